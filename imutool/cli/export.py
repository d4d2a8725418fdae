"""`imutool export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from imutool.cli.app import Json, Overwrite, Quiet, Verbose, app
from imutool.cli.terminal import progress, say, write_json


@app.command(epilog="Example: [bold]imutool export MH_04_debiased.mcap MH_04_debiased --format euroc[/]")
def export(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="An MCAP log.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="The folder that is made.")],
    format: Annotated[str, typer.Option(help="euroc: an ASL folder; rosbag2: a folder around a copy of the log.")],
    imu: Annotated[str | None, typer.Option(help="IMU topic of a EuRoC folder; by default the debiased one.")] = None,
    noise: Annotated[
        str | None, typer.Option(metavar="NAME|F.toml", help="Noise for its sensor.yaml: a data sheet or a file.")
    ] = None,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Write a log as a EuRoC folder or a rosbag2 folder, for programs that read those."""
    from imutool.exporting.export import export as run

    with progress("Exporting", verbose, quiet) as tell:
        report = run(log, target, format=format, imu=imu, sensor_noise=noise, overwrite=overwrite, progress=tell)
    if write_json(report.plain(), json_to):
        return
    counts = ", ".join(f"{count} on {name}" for name, count in report.written.items())
    say(f"{target}: {counts}" + (f"; IMU from {report.imu}" if report.imu else ""))
    if report.left_out:
        say(f"left out: {', '.join(report.left_out)}")
