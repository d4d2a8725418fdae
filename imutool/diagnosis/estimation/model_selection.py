"""Which effects separate recordings from what was expected of them: chosen singly and together, never guessed.

Forward: each effect is tried beside those that were found, by one linear solve from each of its starts; the most promising are
fitted together with the others, and the best comes in. Then back: one that the others have made superfluous goes, and one for
which another serves better is exchanged. What may stay is decided on everything at once: dropping it must cost more than noise
would, corrected for all that was tried, and on blocks of time that the fit has not seen it must help.

Scores are logarithms of chi-square's tail: twenty squares for one parameter are worth more than twenty-five for nine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from imutool.diagnosis.estimation import gauss_newton as fits
from imutool.diagnosis.estimation.alignment import Pair
from imutool.diagnosis.estimation.block_scatter import Scatter, scatter
from imutool.diagnosis.estimation.candidate_score import CandidateScore
from imutool.diagnosis.estimation.fixed_parameters import FixedParameters, values_of, without_implausible
from imutool.diagnosis.estimation.forward_cache import Chosen
from imutool.diagnosis.estimation.gauss_newton import Fit, WhitenedLog, fit
from imutool.diagnosis.estimation.model_error_floor import below_model_error
from imutool.diagnosis.estimation.onset import estimate_onsets
from imutool.diagnosis.estimation.significance import (
    gain_for,
    held_out_gains,
    held_out_p_value,
    log_p_value,
    prediction_p_value,
)
from imutool.diagnosis.estimation.unnamed_effects import Curve, finer, like
from imutool.sensor.effect import Effect, Theta
from imutool.sensor.samples import SensorSamples

FALSE_DISCOVERY = 5e-3
HELPS = 0.05  # chance of the gain on unseen blocks being none
TRIED = 3  # candidates that are fitted in full in a round
MOST, ROUNDS = 8, 20  # effects, and times that one comes in
SUSPICIOUS, CLEARLY, NAMELESS = 3, 10.0, 15.0  # effects; squares by which an answer is better; what a missing name costs
WELL, HOPELESS = 1.03, 2.0  # squares left a white value, below which all is said, and above which more of the same is no answer
MOST_NAMELESS, NAMELESS_SHARE = 2, 0.03  # effects without a name, and how much of the misfit each has to take
BEYOND, BEYOND_LOW_PASS = 3.0, 6.0  # of the poses' band: their smoothing looks like a mount that rings, but delays nothing
SLOWEST_HZ = 0.5  # of a filter or a mount; what lags by more is motion that the poses have lost
NOISE_ONLY = 1.15  # squares left a white value, up to which a simulation's noise is taken at its word
EXCHANGED = 3  # effects among which each is asked whether another would do better
MISSED = 4.0  # times the squares that an effect needs: a fit without it that is as far off after a few steps gets no nearer
RIVALS, RIVAL_SHARE = 3, 0.5  # effects that are asked whether they would do as well, and of the gain what a step has to promise


@dataclass(frozen=True, eq=False)
class SelectedEffect:
    """An effect that was found, with what it costs to leave it out.

    `p_value` is by chi-square over all rows, `gain` the squares that leaving it out adds there, `unidentified` what of it no
    motion showed, `similar` which other effects would have done as well in its place.
    """

    physics: Effect
    theta: Theta
    std: Theta
    unidentified: tuple[str, ...]
    p_value: float
    false_discovery_rate: float
    gain: float
    similar: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Selection:
    """What was found, the fit on fitted rows and the one on all."""

    selected: tuple[SelectedEffect, ...]
    fitted: Fit
    whole: Fit
    tried: int


def select_effects(
    logs: Sequence[WhitenedLog],
    candidates: Sequence[Effect],
    later: Sequence[Sequence[Effect]] = (),
    tell: Callable[[str], None] | None = None,
) -> Selection:
    """The effects that the logs show together; those of `later` are asked, in turn, when those before have nothing to say.

    `tell` hears what is being tried beside what.
    """
    everything = tuple(one for stage in later for one in stage)
    start = fit(logs, ())
    first = _Search(logs, tuple(candidates), everything, start.objective, tell or (lambda word: None))
    named, nameless = (max((r.worth for r in first.ranked(start, some)), default=0.0) for some in (first.named, first.others))
    paths = [(first.others, []), ((), list(later))] if nameless > named + CLEARLY else [((), list(later)), (first.others, [])]
    search, now = _path(first, start, *paths[0])
    churned = len(now.chosen) >= SUSPICIOUS or _unnamed(now) > 0
    if everything and churned and now.objective > WELL * now.numbers:
        # many small parts that do not add up, or one without a name: perhaps one thing alone is the better answer
        other = _path(first, start, *paths[1])
        if cost(other[1]) < cost(now) - CLEARLY:
            search, now = other
    return search.tested(now)


def _path(first: _Search, now: Fit, others: tuple[Effect, ...], waiting: list[Sequence[Effect]]) -> tuple[_Search, Fit]:
    """One effect after another comes in, until none of the candidates that there are by then explains more than chance."""
    search = replace(first, others=others)
    for _ in range(ROUNDS):
        beside = f" beside {', '.join(now.keys)}" if now.keys else ""
        search.tell(f"{len(search.named) + len(search.others)} effects{beside}")
        hopeless = len(now.chosen) > SUSPICIOUS and now.objective > HOPELESS * now.numbers
        better = search.added(now) if len(now.chosen) < MOST and not hopeless else None
        if better is not None:
            now = search.pruned(search.exchanged(search.refined(better)))
        elif waiting:
            search = search.also(waiting.pop(0))
        else:
            break
    return search, now


def cost(found: Fit) -> float:
    """Squares that are left and what the parameters cost (Schwarz); without a name, or with a channel for one, costs more."""
    count = sum(len(theta) for _, theta in found.chosen)
    nameless = _unnamed(found)
    return found.objective + count * float(np.log(found.numbers)) + NAMELESS * nameless


def _unnamed(found: Fit) -> int:
    """Number of effects that are not of the catalogue."""
    return sum(physics.kind != "catalogue" for physics, _ in found.chosen)


class _Ranked(NamedTuple):
    """A candidate by what one linear step from its best start gains, and by the chance of that."""

    score: float
    physics: Effect
    start: Theta
    gain: float

    @property
    def worth(self) -> float:
        """The gain less what as many numbers gain by chance (Akaike)."""
        return self.gain - 2.0 * len(self.start)


@dataclass(eq=False)
class _Search:
    logs: Sequence[WhitenedLog]
    named: tuple[Effect, ...]
    others: tuple[Effect, ...]
    before: float  # squares of white residuals with nothing but a constant bias
    tell: Callable[[str], None]
    starts: dict[str, list[Theta]] = field(default_factory=dict)
    luck: dict[str, float] = field(default_factory=dict)  # log of how much likelier chance looks like it: picked from many
    known: dict[str, _Ranked] = field(default_factory=dict)  # beside the effects of one fit
    trials: dict[str, Fit] = field(default_factory=dict)  # with one of them, likewise
    known_for: Fit | None = None
    asked: tuple[Fit, Scatter] | None = None
    onsets: dict[tuple[str, int], float] = field(default_factory=dict)  # standard deviations of times at which effects set in

    def __post_init__(self) -> None:
        for one in (*self.named, *self.others):
            if one.key not in self.starts:
                self.starts[one.key] = self._starts(one)
                self.luck[one.key] = self._luck(one)

    def also(self, others: Sequence[Effect]) -> _Search:
        """With more candidates; what is known of those there were stays known."""
        return replace(self, others=(*self.others, *others))

    @property
    def tried(self) -> int:
        """All starts of all candidates: what the chance of a false finding is multiplied by."""
        return sum(len(self.starts[one.key]) for one in (*self.named, *self.others))

    def _starts(self, physics: Effect) -> list[Theta]:
        if physics.starts is None:
            return [physics.null_value.astype(float)]
        pair = self.logs[0].pair
        return [np.asarray(start, dtype=float) for start in physics.starts(pair.felt, _as_read(pair))]

    def _luck(self, physics: Effect) -> float:
        if physics.alternatives is None:
            return 0.0
        return float(np.log(max(1.0, physics.alternatives(_as_read(self.logs[0].pair)) / len(self.starts[physics.key]))))

    def chance(self, physics: Effect, gain: float) -> float:
        """The logarithm of the chance that noise alone gains as much by an effect, at the best of its alternatives."""
        return log_p_value(gain, len(physics.parameters)) + self.luck[physics.key]

    def added(self, now: Fit) -> Fit | None:
        """The best fit with one more effect, or none that chance would not explain."""
        nameless = _unnamed(now)
        ranked = self.ranked(now, (*self.named, *self.others) if nameless < MOST_NAMELESS else self.named)
        best: tuple[float, Fit] | None = None
        for promised, physics, start, _ in ranked[:TRIED]:
            if best is not None and promised > best[0] * (1.0 if physics.linear else RIVAL_SHARE):
                continue  # what one step promises of a linear effect is what it gains
            if physics.key not in self.trials:
                hopeful = now.objective - (0.0 if best is None else RIVAL_SHARE * (now.objective - best[1].objective))
                self.trials[physics.key] = self.tried_with(now.chosen, physics, start, now, hopeful)
            trial = self.trials[physics.key]
            it, theta = trial.chosen[-1]
            if not it.parameters or self._beyond_the_band(it, theta):
                continue
            score = self.chance(it, now.objective - trial.objective)
            if best is None or score < best[0]:
                best = score, trial
        if best is None or best[0] > np.log(FALSE_DISCOVERY / self.tried):
            return None
        misfit = self.before - now.numbers
        if _unnamed(best[1]) and now.objective - best[1].objective < NAMELESS_SHARE * misfit:
            return None  # the rim of something that has no name: a name for it would be wrong
        return best[1]

    def tried_with(self, others: Chosen, physics: Effect, start: Theta, near: Fit, hopeful: float) -> Fit:
        """The fit with one more effect, without those of its numbers that would be many times larger than anything met."""
        trial = fit(self.logs, (*others, (physics, start)), near=near, hopeful=hopeful)
        held = without_implausible(physics, trial.chosen[-1][1])
        if held is physics:
            return trial
        left = values_of(physics, held, trial.chosen[-1][1])
        return fit(self.logs, (*others, (held, left)), near=near, hopeful=hopeful)

    def ranked(self, now: Fit, candidates: Sequence[Effect]) -> list[_Ranked]:
        """Candidates by what one linear step promises, each from its best start."""
        if self.known_for is not now:
            self.known_for, self.known, self.trials = now, {}, {}
        asked = [physics for physics in candidates if physics.key not in now.keys]
        panel = None
        for physics in asked:
            if physics.key not in self.known:
                panel = panel or CandidateScore(self.logs, now)
                promises = [(panel.gain(physics, start), start) for start in self.starts[physics.key]]
                gain, start = max(promises, key=lambda pair: pair[0])
                self.known[physics.key] = _Ranked(self.chance(physics, gain), physics, start, gain)
        return sorted((self.known[physics.key] for physics in asked), key=lambda entry: entry.score)

    def refined(self, now: Fit) -> Fit:
        """With more knots in the curve that has just come in, where it has an edge that they pay for."""
        others, (physics, _) = now.chosen[:-1], now.chosen[-1]
        fine = finer(physics, like([log.pair for log in self.logs]))
        if fine is None:
            return now
        trial = fit(self.logs, (*others, (fine, fine.null_value.astype(float))), near=now)
        return trial if cost(trial) < cost(now) - CLEARLY else now

    def exchanged(self, now: Fit) -> Fit:
        """With an effect replaced by another of the catalogue that explains more, where there is one."""
        for k in range(len(now.chosen) - 1) if len(now.chosen) <= EXCHANGED else ():
            others = (*now.chosen[:k], *now.chosen[k + 1 :])
            without = fit(self.logs, others, iterations=2, near=now)
            here = self.chance(now.chosen[k][0], without.objective - now.objective)
            held = fit(self.logs, others, iterations=0)  # alone, what is not linear runs away to where no step leads back from
            for score, physics, start, _ in self.ranked(held, self.named)[:2]:
                if physics.key == now.chosen[k][0].key:
                    if physics.linear:  # what its own step promises is all there is to gain
                        break
                    continue
                if score > here and not now.chosen[k][0].linear:
                    continue
                halfway = without.objective - RIVAL_SHARE * (without.objective - now.objective)
                trial = self.tried_with(others, physics, start, without, halfway)
                if self.chance(trial.chosen[-1][0], without.objective - trial.objective) < here - 1.0:
                    return trial
        return now

    def pruned(self, now: Fit) -> Fit:
        """Without effects that the others have made superfluous."""
        for k, (physics, theta) in enumerate(now.chosen[:-1]):  # the last has just come in
            least = gain_for(np.log(FALSE_DISCOVERY / self.tried) - self.luck[physics.key], len(theta))
            hopeful = now.objective + MISSED * least  # so much is left of what is superfluous after a few steps, and less
            without = fit(self.logs, (*now.chosen[:k], *now.chosen[k + 1 :]), near=now, hopeful=hopeful)
            if self.chance(physics, without.objective - now.objective) > np.log(FALSE_DISCOVERY / self.tried):
                return self.pruned(without)
        return now

    def tested(self, now: Fit) -> Selection:
        """What may stay: tested on all rows, and on blocks that were not fitted."""
        while now.chosen:
            self.tell(f"on unseen time: {', '.join(now.keys)}")
            other = fit(self.logs, now.chosen, part="held_out", near=now)
            whole = fit(self.logs, now.chosen, part="all", near=now)
            held = tuple(without_implausible(physics, theta) for physics, theta in whole.chosen)
            if any(one is not physics for one, (physics, _) in zip(held, whole.chosen, strict=True)):
                begun = tuple(
                    (one, values_of(physics, one, theta)) for one, (physics, theta) in zip(held, whole.chosen, strict=True)
                )
                now = fit(self.logs, tuple(pair for pair in begun if len(pair[1])))
                continue
            whole, self.onsets = estimate_onsets(self.logs, whole, "all", max(1.0, whole.objective / max(whole.numbers, 1)))
            verdicts = _but_faint([self._verdict(k, now, other, whole) for k in range(len(now.chosen))], self.logs)
            worst = max(range(len(verdicts)), key=lambda k: verdicts[k].false_discovery_rate)
            if verdicts[worst].false_discovery_rate <= FALSE_DISCOVERY:
                told = [replace(one, similar=self._similar(k, now)) for k, one in enumerate(verdicts)]
                fitted = replace(now, chosen=_set_in_as(now.chosen, whole.chosen))
                return Selection(tuple(sorted(told, key=lambda one: -one.gain)), fitted, whole, self.tried)
            now = fit(self.logs, (*now.chosen[:worst], *now.chosen[worst + 1 :]), near=now)
        return Selection((), now, fit(self.logs, (), part="all"), self.tried)

    def scattered(self, found: Fit, part: str) -> Scatter | None:
        """How far the blocks are of one mind; nothing where the noise is known, and what is left is as white as it."""
        exact = all(log.pair.against == "simulation" for log in self.logs)
        if exact and found.objective < NOISE_ONLY * found.numbers:
            return None
        if self.asked is None or self.asked[0] is not found:
            self.asked = found, scatter(self.logs, found, part)
        return self.asked[1]

    def _similar(self, k: int, now: Fit) -> tuple[str, ...]:
        """Effects of the catalogue that in an effect's place leave about as little (Akaike's criterion)."""
        others = (*now.chosen[:k], *now.chosen[k + 1 :])
        without = fit(self.logs, others, iterations=2, near=now)
        gain, found = without.objective - now.objective, []
        for _, physics, start, promised in self.ranked(without, self.named)[:RIVALS]:
            if physics.key != now.chosen[k][0].key and promised > RIVAL_SHARE * gain:
                trial = fit(
                    self.logs, (*others, (physics, start)), near=without, hopeful=without.objective - RIVAL_SHARE * gain
                )
                if trial.objective + 2 * len(start) < now.objective + 2 * len(now.chosen[k][1]) + CLEARLY:
                    found.append(physics.name)
        return tuple(dict.fromkeys(found))

    def _beyond_the_band(self, physics: Effect, theta: Theta) -> bool:
        """A frequency at which smoothed poses, which lose and lag by themselves, look alike; or slower than anything met."""
        more = BEYOND_LOW_PASS if physics.name == "low_pass" else BEYOND
        reach = [more * log.pair.band_hz for log in self.logs if log.pair.band_hz is not None]
        hertz = [value for number, value in zip(physics.parameters, theta, strict=True) if number.unit == "Hz"]
        return bool(reach and hertz and (max(hertz) > min(reach) or min(hertz) < SLOWEST_HZ))

    def _verdict(self, k: int, fitted: Fit, other: Fit, whole: Fit) -> SelectedEffect:
        physics, theta = whole.chosen[k]
        without = fit(self.logs, (*whole.chosen[:k], *whole.chosen[k + 1 :]), part="all", near=whole)
        gain = without.objective - whole.objective
        scattered = self.scattered(whole, "all")
        log_p = self.chance(physics, gain)
        if scattered is not None:
            log_p = max(log_p, scattered.chance(physics.key, gain, len(theta)) + self.luck[physics.key])
        blocks = np.concatenate(
            [held_out_gains(log, fitted, k, "held_out") for log in self.logs]
            + [held_out_gains(log, other, k, "fitted") for log in self.logs]
        )
        exact = all(log.pair.against == "simulation" for log in self.logs)
        helping = min(held_out_p_value(blocks[:, 0]), prediction_p_value(blocks) if exact else 1.0)
        rate = min(1.0, float(np.exp(min(0.0, log_p + np.log(self.tried)))))
        if helping > HELPS or self._beyond_the_band(physics, theta):
            rate = 1.0
        std = (whole.stds() if scattered is None else scattered.std)[physics.key]
        std = np.array([self.onsets.get((physics.key, j), float(s)) for j, s in enumerate(std)])
        unseen = [
            f"{physics.key}.{number.name}"
            for number, s in zip(physics.parameters, std, strict=True)
            if s > (fits.LOG_PRIOR if number.positive else number.plausible) and not isinstance(physics.forward, Curve)
        ]
        if isinstance(physics.forward, FixedParameters):
            values_of = {number.name for number in physics.parameters}
            unseen += [f"{physics.key}.{n.name}" for n in physics.forward.physics.parameters if n.name not in values_of]
        return SelectedEffect(physics, theta, std, tuple(unseen), float(np.exp(max(log_p, -700.0))), rate, gain)


def _but_faint(verdicts: Sequence[SelectedEffect], logs: Sequence[WhitenedLog]) -> list[SelectedEffect]:
    """Without trust in what may be the inexactness of a far larger effect."""
    exact = not any(log.pair.sim_noise.any() for log in logs)
    hidden = below_model_error({one.physics.key: one.gain for one in verdicts}, exact)
    return [replace(one, false_discovery_rate=1.0) if one.physics.key in hidden else one for one in verdicts]


def _as_read(pair: Pair) -> SensorSamples:
    """The samples as they were recorded."""
    return SensorSamples(pair.stamp_s, pair.real[:, :3], pair.real[:, 3:], np.zeros((len(pair.real), 3)))


def _set_in_as(fitted: Chosen, whole: Chosen) -> Chosen:
    """With the times at which effects set in as all rows show them: one that lies between fitted rows, those cannot."""
    out = []
    for (physics, theta), (_, seen) in zip(fitted, whole, strict=True):
        begins = np.array([number.begins for number in physics.parameters])
        out.append((physics, np.where(begins, seen, theta)))
    return tuple(out)
