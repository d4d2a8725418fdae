"""`imutool evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from imutool.cli._app import Imu, Init, Json, Logs, Models, Overwrite, Quiet, Smooth, Truth, Verbose, app
from imutool.cli._figures import figures
from imutool.terminal import progress, write_json


@app.command(epilog="Example: [bold]imutool evaluate MH_04.mcap --model adis.safetensors --init truth[/]")
def evaluate(
    logs: Logs,
    model: Models = None,
    init: Init = "auto",
    smooth: Smooth = False,
    zupt: Annotated[bool, typer.Option("--zupt", help="Also dead reckoning that knows when it stands still.")] = False,
    truth: Truth = None,
    imu: Imu = None,
    trajectories: Annotated[Path | None, typer.Option(metavar="DIR", help="Write TUM-format trajectories there.")] = None,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Integrate the IMU alone from the true start, raw and with each model, and score it against the truth."""
    from imutool.evaluate import SCHEMA
    from imutool.evaluate import evaluate as run

    results = []
    with progress("Evaluating", verbose, quiet) as tell:
        for done, log in enumerate(logs):
            tell(done, len(logs), log.name)
            results += run(
                log,
                models=model or (),
                init=init,
                smooth=smooth,
                zupt=zupt,
                truth=truth,
                imu=imu,
                trajectories=trajectories,
                overwrite=overwrite,
            )
        tell(len(logs), len(logs), "")
    if not write_json({"schema": SCHEMA, "results": results}, json_to):
        figures([{**one, "model": f"{one['model']} zupt"} if one["estimate"] == "zupt" else one for one in results])
