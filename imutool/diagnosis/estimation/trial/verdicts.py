"""Verdicts on chosen effects: on all rows, on unseen time, and against errors of models."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from imutool.diagnosis.estimation.candidate_score import Candidates
from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import Chosen, SplineCurve
from imutool.diagnosis.estimation.noise_estimate import axis_squares, is_coloured_noise, kurtosis, leaves_slow_motion
from imutool.diagnosis.estimation.observability import beyond_the_band, unidentified
from imutool.diagnosis.estimation.significance import (
    Scatter,
    estimate_onsets,
    gain_of,
    leaves_as_little,
    scatter,
    with_onsets_of,
    with_onsets_of_all_rows,
)
from imutool.diagnosis.estimation.trial.effect_order import order_squares, order_std
from imutool.diagnosis.estimation.trial.model_error import (
    FOLLOWING,
    LowPassError,
    below_model_error,
    below_reference_error,
    is_over_at_once,
    is_part_of_misfit,
    is_swing_of_motion,
    is_taken_back,
    of_motion,
    with_low_pass_error,
)
from imutool.diagnosis.estimation.trial.selection import SelectedEffect, Selection
from imutool.diagnosis.estimation.trial.unseen_time import first_refuted
from imutool.diagnosis.estimation.trial.walking_bias import std_of_unseen_walk, with_bias_walk
from imutool.diagnosis.estimation.unnamed_effects import has_no_size, plausible_part, takes_noise
from imutool.diagnosis.estimation.whitening import WhitenedLog
from imutool.diagnosis.settings import SearchSettings
from imutool.processes.forked import Forked, of_each
from imutool.sensor.effect import Effect, Theta
from imutool.sensor.effects.low_pass import Design

HYSTERESES = ("gyro_hysteresis", "accel_hysteresis")
OTHER_F0 = np.delete(2.0 ** (np.arange(-8, 17) / 8.0), 8)  # of the fitted one, at which the search of other peaks begins
AS_LIKELY = 9.0  # squares more: three deviations


@dataclass(eq=False)
class Trial:
    """Trial of chosen effects among all candidates; those of `always` are in every fit."""

    logs: Sequence[WhitenedLog]
    named: tuple[Effect, ...]
    unnamed: tuple[Effect, ...]
    always: Chosen
    progress: Callable[[str], None]
    candidates: Candidates
    onset_std: dict[tuple[str, int], float] = field(default_factory=dict, init=False)
    walk_std: Mapping[str, Theta] = field(default_factory=dict, init=False)
    order_std: Mapping[str, Theta] = field(default_factory=dict, init=False)

    @property
    def settings(self) -> SearchSettings:
        """Settings of the search."""
        return self.logs[0].pair.settings.search

    @property
    def tried(self) -> int:
        """Number of hypotheses of the Bonferroni correction; at least one."""
        return max(1, self.candidates.count((*self.named, *self.unnamed)))

    @property
    def threshold(self) -> float:
        """Log p-value that a finding needs after the correction."""
        return float(np.log(self.settings.false_discovery_rate / self.tried))

    def tested(self, base: Fit) -> Selection:
        """Selection of the effects that pass on all rows and on held-out blocks."""
        while len(base.chosen) > (first := len(self.always)):
            _ = (base := with_bias_walk(with_onsets_of_all_rows(base))).jacobians  # which both processes need
            self.progress(f"on unseen time: {', '.join(base.keys[first:])}")
            unseen = Forked(partial(first_refuted, base, first))
            whole = fit(base.logs, base.chosen, part="all", near=base)
            if (reduced := plausible_part(whole.chosen, self.settings.implausible_factor)) is not None:
                base = fit(base.logs, reduced)
                unseen.end()
                continue
            whole, self.onset_std = estimate_onsets(whole)
            self.walk_std, self.order_std = std_of_unseen_walk(whole), order_std(whole)
            verdicts = self.verdicts(whole, first, unseen)
            unseen.end()
            rates = [*(verdict.false_discovery_rate for verdict in verdicts), 1.0][: len(base.chosen) - first]
            worst = max(range(len(rates)), key=lambda k: rates[k])
            if rates[worst] <= self.settings.false_discovery_rate:
                fitted = replace(base, chosen=with_onsets_of(base.chosen, whole.chosen))
                selected = tuple(sorted(verdicts, key=lambda verdict: -verdict.gain))
                best = Selection(selected, fitted, whole, self.tried, first, partial(self._similar, base))
                return self._with_error(best, base)
            base = fit(base.logs, (*base.chosen[: first + worst], *base.chosen[first + worst + 1 :]), near=base)
        return Selection((), base, fit(base.logs, base.chosen, part="all"), self.tried, first)

    def _similar(self, tested: Fit) -> dict[str, tuple[str, ...]]:
        base = self._with_own_noise(tested)
        return {base.keys[k]: tuple(self.rivals(k, base)) for k in range(len(self.always), len(base.chosen))}

    def _with_own_noise(self, tested: Fit) -> Fit:
        """The fit given a constant bias."""
        return tested if all(log.whiten.walk is None for log in tested.logs) else fit(self.logs, tested.chosen)

    def _with_error(self, selection: Selection, tested: Fit) -> Selection:
        """The selection with effects that explain more than chance and may be the error of its low-pass."""
        if (error := LowPassError.of(tested)) is None:
            return selection
        base, count = self._with_own_noise(tested), self.settings.fitted_each_round
        plain = tuple(effect for effect in self.named if not effect.variant)
        clear = (s for s in self.candidates.ranked(base, plain, count)[:count] if s.log_p < self.threshold)
        return with_low_pass_error(selection, error, {s.effect.name: s.gain for s in clear if of_motion(s.effect)})

    def rivals(self, k: int, base: Fit) -> dict[str, Fit]:
        """Fits with another effect on the same sensor in the place of one that leave as little (AIC)."""
        found, maximum, (own_effect, theta) = dict[str, Fit](), self.settings.rivals, base.chosen[k]
        without = fit(self.logs, others := (*base.chosen[:k], *base.chosen[k + 1 :]), iterations=2, near=base)
        minimum, aic = self.settings.rival_share * (without.objective - base.objective), base.objective + 2 * len(theta)
        named = tuple(effect for effect in self.named if effect.lagless is None or not effect.constants)  # one order of a name
        for _, effect, start, promised in self.candidates.ranked(without, named, maximum)[:maximum]:
            if effect.name != own_effect.name and effect.meets(own_effect) and promised > minimum:
                trial = fit(self.logs, (*others, (effect, start)), near=without, give_up_above=without.objective - minimum)
                if leaves_as_little(trial, effect.key, aic):
                    found.setdefault(effect.name, trial)
        return found

    def verdicts(self, whole: Fit, first: int, unseen: Forked[int]) -> list[SelectedEffect]:
        """Verdicts on effects that pass on unseen time too, up to the first that goes; a model's error has a rate of one."""
        exact, verdicts = all(log.pair.exact for log in self.logs), list[SelectedEffect]()
        white = exact and whole.objective < self.settings.white_chi_square * whole.numbers  # as the noise that is known
        white = white and bool((kurtosis(whole) < self.settings.white_kurtosis).all())  # few samples may hold all squares
        scattered = None if white else scatter(whole)
        if self._verdict(first, gain_of(whole, first, 1), whole, scattered) is None:  # no fit of the others leaves more
            return verdicts
        passed = range(first, unseen.result())
        for k, gain in zip(passed, of_each(partial(gain_of, whole), passed), strict=True):
            verdict = self._verdict(k, gain, whole, scattered)
            if verdict is None:
                break
            verdicts.append(verdict)
        gains, names = {e.effect.key: e.gain for e in verdicts}, {effect.key: effect.name for effect, _ in whole.chosen}
        remaining = {whole.keys[k]: k for k in range(passed.start + len(verdicts), len(whole.chosen))}

        def with_left(iterations: int | None) -> dict[str, float]:
            return gains | {
                key: gain_of(whole, k, iterations)[0] for key, k in remaining.items() if FOLLOWING & {names[e] for e in gains}
            }

        def hidden(every: Mapping[str, float]) -> frozenset[str]:
            denoised = any(log.pair.denoised for log in self.logs)
            return below_model_error(every, self.settings, denoised=denoised, poses=not exact, names=names) & gains.keys()

        below = frozenset[str]()
        if hidden(with_left(0)):  # no fit of the others leaves more than its start
            every = with_left(None)
            below = frozenset(key for key in hidden(every) if not self._shown_elsewhere(key, every, whole))
        below |= {e.effect.key for e in verdicts if self._may_be_error(e.effect, whole)}
        below |= {e.effect.key for e in verdicts if below_reference_error(e.effect, e.gain, whole)}
        below |= {e.effect.key for e in verdicts if exact and is_part_of_misfit(e.effect, e.gain, whole)}
        below |= {e.effect.key for e in verdicts if self._is_contradicted(e.effect, whole)}
        below |= {e.effect.key for e in verdicts if e.gain < order_squares(whole, e.effect)}
        return [replace(verdict, false_discovery_rate=1.0) if verdict.effect.key in below else verdict for verdict in verdicts]

    def _shown_elsewhere(self, key: str, gains: Mapping[str, float], whole: Fit) -> bool:
        """Whether an effect explains more than chance on a sensor on which no larger one acts, and errs."""
        (effect,) = (effect for effect, _ in whole.chosen if effect.key == key)
        larger = {name for other, _ in whole.chosen if gains.get(other.key, 0.0) > gains[key] for name in other.sensors}
        columns = [whole.logs[0].pair.signals[name] for name in effect.sensors if name not in larger]
        if not columns:
            return False
        gained = axis_squares(_without(effect, whole)) - axis_squares(whole)
        return self.candidates.log_p(effect, float(sum(gained[part].sum() for part in columns))) < self.threshold

    def _is_contradicted(self, effect: Effect, whole: Fit) -> bool:
        """Whether an effect of several sensors leaves clearly more of one: it is none of them all."""
        parts = [part for name, part in whole.logs[0].pair.signals.items() if name in effect.sensors]
        if len(parts) < 2:
            return False
        gained = axis_squares(_without(effect, whole)) - axis_squares(whole)
        each = [float(gained[part].sum()) for part in parts]
        lost = -min(each)
        return lost > self.settings.contradicted_share * max(each) and self.candidates.log_p(effect, lost) < self.threshold

    def _may_be_error(self, effect: Effect, whole: Fit) -> bool:
        """Whether an effect of a fit may be the error of its low-pass."""
        if (error := LowPassError.of(whole)) is None or not of_motion(effect):
            return False
        return error.may_be(effect, _without(effect, whole), whole, partial(self.candidates.log_p, effect), self.threshold)

    def _verdict(self, k: int, gain: tuple[float, float], whole: Fit, scattered: Scatter | None) -> SelectedEffect | None:
        """Verdict on one effect by all rows; none if chance explains it or it is no answer."""
        effect, theta = whole.chosen[k]
        stds = (whole.stds() if scattered is None else scattered.std)[effect.key]
        std = np.array([self.onset_std.get((effect.key, j), float(s)) for j, s in enumerate(stds)])
        if effect.lagless is not None:
            std[0] = np.hypot(std[0], theta[0] * Design.of(effect, theta).digital_share)
        no_answer = beyond_the_band(effect, theta, self.logs) or takes_noise(effect, theta, self.logs)
        no_answer = (
            no_answer
            or is_coloured_noise(effect, theta, whole)
            or is_over_at_once(effect, theta, self.settings.implausible_factor)
            or is_swing_of_motion(effect, whole)
            or (
                (effect.name in HYSTERESES or (effect.lagless is not None and is_taken_back(whole, effect)))
                and leaves_slow_motion(whole, effect.sensors[0], self.settings.hysteresis_leaves * gain[0])
            )
        )
        if no_answer or has_no_size(effect, theta, std, curve=(curve := isinstance(effect.forward, SplineCurve))):
            return None
        if effect.name == "mount_resonance":
            std = np.hypot(std, _off_other_peaks(whole, k, 1.0 if scattered is None else scattered.inflation[effect.key]))
        log_p = self.candidates.log_p(effect, gain[1])
        if scattered is not None:
            log_p = max(log_p, scattered.log_p_value(effect.key, gain[1], len(theta)) + self.candidates.log_choices[effect.key])
        rate = min(1.0, float(np.exp(min(0.0, log_p + np.log(self.tried)))))
        std = np.hypot(np.hypot(std, self.walk_std.get(effect.key, 0.0)), self.order_std.get(effect.key, 0.0))
        vague = tuple(unidentified(effect, theta, std, curve=curve))
        return SelectedEffect(effect, theta, std, vague, float(np.exp(max(log_p, -700))), rate, gain[0]) if rate < 1.0 else None


