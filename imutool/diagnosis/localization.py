"""Localization of a misfit: axes of a signal, intervals, and the regime of the motion.

The misfit that the findings explain is known almost without noise, so the location is read from it: a second counts when the
misfit in it would stand out of the noise by itself. The regime is the variable, with a threshold, that best separates the
seconds with misfit from those without (Youden's index), if it does so better than chance (Mann and Whitney's test, times the
variables tried).
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.stats import chi2, mannwhitneyu

from imutool.array_types import Bool, Float64, Int64
from imutool.diagnosis.estimation.aligned_log import AlignedLog, Pair, Variables
from imutool.diagnosis.result import Extent, Finding, Located
from imutool.diagnosis.settings import LocalizationSettings
from imutool.units import AXES, COLUMNS

NONE, ALIKE = 0.01, 1e-6  # share of the samples that differ by less than this of the noise, as where there is no misfit
CALM_SHARE = 0.25  # of the seconds, that a misfit which comes and goes leaves alone
EDGE_S = 0.05  # from which on an interval begins later than its window, or ends earlier
FAR_MORE = 2.0  # times the squares that means hold, from which the samples count: what is so fast is lost in a mean
TIMES = ("after", "in the first")  # how a regime of the time begins, above and below its threshold
LOCALIZATION = LocalizationSettings()
Samples = Float64[np.ndarray, "_ k"]


class Misfit(NamedTuple):
    """Real minus expected samples; they have noise where means are formed (`averaged`)."""

    t_s: Float64[np.ndarray, " n"]
    samples: Float64[np.ndarray, "n k"]
    noise: Float64[np.ndarray, " k"]  # standard deviation of a sample, by column
    signals: Mapping[str, slice] = COLUMNS  # columns by signal; the axes of a signal of three are named
    averaged: Sequence[int] = ()  # samples of running means, the longest first


def locate_findings(
    pairs: Sequence[AlignedLog],
    before: Sequence[Samples],
    after: Sequence[Samples],
    floor: Float64[np.ndarray, " k"],
    findings: Sequence[Finding],
    p_values: Mapping[str, float],
) -> list[Located]:
    """Locations where the findings change the expected samples (`after` minus `before`)."""
    misfits = [_converter_output(a, findings) - b for a, b in zip(after, before, strict=True)]
    certain = [signal for signal, p_value in p_values.items() if p_value < pairs[0].settings.localization.p_value]
    return _locate_logs(pairs, misfits, floor, p_values, certain)


def locate_residual(
    pairs: Sequence[Pair],
    after: Sequence[Samples],
    floor: Float64[np.ndarray, "6"],
    p_values: Mapping[str, float],
) -> list[Located]:
    """Locations of unexplained residuals: running means beyond those of calm seconds, or all.

    `p_values` are those of white noise, by signal. Against an exact simulation the samples count where they hold far more than
    the means, which lose a vibration. Poses show no such motion.
    """
    residuals = [pair.real - a for pair, a in zip(pairs, after, strict=True)]
    longest = pairs[0].settings.localization.mean_samples
    counts = (longest, 1) if all(pair.exact for pair in pairs) else (longest,)
    located = _locate_logs(pairs, residuals, floor, p_values, p_values, averaged=counts)
    return [place for place in located if place.signal in p_values]


def _locate_logs(
    pairs: Sequence[AlignedLog],
    misfits: Sequence[Samples],
    floor: Float64[np.ndarray, " k"],
    p_values: Mapping[str, float],
    certain: Container[str],
    averaged: Sequence[int] = (),
) -> list[Located]:
    """Strongest first, log by log: `log` is the pair's name where there are several."""
    logs = list(dict.fromkeys(pair.name for pair in pairs))
    out = []
    for log in logs:
        segments = [(pair, misfit) for pair, misfit in zip(pairs, misfits, strict=True) if pair.name == log]
        located = _locate_log(segments, floor, p_values, certain, averaged)
        out += [msgspec.structs.replace(place, log=log) if len(logs) > 1 else place for place in located]
    return sorted(out, key=lambda place: place.p_value)


def _locate_log(
    segments: Sequence[tuple[AlignedLog, Samples]],
    floor: Float64[np.ndarray, " k"],
    p_values: Mapping[str, float],
    certain: Container[str],
    averaged: Sequence[int],
) -> list[Located]:
    """Segments of one log share its clock; each has its own constant."""
    t_s = np.concatenate([pair.stamp_s for pair, _ in segments])
    misfit = floor * np.concatenate([_without_bias(misfit / floor) for _, misfit in segments])
    each = [pair.variables() for pair, _ in segments]
    common = set.intersection(*map(set, each))  # a channel that is constant, or starts late, is not in every segment
    variables = {n: (unit, np.concatenate([own[n][1] for own in each])) for n, (unit, _) in each[0].items() if n in common}
    first = segments[0][0]
    placed = Misfit(t_s, misfit, floor, first.signals, averaged)
    return locate(placed, variables, p_values, certain, first.settings.localization)


