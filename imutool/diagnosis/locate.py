"""Where a misfit lies: on which axes, in which stretches of time, and in which regime of the motion.

What the findings add to the simulation is known almost without noise, so that place is read from it: a second counts when the
misfit in it would stand out of the noise by itself. The regime is the variable, with a threshold, that best tells the seconds
with misfit from those without (Youden's index), if it does so better than chance (Mann and Whitney's test, times the
variables tried).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float64
from scipy.stats import chi2, mannwhitneyu

from imutool.diagnosis.result import Located
from imutool.units import AXES

WINDOW_S = 1.0
CLEAR = 12.0  # squares of misfit over noise by which a second, or an axis, stands out of it
AXIS_SHARE = 0.02  # of the strongest axis' squares, below which an axis is only touched
JOIN_S = 1.5  # intervals closer than this are one
TELLS = 0.35  # Youden's index above which a regime is worth its words
SIGNALS = ("gyro", "accel")
CHANCE = 1e-3


def located(
    t_s: Float64[np.ndarray, " n"],
    misfit: Float64[np.ndarray, "n 6"],
    noise: Float64[np.ndarray, "6"],
    variables: Mapping[str, tuple[str, Float64[np.ndarray, " n"]]],
    p_values: Mapping[str, float],
) -> list[Located]:
    """One entry a signal in which there is a misfit: what was read less what was expected, without noise, sample by sample.

    Samples may be of several stretches of one log; seconds without any are nowhere.
    What has been found (`p_values`) and is too small for any one second to show it lies everywhere.

    `variables` are what a regime can be of, by how they are called, with unit and values at the samples.
    """
    found = []
    scaled = (misfit - np.median(misfit, axis=0)) / noise
    seconds, window = np.unique(np.floor((t_s - t_s[0]) / WINDOW_S), return_inverse=True)
    for k, signal in enumerate(SIGNALS):
        part = scaled[:, 3 * k : 3 * k + 3] ** 2
        axes_power = part.sum(axis=0)
        axes = [a for a in range(3) if axes_power[a] > max(CLEAR, AXIS_SHARE * axes_power.max())]
        power = np.bincount(window, weights=part.sum(axis=1))
        inside = power > CLEAR
        if axes and not inside.any() and p_values.get(signal, 1.0) < CHANCE:
            inside = np.ones(len(power), bool)  # found over all of the time, though no second shows it by itself
        if not axes or not inside.any():
            continue
        found.append(
            Located(
                signal,
                tuple(AXES[a] for a in axes),
                tuple(intervals(float(t_s[0]) + WINDOW_S * seconds[inside])),
                regime(inside, power, window, variables),
                float(power[inside].sum() / max(power.sum(), 1e-300)),
                p_values.get(signal, float(chi2.sf(axes_power.sum(), 3))),
            )
        )
    return sorted(found, key=lambda one: one.p_value)


def intervals(begins_s: Float64[np.ndarray, " w"]) -> list[tuple[float, float]]:
    """Stretches of windows, by where each begins; those close to one another are joined."""
    out: list[tuple[float, float]] = []
    for begin in begins_s.tolist():
        if out and begin - out[-1][1] < JOIN_S - WINDOW_S:
            out[-1] = out[-1][0], begin + WINDOW_S
        else:
            out.append((begin, begin + WINDOW_S))
    return out


def regime(
    inside: Bool[np.ndarray, " w"],
    power: Float64[np.ndarray, " w"],
    window: np.ndarray,
    variables: Mapping[str, tuple[str, Float64[np.ndarray, " n"]]],
) -> str:
    """In words: "angular rate above 0.4 rad/s", or "always"."""
    high = inside if not inside.all() else power > np.median(power)
    if high.all() or not high.any():
        return "always"
    counts = np.maximum(np.bincount(window), 1)
    best: tuple[float, str] | None = None
    for name, (unit, values) in variables.items():
        level = np.bincount(window, weights=values) / counts
        for sign, word in ((1.0, "above"), (-1.0, "below")):
            index, threshold = _youden(sign * level, high)
            p = float(mannwhitneyu(sign * level[high], sign * level[~high], alternative="greater").pvalue) * 2 * len(variables)
            if p < CHANCE and index > TELLS and (best is None or index > best[0]):
                best = index, f"{name} {word} {sign * threshold:.2g} {unit}".strip()
    if best is None:
        return "no regime: it comes and goes" if not inside.all() else "always"
    return best[1] if not inside.all() else f"always, most with {best[1]}"


def _youden(level: Float64[np.ndarray, " w"], high: Sequence[bool] | Bool[np.ndarray, " w"]) -> tuple[float, float]:
    """The threshold above which most of the high windows and fewest of the others lie, and by how much."""
    order = np.argsort(level)
    flags = np.asarray(high)[order]
    above_high = 1.0 - np.cumsum(flags) / max(flags.sum(), 1)
    above_low = 1.0 - np.cumsum(~flags) / max((~flags).sum(), 1)
    k = int(np.argmax(above_high - above_low))
    return float(above_high[k] - above_low[k]), float(0.5 * (level[order][k] + level[order][min(k + 1, len(level) - 1)]))
