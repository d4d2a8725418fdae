"""Derivatives of the white samples of logs by the parameters of the effects that they are fitted with.

They are what a fit costs: an evaluation for each parameter and log. So they are kept by effect, and only what is not known is
worked out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from imutool.diagnosis.estimation.forward_cache import Chosen, ForwardPass
from imutool.diagnosis.estimation.whitening import Whitener
from imutool.sensor.effect import Effect, Theta


class EffectJacobian(NamedTuple):
    """Of one effect on one log, by axis and parameter; `on` says which of them are anything but zero."""

    white: Float64[np.ndarray, "6 p n"]
    on: Bool[np.ndarray, "6 p"]


def effect_jacobian(whiten: Whitener, course: ForwardPass, physics: Effect) -> EffectJacobian:
    """Of an effect on a course, or of a linear one that is not."""
    shape = 6, len(physics.parameters)
    white, on = np.zeros((*shape, len(range(0, len(course.pair.stamp_s), whiten.every)))), np.zeros(shape, bool)
    found = list(course.slope(physics))
    if found:
        axes, js = np.array([axis for axis, _, _ in found]), np.array([j for _, j, _ in found])
        white[axes, js], on[axes, js] = whiten.rows(np.stack([row for _, _, row in found]), axes), True
    return EffectJacobian(white, on)


class Jacobians:
    """Of effects together; those that are `known` from elsewhere are taken as they are, the very same effect there and here."""

    def __init__(
        self, whiteners: Sequence[Whitener], courses: Sequence[ForwardPass], chosen: Chosen, known: Jacobians | None = None
    ) -> None:
        theirs: dict[int, tuple[EffectJacobian, ...]] = {} if known is None else known._by_effect
        self.fresh = not any(id(physics) in theirs for physics, _ in chosen)
        self.chosen = chosen
        self._by_effect: dict[int, tuple[EffectJacobian, ...]] = {}
        for physics, _ in chosen:
            there = theirs.get(id(physics))
            mine = (effect_jacobian(whiten, course, physics) for whiten, course in zip(whiteners, courses, strict=True))
            self._by_effect[id(physics)] = tuple(mine) if there is None else there

    def linear(self) -> Jacobians:
        """Of the linear effects alone, which change least from step to step."""
        out = Jacobians((), (), ())
        out.chosen = tuple(one for one in self.chosen if one[0].linear)
        out._by_effect = {id(physics): self._by_effect[id(physics)] for physics, _ in out.chosen}
        return out

    def on_axis(
        self, log: int, axis: int, mask: Bool[np.ndarray, " n"]
    ) -> tuple[Int64[np.ndarray, " q"], Float64[np.ndarray, "q m"]]:
        """Which parameters of all act on an axis of a log, and the derivatives by them there, on some rows."""
        where, rows, first = [np.zeros(0, np.int64)], [], 0
        for slopes in self._by_effect.values():
            one = slopes[log]
            js = np.flatnonzero(one.on[axis])
            where.append(first + js)
            rows += [one.white[axis, j][mask] for j in js]
            first += one.white.shape[1]
        return np.concatenate(where), np.stack(rows) if rows else np.zeros((0, int(mask.sum())))

    def along(self, log: int, axis: int, step: Theta, mask: Bool[np.ndarray, " n"]) -> Float64[np.ndarray, " m"]:
        """By how much they say that white samples of an axis change in a step of all parameters."""
        where, rows = self.on_axis(log, axis, mask)
        return np.asarray(step[where] @ rows)