def _without(effect: Effect, whole: Fit) -> Fit:
    """Fit of all effects but one."""
    others = tuple(entry for entry in whole.chosen if entry[0] is not effect)
    return fit(whole.logs, others, part=whole.part, near=whole)


def _off_other_peaks(whole: Fit, k: int, inflation: float) -> Theta:
    """How far a resonance is off other likely ones: the root of mean squares, by parameter.

    Motion far below f0 shows share / f0^2 and share zeta / f0^3. What rings shows f0 itself, and a weak ringing fits noise at
    many f0, each of them a narrow peak.
    """
    (effect, theta), minimum, off = whole.chosen[k], whole.objective, [np.zeros(len(whole.chosen[k][1]))]
    squares = [minimum]
    for ratio in OTHER_F0:
        begun = (effect, theta * np.array([ratio, ratio, *[ratio**2] * (len(theta) - 2)]))
        others = (*whole.chosen[:k], begun, *whole.chosen[k + 1 :])
        at_other_peak = fit(whole.logs, others, part=whole.part, give_up_above=minimum + AS_LIKELY * inflation)
        squares.append(at_other_peak.objective)
        off.append(at_other_peak.chosen[k][1] - theta)
    likely = np.exp((min(squares) - np.array(squares)) / (2.0 * inflation))
    return np.asarray(np.sqrt(likely @ np.array(off) ** 2 / likely.sum()))
