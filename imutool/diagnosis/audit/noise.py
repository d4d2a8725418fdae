"""Faults of a simulated IMU's noise, digits and lines, by a data sheet or a recording."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.fft import dct
from scipy.optimize import minimize_scalar
from scipy.signal import spectrogram
from scipy.stats import gamma

from imutool.array_types import Float64, Rows6, Vectors
from imutool.diagnosis.audit.bandwidth import bandwidth_faults, max_filter_delay
from imutool.diagnosis.audit.faults import FaultFound, found
from imutool.diagnosis.audit.spectral_lines import HANN, SpectralLine
from imutool.diagnosis.estimation.timestamps import grid, limits
from imutool.diagnosis.result import Estimate
from imutool.noise.datasheet import Noise
from imutool.recording import Imu
from imutool.recording.columns import true_ranges
from imutool.units import COLUMNS, SENSORS, UNITS, Sensor

Column = Float64[np.ndarray, " k"]
ABSENT = 0.02  # of the expected noise: less is none
ALIKE = 1.35  # factor between two densities that are one: a data sheet is typical
SAME_SAMPLE = 1.12  # factor between the noise of two samples that was meant to be one
OTHER_RATE = 1.5  # factor between the rates from which they differ
OVER_LIMIT = 1.02  # of the recording's limit, from which a reading was not clipped
CONSEQUENCES = {
    "noise_absent": ("step_lines", "bias_never_walks", "noise_density", "noise_per_sample", "bandwidth_absent"),
    "repeated_samples": ("step_lines", "noise_density", "noise_per_sample", "bandwidth_absent"),
    "clipping_absent": ("bandwidth_absent", "noise_density"),
    "bandwidth_absent": ("noise_density", "noise_per_sample"),
}
MIN_LSB = 0.3  # of the noise: finer digits leave no trace
SEGMENT, CALM, SHORT = 1024, 128, (32, 16)  # samples
QUARTILE = 0.674  # of a normal distribution, in deviations
REPEATED = 0.08  # of the samples
ONE_DIGIT = 1.5  # LSB
REST = 20  # equal samples in a row
WALK_PARTS, WALK_P_VALUE = 512, 1e-4  # cosines over a log
WALK_SHARES, WALKS = np.geomspace(0.03, 1.0, 8), 2.0  # of the expected walk; log likelihood from which one is seen


@dataclass(frozen=True, eq=False)
class Expected:
    """Expected noise by column; of a recording also its rate, samples and digits.

    `minimum` is the least density that is the sensor's: zero where the noise of a recording varies, as vibration does.
    """

    minimum: Float64[np.ndarray, "6"]
    density: Float64[np.ndarray, "6"]
    walk: Float64[np.ndarray, "6"]
    rate_hz: float | None = None
    samples: Rows6 | None = None
    lsb: Float64[np.ndarray, "6"] = field(default_factory=lambda: np.zeros(6))

    @classmethod
    def of_sheet(cls, noise: Noise) -> Expected:
        """Densities of a data sheet."""
        density, walk = (
            np.concatenate([noise.values(f"{sensor}_{kind}") for sensor in SENSORS]) for kind in ("density", "walk")
        )
        return cls(density, density, walk)

    @classmethod
    def of_recording(cls, imu: Imu) -> Expected:
        """Density of a recording's samples; how far its bias walks is not known."""
        samples = np.concatenate([imu.gyro, imu.accel], axis=1)
        lsb = np.array([grid(column) for column in samples.T])
        noise = fast_noise(samples, 1.0 / imu.period_s, lsb)
        varies = (lsb < noise) & (noise > ALIKE * _calmest(samples))
        minimum, density = (np.sqrt(imu.period_s) * each for each in (np.where(varies, 0.0, noise), noise))
        return cls(minimum, density, np.full(6, np.nan), 1.0 / imu.period_s, samples, lsb)

    def varies(self, sensor: Sensor) -> bool:
        """Whether a sensor's noise may be smaller than that of its recording, which varies."""
        part = COLUMNS[sensor]
        return bool(np.median(self.minimum[part]) < np.median(self.density[part]))

    def filters(self, sensor: Sensor) -> bool:
        """Whether the noise of a recording shows a filter; that of a data sheet is white."""
        if self.samples is None:
            return False
        part = self.samples[:, COLUMNS[sensor]]
        return max_filter_delay(part, part) > 0.0

    def sample(self, sensor: Sensor, rate_hz: float) -> tuple[float, float]:
        """Least and most noise of a sample at a rate; digits add to the noise of a recording."""
        own_hz, part = self.rate_hz or rate_hz, COLUMNS[sensor]
        lower, upper = (float(np.nanmedian(each[part])) for each in (self.minimum, self.density))
        minimum = _without_digits(lower * np.sqrt(own_hz), float(np.median(self.lsb[part]))) / np.sqrt(own_hz)
        return minimum * np.sqrt(rate_hz), upper * np.sqrt(rate_hz)


