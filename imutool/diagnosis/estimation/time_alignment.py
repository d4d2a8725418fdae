"""Time alignment of a recording with a simulation or true poses: one clock, a row a sample.

A simulation's samples carry noise of their own, and a term that shrinks the simulation would shrink it as well and look like
physics. Where its poses explain its samples but for white noise, they stand in for them. But poses are rounded, and in their
second derivative this error grows with the square of the frequency: what neither IMU shares with them does not count as motion.
If they do not explain the samples, a Wiener filter takes away what the samples' own spectrum shows to be noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import make_interp_spline

from imutool.array_types import Float64, Vectors
from imutool.cleaning.stamp_line import unrounded
from imutool.diagnosis.estimation.aligned_log import DEFAULT, Pair, split
from imutool.diagnosis.estimation.timestamps import without_jitter
from imutool.diagnosis.settings import AlignmentSettings, DiagnoseSettings
from imutool.errors import DataError
from imutool.geometry import quaternion
from imutool.inertial.correlation import cross_correlation, is_white
from imutool.inertial.kinematics import G_W, attitude_by_gyro, fit_trajectory, gravity_error
from imutool.inertial.resampling import refined, refinement
from imutool.inertial.stationary import may_rest, nothing_but_noise, white_noise
from imutool.inertial.strapdown import with_velocity
from imutool.inertial.wiener import NoiseLeft, denoised, recorded_at
from imutool.recording import Imu, Recording, Times, nanoseconds, seconds
from imutool.sensor.channels import channels_at
from imutool.sensor.samples import IdealMotion

REFINEMENTS = 3  # of a lag
KNOWN_SHARE = 0.5  # of the samples that have a true pose, from which on the poses are worth drawing
MIN_NOISE = np.array([1e-4] * 3 + [1e-3] * 3)
Simulated = tuple[IdealMotion, Float64[np.ndarray, "6"], NoiseLeft | None]


def with_simulation(
    real: Recording, sim: Recording, settings: DiagnoseSettings = DEFAULT, own_poses: bool = False
) -> list[Pair]:
    """Align a recording with each stretch of a simulation of the same motion.

    Raises:
        DataError: the two share too little time, or are not of one motion.
    """
    shift_s = _shift(real.imu, sim.imu, settings.alignment)
    if shift_s is None:
        raise DataError(
            "the simulation and the recording turn differently, or too slowly to be aligned without a common clock",
            where=real.name,
            expected="one motion, or true poses in both logs",
            fix="Leave `sim` out to compare the recording with its own true poses",
        )
    found = [_simulated(part, shift_s, real, settings, own_poses) for part in _stretches(sim, settings)]
    shared_s = [_shared_s(real, ideal) for ideal, _, _ in found]
    min_s = min(settings.alignment.min_s, max(shared_s))
    return [
        replace(_pair(real, ideal, "simulation", settings), aligned_s=shift_s, sim_noise=noise, noise_left=remaining)
        for (ideal, noise, remaining), shared in zip(found, shared_s, strict=True)
        if shared >= min_s
    ]


def _stretches(sim: Recording, settings: DiagnoseSettings) -> list[Recording]:
    """Stretches of a simulation between holes, those that are long enough; else the longest."""
    t_ns = sim.imu.t_ns
    hole_s = max(settings.alignment.hole_s, settings.split.gap_periods * sim.imu.period_s)
    holes = np.flatnonzero(np.diff(t_ns) > 1e9 * hole_s)
    parts = [sim.between(int(t_ns[a]), int(t_ns[b])) for a, b in zip([0, *(holes + 1)], [*holes, len(t_ns) - 1], strict=True)]
    long = [part for part in parts if part.imu.duration_s >= settings.alignment.min_s]
    return (long or [max(parts, key=lambda part: part.imu.duration_s)]) if len(holes) else [sim]


def same_motion(real: Imu, sim: Imu, settings: AlignmentSettings = DEFAULT.alignment) -> bool:
    """Whether a recording and a simulation turn alike, whatever their clocks say."""
    return _shift(real, sim, settings) is not None


def with_truth(real: Recording, ideal: IdealMotion, band_hz: float, settings: DiagnoseSettings = DEFAULT) -> Pair:
    """Align a recording with the motion of its own true poses.

    `ideal` counts seconds from its first sample and is true up to `band_hz`.

    Raises:
        DataError: too little shared time.
    """
    start_ns = int(real.imu.t_ns[0])
    ideal = replace(ideal, channels=_channels(real, start_ns + np.round(ideal.t_s * 1e9).astype(np.int64)))
    return replace(_pair(real, ideal, "true poses", settings), band_hz=band_hz)


def _pair(real: Recording, ideal: IdealMotion, against: str, settings: DiagnoseSettings) -> Pair:
    shared_s, min_s = _shared_s(real, ideal), settings.alignment.min_s
    if shared_s < min_s:
        raise DataError(
            f"{shared_s:.1f} s shared with the {against}",
            where=real.name,
            expected=f"at least {min_s:g} s",
            fix="Give logs of the same time, or a longer one",
        )
    stamp_s, part = _inside(real, ideal)
    samples = np.concatenate([real.imu.gyro.T, real.imu.accel.T])[:, part].T
    # a column in one piece of memory, with which effects, filters and splines take two thirds of the time
    gyro, accel, alpha = (np.asfortranarray(x) for x in (ideal.gyro, ideal.accel, ideal.alpha))
    held_out, usable = split(stamp_s, settings.split)
    t_ns = real.imu.t_ns[part]
    truth = None
    if real.truths:
        poses, known = with_velocity(real.truth).at(t_ns)
        truth = poses if known.mean() > KNOWN_SHARE else None
    return Pair(
        real.name,
        stamp_s,
        samples,
        usable & ~held_out,
        usable & held_out,
        ideal=replace(ideal, gyro=gyro, accel=accel, alpha=alpha),
        truth=truth,
        poses_hz=1.0 / real.truth.period_s if truth is not None else 0.0,
        start_ns=int(t_ns[0]),
        settings=settings,
        channels={name: values for name, values in _channels(real, t_ns).items() if np.ptp(values) > 0},
    )


def _inside(real: Recording, ideal: IdealMotion) -> tuple[Float64[np.ndarray, " n"], slice]:
    """Samples of a recording within a motion: their stamps and rows."""
    stamp_s = seconds(real.imu.t_ns, int(real.imu.t_ns[0]))
    rows = np.flatnonzero((stamp_s >= ideal.t_s[0]) & (stamp_s <= ideal.t_s[-1]))
    part = slice(int(rows[0]), int(rows[-1]) + 1) if len(rows) else slice(0)
    return stamp_s[part], part


def _shared_s(real: Recording, ideal: IdealMotion) -> float:
    stamp_s, _ = _inside(real, ideal)
    return float(np.ptp(stamp_s)) if len(stamp_s) else 0.0


def _channels(recording: Recording, t_ns: np.ndarray) -> dict[str, Float64[np.ndarray, " n"]]:
    """Scalar channels of a log at some times; a single message is no course."""
    return channels_at(recording, seconds(t_ns, int(t_ns[0])), int(t_ns[0]), min_messages=2)


def _simulated(sim: Recording, shift_s: float, real: Recording, settings: DiagnoseSettings, own_poses: bool) -> Simulated:
    """Simulated motion without noise on an even clock, the noise that was filtered out, and what is left of it."""
    start_ns = int(real.imu.t_ns[0])
    t_sim = seconds(sim.imu.t_ns, start_ns + nanoseconds(shift_s))  # on the recording's clock
    samples = np.concatenate([sim.imu.gyro, sim.imu.accel], axis=1)
    noise = white_noise(samples)
    t_sim = without_jitter(t_sim, samples, settings.timestamps)
    period_s = float(np.median(np.diff(t_sim)))
    of_real = white_noise(np.concatenate([real.imu.gyro, real.imu.accel], axis=1)), len(real.imu)
    copied = np.array_equal(real.imu.gyro, sim.imu.gyro) and np.array_equal(real.imu.accel, sim.imu.accel)
    ideal = None if copied else _by_poses(sim, samples, noise, 1.0 / period_s, of_real, settings)
    if ideal is not None:
        t_s = seconds(unrounded(sim.truth.t_ns)[:1], start_ns + nanoseconds(shift_s))[0] + ideal.t_s
        ideal = replace(ideal, t_s=t_s, channels=_channels(real, start_ns + np.round(t_s * 1e9).astype(np.int64)))
        witnesses = recorded_at(sim.imu, t_s, start_ns + nanoseconds(shift_s)), recorded_at(real.imu, t_s, start_ns, ideal.gyro)
        ideal, density = _shared_motion(ideal, 0.5 / period_s, np.concatenate(witnesses, axis=1), settings.alignment)
        return ideal, np.zeros(6), None if own_poses else density
    t_s = np.linspace(t_sim[0], t_sim[-1], round((t_sim[-1] - t_sim[0]) / period_s) + 1)  # on the samples, if they are even
    even = np.asarray(make_interp_spline(t_sim, samples, k=3)(t_s))
    recorded = None if own_poses else recorded_at(real.imu, t_s, start_ns, even[:, :3])  # shares no errors of poses either
    clean, density = denoised(even, 1.0 / period_s, settings.alignment, recorded)
    clean = even if copied else clean  # what the filter takes would separate a recording from itself
    noise = np.minimum(noise, density.maximum)  # a vibration looks like white noise, and a recording shares it
    clean = refined(clean, *of_real)
    t_s = np.linspace(t_s[0], t_s[-1], len(clean))
    alpha = np.asarray(make_interp_spline(t_s, clean[:, :3], k=5)(t_s, 1))
    t_ns = start_ns + np.round(t_s * 1e9).astype(np.int64)
    known = (_attitude(sim, t_ns + round(shift_s * 1e9)), _attitude(real, t_ns))
    R_wb = next((R for R in known if R is not None), None)
    R_wb = attitude_by_gyro(t_s, clean[:, :3], clean[:, 3:]) if R_wb is None else R_wb
    motion = IdealMotion(t_s, clean[:, :3], clean[:, 3:], alpha, R_wb, _channels(real, t_ns))
    return motion, noise, None if own_poses else density


def _by_poses(
    sim: Recording,
    samples: Float64[np.ndarray, "m 6"],
    noise: Float64[np.ndarray, "6"],
    rate_hz: float,
    of_real: tuple[Float64[np.ndarray, "6"], int],
    settings: DiagnoseSettings,
) -> IdealMotion | None:
    """Ideal motion of the simulation's own poses, so dense that a spline through it is exact for the recording's noise.

    None unless the simulated samples are that motion plus white noise and a constant. `of_real` are noise and number of the
    recording's samples.
    """
    if not sim.truths:
        return None
    poses, own, t_ns = replace(sim.truth, t_ns=unrounded(sim.truth.t_ns)), settings.alignment, sim.imu.t_ns
    holes = np.diff(poses.t_ns).max() > 1e9 * settings.split.gap_periods * poses.period_s
    rows = (t_ns >= poses.t_ns[0]) & (t_ns <= poses.t_ns[-1])
    if holes or poses.period_s * own.poses_hz > 1.0 or rows.mean() < own.poses_share:
        return None
    trajectory = fit_trajectory(poses)  # a simulation's poses are exact, or the test below fails
    at_samples = trajectory.at(t_ns[rows])
    residual = samples[rows] - np.concatenate([at_samples.omega_b, at_samples.specific_force()], axis=1)
    R_wb = quaternion.matrix(at_samples.q_wb_wxyz)
    off = gravity_error(R_wb, residual[:, 3:], settings.search.observable_squares)
    residual[:, 3:] -= np.einsum("nji,j->ni", R_wb, off)
    if not is_white(residual - residual.mean(axis=0), noise, MIN_NOISE, own.coarse_bands, own.coarse_factor, own.line_chance):
        return None
    rate_hz *= refinement(np.concatenate([at_samples.omega_b, at_samples.specific_force()], axis=1), *of_real)
    t_ns = poses.t_ns[0] + np.arange(int(poses.duration_s * rate_hz) + 1) * round(1e9 / rate_hz)
    motion = trajectory.at(t_ns[t_ns <= poses.t_ns[-1]])
    t_s = np.arange(len(motion.p_wb)) * round(1e9 / rate_hz) * 1e-9
    R_wb, force = quaternion.matrix(motion.q_wb_wxyz), motion.specific_force(g_w=G_W - off)
    return IdealMotion(t_s, motion.omega_b, force, motion.alpha_b, R_wb)


def _shared_motion(
    ideal: IdealMotion, max_hz: float, witnesses: Float64[np.ndarray, "n r"], settings: AlignmentSettings
) -> tuple[IdealMotion, NoiseLeft]:
    """Motion of poses at the frequencies, up to `max_hz`, that an IMU shares, and the noise that is left in it."""
    noisy = np.concatenate([ideal.gyro, ideal.accel], axis=1)
    clean, noise_left = denoised(noisy, ideal.rate_hz, settings, witnesses, of_poses_to_hz=max_hz)
    alpha = ideal.alpha - np.asarray(make_interp_spline(ideal.t_s, noisy[:, :3] - clean[:, :3], k=5)(ideal.t_s, 1))
    return replace(ideal, gyro=clean[:, :3], accel=clean[:, 3:], alpha=alpha), noise_left


def _attitude(recording: Recording, t_ns: np.ndarray) -> Float64[np.ndarray, "n 3 3"] | None:
    if not recording.truths:
        return None
    poses, known = recording.truth.at(t_ns, max_gap_s=1.0)
    return quaternion.matrix(poses.q_wb_wxyz) if known.mean() > 0.9 else None


def _shift(real: Imu, sim: Imu, settings: AlignmentSettings) -> float | None:
    """Clock shift (s) to add to the recording's times; 0 where a clock offset explains it, None for two motions."""
    overlap = (min(real.t_ns[-1], sim.t_ns[-1]) - max(real.t_ns[0], sim.t_ns[0])) * 1e-9
    shared = overlap > min(settings.min_s, 0.5 * min(real.duration_s, sim.duration_s))
    if _rests(sim) and (_rests(real) or may_rest(real)):
        return 0.0 if shared else (int(sim.t_ns[0]) - int(real.t_ns[0])) * 1e-9
    dead, hz = not np.ptp(real.gyro, axis=0).any(), settings.align_hz  # then the accelerometer shows the motion
    turns = [_turning(imu.t_ns, imu.accel if dead else imu.gyro, hz) for imu in (real, sim)]
    found = cross_correlation(turns[0], turns[1], round(min(settings.min_s * hz, 0.8 * min(map(len, turns)))))
    lag_s = (int(sim.t_ns[0]) - int(real.t_ns[0])) * 1e-9 + found.lag / hz
    within = (found.best(np.abs(lag_s) < max_s) for max_s in (settings.farthest_s, settings.offset_s, np.inf))
    (_, _, near), (_, _, at_0), (lag, alike, sigma) = within
    if shared and near > settings.alike_sigma[0] and sigma < at_0 + settings.alike_sigma[1]:
        return 0.0
    if sigma < settings.alike_sigma[1] or alike < settings.min_correlation:
        return None
    at_s = float(lag_s[found.lag == lag][0])
    return at_s if dead else _refined(real, sim, at_s, settings)


