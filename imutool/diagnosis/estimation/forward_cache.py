"""The course of signals through some effects, remembered before each: what one changes is worked out behind it alone.

Derivatives are differences of the effects' own forward models, so that an effect is one function and nothing else.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from imutool.diagnosis.estimation.alignment import Pair
from imutool.sensor.effect import Effect, Parameter, SignalState, Stage, Theta, in_stage_order, stage_order

STEP, LOG_STEP = 1e-3, 1e-3

Chosen = tuple[tuple[Effect, Theta], ...]


class ForwardPass:
    """A log's ideal signals on their way to its readings; what is the same as on another course is taken from there."""

    def __init__(self, pair: Pair, chosen: Chosen, like: ForwardPass | None = None) -> None:
        self.pair, self.acting = pair, in_stage_order(chosen)
        same = 0 if like is None else _shared(self.acting, like.acting)
        begun = [SignalState(pair.felt, pair.stamp_s, pair.stamp_s)]
        self._ways: list[SignalState] = begun if like is None else like._ways[: same + 1]
        for physics, theta in self.acting[same:]:
            if physics.stage > Stage.CLOCK:
                self._ways[-1] = self._ways[-1].sampled()
            self._ways.append(self._ways[-1].through(physics, theta))
        self.read = self._ways[-1].samples()

    @property
    def expected(self) -> Float64[np.ndarray, "n 6"]:
        """What the sensor would read, without bias."""
        return np.concatenate([self.read.gyro, self.read.accel], axis=1)

    def added(self, to: ForwardPass) -> dict[int, Float64[np.ndarray, " n"]]:
        """What it makes the sensor read more than on another course, by axis; where that is nothing there is no such axis."""
        both = ((0, self.read.gyro, to.read.gyro), (3, self.read.accel, to.read.accel))
        rows = {first + k: row for first, here, there in both if here is not there for k, row in enumerate((here - there).T)}
        return {axis: row for axis, row in rows.items() if row.any()}

    def slope(self, physics: Effect) -> Iterator[tuple[int, int, Float64[np.ndarray, " n"]]]:
        """d expected / d (free parameters) of an effect, by forward differences: axis, parameter, and a row that is not zero.

        An effect that is not on the course is taken to be there, doing nothing, for which it has to be linear.
        """
        place = next((k for k, (one, _) in enumerate(self.acting) if one is physics), None)
        if place is None:
            place = bisect([stage_order(one) for one, _ in self.acting], stage_order(physics))
            theta, behind = physics.null_value.astype(float), self.acting[place:]
        else:
            theta, behind = self.acting[place][1], self.acting[place + 1 :]
        if physics.stage > Stage.CLOCK:
            self._ways[place] = self._ways[place].sampled()
        x, begun = free(physics, theta), self._ways[place]
        for j, number in enumerate(physics.parameters):
            h = step_of(number)
            moved = x.copy()
            moved[j] += h
            way = begun.through(physics, bound(physics, moved))
            for other, values in behind:
                way = way.through(other, values)
            there = way.samples()
            for first, then, now in ((0, there.gyro, self.read.gyro), (3, there.accel, self.read.accel)):
                if then is not now:
                    rows = ((then - now) / h).T
                    yield from ((first + k, j, row) for k, row in enumerate(rows) if row.any())


def _shared(a: list[tuple[Effect, Theta]], b: list[tuple[Effect, Theta]]) -> int:
    """How many effects two courses begin with alike."""
    count = 0
    for (one, theta), (other, same) in zip(a, b, strict=False):
        if one is not other or not np.array_equal(theta, same):
            break
        count += 1
    return count


def free(physics: Effect, theta: Theta) -> Theta:
    """Parameters as they are fitted: logarithms of the positive ones."""
    return np.array([np.log(t) if n.positive else t for t, n in zip(theta, physics.parameters, strict=True)])


def bound(physics: Effect, x: Theta) -> Theta:
    """Back from there."""
    return np.array([np.exp(np.clip(v, -50, 50)) if n.positive else v for v, n in zip(x, physics.parameters, strict=True)])


def step_of(number: Parameter) -> float:
    """For differences."""
    if number.step is not None:
        return number.step
    return LOG_STEP if number.positive else STEP * number.plausible
