"""Fitness of a bias model for a log, from its samples: `fits`, `doubtful` or `unfit`.

The inertial filter predicts the samples of each half second: at rest no velocity and no rate, in motion a bounded velocity,
which ties the gyro to gravity. Under a model that fits, the innovations e of the bounded velocity are small, e^T S^-1 e ~
chi-square with three degrees of freedom (Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and
Navigation, 2001, sec. 5.4), and the bias that the log shows lies within the prior of the training logs. The innovations of the
raw samples ask for the whole of the model's correction in motion (`imutool.inertial.innovations`), whatever bias a new
switching-on gave; a log that asks for less than half is another unit's. A lever arm is no such correction. A bias that the log
does not show is believed where what it shows tells the unit.
Where one of the three fails, the likelihood of the innovations is compared with that of the raw samples and an unknown constant
bias: the model is unfit if even from its start in this log it explains the samples worse than no model, if the log asks for the
opposite of its correction, or if its bias and its correction are both another unit's.

The thresholds come from `tests/bench/fit.py`, and from made-up sensors as those of `tests/bench/units.py`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from imutool.bias import static
from imutool.bias.hybrid import without_lever_arm
from imutool.bias.log_binding import max_left, other_conditions, other_unit, turned_axes
from imutool.bias.model import BiasModel, Vector6
from imutool.bias.model_file import library, shipped_for
from imutool.bias_start import Fitness
from imutool.bias_start.bias_at_rest import (
    MAX_SURPRISING,
    UNKNOWN_STD,
    UNTRAINED,
    changed_at_rest,
    refuted_stops,
    shown_at_rest,
    stops_in,
)
from imutool.bias_start.bias_tracking import BiasFilter, FilteredBlock, Samples, filter_together, stops_of, without_motion
from imutool.bias_start.initial_bias import AT_REST_STD, MIN_STD, InitialBias, bias_prior
from imutool.bias_start.prior_width import (
    DEPENDENT,
    MAX_CHANGE,
    MAX_DEVIATIONS,
    MAX_UNKNOWN,
    TELLING,
    BiasPrior,
    ShownBias,
    contradicted_start,
    other_bias,
    supported_std,
    untold_unit,
)
from imutool.bias_start.stretches import unusual_gravity
from imutool.inertial.innovations import SURPRISING, Share, innovations, share_of_correction

CHECKED_S = 120.0  # of a log that the check reads
MIN_SPEED_M_S, MIN_PIVOT_M = 1.0, 1e-3  # of the filter: an arm and a tight bound would take up what a wrong scale leaves
MAX_OF_GUESS = np.array([3.0] * 3 + [MAX_DEVIATIONS] * 3)  # the same where few sessions leave the prior's width to a guess
MIN_EVIDENCE = -40.0  # log-likelihood of the model against none
ROOM_M = 8.0  # deviation of a position every half second, as if each were independent; as three metres for some seconds
MAX_IN_ROOM = 0.45  # mean chi-square of three: 0.4 or less in rooms and halls, from 4 on in vehicles; walkers lie between
MAX_STD, OF_FILTER = 0.5, 0.5  # of the filter's deviation: its maximum for a share, and its part beside Newey and West's
SURE_GYRO = {"gyro_density": 2e-4, "gyro_scale": 1e-4}  # its errors are in question: the filter must not take them for noise
HALF, MAX_SHARE = 0.5, 1.5  # of a correction: between them it does more good than harm
MIN_SHARE = -2.0  # below, the log lacks so much else that the correction makes it worse by less than half
MIN_SHOWN = 0.005  # deviation of a share that a percentage shows
STEADY_TURN, ONLY_GYRO = "what looks like a stop is a steady turn, by gravity in motion", np.array([0.0] * 3 + [np.inf] * 3)
SURE, OWN = 3.0, 4.0  # standard deviations; of made-up sensors' own shares, the largest lies 3.8 from one


@dataclass(frozen=True)
class _Evidence:
    """Evidence of some samples about a prior: log-likelihood, surprising innovations, bias shown."""

    log_likelihood: float
    surprising: float  # share of the innovations
    difference: Vector6  # of the bias shown from the prior's mean
    variance: Vector6  # of it, without the prior
    stops: tuple[tuple[float, float], ...] = ()  # begin and end (s)
    odds: float = 0.0  # logarithm, of the prior's unit to others


def judge(model: BiasModel, start: InitialBias, batches: Iterable[Samples], about: Mapping[str, str]) -> Fitness:
    """Fitness of a model for up to `CHECKED_S` of a log; `about` is its sensor and dataset."""
    samples = head(batches)
    if len(samples[0]) and (wrong := unusual_gravity(samples[2], start.rest[3:])):
        return Fitness("unfit", (wrong,))
    if model.method == static.Model.method:
        return _untrained(start, samples)
    if len(samples[0]) < 2:
        return Fitness("doubtful", ("the log is too short to be judged",))
    prior = replace(bias_prior(model), stops=start.follows is None or start.follows.stops)
    prior = prior if model.prior_std.any() else replace(prior, std=UNKNOWN_STD)  # that of an unknown sensor
    found = _trained(model, start, samples, about, prior)
    if found.verdict == "fits" or not refuted_stops(samples, model):
        return found
    found = _trained(model, start, samples, about, replace(prior, stops=False)) if prior.stops else found
    return Fitness(found.verdict, (*found.reasons, STEADY_TURN))


def _trained(model: BiasModel, start: InitialBias, samples: Samples, about: Mapping[str, str], prior: BiasPrior) -> Fitness:
    """Fitness of a trained model."""
    unknown = replace(prior, mean=np.where(np.abs(prior.mean) > UNKNOWN_STD, prior.mean, 0.0), std=UNKNOWN_STD, minimum=None)
    corrected, of_sensor = (without_motion(each, samples, prior.mean) for each in (model, without_lever_arm(model)))
    at_poses = (*samples[:2], samples[2] + corrected[2] - of_sensor[2])  # a lever arm is no error of the sensor
    found, none = _evidence((corrected, at_poses), (prior, unknown))
    shown_std = np.sqrt(DEPENDENT**2 * found.variance + AT_REST_STD**2)
    other_start, harmful = contradicted_start(start.rest, start.std, prior.mean + found.difference, shown_std)
    supported = supported_std(prior.std, prior.minimum, found.difference, DEPENDENT**2 * found.variance)
    prior = replace(prior, std=np.minimum(supported, prior.std))  # a contradiction widens nothing here
    maximum = np.full(6, MAX_DEVIATIONS) if prior.minimum is None else MAX_OF_GUESS
    share = _share((at_poses, corrected), unknown)
    confirmed = HALF < share.value - SURE * share.std < MAX_SHARE
    max_share = max_left(len(model.card.get("sessions", ())))
    other_axes = turned_axes(found.difference, _shown_std(found, prior), prior.mean, max_share, confirmed=confirmed)
    new_bias, refuted = list(other_bias(found.difference, _deviations(found, prior), maximum)), list(_refuted(share))
    contradictions = [*other_axes, *new_bias, *_disagreement(found, none), *refuted]
    if harmful or contradictions:
        used = _started(start, prior)
        same = np.array_equal(used.mean, prior.mean)
        worse = _worse_than_none(corrected if same else without_motion(model, samples, used.mean), used, found, prior, none)
        opposite = bool(refuted) and share.value < -SURE * share.std
        if harmful or other_axes or worse or opposite or (new_bias and refuted):
            return Fitness("unfit", (*other_start, *contradictions, *worse))
    doubts = [
        *other_start,
        *(sentence for sentence in contradictions if not confirmed or sentence not in new_bias),
        *changed_at_rest(corrected, found.stops, prior),
        *_not_shown(start, found),
        *model.remarks,
        *other_conditions(model, samples),
        *other_unit(model, about),
    ]
    if not (doubts or confirmed or _same_unit(model, about)):
        doubts += filter(None, [untold_unit(prior, found.variance, found.odds, _shown_std(found, prior))])
    if doubts:
        return Fitness("doubtful", tuple(doubts))
    agreement = _shown_share(share) if confirmed else _agreement(found, prior, share)
    followed = [] if model.log_drift is None else [f"its bias follows {model.log_drift.name}"]
    if model.load_before is not None:
        followed.append("the sensor was in use before the log, so its drift does not start cold")
    return Fitness("fits", (agreement, *new_bias, *followed))


def _untrained(start: InitialBias, samples: Samples) -> Fitness:
    """Fitness of a constant bias, which needs no training, from the stops of a log."""
    units = sorted({path.stem.rpartition("-")[0] for path in library().glob("*.safetensors")})
    other_start, harmful = contradicted_start(start.rest, start.std, *shown_at_rest(samples))
    if np.linalg.norm(start.rest[:3]) > TELLING[0] / 2.0 and (shown := refuted_stops(samples, static.Model())):
        in_motion, turned = contradicted_start(start.rest, start.std, shown[0], DEPENDENT * shown[1] + ONLY_GYRO)
        other_start, harmful = [*other_start, *in_motion, STEADY_TURN], harmful or turned
    stops = stops_in(samples)
    doubts = (*other_start, *changed_at_rest(samples, stops, UNTRAINED))
    unseen = f"the first {CHECKED_S:.0f} s have no stop that could contradict its bias"
    agreement = "its bias agrees with the gyro at rest" if stops else unseen
    trained = f"trained models ship for {', '.join(units)}"
    return Fitness("unfit" if harmful else "doubtful" if doubts else "fits", (*(doubts or (agreement,)), trained))


def head(batches: Iterable[Samples]) -> Samples:
    """Samples of the first `CHECKED_S` seconds."""
    parts = list(itertools.takewhile(lambda part: not len(part[0]) or part[0][0] < CHECKED_S, batches))
    t_s = np.concatenate([np.zeros(0), *(part[0] for part in parts)])
    gyro, accel = (np.concatenate([np.zeros((0, 3)), *(part[column] for part in parts)]) for column in (1, 2))
    end = int(np.searchsorted(t_s, CHECKED_S))
    return t_s[:end], gyro[:end], accel[:end]


def _started(start: InitialBias, prior: BiasPrior) -> BiasPrior:
    """Prior with which a start begins; one that the user gives is no part of the model."""
    own = {"mean": start.rest, "std": np.maximum(start.std, MIN_STD)} if start.std.any() else {}
    return start.follows or replace(prior, **own)


def _evidence(samples: Sequence[Samples], priors: Sequence[BiasPrior]) -> list[_Evidence]:
    """Evidence of samples at the same times, which hold no motion-dependent bias, each about its prior of a constant bias."""
    return [_shown(*each) for each in zip(_filtered(samples, priors), priors, strict=True)]


def _filtered(samples: Sequence[Samples], priors: Sequence[BiasPrior], **changes: float) -> list[list[FilteredBlock]]:
    """Filtered blocks of samples at the same times, by settings that take up little of what a wrong scale leaves."""
    settings = priors[0].settings  # all are of one model
    speed_m_s = max(settings.speed_m_s, MIN_SPEED_M_S)
    careful = msgspec.structs.replace(settings, speed_m_s=speed_m_s, pivot_m=MIN_PIVOT_M, **changes)
    return filter_together([BiasFilter(replace(prior, walk=np.zeros(6)), careful, ahead=True) for prior in priors], samples)


def _share(samples: Sequence[Samples], unknown: BiasPrior) -> Share:
    """Share of a correction that a log shows; the samples are those without it and those with it.

    The position shows it where one of both stays in a room, and elsewhere the velocity.
    """
    if all(np.array_equal(*columns) for columns in zip(*samples, strict=True)):
        return Share(0.0, math.inf, math.inf)
    in_room = _filtered(samples, [unknown] * 2, room_m=ROOM_M, **SURE_GYRO)
    away = [innovations(block.step for block in blocks if not block.resting).chi_square for blocks in in_room]
    share = _share_of(in_room)
    stays = any(each.sum() <= MAX_IN_ROOM * len(each) for each in away)
    return share if stays and share.filter_std < MAX_STD else _share_of(_filtered(samples, [unknown] * 2))


def _share_of(runs: Sequence[Sequence[FilteredBlock]]) -> Share:
    share = share_of_correction(*(innovations(block.step for block in blocks) for blocks in runs))
    return share._replace(std=math.hypot(share.std, OF_FILTER * share.filter_std))


def _shown(blocks: Sequence[FilteredBlock], prior: BiasPrior) -> _Evidence:
    if not blocks:
        return _Evidence(0.0, 0.0, np.zeros(6), np.full(6, np.inf))
    found = innovations(block.step for block in blocks)
    last = blocks[-1].step.after
    after, before = np.diag(last.covariance(False)), prior.std**2
    precision = 1.0 / after - 1.0 / before
    shown = precision > 1e-9 / before
    gain = np.where(shown, 1.0 - after / before, 1.0)
    difference = np.where(shown, (last.bias - prior.mean) / gain, 0.0)
    variance = np.where(shown, 1.0 / np.where(shown, precision, 1.0), np.inf) + prior.walk**2 * blocks[-1].end_s
    surprising = float((found.chi_square > SURPRISING).mean())
    odds = ShownBias.of(last.bias - prior.mean, last.covariance(False), prior.std, AT_REST_STD).odds_of_unit(prior)
    return _Evidence(float(found.log_likelihood.sum()), surprising, difference, variance, stops_of(blocks), odds)


def _not_shown(start: InitialBias, found: _Evidence) -> Iterator[str]:
    """Sentence on a bias that the log shows less well than its start, and whose deviation exceeds the gyro's bias."""
    before, shown = start.std[:3], DEPENDENT * np.sqrt(found.variance[:3])
    std = 1.0 / np.sqrt(1.0 / np.maximum(before, MIN_STD[:3]) ** 2 + 1.0 / shown**2)
    unknown = np.where((shown > before) & (std > np.linalg.norm(start.rest[:3])), std, 0.0)
    axis = int(np.argmax(unknown))
    if unknown[axis] > MAX_UNKNOWN:
        bias = f"the start's {start.rest[axis]:+.2g} ± {std[axis]:.2g} rad/s"
        yield f"neither stops nor gravity shows the gyro's bias about {'xyz'[axis]}; {bias} may do more harm than good"