def _converter_output(samples: Float64[np.ndarray, "n k"], findings: Sequence[Finding]) -> Float64[np.ndarray, "n k"]:
    """Clipped and rounded as the findings say."""
    out = samples.copy()
    values = {name: estimate.value for finding in findings for name, estimate in finding.parameters.items()}
    for sensor, part in COLUMNS.items():
        limit, lsb = values.get(f"{sensor}_limit"), values.get(f"{sensor}_lsb")
        own = [values.get(f"{sensor}_limit_{axis}", np.inf if limit is None else limit) for axis in AXES]
        if np.isfinite(own).any():  # else the columns may be those of another signal
            out[:, part] = np.clip(out[:, part], -np.array(own), own)
        if lsb is not None:
            out[:, part] = lsb * np.rint(out[:, part] / lsb)
    return out


def locate(
    misfit: Misfit,
    variables: Variables,
    p_values: Mapping[str, float],
    certain: Container[str] = (),
    settings: LocalizationSettings = LOCALIZATION,
) -> list[Located]:
    """Locations of a misfit by signal, strongest first; samples may span several segments.

    Args:
        misfit: samples of one log, with their noise.
        variables: what a regime can be of, by name, with unit and values at the samples.
        p_values: of the misfit by signal.
        certain: signals that have a misfit; where no single second shows it, it lies everywhere.
        settings: those of a diagnosis by default.
    """
    located, t_s, averaged = list[Located](), misfit.t_s, misfit.averaged
    scaled = _without_bias(misfit.samples / misfit.noise)
    seconds, window = np.unique(np.floor((t_s - t_s[0]) / settings.window_s), return_inverse=True)
    for signal, columns in misfit.signals.items():
        by_axis = np.stack([np.bincount(window, weights=column) for column in (scaled[:, columns] ** 2).T], axis=1)
        inside = by_axis.sum(axis=1) > settings.clear_squares
        if averaged:
            by_axis, inside = _beyond_noise(scaled[:, columns], window, averaged, settings)
        axes_power, power = by_axis.sum(axis=0), by_axis.sum(axis=1)
        minimum = max(settings.clear_squares, settings.axis_share * axes_power.max())
        axes = np.flatnonzero(axes_power > minimum).tolist()
        if axes and not inside.any() and signal in certain:
            inside = np.ones(len(power), bool)
        if not axes or not inside.any():
            continue
        begins = float(t_s[0]) + settings.window_s * seconds[inside]
        extent, text = regime(inside, power, window, variables, settings)
        located.append(
            Located(
                signal,
                tuple(AXES[a] for a in axes) if len(axes_power) == len(AXES) else (),
                tuple(_acting(intervals(begins, settings), t_s, scaled[:, columns])),
                text,
                float(power[inside].sum() / power.sum()),
                p_values.get(signal, 1.0),
                extent=extent,
            )
        )
    return sorted(located, key=lambda place: place.p_value)


def _without_bias(scaled: Samples) -> Samples:
    """Misfit over noise without a constant, which the bias takes: that of most samples which are alike, or the median.

    What sets in leaves the samples before it alike; behind a step of a bias they are alike, too, and the longer part counts.
    """
    out = scaled - np.median(scaled, axis=0)
    for k in range(out.shape[1]):
        _, first, counts = np.unique(np.rint(out[:, k] / ALIKE), return_index=True, return_counts=True)
        maximum = int(counts.argmax())
        out[:, k] -= out[first[maximum], k] if counts[maximum] > NONE * len(out) else 0.0
    return np.where(np.abs(out) < 2.0 * ALIKE, 0.0, out)


def _acting(
    found: Sequence[tuple[float, float]], t_s: Float64[np.ndarray, " n"], misfit: Samples
) -> Iterator[tuple[float, float]]:
    """Intervals from the first sample that differs to the last, where these are clearly inside."""
    differs = t_s[misfit.any(axis=1)]
    for ends in found:
        own = differs[(differs >= ends[0]) & (differs < ends[1])].tolist()
        if own:
            begin, end = (at if abs(at - edge) > EDGE_S else edge for at, edge in zip((own[0], own[-1]), ends, strict=True))
            yield begin, end


