"""Low-pass and clock offset, which may take each other's lag."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import Chosen
from imutool.diagnosis.estimation.observability import LOW_PASSES, beyond_the_band
from imutool.diagnosis.estimation.whitening import WhitenedLog
from imutool.diagnosis.settings import SearchSettings
from imutool.sensor.effect import Effect, Theta
from imutool.sensor.effects import low_pass


def beside_offset(logs: Sequence[WhitenedLog], others: Chosen, effect: Effect, starts: Sequence[Theta]) -> list[Chosen]:
    """Starts of fits with one more effect; a low-pass also takes its lag back from a clock.

    An offset that was fitted first (clocks without a common epoch are aligned by the motion) has taken the filter's lag. Steps
    from there end early where a lag is a period of a vibration: the filter is too fast, and other effects take the rest. The
    second begins with the start that leaves least.
    """
    begun = [chosen for start in starts for chosen in lag_taken_back(others, effect, start)]
    fits = sorted((fit(logs, chosen, iterations=0) for chosen in begun), key=lambda found: found.objective)
    return [(*others, (effect, starts[0])), *(found.chosen for found in fits[:1])]


def lag_taken_back(others: Chosen, effect: Effect, start: Theta) -> list[Chosen]:
    """Effects with a low-pass whose lag a clock offset no longer takes; none without both."""
    place = next((k for k, (other, _) in enumerate(others) if other.name == "clock_offset"), None)
    if place is None or effect.lagless is None:
        return []
    offset, tau_s = others[place]
    return [(*others[:place], (offset, tau_s + np.array([low_pass.lag_s(start)])), *others[place + 1 :], (effect, start))]


def without_unseen_low_pass(logs: Sequence[WhitenedLog], now: Fit, named: Sequence[Effect], settings: SearchSettings) -> Fit:
    """Fit with a clock offset for a low pass beyond the poses' band, which its delay shows."""
    offset = next((e for e in named if e.name == "clock_offset" and e.key not in now.keys), None)
    for k, (effect, theta) in enumerate(now.chosen):
        if offset is not None and effect.name in LOW_PASSES and beyond_the_band(effect, theta, logs, settings):
            delayed = offset, np.array([-low_pass.lag_s(theta)])  # far below its cut-off
            return fit(logs, (*now.chosen[:k], *now.chosen[k + 1 :], delayed), near=now)
    return now
