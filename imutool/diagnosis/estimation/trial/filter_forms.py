"""Forms of filters: a low-pass together with a clock offset, or digital; a resonance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.optimize import brentq

from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.noise_estimate import leaves_slow_motion
from imutool.diagnosis.estimation.observability import LOW_PASSES, WANDER, beyond_the_band, exclude_each_other
from imutool.diagnosis.estimation.significance import bic
from imutool.diagnosis.estimation.trial.effect_forms import digital, exponential
from imutool.diagnosis.estimation.whitening import WhitenedLog
from imutool.sensor.effect import Effect, Theta
from imutool.sensor.effects.low_pass import RATE, SMOOTHING, Design
from imutool.sensor.effects.second_order_low_pass import BUTTERWORTH
from imutool.units import SENSORS

HYSTERESIS = "accel_hysteresis"
TAKEN_BACK = 0.5  # of a low-pass's lag: a clock that leaves less takes it back
SLOWEST = 0.9  # samples of a digital filter for one that is recorded


def beside_offset(logs: Sequence[WhitenedLog], others: Chosen, effect: Effect, starts: Sequence[Theta]) -> list[Chosen]:
    """Starts of fits with one more effect; a low-pass also takes its lag back from a clock.

    An offset that was fitted first (clocks without a common epoch are aligned by the motion) has taken the filter's lag. Steps
    from there end early where a lag is a period of a vibration: the filter is too fast, and other effects take the rest. The
    second begins with the start that leaves least.
    """
    begun = [chosen for start in starts for chosen in lag_taken_back(others, effect, start)]
    fits = sorted((fit(logs, chosen, iterations=0) for chosen in begun), key=lambda found: found.objective)
    return [(*others, (effect, starts[0])), *(found.chosen for found in fits[:1])]


def lag_taken_back(others: Chosen, effect: Effect, start: Theta) -> list[Chosen]:
    """Effects with a low-pass whose lag a clock offset no longer takes; none without both."""
    place = next((k for k, (other, _) in enumerate(others) if other.name == "clock_offset"), None)
    if place is None or effect.lagless is None:
        return []
    (offset, tau_s), lag_s = others[place], Design.of(effect, start).lag_s
    return [(*others[:place], (offset, tau_s + np.array([lag_s])), *others[place + 1 :], (effect, start))]


def without_unseen_low_pass(base: Fit, named: Sequence[Effect]) -> Fit:
    """Fit with a clock offset for a low pass beyond the poses' band, which its delay shows."""
    offset = next((e for e in named if e.name == "clock_offset" and e.key not in base.keys), None)
    for k, (effect, theta) in enumerate(base.chosen):
        of_both = effect.name in LOW_PASSES and len(effect.sensors) == len(SENSORS)
        if offset is not None and of_both and beyond_the_band(effect, theta, base.logs):
            delayed = offset, np.array([-Design.of(effect, theta).lag_s])  # far below its cut-off
            return fit(base.logs, (*base.chosen[:k], *base.chosen[k + 1 :], delayed), near=base)
    return base


def with_form_of_low_pass(base: Fit, named: Sequence[Effect]) -> Fit:
    """Fit with another form of a low-pass that is clearly better (BIC).

    Forms are its order, a digital filter, and filters of one sensor or of each by itself.
    A digital one begins at the rate of the samples. Near half of that rate it takes far more than an analog one, and a filter
    of another form would leave its error to other effects. Poses do not know so fast a motion. Where the simulation itself errs
    (its noise was filtered, it folds vibrations), a filter of other sensors has to explain more than that.
    """
    if not is_simulated(logs := base.logs):
        return base
    settings, error = logs[0].pair.settings.search, model_error(logs)
    for k, (effect, theta) in enumerate(base.chosen):
        if effect.name not in LOW_PASSES:
            continue
        if {RATE, SMOOTHING} & {*effect.parameters}:  # another effect that came in since may explain what its rate did
            others, analog = (*base.chosen[:k], *base.chosen[k + 1 :]), [of for of in named if of.key == effect.key]
            if all(other.name in (*LOW_PASSES, "clock_offset") for other, _ in others):
                continue
            trial = min((fit(logs, (*others, (of, theta[:-1])), near=base) for of in analog), key=form_bic, default=base)
            if form_bic(trial) < form_bic(base):
                return with_form_of_low_pass(trial, named)
            continue
        errs, best = error * taken(base, k), base
        for chosen in _forms(base, k, _allowed(base, k, named)):
            margin = max(settings.clearly_better, 0.0 if _sensors(chosen) == _sensors(base.chosen) else errs)
            trial = fit(logs, chosen, near=base, give_up_above=bic(best) - margin)
            if form_bic(trial) < form_bic(best) and bic(trial) < bic(base) - margin and is_shown(trial):
                best = trial
        if best is not base:
            return with_form_of_low_pass(best, named)
        two = _of_each_sensor(base, k, named)
        trial = fit(logs, two, near=base) if two else base
        if bic(trial) < bic(base) - settings.model_error_low_pass / error * max(settings.clearly_better, errs):
            return with_form_of_low_pass(with_own_forms(trial, named), named)  # endless damping is of first order
    return base


