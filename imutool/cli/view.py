"""`imutool view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from imutool.cli._app import Imu, Init, Logs, Models, Overwrite, Quiet, Truth, Verbose, app
from imutool.terminal import progress, say


@app.command(epilog="Example: [bold]imutool view MH_04_debiased.mcap --save MH_04.rrd[/]")
def view(
    logs: Logs,
    model: Models = None,
    init: Init = "auto",
    truth: Truth = None,
    imu: Imu = None,
    save: Annotated[Path | None, typer.Option(metavar="F.rrd", help="Save instead of opening the viewer.")] = None,
    png: Annotated[Path | None, typer.Option(metavar="DIR", help="Also draw its pictures, LOG-errors.png and so on.")] = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Show truth, raw and debiased in the Rerun viewer, or save them for it."""
    from imutool.view import report
    from imutool.view.rerun import viewer
    from imutool.view.runs import load

    with progress("Reading", verbose, quiet) as tell:
        data = []
        for done, log in enumerate(logs):
            tell(done, len(logs), log.name)
            data.append(load(log, models=model or (), init=init, imu=imu, truth=truth))
    if png is not None:
        for one in data:
            report.write_pngs(one, png, overwrite=overwrite)
    say(viewer.show(data, save=save, overwrite=overwrite))
