"""Evaluate pure integration by the true poses of a log, raw and with each model."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import to_builtins

from imutool.array_types import Float64
from imutool.bias import static
from imutool.bias.model import GAP_S, BiasModel
from imutool.bias.model_file import find_model
from imutool.bias_start import DEBIASED_BY, SUFFIX
from imutool.bias_start.aided_path import aided_path, residual_prior
from imutool.bias_start.bias_covariance import ExpectedDrift
from imutool.bias_start.correction import DebiasedImu, apply, apply_with_std, corrected
from imutool.bias_start.initial_bias import InitialBias
from imutool.bias_start.model_choice import (
    bound_to,
    check_start,
    estimate_at_rest,
    find_initial_bias,
    fitness_in_memory,
    smooth_in_memory,
)
from imutool.bias_start.stretches import measured_imu, read_stretches
from imutool.errors import ConfigError, DataError, ImutoolError, ModelError
from imutool.exporting.tum import write_trajectory
from imutool.inertial import metrics
from imutool.inertial.aids import Aids, parse_aids
from imutool.inertial.metrics import Figures
from imutool.inertial.scoring.path_blocks import PathBlocks, TrueSpan, in_memory, integrated, pieces
from imutool.inertial.scoring.pose_delay import pose_delay
from imutool.inertial.strapdown import StartPose, drift_windows, gaps_crossed, window_drift, with_velocity
from imutool.log_info.aid_search import find_aids
from imutool.log_info.convention_report import contradictions, warn_of_recordings
from imutool.mcap_io.log import Log
from imutool.processes.system import release_memory
from imutool.recording import Imu, Poses, Recording, nanoseconds

logger = logging.getLogger(__name__)

RAW, TRUTH = "raw", "truth"  # also of files of trajectories
DRIFT_S = 5.0
DELAY_WINDOW_S = 1.0  # of the windows that show a delay of the poses
CLEAR_STDS, MAX_DRIFT_LEFT = 4.0, 0.9  # of a clear delay: deviations, and share of the drift that is left without it
DRIFTS = "drift_orientation_deg", "drift_velocity_m_s", "drift_orientation_std_deg", "drift_velocity_std_m_s"
DELAY = "pose_delay_s", "pose_delay_std_s", "aoe_without_delay_deg", "drift_orientation_without_delay_deg"
PURE, AIDED = "integration", "aided"
Refused = Callable[[str, ImutoolError], None]
Correction = tuple[str, BiasModel, InitialBias]  # a model's name, the model, its start in a recording


def evaluate(
    log: Path,
    *,
    models: Sequence[str | Path | BiasModel] = (),
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
    asked, results = None if aid is None else parse_aids(aid), list[dict[str, Any]]()
    stretches = read_stretches(log, imu=imu, truth=truth)
    release_memory()
    in_log = [None] * len(stretches) if models else _debiased(log, stretches, truth)
    for stretch, debiased in zip(stretches, in_log, strict=True):
        recording = measured_once(stretch, log)
        aids = None
        if asked is not None:
            with Log(log) as opened:
                aids = find_aids(opened, recording, asked)
        chosen = recording.with_truth(next(iter(recording.truths))) if truth is None and recording.truths else recording
        scored, wrong = _scored(chosen)
        corrections = started(scored, models, init, log, smooth=smooth, refused=refused, force=True)
        how = {"init": init, "smooth": smooth}
        save = None if trajectories is None else partial(write_trajectory, trajectories, scored.name, overwrite)
        results += _evaluated(scored, debiased, corrections, wrong, how, aids, save)
    return results


def measured_once(recording: Recording, log: Path) -> Recording:
    """Recording of the measured samples; warns of others, and of debiased ones."""
    if by := debiased_by(recording.metadata.get("imutool", {}), recording.imu_topic):
        logger.warning("%s: `%s` is debiased already, by %s: a model corrects it once more", recording.name, RAW, by)
    return replace(recording, imu=measured_imu(recording.imu, f"{log} {recording.imu_topic}"))


def debiased_by(about: Mapping[str, str], topic: str) -> str:
    """Name of the model that has debiased an IMU, by its log's record `imutool`, or empty."""
    return about.get(DEBIASED_BY) or (about.get("model", "") if topic == f"{about.get('source_topic')}{SUFFIX}" else "")


def _debiased(log: Path, stretches: Sequence[Recording], truth: str | None) -> Sequence[Imu | None]:
    """The samples of the same stretches that the log has debiased."""
    topic = f"{stretches[0].imu_topic}{SUFFIX}"
    with Log(log) as opened:
        known = topic in opened.topics
    found = [stretch.imu for stretch in read_stretches(log, imu=topic, truth=truth)] if known else []
    return found if len(found) == len(stretches) else [None] * len(stretches)


