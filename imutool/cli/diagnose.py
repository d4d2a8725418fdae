"""`imutool diagnose`, and `imutool audit` of a simulator alone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from imutool.cli.app import COMMON, Common, Imu, Set, Truth, Written, app
from imutool.cli.parameters import with_flags
from imutool.cli.terminal import logger, say, table

if TYPE_CHECKING:
    from imutool.diagnosis.result import Diagnosis

FOLDER = Written(files=("findings.json", "physics.toml", "noise.toml", "report.html", "log.html", "view.rrd"))
Folder = Annotated[
    Path | None,
    typer.Option(
        "-o",
        "--output",
        metavar="DIR",
        help="Folder for findings.json, physics.toml, noise.toml, report.html, log.html and view.rrd.",
    ),
    FOLDER,
]
Sim = Annotated[
    str | None,
    typer.Option(metavar="SIM", help="Simulation; by default the recording's poses. With poses in both, motions may differ."),
]
Close = Annotated[
    bool,
    typer.Option("--close", help="Simulate again with physics.toml (DIR/closed.mcap), add what is still missing, and compare."),
]
Metric = Annotated[
    Path | None, typer.Option(metavar="SCRIPT", help="Your figure for --close: python SCRIPT REAL SIM prints a number.")
]


@app.command(epilog="Example: [bold]imutool diagnose real.mcap --sim sim.mcap -o diagnosis[/]")
def diagnose(
    reals: Annotated[
        list[str],
        typer.Argument(metavar="REAL", help="Recordings, files or URLs; several share the physics, each has its own bias."),
    ],
    sim: Sim = None,
    signal: Annotated[
        list[str] | None, typer.Option(metavar="TOPIC.field", help="Also compare this field of both logs. Repeatable.")
    ] = None,
    folder: Folder = None,
    close: Close = False,
    metric: Metric = None,
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE.toml", help="File of settings; the documentation lists them."),
    ] = None,
    set_: Set = None,
    imu: Imu = None,
    truth: Truth = None,
    common: Common = COMMON,
) -> None:
    """Find physics that a simulation leaves out, by comparison with a recording.

    Name each effect, estimate its parameters, and show how much closer the simulation comes.
    """
    from imutool import diagnosis_output
    from imutool.config import load as load_settings
    from imutool.diagnosis.closed_loop import script_metric
    from imutool.diagnosis.compared_logs import ComparedLogs
    from imutool.diagnosis.settings import DiagnoseSettings
    from imutool.file_location import local, refuse_twins, to_location
    from imutool.processes.forked import forking

    logs = [to_location(real) for real in reals]
    refuse_twins(logs, "reals")
    settings = load_settings(DiagnoseSettings, config, set_ or ())
    with forking(), common.progress("Diagnosing") as tell:
        diagnosis, remarks = diagnosis_output.diagnose(
            ComparedLogs(logs, None if sim is None else to_location(sim), imu, truth, signal or (), settings),
            folder,
            close=close,
            metric=None if metric is None else script_metric(metric, local(logs[0], "metric")),
            overwrite=common.overwrite,
            tell=tell,
        )
    for remark in remarks:
        logger.warning("%s", remark)
    if not common.write(diagnosis.report):
        _say(diagnosis, folder)


def _say(diagnosis: Diagnosis, folder: Path | None) -> None:
    from imutool import diagnosis_output
    from imutool.diagnosis.wording.conclusion import below, headline, notes
    from imutool.diagnosis.wording.conclusion import table as findings_table
    from imutool.units import SENSORS

    say(headline(diagnosis))
    if diagnosis.findings:
        say("")
        table(findings_table(diagnosis), keys=1)
    for line in [*below(diagnosis), *notes(diagnosis)]:
        say(line)
    if diagnosis.closed is not None:
        from imutool.diagnosis.closed_loop import table as closed_table

        missing = ", ".join(diagnosis.closed.findings) or "a misfit without a name"
        answer = f"still missing: {missing}" if diagnosis.closed.mismatch else "nothing is missing"
        if any(finding.signal not in (*SENSORS, "both") for finding in diagnosis.findings):
            answer += " in the IMU; effects of other signals are not simulated"
        rounds = f", after {diagnosis.closed.rounds} rounds" if diagnosis.closed.rounds > 1 else ""
        say(f"Simulated again with physics.toml and diagnosed again: {answer}{rounds}.")
        if diagnosis.closed.compared:
            table(closed_table(diagnosis.closed), keys=1)
    if folder is not None:
        closed = () if diagnosis.closed is None else diagnosis_output.OF_CLOSE
        say(f"{folder}: {', '.join(name for name in (*diagnosis_output.FILES, *closed) if (folder / name).exists())}")


@app.command(epilog="Example: [bold]imutool audit sim.mcap --real real.mcap --noise adis16448[/]")
def audit(
    sim: Annotated[Path, typer.Argument(metavar="SIM", help="A simulation: a log with an IMU and the poses of its body.")],
    real: Annotated[
        Path | None, typer.Option(metavar="REAL", help="A recording of the sensor, for noise, digits, limits and lever arm.")
    ] = None,
    noise: Annotated[
        str, typer.Option(metavar="NAME|FILE.toml", help="Its noise: adis16448, bmi160, or a TOML file.")
    ] = "none",
    imu: Imu = None,
    truth: Truth = None,
    common: Common = COMMON,
) -> None:
    """Find the errors of a simulator's IMU, without a recording.

    It checks gravity, frame, axes, transport term, lever arm, timing, noise, digits and limits. Each error comes with its
    equation and a report of a simulator that had it.
    """
    from imutool.diagnosis.audit import audit as run
    from imutool.diagnosis.audit import lines

    with common.progress("Auditing") as tell:
        tell(0, 1, "reading")
        report = run(sim, real, noise=noise, imu=imu, truth=truth)
    if not common.write(report):
        for line in lines(report):
            say(with_flags(line))
