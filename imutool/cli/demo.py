"""`imutool demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from imutool.cli.app import Json, Overwrite, Quiet, Verbose, app
from imutool.cli.figures import epoch_line, figures
from imutool.cli.terminal import err, plain, progress, say, write_json


@app.command(epilog="Example: [bold]imutool demo -o demo-out[/]")
def demo(
    folder: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Where everything goes.")] = Path("demo-out"),
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Go the whole way on a made-up recording: convert, train, debias, evaluate, view. No download."""
    from imutool.demo import run

    def announce(line: str) -> None:
        if not quiet:
            err.print(plain(line), highlight=False, soft_wrap=True)

    with progress("Training", verbose, quiet) as tell:
        done = run(folder, announce, overwrite=overwrite, progress=lambda epoch: tell(*epoch_line(epoch)))
    files = {name: str(getattr(done, name)) for name in ("log", "debiased", "model", "rrd", "png", "report")}
    if not write_json({"schema": "imutool.demo/1", "results": done.results, **files}, json_to):
        say("Pure integration of a flight the model has not seen, from its true start:")
        figures(done.results)
        say(f"Report: {done.report}. Error curves: {done.png}. In the viewer: rerun {done.rrd}")
