"""Vibration: a line in the spectra of specific force and angular rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imutool.array_types import Float64
from imutool.inertial.stationary import white_noise
from imutool.sensor.effect import Effect, Parameter, Remembered, Stage, Theta, residual
from imutool.sensor.samples import IdealMotion, SensorSamples

MIN_HZ = 3.0  # slower is motion, drift or another effect, and no vibration
LINES = 3  # starts: the strongest lines of the residual
FINER = 4  # times as many frequencies as samples tell: the top of a peak lies between three of them
ABOUT = 401  # frequencies whose median tells what a line stands out from
PARTS = 8  # of a log, in each of which a vibration has one amplitude and phase
STEADY = 2.0  # times their scatter, the squared mean of what the eighths show: a wandering line had 1.7 at most, a steady one 6
IN_POSES = 0.1  # of the power of a line, from which the poses have it, too


def _waves(t_s: Float64[np.ndarray, " n"], f_hz: float) -> Float64[np.ndarray, "n 2"]:
    phase = 2.0 * np.pi * f_hz * t_s
    return np.stack([np.sin(phase), np.cos(phase)]).T


waves_of = Remembered(_waves)


def line_power(
    stamp_s: Float64[np.ndarray, " n"], samples: Float64[np.ndarray, "n k"], f_hz: float, *, noise: Float64[np.ndarray, " k"]
) -> float:
    """Power of samples at a frequency over that of their noise, all columns together."""
    each = np.exp(-2j * np.pi * f_hz * stamp_s) @ (samples - samples.mean(axis=0)) / noise
    return float((np.abs(each) ** 2).sum())


def line_p_value(samples: Float64[np.ndarray, "n k"], rate_hz: float, f_hz: float) -> float:
    """p-value of a line, all columns together.

    That noise of any colour stands out as far from its own level on both sides, at any frequency.
    """
    from scipy.ndimage import median_filter
    from scipy.signal import periodogram
    from scipy.stats import gamma

    frequency, power = periodogram(samples, rate_hz, "hann", axis=0)
    side, half = ABOUT // FINER // 2, ABOUT // FINER // 4 + 2  # frequencies next to it, and to their middle
    medians = np.pad(median_filter(power, (side, 1)), ((half, half), (0, 0)), "edge")
    beside = np.maximum(medians[: -2 * half], medians[2 * half :])  # where a motion ends, one side is far quieter
    level = beside / np.log(2.0) + np.finfo(np.float64).tiny  # mean of what is exponential
    at = int(np.argmin(np.abs(frequency - f_hz)))
    highest = (power[at - 1 : at + 2] / level[at - 1 : at + 2]).sum(axis=1).max()
    return float(min(1.0, len(frequency) * gamma.sf(highest, samples.shape[1])))


def steady_p_value(stamp_s: Float64[np.ndarray, " n"], samples: Float64[np.ndarray, "n k"], f_hz: float) -> float:
    """p-value of a line by its amplitude and phase in each eighth of a log.

    A vibration keeps both, so that their mean stands out from their scatter (F of 2 and 14). A gait and its impacts are as
    loud there, but wander, in all columns together: the clearest column counts, at any frequency.
    """
    from scipy.stats import f as fisher

    wave = np.exp(-2j * np.pi * f_hz * stamp_s)[:, None]
    parts = np.array_split(wave * (samples - samples.mean(axis=0)), PARTS)
    each = np.stack([part.mean(axis=0) for part in parts])
    middle = each.mean(axis=0)
    scatter = (np.abs(each - middle) ** 2).sum(axis=0) / (PARTS - 1) + np.finfo(np.float64).tiny
    log_p = fisher.logsf(PARTS * np.abs(middle) ** 2 / scatter, 2, 2 * (PARTS - 1))
    return float(min(1.0, samples.shape[1] * len(stamp_s) / 2.0 * np.exp(log_p.min())))


def quarter_turn(theta: Theta) -> Theta:
    """Parameters of the same vibration, a quarter of a period away."""
    return np.concatenate([theta[:1], np.stack([theta[2::2], -theta[1::2]], axis=1).ravel()])


def wanders(samples: Float64[np.ndarray, "n k"], line: Float64[np.ndarray, "n k"], quarter: Float64[np.ndarray, "n k"]) -> bool:
    """Whether a line is in some eighths of a log alone, or has another phase in each.

    By the amplitude and phase that samples have of it, and of its `quarter` turn, all columns together: those of a steady line
    scatter by noise, which is far less than their mean. A shock rings in few eighths, and steps or a motor turn the phase.
    """
    weight, centred = 1.0 / white_noise(samples) ** 2, samples - samples.mean(axis=0)
    real, imaginary, size = ((x * y) @ weight for x, y in ((centred, line), (centred, quarter), (line, line)))
    parts = ((x.sum() for x in np.array_split(each, PARTS)) for each in (real - 1j * imaginary, size))
    each = np.array([of_line / max(of_size, np.finfo(np.float64).tiny) for of_line, of_size in zip(*parts, strict=True)])
    scatter = float((np.abs(each - each.mean()) ** 2).sum() / (PARTS - 1))
    return float(np.abs(each.mean()) ** 2) < STEADY * scatter


def is_motion(
    stamp_s: Float64[np.ndarray, " n"],
    by_poses: Float64[np.ndarray, "n k"],
    line: Float64[np.ndarray, "n k"],
    f_hz: float,
    chance: float,
) -> bool:
    """Whether a line is motion of the body: the poses have it as well, as a line of their own.

    A body that moves periodically, as in walking, has lines, and poses that were smoothed lose a part of each.
    """
    noise = white_noise(by_poses + line)
    in_residual, in_poses = (line_power(stamp_s, samples, f_hz, noise=noise) for samples in (line, by_poses))
    rate_hz = (len(stamp_s) - 1) / (stamp_s[-1] - stamp_s[0])
    return in_poses > IN_POSES * in_residual and line_p_value(by_poses, float(rate_hz), f_hz) < chance


def _forward(motion: IdealMotion, theta: Theta) -> IdealMotion:
    """f (Hz), then the amplitudes of sine and cosine of each axis, accel (m/s²), gyro (rad/s); t on the motion's clock."""
    waves = (theta[1:].reshape(6, 2) @ waves_of(motion.t_s, float(theta[0])).T).T
    return replace(motion, accel=motion.accel + waves[:, :3], gyro=motion.gyro + waves[:, 3:])


