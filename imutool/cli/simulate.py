"""Made-up logs: `imutool simulate` and the blind cases of `imutool conceal`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from imutool.cli.app import COMMON, LOG, Common, Json, Quiet, Truth, Verbose, app
from imutool.cli.terminal import log_to_stderr, logger, say, write_json
from imutool.errors import ConfigError, DataError
from imutool.report import Report, Section

LONGEST_S = 75.0  # of a case's trajectory


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
    truth: str | None
    imu: str | None
    physics: dict[str, Any]
    noise: dict[str, Any]
    rate_hz: float
    seed: int
    output: str
    samples: int
    duration_s: float
    stretches_s: list[list[float]]
    motion: MotionQuality | None
    remarks: list[str]


@app.command(epilog="Example: [bold]imutool simulate V1_02.mcap sim.mcap --physics physics.toml --noise adis16448 --seed 1[/]")
def simulate(
    trajectory: Annotated[Path, typer.Argument(metavar="TRAJECTORY", help="An MCAP log with poses.")],
    target: Annotated[str, typer.Argument(metavar="OUT", help="New log with the simulated IMU and the poses."), LOG],
    physics: Annotated[Path | None, typer.Option(metavar="FILE.toml", help="Physics of the sensor; by default ideal.")] = None,
    noise: Annotated[str, typer.Option(metavar="NAME|FILE.toml", help="none, adis16448, bmi160, or a TOML file.")] = "none",
    rate: Annotated[
        float | None, typer.Option(metavar="HZ", help="Samples per second; by default the log's IMU rate, or 200.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the noise.")] = 0,
    truth: Truth = None,
    imu: Annotated[
        str | None,
        typer.Option(metavar="TOPIC", help="Start from the samples of this simulated IMU, instead of the poses."),
    ] = None,
    common: Common = COMMON,
) -> None:
    """Simulate an IMU, with a sensor's physics and noise.

    The motion is that of the log's poses or, with --imu, of a simulated IMU's samples.
    """
    from imutool.file_location import local
    from imutool.sensor.simulate import simulate as run

    along = None
    if imu is not None:
        from imutool.diagnosis.second_simulation import along_samples

        along = partial(along_samples, imu=imu)
    with common.progress("Simulating") as tell:
        simulation = run(
            trajectory,
            local(target, "target"),
            physics=physics,
            noise=noise,
            rate_hz=rate,
            seed=seed,
            truth=truth,
            overwrite=common.overwrite,
            progress=tell,
            along=along,
        )
        for remark in simulation.remarks:
            logger.warning("%s", remark)
    values = {key: value for key, value in simulation.plain().items() if key != "schema"}
    motion = None if values["motion"] is None else MotionQuality(**values["motion"])
    report = SimulationReport(**values | {"motion": motion})
    if common.write(report):
        return
    acting = [effect["name"] for effect in report.physics["effect"] if not effect["column"]]
    acting += [f"a curve of {curve['variable']}" for curve in report.physics["unknown"]]
    acting += [term["term"] for term in report.physics["term"]] + ["bias"] * (report.physics["bias"] is not None)
    names = ", ".join(acting) or "ideal"
    pieces = len(report.stretches_s)
    where = f"{report.duration_s:.1f} s" + (f" in {pieces} stretches" if pieces > 1 else "")
    say(f"{target}: {report.samples} samples at {report.rate_hz:g} Hz over {where}; physics {names}; noise {noise}")
    if motion is None:
        say(f"from the samples of {report.imu}, without their white noise")
        return
    std = f"{motion.gyro_std_rad_s:.2g} rad/s and {motion.accel_std_m_s2:.2g} m/s²"
    say(f"uncertainty of the motion {std}; {motion.glitches} outliers and {motion.steps} jumps of the poses removed")


@app.command(
    epilog="Example: [bold]imutool conceal MH_03.mcap case/ --seed 7[/]; once diagnosed [bold]imutool conceal --open case/[/]"
)
def conceal(
    places: Annotated[list[Path], typer.Argument(metavar="[TRAJECTORY] DIR", help="A log with true poses; the case's folder.")],
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the case; by default random.")] = None,
    kind: Annotated[str, typer.Option(help="single, pair, null, driven, unknown, uncalibrated or any.")] = "any",
    size: Annotated[str, typer.Option(help="large (plausible), middle (a quarter), small (just visible) or any.")] = "any",
    noise: Annotated[str, typer.Option(help="any, adis16448, bmi160, navigation or a TOML file.")] = "any",
    longest: Annotated[
        float, typer.Option(min=20.0, metavar="SECONDS", help="Use at most this much of the trajectory.")
    ] = LONGEST_S,
    truth: Truth = None,
    open_it: Annotated[bool, typer.Option("--open", help="Open the envelope in DIR and score DIR/findings.json.")] = False,
    findings: Annotated[Path | None, typer.Option(help="Score this findings file (with --open).")] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing --json; a case is never replaced.")
    ] = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Make a sealed blind case, or open one and score the findings.

    A case is a simulation, a recording, and an envelope with the effects that separate them.
    """
    log_to_stderr(verbose, quiet)
    if len(places) != (1 if open_it else 2):
        given = " ".join(map(str, places))
        raise ConfigError(f"{given!r} is given", where="conceal", expected="DIR alone" if open_it else "TRAJECTORY and DIR")
    made = {"--seed": seed is not None, "--kind": kind != "any", "--size": size != "any", "--noise": noise != "any"}
    made |= {"--longest": longest != LONGEST_S, "--truth": truth is not None}
    if open_it and (idle := [name for name, given in made.items() if given]):
        raise ConfigError(f"{idle[0]} is of a case that is made", where="conceal", fix="Leave it out, or --open")
    if open_it:
        _open(places[0], findings, json_to, overwrite)
        return
    if findings is not None or json_to is not None:
        raise ConfigError("--findings and --json need --open", where="conceal", fix="Add --open")
    from imutool.blind_cases import conceal as run
    from imutool.log_info.convention_report import check_poses
    from imutool.mcap_io.read import read

    check_poses(read(places[0], truth=truth))  # here, as a case shares no code with what estimates
    run(places[0], places[1], seed=seed, kind=kind, size=size, noise=noise, longest_s=longest, truth=truth)
    say(f"{places[1]}: sim.mcap, real.mcap, envelope.json and its key")
    say(f"next: imutool diagnose {places[1]}/real.mcap --sim {places[1]}/sim.mcap -o {places[1]}")
    say(f"then: imutool conceal --open {places[1]}")


