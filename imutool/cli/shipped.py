"""Commands about imutool itself: `models`, `schema` and `demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from msgspec import convert
from msgspec.structs import astuple

from imutool.cli.app import Json, Overwrite, Quiet, Verbose, Written, app
from imutool.cli.evaluate import Score
from imutool.cli.terminal import epoch_line, err, figures, log_to_stderr, plain, progress, say, table, write_json
from imutool.report import REPORTS, Report, Section, json_schema

FOLDER = Written(files=("*",), keeps=True)


class DemoReport(Report, frozen=True, tag="imutool.demo/1"):
    """Report of `imutool demo`: scores of `imutool evaluate`, and the files written."""

    results: list[Score]
    log: str
    debiased: str
    model: str
    rrd: str
    png: str
    report: str


class ModelEntry(Section, frozen=True):
    """Model that ships with imutool."""

    name: str
    method: str
    sensor: str | None
    dataset: str | None
    rate_hz: float


class Models(Report, frozen=True, tag="imutool.models/1"):
    """Report of `imutool models`."""

    models: list[ModelEntry]


@app.command(epilog="Example: [bold]imutool models --json -[/]")
def models(overwrite: Overwrite = False, json_to: Json = None, verbose: Verbose = False, quiet: Quiet = False) -> None:
    """List the models that ship, their sensor and their card."""
    from imutool.bias.io import header_of, library

    log_to_stderr(verbose, quiet)
    entries = []
    for path in sorted(library().glob("*.safetensors")):
        about = header_of(path)
        rate_hz = round(float(about["rate_hz"]), 1)
        entries.append(ModelEntry(path.stem, about["method"], about.get("sensor"), about.get("dataset"), rate_hz))
    if write_json(Models(entries), json_to, overwrite=overwrite):
        return
    if entries:
        table([ModelEntry.__struct_fields__, *(tuple(map(str, astuple(model))) for model in entries)], keys=1)
    else:
        say("No model ships with this version; train one with: imutool train")


@app.command(epilog="Example: [bold]imutool schema info[/]")
def schema(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="A report, such as info; by default list all.")] = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Print the JSON Schema of a report, or list the reports."""
    log_to_stderr(verbose, quiet)
    if name is None:
        for report in sorted(REPORTS):
            say(report)
    else:
        write_json(json_schema(name), "-")


@app.command(epilog="Example: [bold]imutool demo -o demo-out[/]")
def demo(
    folder: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Output folder."), FOLDER] = Path("demo-out"),
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Run a demo without download: convert, train, debias, evaluate, view.

    The recording is made up.
    """
    from imutool.cli.demo import run

    def announce(line: str) -> None:
        if not quiet:
            err.print(plain(line), highlight=False, soft_wrap=True)

    with progress("Training", verbose, quiet) as tell:
        done = run(folder, announce, overwrite=overwrite, progress=lambda epoch: tell(*epoch_line(epoch)))
    files = {name: str(getattr(done, name)) for name in ("log", "debiased", "model", "rrd", "png", "report")}
    if not write_json(DemoReport(results=convert(done.results, list[Score]), **files), json_to, overwrite=overwrite):
        say("Pure integration of a flight the model has not seen, from its true start:")
        figures(done.results)
        say(f"Report: {done.report}. Error curves: {done.png}. In the viewer: rerun {done.rrd}")