def with_form_of_resonance(base: Fit, named: Sequence[Effect]) -> Fit:
    """Fit with a resonance whose damper is elsewhere, where that is clearly better (BIC)."""
    if not all(log.pair.exact for log in base.logs):
        return base
    for k, (effect, theta) in enumerate(base.chosen):
        for other in [e for e in named if e.name == effect.name == "mount_resonance" and e.key != effect.key]:
            chosen = (*base.chosen[:k], (other, theta), *base.chosen[k + 1 :])
            trial = fit(base.logs, chosen, near=base, give_up_above=base.objective)
            if bic(trial) < bic(base) - base.logs[0].pair.settings.search.clearly_better:
                return trial
    return base


def with_delay_of_accel(base: Fit, named: Sequence[Effect], *, complete: bool = False) -> Fit:
    """Fit with a delay of the accelerometer for a filter that is not clearly better (BIC).

    A late accelerometer is a clock that is late, and a gyro that is ahead of it. One alone of these two explains little, so
    that the search finds the low-pass of this lag, or of slow motion a hysteresis. A hysteresis, and against a
    simulation a first order, has one number, and stays unless it is clearly worse. What a `complete` fit leaves is noise.
    """
    both = {key: of for key in ("clock_offset", "gyro_delay") for of in named if of.key == key}
    now = {effect.key: theta for effect, theta in base.chosen}
    for k, (effect, theta) in enumerate(base.chosen):
        if len(both) == 2 and effect.name in (*LOW_PASSES, HYSTERESIS) and effect.sensors == ("accel",):
            others, lag_s = (*base.chosen[:k], *base.chosen[k + 1 :]), sensor_lag_s(effect, theta, "accel")
            late = [entry for entry in others if entry[0].key not in both]
            late += [(of, now.get(key, np.zeros(1)) - lag_s) for key, of in both.items()]
            settings = base.logs[0].pair.settings.search
            plainer = effect.name == HYSTERESIS or (is_simulated(base.logs) and effect.name == LOW_PASSES[0])
            slack = settings.clearly_better * (-1.0 if plainer else 1.0)
            if complete and effect.name != HYSTERESIS:
                slack *= base.reduced_chi_square
            trial = fit(base.logs, tuple(late), near=base, give_up_above=base.objective + max(0.0, slack))
            if bic(trial) >= bic(base) + slack:
                return base
            maximum = settings.hysteresis_leaves * (fit(base.logs, others, near=base).objective - trial.objective)
            return base if effect.name == HYSTERESIS and leaves_slow_motion(trial, "accel", maximum) else trial
    return base


def is_simulated(logs: Sequence[WhitenedLog]) -> bool:
    """Whether all logs are of an IMU and compared with a simulation."""
    return all(isinstance(log.pair, Pair) and log.pair.exact for log in logs)


def model_error(logs: Sequence[WhitenedLog]) -> float:
    """Share of the squares of a filter by which its model may err, against a simulation."""
    settings = logs[0].pair.settings.search
    return settings.model_error_denoised if any(log.pair.denoised for log in logs) else settings.model_error


def with_own_forms(base: Fit, named: Sequence[Effect]) -> Fit:
    """Fit with the filters of one sensor alone each in another form, if better (BIC)."""
    best = base
    for sensors in ((sensor,) for sensor in SENSORS):
        places = [k for k, (effect, _) in enumerate(best.chosen) if effect.name in LOW_PASSES and effect.sensors == sensors]
        forms = [of for of in named if of.name in LOW_PASSES and of.sensors == sensors]
        for chosen in [chosen for k in places for chosen in _forms(best, k, forms)]:
            trial = fit(base.logs, chosen, near=best, give_up_above=bic(best))
            best = trial if form_bic(trial) < form_bic(best) and is_shown(trial) else best
    return best


def form_bic(found: Fit) -> float:
    """BIC with a cost for rare forms of filters.

    Another order counts as a parameter, and any form but an analog first or second order has to be clear. A filter far above
    the motion shows its lag alone, which every form has.
    """
    filters = [effect for effect, _ in found.chosen if effect.name in LOW_PASSES]
    orders, rare = (
        sum(len(of.constants) for of in filters),
        sum(bool(of.constants or {RATE, SMOOTHING} & {*of.parameters}) for of in filters),
    )
    return bic(found) + orders * float(np.log(found.numbers)) + rare * found.logs[0].pair.settings.search.clearly_better


def is_late(found: Fit, low_pass: Effect) -> bool:
    """Whether a sensor is late behind its low-pass, whose lag no clock takes back."""
    own_s = next(Design.of(low_pass, theta).lag_s for effect, theta in found.chosen if effect is low_pass)
    lags_s = (sum(sensor_lag_s(*entry, sensor) for entry in found.chosen) for sensor in low_pass.sensors)
    return not any(log.pair.aligned_s for log in found.logs) and min(lags_s, default=0.0) > TAKEN_BACK * own_s


