"""Timestamps and converter: missing samples, stamp jitter, quantization, saturation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.ndimage import binary_dilation, median_filter
from scipy.signal import savgol_filter
from scipy.stats import binom, norm

from imutool.array_types import Bool, Float64, Rows6
from imutool.diagnosis.estimation.aligned_log import DEFAULT, Pair
from imutool.diagnosis.result import Estimate, Finding, HeldOut
from imutool.diagnosis.settings import TimestampSettings
from imutool.inertial.stationary import white_noise
from imutool.sensor.effect import Effect, Parameter, Stage, Theta, starts_at
from imutool.sensor.effects import saturation
from imutool.units import ASCII_UNITS, AXES, COLUMNS, SENSORS, UNITS

SHARES = (0.999, 0.99, 0.97, 0.9, 0.8)  # of the largest reading, where a soft limit is looked for
MIN_VALUES, MIN_ROWS = 3, 100  # of a grid
OWN_LIMIT = 0.1  # of the largest reading of a sensor, that the limit of one axis is at least
READ, NOISY = 0.999, 6.0  # of the readings are no glitch; deviations of a sample by which noise goes beyond a limit
FINER = 0.05  # of the noise, that readings differ by right below a limit
JITTER, UNEVEN = "timestamp_jitter", "stamps jitter, samples do not"


def even(
    stamp_s: Float64[np.ndarray, " n"], settings: TimestampSettings = DEFAULT.timestamps
) -> tuple[Float64[np.ndarray, " n"], int]:
    """Stamps of an even clock fitted to the stamps, and the number of missing samples.

    The period is the one in which the stamps agree best: missing samples do not change it. A running median of what each stamp
    counts, less its number, says which are missing though every stamp jitters. In steady stamps long steps say it: a phone that
    follows the network's time runs its clock faster or slower for seconds.
    """
    k, since, steps = np.arange(len(stamp_s), dtype=np.float64), stamp_s - stamp_s[0], np.diff(stamp_s)
    periods = np.maximum(np.rint(steps / np.median(steps)), 1.0)
    missing = np.concatenate([[0.0], np.cumsum(periods - 1.0)])
    if (np.abs(steps / np.median(steps) - periods) > settings.clear_share).any():
        period, phase, agree = _period(since, settings)
        missing = counted = np.rint((since - phase) / period) - k
        # a stamp well within its own period is taken at its word
        clear = np.abs((since - phase) / period - k - counted) < settings.clear_share
        if agree < settings.min_agreement:
            missing = _by_level(stamp_s, k, settings)
        elif not clear.all():
            steady = median_filter(counted, settings.median_samples, mode="nearest")
            missing = np.where(clear & (np.abs(counted - steady) <= 0.5), counted, steady)
    slope, start = np.polyfit(k + missing, stamp_s, 1)
    return start + slope * (k + missing), int(missing[-1] - missing[0])


def _by_level(
    stamp_s: Float64[np.ndarray, " n"], k: Float64[np.ndarray, " n"], settings: TimestampSettings
) -> Float64[np.ndarray, " n"]:
    """Samples that are missing before each, under large jitter: one that is missing lifts the level of all later ones."""
    lag = settings.lag_samples
    period = float(np.median(stamp_s[lag:] - stamp_s[:-lag])) / lag
    missing = np.zeros(len(stamp_s))
    for _ in range(4):
        slope, start = np.polyfit(k + missing, stamp_s, 1)
        period = slope if missing.any() or abs(slope / period - 1.0) < 0.1 / len(k) else period
        level = median_filter((stamp_s - start) / period - k, settings.median_samples, mode="nearest")
        missing = np.maximum.accumulate(np.rint(level - level[0]))
    return missing


def _period(since_s: Float64[np.ndarray, " n"], settings: TimestampSettings) -> tuple[float, float, float]:
    """Period (s) in which the stamps agree best, its phase (s), and the agreement."""
    best = float(np.median(np.diff(since_s)))
    span = settings.period_span
    for count in (settings.period_samples, len(since_s)):
        first_s, slowest = since_s[:count], (1.0 - span) / best
        step = 2.0 * span / (settings.periods - 1) / best
        turned, by = np.exp(2j * np.pi * slowest * first_s), np.exp(2j * np.pi * step * first_s)
        agree = [abs(turned.sum()), *(abs(np.multiply(turned, by, out=turned).sum()) for _ in range(settings.periods - 1))]
        best, span = 1.0 / (slowest + step * int(np.argmax(agree))), 4.0 * span / settings.periods
    mean = np.exp(2j * np.pi * since_s / best).mean()
    return best, float(np.angle(mean)) / (2.0 * np.pi) * best, float(abs(mean))


def jitter(pairs: Sequence[Pair]) -> tuple[Effect, ...]:
    """Timestamp jitter of evenly taken samples as an effect; a share of one is all of it."""
    settings = pairs[0].settings.timestamps
    corrections = [(pair.stamp_s, even(pair.stamp_s, settings)[0] - pair.stamp_s) for pair in pairs]
    if min(float(x.std()) for _, x in corrections) < settings.min_jitter_s:
        return ()

    def forward(taken_s: Float64[np.ndarray, " n"], theta: Theta) -> Float64[np.ndarray, " n"]:
        same_length = (entry for entry in corrections if len(entry[0]) == len(taken_s))
        _, correction = min(same_length, key=lambda entry: abs(float(entry[0][0] - taken_s[0])))
        return np.asarray(taken_s + theta[0] * correction + theta[1] + theta[2] * np.linspace(-1.0, 1.0, len(taken_s)))

    unsure = float(np.mean([x.std() / np.sqrt(len(x)) for _, x in corrections]))  # of the even clock's start
    share = (Parameter("share", "-", 1.0), Parameter("begins_off", "s", unsure), Parameter("ends_off", "s", 2.0 * unsure))
    return (Effect(JITTER, Stage.CLOCK, SENSORS, UNEVEN, share, "it moves, and stamps are uneven", forward),)


def by_samples(
    pairs: Sequence[Pair], name: str, signal: str, parameters: Mapping[str, Estimate], equation: str, p_value: float = 0.0
) -> Finding:
    """Finding that samples and stamps show by themselves, without a fit."""
    length_s = sum(float(pair.stamp_s[-1] - pair.stamp_s[0]) for pair in pairs)
    return Finding(name, signal, 0.0, p_value, p_value, parameters, equation, HeldOut(0.0, 0.0, "-", round(length_s, 1)))


def uneven(pairs: Sequence[Pair], std_s: float, equation: str, p_value: float = 0.0) -> Finding:
    """Finding of stamps that are off by so much."""
    count = sum(len(pair.stamp_s) for pair in pairs)
    parameters = {"std": Estimate(std_s, float(std_s / np.sqrt(2.0 * count)), "s")}
    return by_samples(pairs, JITTER, "both", parameters, equation, p_value)


def dropped(pairs: Sequence[Pair]) -> list[Finding]:
    """Finding of dropped samples that an even clock would have had."""
    settings, total = pairs[0].settings.timestamps, sum(len(pair.stamp_s) for pair in pairs)
    missing = sum(even(pair.stamp_s, settings)[1] for pair in pairs)
    if missing < settings.min_missing:
        return []
    share = Estimate(missing / (missing + total), float(np.sqrt(missing)) / (missing + total), "-")
    parameters = {"share": share, "missing": Estimate(float(missing), 0.0, "samples")}
    return [by_samples(pairs, "dropped_samples", "both", parameters, "samples are missing")]


def rounded(pairs: Sequence[Pair], floor: Float64[np.ndarray, "6"]) -> list[Finding]:
    """Finding of quantization: values on a grid as coarse as the noise."""
    settings, lsb = pairs[0].settings.timestamps, {}
    for signal, part in COLUMNS.items():
        axes = [x for pair in pairs for x in pair.real[:, part].T]
        grids = [grid(x, settings) for x in axes if len(np.unique(x)) >= MIN_VALUES] or [0.0]  # fewer lie on any grid
        noise = float(np.sqrt(np.mean(floor[part] ** 2)))
        if min(grids) > settings.min_digits * noise and max(grids) < 1.5 * min(grids):
            lsb[signal] = float(np.median(grids))
    if not lsb:
        return []
    of = "both" if len(lsb) > 1 else next(iter(lsb))
    parameters = {f"{name}_lsb": Estimate(value, 1e-3 * value, UNITS[name]) for name, value in lsb.items()}
    return [by_samples(pairs, "quantization", of, parameters, "values are multiples of an LSB")]


def grid(x: Float64[np.ndarray, " n"], settings: TimestampSettings = DEFAULT.timestamps) -> float:
    """Grid step of values; 0 where they lie on no grid or take fewer than three values."""
    values = np.unique(np.round(x, 12))
    if len(values) < MIN_VALUES:
        return 0.0
    step = float(np.diff(values).min())
    for _ in range(3):  # least squares on the multiples
        k = np.rint((values - values[0]) / step)
        step = float((k @ (values - values[0])) / (k @ k))
    off = np.abs((x - values[0]) / step - np.rint((x - values[0]) / step))
    return step if float((off < 0.05).mean()) > settings.grid_share else 0.0


def limits(real: Rows6, settings: TimestampSettings = DEFAULT.timestamps) -> dict[str, float]:
    """Limits of the converters: the largest readings of a side that recur to the last digit.

    By sensor; by axis (`gyro_x`) where another axis of the sensor reads more.
    """
    highest, moves = dict[str, float](), ~stuck(real)  # a dead axis has no limit
    for k, signal in enumerate(SENSORS):
        own = [a for a in range(3 * k, 3 * k + 3) if moves[a]]
        varied = [a for a in own if len(np.unique(real[:, a])) > MIN_ROWS]
        by_axis = {f"{signal}_{AXES[a % 3]}": _limit(real[:, [a]], settings) for a in varied}
        common, minimum = _limit(real[:, own], settings), OWN_LIMIT * float(np.abs(real[:, own]).max(initial=0.0))
        highest |= {signal: common} if common else {key: limit for key, limit in by_axis.items() if limit > minimum}
    return highest


def _limit(values: Float64[np.ndarray, "n k"], settings: TimestampSettings) -> float:
    """Largest reading of some axes if it is a limit, else 0."""
    at, next_to, limit = 0, 0, float(np.abs(values).max(initial=0.0))
    for side in (values, -values):  # 16 bits end at -32768 and 32767
        if (end := float(side.max(initial=0.0))) >= settings.clipped_share * limit:
            below = side[side < end * (1.0 - 1e-9)]
            at, next_to = at + side.size - below.size, next_to + int((below >= below.max(initial=0.0) * (1.0 - 1e-9)).sum())
    # on a grid all come again, less at the ends
    return limit if at >= settings.min_at_limit and at > settings.piled_factor * next_to else 0.0


def soft_limits(pairs: Sequence[Pair], biases: Sequence[Float64[np.ndarray, "6"]]) -> tuple[Effect, ...]:
    """Saturation with noise on top, the bias ahead of it or, if a sensor corrects it, behind."""
    candidates = []
    for k, signal in enumerate(SENSORS):
        if any(key.startswith(signal) for pair in pairs for key in limits(pair.real, pair.settings.timestamps)):
            continue
        part = COLUMNS[signal]
        bias = np.mean([b[part] for b in biases], axis=0)
        for ahead, variant in ((bias, ("", "accel")[k]), (0.0 * bias, f"corrected {signal}")):
            real = [pair.real[:, part] - bias + ahead for pair in pairs]
            limit = float(max(np.abs(x).max() for x in real))
            lower = max(float(np.max(np.quantile(np.abs(x), READ) - NOISY * white_noise(x))) for x in real)
            L = Parameter(f"{signal}_limit", UNITS[signal], limit, positive=True, null_value=np.inf, step=1e-4, minimum=lower)
            starts, text = starts_at(*([share * limit] for share in SHARES)), f"{signal} = clip({signal}, -L, L)"
            given = "saturation", Stage.CONVERTER, (signal,), text, (L,), "the limit is reached"
            clip = saturation.BiasedClip(k, ahead)
            candidates.append(Effect(*given, clip, False, starts, variant=variant))
    return tuple(candidates)


def clipped(real: Rows6, settings: TimestampSettings = DEFAULT.timestamps) -> Bool[np.ndarray, "n 6"]:
    """Clipped samples of an axis, and their neighbours, which filters mix with them."""
    at = np.zeros(real.shape, bool)
    for key, limit in limits(real, settings).items():
        *_, part = saturation.of_limit(key)
        at[:, part] = np.abs(real[:, part]) >= settings.clipped_share * limit
    return np.asarray(binary_dilation(at, np.ones((5, 1), bool))) if at.any() else at


def stuck(real: Rows6) -> Bool[np.ndarray, "6"]:
    """Stuck axes, which read the same in every sample."""
    return np.asarray(np.ptp(real, axis=0) == 0.0)


def saturated(pairs: Sequence[Pair], expected: Sequence[Float64[np.ndarray, "_ 6"]], tried: int) -> list[Finding]:
    """Finding of saturation: the expectation exceeds clipped samples (sign test)."""
    settings, parameters = pairs[0].settings.timestamps, dict[str, Estimate]()
    powers, signal_of, p = [0.0, 0.0, 0.0], "", 1.0
    real, model = (np.concatenate(parts) for parts in ([pair.real for pair in pairs], expected))
    for key, limit in limits(real, settings).items():
        name, signal, part = saturation.of_limit(key)
        at = np.abs(real[:, part]) >= limit * (1.0 - settings.limit_error)
        beyond = (model[:, part] * np.sign(real[:, part]))[at] > limit
        below = np.abs(real[:, part])[np.abs(real[:, part]) < limit * (1.0 - 1e-9)].max(initial=0.0)
        is_cut = limit - below < FINER * white_noise(real[:, part]).max()  # no grid makes it recur; a bias may hide the cut
        chance = 0.0 if is_cut else float(binom.sf(beyond.sum() - 1, len(beyond), 0.5)) * tried
        if chance > 1e-2 and beyond.mean() < 0.9:
            continue
        parameters[name] = Estimate(limit, settings.limit_error * limit, UNITS[signal])
        before = ((real - model)[:, part] ** 2)[at]
        after = ((real[:, part] - np.clip(model[:, part], -limit, limit)) ** 2)[at]
        powers, signal_of, p = [float(before.sum()), float(after.sum()), float(at.size)], signal, min(p, chance)
    if not parameters:
        return []
    seen_in = signal_of if all(name.startswith(signal_of) for name in parameters) else "both"
    length = sum(float(pair.stamp_s[-1] - pair.stamp_s[0]) for pair in pairs)
    before_rms, after_rms = (float(np.sqrt(power / powers[2])) for power in powers[:2])
    held_out = HeldOut(before_rms, after_rms, ASCII_UNITS[signal_of], round(length, 1))
    share = float(np.clip(1.0 - powers[1] / max(powers[0], 1e-300), 0.0, 1.0))
    return [Finding("saturation", seen_in, share, p, p, parameters, "readings are clipped at +-limit", held_out)]


def late_stamps(pairs: Sequence[Pair]) -> list[Finding]:
    """Finding of timestamp jitter, where stamps are uneven and the samples are even."""
    settings = pairs[0].settings.timestamps
    lateness = [pair.stamp_s - even(pair.stamp_s, settings)[0] for pair in pairs]
    if min(float(x.std()) for x in lateness) < settings.min_jitter_s:
        return []
    logs = ((pair.real, late, pair.period_s) for pair, late in zip(pairs, lateness, strict=True))
    chance = _chance_of_following(logs, settings)
    if chance == 1.0:
        return []
    return [uneven(pairs, float(np.concatenate(lateness).std()), UNEVEN, chance)]


def without_jitter(
    stamp_s: Float64[np.ndarray, " n"], samples: Float64[np.ndarray, "n k"], settings: TimestampSettings = DEFAULT.timestamps
) -> Float64[np.ndarray, " n"]:
    """Stamps without jitter that the samples do not follow; holes and slow wander stay."""
    steps = np.diff(stamp_s)
    if steps.std() < settings.min_jitter_s:
        return stamp_s
    period_s = float(np.median(steps))
    late = stamp_s - stamp_s[0] - period_s * np.arange(len(stamp_s))
    late -= median_filter(late, 1 + 2 * round(settings.jitter_s / period_s), mode="nearest")
    return stamp_s if _chance_of_following([(samples, late, period_s)], settings) == 1.0 else stamp_s - late


def _chance_of_following(
    logs: Iterable[tuple[Float64[np.ndarray, "n k"], Float64[np.ndarray, " n"], float]], settings: TimestampSettings
) -> float:
    """p-value of samples that follow their stamps' lateness, given with the period; 1 unless they clearly do not."""
    followed_sum, weight = 0.0, 0.0
    for samples, late, period_s in logs:
        for column in samples.T:
            share, size = _followed(column, late, period_s, settings)
            followed_sum, weight = followed_sum + share * size, weight + size
    if weight <= 0.0:
        return 1.0
    share, sigma = followed_sum / weight, 1.0 / np.sqrt(weight)
    return 1.0 if share > 0.5 or 1.0 - share < settings.even_sigma * sigma else float(norm.sf((1.0 - share) / sigma))


def _followed(
    column: Float64[np.ndarray, " n"], late_s: Float64[np.ndarray, " n"], period_s: float, settings: TimestampSettings
) -> tuple[float, float]:
    """Share of the stamps' lateness that the samples follow, and its inverse variance."""
    if len(column) < MIN_ROWS:
        return 0.0, 0.0
    line = settings.line_samples, settings.line_degree
    slope = savgol_filter(column, *line, deriv=1, delta=period_s)
    moved = slope * late_s
    moved = moved - savgol_filter(moved, *line)
    rest = column - savgol_filter(column, *line)
    size = float(moved @ moved)
    share = float(moved @ rest) / max(size, 1e-300)
    variance = float(np.mean((rest - share * moved) ** 2))
    return share, size / max(variance, 1e-300)
