"""`imutool evaluate`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from imutool.cli.app import Imu, Init, Json, Logs, Models, Overwrite, Quiet, ReportPage, Smooth, Truth, Verbose, app
from imutool.cli.terminal import figures, progress, say, write_json
from imutool.report import Report


class Evaluation(Report, frozen=True, tag="imutool.evaluation/1"):
    """Report of `imutool evaluate`: scores of each log, model and estimate."""

    results: list[dict[str, Any]]


@app.command(epilog="Example: [bold]imutool evaluate MH_04.mcap --model adis.safetensors --init truth[/]")
def evaluate(
    logs: Logs,
    model: Models = None,
    init: Init = "auto",
    smooth: Smooth = False,
    zupt: Annotated[bool, typer.Option("--zupt", help="Also score dead reckoning with zero-velocity updates.")] = False,
    truth: Truth = None,
    imu: Imu = None,
    trajectories: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for trajectories in TUM format.")] = None,
    report: ReportPage = None,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Integrate the IMU from the true start, raw and debiased, and score it on the truth."""
    from imutool.evaluation import evaluate as run
    from imutool.viewing.html import report as pages
    from imutool.viewing.model.runs import load

    if report is not None:
        pages.check_target(report, overwrite=overwrite)
    results: list[dict[str, Any]] = []
    loaded = []
    with progress("Evaluating", verbose, quiet) as tell:
        for done, log in enumerate(logs):
            tell(done, len(logs), log.name)
            first = len(results)
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
            if report is not None:
                run_data = load(log, models=model or (), init=init, smooth=smooth, truth=truth, imu=imu)
                loaded.append(replace(run_data, notes=(*run_data.notes, *_stops(results[first:]))))
        if report is not None:
            tell(len(logs), len(logs), "drawing")
            pages.write_page(loaded, report, overwrite=overwrite)
        tell(len(logs), len(logs), "")
    if not write_json(Evaluation(results), json_to):
        figures([{**row, "model": f"{row['model']} zupt"} if row["estimate"] == "zupt" else row for row in results])
        if report is not None:
            say(f"Report: {report}")


def _stops(results: Sequence[dict[str, Any]]) -> list[str]:
    """Sentences about the scores with zero-velocity updates.

    The report draws pure integration.
    """
    return [
        f"With zero-velocity updates {row['model']} has an orientation error of {row['aoe_deg']:.2f}° and a position error of "
        f"{row['ape_m']:.2f} m."
        for row in results
        if row["estimate"] == "zupt"
    ]
