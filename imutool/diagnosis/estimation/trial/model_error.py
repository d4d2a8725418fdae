"""Errors of models: how small an effect may be the error of the model of a far larger one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.stats import f as fisher

from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.gauss_newton import Fit
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.noise_estimate import leaves_slow_motion
from imutool.diagnosis.estimation.observability import LOW_PASSES, STEADY, WANDER
from imutool.diagnosis.estimation.trial.selection import Selection
from imutool.diagnosis.settings import SearchSettings
from imutool.sensor.effect import Effect, Theta
from imutool.sensor.effects.gyro_bias_step import followed, orthonormal
from imutool.sensor.effects.low_pass import Design

CLOCKS = (*STEADY, WANDER)
FILTERS = (*LOW_PASSES, "mount_resonance", "gyro_delay", "gyro_hysteresis", "accel_hysteresis")
SIMPLIFIED = ("mount_resonance", "gyro_hysteresis", "accel_hysteresis")  # a mass moves, too; motion turns between two samples
FOLLOWING = frozenset({*CLOCKS, *FILTERS})
OF_MOTION = FOLLOWING | {
    *(f"{sensor}_{kind}" for sensor in ("gyro", "accel") for kind in ("scale", "misalignment", "scale_asymmetry", "quadratic")),
    *("lever_arm", "size_effect", "mount_rotation", "gyro_g_sensitivity", "gyro_scale_drift", "gyro_scale_temperature"),
}
BIAS_STEPS, AROUND_S = ("gyro_bias_step", "accel_bias_step"), 3.0  # on both sides, where a gain hardly changes

TAKEN_BACK = 0.5  # of a low-pass's lag, by a gyro that is ahead
SLOW = 0.25  # of a cut-off frequency: below, a low-pass takes 0.2 % (second order) to 3 % (first)
SEEN_ERROR = 2.0  # times what other effects show of a low-pass's error (made-up flights whose vibrations fold: 1.4 to 3.6)


def below_model_error(
    gains: Mapping[str, float],
    settings: SearchSettings,
    *,
    denoised: bool,
    poses: bool,
    names: Mapping[str, str] = MappingProxyType({}),
) -> frozenset[str]:
    """Effects below the model error of a far larger effect that follow the same motion.

    A filter and a clock say how a sensor follows its motion, and so does the error of any other model: a mass on springs moves,
    and its lever arm with it; a simulator that holds its forces for a step reads accelerations half a step early; noise that
    was filtered out of a simulation took a little of its motion along. Such an error is a share of the large effect, however
    certain against the noise. The clock of `poses` drifts and jumps against the sensor's in more ways than one, and a filter
    takes what the clock leaves. A low-pass of another order leaves an error that rings. `gains` are squares that leaving an
    effect out costs, by key; `names` are those of keys with a variant. `denoised` says whether noise was filtered out of a
    simulation.
    """
    allowed = settings.model_error_denoised if denoised else settings.model_error
    simplified = dict.fromkeys(SIMPLIFIED, settings.model_error_resonance)
    of_filters = dict.fromkeys(LOW_PASSES, settings.model_error_low_pass)
    of_filters |= dict.fromkeys(CLOCKS, settings.model_error_clock) if poses else {}

    def name(key: str) -> str:
        return names.get(key, key)

    def share(key: str, other: str) -> float:
        as_filter = of_filters.get(name(other), 0.0) if name(key) in FILTERS else 0.0
        return max(allowed, simplified.get(name(other), 0.0), as_filter)

    return frozenset(
        key
        for key, gain in gains.items()
        if name(key) in FOLLOWING and any(gain < share(key, other) * more for other, more in gains.items() if other != key)
    )


def is_taken_back(found: Fit, low_pass: Effect) -> bool:
    """Whether a gyro that is ahead takes most of its low-pass's lag back, as no filter does."""
    ahead_s = -sum(float(theta[0]) for effect, theta in found.chosen if effect.key == "gyro_delay")
    own_s = next(Design.of(low_pass, theta).lag_s for effect, theta in found.chosen if effect is low_pass)
    return "gyro" in low_pass.sensors and ahead_s > TAKEN_BACK * own_s


def of_motion(effect: Effect) -> bool:
    """Whether an effect but a low-pass follows the motion, as the error of one does."""
    return effect.name in OF_MOTION - {*LOW_PASSES} or (effect.kind == "unknown" and not effect.of_time)


def below_reference_error(effect: Effect, gain: float, found: Fit) -> bool:
    """Whether an effect that follows the motion is below the error of a simulation itself.

    It interpolates, integrates and rounds, so its motion errs by a share, however little noise a recording has. Poses have far
    more noise than this share.
    """
    if not _follows_body(effect, found):
        return False
    motion = 0.0
    for log in found.logs:
        ideal = expected(log.pair, ())
        squares = (log.whiten(ideal - ideal.mean(axis=0))[log.rows(found.part)] ** 2).sum(axis=0)
        motion += sum(float(squares[part].sum()) for name, part in log.pair.signals.items() if name in effect.sensors)
    return gain < found.logs[0].pair.settings.search.model_error_reference * motion


def is_part_of_misfit(effect: Effect, gain: float, found: Fit) -> bool:
    """Whether an effect explains a small part of a misfit of slow motion that has no name.

    Whatever moves with the body explains some of such a misfit, so a name for it would be wrong.
    """
    minimum = found.logs[0].pair.settings.search.larger_misfit * gain
    return _follows_body(effect, found) and all(leaves_slow_motion(found, sensor, minimum) for sensor in effect.sensors)


