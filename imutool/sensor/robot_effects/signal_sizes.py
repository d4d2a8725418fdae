"""Sizes of a signal, from which its effects take their plausible parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.robot_effects.joint_dynamics import Dynamics


@dataclass(frozen=True)
class Scale:
    """Names, units and sizes of a signal's columns."""

    names: tuple[str, ...]  # TOPIC.field
    units: tuple[str, ...]
    size: tuple[float, ...]  # standard deviation
    slope: tuple[float, ...]  # standard deviation, per second
    lag_s: float  # at first sight
    duration_s: float  # of the log
    state: Mapping[str, float]  # standard deviation of each
    dynamics: Dynamics | None = None  # relation of an arm's efforts to its motion, if the simulation showed one

    @property
    def columns(self) -> range:
        """Indices of the columns."""
        return range(len(self.names))

    def effect(
        self,
        name: str,
        columns: tuple[int, ...] | range,
        equation: str,
        parameters: tuple[Parameter, ...],
        forward: Callable[[Any, Theta], Any],
        observable_if: str = "it varies",
        *,
        stage: Stage = Stage.SENSOR,
        starts: list[Theta] | Callable[[Any, Any], Sequence[Theta]] | None = None,
        variant: str = "",
        **more: Any,
    ) -> Effect:
        """Effect on some columns; linear without `starts`."""
        sensors = () if len(self.names) == 1 else tuple(self.names[k] for k in columns)
        label = ",".join([*(sensors if len(columns) < len(self.names) else ()), *([variant] if variant else [])])
        given = starts if starts is None or callable(starts) else lambda ideal, real: starts
        return Effect(
            name, stage, sensors, equation, parameters, observable_if, forward, starts is None, given, variant=label, **more
        )


def moved(values: Any) -> float:
    """Standard deviation of a state, or a tiny number for a constant one."""
    return max(float(np.std(values)), 1e-12)


def delay_of_all(scale: Scale, name: str) -> Effect:
    """A delay of all columns together."""
    step = 0.005 * min(size / slope for size, slope in zip(scale.size, scale.slope, strict=True))
    starts = [np.zeros(1)] if abs(scale.lag_s) < 1e-9 else [np.zeros(1), np.array([scale.lag_s])]
    text, needs = "y(t) = x(t - delay)", "it moves"
    number = (Parameter("delay", "s", max(0.2, abs(scale.lag_s)), step=step),)
    return scale.effect(name, scale.columns, text, number, late, needs, stage=Stage.CLOCK, starts=starts)


def late(taken_s: np.ndarray, theta: Theta) -> np.ndarray:
    """When the samples were taken, of a delay."""
    return np.asarray(taken_s - theta[0])
