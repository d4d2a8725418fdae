"""`imutool simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from imutool.cli.app import Json, Overwrite, Quiet, Truth, Verbose, app
from imutool.cli.terminal import logger, progress, say, write_json
from imutool.report import Report, Section


class MotionQuality(Section, frozen=True):
    """Noise of the poses and of the smoothed motion, with glitches and steps removed."""

    pose_noise_m: list[float]
    pose_noise_rad: list[float]
    cutoff_hz: list[list[float]]
    gyro_std_rad_s: float
    accel_std_m_s2: float
    glitches: int
    steps: int


class SimulationReport(Report, frozen=True, kw_only=True, tag="imutool.simulation/1"):
    """Report of `imutool simulate`."""

    command: str
    trajectory: str
    truth: str
    physics: dict[str, Any]
    noise: dict[str, Any]
    rate_hz: float
    seed: int
    output: str
    samples: int
    duration_s: float
    stretches_s: list[list[float]]
    motion: MotionQuality
    remarks: list[str]


@app.command(epilog="Example: [bold]imutool simulate V1_02.mcap sim.mcap --physics physics.toml --noise adis16448 --seed 1[/]")
def simulate(
    trajectory: Annotated[Path, typer.Argument(metavar="TRAJECTORY", help="An MCAP log with poses.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="New log with the simulated IMU and the poses.")],
    physics: Annotated[Path | None, typer.Option(metavar="FILE.toml", help="Physics of the sensor; by default ideal.")] = None,
    noise: Annotated[str, typer.Option(metavar="NAME|FILE.toml", help="none, adis16448, bmi160, or a TOML file.")] = "none",
    rate: Annotated[
        float | None, typer.Option(metavar="HZ", help="Samples per second; by default the log's IMU rate, or 200.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the noise.")] = 0,
    truth: Truth = None,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Simulate an IMU along the poses of a log, with a sensor's physics and noise."""
    from imutool.sensor.simulate import simulate as run

    with progress("Simulating", verbose, quiet) as tell:
        found = run(
            trajectory,
            target,
            physics=physics,
            noise=noise,
            rate_hz=rate,
            seed=seed,
            truth=truth,
            overwrite=overwrite,
            progress=tell,
        )
        for remark in found.remarks:
            logger.warning("%s", remark)
    values = {key: value for key, value in found.plain().items() if key != "schema"}
    report = SimulationReport(**values | {"motion": MotionQuality(**values["motion"])})
    if write_json(report, json_to):
        return
    acting = [effect["name"] for effect in report.physics["effect"]]
    acting += [f"a curve of {curve['variable']}" for curve in report.physics["unknown"]]
    acting += [term["term"] for term in report.physics["term"]] + ["bias"] * (report.physics["bias"] is not None)
    names = ", ".join(acting) or "ideal"
    pieces = len(found.motion.stretches)
    where = f"{report.duration_s:.1f} s" + (f" in {pieces} stretches" if pieces > 1 else "")
    say(f"{target}: {report.samples} samples at {report.rate_hz:g} Hz over {where}; physics {names}; noise {noise}")
    motion = report.motion
    std = f"{motion.gyro_std_rad_s:.2g} rad/s and {motion.accel_std_m_s2:.2g} m/s²"
    say(f"uncertainty of the motion {std}; {motion.glitches} glitches dropped, {motion.steps} steps levelled")