def fast_noise(x: Float64[np.ndarray, "n k"], rate_hz: float, lsb: Column | float = 0.0) -> Column:
    """White noise of a sample (deviation) at high frequency, in the calm quarter of a log.

    A line is seen apart in long segments, and a body that never rests is calm for the short ones between two impacts. So the
    noise is the least of both. `lsb` are the digits: where coarse, a reading that stays says nothing.
    """
    long = _between_lines(x, rate_hz)
    return np.where(lsb > long, long, np.minimum(long, np.minimum(*(_between_impacts(x, size) for size in SHORT))))


def _between_lines(x: Float64[np.ndarray, "n k"], rate_hz: float) -> Column:
    """Noise by the median of the frequencies.

    The median of n exponential powers is ln 2 of their mean, and scatters by 1 / sqrt(n) of that. Steps and impacts are louder.
    """
    f_hz, _, power = spectrogram(x, rate_hz, window="hann", nperseg=min(SEGMENT, len(x)), axis=0)
    band = (f_hz > 0.25 * rate_hz) & (f_hz < 0.48 * rate_hz)
    levels = np.median(power[band], axis=0)
    quarter = np.log(2.0) - QUARTILE * np.sqrt(HANN / band.sum()) * (levels.shape[-1] > 1)
    return np.asarray(np.sqrt(np.quantile(levels, 0.25, axis=-1) / quarter * rate_hz / 2.0))


def _between_impacts(x: Float64[np.ndarray, "n k"], size: int) -> Column:
    """Noise by the calm quarter of segments that end before the next foot strikes."""
    levels, shape = _levels(x, size)
    return np.asarray(np.sqrt(np.quantile(levels, 0.25, axis=-1) / gamma.ppf(0.25, shape)))


def _calmest(x: Float64[np.ndarray, "n k"]) -> Column:
    """Noise by the calmest of all segments: of a noise that does not vary, the least of so many draws."""
    levels, shape = _levels(x, CALM)
    return np.asarray(np.sqrt(levels.min(axis=-1) / gamma.ppf(1.0 / (1 + levels.shape[-1]), shape)))


def _levels(x: Float64[np.ndarray, "n k"], size: int) -> tuple[Float64[np.ndarray, "k segments"], float]:
    """Powers of a sample's noise at high frequency, a segment each, as shares of a gamma distribution of some shape.

    They are means over frequencies: neighbours of a Hann window share 4/9 of it, those next to them 1/36.
    """
    f, _, power = spectrogram(x, 1.0, window="hann", nperseg=min(size, len(x)), axis=0)
    levels = power[(f > 0.25) & (f < 0.48)]
    n = len(levels)
    shape = n**2 / (n + 2.0 * (n - 1) * 4.0 / 9.0 + 2.0 * (n - 2) / 36.0)
    return levels.mean(axis=0) * shape / 2.0, shape


def noise_faults(
    imu: Imu, residual: Rows6, expected: list[Expected], lines: Sequence[SpectralLine] = ()
) -> tuple[list[FaultFound], list[SpectralLine]]:
    """Faults of the noise, and lines of unknown cause, in what the motion leaves of the samples."""
    rate_hz, samples = 1.0 / imu.period_s, np.concatenate([imu.gyro, imu.accel], axis=1)
    out = [
        found("step_lines", line.sensor, f=Estimate(line.f_hz, line.width_hz, "Hz")) for line in lines if line.cause == "sensor"
    ]
    out += _repeated(samples)
    for sensor in SENSORS:
        part = COLUMNS[sensor]
        lsb = np.array([grid(column) for column in samples[:, part].T])
        own = float(np.median(fast_noise(residual[:, part], rate_hz, lsb)))
        noise = _without_digits(own, float(np.median(lsb))), own
        filters = max_filter_delay(residual[:, part], samples[:, part]) > 0.0
        densities: dict[str, FaultFound] = {}  # of two references that show one fault, the later counts
        for reference in expected:
            density = _density(sensor, noise, rate_hz, reference)
            comparable = filters == reference.filters(sensor)  # what a filter leaves at high frequency is no density
            densities |= {fault.fault: fault for fault in density if comparable or fault.fault == "noise_absent"}
            out += _walk(sensor, residual[:, part], rate_hz, own, reference.walk[part])
            if reference.samples is not None and reference.rate_hz is not None:
                out += _clipping(sensor, samples[:, part], reference.samples[:, part])
                out += _digits(sensor, samples[:, part], reference.samples[:, part])
                sims = (residual[:, part], samples[:, part])
                out += bandwidth_faults(sensor, sims, rate_hz, reference.samples[:, part], reference.rate_hz)
        out += densities.values()
    unknown = [line for line in lines if line.cause == "unknown" and not _follows("step_lines", line.sensor, out)]
    return [fault for fault in out if not _follows(fault.fault, fault.signal, out)], unknown


def _follows(fault: str, signal: str, others: list[FaultFound]) -> bool:
    """Whether a fault is only another side of one that was found."""
    return any(fault in CONSEQUENCES.get(other.fault, ()) for other in others if other.signal in (signal, "both"))