def _deviations(found: _Evidence, prior: BiasPrior) -> Vector6:
    """Differences between the bias that a log shows and the prior, in standard deviations."""
    return np.asarray(np.abs(found.difference) / _shown_std(found, prior))


def _shown_std(found: _Evidence, prior: BiasPrior) -> Vector6:
    """Standard deviation of the bias that a log shows about the prior's mean."""
    return np.asarray(np.sqrt(prior.std**2 + DEPENDENT**2 * found.variance + AT_REST_STD**2))


def _disagreement(found: _Evidence, none: _Evidence) -> Iterator[str]:
    """Sentence on samples that contradict each other after the correction, unless those of no model do."""
    if found.surprising > MAX_SURPRISING + none.surprising:  # fast vehicles surprise without a model, too
        half_seconds = f"{found.surprising:.0%} of the half seconds, before it in {none.surprising:.0%}"
        yield f"gyro and gravity disagree after the correction in {half_seconds}"


def _refuted(share: Share) -> Iterator[str]:
    """Sentence on a correction of which the log shows less than half."""
    if MIN_SHARE < share.value < max(HALF - SURE * share.std, min(HALF, 1.0 - OWN * share.std)):
        yield f"{_shown_share(share)}: the correction is another unit's"


def _shown_share(share: Share) -> str:
    """Share of the correction that the log shows, in words."""
    deviation = f" ± {share.std:.0%}" if share.std >= MIN_SHOWN else ""
    return f"gravity and stops show {share.value:.0%}{deviation} of the model's correction in motion"