def sensor_lag_s(effect: Effect, theta: Theta, sensor: str) -> float:
    """Lag of one sensor far below any cut-off; of a clock that wanders, its mean."""
    if effect.name in LOW_PASSES:
        return Design.of(effect, theta).lag_s if sensor in effect.sensors else 0.0
    if effect.key == "gyro_delay":
        return float(theta[0]) if sensor == "gyro" else 0.0
    return -float(np.mean(theta)) if effect.name in ("clock_offset", WANDER) else 0.0


def _sensors(chosen: Chosen) -> list[tuple[str, ...]]:
    """Sensors on which low-passes act."""
    return sorted(effect.sensors for effect, _ in chosen if effect.name in LOW_PASSES)


def _allowed(base: Fit, k: int, named: Sequence[Effect]) -> list[Effect]:
    """Effects that may act together with all others but one."""
    others = (*base.chosen[:k], *base.chosen[k + 1 :])
    return [of for of in named if of.name not in LOW_PASSES or not any(exclude_each_other(of, e) for e, _ in others)]


def _forms(base: Fit, k: int, named: Sequence[Effect]) -> Iterator[Chosen]:
    """Effects with another form of a low-pass; a clock offset may share its lag."""
    rate_hz = 1.0 / base.logs[0].pair.period_s if is_simulated(base.logs) else np.inf  # too fast for poses
    (effect, theta), others = base.chosen[k], (*base.chosen[:k], *base.chosen[k + 1 :])
    offset = next((e for e in named if e.name == "clock_offset"), None)
    lag_s, forms = Design.of(effect, theta).lag_s, [of for of in named if of.name in LOW_PASSES]
    for form in forms:
        for start in _starts(form, effect, theta, lag_s, rate_hz):
            yield (*others, start)
    if offset is None or len(effect.sensors) == 1:
        return
    at_s = [float(tau_s[0]) for e, tau_s in others if e.key == offset.key]
    without = tuple(entry for entry in others if entry[0].key != offset.key)
    for form in forms if at_s else [e for e in forms if e.name == LOW_PASSES[0] and e.sensors == effect.sensors]:
        start_s = lag_s - at_s[0] if at_s else 0.5 * lag_s
        for start in _starts(form, form, None, start_s, rate_hz) if start_s > 0.0 else ():
            yield (*without, start) if at_s else (*others, start, (offset, np.array([-start_s])))


def _starts(other: Effect, effect: Effect, theta: Theta | None, lag_s: float, rate_hz: float) -> list[tuple[Effect, Theta]]:
    """A low-pass with a lag: analog if it is another one than the fitted, digital, and as smoothing."""
    damping = [BUTTERWORTH][: len(other.parameters) - 1]
    at_rate = [digital(other), *([] if other.constants else [exponential(other)])] if np.isfinite(rate_hz) else []
    starts = [(of, np.array([cutoff_hz(of, [*damping, rate_hz], lag_s), *damping, rate_hz])) for of in at_rate]
    if theta is not None and other.key == effect.key:
        return starts
    return [(other, np.array([cutoff_hz(other, damping, lag_s), *damping])), *starts]


def cutoff_hz(of: Effect, others: Sequence[float], lag_s: float) -> float:
    """Cut-off with which a low-pass has a lag: the analog one's if a filter at a rate has less."""

    def longer_s(log_hz: float) -> float:
        return Design.of(of, np.array([np.exp(log_hz), *others])).lag_s - lag_s

    analog_hz = Design.of(of, np.array([1.0, *others])).lag_s / lag_s
    margin, maximum = np.log(analog_hz) - 3.0, np.log(analog_hz) + 1.0
    return float(np.exp(brentq(longer_s, margin, maximum))) if longer_s(margin) > 0.0 > longer_s(maximum) else analog_hz


def _of_each_sensor(base: Fit, k: int, named: Sequence[Effect]) -> Chosen:
    """Effects with a low-pass for each sensor in the place of one for both; none without."""
    effect, theta = base.chosen[k]
    each = tuple((of, theta) for of in named if of.name == effect.name and len(of.sensors) < len(effect.sensors))
    return (*base.chosen[:k], *each, *base.chosen[k + 1 :]) if each and not effect.constants else ()


def taken(found: Fit, k: int) -> float:
    """White squares of what an effect changes."""
    others, total = (*found.chosen[:k], *found.chosen[k + 1 :]), 0.0
    for log in found.logs:
        changed = log.whiten(expected(log.pair, found.chosen) - expected(log.pair, others))
        total += float((changed[log.rows(found.part)] ** 2).sum())
    return total


def is_shown(found: Fit) -> bool:
    """Whether the logs show all low-passes.

    A digital one that is slower than the samples would give them twice.
    """
    filters = [entry for entry in found.chosen if entry[0].name in LOW_PASSES]
    designs = [Design.of(*entry) for entry in filters]
    slowest_hz = min((min(design.rate_hz, design.smoothing_hz) for design in designs), default=np.inf)
    folds = slowest_hz * found.logs[0].pair.period_s < SLOWEST
    return not folds and not any(beyond_the_band(*entry, found.logs) for entry in filters)
