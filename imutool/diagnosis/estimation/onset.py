"""When an effect sets in, and how surely: nothing is smooth in such a time, so all times near it are gone through."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from imutool.diagnosis.estimation.forward_cache import Chosen
from imutool.diagnosis.estimation.gauss_newton import Fit, WhitenedLog, fit

NEAR_S, MOST_TIMES = 0.4, 41  # around where a fit put it: as far as the filter of a band smears it


def estimate_onsets(
    logs: Sequence[WhitenedLog], found: Fit, part: str, inflation: float
) -> tuple[Fit, dict[tuple[str, int], float]]:
    """The fit with each such time at its mean over what the rows leave likely, and the standard deviation of that (s).

    A time is as likely as exp(-squares / 2), the squares divided by `inflation` where they are more than noise.
    """
    period_s = max(log.pair.period_s for log in logs)
    spread: dict[tuple[str, int], float] = {}
    for k, (physics, theta) in enumerate(found.chosen):
        for j, number in enumerate(physics.parameters):
            if not number.begins or not np.isfinite(theta[j]):
                continue
            step_s = max(period_s, 2.0 * NEAR_S / (MOST_TIMES - 1))
            t_s = theta[j] + step_s * np.arange(-(MOST_TIMES // 2), MOST_TIMES // 2 + 1)
            squares = np.array([_left(logs, found, k, j, float(t), part) for t in t_s])
            likely = np.exp(-(squares - squares.min()) / (2.0 * inflation))
            likely /= likely.sum()
            mean = float(likely @ t_s)
            spread[physics.key, j] = float(np.sqrt(likely @ (t_s - mean) ** 2 + step_s**2 / 12.0))
            found = fit(logs, _at(found, k, j, mean), part=part, iterations=0)
    return found, spread


def _left(logs: Sequence[WhitenedLog], found: Fit, k: int, j: int, t_s: float, part: str) -> float:
    """Squares that are left with another time, all else as it is but for the constants."""
    return fit(logs, _at(found, k, j, t_s), part=part, iterations=0).objective


def _at(found: Fit, k: int, j: int, t_s: float) -> Chosen:
    theta: Float64[np.ndarray, " p"] = found.chosen[k][1].copy()
    theta[j] = t_s
    return (*found.chosen[:k], (found.chosen[k][0], theta), *found.chosen[k + 1 :])
