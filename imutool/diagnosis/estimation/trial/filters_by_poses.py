"""Filters of one sensor that poses show, together with a clock offset or without one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations, product

import numpy as np

from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import Chosen
from imutool.diagnosis.estimation.observability import LOW_PASSES, WANDER, beyond_the_band
from imutool.diagnosis.estimation.significance import bic
from imutool.diagnosis.estimation.trial.filter_forms import sensor_lag_s
from imutool.sensor.effect import Effect
from imutool.sensor.effects.low_pass import Design
from imutool.sensor.effects.second_order_low_pass import BUTTERWORTH
from imutool.units import SENSORS

OFFSET = "clock_offset"
LAGS_BY_POSES = (*LOW_PASSES, OFFSET, "gyro_delay", WANDER, "reference_smoothing")  # each takes a part of a filter
MIN_LAG_S = 0.003  # of a filter, from where its fit starts


def with_filters_by_poses(base: Fit, named: Sequence[Effect]) -> Fit:
    """Fit with a low-pass of one sensor, or of each, for other lags next to poses.

    It has to be clearly better (BIC).

    A clock that follows the slower sensor explains most of its lag, and is found first. What it leaves has many other names: a
    gyro ahead of it, a clock that wanders, smoothed poses, scales.
    """
    logs = base.logs
    lags = [k for k, (effect, _) in enumerate(base.chosen) if effect.name in LAGS_BY_POSES]
    if not lags or not all(isinstance(log.pair, Pair) and log.pair.band_hz is not None for log in logs):
        return base
    of_key = {of.key: of for of in named}
    first = min((fit(logs, chosen, near=base) for chosen in _first_order(base, lags, of_key)), key=bic, default=base)
    trials = [first, *(fit(logs, chosen, near=base, give_up_above=bic(base)) for chosen in _second_order(first, of_key))]
    best = min((trial for trial in trials if _is_shown(trial)), key=bic, default=base)
    margin = logs[0].pair.settings.search.clearly_better * max(1.0, base.reduced_chi_square)
    return best if bic(best) < bic(base) - margin else base


def _is_shown(found: Fit) -> bool:
    """Whether the poses can show all filters of a fit."""
    return not any(beyond_the_band(*entry, found.logs) for entry in found.chosen if entry[0].name in LOW_PASSES)


def _first_order(base: Fit, lags: Sequence[int], named: Mapping[str, Effect]) -> Iterator[Chosen]:
    """Effects with filters of one sensor or of each, and with a clock offset or none, for those that lag."""
    others = tuple(entry for k, entry in enumerate(base.chosen) if k not in lags)
    lag_s = {sensor: sum(sensor_lag_s(*base.chosen[k], sensor) for k in lags) for sensor in SENSORS}
    for sensors, with_clock in product((*combinations(SENSORS, 1), SENSORS), (True, False)):
        keys = [f"{LOW_PASSES[0]}:{sensor}" for sensor in sensors]
        if not {*keys, *([OFFSET] if with_clock else [])} <= named.keys():
            continue
        rest = [lag_s[sensor] for sensor in SENSORS if sensor not in sensors] or [0.5 * min(lag_s.values())]
        clock_s = rest[0] if with_clock else 0.0
        own_s = [max(lag_s[sensor] - clock_s, MIN_LAG_S) for sensor in sensors]
        filters = [(named[key], np.array([0.5 / (np.pi * each_s)])) for key, each_s in zip(keys, own_s, strict=True)]
        yield (*others, *([(named[OFFSET], np.array([-clock_s]))] if with_clock else []), *filters)


def _second_order(first: Fit, named: Mapping[str, Effect]) -> Iterator[Chosen]:
    """Effects with filters of second order in the place of one or all of first order."""
    places = [k for k, (effect, _) in enumerate(first.chosen) if effect.name == LOW_PASSES[0] and effect.variant in SENSORS]
    for count in range(1, len(places) + 1):
        for some in combinations(places, count):
            chosen = list(first.chosen)
            for k in some:
                effect, theta = chosen[k]
                other = named[f"{LOW_PASSES[1]}:{effect.variant}"]
                chosen[k] = other, np.array([BUTTERWORTH / (np.pi * Design.of(effect, theta).lag_s), BUTTERWORTH])
            yield tuple(chosen)
