"""Filters of one sensor or of each, with a clock offset or without one, for other lags."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations, product

import numpy as np

from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import Chosen
from imutool.diagnosis.estimation.observability import LOW_PASSES, WANDER
from imutool.diagnosis.estimation.trial.filter_forms import (
    cutoff_hz,
    form_bic,
    is_shown,
    is_simulated,
    model_error,
    sensor_lag_s,
    taken,
    with_own_forms,
)
from imutool.sensor.effect import Effect
from imutool.sensor.effects.second_order_low_pass import BUTTERWORTH
from imutool.units import SENSORS

OFFSET = "clock_offset"
LAGS = (*LOW_PASSES, OFFSET, "gyro_delay")
LAGS_BY_POSES = (*LAGS, WANDER, "reference_smoothing")  # each takes a part of a filter
MIN_LAG_S = 0.003  # of a filter, from where its fit starts
AHEAD = 0.05  # of a sample period: less is no sensor that looks ahead


def with_filter_of_each_sensor(base: Fit, named: Sequence[Effect]) -> Fit:
    """Fit with a low-pass of one sensor, or of each, for other lags, if better (BIC).

    Chips filter gyro and accelerometer each in its own way. The search finds the larger filter on both sensors, or a clock
    that follows the slower one. What that leaves has many other names: a gyro ahead of it, a clock that wanders, smoothed
    poses, scales.
    """
    logs, exact = base.logs, is_simulated(base.logs)
    if not exact and not all(isinstance(log.pair, Pair) and log.pair.band_hz is not None for log in logs):
        return base
    lags = [k for k, (effect, _) in enumerate(base.chosen) if effect.name in (LAGS if exact else LAGS_BY_POSES)]
    if not lags or (exact and len(lags) == 1 and base.keys[lags[0]] != "gyro_delay"):  # a form of its own is tried before
        return base
    trials = list[Fit]()
    for chosen in _with_filters(base, lags, {of.key: of for of in named}, LOW_PASSES[exact]):
        trials.append(fit(logs, chosen, near=base, give_up_above=min(map(form_bic, trials), default=np.inf)))
    best = with_own_forms(min(filter(is_shown, trials), key=form_bic, default=base), named)
    margin = logs[0].pair.settings.search.clearly_better
    if not exact:
        margin *= max(1.0, base.reduced_chi_square)
    elif len(best.prior) < len(base.prior) or min(_lags_s(base, lags).values()) < -AHEAD * logs[0].pair.period_s:
        margin = 0.0  # simpler; and no filter is ahead, but a clock may be
    else:
        margin = max(margin, model_error(logs) * sum(taken(base, k) for k in lags if base.chosen[k][0].name in LOW_PASSES))
    return best if form_bic(best) < form_bic(base) - margin else base


def _lags_s(base: Fit, lags: Sequence[int]) -> dict[str, float]:
    """Lag of each sensor by some effects of a fit."""
    return {sensor: sum(sensor_lag_s(*base.chosen[k], sensor) for k in lags) for sensor in SENSORS}


def _with_filters(base: Fit, lags: Sequence[int], named: Mapping[str, Effect], order: str) -> Iterator[Chosen]:
    """Effects with filters of one sensor or of each, and with a clock offset or none, for those that lag."""
    others, lag_s = tuple(entry for k, entry in enumerate(base.chosen) if k not in lags), _lags_s(base, lags)
    damping = [BUTTERWORTH][: LOW_PASSES.index(order)]
    for sensors, with_clock in product((SENSORS, *combinations(SENSORS, 1)), (True, False)):
        filters = [named.get(f"{order}:{sensor}") for sensor in sensors]
        rest = [lag_s[sensor] for sensor in SENSORS if sensor not in sensors] or [0.5 * min(lag_s.values())]
        clock_s = rest[0] if with_clock else 0.0
        own_s = [max(lag_s[sensor] - clock_s, MIN_LAG_S) for sensor in sensors]
        clock = [(named[OFFSET], np.array([-clock_s]))] if with_clock and OFFSET in named else []
        each = [(of, np.array([cutoff_hz(of, damping, s), *damping])) for of, s in zip(filters, own_s, strict=True) if of]
        if len(each) == len(sensors) and len(clock) == with_clock:
            yield (*others, *clock, *each)