def _density(sensor: Sensor, noise: tuple[float, float], rate_hz: float, expected: Expected) -> Iterator[FaultFound]:
    """Noise absent, of a sample at another rate (or a density taken for a sample's), or of another density."""
    (minimum, maximum), own = expected.sample(sensor, rate_hz), noise[1]
    if not maximum > 0.0:
        return
    ratio = max(noise[0] / maximum, 1.0) * min(own / max(minimum, 1e-300), 1.0)
    numbers = {"noise": Estimate(own, 0.02 * own, UNITS[sensor]), "expected": Estimate(maximum, 0.0, UNITS[sensor])}
    real_hz = expected.rate_hz
    meant = maximum / np.sqrt(rate_hz) * (1.0 if real_hz is None else np.sqrt(real_hz))  # a sample's, as it was given
    other_rate = real_hz is None or max(real_hz / rate_hz, rate_hz / real_hz) > OTHER_RATE
    if own / maximum < ABSENT and max(meant / max(own, 1e-300), 1.0) > SAME_SAMPLE**2:
        yield found("noise_absent", sensor, **numbers)
    elif other_rate and 1.0 / SAME_SAMPLE < own / meant < SAME_SAMPLE:
        yield found("noise_per_sample", sensor, **numbers)
    elif not 1.0 / ALIKE < ratio < ALIKE:
        yield found("noise_density", sensor, **numbers)


def _without_digits(noise: float, lsb: float) -> float:
    """Least noise of samples whose digits may add up to LSB / sqrt(12)."""
    return float(np.sqrt(max(noise**2 - lsb**2 / 12.0, 0.0)))


def _walk(
    sensor: Sensor, residual: Vectors, rate_hz: float, own: float, walk: Float64[np.ndarray, "3"]
) -> Iterator[FaultFound]:
    """A bias that never walks: the slow parts of the residual are too small for the expected walk.

    Cosine transforms of white noise of a density N and a walk K have independent parts, of variances N² and K² / (2 pi f)² a
    unit of frequency. By the likelihood ratio of both, each part's square counts by their ratio. p is Chernoff's bound of that
    sum, min over s of exp(s S) prod (1 + 2 s ratio)^(-1/2). A walk that is only smaller is likelier than none, and no fault.
    """
    n = len(residual)
    k = np.arange(1, min(WALK_PARTS, n))
    drift = (walk**2 / rate_hz) / (2.0 * np.sin(0.5 * np.pi * k / n))[:, None] ** 2
    ratio = drift / max(own, 1e-300) ** 2
    if not np.isfinite(ratio).all() or not (walk > 0.0).all():
        return
    squares = dct(residual, axis=0, norm="ortho")[k] ** 2 / max(own, 1e-300) ** 2
    weighed = float((squares / (1.0 + ratio) * ratio).sum())
    best = minimize_scalar(lambda s: np.exp(s) * weighed - 0.5 * np.log1p(2.0 * np.exp(s) * ratio).sum(), bracket=(-10.0, 0.0))
    smaller = ratio * WALK_SHARES[:, None, None] ** 2
    walks = 0.5 * (squares * smaller / (1.0 + smaller) - np.log1p(smaller)).sum(axis=(1, 2)).max()  # log likelihood over none
    if float(best.fun) < np.log(WALK_P_VALUE) and walks < WALKS:
        density = float(np.median(walk))
        yield found("bias_never_walks", sensor, expected_walk=Estimate(density, 0.0, f"{UNITS[sensor]}/s/√Hz"))


def _clipping(sensor: Sensor, sim: Vectors, real: Float64[np.ndarray, "m 3"]) -> Iterator[FaultFound]:
    """Clipping that the recording has and the simulation lacks."""
    limit = limits(np.tile(real, 2)).get(sensor)
    if limit is not None and np.abs(sim).max() > OVER_LIMIT * limit:
        yield found("clipping_absent", sensor, limit=Estimate(limit, 0.0, UNITS[sensor]))


def _digits(sensor: Sensor, sim: Vectors, real: Float64[np.ndarray, "m 3"]) -> Iterator[FaultFound]:
    """Digits that the recording has and the simulation lacks."""
    steps = [grid(column) for column in real.T]
    lsb = float(np.median(steps))
    if min(steps) > MIN_LSB * float(np.median(fast_noise(real, 1.0))) and all(grid(column) < 0.5 * lsb for column in sim.T):
        yield found("digits_absent", sensor, lsb=Estimate(lsb, 1e-3 * lsb, UNITS[sensor]))


def _repeated(samples: Rows6) -> Iterator[FaultFound]:
    """Samples held for some periods; runs of `REST` are the rest of a body without noise."""
    equal = (np.diff(samples, axis=0) == 0.0).all(axis=1)
    for start, end in true_ranges(equal):
        if end - start >= REST:
            equal[start:end] = False
    share, lsb = float(equal.mean()), np.array([grid(column) for column in samples.T])
    moves = np.abs(np.diff(samples, axis=0))
    moves = moves[moves.any(axis=1)]
    if share > REPEATED and (np.median(moves, axis=0) > ONE_DIGIT * lsb).any():  # slower motion stays for some samples
        yield found("repeated_samples", "both", share=Estimate(share, 0.0, "-"))
