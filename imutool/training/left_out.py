"""Candidate models on left-out logs: each log corrected by models that the other logs gave.

Candidates, from the simplest: `constant` (the prior of the rest bias alone), `linear` (scale and misalignment), and `effects`
(those that the other logs support). Each log is integrated from its first true pose with every start that users have; raw
samples and `static`, the log's own rest bias without any training, are scored alike. The poses are first turned and shifted by
the rotation and the clock that are fitted between them and the sensor for this log alone. Where they turn and the gyro does
not, as over clipped samples, the path turns with them. The simplest candidate that is not
beaten is kept, for the gyro by the orientation error (AOE) and by the attitude after 5 s from the truth, for the accelerometer
by the velocity after 5 s. One or two logs are cut in parts, which are often no longer than a start from the truth. Their scores
decide nothing: the candidate is kept that predicts the windows of each part best.
A network is the least simple candidate (`network_scores`).
Effects are linear in their parameters, so a left-out model is one Gauss-Newton step from the fit of all logs; the weights of
outliers and the attitude under the accelerometer stay those of all logs (`tests/bench/left_out.py` fits anew).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch

from imutool.array_types import Float64
from imutool.bias.model import BiasModel
from imutool.bias.networks.network import BiasNetwork
from imutool.bias.temperature import Scale
from imutool.bias_start.bias_from_truth import poses_turn_alone
from imutool.bias_start.model_choice import bound_to
from imutool.processes.forked import of_each
from imutool.recording import Recording, nanoseconds
from imutool.training.calibration.effect_selection import Calibration, parameter_columns
from imutool.training.calibration.log_scatter import MIN_GAIN, SURELY
from imutool.training.candidates import CANDIDATES, best_predicted, known, left_out_effects, left_out_model, with_statistics
from imutool.training.log_agreement import Contradiction, check_axes, contradicting
from imutool.training.log_scores import STARTS, Score, score_of, scores_of
from imutool.training.log_signals import without_nuisances
from imutool.training.settings import LINEAR, TrainSettings
from imutool.training.training_windows import Pool
from imutool.units import Sensor

logger = logging.getLogger(__name__)

CHANCE = 0.3  # least deviation of a sum of gains over logs, in logarithms of errors, that candidates without a true effect have
MIN_ERROR = 1e-6  # ° or m/s
LONGEST_S = 120.0  # of a log that is scored


class Criterion(NamedTuple):
    """Field of the scores that are compared, and a start; without one their mean counts."""

    field: str
    start: str = ""


CRITERIA: Mapping[Sensor, tuple[Criterion, ...]] = {
    "gyro": (Criterion("aoe_deg"), *(Criterion("aoe_deg", start) for start in STARTS), Criterion("drift_deg", "truth")),
    "accel": (Criterion("drift_m_s"), *(Criterion("drift_m_s", start) for start in STARTS)),
}
# Those by which a candidate replaces a simpler one. Errors of opposite signs cancel in the AOE of a log, in short windows less.
DECISIVE = {
    sensor: tuple(criterion for criterion in criteria if not criterion.start or criterion.field == "drift_deg")
    for sensor, criteria in CRITERIA.items()
}

WITHOUT_TRAINING = {
    "raw": (
        "the raw samples",
        "imutool info LOG says what may be wrong with the poses, or the motion does not show the sensor",
    ),
    "static": (
        "samples without their bias at rest",
        "imutool evaluate LOG --model MODEL --model static compares both on a log",
    ),
}


@dataclass(frozen=True)
class Comparison:
    """Scores of left-out logs or `parts`, candidates kept, and logs that contradict the others."""

    scores: tuple[Score, ...]
    kept: Mapping[Sensor, str]
    parts: bool
    contradicting: tuple[Contradiction, ...] = ()

    @property
    def constant(self) -> set[Sensor]:
        """Sensors for which a constant bias is enough."""
        return {sensor for sensor, kept in self.kept.items() if kept == CANDIDATES[0]}

    def with_scores(self, scores: Sequence[Score]) -> Comparison:
        """Comparison with the scores of one more candidate, the least simple."""
        known = (*self.scores, *scores)
        return replace(self, scores=known, kept={sensor: keep(known, sensor) for sensor in self.kept})

    def card(self) -> dict[str, Any]:
        """Entry of a model card."""
        scores, contradicting = ([vars(entry) for entry in entries] for entries in (self.scores, self.contradicting))
        return {"kept": dict(self.kept), "parts": self.parts, "scores": scores, "contradicting": contradicting}


def compare(
    recordings: Sequence[Recording],
    pool: Pool,
    fits: Mapping[Sensor, Calibration],
    trained: BiasNetwork,
    settings: TrainSettings,
    scale: Scale | None = None,
) -> Comparison:
    """Scores of every left-out log.

    `trained` has the statistics of all logs without the effects of the fits, `scale` is that of their temperature.

    Raises:
        DataError: a log whose axes are turned against the others'.
    """
    check_axes(pool, fits)
    candidates = [c for c in CANDIDATES if all(known(fit, c, sensor) for sensor, fit in fits.items())]
    if all(fit.named and set(fit.effects) == set(LINEAR[sensor]) for sensor, fit in fits.items()):
        candidates.remove("effects")  # the same as `linear`
    statistics = {c: with_statistics(fits, pool, trained, c, settings) for c in candidates}

    def of_log(numbered: tuple[int, Recording]) -> list[Score]:
        index, recording = numbered
        effects = {c: {sensor: left_out_effects(fit, c, sensor, index) for sensor, fit in fits.items()} for c in candidates}
        left_out = {c: left_out_model(fits, pool, statistics[c], effects[c], index, scale) for c in candidates}
        models = {c: bound_to(model, recording) for c, model in left_out.items()}
        log = _without_nuisances(recording, fits["gyro"], (), index)
        alone = poses_turn_alone(log.imu, log.truth)
        scores = [score_of(log, "raw", "", log.imu, alone), *scores_of(log, "static", None, alone)]
        for name, model in models.items():
            log = _without_nuisances(recording, fits["gyro"], effects[name]["gyro"], index)
            scores += scores_of(log, name, model, alone)
        return scores

    logs = list(enumerate(_logs(recordings, pool, fits["gyro"])))
    scores = [score for some in of_each(of_log, logs, long=True) for score in some]
    contradictions = contradicting(pool, fits)
    for contradiction in contradictions:
        logger.warning("%s", contradiction)
    parts = len(logs) > len(recordings)
    kept = {sensor: best_predicted(fit, sensor, candidates) if parts else keep(scores, sensor) for sensor, fit in fits.items()}
    for warning in better_without(scores, kept["gyro"]):
        logger.warning("%s", warning)
    return Comparison(tuple(scores), kept, parts, contradictions)


def network_scores(
    name: str,
    trained_on: Callable[[Sequence[int]], BiasModel],
    recordings: Sequence[Recording],
    pool: Pool,
    fits: Mapping[Sensor, Calibration],
) -> list[Score]:
    """Scores of a network on every log, trained on every other log without it.

    A network needs as long for each log left out as for all of them, so there are two trainings in place of many.
    """
    scores = []
    logs = list(_logs(recordings, pool, fits["gyro"]))
    for first in (0, 1):
        model = trained_on(range(1 - first, len(logs), 2))
        for index in range(first, len(logs), 2):
            alone = poses_turn_alone(logs[index].imu, logs[index].truth)
            log = _without_nuisances(logs[index], fits["gyro"], LINEAR["gyro"], index)
            scores += scores_of(log, name, bound_to(model, log), alone)
    return scores


def better_without(scores: Sequence[Score], kept: str) -> Iterator[str]:
    """Warnings of raw samples, or a bias at rest, that are better than the candidate kept."""
    logs, aoe = list(dict.fromkeys(score.log for score in scores)), DECISIVE["gyro"][0]
    errors = {model: _log_errors(scores, logs, model, aoe) for model in (kept, *WITHOUT_TRAINING)}
    for model, (name, fix) in WITHOUT_TRAINING.items():
        if beaten(errors[kept], errors[model]):
            less = 1.0 - np.exp(-np.nanmean(errors[kept] - errors[model]))
            yield f"on the left-out logs {name} have {100.0 * less:.0f} % less error of orientation than the model: {fix}"


def keep(scores: Sequence[Score], sensor: Sensor) -> str:
    """Simplest unbeaten candidate, of those that no simpler one beats from any start.

    For the gyro `static` counts as the simplest. Where it beats all candidates, the first is kept.
    """
    logs = list(dict.fromkeys(score.log for score in scores))
    present = [name for name in dict.fromkeys(score.model for score in scores) if name not in WITHOUT_TRAINING]
    table = {
        (model, criterion): _log_errors(scores, logs, model, criterion)
        for model in ("static", *present)
        for criterion in CRITERIA[sensor]
    }
    sound = []
    for place, candidate in enumerate(present):
        simpler = [*(["static"] if sensor == "gyro" else []), *present[:place]]
        if not any(
            beaten(table[candidate, criterion], table[other, criterion]) for other in simpler for criterion in CRITERIA[sensor]
        ):
            sound.append(candidate)
    return next(
        (
            candidate
            for place, candidate in enumerate(sound)
            if not any(
                beaten(table[candidate, criterion], table[other, criterion], SURELY)
                for other in sound[place + 1 :]
                for criterion in DECISIVE[sensor]
            )
        ),
        present[0],
    )


def _log_errors(
    scores: Sequence[Score], logs: Sequence[str], model: str, criterion: Criterion
) -> Float64[np.ndarray, "logs starts"]:
    """Logarithm of an error of each log with each start, those of raw samples with all; NaN where there is none."""
    out = np.full((len(logs), len(STARTS)), np.nan)
    for score in scores:
        value = getattr(score, criterion.field)
        if score.model == model and criterion.start in ("", score.start) and value is not None:
            starts = slice(None) if not score.start else STARTS.index(score.start)
            out[logs.index(score.log), starts] = np.log(max(value, MIN_ERROR))
    return out


def beaten(errors: Float64[np.ndarray, "logs ..."], others: Float64[np.ndarray, "logs ..."], surely: float = 1.0) -> bool:
    """Whether errors are smaller by `MIN_GAIN` and by `surely` standard errors over the logs.

    The gain of a log is the mean over the starts that both have: errors without truth are larger than those from the truth. A
    true gain scatters from log to log, too, if only some motions show it. So a gain also counts that is beyond chance without
    the log that gains most. Chance loses as often as it gains, so the losses show its variance.
    """
    gains = np.reshape(errors - others, (len(errors), -1))
    gain = np.sort(np.nanmean(gains[np.isfinite(gains).any(axis=1)], axis=1))
    if not len(gain):
        return False
    scatter = gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 1 else 0.0
    if gain.mean() > max(MIN_GAIN, surely * scatter):
        return True
    rest = gain[:-1]
    chance = np.sqrt(2.0 * np.square(np.minimum(rest, 0.0)).sum() + CHANCE**2)
    return len(rest) > 0 and bool(rest.mean() > max(MIN_GAIN, surely * chance / len(rest)))


def _without_nuisances(log: Recording, fit: Calibration, names: Sequence[str], index: int) -> Recording:
    """Recording whose poses are turned and shifted onto the sensor, as far as a log left out shows that to some effects."""
    columns = parameter_columns(fit.forms, names)
    return without_nuisances(log, fit.problem.own_at(fit.problem.solve_by_scatter(columns, index).theta)[index].cpu().numpy())


def _logs(recordings: Sequence[Recording], pool: Pool, fit: Calibration) -> Iterator[Recording]:
    """Recordings, or their parts where the logs of the fit are parts, of `LONGEST_S` at most."""
    parts = len(fit.problem.own) // len(pool.names)
    for log, recording in enumerate(recordings):
        begin_ns = pool.spans_ns[log][0]
        t = pool.t[(pool.log == log) & ~pool.held_out] if parts > 1 else pool.t[pool.log == log]
        bounds = torch.linspace(0, len(t) - 1, parts + 1).long()
        for part, (first, last) in enumerate(zip(t[bounds[:-1]].tolist(), t[bounds[1:]].tolist(), strict=True), start=1):
            end_ns = begin_ns + nanoseconds(min(last, first + LONGEST_S))
            start_ns = begin_ns + nanoseconds(first) if part > 1 else int(recording.imu.t_ns[0])
            name = recording.name if parts == 1 else f"{recording.name} {part}/{parts}"
            yield replace(recording, name=name, imu=recording.imu.between(start_ns, end_ns))
