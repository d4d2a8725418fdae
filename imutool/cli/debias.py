"""`imutool debias`."""

from __future__ import annotations

from typing import Annotated

import typer

from imutool.cli._app import Init, Json, Overwrite, Quiet, Smooth, Verbose, app
from imutool.place import place
from imutool.terminal import progress, say, write_json


@app.command(epilog="Example: [bold]imutool debias MH_04.mcap MH_04_debiased.mcap --model adis.safetensors[/]")
def debias(
    source: Annotated[str, typer.Argument(metavar="IN", help="An MCAP log: a file, or a URL such as s3://bucket/log.mcap.")],
    target: Annotated[str, typer.Argument(metavar="OUT", help="The log with the debiased IMU beside the raw one.")],
    model: Annotated[
        str | None, typer.Option(help="Model file, physics.toml or a name that ships; else a static estimate.")
    ] = None,
    imu: Annotated[list[str] | None, typer.Option(help="IMU topic, where a log has several. Repeatable.")] = None,
    init: Init = "auto",
    smooth: Smooth = False,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Rewrite a log with a debiased IMU channel; everything else passes through unchanged."""
    from imutool.debias import debias as run

    with progress("Debiasing", verbose, quiet) as tell:
        report = run(
            place(source),
            place(target),
            model=model,
            imus=imu or (),
            init=init,
            smooth=smooth,
            overwrite=overwrite,
            progress=lambda done, total: tell(done, total, ""),
        )
    imus = {
        topic: {
            "model": report.models[topic],
            "init_how": start.how,
            "gyro_bias": start.rest[:3].tolist(),
            "accel_bias": start.rest[3:].tolist(),
            "std": start.std.tolist(),
        }
        for topic, start in report.starts.items()
    }
    added, copied = dict(report.rewrite.added), report.rewrite.copied
    result = {"schema": "imutool.debias/1", "output": str(target), "imus": imus, "copied": copied, "added": added}
    if write_json(result, json_to):
        return
    for topic, entry in imus.items():
        bias = ", ".join(f"{b:+.5f}" for b in entry["gyro_bias"]), ", ".join(f"{b:+.4f}" for b in entry["accel_bias"])
        start = f"start bias {bias[0]} rad/s; {bias[1]} m/s² ({entry['init_how']})"
        say(f"{topic}: {entry['model']}, {start}")
    counts = ", ".join(f"{count} on {name}" for name, count in added.items())
    say(f"{target}: {copied} messages as they were, {counts}")
