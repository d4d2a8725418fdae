"""`imutool models`, which ship, and `imutool schema` of the reports."""

from __future__ import annotations

from typing import Annotated

import typer
from msgspec.structs import astuple

from imutool.cli.app import COMMON, Common, Quiet, Verbose, app
from imutool.cli.terminal import log_to_stderr, say, table, write_json
from imutool.report import REPORTS, Report, Section, json_schema


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
def models(common: Common = COMMON) -> None:
    """List the models that ship: method, sensor, data set and rate."""
    from imutool.bias.model_file import header_of, library

    entries = []
    for path in sorted(library().glob("*.safetensors")):
        about = header_of(path)
        rate_hz = round(float(about["rate_hz"]), 1)
        entries.append(ModelEntry(path.stem, about["method"], about.get("sensor"), about.get("dataset"), rate_hz))
    if common.write(Models(entries)):
        return
    if entries:
        table([ModelEntry.__struct_fields__, *(tuple(map(str, astuple(model))) for model in entries)], keys=1)
    else:
        say("No model ships with this version; train one with: imutool train")


@app.command(epilog="Example: [bold]imutool schema info[/]")
def schema(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="A report, such as info; by default list all.")] = None,
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
