"""What the motion of some logs can show of the catalogue at all: what would drown in the noise even if it were there.

A number of an effect that is as large as is plausible adds some squares to the white residuals, less what a constant bias would
take of them. Where those are fewer than a search asks of a finding, the number cannot be seen, and nothing is said of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Float64

from imutool.diagnosis.estimation.gauss_newton import WhitenedLog, expected
from imutool.sensor.effect import Effect

ENOUGH = 36.0  # squares: six standard deviations, as what is tried some thousand times has to be
SMALL = 1e-2  # of the plausible size, at which an effect is still proportional to it
BEHIND: Mapping[str, tuple[str, ...]] = {"clock_offset": ("clock_skew", "clock_jump", "low_pass", "mount_resonance")}
"""What delays, swings or jumps needs the motion that shows a delay."""


def unobservable(logs: Sequence[WhitenedLog], candidates: Sequence[Effect]) -> tuple[str, ...]:
    """`effect.parameter` of what cannot be seen, and `effect` where that is all of it."""
    out: list[str] = []
    for physics in candidates:
        if not _asked(physics):
            continue
        hidden = [number.name for number, gain in zip(physics.parameters, _gains(logs, physics), strict=True) if gain < ENOUGH]
        if len(hidden) == len(physics.parameters):
            out += [physics.name, *_behind(physics, candidates)]
        else:
            out += [f"{physics.name}.{name}" for name in hidden]
    return tuple(dict.fromkeys(out))


def _asked(physics: Effect) -> bool:
    """What is proportional to its numbers near nothing."""
    return bool(np.isfinite(physics.null_value).all()) and not any(n.positive or n.begins for n in physics.parameters)


def _behind(physics: Effect, candidates: Sequence[Effect]) -> Iterator[str]:
    there = {one.name for one in candidates}
    return (name for name in BEHIND.get(physics.name, ()) if name in there)


def _gains(logs: Sequence[WhitenedLog], physics: Effect) -> Float64[np.ndarray, " p"]:
    """Squares that each number adds at its plausible size, less those of the constant that hides most of it."""
    total = np.zeros(len(physics.parameters))
    for log in logs:
        rows, nothing = log.rows("all"), expected(log.pair, ())
        added = [expected(log.pair, ((physics, theta),)) - nothing for theta in np.diag(SMALL * physics.plausible)]
        B = log.whiten(np.stack(added, axis=2))[rows] / SMALL
        one = log.whiten(np.ones_like(log.pair.real))[rows]
        cross = np.einsum("na,nap->ap", one, B)
        total += (B**2).sum(axis=(0, 1)) - (cross**2 / np.maximum((one**2).sum(axis=0), 1e-300)[:, None]).sum(axis=0)
    return total
