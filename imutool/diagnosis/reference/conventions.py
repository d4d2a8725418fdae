"""Units and axes in which a recording and its reference, a simulation or true poses, differ.

A unit or an order of axes is a convention, not physics: no effect of the catalogue is as large, and each would stand for it
badly (an accelerometer in g looks like a gravity that is too small). So both are looked for first, as `imutool audit` does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from imutool.array_types import Vectors
from imutool.cleaning.rules.axes import TO_Z_UP
from imutool.diagnosis.audit.axes import Hypotheses, Matrix
from imutool.diagnosis.audit.motion import OTHER_UNIT
from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.jacobians import expected
from imutool.diagnosis.result import Estimate, Finding, HeldOut
from imutool.units import ASCII_UNITS, AXES, COLUMNS, SENSORS, Sensor

EXPLAINED = 0.03  # of the motion's squares: a convention leaves less, unless the mount is turned by 10 degrees besides
EXPLAINED_AS_OTHER = 0.3  # likewise, if the other sensor shows the same axes: a large lever arm is left next to a convention
UNLIKE = 0.1  # loss of correlation with the motion that another order of axes may bring: at rest no order correlates
CONSTANT = 0.1  # of the squares of the specific force: a bias and a tilt leave less of them, a wrong convention most of gravity


def with_common_conventions(pairs: Sequence[Pair], of: str = "simulation") -> tuple[list[Pair], list[Finding]]:
    """Recordings in the units and axes of a reference, `of` by name; findings of what differs."""
    shown: dict[Sensor, _Convention] = {}
    for sensor in SENSORS:
        part = COLUMNS[sensor]
        rows = [pair.usable[:, part].all(axis=1) for pair in pairs]
        y, x = (
            np.concatenate([values[:, part][row] for values, row in zip(each, rows, strict=True)])
            for each in ([pair.real for pair in pairs], [expected(pair, ()) for pair in pairs])
        )
        shown[sensor] = _convention(sensor, y, x)
    changes = {sensor: own.beside(*(other for other in shown.values() if other is not own)) for sensor, own in shown.items()}
    if all(factor == 1.0 and np.array_equal(P, np.eye(3)) for factor, P in changes.values()):
        return [*map(_with_z_up, pairs)], []
    after = [_with_z_up(_converted(pair, changes)) for pair in pairs]
    return after, _findings(pairs, after, changes, of)


def _with_z_up(pair: Pair) -> Pair:
    """Pair in a world whose z is up, if both logs read gravity along -z: its change would have the other sign."""
    read, R_wb = pair.ideal.sample(pair.stamp_s, pair.stamp_s), pair.ideal.R_wb
    if R_wb is None or read.at.R_wb is None:
        return pair
    up = [float((read.at.R_wb[:, 2] * force).sum()) for force in (read.accel, pair.real[:, 3:])]
    return replace(pair, ideal=replace(pair.ideal, R_wb=TO_Z_UP["-z"] @ R_wb)) if max(up) < 0.0 else pair


class _Convention(NamedTuple):
    """Factor and axes P with factor y P = x as far as the motion shows them, and what they leave."""

    factor: float
    P: Matrix
    misfit: float  # share of the squares
    needed: bool  # the reference's axes leave too much for a turned mount

    def beside(self, other: _Convention) -> tuple[float, Matrix]:
        """Factor and axes, if they explain the motion; less of it where the other sensor shows the same axes."""
        alike = other.misfit < EXPLAINED and np.array_equal(self.P, other.P)
        if self.misfit > (EXPLAINED_AS_OTHER if alike else EXPLAINED):
            return 1.0, np.eye(3)
        return self.factor, self.P if self.needed or (alike and other.needed) else np.eye(3)


def _convention(sensor: Sensor, y: Vectors, x: Vectors) -> _Convention:
    """Convention that the motion shows best; the same as the reference if gravity or the correlation contradicts it."""
    same = _Convention(1.0, np.eye(3), np.inf, needed=False)
    if len(y) == 0 or not y.any():
        return same
    like = Hypotheses({"reference": x[:, :, None]}, free_bias=sensor == "gyro", turns=False)
    other = OTHER_UNIT[sensor]
    factor = next((by for by in (other, 1.0 / other) if like.unit(y, by) != 1.0), 1.0)
    _, P = like.frame(y * factor)
    turned = y @ P
    misfit = factor * turned - x
    size = max(float((x**2).mean(axis=0).sum()), np.finfo(np.float64).tiny)
    shown = sensor == "gyro" or float((misfit.mean(axis=0) ** 2).sum()) < CONSTANT * size
    shown &= _correlation(turned, x) > _correlation(y, x) - UNLIKE
    needed = float((factor * y - x).var(axis=0).sum()) > EXPLAINED * float(x.var(axis=0).sum())
    return _Convention(factor, P, float(misfit.var(axis=0).sum()) / size, needed) if shown else same


def _correlation(y: Vectors, x: Vectors) -> float:
    """Correlation of all axes together."""
    y, x = y - y.mean(axis=0), x - x.mean(axis=0)
    return float((y * x).sum() / max(np.sqrt((y**2).sum() * (x**2).sum()), np.finfo(np.float64).tiny))


def _converted(pair: Pair, changes: dict[Sensor, tuple[float, Matrix]]) -> Pair:
    turn = np.zeros((6, 6))
    for sensor, (factor, P) in changes.items():
        turn[COLUMNS[sensor], COLUMNS[sensor]] = factor * P
    known = None if pair.known is None else np.asarray(pair.known.astype(float) @ (turn != 0.0) > 0.5)
    return replace(pair, real=np.asfortranarray(pair.real @ turn), known=known)


def _findings(
    before: Sequence[Pair], after: Sequence[Pair], changes: dict[Sensor, tuple[float, Matrix]], of: str
) -> list[Finding]:
    found = []
    for sensor, (factor, _) in changes.items():
        if factor != 1.0:
            scale = {"scale": Estimate(1.0 / factor, 0.0, "-")}
            text = f"{sensor} = {1.0 / factor:.6g} {sensor} of the {of}"
            found.append(_finding("wrong_unit", sensor, sensor, scale, text, before, after))
    turned = {sensor: P for sensor, (_, P) in changes.items() if not np.array_equal(P, np.eye(3))}
    alike = len({P.tobytes() for P in turned.values()}) == 1 and len(turned) == len(SENSORS)
    for sensor, P in turned.items():
        if not alike or sensor == SENSORS[0]:
            name = "left_handed" if np.linalg.det(P) < 0.0 else "permuted_axes"
            axes = ", ".join(("-" if row.sum() < 0.0 else "") + AXES[int(np.abs(row).argmax())] for row in P)
            text = f"recorded x, y, z = {axes} of the {of}"
            found.append(_finding(name, "both" if alike else sensor, sensor, {}, text, before, after))
    return found


def _finding(
    name: str,
    signal: str,
    sensor: Sensor,
    parameters: dict[str, Estimate],
    equation: str,
    before: Sequence[Pair],
    after: Sequence[Pair],
) -> Finding:
    """Finding with what the convention alone removes of the samples on held-out time, all axes together."""
    part = COLUMNS[sensor]

    def rms(pairs: Sequence[Pair]) -> float:
        residuals = [(pair.real - expected(pair, ()))[pair.held_out, part] for pair in pairs]
        return float(np.sqrt(np.mean(np.concatenate(residuals) ** 2)))

    was, is_now = rms(before), rms(after)
    seconds = round(sum(float(pair.held_out.sum()) * pair.period_s for pair in before), 1)
    share = 1.0 - (is_now / was) ** 2 if was > 0.0 else 0.0
    return Finding(name, signal, share, 0.0, 0.0, parameters, equation, HeldOut(was, is_now, ASCII_UNITS[sensor], seconds))
