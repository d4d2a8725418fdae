"""Which effects separate a signal from its simulation: forward, exchange, back, and what may stay, as `discover` does it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.stats import t as student
from scipy.stats import wilcoxon

from imutool.diagnosis.estimation.model_selection import FALSE_DISCOVERY, HELPS
from imutool.diagnosis.estimation.significance import BLOCK_S, log_p_value
from imutool.diagnosis.scalar.effects import Chosen, Effect, Samples, differ
from imutool.diagnosis.scalar.fit import BETWEEN_SAMPLES, Fit, Panel, WhitenedLog, fit

ALIKE = 4.0  # natural logarithms of chance within which two effects cannot be told apart
TRIED = 5  # candidates that are fitted in full in a round
MOST, ROUNDS = 6, 16  # effects, and times that one comes in
LEAST_BLOCKS = 3
MANY, LEFT = 3, 1.15  # effects, and squares left for each row, from which on a search without preference for names is made


@dataclass(frozen=True, eq=False)
class Judged:
    """An effect that was found: its place in the fits, the squares and chances that it stands for, and what serves as well."""

    effect: Effect
    p_value: float
    false_discovery_rate: float
    gain: float
    similar: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Found:
    """What was found, strongest first; the fit on fitted rows and the one on all, effects in the same order."""

    judged: tuple[Judged, ...]
    fitted: Fit
    whole: Fit


class Search:
    """Effects of a signal among candidates; those of `later` are asked, in turn, when those before have nothing to say.

    always: part of every fit, and never news.
    """

    def __init__(
        self, signal: WhitenedLog, always: Chosen, candidates: Sequence[Effect], later: Sequence[Sequence[Effect]]
    ) -> None:
        self.signal, self.always = signal, always
        self.candidates, self.later = list(candidates), [list(group) for group in later]

    @property
    def tried(self) -> int:
        """All starts of all candidates so far: what the chance of a false finding is multiplied by."""
        return sum(len(effect.starts) for effect in self.candidates)

    @property
    def threshold(self) -> float:
        """The logarithm of the chance that a finding must be below."""
        return float(np.log(FALSE_DISCOVERY / self.tried))

    def run(self, begun: Chosen = ()) -> Found:
        """What is found, beginning with what was found before."""
        now = self._grown(fit(self.signal, (*self.always, *begun)), self.later)
        self.candidates += [one for group in self.later for one in group if one not in self.candidates]
        if self._doubtful(now):
            free = self._grown(fit(self.signal, self.always), ())
            if self._cost(free) < self._cost(now) - ALIKE:
                now = free
        return self._judged(now)

    def _grown(self, now: Fit, later: Sequence[Sequence[Effect]]) -> Fit:
        """With effects coming in one by one until none is worth it."""
        waiting = list(later)
        for _ in range(ROUNDS):
            better = self._added(now) if len(now.chosen) < MOST + len(self.always) else None
            if better is not None:
                now = self._pruned(self._exchanged(better))
            elif waiting:
                self.candidates += waiting.pop(0)
            else:
                break
        return now

    def _doubtful(self, now: Fit) -> bool:
        """Whether names were perhaps piled up in place of one thing without a name: many of them, or a misfit that stays."""
        return bool(len(self._of(now)) >= MANY or now.objective > LEFT * self.signal.rows("fitted").sum())

    def _cost(self, now: Fit) -> float:
        """Half the squares left, what the parameters cost (Schwarz), and how many effects were tried."""
        numbers = sum(len(now.chosen[k][1]) for k in self._of(now))
        rows = float(self.signal.rows("fitted").sum())
        return 0.5 * now.objective + 0.5 * numbers * float(np.log(rows)) + len(self._of(now)) * float(np.log(self.tried))

    def _of(self, now: Fit) -> range:
        """Places of effects that are not part of every fit."""
        return range(len(self.always), len(now.chosen))

    def _without(self, now: Fit, k: int, part: str = "fitted") -> Fit:
        return fit(self.signal, (*now.chosen[:k], *now.chosen[k + 1 :]), part)

    def _ranked(self, now: Fit, besides: Sequence[Effect]) -> list[tuple[float, Effect, np.ndarray]]:
        """Candidates by what one linear step promises, each from its best start."""
        panel, out = Panel(self.signal, now), []
        for effect in self.candidates:
            if differ(effect, besides):
                gain, k = max((panel.gain(effect, start), k) for k, start in enumerate(effect.starts))
                out.append((log_p_value(gain, len(effect.numbers)), effect, effect.starts[k]))
        return sorted(out, key=lambda entry: entry[0])

    def _added(self, now: Fit) -> Fit | None:
        """The best fit with one more effect, or none that chance would not explain."""
        best: tuple[float, Fit] | None = None
        for _, effect, start in self._ranked(now, [one for one, _ in now.chosen])[:TRIED]:
            trial = fit(self.signal, (*now.chosen, (effect, start)))
            score = log_p_value(now.objective - trial.objective, len(start))
            if best is None or score < best[0]:
                best = score, trial
        return None if best is None or best[0] > self.threshold else best[1]

    def _exchanged(self, now: Fit) -> Fit:
        """With an effect replaced by another, or by its variant, that explains more, where there is one."""
        for k in list(self._of(now))[:-1]:
            without = self._without(now, k)
            here = log_p_value(without.objective - now.objective, len(now.chosen[k][1]))
            for score, effect, start in self._ranked(without, [one for one, _ in without.chosen])[:3]:
                if effect.key == now.chosen[k][0].key or score > here:
                    continue
                trial = fit(self.signal, (*without.chosen, (effect, start)))
                if log_p_value(without.objective - trial.objective, len(start)) < here - 1.0:
                    return trial
        return now

    def _pruned(self, now: Fit) -> Fit:
        """Without effects that the others have made superfluous."""
        for k in list(self._of(now))[:-1]:  # the last has just come in
            without = self._without(now, k)
            if log_p_value(without.objective - now.objective, len(now.chosen[k][1])) > self.threshold:
                return self._pruned(without)
        return now

    def _judged(self, now: Fit) -> Found:
        """What may stay: tested on all rows, and on blocks that were not fitted."""
        while True:
            whole, other = fit(self.signal, now.chosen, "all"), fit(self.signal, now.chosen, "held_out")
            verdicts = [self._verdict(k, now, other, whole) for k in self._of(now)]
            if not verdicts:
                return Found((), now, whole)
            worst = int(np.argmax([one.false_discovery_rate for one in verdicts]))
            if verdicts[worst].false_discovery_rate <= FALSE_DISCOVERY:
                break
            now = self._without(now, len(self.always) + worst)
        order = [len(self.always) + int(k) for k in np.argsort([-one.gain for one in verdicts])]
        places = [*range(len(self.always)), *order]
        fitted, whole = (
            fit(self.signal, tuple(one.chosen[k] for k in places), part) for one, part in ((now, "fitted"), (whole, "all"))
        )
        return Found(tuple(sorted(verdicts, key=lambda one: -one.gain)), fitted, whole)

    def _verdict(self, k: int, fitted: Fit, other: Fit, whole: Fit) -> Judged:
        effect, theta = whole.chosen[k]
        without = self._without(whole, k, "all")
        gain = without.objective - whole.objective
        if any(one.jumps for j, (one, _) in enumerate(whole.chosen) if j != k):
            gain /= BETWEEN_SAMPLES**2  # whatever moves the signal a little wins single samples at an edge
        log_p = log_p_value(gain, len(theta))
        gains = self._gains(fitted, k, "fitted", "held_out")
        if not effect.wanders:
            gains = np.concatenate([gains, self._gains(other, k, "held_out", "fitted")])
        helps = helped(gains)
        rate = float(np.exp(min(0.0, log_p + np.log(self.tried))))
        rate = max(rate, helps) if helps > HELPS else rate
        return Judged(effect, float(np.exp(max(log_p, -700.0))), rate, gain, self._similar(whole, without, k, log_p))

    def _similar(self, whole: Fit, without: Fit, k: int, log_p: float) -> tuple[str, ...]:
        """What would explain as much in an effect's place, within what chance decides."""
        effect, found = whole.chosen[k][0], []
        ranked = [one for one in self._ranked(without, [one for one, _ in without.chosen]) if one[1].key != effect.key]
        for score, one, start in ranked[:TRIED]:
            if score > 0.3 * log_p:  # hopeless even if the step that was tried is far from the best
                continue
            trial = fit(self.signal, (*without.chosen, (one, start)), "all")
            if log_p_value(without.objective - trial.objective, len(start)) < log_p + ALIKE:
                found.append(one.key if one.name in ("driven", "unknown", effect.name) else one.name)
        return tuple(dict.fromkeys(found))

    def _gains(self, now: Fit, k: int, fitted: str, tested: str) -> Float64[np.ndarray, " b"]:
        """Squares by which each block of a part that was not fitted is better with an effect than without it."""
        rows = self.signal.rows(tested)
        with_, without = (self._left(one.chosen, tested) for one in (now, self._without(now, k, fitted)))
        block = np.floor(self.signal.ideal.t_s[rows] / BLOCK_S).astype(int)
        names, inverse = np.unique(block, return_inverse=True)
        return np.bincount(inverse, weights=without**2 - with_**2, minlength=len(names))

    def _left(self, chosen: Chosen, part: str) -> Samples:
        """White residual of a part, with the best constant for it."""
        rows = self.signal.rows(part)
        white = self.signal.white(chosen)[rows]
        return np.asarray(white - white.mean())


def helped(gains: Float64[np.ndarray, " b"]) -> float:
    """The chance of blocks gaining so much when they gain nothing on average; certain where there are too few.

    By Student's test, or by Wilcoxon's where that is surer: one block beyond all that was fitted must not decide.
    """
    if len(gains) < LEAST_BLOCKS or not gains.std():
        return 1.0
    by_mean = float(student.sf(gains.mean() / (gains.std(ddof=1) / np.sqrt(len(gains))), len(gains) - 1))
    return min(by_mean, float(wilcoxon(gains, alternative="greater").pvalue))
