"""Comparison with a simulation of another motion: one description, fitted to both logs.

That one log shows an effect and the other does not is no difference between the two: it may move too little, or one cause may
go by another name there (a filter is a delay of slow motion). So the effects of the recording are fitted to the simulation,
too, and what is compared is numbers with their deviations (Gelman and Stern, The American Statistician 60, 2006).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from imutool.array_types import Float64
from imutool.diagnosis.compare_findings import ALIKE_SHARE
from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.observability import exclude_each_other
from imutool.diagnosis.estimation.significance import scatter
from imutool.diagnosis.estimation.trial.model_error import FOLLOWING
from imutool.diagnosis.estimation.trial.selection import SelectedEffect, Selection, without
from imutool.diagnosis.estimation.whitening import WhitenedLog
from imutool.diagnosis.held_out import noise_floor
from imutool.diagnosis.result import Finding
from imutool.diagnosis.summarize import finding_of
from imutool.sensor.effect import Effect, Stage, Theta
from imutool.sensor.effects import vibration


def compared(found: Selection, sim: Selection, of_sim: Sequence[Finding]) -> tuple[Selection, tuple[Finding, ...], str]:
    """Selection, findings of the simulation, and a remark; both logs in the same words."""
    below = [within_model_error(one) for one in (found, sim)]
    clear = [[one for one in each.selected if one not in small] for each, small in zip((found, sim), below, strict=True)]
    both = [
        [one for one in small if not any(_is_rival(one.effect, other.effect) for other in others)]
        for small, others in zip(below, clear[::-1], strict=True)
    ]
    found, sim = (without(one, {small.effect.key for small in each}) for one, each in zip((found, sim), both, strict=True))
    left_out = {(one.effect.name, one.effect.equation) for one in both[1]}
    found = with_common_description(found, sim)
    known = with_twins([one for one in of_sim if (one.effect, one.equation) not in left_out], sim, found)
    names = ", ".join(dict.fromkeys(one.effect.name.replace("_", " ") for one in both[0]))
    return found, known, f"{names}: less than poses know of a motion, so not among the findings" if names else ""


def within_model_error(found: Selection) -> list[SelectedEffect]:
    """Selected effects that are smaller than the model error of a curve through poses.

    The motion is the largest effect of all, and its model errs by a share of it (`model_error`, 0.3 % of its size). A sensor
    with less noise shows such an error as scale, arm or curve, with certainty. Drifts and lines do not follow the motion.
    """
    logs, allowed = found.whole.logs, found.whole.logs[0].pair.settings.search.model_error
    squares = np.sum([_motion_squares(log) for log in logs], axis=0)
    signals = logs[0].pair.signals
    return [
        one
        for one in found.selected
        if not one.effect.of_time
        and one.effect.name != vibration.EFFECT.name
        and one.gain < allowed * min(squares[signals[sensor]].sum() for sensor in one.effect.sensors)
    ]


def with_common_description(found: Selection, sim: Selection) -> Selection:
    """Selection with the simulation's filter or clock effects, where they fit as well.

    They may leave more by `ALIKE_SHARE` of the size, as numbers may that are alike.
    """
    mine, theirs = (_following(one.whole.chosen, one.always) for one in (found, sim))
    if not mine or not theirs or {e.key for e, _ in mine} == {e.key for e, _ in theirs}:
        return found
    if not all(_is_comparable(effect, found.whole.logs) for effect, _ in theirs):
        return found
    rest = tuple(entry for entry in found.whole.chosen if entry not in mine)
    alone, trial = (fit(found.whole.logs, (*rest, *more), part="all") for more in ((), theirs))
    if trial.objective > found.whole.objective + ALIKE_SHARE**2 * (alone.objective - found.whole.objective):
        return found
    first = max((one for one in found.selected if one.effect.name in FOLLOWING), key=lambda one: one.gain)
    kept = [one for one in found.selected if one.effect.name not in FOLLOWING]
    theta, std = _numbers(trial)
    named = [replace(first, effect=e, theta=theta[e.key], std=std[e.key], unidentified=()) for e, _ in theirs]
    kept = [replace(one, theta=theta[one.effect.key], std=std[one.effect.key]) for one in kept]
    return replace(found, selected=(*named, *kept), fitted=fit(found.fitted.logs, trial.chosen), whole=trial)


def with_twins(known: Sequence[Finding], sim: Selection, real: Selection) -> tuple[Finding, ...]:
    """Findings of a simulation, with the recording's effects in place of their rivals."""
    chosen, always, logs = sim.whole.chosen, sim.always, sim.whole.logs
    keys = {effect.key for effect, _ in chosen}
    asked = [one for one in real.selected if _is_comparable(one.effect, logs)]
    if not any(one.effect.key not in keys for one in asked):
        return tuple(known)
    rivals = {e.key for e, _ in chosen[always:] if any(_is_rival(e, one.effect) for one in asked)}
    others = tuple(entry for entry in chosen if entry[0].key not in rivals)
    begun = (*others, *((one.effect, one.theta) for one in asked))
    whole = fit(logs, begun, part="all")
    theta, std = _numbers(whole)
    new = tuple(SelectedEffect(one.effect, theta[one.effect.key], std[one.effect.key], (), 1.0, 1.0, 0.0) for one in asked)
    selection = Selection(new, fit(sim.fitted.logs, whole.chosen), whole, sim.tried, always)
    floor = noise_floor(logs)
    twins = [finding_of(logs, selection, one, floor) for one in new]
    replaced = {(e.name, e.equation) for e, _ in chosen if e.key in rivals}
    return (*(one for one in known if (one.effect, one.equation) not in replaced), *twins)


def _motion_squares(log: WhitenedLog) -> Float64[np.ndarray, " k"]:
    """Squares of the motion by column, white as its noise, but for a constant."""
    rows = log.rows("all")
    white, constant = log.whiten(expected(log.pair, ()))[rows], log.constants[rows]
    size = np.maximum((constant**2).sum(axis=0), np.finfo(np.float64).tiny)
    return np.asarray(((white - constant * ((constant * white).sum(axis=0) / size)) ** 2).sum(axis=0))


def _following(chosen: Chosen, always: int) -> Chosen:
    return tuple(entry for entry in chosen[always:] if entry[0].name in FOLLOWING)


def _is_rival(theirs: Effect, asked: Effect) -> bool:
    """Whether two effects are one word or two for the same thing."""
    return exclude_each_other(theirs, asked) or (theirs.name in FOLLOWING and asked.name in FOLLOWING)


def _is_comparable(effect: Effect, logs: Sequence[WhitenedLog]) -> bool:
    """Whether an effect has a meaning in other logs: no limit and no time of one log, and channels that all have."""
    channels = set.intersection(*(set(log.pair.channels) for log in logs if isinstance(log.pair, Pair)))
    needs = [need for need in effect.needs if need != "attitude"] + ([effect.variable] if effect.kind == "driven" else [])
    known = all(any(need in name for name in channels) for need in needs)
    return known and effect.stage != Stage.CONVERTER and not any(parameter.begins for parameter in effect.parameters)


def _numbers(found: Fit) -> tuple[dict[str, Theta], dict[str, Theta]]:
    """Parameters and robust deviations by effect."""
    block_s = found.logs[0].pair.settings.search.robust_block_s
    std = scatter(found.logs, found, found.part, block_s).std if found.chosen else {}
    return {e.key: theta for e, theta in found.chosen}, {key: np.asarray(value) for key, value in std.items()}
