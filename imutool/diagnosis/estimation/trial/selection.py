"""Selected effects of the logs, with the fits that show them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace

from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.observability import LOW_PASSES
from imutool.sensor.effect import Effect, Theta


@dataclass(frozen=True, eq=False)
class SelectedEffect:
    """Selected effect with its parameters and the cost of leaving it out."""

    effect: Effect
    theta: Theta
    std: Theta
    unidentified: tuple[str, ...]  # parameters that no motion showed
    p_value: float  # by chi-square over all rows
    false_discovery_rate: float
    gain: float  # squares that leaving it out adds on all rows


@dataclass(frozen=True, eq=False)
class Selection:
    """Selected effects, strongest first, with fits, trials, and what finds those like each."""

    selected: tuple[SelectedEffect, ...]
    fitted: Fit
    whole: Fit
    tried: int
    always: int = 0
    similar: Callable[[], Mapping[str, tuple[str, ...]]] = dict
    within_error: tuple[str, ...] = ()  # names of effects that may be the error of a low-pass

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is no finding because it may be the error of a low-pass."""
        if not self.within_error:
            return ()
        names = ", ".join(name.replace("_", " ") for name in self.within_error)
        named = any(e.effect.name in LOW_PASSES for e in self.selected)
        which = "the low-pass" if named else "a low-pass, without which the simulation is noisier than the recording"
        why = f"may be the error of {which} (the samples of a simulation alias its vibrations)"
        return (f"{names}: more than chance, but {why}, so not among the findings",)


def without(found: Selection, keys: Collection[str]) -> Selection:
    """Selection without some effects, by key; the others are fitted again."""
    fitted, whole = (
        fit(before.logs, tuple(entry for entry in before.chosen if entry[0].key not in keys), part=before.part, near=before)
        for before in (found.fitted, found.whole)
    )
    theta = {effect.key: value for effect, value in whole.chosen}
    kept = (replace(e, theta=theta[e.effect.key]) for e in found.selected if e.effect.key not in keys)
    return replace(found, selected=tuple(kept), fitted=fitted, whole=whole)