def _rests(imu: Imu) -> bool:
    """Whether a gyro shows noise only, so that nothing can be aligned, and nothing has to be."""
    return all(nothing_but_noise(column, minimum) for column, minimum in zip(imu.gyro.T, MIN_NOISE, strict=False))


def _refined(real: Imu, sim: Imu, lag_s: float, settings: AlignmentSettings) -> float:
    """Lag (s) refined by Gauss-Newton, together with any linear map of the simulated rates."""
    t_s = seconds(real.t_ns, int(real.t_ns[0]))
    t_sim, off_s = seconds(sim.t_ns, int(real.t_ns[0]) + nanoseconds(lag_s)), 0.0
    rate = make_interp_spline(t_sim, sim.gyro, k=3)
    for _ in range(REFINEMENTS):
        inside = (t_s + off_s >= t_sim[0]) & (t_s + off_s <= t_sim[-1])
        at_s, recorded = t_s[inside] + off_s, real.gyro[inside]
        A = np.column_stack([rate(at_s), np.ones(len(at_s))])
        M = np.linalg.lstsq(A, recorded, rcond=None)[0]
        slope = rate(at_s, 1) @ M[:3]
        slope -= A @ np.linalg.lstsq(A, slope, rcond=None)[0]
        off_s += float((slope * (recorded - A @ M)).sum() / max(float((slope**2).sum()), 1e-300))
        if abs(off_s) > 1.0 / settings.align_hz:
            return lag_s  # what separates the two is no delay
    return lag_s + off_s


def _turning(t_ns: Times, x: Vectors, rate_hz: float) -> Float64[np.ndarray, " m"]:
    """Size of the angular rate, or of another vector, on an even clock."""
    size, t_s = np.linalg.norm(x - np.median(x, axis=0), axis=1), seconds(t_ns, int(t_ns[0]))
    return np.asarray(np.interp(np.arange(0.0, t_s[-1], 1.0 / rate_hz), t_s, size))
