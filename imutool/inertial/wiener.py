"""Wiener filter of simulated signals; noise is what a recording does not share."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta
from scipy.integrate import trapezoid
from scipy.interpolate import make_interp_spline
from scipy.ndimage import maximum_filter1d, median_filter, uniform_filter, uniform_filter1d
from scipy.signal import ShortTimeFFT, butter, sosfiltfilt
from scipy.signal.windows import hann
from scipy.stats import beta

from imutool.array_types import Bool, Complex128, Float64
from imutool.config import Settings
from imutool.inertial.stationary import CALM, nothing_but_noise, white_noise
from imutool.recording import Imu, interpolate, seconds

MOSTLY = 2.0  # times the noise: less is noise for the most part
OVERLAP = 4  # windows begin a quarter of a window apart
INDEPENDENT = 0.5, 0.65  # of such Hann windows, and of their neighbouring frequencies (noise alone: 0.5 and 0.67)
CHANCE = 1e-4  # of noise to share more at one frequency
APART = 2  # times the frequencies of a mean: so far from what is shared, nothing of a motion is left in what is not
ALMOST_ALL, NO_NOISE = 0.9, 1e-12  # of the frequencies, which a recording shares; of the largest power, as good as none
STEPS, MIN_SAMPLES, MAX_S = 4, 100, 0.5  # of a fit of two clocks; a larger difference is none of their rates
SLOW_HZ = 8.0  # of the rates by which they are compared: a vibration has another delay one period later
SMOOTH = 3  # times the frequencies of a mean: over which noise is taken to have one density
Parts = Complex128[np.ndarray, "f t k"]


class WienerSettings(Settings, frozen=True):
    """Settings of the filter: by experience on blind cases."""

    noise_band: Annotated[float, Meta(gt=0, le=1)] = 0.8  # of Nyquist: above, a simulated motion has nothing but noise
    short_time_s: Annotated[float, Meta(gt=0)] = 2.5  # of a gain: a body moves and rests (0.6 to 2.5 s tried, shorter is worse)
    short_time_parts: Annotated[int, Meta(ge=1)] = 7  # frequencies, and times a quarter of that apart, whose mean is one


class _Shared(NamedTuple):
    """Frequencies that signals share with recorded ones, and the power that these leave."""

    shared: Bool[np.ndarray, "f k"]
    own: Float64[np.ndarray, "f k"]


class NoiseLeft(NamedTuple):
    """One-sided density of the noise that a filter leaves, by frequency: a motion hides it.

    `maximum` bounds the deviation of a sample's noise before the filter: what a recording does not share, and what is filtered.
    """

    f_hz: Float64[np.ndarray, " f"]
    density: Float64[np.ndarray, "f k"]
    maximum: Float64[np.ndarray, " k"] | float = np.inf


def wiener_filter(
    x: Float64[np.ndarray, "n k"], rate_hz: float, settings: WienerSettings | None = None
) -> Float64[np.ndarray, "n k"]:
    """Signals without noise, as `denoised`."""
    return denoised(x, rate_hz, settings)[0]


def denoised(
    x: Float64[np.ndarray, "n k"],
    rate_hz: float,
    settings: WienerSettings | None = None,
    recorded: Float64[np.ndarray, "n r"] | None = None,
    *,
    of_poses_to_hz: float | None = None,
) -> tuple[Float64[np.ndarray, "n k"], NoiseLeft]:
    """Signals without noise, by a Wiener filter in short times, and the noise that is left.

    It filters by frequency and across signals. Frequencies that no combination of the recorded signals shares show the noise,
    of whatever colour (NaN where nothing is recorded); without them the top of the spectrum does, and the noise is white. In
    units of it, the eigenvectors of the cross-spectrum with hardly more than noise go: what a gyro shows of a motion helps an
    accelerometer that hardly shows it.
    What stays is multiplied by 1 - noise / power of its own time: one gain for all of it would leave noise at rest, and take
    from the motion. Of a motion by poses nothing stays that is not shared: their errors are not white, and those of rounding
    change with the position. Nor does anything above `of_poses_to_hz`: what a simulation's samples do not show, a spline made.
    """
    n, settings, of_poses = len(x), settings or WienerSettings(), of_poses_to_hz is not None
    line = _line(x)
    size = 4 * max(1, min(round(settings.short_time_s * rate_hz), n - 1) // 4)
    stft = ShortTimeFFT(hann(size, sym=False), size // OVERLAP, fs=rate_hz)
    y = x - line
    mirrored = np.concatenate([-y[size:0:-1], y, -y[-2 : -size - 2 : -1]])
    parts = np.moveaxis(stft.stft(mirrored, axis=0), 1, 2)  # frequency, time, signal
    with_recorded = None if recorded is None else _shared(x, recorded, stft, settings)
    shared = None if with_recorded is None else with_recorded.shared
    if of_poses and shared is None:
        return x, NoiseLeft(stft.f, np.zeros((len(stft.f), x.shape[1])))
    density = 2.0 / (rate_hz * float((stft.win**2).sum()))  # one-sided, of a square of the parts
    inside = slice(stft.lower_border_end[1], stft.upper_border_begin(len(mirrored))[1])  # beyond, a motion is cut off
    all_of_it = density * (np.abs(parts[:, inside]) ** 2).mean(axis=1)
    top = density * _top_power(parts, settings)
    std, unknown = _noise_std(parts, with_recorded, settings, white=not of_poses)
    std = std[:, None]
    parts /= std
    power = np.einsum("fti,ftj->fij", parts, parts.conj()) / parts.shape[1]
    power = uniform_filter1d(power, settings.short_time_parts, axis=0, mode="nearest")
    value, vector = np.linalg.eigh(power)
    vector = vector * (value > MOSTLY)[:, None, :]
    kept = vector @ vector.conj().swapaxes(1, 2)
    parts = parts @ kept.swapaxes(1, 2)
    noise = np.abs(np.diagonal(kept, axis1=1, axis2=2))[:, None, :]
    around_each = (settings.short_time_parts, settings.short_time_parts, 1)
    local_power = uniform_filter(np.abs(parts) ** 2, around_each, mode="nearest")
    gain = np.where(local_power < MOSTLY * noise, 0.0, 1.0 - noise / np.maximum(local_power, 1e-300))
    if of_poses_to_hz is not None and shared is not None:
        gain *= (~_apart(shared, settings) & (stft.f <= of_poses_to_hz)[:, None])[:, None]
    clean = stft.istft(np.moveaxis(gain * parts * std, 1, 2), k1=n + 2 * size, f_axis=0, t_axis=2)
    remaining = density * (std[:, 0] ** 2) * (gain**2).mean(axis=1) * noise[:, 0]
    maximum: Float64[np.ndarray, " k"] | float = np.inf
    remaining = np.where(unknown, np.minimum(2.0 * (CALM * white_noise(x)) ** 2 / rate_hz, top), remaining)
    if with_recorded is not None:  # noise is not shared: a vibration looks like white noise, and a recording shares it
        unshared = with_recorded.own * uniform_filter1d(all_of_it, settings.short_time_parts, axis=0, mode="nearest")
        filtered = np.where(unknown, top * rate_hz / 2.0, trapezoid(density * std[:, 0] ** 2, stft.f, axis=0))
        remaining, maximum = np.minimum(remaining, unshared), np.sqrt(np.minimum(trapezoid(unshared, stft.f, axis=0), filtered))
    return np.asarray(line + clean[size : size + n]), NoiseLeft(stft.f, remaining, maximum)


def _line(x: Float64[np.ndarray, "n k"]) -> Float64[np.ndarray, "n k"]:
    """Lines from end to end, without which the ends meet their own mirror, so that no step shows there.

    Of noise alone it is the mean: its ends would be taken for a ramp.
    """
    line, noisy = np.linspace(x[0], x[-1], len(x)), np.array([nothing_but_noise(column) for column in x.T])
    line[:, noisy] = x[:, noisy].mean(axis=0)
    return np.asarray(line)


def recorded_at(
    imu: Imu, t_s: Float64[np.ndarray, " m"], start_ns: int, gyro: Float64[np.ndarray, "m 3"] | None = None
) -> Float64[np.ndarray, "m 6"]:
    """Recorded samples at the times of a simulation; NaN outside of them.

    If its rates `gyro` are given, clocks are brought to one rate and offset: half a period of drift hides what is shared, and
    so does a lag, of a filter too, whose turn of the phase differs between frequencies of one mean.
    """
    own_s, columns = seconds(imu.t_ns, start_ns), [*imu.gyro.T, *imu.accel.T]
    own_s = own_s if gyro is None else own_s + _drift_s(own_s, imu.gyro, t_s, gyro)
    return np.stack([np.interp(t_s, own_s, column, left=np.nan, right=np.nan) for column in columns], axis=1)


def _drift_s(
    own_s: Float64[np.ndarray, " n"],
    recorded: Float64[np.ndarray, "n 3"],
    t_s: Float64[np.ndarray, " m"],
    gyro: Float64[np.ndarray, "m 3"],
) -> Float64[np.ndarray, " n"]:
    """Line of time to add to recorded stamps.

    With it slow rates agree up to any linear map of them (Gauss-Newton). Nothing if that changes less than a period, or
    explains no more.
    """
    inside = (t_s >= own_s[0]) & (t_s <= own_s[-1])
    rate_hz, at = float((len(t_s) - 1) / np.ptp(t_s)), t_s[inside]
    if len(at) < MIN_SAMPLES or not np.ptp(gyro, axis=0).all():
        return np.zeros(len(own_s))
    slow = butter(2, min(SLOW_HZ, 0.4 * rate_hz), fs=rate_hz, output="sos")
    read = sosfiltfilt(slow, interpolate(at, own_s, recorded), axis=0)
    rate, line, squares = make_interp_spline(t_s, sosfiltfilt(slow, gyro, axis=0), k=3), np.zeros(2), []
    since = np.column_stack([np.ones(len(at)), (at - at.mean()) / np.ptp(at)])
    for _ in range(STEPS):
        warped = np.clip(at + since @ line, t_s[0], t_s[-1])
        A = np.column_stack([rate(warped), np.ones(len(at))])
        M = np.linalg.lstsq(A, read, rcond=None)[0]
        residual, slope = read - A @ M, rate(warped, 1) @ M[:3]
        squares.append(float((residual**2).sum()))
        columns = np.stack([since[:, j, None] * slope for j in (0, 1)], axis=2).reshape(-1, 2)
        line = line + np.linalg.lstsq(columns, residual.ravel(), rcond=None)[0]
    moved = 1.0 / rate_hz < abs(line).max() < MAX_S and squares[-1] < squares[0]
    return line[0] + (own_s - at.mean()) / np.ptp(at) * line[1] if moved else np.zeros(len(own_s))


def _noise_std(
    parts: Parts, shared: _Shared | None, settings: WienerSettings, *, white: bool
) -> tuple[Float64[np.ndarray, "f k"], Bool[np.ndarray, " k"]]:
    """Noise of the parts by frequency, and the signals in which it cannot be told from the motion.

    It is that of the frequencies that are not shared, and no more than the recorded signals leave of the others; if `white`,
    that of the top where nothing is compared. Where almost all are shared it cannot be told, and is next to nothing here: a
    filter takes none of it.
    """
    power = np.median(np.abs(parts) ** 2, axis=1) / np.log(2.0)  # a shock is no noise of other times
    out, unknown = np.tile(_top_power(parts, settings), (len(parts), 1)), np.zeros(parts.shape[2], bool)
    for k, (column, unexplained) in enumerate(zip(shared.shared.T, shared.own.T, strict=True) if shared is not None else ()):
        own = np.flatnonzero(_apart(column, settings))
        beyond_chance = column.sum() > settings.short_time_parts  # frequencies whose means overlap
        if beyond_chance and len(own) > SMOOTH * settings.short_time_parts:
            level = median_filter(power[own, k], SMOOTH * settings.short_time_parts, mode="nearest")  # a line is no noise
            out[:, k] = np.interp(np.arange(len(out)), own, level)
        elif column.mean() > ALMOST_ALL or not white:
            out[:, k], unknown[k] = NO_NOISE * power[:, k].max(), white
        if white and beyond_chance and not unknown[k]:  # with a vibration that is not shared it would be too much
            maximum = unexplained * uniform_filter1d(power[:, k], settings.short_time_parts, mode="nearest")
            out[column, k] = np.clip(maximum[column], NO_NOISE * power[:, k].max(), out[column, k])
    return np.asarray(np.sqrt(np.maximum(out, 1e-300))), unknown


def _top_power(parts: Parts, settings: WienerSettings) -> Float64[np.ndarray, " k"]:
    """Power of the parts at the top of the spectrum, by signal: no white noise has more."""
    top = np.abs(parts[int(settings.noise_band * len(parts)) :]) ** 2
    return np.asarray(np.median(top, axis=(0, 1)) / np.log(2.0))


def _apart(shared: Bool[np.ndarray, "f ..."], settings: WienerSettings) -> Bool[np.ndarray, "f ..."]:
    """Frequencies away from those that are shared."""
    return np.asarray(~maximum_filter1d(shared, 2 * APART * settings.short_time_parts + 1, axis=0, mode="nearest"))


def _shared(
    x: Float64[np.ndarray, "n k"], recorded: Float64[np.ndarray, "n r"], stft: ShortTimeFFT, settings: WienerSettings
) -> _Shared | None:
    """Multiple coherence with recorded signals: where it is more than chance, and what it leaves; None in too short a time."""
    rows, around = np.flatnonzero(np.isfinite(recorded).all(axis=1)), settings.short_time_parts
    if not len(rows) or rows[-1] + 1 - rows[0] < stft.m_num:
        return None
    both = np.concatenate([recorded, x], axis=1)[rows[0] : rows[-1] + 1]
    both = both - _line(both)
    inside = slice(stft.lower_border_end[1], stft.upper_border_begin(len(both))[1])
    parts = np.moveaxis(stft.stft(both, axis=0), 1, 2)[:, inside]
    independent = round(INDEPENDENT[0] * parts.shape[1] * INDEPENDENT[1] * around)
    r = recorded.shape[1]
    if independent <= 2 * r:
        return None
    power = uniform_filter1d(np.einsum("fti,ftj->fij", parts, parts.conj()), around, axis=0, mode="nearest")
    size = np.sqrt(np.maximum(np.abs(np.diagonal(power, axis1=1, axis2=2)), 1e-300))  # zero on a stuck axis
    power /= size[:, :, None] * size[:, None, :]
    of_recorded, cross = power[:, :r, :r] + 1e-9 * np.eye(r), power[:, :r, r:]
    coherence = np.einsum("frk,frk->fk", cross.conj(), np.linalg.solve(of_recorded, cross)).real
    own = np.clip((1.0 - coherence) * independent / (independent - r), 0.0, 1.0)  # r signals explain r parts of noise, too
    return _Shared(np.asarray(coherence > beta.isf(CHANCE, r, independent - r)), own)
