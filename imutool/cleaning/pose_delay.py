"""Delay of the poses' stamps, by the cross-correlation of angular rates."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.cleaning.likelihood import STUDENT
from imutool.cleaning.samples import STEP_NS, STEP_S, Motion
from imutool.cleaning.truth import Truth, turning
from imutool.cleaning.unit_evidence import POSES_APART_NS
from imutool.recording import seconds
from imutool.recording.columns import median, quantile

MAX_POSES = 2000  # evenly taken from a longer log
LONGEST_DELAY_S, FINE_S = 2.0, 0.01
SLOW_S = 1.0  # length of the turns that find the delay: in steps of 0.1 s a fast walk fits one stride later as well
FINE_LAGS_S = FINE_S * np.arange(-12, 13)
REPEATED = 2.0  # times what the best delay leaves: if motion repeats, another delay may leave less; otherwise 2.6 and more
MIN_CORRELATION, WEAK = 0.8, 0.5  # of the whole log, and of a part
MIN_SHARED, MAX_STEPS = 300, 72_000  # steps of 0.1 s that two clocks share, and of a log that is searched for them
SHARES = 1.0, 0.95  # of the turns that count with their own length; longer ones, as where markers are exchanged, are cut to it
CERTAIN = 6.0  # standard deviations of Fisher's z; of 210 pairs of unrelated logs the best by chance had 5.3
DELAY_PARTS, FEWEST_PARTS = 8, 4  # parts whose own lags show how sure the delay is
SCALE_STEPS, GAUSS = 20, 1.4  # steps to Student's scale of a few parts, and by how much it is below a Gaussian's deviation
SEARCHES = (LONGEST_DELAY_S, 40, DELAY_PARTS), (0.5, 20, FEWEST_PARTS)  # longest delay, poses in each part, most parts
STEP_MIN_S, STEP_STDS = 0.03, 8.0  # of a step of one clock, at least; and in deviations of the parts on each side
STEP_CLEAR = 3.0  # of each side, the logarithm of a likelihood ratio of its own delay to the other's, with a sample each second


class Step(NamedTuple):
    """Step of the delay, by which it differs after a time from before, within a part of the log."""

    before_s: float
    after_s: float
    at_ns: int


def lateness(late_s: float, decimals: int = 0) -> str:
    """Delay in words, as `100 ms late` or `3.500 s early`; `decimals` are of milliseconds."""
    text = f"{abs(late_s):.3f} s" if abs(late_s) > LONGEST_DELAY_S else f"{1e3 * abs(late_s):.{decimals}f} ms"
    return f"{text} {'late' if late_s > 0 else 'early'}"


class Delay(NamedTuple):
    """Lateness of the poses' stamps against the gyro's, with its standard deviation.

    With a step of one of the clocks it is that of the larger part of the log.
    """

    seconds: float
    std_s: float
    step: Step | None = None


def pose_delay(motion: Motion, truth: Truth) -> Delay | None:
    """Delay of the poses' stamps by the lengths of the rates; None where it is not shown.

    Where no delay up to `LONGEST_DELAY_S` fits, the poses may be on a clock of their own. The gyro's median is its bias, but
    for a body that turns on and on about one axis: where nothing fits, no bias is taken off. Where still nothing fits, the
    longest turns are cut, since a few jumps of the poses hide the motion.
    """
    bias = median(motion.table()[1][:, :3])
    for share in SHARES:
        near = _near_delay(motion, truth, bias, share)
        if found := near or _far_delay(motion, truth, bias, share) or _far_delay(motion, truth, np.zeros(3), share):
            return found
    return None


def _far_delay(motion: Motion, truth: Truth, bias: Float64[np.ndarray, "3"], share: float) -> Delay | None:
    """Delay of any size, of poses that may be on a clock of their own."""
    apart_s = _clock_difference(motion, truth, bias, share)
    if apart_s is None:
        return None
    found = _near_delay(motion, truth._replace(t_ns=truth.t_ns - round(apart_s * 1e9)), bias, share)
    if found is None:
        return None
    step = found.step and Step(apart_s + found.step.before_s, apart_s + found.step.after_s, found.step.at_ns)
    return Delay(apart_s + found.seconds, found.std_s, step)


def _clock_difference(motion: Motion, truth: Truth, bias: Float64[np.ndarray, "3"], share: float) -> float | None:
    """Seconds from the IMU's clock to that of the poses, by the lengths of the rates at every lag.

    None if chance explains the best lag.
    """
    first, _, rate = turning(truth)
    step, mean = motion.table()
    true_s, start_ns = seconds(first, int(first[0])) + 0.5 * seconds(truth.t_ns[1:] - first, 0), motion.middle_ns
    count = int(true_s[-1] / STEP_S) + 1, int(step[-1] - step[0]) + 1
    if not all(MIN_SHARED <= n <= MAX_STEPS for n in count):
        return None
    true = np.interp(STEP_S * np.arange(count[0]), true_s, _cut(np.linalg.norm(rate, axis=1), share))
    gyro = np.interp(step[0] + np.arange(count[1]), step, _cut(np.linalg.norm(mean[:, :3] - bias, axis=1), share))
    from imutool.inertial.correlation import cross_correlation  # scipy, which poses on the IMU's clock never need

    found = cross_correlation(gyro, true, MIN_SHARED)
    lag, value, sigma = found.best(np.ones(len(found.lag), bool))
    if value < WEAK or sigma < CERTAIN:
        return None
    return 1e-9 * (int(first[0]) - start_ns) + STEP_S * (lag - int(step[0]) - 0.5)


def _cut(lengths: Float64[np.ndarray, "*rows n"], share: float) -> Float64[np.ndarray, "*rows n"]:
    """Lengths, those beyond a share of all as long as its longest."""
    return lengths if share == 1.0 or not lengths.size else np.minimum(lengths.T, quantile(lengths.T, share)).T


def _near_delay(motion: Motion, truth: Truth, bias: Float64[np.ndarray, "3"], share: float) -> Delay | None:
    """Delay of at most `LONGEST_DELAY_S`, and of less in a short log."""
    period_ns = max(STEP_NS, int(median(np.diff(truth.t_ns))))  # poses at 25 Hz are 80 and 120 ms apart here
    steps = max(1, round(SLOW_S * 1e9 / period_ns)), 1
    for longest_s, fewest, max_parts in SEARCHES:
        slow, fast = (_Turns.of(motion, truth, n, period_ns, bias, longest_s, share) for n in steps)
        count = min(max_parts, min(len(slow.size) + fewest, len(fast.size)) // fewest)  # of the slow ones a log holds fewer
        if count >= FEWEST_PARTS:
            return _searched(slow, fast, longest_s, count, motion.middle_ns)
    return None


def _searched(slow: _Turns, fast: _Turns, longest_s: float, count: int, start_ns: int) -> Delay | None:
    """Delay by turns over a second, refined by turns between neighbouring poses, in `count` parts."""
    coarse = np.arange(-longest_s, longest_s + 1e-9, STEP_S)
    slowly = slow.correlations(coarse, count)
    if count == DELAY_PARTS and (stepped := _stepped(fast, coarse, slowly, start_ns)) is not None:
        return stepped
    whole = slowly[:, 0]
    at = _best(coarse, whole)
    if whole[at] < MIN_CORRELATION or at in (0, len(coarse) - 1):
        return None
    lags = coarse[at] + FINE_LAGS_S
    fine = fast.correlations(lags, count)
    if fine[:, 0].max() < MIN_CORRELATION:
        return None
    peaks = np.array([_peak(lags, column) for column in fine.T])
    parts = peaks[1:][np.isfinite(peaks[1:])]
    if not np.isfinite(peaks[0]) or len(parts) < FEWEST_PARTS:
        return None
    return Delay(float(peaks[0]), _scatter(parts) / len(parts) ** 0.5)


def _best(lags: Float64[np.ndarray, " l"], values: Float64[np.ndarray, " l"]) -> int:
    """Place of the largest correlation, or of the peak nearest to no delay among those that are nearly as large.

    A pendulum fits as well a swing later.
    """
    remaining, largest = 1.0 - values**2, int(np.argmax(values))
    peaks = np.flatnonzero((values[1:-1] >= np.maximum(values[:-2], values[2:])) & (values[1:-1] > 0.0)) + 1
    alike = np.append(peaks[remaining[peaks] <= REPEATED * remaining[largest]], largest)
    return int(alike[np.argmin(np.abs(lags[alike]))])


def _scatter(parts: Float64[np.ndarray, " p"]) -> float:
    """Standard deviation of the parts' delays by Student's scale, so that one part that errs does not decide."""
    off = np.square(parts - median(parts))
    squared = max(float(off.mean()), 1e-18)
    for _ in range(SCALE_STEPS):
        squared = max(float(((STUDENT + 1.0) * off / (STUDENT + off / squared)).mean()), 1e-18)
    return float(GAUSS * squared**0.5)


def _stepped(
    fast: _Turns, coarse: Float64[np.ndarray, " l"], slowly: Float64[np.ndarray, "l p"], start_ns: int
) -> Delay | None:
    """Delay of the larger side of a step, which parts show whose own delays are alike on each side of it alone."""
    best = [_best(coarse, column) for column in slowly.T]
    own = np.where(slowly.max(axis=0) < MIN_CORRELATION, np.nan, coarse[best])[1:]
    parts = np.full(DELAY_PARTS, np.nan)
    for centre in {*own[np.isfinite(own)].tolist()}:  # np.unique imports numpy.ma, a sixteenth of `info`
        fine = fast.correlations(centre + FINE_LAGS_S, DELAY_PARTS)[:, 1:]
        for row in np.flatnonzero(own == centre):
            parts[row] = _peak(centre + FINE_LAGS_S, fine[:, row])
    found: list[tuple[float, Delay]] = []
    for within in range(1, DELAY_PARTS):  # the part that the step divides, or that begins with it
        sides = [side[np.isfinite(side)] for side in (parts[:within], parts[min(within + 1, DELAY_PARTS - 1) :])]
        if min(map(len, sides)) == 0 or sum(map(len, sides)) < DELAY_PARTS - 2:
            continue
        before_s, after_s = (float(median(side)) for side in sides)
        residual = np.concatenate([sides[0] - before_s, sides[1] - after_s])
        std_s = float(np.sqrt((residual**2).sum() / (len(residual) - 2)))
        if abs(after_s - before_s) > max(STEP_MIN_S, STEP_STDS * std_s) and fast.tell_apart(before_s, after_s, within):
            at_ns = start_ns + round(1e9 * float(np.array_split(fast.first_s, DELAY_PARTS)[within][0]))
            larger = int(len(sides[1]) > len(sides[0]))
            delay_s = (before_s, after_s)[larger]
            found.append((std_s, Delay(delay_s, std_s / len(sides[larger]) ** 0.5, Step(before_s, after_s, at_ns))))
    return min(found, key=lambda each: each[0], default=(0.0, None))[1]


class _Turns(NamedTuple):
    """Turns between poses, and the gyro's mean in each step.

    A turn has its size (rad/s), its beginning and its end (s, on the IMU's clock). `share` is of the turns that are not cut.
    """

    size: Float64[np.ndarray, " n"]
    first_s: Float64[np.ndarray, " n"]
    last_s: Float64[np.ndarray, " n"]
    gyro: StepIntegral
    share: float

    @classmethod
    def of(
        cls,
        motion: Motion,
        truth: Truth,
        spacing: int,
        period_ns: int,
        bias: Float64[np.ndarray, "3"],
        longest_s: float,
        share: float,
    ) -> _Turns:
        """Turns between poses that are `spacing` rows apart, as far as the gyro covers them at every delay."""
        first, last, rate = turning(truth, spacing)
        step, mean = motion.table()
        use, first_s, last_s = usable(first, last, motion.middle_ns, step, POSES_APART_NS + (spacing - 1) * period_ns)
        inside = (first_s > longest_s + STEP_S * step[0]) & (last_s + longest_s < STEP_S * (step[-1] + 1))
        gyro = StepIntegral.of(step, mean[:, :3] - bias)
        return cls(_cut(np.linalg.norm(rate[use[inside]], axis=1), share), first_s[inside], last_s[inside], gyro, share)

    def correlations(self, lags: Float64[np.ndarray, " l"], count: int) -> Float64[np.ndarray, "l p"]:
        """Correlations with the gyro at each lag: of all turns, and of each of `count` parts of the log."""
        means = (self.gyro.between(self.first_s - lag, self.last_s - lag) for lag in lags)
        measured = _cut(np.stack([np.linalg.norm(mean, axis=1) for mean in means]), self.share)
        parts = zip(np.array_split(self.size, count), np.array_split(measured, count, axis=1), strict=True)
        return np.stack([_correlations(self.size, measured), *(_correlations(*part) for part in parts)], axis=1)

    def tell_apart(self, before_s: float, after_s: float, within: int) -> bool:
        """Whether the parts before and those after one of them each fit their own delay clearly better than the other's."""
        before, after = np.log(
            1.0 - np.square(self.correlations(np.array([before_s, after_s]), DELAY_PARTS)[:, 1:]).clip(max=1.0 - 1e-9)
        )
        spans_s = np.array([np.ptp(part) for part in np.array_split(self.first_s, DELAY_PARTS)])
        gain = 0.5 * spans_s * (after - before)
        return bool(min(gain[:within].sum(), -gain[min(within + 1, DELAY_PARTS - 1) :].sum()) > STEP_CLEAR)


def _correlations(a: Float64[np.ndarray, " n"], rows: Float64[np.ndarray, "l n"]) -> Float64[np.ndarray, " l"]:
    a, rows = a - a.mean(), rows - rows.mean(axis=1, keepdims=True)
    return np.asarray((a * rows).sum(axis=1) / np.sqrt(np.maximum((a * a).sum() * (rows * rows).sum(axis=1), 1e-300)))


def _peak(lags: Float64[np.ndarray, " l"], values: Float64[np.ndarray, " l"]) -> float:
    """Place of the largest value, between steps; NaN if it is weak or at an end."""
    best = int(np.argmax(values))
    if values[best] < WEAK or best in (0, len(lags) - 1):
        return float("nan")
    before, at, after = values[best - 1 : best + 2]
    curve = before - 2.0 * at + after
    return float(lags[best] + (0.5 * (before - after) / curve * FINE_S if curve < 0 else 0.0))


class StepIntegral(NamedTuple):
    """Integral over the means of steps, at the steps' edges (s)."""

    edges_s: Float64[np.ndarray, " e"]
    columns: Float64[np.ndarray, "3 e"]

    @classmethod
    def of(cls, step: Int64[np.ndarray, " m"], values: Float64[np.ndarray, "m 3"]) -> StepIntegral:
        """Integral of some steps.

        Missing steps count as one wide step with the mean of its neighbours: the cost goes by samples, whatever the stamps say.
        """
        edges = STEP_S * np.stack([step, step + 1], axis=1).reshape(-1)
        means = np.repeat(values, 2, axis=0)[:-1]
        means[1::2] = 0.5 * (values[1:] + values[:-1])
        whole = np.concatenate([np.zeros((1, 3)), np.cumsum(means * np.diff(edges)[:, None], axis=0)])
        edges, rows = np.unique(edges, return_index=True)
        return cls(edges, np.ascontiguousarray(whole[rows].T))

    def between(self, first_s: Float64[np.ndarray, " n"], last_s: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 3"]:
        """Mean of the values between two times."""
        a, b = (np.stack([np.interp(t, self.edges_s, column) for column in self.columns], axis=1) for t in (first_s, last_s))
        mean: Float64[np.ndarray, "n 3"] = (b - a) / (last_s - first_s)[:, None]
        return mean


def usable(
    first_ns: Int64[np.ndarray, " n"],
    last_ns: Int64[np.ndarray, " n"],
    start_ns: int,
    step: Int64[np.ndarray, " m"],
    longest_ns: int = POSES_APART_NS,
) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:
    """Pairs of poses less than `longest_ns` apart, inside the IMU's time: rows, ends (s)."""
    first_s, last_s = seconds(first_ns, start_ns), seconds(last_ns, start_ns)
    use = np.flatnonzero((first_s > STEP_S * step[0]) & (last_s < STEP_S * (step[-1] + 1)) & (last_ns - first_ns < longest_ns))
    use = use[:: max(1, -(-len(use) // MAX_POSES))]
    return use, first_s[use], last_s[use]
