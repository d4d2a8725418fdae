"""What a motion shows: observable parameters, fixed ones, and effects that are no answer."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, combinations
from typing import Any

import numpy as np
from scipy.signal import welch

from imutool.array_types import Float64
from imutool.diagnosis.estimation.aligned_log import AlignedLog, Pair
from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import expected
from imutool.diagnosis.estimation.significance import bic, parameter_cost
from imutool.diagnosis.estimation.whitening import WhitenedLog
from imutool.recording import GRAVITY_M_S2
from imutool.sensor.effect import ONCE_MORE, Effect, Theta
from imutool.sensor.effects import low_pass, vibration
from imutool.sensor.effects.gyro_hysteresis import play
from imutool.sensor.effects.gyro_scale import SCALES, STEP

SMALL = 1e-2  # of the plausible size, at which an effect is still proportional to it
SHARED, STANDS_STILL = "share", 0.4  # variant of a hysteresis; of the motion, what such a share moves at least
MAX_SHARE = 1.2  # of the reading that lags: all of it, and what a fit errs by
LOW_PASSES = ("low_pass", "second_order_low_pass")
NEEDS_DELAY = {"clock_offset": ("clock_skew", "clock_jump", "clock_wander", *LOW_PASSES, "mount_resonance")}
"""What delays, rings, jumps or wanders needs the motion that shows a delay."""
STEADY, WANDER = ("clock_offset", "clock_skew", "clock_jump"), "clock_wander"
UNLISTED = (WANDER, "reference_smoothing")  # errors of poses: that a log cannot show them says nothing of the sensor
PLAINER = {  # of one that is no better: another effect, and its parameters, by index
    **{f"gyro_bias_{course}": ("temperature", range(3)) for course in ("drift", "step")},
    **{f"accel_bias_{course}": ("temperature", range(3, 6)) for course in ("drift", "step")},
    **{"gyro_scale_asymmetry": ("gyro_scale", range(3)), "accel_scale_asymmetry": ("accel_scale", range(3))},
    "gyro_scale_drift": ("gyro_scale_temperature", range(3)),
    "gyro_hysteresis": ("gyro_delay", range(1)),
}
REVERSED = -2.0  # error of scale of an axis that reads the opposite of the motion
SITES_M_S2 = 0.04  # 9.764 to 9.834 m/s² on Earth
REPLACES = {WANDER: ("clock_offset", "clock_skew"), "reference_smoothing": LOW_PASSES, LOW_PASSES[1]: LOW_PASSES[:1]}
"""What would cancel together."""
Starts = Mapping[str, Sequence[Theta]]


# ── what the motion can show ──


def unobservable(logs: Sequence[WhitenedLog], candidates: Sequence[Effect]) -> tuple[str, ...]:
    """Unobservable parameters `effect.parameter`, or `effect` where all of them are.

    At its plausible size such a parameter adds fewer than `observable_squares` to the white residuals, given a constant bias.
    """
    out: list[str] = []
    names, minimum = {effect.name for effect in candidates}, logs[0].pair.settings.search.observable_squares
    for effect in candidates:
        if not _proportional(effect) or effect.name in UNLISTED:
            continue
        gains = zip(effect.parameters, _gains(logs, effect), strict=True)
        hidden = [parameter.name for parameter, gain in gains if gain < minimum]
        if len(hidden) == len(effect.parameters):
            out += [effect.name, *(name for name in NEEDS_DELAY.get(effect.name, ()) if name in names)]
        else:
            out += [f"{effect.name}.{name}" for name in hidden]
    return tuple(dict.fromkeys(out))


def _proportional(effect: Effect) -> bool:
    """Whether an effect is proportional to its parameters near zero."""
    return bool(np.isfinite(effect.null_value).all()) and not any(n.positive or n.begins for n in effect.parameters)


def _gains(logs: Sequence[WhitenedLog], effect: Effect) -> Float64[np.ndarray, " p"]:
    """Squares that each parameter adds at its plausible size, less those that a constant takes."""
    total = np.zeros(len(effect.parameters))
    for log in logs:
        rows, ideal, constant = log.rows("all"), expected(log.pair, ()), log.constants[log.rows("all")]
        constant = constant / np.sqrt(np.maximum((constant**2).sum(axis=0), 1e-300))
        for j, theta in enumerate(np.diag(SMALL * effect.plausible)):  # one after the other: a column is as long as the log
            b = log.whiten(expected(log.pair, ((effect, theta),)) - ideal)[rows] / SMALL
            total[j] += (b**2).sum() - (np.einsum("na,na->a", constant, b) ** 2).sum()
    return total


# ── fixed parameters ──


class FixedParameters:
    """Forward model of an effect whose other parameters are fixed at their null value."""

    def __init__(self, effect: Effect, free: Sequence[int]) -> None:
        self.effect, self.free = effect, list(free)

    def __call__(self, signals: Any, theta: Theta) -> Any:
        """Signals behind the effect."""
        every = self.effect.null_value.astype(float)
        every[self.free] = theta
        return self.effect.forward(signals, every)


def with_free(effect: Effect, free: Sequence[int], sensors: tuple[str, ...] = ()) -> Effect:
    """Effect with only some free parameters, by index, on some sensors; itself with all."""
    if len(free) == len(effect.parameters):
        return effect
    kept_parameters = tuple(effect.parameters[k] for k in free)
    return replace(effect, sensors=sensors or effect.sensors, parameters=kept_parameters, forward=FixedParameters(effect, free))


def without_implausible(effect: Effect, theta: Theta, factor: float) -> Effect:
    """Effect without implausible parameters, which fit noise; an axis may be reversed."""
    maximum = [factor * n.plausible if n.maximum is None else n.maximum for n in effect.parameters]
    size = np.minimum(np.abs(theta), np.abs(theta - REVERSED)) if effect.name in SCALES else np.abs(theta)
    free = [k for k, n in enumerate(effect.parameters) if n.begins or size[k] <= maximum[k]]
    judged = effect.kind == "catalogue" and (effect.linear or effect.variant == STEP)
    return with_free(effect, free if any(not effect.parameters[k].begins for k in free) else []) if judged else effect


def with_steady_clock(base: Fit, named: Sequence[Effect], starts: Starts) -> Fit:
    """Fit with one or two of offset, skew and jump for a clock that wanders, if as good (BIC)."""
    others, best = tuple(entry for entry in base.chosen if entry[0].name != WANDER), base
    if len(others) == len(base.chosen):
        return base
    steady = [effect for effect in named if effect.name in STEADY and effect.key not in base.keys]
    for some in chain(combinations(steady, 1), combinations(steady, 2)):
        on_trend = len(some) > 1 and any(effect.name == "clock_skew" for effect in some)
        at = {"clock_offset": 0, "clock_skew": 0, "clock_jump": -1 if on_trend else 0}
        begun = (*others, *((effect, starts[effect.key][at[effect.name]]) for effect in some))
        best = min(best, fit(base.logs, begun, near=base, give_up_above=bic(best) - parameter_cost(base, begun)), key=bic)
    return best


def with_plainer_effects(base: Fit, named: Sequence[Effect]) -> Fit:
    """Fit with the plainer of two effects where the other is not clearly better (BIC)."""
    poses = any(log.pair.band_hz is not None for log in base.logs)
    for complex_one, theta in base.chosen:
        sizes = _plainer(complex_one, theta, poses=poses)
        rest = tuple(entry for entry in base.chosen if entry[0] is not complex_one)
        plainer = [effect for effect in named if effect.key in sizes and effect.key not in base.keys]
        parts = [(with_free(e, sizes[e.name][0], complex_one.sensors), np.array(sizes[e.name][1])) for e in plainer]
        margin = base.logs[0].pair.settings.search.clearly_better * max(1.0, base.reduced_chi_square)
        limits = [bic(base) + margin - parameter_cost(base, (*rest, part)) for part in parts]
        trials = [fit(base.logs, (*rest, part), near=base, give_up_above=at) for part, at in zip(parts, limits, strict=True)]
        best = min(trials, key=bic, default=base)
        base = best if bic(best) < bic(base) + margin else base
    return base


def _plainer(effect: Effect, theta: Theta, *, poses: bool) -> Mapping[str, tuple[Sequence[int], Sequence[float]]]:
    """Effects that may stand for one: their free parameters, by index, and a start.

    A clock that jumps, a gyro that lags against poses (which have a clock of their own), a drift or step of a bias next to a
    temperature of the log, two gains of axes that hardly change their sign, a share that lags by as much as the motion, three
    scales as one gravity within what Earth has.
    """
    name = effect.name
    if name == "clock_jump":
        return {"clock_offset": ([0], [theta[1]]), "clock_skew": ([0], [theta[1] / max(2.0 * theta[0], 1.0)])}
    if name == LOW_PASSES[1] or (name == LOW_PASSES[0] and effect.sensors == ("gyro",)):
        lag_s = low_pass.Design.of(effect, theta).lag_s
        of_both = {"clock_offset": ([0], [-lag_s]), "low_pass": ([0], [1.0 / (2.0 * np.pi * lag_s)])}
        return of_both if len(effect.sensors) > 1 else {"gyro_delay": ([0], [lag_s])} if effect.sensors[0] == "gyro" else {}
    if effect.key == "gyro_delay" and poses:
        return {"clock_offset": ([0], [-theta[0]])}
    if name in PLAINER and effect.variant != SHARED:
        return {PLAINER[name][0]: (PLAINER[name][1], np.zeros(len(PLAINER[name][1])).tolist())}
    if effect.variant == SHARED:
        return {f"{effect.sensors[0]}_scale": (range(3), np.full(3, -theta[1]).tolist())}
    g = GRAVITY_M_S2 * float(np.mean(theta))
    return {"gravity": (range(3), [g, 0.0, 0.0])} if name == "accel_scale" and len(theta) == 3 and abs(g) < SITES_M_S2 else {}


def with_common_arm(base: Fit, named: Sequence[Effect], is_significant: Callable[[Effect, float], bool]) -> Fit:
    """Fit with a lever arm for a size effect of equal arms; with both if the rest is smaller.

    All nine numbers of a size effect next to a lever arm hold that arm twice, and either could do without the other.
    """
    nine = [entry for entry in base.chosen if entry[0].name == "size_effect" and len(entry[0].parameters) == 9]
    lever = [effect for effect in named if effect.name == "lever_arm"]
    if not nine or not lever:
        return base
    logs, share = base.logs, base.logs[0].pair.settings.search.common_arm_share
    others = tuple(entry for entry in base.chosen if entry[0].name not in ("size_effect", "lever_arm"))
    alone = base if len(others) == len(base.chosen) - 1 else fit(logs, (*others, nine[0]), near=base)
    without = fit(logs, others, near=base)
    simple = fit(logs, (*others, (lever[0], lever[0].null_value.astype(float))), near=base)
    if without.objective - simple.objective < share * (without.objective - base.objective):
        return alone
    rest = with_free(nine[0][0], range(6))  # of the x and y axes against z, whose arm is the lever arm
    both = fit(logs, (*simple.chosen, (rest, rest.null_value.astype(float))), near=simple)
    if not is_significant(rest, simple.objective - both.objective):
        return simple
    positions = next(theta for effect, theta in alone.chosen if effect is nine[0][0]).reshape(3, 3)  # of each axis
    return both if np.linalg.norm(positions.mean(axis=0)) > np.linalg.norm(positions.std(axis=0)) else alone


def values_of(effect: Effect, reduced: Effect, theta: Theta) -> Theta:
    """Values of the parameters that a reduced effect still has."""
    names = [parameter.name for parameter in reduced.parameters]
    return np.array([value for parameter, value in zip(effect.parameters, theta, strict=True) if parameter.name in names])


def unidentified(effect: Effect, theta: Theta, std: Theta, *, curve: bool) -> Iterator[str]:
    """Unidentified `effect.parameter`: as unsure as it is large, or fixed; none of a curve."""
    name = effect.name if effect.kind == "catalogue" else effect.key
    for parameter, value, s in zip(effect.parameters, theta, std, strict=True):
        if s > max(abs(value), 0.0 if parameter.positive else parameter.plausible) and not curve:
            yield f"{name}.{parameter.name}"
    if isinstance(effect.forward, FixedParameters) and effect.sensors == effect.forward.effect.sensors:
        free = {parameter.name for parameter in effect.parameters}
        yield from (f"{name}.{n.name}" for n in effect.forward.effect.parameters if n.name not in free)


# ── effects that are no answer ──


def for_noise(effects: Sequence[Effect]) -> list[Effect]:
    """Effects whose residual gives the noise: further steps and filters leave too little."""
    plain = (effect for effect in effects if effect.lagless is None or effect.key == LOW_PASSES[0])
    return [effect for effect in plain if effect.variant not in (SHARED, STEP, *ONCE_MORE)]


def exclude_each_other(a: Effect, b: Effect) -> bool:
    """Whether two effects never act together.

    Variants of one effect on one sensor do not, but for what acts several times, nor what replaces another.
    """
    if a.key != b.key and a.name == b.name and {a.variant, b.variant} <= {"", STEP, *ONCE_MORE}:
        return False
    one_sensor = a.sensors == b.sensors or bool(set(a.sensors) & set(b.sensors))
    variants = a.kind == b.kind == "catalogue" and a.name == b.name and one_sensor
    return a.key == b.key or variants or a.name in REPLACES.get(b.name, ()) or b.name in REPLACES.get(a.name, ())


def may_act(effect: Effect, keys: Sequence[str]) -> bool:
    """Whether an effect may come in: one that acts once more follows the one before."""
    if effect.variant not in ONCE_MORE:
        return True
    before = ("", *ONCE_MORE)[ONCE_MORE.index(effect.variant)]
    return (f"{effect.name}:{before}" if before else effect.name) in keys


def beyond_the_band(effect: Effect, theta: Theta, logs: Sequence[WhitenedLog]) -> bool:
    """Whether a fit is no answer: beyond the poses' band, too slow, too loud, or noise."""
    if any(n.minimum is not None and value < n.minimum for n, value in zip(effect.parameters, theta, strict=True)):
        return True
    by_poses, settings = [log.pair for log in logs if log.pair.band_hz is not None], logs[0].pair.settings.search
    if effect.name == vibration.EFFECT.name and any(_is_motion(effect, theta, pair) for pair in by_poses):
        return True
    # smoothed poses lose and delay motion beyond their band by themselves, which looks alike
    factor = settings.beyond_band_low_pass if effect.name in LOW_PASSES else settings.beyond_band
    reach = [factor * pair.band_hz for pair in by_poses if pair.band_hz is not None]
    hertz = [value for parameter, value in zip(effect.parameters, theta, strict=True) if parameter.unit == "Hz"]
    outside = bool(reach and hertz and (max(hertz) > min(reach) or min(hertz) < settings.slowest_hz))
    if effect.name == "mount_resonance":
        takes_back = bool(theta[2:5].sum() < 0.0)  # as no spring does
        overdamped = bool(theta[1] > 1.0)  # a lag, which does not ring
        return outside or takes_back or overdamped or any(_rings_too_loud(effect, theta, log.pair) for log in logs)
    if effect.variant == SHARED and (theta[1] > MAX_SHARE or all(_is_scale(effect, theta, log.pair) for log in logs)):
        return True
    noise = [log.pair.sim_noise[log.pair.signals[effect.sensors[0]]].max() for log in logs if isinstance(log.pair, Pair)]
    minimum = settings.beyond_sim_noise * max(noise, default=0.0)  # a narrower width takes what a filter left of it
    return outside or any(n.name == "width" and value < minimum for n, value in zip(effect.parameters, theta, strict=True))