def is_swing_of_motion(effect: Effect, found: Fit) -> bool:
    """Whether a step of a bias is no more than what follows the motion around it.

    It is asked where a misfit has no name. On three seconds to each side the step has to explain more than chance (F)
    after a constant, everything that a misfit follows (`followed`), and both times the time, as gains that change (Chow,
    Econometrica 28, 1960).
    """
    settings = found.logs[0].pair.settings.search
    pairs = [log.pair for log in found.logs if isinstance(log.pair, Pair) and log.pair.exact]
    if effect.name not in BIAS_STEPS or found.reduced_chi_square < settings.white_chi_square or len(pairs) < len(found.logs):
        return False
    others = tuple(entry for entry in found.chosen if entry[0] is not effect)
    return all(_local_p_value(pair, effect, others, found.chosen) > settings.false_discovery_rate for pair in pairs)


def _local_p_value(pair: Pair, effect: Effect, others: Chosen, chosen: Chosen) -> float:
    """p-value of a step within seconds of it; one where a log does not show both sides."""
    part, without = pair.signals[effect.sensors[0]], expected(pair, others)
    added = np.abs(expected(pair, chosen) - without)[:, part].sum(axis=1)
    at = int(np.argmax(np.abs(np.diff(added))))
    near = (pair.stamp_s - pair.stamp_s[at]) / AROUND_S
    rows = (np.abs(near) < 1.0) & pair.usable[:, part].all(axis=1)
    follow = np.column_stack([np.ones(rows.sum()), followed(pair.ideal.sample(pair.stamp_s[rows], pair.stamp_s[rows]))])
    beside = np.column_stack([follow, near[rows, None] * follow])
    free = len(beside) - beside.shape[1] - 1
    if free < beside.shape[1] or not 0 < int((near[rows] > 0).sum()) < len(beside):
        return 1.0
    basis = orthonormal(beside)
    rest, step = (pair.real - without)[rows, part], (np.arange(len(near)) > at)[rows, None].astype(np.float64)
    rest, step = (x - basis @ (basis.T @ x) for x in (rest, step))
    gain = (step * rest).sum(axis=0) ** 2 / (step**2).sum()
    return float(fisher.sf(np.mean(gain / (((rest**2).sum(axis=0) - gain) / free)), rest.shape[1], free))


def _follows_body(effect: Effect, found: Fit) -> bool:
    """Whether an effect of an IMU follows the motion of its body."""
    of_body = of_motion(effect) or effect.name in FILTERS
    return of_body and bool(effect.sensors) and all(isinstance(log.pair, Pair) for log in found.logs)


def is_over_at_once(effect: Effect, theta: Theta, factor: float) -> bool:
    """Whether a drift is implausibly large and over before the first sample.

    Any size of it fits what the first samples show of its tail.
    """
    if effect.reached is None:
        return False
    size = np.abs(theta[:-1]) * effect.reached(float(theta[-1]))
    return bool((size > factor * np.array(effect.plausible)[:-1]).any())


class LowPassError(NamedTuple):
    """Error of the largest low-pass of a fit.

    `size` are the white squares of what it takes from the motion, `squares` those by which it may err. A simulation whose noise
    was filtered out may have vibrations that its samples fold, and a sensor filters before it samples. What is left looks like
    a scale, an arm or a mount. The lag does not count: a clock's offset may take it.
    """

    size: float
    squares: float
    cutoff_hz: float

    @staticmethod
    def of(found: Fit) -> LowPassError | None:
        """The error against a simulation whose noise was filtered out; none without a low-pass."""
        filters = [(effect, theta) for effect, theta in found.chosen if effect.name in LOW_PASSES]
        if not filters or not any(isinstance(log.pair, Pair) and log.pair.denoised for log in found.logs):
            return None
        size, cutoff_hz = max((_taken(effect, theta, found), float(theta[0])) for effect, theta in filters)
        return LowPassError(size, found.logs[0].pair.settings.search.model_error_denoised * size, cutoff_hz)

    def may_be(self, effect: Effect, without: Fit, found: Fit, log_p: Callable[[float], float], maximum: float) -> bool:
        """Whether an effect of a fit may be this error: it is small, and slow motion does not show it."""
        if not of_motion(effect) or without.objective - found.objective >= self.squares:
            return False
        return log_p(_slow_squares(without, SLOW * self.cutoff_hz) - _slow_squares(found, SLOW * self.cutoff_hz)) > maximum


def _taken(effect: Effect, theta: Theta, found: Fit) -> float:
    """White squares of what a low-pass takes from the motion, without its lag."""
    lagless = (effect.without_lag(theta), theta)
    each = ((log, expected(log.pair, (lagless,)) - expected(log.pair, ())) for log in found.logs)
    return float(sum((log.whiten(taken)[log.rows(found.part)] ** 2).sum() for log, taken in each))


def _slow_squares(found: Fit, max_hz: float) -> float:
    """Squares of white residuals up to a frequency."""
    total = 0.0
    for log, residual in zip(found.logs, found.residuals, strict=True):
        rows = residual[log.rows(found.part)]
        f_hz = np.fft.rfftfreq(len(rows), log.pair.period_s * log.whiten.every)
        total += 2.0 * float((np.abs(np.fft.rfft(rows, axis=0)[(f_hz > 0.0) & (f_hz < max_hz)]) ** 2).sum()) / len(rows)
    return total


def with_low_pass_error(selection: Selection, error: LowPassError, gains: Mapping[str, float]) -> Selection:
    """Selection with a low-pass less sure, by the gains of effects that show its error."""
    shown = {name: gain for name, gain in gains.items() if gain < error.size}
    if not shown:
        return selection
    share = SEEN_ERROR * float(np.sqrt(max(shown.values()) / error.size))
    return replace(
        selection,
        selected=tuple(
            replace(e, std=np.hypot(e.std, share * e.theta)) if e.effect.name in LOW_PASSES else e for e in selection.selected
        ),
        within_error=tuple(shown),
    )
