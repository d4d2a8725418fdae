"""Model selection of effects: forward selection, exchange and elimination.

Forward: the candidates of the best scores are fitted in full, and the best comes in. Back: a superfluous effect goes, one for
which another serves better is exchanged. What stays must beat noise on all rows, for all that was tried, and on unseen time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain

import numpy as np

from imutool.diagnosis.estimation.candidate_score import Candidates, portable, restored
from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import Chosen
from imutool.diagnosis.estimation.noise_estimate import axis_squares
from imutool.diagnosis.estimation.observability import (
    LOW_PASSES,
    WANDER,
    beyond_the_band,
    values_of,
    with_common_arm,
    with_plainer_effects,
    with_steady_clock,
    without_implausible,
)
from imutool.diagnosis.estimation.significance import bic, gain_for, unnamed_count
from imutool.diagnosis.estimation.trial.filter_forms import (
    beside_offset,
    with_delay_of_accel,
    with_form_of_low_pass,
    with_form_of_resonance,
    without_unseen_low_pass,
)
from imutool.diagnosis.estimation.trial.model_error import LowPassError
from imutool.diagnosis.estimation.trial.selection import Selection
from imutool.diagnosis.estimation.trial.sensor_filters import LAGS_BY_POSES, with_filter_of_each_sensor
from imutool.diagnosis.estimation.trial.verdicts import Trial
from imutool.diagnosis.estimation.unnamed_effects import smoothing, with_finer_curve
from imutool.diagnosis.estimation.whitening import WhitenedLog
from imutool.processes.forked import Forked, of_each
from imutool.sensor.effect import Effect, Theta
from imutool.sensor.effects.gyro_dead_band import ZONE


def select_effects(
    logs: Sequence[WhitenedLog],
    candidates: Sequence[Effect],
    later: Sequence[Sequence[Effect]] = (),
    progress: Callable[[str], None] | None = None,
    *,
    always: Chosen = (),
    begin: Chosen = (),
) -> Selection:
    """Select the effects that the logs show together.

    Groups of `later` are tried in turn, once the candidates before explain nothing more. Effects of `always` are in every fit
    and are no findings; the search begins with those of `begin`. `progress` is called with what is being tried.
    """
    unnamed = tuple(effect for group in later for effect in group)
    start, known, report = fit(logs, always), Candidates(logs, (*candidates, *unnamed)), progress or (lambda text: None)
    first = _Search(logs, tuple(candidates), unnamed, always, report, known, before=start.objective)
    settings = first.settings
    best_named, best_unnamed = (max((s.aic_gain for s in known.ranked(start, c)), default=0.0) for c in (candidates, unnamed))
    orders = ((), later), (unnamed, ())  # effects without a name after the others, or together with them
    order, other_order = reversed(orders) if best_unnamed > best_named + settings.clearly_better else orders
    begun = first.pruned(fit(logs, (*always, *begin))) if begin else start
    second = replace(first, candidates=known.copy(), progress=lambda text: None)
    other = Forked(lambda: portable(*_grown(second, begun, *other_order))) if unnamed else None
    answers = [_grown(first, begun, *order)]
    base = answers[0][1]
    doubtful = len(base.chosen) - len(always) >= settings.suspicious_effects or unnamed_count(base) > 0
    if other is not None and doubtful and base.objective > settings.explained_chi_square * base.numbers:
        # many small parts that do not add up, or an unnamed one: perhaps one effect alone is the better answer
        described = other.result()
        trial = restored(described, start, (*(effect for effect, _ in always), *candidates, *unnamed))
        better = bic(trial) < bic(base) - settings.clearly_better
        answers.insert(0 if better else 1, (replace(second, unnamed=unnamed[: described.unnamed], progress=report), trial))
    elif other is not None:
        other.end()
    count = len(always) + 1  # with the first effect alone: what came in later may have spoilt it
    alone = ((search, fit(logs, found.chosen[:count])) for search, found in answers if len(found.chosen) > count)
    selections = (search.tested(search.simplified(found)) for search, found in chain(answers, alone))
    best = next(selections)
    best = best if best.selected else next((each for each in selections if each.selected), best)  # unseen time refuted the best
    noise = smoothing(best.whole, len(always))
    return select_effects(logs, candidates, later, report, always=(*always, *noise)) if noise else best


def _grown(first: _Search, base: Fit, unnamed: Sequence[Effect], later: Sequence[Sequence[Effect]]) -> tuple[_Search, Fit]:
    """Fit after effects came in one by one, until no candidate explains more than chance."""
    search, settings, waiting = replace(first, unnamed=tuple(unnamed)), first.settings, list(later)
    before, largest = first.before, np.zeros(first.logs[0].pair.columns)  # squares left, and by column the largest effect's
    for _ in range(settings.rounds):
        count = len(base.chosen) - len(first.always)
        search.progress(" with ".join([f"{len(search.named) + len(search.unnamed)} effects", *base.keys[len(first.always) :]]))
        hopeless = count > settings.suspicious_effects and base.objective > settings.hopeless_chi_square * base.numbers
        hopeless &= before - base.objective < settings.hopeless_share * (before - base.numbers)
        better = search.added(base) if count < settings.max_effects and not hopeless else None
        gained = axis_squares(base) - axis_squares(better or base)
        if better is not None and gained.max() >= settings.negligible_share * largest[gained.argmax()]:
            largest = np.maximum(largest, gained)
            better = with_finer_curve(better)
            if better.chosen[-1][0].name in LOW_PASSES:
                better = with_form_of_low_pass(better, search.named)
                better = with_delay_of_accel(better, search.named)
            if better.chosen[-1][0].name in LAGS_BY_POSES:
                better = with_filter_of_each_sensor(better, search.named)
            better = with_form_of_resonance(better, search.named)
            before, base = base.objective, search.pruned(search.exchanged(search.with_always(better)))
        elif waiting:
            search = replace(search, unnamed=(*search.unnamed, *waiting.pop(0)))
        else:
            break
    return search, base


@dataclass(eq=False)
class _Search(Trial):
    before: float  # squares of white residuals with nothing but a constant bias
    trials: dict[str, Fit] = field(default_factory=dict)  # with one more candidate than `trials_of`
    trials_of: Fit | None = None

    @property
    def searched(self) -> tuple[Effect, ...]:
        """Named candidates, but for those that come in as the form of another."""
        own = (effect for effect in self.named if not effect.constants or effect.variant == ZONE)
        return tuple(effect for effect in own if (effect.name != LOW_PASSES[1] or not effect.variant))

    def removable(self, base: Fit) -> range:
        """Indices of effects but for those of every fit and the last, which has just come in."""
        return range(len(self.always), len(base.chosen) - 1)

    def added(self, base: Fit, but_for: frozenset[str] = frozenset()) -> Fit | None:
        """The best fit with one more effect; none if chance explains its gain, or the error of a low-pass may do so."""
        settings, share, count = self.settings, self.settings.rival_share, self.settings.fitted_each_round
        self.trials_of, self.trials = base, self.trials if self.trials_of is base else {}
        allowed = self.searched + (self.unnamed if unnamed_count(base) < settings.max_unnamed else ())
        allowed, error = tuple(effect for effect in allowed if effect.key not in but_for), LowPassError.of(base)
        best: tuple[float, Fit] | None = None
        poses, unsure, filters = any(log.pair.band_hz is not None for log in self.logs), set[str](), set[str]()
        for promised, effect, start, gain in self.candidates.ranked(base, allowed, count)[:count]:
            if best is not None and promised > best[0] * (1.0 if effect.linear else share):
                continue  # the score of a linear effect is its gain
            if poses and effect.lagless is not None:
                filters.add(effect.key)
            if effect.name == WANDER and gain < self.settings.unnamed_share * (base.objective - base.numbers):
                continue  # errors of poses last for seconds, as it does
            if effect.key not in self.trials:
                limit = base.objective - (0.0 if best is None else share * (base.objective - best[1].objective))
                self.trials[effect.key] = self.tried_with(base.chosen, effect, start, base, limit)
            added_effect, theta = (trial := self.trials[effect.key]).chosen[-1]
            if not added_effect.parameters or beyond_the_band(added_effect, theta, self.logs):
                continue
            log_p = partial(self.candidates.log_p, added_effect)
            own_log_p = log_p(base.objective - trial.objective)
            if (
                error is not None
                and own_log_p < self.threshold
                and error.may_be(added_effect, base, trial, log_p, self.threshold)
            ):
                unsure.add(effect.key)
                continue
            best = (own_log_p, trial) if best is None or own_log_p < best[0] else best
        if best is None or best[0] > self.threshold:
            no_answer = filters | unsure if best is None else filters  # poses hardly show filters, which promise alike
            return self.added(base, but_for | no_answer) if no_answer else None
        limit = settings.unnamed_share * (self.before - base.numbers)
        if unnamed_count(best[1]) and base.objective - best[1].objective < limit:
            return None  # the rim of something that has no name: a name for it would be wrong
        return self.candidates.jump_on_trend(base, best[1], self.named, self.threshold)

    def tried_with(self, others: Chosen, effect: Effect, start: Theta, near: Fit, limit: float) -> Fit:
        """Fit with one more effect, without its implausibly large parameters."""
        begun = beside_offset(self.logs, others, effect, [start, *self.candidates.starts[effect.key]])
        trials = (fit(self.logs, chosen, near=near, give_up_above=limit) for chosen in begun)
        trial = min(trials, key=lambda found: found.objective)
        reduced = without_implausible(effect, theta := trial.chosen[-1][1], self.settings.implausible_factor)
        start = values_of(effect, reduced, theta)
        return trial if reduced is effect else fit(self.logs, (*others, (reduced, start)), near=near, give_up_above=limit)

    def exchanged(self, base: Fit) -> Fit:
        """Fit with an effect replaced by another of the catalogue that explains more."""
        for k in self.removable(base) if len(base.chosen) - len(self.always) <= self.settings.exchanged_effects else ():
            others, own = (*base.chosen[:k], *base.chosen[k + 1 :]), base.chosen[k][0]
            without = fit(self.logs, others, iterations=2, near=base)
            own_log_p = self.candidates.log_p(own, without.objective - base.objective)
            unfitted = fit(self.logs, others, iterations=0, near=base)  # refitted, a nonlinear effect may diverge for good
            for log_p, effect, start, _ in self.candidates.ranked(unfitted, self.searched, 2)[:2]:
                if effect.key == own.key and effect.linear:  # its score is its gain
                    break
                if effect.key == own.key or (log_p > own_log_p and not own.linear):
                    continue
                limit = without.objective - self.settings.rival_share * (without.objective - base.objective)
                trial = self.tried_with(others, effect, start, without, limit)
                if self.candidates.log_p(trial.chosen[-1][0], without.objective - trial.objective) < own_log_p - 1.0:
                    return trial
        return base

    def with_always(self, base: Fit) -> Fit:
        """The fit with the effects of `always` first.

        Forms of a filter move a clock offset, or do without it.
        """
        first = {effect.key: (effect, theta) for effect, theta in self.always}
        if base.keys[: len(first)] == tuple(first):
            return base
        own = {effect.key: (effect, theta) for effect, theta in base.chosen}
        return fit(self.logs, tuple((first | own).values()), near=base)

    def simplified(self, base: Fit) -> Fit:
        """Fit with the simpler of two effects that the logs hardly tell apart."""
        for effect in [effect for effect, _ in base.chosen if effect.kind != "catalogue"]:
            rivals = self.rivals(base.keys.index(effect.key), base).values()  # a name that leaves no more says more
            score = bic if effect.kind == "driven" else lambda found: found.objective  # a lag that is zero leaves a little less
            base = next((trial for trial in rivals if score(trial) < score(base)), base)
        base = with_delay_of_accel(with_form_of_low_pass(base, self.named), self.named, complete=True)
        base = with_filter_of_each_sensor(base, self.named)
        base = with_steady_clock(base, self.named, self.candidates.starts)
        base = with_plainer_effects(base, self.named)
        base = without_unseen_low_pass(base, self.named)
        base, log_p, maximum = self.with_always(base), self.candidates.log_p, self.threshold
        return with_common_arm(base, self.named, lambda effect, gain: log_p(effect, gain) < maximum)

    def pruned(self, base: Fit) -> Fit:
        """The fit without effects that the others have made superfluous."""
        fits = dict[int, Fit]()

        def without(k: int) -> Fit:
            effect, theta = base.chosen[k]
            gain = gain_for(self.threshold - self.candidates.log_choices[effect.key], len(theta))
            limit = base.objective + self.settings.give_up_factor * gain  # a superfluous effect leaves less after a few steps
            return fits.setdefault(k, fit(self.logs, (*base.chosen[:k], *base.chosen[k + 1 :]), near=base, give_up_above=limit))

        removable = self.removable(base)
        for k, objective in zip(removable, of_each(lambda k: without(k).objective, removable), strict=True):
            if self.candidates.log_p(base.chosen[k][0], objective - base.objective) > self.threshold:
                return self.pruned(fits[k] if k in fits else without(k))
        return base
