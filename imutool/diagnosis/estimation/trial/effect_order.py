"""Errors of a model by the order in which its effects act.

A sensor may scale a reading ahead of a misalignment or behind it, or add both to the true rate. And the one with the errors
may be the simulation: then the inverse effects act on its samples in the reverse order. What another order changes is of second
order in the effects. It moves their sizes, and may look like one more effect.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64
from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.gauss_newton import Fit, direction
from imutool.diagnosis.estimation.jacobians import Chosen, bound_slopes, expected
from imutool.sensor.effect import Effect, SignalState, Stage, Theta, in_stage_order
from imutool.sensor.samples import SensorSamples

READINGS = frozenset(
    f"{sensor}_{kind}" for sensor in ("gyro", "accel") for kind in ("scale", "misalignment", "scale_asymmetry", "quadratic")
) | {"gyro_g_sensitivity"}
INSTANT = READINGS | {"lever_arm", "size_effect", "mount_rotation"}  # of one instant of the motion: any order is thinkable
Readings = Float64[np.ndarray, "_ k"]  # each log has its own rows


def order_squares(found: Fit, effect: Effect) -> float:
    """White squares of what the reverse order of all other effects changes.

    On the sensors of an effect, beyond what the parameters of the others take over.
    """
    others = tuple(entry for entry in found.chosen if entry[0] is not effect)
    pairs = _pairs(found)
    if not pairs or sum(_is_of(INSTANT, other) for other, _ in others) < 2:
        return 0.0
    changed = _Changed.of(found, [_reversed(pair, others) - expected(pair, others) for pair in pairs], effect)
    counted = {column for name in effect.sensors for column in range(pairs[0].columns)[pairs[0].signals[name]]}
    return sum(squares for column, squares in changed.left if column in counted)


def order_std(found: Fit) -> dict[str, Theta]:
    """Deviations of parameters by effects' order: reversed, or each on the true reading."""
    pairs = _pairs(found)
    if not pairs or sum(_is_of(READINGS, effect) for effect, _ in found.chosen) < 2:
        return {}
    variance = np.zeros(len(found.prior))
    for other_order in (_read_reversed, _read_added):
        changes = [other_order(pair, found.chosen) - expected(pair, found.chosen) for pair in pairs]
        variance += _Changed.of(found, changes).taken ** 2
    own = ((effect, np.abs(bound_slopes(effect, theta)), variance[found.place(effect.key)]) for effect, theta in found.chosen)
    return {effect.key: np.sqrt(slopes**2 @ free) for effect, slopes, free in own}


class _Changed(NamedTuple):
    """Changed readings, as the free parameters of a fit take them over, and the white squares left, by column."""

    taken: Theta
    left: list[tuple[int, float]]

    @staticmethod
    def of(found: Fit, changes: list[Readings], but_for: Effect | None = None) -> _Changed:
        """Least squares by the parameters of all effects, or of all but one."""
        N, g, rows = (
            np.diag(found.prior**-2.0),
            np.zeros(len(found.prior)),
            list[tuple[int, np.ndarray, np.ndarray, np.ndarray]](),
        )
        for k, (log, change) in enumerate(zip(found.logs, changes, strict=True)):
            mask = log.rows(found.part)
            for column, d in enumerate(log.whiten(change)[mask].T):
                bias = direction(log.constants[mask, column])
                where, A = found.jacobians.on_axis(k, column, mask)
                A, without_bias = A - np.outer(A @ bias, bias), d - (d @ bias) * bias
                N[where[:, None], where] += A @ A.T
                g[where] += A @ without_bias
                rows.append((column, where, A, without_bias))
        free = np.ones(len(g), bool)
        if but_for is not None:
            free[found.place(but_for.key)] = False
        taken = np.zeros(len(g))
        taken[free] = np.linalg.solve(N[np.ix_(free, free)], g[free])
        return _Changed(taken, [(column, float(((d - taken[where] @ A) ** 2).sum())) for column, where, A, d in rows])


def _pairs(found: Fit) -> list[Pair]:
    """Pairs of a fit; none if it is not of IMUs."""
    pairs = [log.pair for log in found.logs if isinstance(log.pair, Pair)]
    return pairs if len(pairs) == len(found.logs) else []


def _is_of(names: frozenset[str], effect: Effect) -> bool:
    return effect.name in names and not any(parameter.begins for parameter in effect.parameters)


def _reversed(pair: Pair, chosen: Chosen) -> Readings:
    """Expected readings with the effects of one instant in the reverse order, ahead of all others."""
    motion = pair.ideal
    for effect, theta in reversed(in_stage_order(chosen)):
        if _is_of(INSTANT, effect) and effect.stage < Stage.CLOCK:
            motion = effect.forward(motion, theta)
        elif _is_of(INSTANT, effect):
            read = effect.forward(motion.sample(motion.t_s, motion.t_s), theta)
            alpha = motion.alpha + np.gradient(read.gyro - motion.gyro, motion.t_s, axis=0)
            motion = replace(motion, gyro=read.gyro, accel=read.accel, alpha=alpha)
    return expected(replace(pair, ideal=motion), tuple(entry for entry in chosen if not _is_of(INSTANT, entry[0])))


def _read_reversed(pair: Pair, chosen: Chosen) -> Readings:
    samples, readings, behind = _taken(pair, chosen)
    return _behind(pair, samples, [*reversed(readings), *behind])


def _read_added(pair: Pair, chosen: Chosen) -> Readings:
    samples, readings, behind = _taken(pair, chosen)
    each = [effect.forward(samples, theta) for effect, theta in readings]
    gyro, accel = (
        sum((getattr(read, sensor) - ideal for read in each), ideal)
        for sensor, ideal in (("gyro", samples.gyro), ("accel", samples.accel))
    )
    return _behind(pair, samples.with_readings(gyro, accel), behind)


Acting = list[tuple[Effect, Theta]]


def _taken(pair: Pair, chosen: Chosen) -> tuple[SensorSamples, Acting, Acting]:
    """Samples before any effect of the sensor, its effects of readings, and all behind the clock but these."""
    state: SignalState = pair.state()
    readings, behind = Acting(), Acting()
    for effect, theta in in_stage_order(chosen):
        if effect.stage <= Stage.CLOCK:
            state = state.through(effect, theta)
        else:
            (readings if _is_of(READINGS, effect) else behind).append((effect, theta))
    samples: SensorSamples = state.samples()
    return samples, readings, behind


def _behind(pair: Pair, samples: SensorSamples, effects: Acting) -> Readings:
    for effect, theta in effects:
        samples = effect.forward(samples, theta)
    return np.concatenate([block for _, block in pair.blocks(samples)], axis=1)
