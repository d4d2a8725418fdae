"""Evaluate pure integration by the true poses of a log, raw and with each model."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import to_builtins

from imutool.array_types import Bool, Float64
from imutool.bias import static
from imutool.bias.model import GAP_S, BiasModel
from imutool.bias.model_file import check_rate, find_model
from imutool.bias_start.aided_path import aided_path, residual_prior
from imutool.bias_start.bias_covariance import expected_drift
from imutool.bias_start.correction import DebiasedImu, apply, apply_with_std
from imutool.bias_start.fitness import judge
from imutool.bias_start.initial_bias import InitialBias, model_samples
from imutool.bias_start.model_choice import bound_to, check_smooth, estimate_at_rest, find_initial_bias, smooth_in_memory
from imutool.bias_start.stretches import measured_imu, read_stretches
from imutool.errors import ConfigError, DataError, ImutoolError, ModelError
from imutool.inertial import metrics
from imutool.inertial.aids import Aids, parse_aids
from imutool.inertial.kinematics import trapezoidal
from imutool.inertial.strapdown import (
    StartPose,
    along_truth,
    dead_reckon,
    drift_windows,
    gaps_crossed,
    stretch_with_truth,
    window_drift,
    with_velocity,
)
from imutool.log_info.aid_search import find_aids
from imutool.log_info.convention_report import contradictions, warn_of_recordings
from imutool.mcap_io.log import Log
from imutool.processes.system import release_memory
from imutool.recording import Imu, Poses, Recording, nanoseconds

logger = logging.getLogger(__name__)

RAW = "raw"
DRIFT_S = 5.0
DELAY_WINDOW_S = 1.0  # of the windows that show a delay of the poses
CLEAR_STDS, MOST_DRIFT_LEFT = 4.0, 0.9  # of a clear delay: deviations, and share of the drift that is left without it
DRIFTS = "drift_orientation_deg", "drift_velocity_m_s", "drift_orientation_std_deg", "drift_velocity_std_m_s"
DELAY = "pose_delay_s", "pose_delay_std_s", "aoe_without_delay_deg", "drift_orientation_without_delay_deg"
DEG = 180.0 / np.pi
PURE, AIDED = "integration", "aided"
Refused = Callable[[str, ImutoolError], None]
Mask = Bool[np.ndarray, " n"]
Figures = dict[str, float | None]


def evaluate(
    log: Path,
    *,
    models: Sequence[str | Path] = (),
    init: str = "auto",
    smooth: bool = False,
    aid: str | None = None,
    truth: str | None = None,
    imu: str | None = None,
    trajectories: Path | None = None,
    overwrite: bool = False,
    refused: Refused | None = None,
) -> list[dict[str, Any]]:
    """Results of the raw samples and of each model.

    Without models also those of the debiased samples in the log. A log whose clock jumps has these for each of its stretches,
    which are named NAME_1, NAME_2 and so on. Every trajectory starts at the true pose and velocity at the first sample the
    truth covers, and is integrated by `strapdown.dead_reckon`; only samples outside gaps of the truth are scored. A warning
    counts gaps of the IMU. With `smooth` each bias comes from the whole log. With `aid` a second result each is the smoothed
    path of the same samples with those aids (`aids.parse_aids`).

    Raises:
        ConfigError: `smooth` with another `init`, an unknown aid, two models of one name, files that exist, no sample measured.
        LogError, DataError: no IMU, no truth, or the two share no time; an aid that the log lacks.
        ModelError: a model that cannot be used with this log.
    """
    if trajectories is not None:
        _refuse_twins(models)
    asked = None if aid is None else parse_aids(aid)
    results = list[dict[str, Any]]()
    stretches = read_stretches(log, imu=imu, truth=truth)
    release_memory()
    in_log = [None] * len(stretches) if models else _debiased(log, stretches, truth)
    for stretch, debiased in zip(stretches, in_log, strict=True):
        recording = replace(stretch, imu=measured_imu(stretch.imu, f"{log} {stretch.imu_topic}"))
        aids = None
        if asked is not None:
            with Log(log) as opened:
                aids = find_aids(opened, recording, asked)
        chosen = recording.with_truth(next(iter(recording.truths))) if truth is None and recording.truths else recording
        results += _evaluated(chosen, debiased, log, models, init, smooth, aids, trajectories, overwrite, refused)
    return results


def _debiased(log: Path, stretches: Sequence[Recording], truth: str | None) -> Sequence[Imu | None]:
    """The samples of the same stretches that the log has debiased."""
    from imutool.debiasing import SUFFIX

    topic = f"{stretches[0].imu_topic}{SUFFIX}"
    with Log(log) as opened:
        known = topic in opened.topics
    found = [stretch.imu for stretch in read_stretches(log, imu=topic, truth=truth)] if known else []
    return found if len(found) == len(stretches) else [None] * len(stretches)


def _evaluated(
    recording: Recording,
    debiased: Imu | None,
    log: Path,
    models: Sequence[str | Path],
    init: str,
    smooth: bool,
    aids: Aids | None,
    trajectories: Path | None,
    overwrite: bool,
    refused: Refused | None,
) -> list[dict[str, Any]]:
    """Results of one stretch of a log."""
    (whole,) = warn_of_recordings([recording])
    wrong = contradictions(whole)
    truth = recording.truth
    if (whole.world != np.eye(3)).any() or whole.position_unit != "m" or whole.quaternions:
        logger.warning("%s: until then its positions and velocities are not scored", recording.name)
        truth = replace(truth, p_wb=np.zeros_like(truth.p_wb), v_w=None)
    recording = replace(recording, truths={next(iter(recording.truths)): with_velocity(truth)})
    results, about = list[dict[str, Any]](), recording.metadata.get("imutool", {})
    recorded = [(RAW, recording.imu, None, None)]
    recorded += [] if debiased is None else [(str(about.get("model") or "debiased"), debiased, None, None)]
    found = started(recording, models, init, log, smooth=smooth, refused=refused)
    for name, imu, model, start in [*recorded, *((name, recording.imu, model, start) for name, model, start in found)]:
        rows, true, valid = stretch_with_truth(imu.t_ns, recording.truth, recording.name)
        fit = judge(model, start, [model_samples(model, recording.imu)], about).beside(wrong) if model and start else None
        debiasing, std = _corrected(imu, model, start, with_std=aids is not None)
        corrected = debiasing.imu
        del debiasing  # no array as long as the log stays when it is no longer needed
        release_memory()
        estimates = {PURE: dead_reckon(corrected.rows(rows), StartPose.of(true))}
        if name == RAW and (gaps := gaps_crossed(estimates[PURE], GAP_S, int(recording.imu.t_ns[0]))):
            logger.warning("%s: %s", recording.name, gaps)
        if aids is not None:
            estimates[AIDED] = aided_path(corrected.rows(rows), StartPose.of(true), residual_prior(start, std), aids)
        how = {"init": init if start else None, "init_how": start.how if start else None, "smooth": smooth}
        scores = list[dict[str, Any]]()
        for kind, estimate in estimates.items():
            of = {
                "log": recording.name,
                "model": name,
                "estimate": kind,
                "aids": aids.signals if aids and kind == AIDED else {},
            }
            scores.append(of | how | {"fit": fit and to_builtins(fit)} | metrics.evaluate(estimate, true, valid))
            if trajectories is not None:
                if (name, kind) == (RAW, PURE):
                    metrics.write_trajectory(true.rows(valid), trajectories, recording.name, "truth", overwrite)
                label = name if kind == PURE else f"{name}_{kind}"
                metrics.write_trajectory(estimate.rows(valid), trajectories, recording.name, label, overwrite)
        del estimates, estimate
        corrected = trapezoidal(corrected)  # now means of each sample and the next
        drifted, delay = _drifts(corrected, (rows, true, valid), recording, model, start)
        del true, valid
        drifted |= _without_delay(delay, corrected, recording, drifted[DRIFTS[0]])
        bias = np.zeros(6) if start is None else start.rest
        results += [score | drifted | {"gyro_bias": bias[:3].tolist(), "accel_bias": bias[3:].tolist()} for score in scores]
        del corrected
    return results


def _drifts(
    means: Imu,
    truth: tuple[slice, Poses, Mask],
    recording: Recording,
    model: BiasModel | None,
    start: InitialBias | None,
) -> tuple[Figures, tuple[float, float] | None]:
    """Drift of windows that start from the truth, what the bias covariance expects, and a delay of the poses.

    `means` are those of each sample and the next (`kinematics.trapezoidal`).
    """
    rows, true, valid = truth
    path = dead_reckon(means.rows(rows), StartPose.of(true))
    drifted = _drift(path, true, valid, model, start, recording.imu)
    return drifted, metrics.pose_delay(path, true, drift_windows(path, valid, DELAY_WINDOW_S)) if model else None


def _drift(path: Poses, true: Poses, valid: Mask, model: BiasModel | None, start: InitialBias | None, imu: Imu) -> Figures:
    """Root mean squares of the drift of windows that start from the truth, and of what the bias covariance expects.

    None if no window fits.
    """
    windows = drift_windows(path, valid, DRIFT_S)
    found = window_drift(path, true, *windows.T)
    squares = {"drift_orientation_deg": found.orientation_rad**2, "drift_velocity_m_s": found.velocity_m_s**2}
    if model is not None and start is not None:
        variances = expected_drift(model, start, imu, path, windows).diagonal(axis1=1, axis2=2)
        squares["drift_orientation_std_deg"] = variances[:, :3].sum(axis=1)
        squares["drift_velocity_std_m_s"] = variances[:, 3:].sum(axis=1)
    out: Figures = {"drift_window_s": DRIFT_S}
    for name in DRIFTS:
        is_angle = name.endswith("deg")
        known = name in squares and len(windows) > 0 and (is_angle or true.has_positions)
        out[name] = float(np.sqrt(squares[name].mean())) * (DEG if is_angle else 1.0) if known else None
    return out


def _without_delay(found: tuple[float, float] | None, imu: Imu, recording: Recording, drift_deg: float | None) -> Figures:
    """Delay of the poses against the debiased gyro, and the scores without it; None where it is not clear."""
    nothing = Figures.fromkeys(DELAY)
    if found is None or drift_deg is None or abs(found[0]) < CLEAR_STDS * found[1]:
        return nothing
    moved = replace(recording.truth, t_ns=recording.truth.t_ns - nanoseconds(found[0]))
    try:
        path, true, valid = along_truth(imu, moved, recording.name)
    except DataError:
        return nothing
    left_deg = _drift(path, true, valid, None, None, imu)[DRIFTS[0]]
    if left_deg is None or not left_deg < MOST_DRIFT_LEFT * drift_deg:
        return nothing
    return dict(zip(DELAY, (*found, metrics.absolute(path, true, valid)["aoe_deg"], left_deg), strict=True))


def _corrected(
    imu: Imu, model: BiasModel | None, start: InitialBias | None, *, with_std: bool = False
) -> tuple[DebiasedImu, Float64[np.ndarray, "n 6"] | None]:
    """Samples corrected by a model, on request with the deviation of its bias; without one as they are."""
    if model is None or start is None:
        return DebiasedImu(imu, np.zeros((len(imu), 6))), None
    return apply_with_std(model, start, imu) if with_std else (apply(model, start, imu), None)


def runs(
    recording: Recording, models: Sequence[str | Path], init: str, where: str | Path
) -> Iterator[tuple[str, DebiasedImu, InitialBias | None]]:
    """Samples as recorded, then corrected by each model: name, samples and bias, initial bias."""
    yield RAW, _corrected(recording.imu, None, None)[0], None
    for name, model, start in started(recording, models, init, where):
        yield name, apply(model, start, recording.imu), start


def started(
    recording: Recording,
    models: Sequence[str | Path],
    init: str,
    where: str | Path,
    *,
    smooth: bool = False,
    refused: Refused | None = None,
) -> Iterator[tuple[str, BiasModel, InitialBias]]:
    """Model name, model and initial bias in this recording, for each requested model.

    With `refused` a model that does not apply to the recording is left out, and `refused` is called with it and the error.
    """
    check_smooth(init, smooth)
    for given, loaded in [(given, _load(given, recording)) for given in models]:  # a model that is none ends it at once
        try:
            model, start = _model_and_start(loaded, recording, init, where, smooth)
        except (DataError, ModelError) as error:
            if refused is None:
                raise
            refused(str(given), error)
            continue
        yield str(model.card.get("name", model.method)), model, start


def _load(given: str | Path, recording: Recording) -> BiasModel | None:
    """Model of a file or that ships; None for `static`, which is not trained."""
    return None if str(given) == static.Model.method else find_model(given, 1.0 / recording.imu.period_s)


def _model_and_start(
    trained: BiasModel | None, recording: Recording, init: str, where: str | Path, smooth: bool
) -> tuple[BiasModel, InitialBias]:
    if trained is None and init == "auto" and not smooth:
        return estimate_at_rest(recording.imu, where)
    model: BiasModel = static.Model() if trained is None else bound_to(trained, recording)
    if trained is not None:
        check_rate(model, 1.0 / recording.imu.period_s, where, recording.imu.t_ns)
    for remark in model.remarks:
        logger.warning("%s: %s", recording.name, remark)
    if smooth:
        return model, smooth_in_memory(model, recording.imu, where)
    return model, find_initial_bias(init, model, recording)


def _refuse_twins(models: Sequence[str | Path]) -> None:
    """Two models of one name would write one file."""
    names = [Path(model).stem for model in models]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"two models are called {name!r}", where="trajectories", fix="Rename one of the files")
