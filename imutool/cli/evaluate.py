"""Scores against the true poses: `imutool evaluate` and `imutool vio`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from msgspec import convert, field

from imutool.bias_start import Fitness
from imutool.cli.app import COMMON, Aid, Common, Imu, Init, Logs, Models, ReportPage, Set, Smooth, Truth, Written, app
from imutool.cli.terminal import figures, kept_for_end, raise_kept, say, table
from imutool.errors import ConfigError, ImutoolError, ModelError
from imutool.report import UNSET, Report, Section, UnsetType

ALIGNED_HELP = (
    "Also print evo's orientation error after an alignment of the positions (SE(3)); it is no measure of the attitude."
)
TRAJECTORIES = Written(files=("*.tum",), keeps=True, of_each="{}_*.tum")


class Score(Section, frozen=True, kw_only=True):
    """Scores of an estimate of a log; degrees, metres, biases in rad/s and m/s².

    Relative errors are keyed by their distance in metres; a figure that the log does not show is null. `aids` are the topics
    that an aided path used, by kind. The drift is that of windows from the truth, by the trapezoidal rule, with the deviation
    that the bias expects. A positive delay says that the poses are late; the scores without it, by the same rule, are there
    where it is clear.
    """

    log: str
    model: str
    estimate: Literal["integration", "aided"]
    aids: dict[str, str] = field(default_factory=dict)  # older reports have none
    init: str | None
    init_how: str | None
    smooth: bool
    fit: Fitness | UnsetType | None = UNSET
    samples: int
    duration_s: float
    aoe_deg: float
    aoe_aligned_deg: float | None
    ape_m: float | None
    ape_aligned_m: float | None
    velocity_rmse_m_s: float | None
    roe_deg: dict[str, float | None]
    rpe_m: dict[str, float | None]
    drift_orientation_deg: float | None
    drift_velocity_m_s: float | None
    drift_orientation_std_deg: float | UnsetType | None = UNSET
    drift_velocity_std_m_s: float | UnsetType | None = UNSET
    pose_delay_s: float | UnsetType | None = UNSET
    pose_delay_std_s: float | UnsetType | None = UNSET
    aoe_without_delay_deg: float | UnsetType | None = UNSET
    drift_orientation_without_delay_deg: float | UnsetType | None = UNSET
    drift_window_s: float
    gyro_bias: list[float]
    accel_bias: list[float]


class Evaluation(Report, frozen=True, tag="imutool.evaluation/1"):
    """Report of `imutool evaluate`: scores of each log, model and estimate."""

    results: list[Score]


class VioReport(Report, frozen=True, tag="imutool.vio/1"):
    """Report of `imutool vio`: scores of each log, model and choice of bias states."""

    results: list[dict[str, Any]]


@app.command(epilog="Example: [bold]imutool evaluate MH_04.mcap --model adis.safetensors --init truth[/]")
def evaluate(
    logs: Logs,
    model: Models = None,
    init: Init = "auto",
    smooth: Smooth = False,
    aid: Aid = None,
    zupt: Annotated[bool, typer.Option("--zupt", help="The same as --aid stops.")] = False,
    truth: Truth = None,
    imu: Imu = None,
    trajectories: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for trajectories in TUM format."), TRAJECTORIES
    ] = None,
    aligned: Annotated[bool, typer.Option("--aligned", help=ALIGNED_HELP)] = False,
    report: ReportPage = None,
    common: Common = COMMON,
) -> None:
    """Integrate the IMU from the true start, raw and debiased, and compare it with the truth.

    Without --model it scores the debiased samples of the log, if there are any. Models that do not apply to a log or do not
    fit it, and logs that are not usable, are named after the scores of the others.
    """
    from imutool.evaluation import evaluate as run

    if trajectories is not None and len(logs) > 1:
        _refuse_one_name(logs)
    if report is not None:
        from imutool.viewing.html import report as pages
        from imutool.viewing.html.drawing import require_matplotlib
        from imutool.viewing.model.load_view import load

        require_matplotlib()
    results: list[dict[str, Any]] = []
    loaded, asked = [], ",".join(filter(None, (aid, "stops" if zupt else None))) or None
    errors: list[ImutoolError] = []
    with common.progress("Evaluating") as tell:
        for done, log in enumerate(logs):
            tell(done, len(logs), log.name)
            refused: dict[str, ImutoolError] = {}
            read: dict[str, Any] = {"init": init, "smooth": smooth, "truth": truth, "imu": imu}
            more: dict[str, Any] = {"trajectories": trajectories, "overwrite": common.overwrite, "refused": refused.__setitem__}
            with kept_for_end(errors):
                found = run(log, models=model or (), aid=asked, **read, **more)
                errors += [each.replaced(what=f"the model {name} is not scored: {each.what}") for name, each in refused.items()]
                if report is not None:
                    scored = [name for name in model or () if name not in refused]
                    run_data = load(log, models=scored, aid=asked, **read)
                    loaded.append(replace(run_data, notes=(*run_data.notes, *_late(found))))
                results += found
        if not results:
            raise_kept(errors)
        if report is not None:
            tell(len(logs), len(logs), "drawing")
            pages.write_page(loaded, report, overwrite=common.overwrite)
        tell(len(logs), len(logs), "")
    if not common.write(Evaluation(convert(results, list[Score]))):
        rows = [{**row, "model": f"{row['model']} aided"} if row["estimate"] == "aided" else row for row in results]
        figures(rows, aligned=aligned)
        for sentence in [*_used(results), *_late(results), *([] if report is None else [f"Report: {report}"])]:
            say(sentence)
    raise_kept([*errors, *_unfit(results)])


def _refuse_one_name(logs: Sequence[Path]) -> None:
    """Refuse two logs of one name, before any work: they would write the same trajectories (ConfigError)."""
    from imutool.file_location import log_name
    from imutool.mcap_io.log import Log
    from imutool.mcap_io.write import own_and_user_metadata

    known: dict[str, Path] = {}
    for path in logs:
        with kept_for_end([]), Log(path) as log:  # one that is no log is named later
            own, _ = own_and_user_metadata(log.metadata_records(), "")
            name = own.get("name", log_name(path))
            if name in known:
                what = f"{known[name]} and {path} are both called {name!r}"
                raise ConfigError(what, where="trajectories", fix="Score them one at a time, each with a folder of its own")
            known[name] = path


def _unfit(results: Sequence[dict[str, Any]]) -> list[ImutoolError]:
    """Errors of scored models that `debias` would refuse; warns of all that may not fit a log."""
    rows = [row for row in results if row["estimate"] == "integration" and row["fit"]]
    verdicts = [convert(row["fit"], Fitness).report(row["model"], row["log"], force=True).verdict for row in rows]
    what, fix = "the model {model!r} does not fit this log, by its samples; the report has its scores", "Choose another model"
    return [
        ModelError(what.format_map(row), where=row["log"], expected="a model of this sensor", fix=fix)
        for row, verdict in zip(rows, verdicts, strict=True)
        if verdict == "unfit"
    ]


def _late(results: Sequence[dict[str, Any]]) -> list[str]:
    """Sentences about poses whose clock makes a part of the errors."""
    from imutool.cleaning.pose_delay import lateness

    sentences = []
    for row in results:
        if row["estimate"] == "integration" and row["pose_delay_s"] is not None:
            aoe, drift = row["aoe_without_delay_deg"], row["drift_orientation_without_delay_deg"]
            late = f"{row['log']}, {row['model']}: the poses are {lateness(row['pose_delay_s'], 1)} by the debiased gyro"
            without = f"AOE is {aoe:.2f}°, and {drift:.2f}° after {row['drift_window_s']:g} s"
            sentences.append(f"{late}; without that, by the trapezoidal rule, {without}")
    return sentences


def _used(results: Sequence[dict[str, Any]]) -> list[str]:
    """Sentences about the aids of each log."""
    from imutool.inertial.aids import listed

    used = {row["log"]: row["aids"] for row in results if row["aids"]}
    return [f"{log}, aids: {listed(aids)}" for log, aids in used.items()]


@app.command(epilog="Example: [bold]imutool vio MH_04.mcap --model adis.safetensors --blackout 3[/]")
def vio(
    logs: Logs,
    model: Models = None,
    init: Init = "auto",
    truth: Truth = None,
    imu: Imu = None,
    bias_states: Annotated[
        bool | None, typer.Option("--bias-states/--no-bias-states", help="Estimate biases, or trust the IMU; by default both.")
    ] = None,
    lag: Annotated[float, typer.Option(metavar="SECONDS", help="Lag of the fixed-lag smoother.")] = 3.0,
    keyframes: Annotated[float, typer.Option(metavar="HZ", help="Camera keyframes per second.")] = 4.0,
    features: Annotated[int, typer.Option(help="Feature tracks in a frame.")] = 30,
    pixel_noise: Annotated[float, typer.Option(metavar="PX", help="White noise of a pixel coordinate.")] = 1.0,
    blackout: Annotated[float, typer.Option(metavar="SECONDS", help="Length of a camera blackout in every 15 s.")] = 0.0,
    duration: Annotated[float | None, typer.Option(metavar="SECONDS", help="Use only this much of each log.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of landmarks, tracks and pixel noise.")] = 0,
    set_: Set = None,
    common: Common = COMMON,
) -> None:
    """Score a visual-inertial estimate on the log's IMU, raw and with each model.

    The camera is simulated: EuRoC's stereo pair along the log's true poses, on every data set.
    """
    from imutool.config import load
    from imutool.vio.run import VioSettings, tabulate
    from imutool.vio.run import vio as run

    given = {"smoother.lag_s": lag, "keyframes_hz": keyframes, "features": features, "pixel_noise": pixel_noise}
    given |= {"blackout_s": blackout, "seed": seed} | ({} if duration is None else {"duration_s": duration})
    settings = load(VioSettings, None, [*(f"{key}={value}" for key, value in given.items()), *(set_ or ())])
    states = (True, False) if bias_states is None else (bias_states,)
    results: list[dict[str, Any]] = []
    errors: list[ImutoolError] = []
    read: dict[str, Any] = {"init": init, "truth": truth, "imu": imu, "bias_states": states, "settings": settings}
    with common.progress("Estimating") as tell:
        for log in logs:
            with kept_for_end(errors):
                results += run(log, models=model or (), **read, progress=tell)
        if not results:
            raise_kept(errors)
    if not common.write(VioReport(results)):
        for rows in tabulate(results):
            table(rows, keys=3)
        say(f"Camera, simulated along the truth: {results[0]['camera']}; {results[0]['tracks']} tracks in a frame")
        for row in results:
            if row["failed"]:
                say(f"{row['log']}, {row['model']}, bias states {'on' if row['bias_states'] else 'off'}: {row['failed']}")
    raise_kept(errors)
