"""Forms of filters: a low-pass beside a clock offset, or digital; a resonance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.observability import LOW_PASSES, beyond_the_band, exclude_each_other
from imutool.diagnosis.estimation.significance import bic
from imutool.diagnosis.estimation.trial.effect_forms import digital, exponential
from imutool.diagnosis.estimation.whitening import WhitenedLog
from imutool.diagnosis.settings import SearchSettings
from imutool.sensor.effect import Effect, Theta
from imutool.sensor.effects.low_pass import RATE, SMOOTHING, Design
from imutool.sensor.effects.second_order_low_pass import BUTTERWORTH

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


def without_unseen_low_pass(logs: Sequence[WhitenedLog], now: Fit, named: Sequence[Effect], settings: SearchSettings) -> Fit:
    """Fit with a clock offset for a low pass beyond the poses' band, which its delay shows."""
    offset = next((e for e in named if e.name == "clock_offset" and e.key not in now.keys), None)
    for k, (effect, theta) in enumerate(now.chosen):
        if offset is not None and effect.name in LOW_PASSES and beyond_the_band(effect, theta, logs, settings):
            delayed = offset, np.array([-Design.of(effect, theta).lag_s])  # far below its cut-off
            return fit(logs, (*now.chosen[:k], *now.chosen[k + 1 :], delayed), near=now)
    return now


def with_form_of_low_pass(logs: Sequence[WhitenedLog], now: Fit, named: Sequence[Effect]) -> Fit:
    """Fit with another form of a low-pass that is clearly better (BIC).

    Forms are its order, a digital filter, and filters of one sensor or of each by itself.
    A digital one begins at the rate of the samples. Near half of that rate it takes far more than an analog one, and a filter
    of another form would leave its error to other effects. Poses do not know so fast a motion. Where the simulation itself errs
    (its noise was filtered, it folds vibrations), a filter of other sensors has to explain more than that.
    """
    if not all(isinstance(log.pair, Pair) and log.pair.exact for log in logs):
        return now
    settings, period_s = logs[0].pair.settings.search, logs[0].pair.period_s
    error = settings.model_error_denoised if any(log.pair.denoised for log in logs) else settings.model_error
    for k, (effect, _) in enumerate(now.chosen):
        if effect.name not in LOW_PASSES or {RATE, SMOOTHING} & {*effect.parameters}:
            continue
        errs, best = error * _taken(now, k), now
        for chosen in _forms(now, k, named, 1.0 / period_s):
            least = settings.clearly_better if _sensors(chosen) == _sensors(now.chosen) else max(settings.clearly_better, errs)
            trial = fit(logs, chosen, near=now, give_up_above=bic(best) - least)
            if bic(trial) < min(bic(best), bic(now) - least) and not _folds(trial, period_s):
                best = trial
        if best is not now:
            return with_form_of_low_pass(logs, best, named)
        two = _of_each_sensor(now, k, named)
        trial = fit(logs, two, near=now) if two else now
        if bic(trial) < bic(now) - settings.model_error_low_pass / error * max(settings.clearly_better, errs):
            return with_form_of_low_pass(logs, trial, named)
    return now


def with_form_of_resonance(logs: Sequence[WhitenedLog], now: Fit, named: Sequence[Effect]) -> Fit:
    """Fit with a resonance whose damper is elsewhere, where that is clearly better (BIC)."""
    if not all(log.pair.exact for log in logs):
        return now
    for k, (effect, theta) in enumerate(now.chosen):
        for other in [one for one in named if one.name == effect.name == "mount_resonance" and one.key != effect.key]:
            trial = fit(logs, (*now.chosen[:k], (other, theta), *now.chosen[k + 1 :]), near=now, give_up_above=now.objective)
            if bic(trial) < bic(now) - logs[0].pair.settings.search.clearly_better:
                return trial
    return now


