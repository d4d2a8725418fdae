"""A recording and a simulation of different motions: each is diagnosed against its own truth, and the answers are compared.

An effect that both have, alike to within what the two are sure of, is no difference. One that both have in different sizes is
told with the recording's numbers; one that only the simulation has is told as a remark, since no recording shows it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from imutool.diagnosis.quantity import grouped
from imutool.diagnosis.result import Curve, Estimate, Finding

ALIKE_STD = 3.0  # parameters this many joint standard deviations apart are two values,
ALIKE_SHARE = 0.03  # unless they are within this of the largest: smoothed poses lack a per cent of either motion
ANOTHER_MOTION = "the simulation is of another motion; each was compared with its own true poses"


def shared(here: Finding, known: Sequence[Finding]) -> bool:
    """Whether the simulation has the same effect with the same numbers."""
    there = _twin(here, known)
    return there is not None and _alike(here, there)


def remarks(here: Sequence[Finding], known: Sequence[Finding]) -> Iterator[str]:
    """What the simulation has of its own: alike, in another size, or alone."""
    seen = []
    for one in here:
        there = _twin(one, known)
        if there is None:
            continue
        seen.append(there)
        if _alike(one, there):
            yield f"{_words(one)}: the simulation has it alike, so it is not among the findings"
        else:
            yield f"{_words(one)}: the simulation has it too, as {_numbers(there)}"
    for there in known:
        if there not in seen:
            yield f"{_words(there)}: the simulation has it ({_numbers(there)}), the recording does not show it"


def _twin(here: Finding, known: Sequence[Finding]) -> Finding | None:
    """The simulation's finding of the same effect on the same signal, by the same driver."""
    return next((one for one in known if _key(one) == _key(here)), None)


def _key(one: Finding) -> tuple[str, ...]:
    variable = "" if one.curve is None else one.curve.variable
    return one.effect, one.signal, one.driver, variable, one.equation if one.effect == "unknown" and not variable else ""


def _alike(here: Finding, there: Finding) -> bool:
    if here.curve is not None and there.curve is not None:
        return _same_curve(here.curve, there.curve)
    return _same_numbers(here.parameters, there.parameters)


def _same_numbers(here: Mapping[str, Estimate], there: Mapping[str, Estimate]) -> bool:
    """A number that only one side could see says nothing."""
    both = [(here[name], there[name]) for name in here.keys() & there.keys()]
    largest = {a.unit: max(abs(one.value) for pair in both for one in pair if one.unit == a.unit) for a, _ in both}
    return bool(both) and all(
        abs(a.value - b.value) <= max(ALIKE_STD * np.hypot(a.std, b.std), ALIKE_SHARE * largest[a.unit]) for a, b in both
    )


def _same_curve(here: Curve, there: Curve) -> bool:
    """Where the variable reaches on both sides, about the mean there."""
    x = np.array(here.x)
    inside = (x >= there.x[0]) & (x <= there.x[-1])
    if not inside.any():
        return False
    y, band = (
        np.stack([np.interp(x[inside], there.x, column) for column in np.array(part).T], axis=1)
        for part in (there.y, there.band)
    )
    off = np.array(here.y)[inside] - y
    return bool((np.abs(off - off.mean(axis=0)) <= ALIKE_STD * np.hypot(np.array(here.band)[inside], band)).all())


def _words(one: Finding) -> str:
    return one.effect.replace("_", " ") + (f" by {one.driver}" if one.driver else "")


def _numbers(one: Finding) -> str:
    told = [quantity.labelled for quantity in grouped(one.parameters)]
    return ", ".join(told) if told else "a curve of its own"