def _is_scale(effect: Effect, theta: Theta, pair: AlignedLog) -> bool:
    """Whether the share of a hysteresis stands still, because its width exceeds the motion: it lowers the scale alone."""
    (sensor,) = effect.sensors
    motion = expected(pair, ())[:, pair.signals[sensor]]
    output = play(motion, float(theta[0]))
    return bool((output.std(axis=0) < STANDS_STILL * motion.std(axis=0)).all())


def _is_motion(effect: Effect, theta: Theta, pair: AlignedLog) -> bool:
    """Whether a line is one of the body's own motion, of which smoothed poses lose a part."""
    by_poses, chance = expected(pair, ()), pair.settings.search.false_discovery_rate
    line = expected(pair, ((effect, theta),)) - by_poses
    return vibration.is_motion(pair.stamp_s, by_poses, line, float(theta[0]), chance)


def _rings_too_loud(effect: Effect, theta: Theta, pair: AlignedLog) -> bool:
    """Whether a mount that rings beyond the poses' band would be louder there than an axis reads.

    Below its frequency a resonance is a gain, as smoothing is. The samples themselves show whether it rings.
    """
    (f0_hz, zeta), settings = theta[:2], pair.settings.search
    if pair.band_hz is None or f0_hz <= pair.band_hz:
        return False
    accel, rate_hz = pair.signals["accel"], 1.0 / pair.period_s
    size = min(len(pair.real), round(settings.ringing_segment_s * rate_hz))
    f_hz, predicted = welch(expected(pair, ((effect, theta),))[:, accel], rate_hz, nperseg=size, axis=0)
    _, read = welch(pair.real[:, accel], rate_hz, nperseg=size, axis=0)
    near = np.abs(f_hz - f0_hz) <= max(zeta * f0_hz, 2.0 / settings.ringing_segment_s)
    return bool((predicted[near].sum(axis=0) > settings.ringing_power * read[near].sum(axis=0)).any())