def with_delay_of_accel(logs: Sequence[WhitenedLog], now: Fit, named: Sequence[Effect]) -> Fit:
    """Fit with a delay of the accelerometer for a low-pass of it that is clearly worse (BIC).

    A late accelerometer is a clock that is late, and a gyro that is ahead of it. One alone of these two explains little, so
    that the search finds the filter of this lag.
    """
    both = [of for name in ("clock_offset", "gyro_delay") for of in named if of.name == name and of.key not in now.keys]
    for k, (effect, theta) in enumerate(now.chosen):
        if len(both) == 2 and effect.name in LOW_PASSES and effect.sensors == ("accel",):
            start = np.array([-Design.of(effect, theta).lag_s])
            late = (*now.chosen[:k], *now.chosen[k + 1 :], *((of, start) for of in both))
            least = bic(now) - logs[0].pair.settings.search.clearly_better
            trial = fit(logs, late, near=now, give_up_above=now.objective)
            return trial if bic(trial) < least else now
    return now


def _sensors(chosen: Chosen) -> list[tuple[str, ...]]:
    """Sensors on which low-passes act."""
    return sorted(effect.sensors for effect, _ in chosen if effect.name in LOW_PASSES)


def _forms(now: Fit, k: int, named: Sequence[Effect], rate_hz: float) -> Iterator[Chosen]:
    """Effects with another form of a low-pass; a clock offset may share its lag."""
    (effect, theta), others = now.chosen[k], (*now.chosen[:k], *now.chosen[k + 1 :])
    offset = next((one for one in named if one.name == "clock_offset"), None)
    lag_s = Design.of(effect, theta).lag_s
    forms = [of for of in named if of.name in LOW_PASSES and not any(exclude_each_other(of, one) for one, _ in others)]
    for form in forms:
        for start in _starts(form, effect, theta, lag_s, rate_hz):
            yield (*others, start)
    if offset is None or len(effect.sensors) == 1:
        return
    at_s = [float(tau_s[0]) for one, tau_s in others if one.key == offset.key]
    without = tuple(entry for entry in others if entry[0].key != offset.key)
    for form in forms if at_s else [one for one in forms if one.name == LOW_PASSES[0] and one.sensors == effect.sensors]:
        start_s = lag_s - at_s[0] if at_s else 0.5 * lag_s
        for start in _starts(form, form, None, start_s, rate_hz) if start_s > 0.0 else ():
            yield (*without, start) if at_s else (*others, start, (offset, np.array([-start_s])))


def _starts(other: Effect, effect: Effect, theta: Theta | None, lag_s: float, rate_hz: float) -> list[tuple[Effect, Theta]]:
    """A low-pass with a lag: analog if it is another one than the fitted, digital, and of first order as smoothing."""
    cutoff_hz = Design.of(other, np.array([1.0, BUTTERWORTH])[: len(other.parameters)]).lag_s / lag_s
    start = [cutoff_hz, BUTTERWORTH][: len(other.parameters)]
    if theta is not None and (other.name, other.constants) == (effect.name, effect.constants):
        start = theta.tolist()
    analog = [] if theta is not None and other.key == effect.key else [(other, np.array(start))]
    at_rate = np.array([*start, rate_hz])
    smoothing = [(exponential(other), at_rate)] if other.name == LOW_PASSES[0] and not other.constants else []
    return [*analog, (digital(other), at_rate), *smoothing]


def _of_each_sensor(now: Fit, k: int, named: Sequence[Effect]) -> Chosen:
    """Effects with a low-pass for each sensor in the place of one for both; none without."""
    effect, theta = now.chosen[k]
    each = tuple((of, theta) for of in named if of.name == effect.name and len(of.sensors) < len(effect.sensors))
    return (*now.chosen[:k], *each, *now.chosen[k + 1 :]) if each and not effect.constants else ()


def _taken(found: Fit, k: int) -> float:
    """White squares of what an effect changes."""
    others, total = (*found.chosen[:k], *found.chosen[k + 1 :]), 0.0
    for log in found.logs:
        changed = log.whiten(expected(log.pair, found.chosen) - expected(log.pair, others))
        total += float((changed[log.rows(found.part)] ** 2).sum())
    return total


def _folds(found: Fit, period_s: float) -> bool:
    """Whether a digital filter is slower than the samples, which it would give twice."""
    slowest = (
        value
        for effect, theta in found.chosen
        for p, value in zip(effect.parameters, theta, strict=True)
        if p in (RATE, SMOOTHING)
    )
    return min(slowest, default=np.inf) * period_s < SLOWEST