def _open(folder: Path, findings: Path | None, json_to: str | None, overwrite: bool) -> None:
    import msgspec

    from imutool.blind_cases import open_case

    if not (folder / "envelope.json").exists():
        raise DataError("holds no blind case", where=folder, expected="a folder that imutool conceal made")
    if findings is None and not (folder / "findings.json").exists():
        fix = f"Run imutool diagnose {folder}/real.mcap --sim {folder}/sim.mcap -o {folder}"
        raise DataError("holds no findings.json to score", where=folder, expected="a case after its diagnosis", fix=fix)
    result: dict[str, Any] = msgspec.to_builtins(open_case(folder, findings))
    if write_json(result, json_to, overwrite=overwrite):
        return
    hidden = "; ".join(_effect_text(effect) for effect in result["truth"]["effects"]) or "nothing but a bias and noise"
    say(f"concealed ({result['kind']}, {result['size']}): {hidden}")
    say(f"found: {', '.join(result['found']) or 'nothing'}; the names are {'right' if result['right'] else 'not right'}")
    if result["place"]["f1"] is not None:
        say(f"place: F1 {result['place']['f1']:.2f}")
    for row in result["parameters"]:
        sigmas = "" if row["sigmas"] is None else f", {row['sigmas']:+.1f} sigmas off"
        name = f"{row['effect']}.{row['parameter']}"
        say(f"{name}: {row['value']:.5g} ± {row['std']:.2g}, truly {row['true']:.5g} ({row['percent']:.2g} %{sigmas})")
    if result["gain"] is not None:
        say(f"gain: {100.0 * result['gain']:.0f} % of what perfect knowledge would remove")


def _effect_text(effect: dict[str, Any]) -> str:
    """Effect with its parameters; those without influence are left out."""
    numbers = (
        f"{name} {parameter['value']:.4g} {parameter['unit']}"
        for name, parameter in effect["parameters"].items()
        if parameter["value"] != 0.0 and abs(parameter["value"]) < 1e8 and not name.startswith("phase")
    )
    driver = f" by {effect['driver']}" if effect["driver"] else ""
    return f"{effect['effect']}{driver} ({', '.join(numbers)})"