def _worse_than_none(samples: Samples, used: BiasPrior, found: _Evidence, prior: BiasPrior, none: _Evidence) -> list[str]:
    """Sentences on a model that explains a log worse than no model, even from its start in that log."""
    shown = found.variance < MAX_CHANGE**2 / MAX_DEVIATIONS**2
    if (shown & (np.abs(found.difference) > MAX_CHANGE + MAX_DEVIATIONS * prior.std)).any():
        return ["no turn-on changes the bias by so much: the log is of another unit"]
    evidence = _evidence([samples], [used])[0].log_likelihood - none.log_likelihood
    if evidence > MIN_EVIDENCE:
        return []
    return [f"the raw samples agree with gravity and stops better than the corrected, by {-evidence:.0f} in log-likelihood"]


def _same_unit(model: BiasModel, about: Mapping[str, str]) -> bool:
    """Whether the log is of the very unit for which a model ships, or was in its training."""
    names = [log.get("name") for log in model.card.get("logs", ()) if isinstance(log, dict)]
    return model.card.get("name") in shipped_for(about) or about.get("sequence") in names


def _agreement(found: _Evidence, prior: BiasPrior, share: Share) -> str:
    """Sentence on a log that agrees with a model, and on what it does not show."""
    maximum = _deviations(found, prior).max()
    agrees = f"the bias that the log shows lies within {maximum:.1f} standard deviations of the model's prior"
    if math.isinf(share.std):  # nothing is corrected in motion
        return agrees
    return f"{agrees}; {_shown_share(share) if share.std <= HALF else 'it does not show the share of the correction in motion'}"