def _beyond_noise(
    samples: Float64[np.ndarray, "n k"],
    window: Int64[np.ndarray, " n"],
    averaged: Sequence[int],
    settings: LocalizationSettings,
) -> tuple[Float64[np.ndarray, "w k"], Bool[np.ndarray, " w"]]:
    """Squares of the longest means beyond those of noise, or of shorter ones that hold far more."""
    best = _of_means(samples, window, averaged[0], settings)
    for count in averaged[1:]:
        power, inside = _of_means(samples, window, count, settings)
        if inside.any() and power.sum() / count > FAR_MORE * best[0].sum() / averaged[0]:
            best = power, inside
    return best


def _of_means(
    samples: Float64[np.ndarray, "n k"], window: Int64[np.ndarray, " n"], averaged: int, settings: LocalizationSettings
) -> tuple[Float64[np.ndarray, "w k"], Bool[np.ndarray, " w"]]:
    """Squares of running means of each window beyond those of noise, and where an axis stands out of the calmest quarter.

    A sample of white noise has a square of one, and neighbouring means are nearly equal.
    """
    means, counts = uniform_filter1d(samples, averaged, axis=0), np.bincount(window)
    power = averaged * np.stack([np.bincount(window, weights=column) for column in (means**2).T], axis=1)
    usual = np.maximum(np.quantile(power / counts[:, None], CALM_SHARE, axis=0), 1.0) * counts[:, None]
    independent = np.maximum(counts * 3.0 * averaged / (2.0 * averaged**2 + 1.0), 1.0)  # by the sum of squared correlations
    stands_out = power > usual * (chi2.isf(settings.window_p_value, independent) / independent)[:, None]
    inside = stands_out.any(axis=1)
    if not inside.any():
        return np.maximum(power - counts[:, None], 0.0), inside
    return np.maximum(power - usual, 0.0) * inside[:, None], inside


def intervals(begins_s: Float64[np.ndarray, " w"], settings: LocalizationSettings) -> list[tuple[float, float]]:
    """Intervals of windows, by where each begins; neighbours are joined."""
    out: list[tuple[float, float]] = []
    for begin in begins_s.tolist():
        if out and begin - out[-1][1] < settings.join_s - settings.window_s:
            out[-1] = out[-1][0], begin + settings.window_s
        else:
            out.append((begin, begin + settings.window_s))
    return out


def regime(
    inside: Bool[np.ndarray, " w"],
    power: Float64[np.ndarray, " w"],
    window: np.ndarray,
    variables: Variables,
    settings: LocalizationSettings,
) -> tuple[Extent, str]:
    """Extent of a misfit, and its regime in words: "angular rate above 0.4 rad/s", "after 30 s"."""
    high = inside if not inside.all() else power > np.median(power)
    if not high.any():  # one window alone
        return "everywhere", "always"
    counts = np.bincount(window)
    best: tuple[float, str] | None = None
    for name, (unit, values) in variables.items():
        level = np.bincount(window, weights=values) / counts
        for sign, word in ((1.0, "above"), (-1.0, "below")):
            index, threshold = _youden(sign * level, high)
            p = float(mannwhitneyu(sign * level[high], sign * level[~high], alternative="greater").pvalue) * 2 * len(variables)
            if p < settings.p_value and index > settings.min_youden and (best is None or index > best[0]):
                best = index, _words(name, word, sign * threshold, unit)
    if best is None:
        return ("everywhere", "always") if inside.all() else ("intermittent", "no regime: it comes and goes")
    text = best[1]
    maximum = "most" if text.startswith(TIMES) else "most with"
    return ("everywhere", f"always, {maximum} {text}") if inside.all() else ("regime", text)


def _words(name: str, word: str, threshold: float, unit: str) -> str:
    """A regime in words; of the time it is a part of the log."""
    if name == "time":
        return f"{TIMES[word == 'below']} {threshold:.0f} {unit}"
    return f"{name} {word} {float(f'{threshold:.2g}'):g} {unit}".strip()


def _youden(level: Float64[np.ndarray, " w"], high: Sequence[bool] | Bool[np.ndarray, " w"]) -> tuple[float, float]:
    """Youden's index of the best threshold between high windows and others, and the threshold."""
    order = np.argsort(level)
    flags = np.asarray(high)[order]
    above_high = 1.0 - np.cumsum(flags) / flags.sum()
    above_low = 1.0 - np.cumsum(~flags) / (~flags).sum()
    k = int(np.argmax(above_high - above_low))
    return float(above_high[k] - above_low[k]), float(0.5 * (level[order][k] + level[order][min(k + 1, len(level) - 1)]))
