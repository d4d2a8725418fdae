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
    """The report of `imutool evaluate`: scores of each log, model and estimate."""

    results: list[dict[str, Any]]


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
    report: ReportPage = None,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Integrate the IMU alone from the true start, raw and with each model, and score it against the truth."""
    from imutool.evaluation import evaluate as run
    from imutool.viewing.html import report as pages
    from imutool.viewing.model.runs import load

    if report is not None:
        pages.check_target(report, overwrite=overwrite)
    results: list[dict[str, Any]] = []
    logs_seen = []
    with progress("Evaluating", verbose, quiet) as tell:
        for done, log in enumerate(logs):
            tell(done, len(logs), log.name)
            told = len(results)
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
                seen = load(log, models=model or (), init=init, smooth=smooth, truth=truth, imu=imu)
                logs_seen.append(replace(seen, notes=(*seen.notes, *_stops(results[told:]))))
        if report is not None:
            tell(len(logs), len(logs), "drawing")
            pages.write_page(logs_seen, report, overwrite=overwrite)
        tell(len(logs), len(logs), "")
    if not write_json(Evaluation(results), json_to):
        figures([{**one, "model": f"{one['model']} zupt"} if one["estimate"] == "zupt" else one for one in results])
        if report is not None:
            say(f"Report: {report}")


def _stops(results: Sequence[dict[str, Any]]) -> list[str]:
    """What the table says of dead reckoning that knows its stops, in sentences: the report draws pure integration."""
    return [
        f"With zero-velocity updates {one['model']} has an orientation error of {one['aoe_deg']:.2f}° and a position error of "
        f"{one['ape_m']:.2f} m."
        for one in results
        if one["estimate"] == "zupt"
    ]