def _scored(recording: Recording) -> tuple[Recording, Sequence[str]]:
    """Recording with the true poses that can be scored, and their velocity; what contradicts its units, axes and frames."""
    (whole,) = warn_of_recordings([recording])
    truth = recording.truth
    if (whole.world != np.eye(3)).any() or whole.position_unit != "m" or whole.quaternions:
        logger.warning("%s: until then its positions and velocities are not scored", recording.name)
        truth = replace(truth, p_wb=np.zeros_like(truth.p_wb), v_w=None)
    return replace(recording, truths={next(iter(recording.truths)): with_velocity(truth)}), contradictions(whole)


def _evaluated(
    recording: Recording,
    debiased: Imu | None,
    corrections: Iterable[Correction],
    wrong: Sequence[str],
    how: Mapping[str, object],
    aids: Aids | None,
    save: Callable[[str, Iterable[Poses]], None] | None,
) -> list[dict[str, Any]]:
    """Results of one stretch of a log; `wrong` are its contradictions, `how` the start that was asked for."""
    results, about = list[dict[str, Any]](), recording.metadata.get("imutool", {})
    recorded = [(RAW, recording.imu, None, None)]
    recorded += [] if debiased is None else [(str(about.get("model") or "debiased"), debiased, None, None)]
    span: TrueSpan | None = None
    for name, imu, model, start in [*recorded, *((name, recording.imu, model, start) for name, model, start in corrections)]:
        if span is None or imu is not recording.imu:
            span = TrueSpan(imu.t_ns, recording.truth, recording.name)
        fit = fitness_in_memory(model, start, recording, wrong) if model and start else None
        release_memory()
        whole_log, std = _corrected(imu, model, start, with_std=aids is not None)
        samples = whole_log.rows(span.span)
        estimates: dict[str, PathBlocks] = {PURE: partial(integrated, samples, span)}
        if name == RAW and (gaps := gaps_crossed(span.t_ns, GAP_S, int(recording.imu.t_ns[0]))):
            logger.warning("%s: %s", recording.name, gaps)
        if aids is not None:
            begin = StartPose.of(span.rows(slice(0, 1)))
            estimates[AIDED] = partial(in_memory, aided_path(samples, begin, residual_prior(start, std), aids), span)
        begun = {"init": how["init"] if start else None, "init_how": start.how if start else None, "smooth": how["smooth"]}
        scores = list[dict[str, Any]]()
        for kind, estimate in estimates.items():
            used = aids.signals if aids and kind == AIDED else {}
            of = {"log": recording.name, "model": name, "estimate": kind, "aids": used}
            scores.append(of | begun | {"fit": fit and to_builtins(fit)} | metrics.evaluate_blocks(estimate))
            if save is not None:
                label = name if kind == PURE else f"{name}_{kind}"
                for side, named in enumerate((label, TRUTH) if (name, kind) == (RAW, PURE) else (label,)):
                    save(named, (block.scored()[side] for block in estimate()))
        del estimates, estimate
        drifted = _drift(samples, span, model, start, recording.imu, has_positions=scores[0]["ape_m"] is not None)
        drifted |= _without_delay(whole_log, span, recording, drifted[DRIFTS[0]]) if model else Figures.fromkeys(DELAY)
        bias = np.zeros(6) if start is None else start.rest
        results += [score | drifted | {"gyro_bias": bias[:3].tolist(), "accel_bias": bias[3:].tolist()} for score in scores]
        del whole_log, samples  # the next ones need the memory
    return results


def _drift(
    samples: Imu, span: TrueSpan, model: BiasModel | None, start: InitialBias | None, imu: Imu, *, has_positions: bool = True
) -> Figures:
    """Root mean squares of the drift of windows that start from the truth, and of what the bias covariance expects.

    `samples` are those of `imu` in the span, corrected. None if no window fits.
    """
    expected = None if model is None or start is None else ExpectedDrift(model, start, imu)
    squares = list[Float64[np.ndarray, "_ m"]]()
    for path, true, windows in pieces(samples, span, drift_windows(span.t_ns, span.valid, DRIFT_S)):
        found = window_drift(path, true, *windows.T)
        columns = [found.orientation_rad**2, found.velocity_m_s**2]
        if expected is not None:
            variances = expected(path, windows).diagonal(axis1=1, axis2=2)
            columns += [variances[:, :3].sum(axis=1), variances[:, 3:].sum(axis=1)]
        squares.append(np.array(columns))
    out: Figures = {"drift_window_s": DRIFT_S, **dict.fromkeys(DRIFTS)}
    if squares:
        for name, column in zip(DRIFTS, np.concatenate(squares, axis=1), strict=False):  # without a model two
            is_angle = name.endswith("deg")
            if is_angle or has_positions:
                rms = np.sqrt(column.mean())
                out[name] = float(np.rad2deg(rms) if is_angle else rms)
    return out