def _starts(motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
    """Lines that stand out most from the residual's spectrum, with their amplitudes."""
    gyro, accel = residual(motion, samples)
    error, t_s = np.concatenate([accel, gyro], axis=1), samples.stamp_s
    error = error - error.mean(axis=0)
    noise = white_noise(error)
    rate_hz = (len(t_s) - 1) / (t_s[-1] - t_s[0])
    from scipy.ndimage import median_filter
    from scipy.signal import periodogram

    f_hz, each = periodogram(error, rate_hz, "hann", nfft=FINER * len(t_s), axis=0)
    level = np.log((each / np.maximum(noise, np.finfo(np.float64).tiny) ** 2).sum(axis=1) + np.finfo(np.float64).tiny)
    out = level - median_filter(level, min(ABOUT, len(level)))
    peaks = 1 + np.flatnonzero((out[1:-1] >= out[:-2]) & (out[1:-1] >= out[2:]))
    starts = []
    peaks = peaks[f_hz[peaks] > MIN_HZ] if (f_hz[peaks] > MIN_HZ).any() else peaks
    for peak in peaks[np.argsort(out[peaks])[::-1][:LINES]]:
        line_hz = _top(f_hz, level, int(peak))
        amplitudes = np.linalg.lstsq(_waves(t_s, line_hz), error, rcond=None)[0]
        starts.append(np.concatenate([[line_hz], amplitudes.T.ravel()]))
    return starts


def _top(f_hz: Float64[np.ndarray, " n"], level: Float64[np.ndarray, " n"], peak: int) -> float:
    """Top of the parabola through a peak and its neighbours, as Hann's window nearly has in its logarithm."""
    before, at, after = level[peak - 1 : peak + 2]
    bend = before - 2.0 * at + after
    return float(f_hz[peak] + (0.5 * (before - after) / bend if bend else 0.0) * f_hz[1])


EFFECT = Effect(
    "vibration",
    Stage.MOTION,
    ("gyro", "accel"),
    "accel, gyro += s sin(2 pi f t) + c cos(2 pi f t)",
    (
        Parameter(
            "f", "Hz", 50.0, positive=True, null_value=50.0, step=1e-7, minimum=MIN_HZ
        ),  # 90 s of 50 Hz turn the phase by 3e-3 rad
        *(Parameter(f"accel_{of}_{axis}", "m/s²", 0.5) for axis in "xyz" for of in ("sin", "cos")),
        *(Parameter(f"gyro_{of}_{axis}", "rad/s", 0.05) for axis in "xyz" for of in ("sin", "cos")),
    ),
    "the line stands above the noise",
    _forward,
    linear=False,
    starts=_starts,
    alternatives=lambda samples: len(samples.stamp_s) // 2,  # frequencies that samples tell apart
)
