"""Spectral lines of a simulated IMU, and whether the body moves with them.

A gait, a rotor and a control that is held for some steps move a body in lines, too. Poses that were neither smoothed nor
averaged show them: differences of poses follow a rate as sinc(f T), an acceleration as sinc(f T)^2, T being their period.
A simulator reads its IMU at instants, so a motion beyond half of its rate folds; the poses fold it at their own rate.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter
from scipy.signal import spectrogram
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from imutool.array_types import Bool, Float64, Rows6, Vectors
from imutool.inertial.kinematics import G_W
from imutool.recording import Poses
from imutool.units import COLUMNS, SENSORS, Sensor

Column = Float64[np.ndarray, " f"]
Cause = Literal["motion", "sensor", "unknown"]
P_VALUE = 1e-9
AROUND = (31, 13)  # bins whose medians a line exceeds: a hump is wider
ABOVE = 3.0  # times these medians
MIN: dict[Sensor, float] = {"gyro": 1e-5, "accel": 1e-4}  # amplitude, rad/s and m/s²: less is rounding
STEADY = 0.45  # of its mean, the scatter of a line from segment to segment; of noise on three axes 0.58
HANN = 1.5  # bins of noise in one of a Hann window
MIN_SHARE, MAX_SHARE = 0.15, 0.495  # of the rate: below, motion is left
SEGMENT = 1024
KNOWN_SHARE = 0.45  # of the poses' rate, up to which they show a motion
CLEARLY = 4.0  # times the power of the poses' differences, that a line of this motion would have


class SpectralLine(NamedTuple):
    """Line of one sensor, and what it comes from."""

    sensor: Sensor
    f_hz: float
    width_hz: float
    cause: Cause


class Spectrum(NamedTuple):
    """Power of three axes by frequency and of its neighbours, and whether a line is no chance."""

    f_hz: Column
    power: Column
    ratio: Column
    certain: Bool[np.ndarray, " f"]
    steady: Bool[np.ndarray, " f"]


class Shown(NamedTuple):
    """Spectrum of the poses' differences, their rate, and the order of sinc in their power."""

    spectrum: Spectrum
    rate_hz: float
    order: int

    @property
    def lines(self) -> Bool[np.ndarray, " f"]:
        """Where a line is certain."""
        return np.asarray(self.spectrum.certain & (self.spectrum.ratio > ABOVE))

    def at(self, f_hz: float, power: float) -> tuple[Bool[np.ndarray, " f"], float, float]:
        """Where a motion folds to, the power that a line of it would have there, and the largest that is there."""
        f = self.spectrum.f_hz
        near = np.asarray(np.abs(f - abs(f_hz - self.rate_hz * round(f_hz / self.rate_hz))) < 2.5 * f[1])
        return near, power * float(np.sinc(f_hz / self.rate_hz) ** self.order), float(self.spectrum.power[near].max())


def spectral_lines(
    samples: Rows6, residual: Float64[np.ndarray, "m 6"], rate_hz: float, shown: Float64[np.ndarray, "p 6"], poses_hz: float
) -> list[SpectralLine]:
    """Strongest line of each sensor with which the body does not move, or may not.

    They stand in what the motion leaves, and in the samples, too: a curve through slow poses has some of its own. `shown` are
    the rate and specific force by differences of poses (`by_differences`).
    """
    size = min(SEGMENT, len(residual) // 4)
    out: list[SpectralLine] = []
    cause_names: tuple[Cause, Cause] = ("sensor", "unknown")
    for k, sensor in enumerate(SENSORS):
        part = COLUMNS[sensor]
        found, whole = (_spectrum(x[:, part], rate_hz, size) for x in (residual, samples))
        poses = _spectrum(shown[:, part], poses_hz, min(round(size * poses_hz / rate_hz), len(shown)))
        by_poses, width_hz = Shown(poses, poses_hz, order=2 * k + 2), rate_hz / size
        above = (found.f_hz > MIN_SHARE * rate_hz) & (found.f_hz < MAX_SHARE * rate_hz)
        above &= np.sqrt(2.0 * HANN * found.power * width_hz) > MIN[sensor]
        lines = np.flatnonzero(above & found.certain & found.steady & (np.minimum(found.ratio, whole.ratio) > ABOVE))
        strongest = lines[np.argsort(-found.ratio[lines])]
        peak = maximum_filter1d(found.power, 5)  # as `Shown.at` looks for it
        causes = [_cause(float(found.f_hz[line]), rate_hz, float(peak[line]), by_poses) for line in strongest]
        first = next((cause for cause in cause_names if cause in causes), None)
        if first is not None:
            out.append(SpectralLine(sensor, float(found.f_hz[strongest[causes.index(first)]]), width_hz, first))
    return out


def _cause(f_hz: float, rate_hz: float, power: float, shown: Shown) -> Cause:
    """What a line comes from: the poses show it, or nothing as large, or cannot show it."""
    near, expected, power_shown = shown.at(f_hz, power)
    if (near & shown.lines).any():
        return "motion"
    for folded_hz in (rate_hz - f_hz, rate_hz + f_hz):
        near, weaker, other = shown.at(folded_hz, power)
        if (near & shown.lines).any() and weaker / CLEARLY < other < CLEARLY * weaker:
            return "motion"
    return "sensor" if f_hz < KNOWN_SHARE * shown.rate_hz and expected > CLEARLY * power_shown else "unknown"


def _spectrum(x: Vectors, rate_hz: float, size: int) -> Spectrum:
    f_hz, _, parts = spectrogram(x, rate_hz, window="hann", nperseg=size, noverlap=size // 2, axis=0)
    by_segment = parts.sum(axis=1)
    power = by_segment.mean(axis=1)
    freedom = 3.0 * 2.0 * by_segment.shape[1] * 9.0 / 11.0  # of half-overlapping Hann segments, three axes
    around = np.maximum(*(median_filter(power, bins, mode="nearest") for bins in AROUND))
    ratio = power / np.maximum(around, 1e-300)
    certain = chi2.logsf(ratio * freedom, freedom) < np.log(P_VALUE)
    return Spectrum(f_hz, power, ratio, np.asarray(certain), np.asarray(by_segment.std(axis=1) < STEADY * power))


def by_differences(poses: Poses, arm: Float64[np.ndarray, "3"]) -> tuple[Rows6, float]:
    """Rate and specific force at a lever arm by differences of poses, and their rate (Hz)."""
    period_s = poses.period_s
    R_wb = Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True)
    half = (R_wb[:-1].inv() * R_wb[1:]).as_rotvec() / period_s  # half a period later
    omega, alpha = (half[:-1] + half[1:]) / 2.0, np.diff(half, axis=0) / period_s
    a_w = np.diff(poses.p_wb, n=2, axis=0) / period_s**2
    force = R_wb[1:-1].inv().apply(a_w - G_W) + np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))
    return np.concatenate([half[1:], force], axis=1), 1.0 / period_s