def _without_delay(imu: Imu, span: TrueSpan, recording: Recording, drift_deg: float | None) -> Figures:
    """Delay of the poses against the debiased gyro, and the scores without it; None where it is not clear."""
    nothing, windows = Figures.fromkeys(DELAY), drift_windows(span.t_ns, span.valid, DELAY_WINDOW_S)
    found = pose_delay(pieces(imu.rows(span.span), span, windows, margin=1))
    if found is None or drift_deg is None or abs(found[0]) < CLEAR_STDS * found[1]:
        return nothing
    moved = replace(recording.truth, t_ns=recording.truth.t_ns - nanoseconds(found[0]))
    try:
        moved_span = TrueSpan(imu.t_ns, moved, recording.name)
    except DataError:
        return nothing
    samples = imu.rows(moved_span.span)
    left_deg = _drift(samples, moved_span, None, None, samples)[DRIFTS[0]]
    if left_deg is None or not left_deg < MAX_DRIFT_LEFT * drift_deg:
        return nothing
    aoe_deg = metrics.absolute_blocks(partial(integrated, samples, moved_span, means=True))["aoe_deg"]
    return dict(zip(DELAY, (*found, aoe_deg, left_deg), strict=True))


def _corrected(
    imu: Imu, model: BiasModel | None, start: InitialBias | None, *, with_std: bool
) -> tuple[Imu, Float64[np.ndarray, "n 6"] | None]:
    """Samples corrected by a model, on request with the deviation of its bias; without one as they are."""
    if model is None or start is None:
        return imu, None
    if not with_std:
        return corrected(model, start, imu), None
    debiased, std = apply_with_std(model, start, imu)
    return debiased.imu, std


def runs(
    recording: Recording, models: Sequence[str | Path | BiasModel], init: str, where: str | Path
) -> Iterator[tuple[str, DebiasedImu, InitialBias | None]]:
    """Samples as recorded, then corrected by each model: name, samples and bias, initial bias."""
    yield RAW, DebiasedImu(recording.imu, np.zeros((len(recording.imu), 6))), None
    for name, model, start in started(recording, models, init, where, force=True):
        yield name, apply(model, start, recording.imu), start


def started(
    recording: Recording,
    models: Sequence[str | Path | BiasModel],
    init: str,
    where: str | Path,
    *,
    smooth: bool = False,
    refused: Refused | None = None,
    force: bool = False,
) -> Iterator[Correction]:
    """Model name, model and initial bias in this recording, for each requested model.

    With `force` models of other rates count, too. `refused` is called with each that does not apply, and with the error.
    """
    check_start(init, smooth)
    for given, loaded in [(given, _load(given, recording)) for given in models]:  # a model that is none ends it at once
        try:
            model, start = _model_and_start(loaded, recording, init, where, smooth, force)
        except (DataError, ModelError) as error:
            if refused is None:
                raise
            refused(str(given), error)
            continue
        yield str(model.card.get("name", model.method)), model, start


def _load(given: str | Path | BiasModel, recording: Recording) -> BiasModel | None:
    """Model itself, of a file, or that ships; None for `static`, which is not trained."""
    if str(getattr(given, "method", given)) == static.Model.method:
        return None
    return given if isinstance(given, BiasModel) else find_model(given, 1.0 / recording.imu.period_s)


def _model_and_start(
    trained: BiasModel | None, recording: Recording, init: str, where: str | Path, smooth: bool, force: bool
) -> tuple[BiasModel, InitialBias]:
    if trained is None and init == "auto" and not smooth:
        return estimate_at_rest(recording.imu, where)
    model: BiasModel = static.Model() if trained is None else bound_to(trained, recording, where, force=force)
    for remark in model.remarks:
        logger.warning("%s: %s", recording.name, remark)
    return model, smooth_in_memory(model, recording.imu, where) if smooth else find_initial_bias(init, model, recording)


def _refuse_twins(models: Sequence[str | Path | BiasModel]) -> None:
    """Two trajectories of one name would be one file; those of the samples and of the truth have names, too."""
    own = (model.card.get("name", model.method) if isinstance(model, BiasModel) else Path(model).stem for model in models)
    names = [RAW, TRUTH, *own]
    if twins := [name for name in names if names.count(name) > 1]:
        raise ConfigError(f"two trajectories are called {twins[0]!r}", where="trajectories", fix="Rename a model's file")
