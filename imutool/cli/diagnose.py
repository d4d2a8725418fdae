"""`imutool diagnose`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from imutool.cli.app import Imu, Json, Overwrite, Quiet, Truth, Verbose, Written, app
from imutool.cli.terminal import logger, progress, say, table, write_json

if TYPE_CHECKING:
    from imutool.diagnosis.result import Diagnosis
    from imutool.viewing.model.run_data import RunData

FOLDER = Written(files=("findings.json", "physics.toml", "report.html", "log.html", "view.rrd"))


@app.command(epilog="Example: [bold]imutool diagnose real.mcap --sim sim.mcap -o diagnosis[/]")
def diagnose(
    reals: Annotated[
        list[Path], typer.Argument(metavar="REAL...", help="Recordings; several share the physics, each has its own bias.")
    ],
    sim: Annotated[
        Path | None,
        typer.Option(
            metavar="SIM", help="Simulation, of any motion if both have poses; by default along the recording's poses."
        ),
    ] = None,
    signal: Annotated[
        list[str] | None, typer.Option(metavar="TOPIC.field", help="Also compare this field of both logs. Repeatable.")
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="DIR", help="Folder for findings.json, physics.toml, report.html, log.html and view.rrd."
        ),
        FOLDER,
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE.toml", help="Settings; imutool.diagnosis.settings.DiagnoseSettings lists them."),
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="key=value", help="Change one setting. Repeatable.")
    ] = None,
    imu: Imu = None,
    truth: Truth = None,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Find physics that a simulation leaves out, by comparison with a recording.

    Name each effect, estimate its parameters, and show how much closer the simulation comes.
    """
    from imutool import diagnosis_output
    from imutool.config import load as load_settings
    from imutool.diagnosis.diagnose import diagnose as run
    from imutool.diagnosis.settings import DiagnoseSettings
    from imutool.viewing.model.runs import load

    def look(findings: Path) -> list[RunData]:
        return [load(real, imu=imu, truth=truth, findings=findings) for real in reals]

    settings = load_settings(DiagnoseSettings, config, set_ or ())
    if folder is not None:
        diagnosis_output.refuse(folder, overwrite=overwrite)
    with progress("Diagnosing", verbose, quiet) as tell:
        diagnosis = run(reals, sim, imu=imu, truth=truth, signals=signal or (), tell=tell, settings=settings)
        if folder is not None:
            tell(0, 1, "writing")
            for remark in diagnosis_output.write(diagnosis, folder, logs=look, overwrite=overwrite):
                logger.warning("%s", remark)
    if write_json(diagnosis.report, json_to, overwrite=overwrite):
        return
    _say(diagnosis, folder)


def _say(diagnosis: Diagnosis, folder: Path | None) -> None:
    from imutool import diagnosis_output
    from imutool.diagnosis.wording.conclusion import below, headline, notes
    from imutool.diagnosis.wording.conclusion import table as findings_table

    say(headline(diagnosis))
    if diagnosis.findings:
        say("")
        table(findings_table(diagnosis), keys=1)
    for line in [*below(diagnosis), *notes(diagnosis)]:
        say(line)
    if folder is not None:
        say(f"{folder}: {', '.join(name for name in diagnosis_output.FILES if (folder / name).exists())}")
