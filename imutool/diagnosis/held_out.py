"""Residuals behind the findings: held-out gain, whiteness, ringing, resimulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import msgspec
import numpy as np
from scipy.linalg import hankel
from scipy.signal import butter, sosfiltfilt, welch
from scipy.stats import chi2, ttest_1samp
from scipy.stats import f as fisher

from imutool.array_types import Float64, Rows6
from imutool.diagnosis.estimation.aligned_log import AlignedLog, Pair
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.noise_estimate import noise_std
from imutool.diagnosis.estimation.whitening import WhitenedImu, WhitenedLog
from imutool.diagnosis.result import Closer, Estimate, Finding, HeldOut, Unexplained
from imutool.errors import DataError
from imutool.recording import Recording, nanoseconds
from imutool.sensor.effect import Acting, simulate_stretches
from imutool.sensor.physics_file import PhysicsFile
from imutool.sensor.samples import IdealMotion
from imutool.sensor.simulate import MOTION_HZ
from imutool.sensor.trajectory import smooth_motion

MIN_NOISE = {"gyro": 1e-4, "accel": 1e-3}  # rad/s, m/s²: of a sensor without a usable axis
AS_GOOD = 0.3  # of the noise: how far a simulation along the poses may be from the one that was given, and still stand for it
MODES = 6  # order of the subspace model: the mode, and two that take up what is left
RINGING_BAND = 1.5  # times the frequency of a mount, on both sides
MAX_OF_IT = 0.8  # of the held-out samples that the poses have to cover


def with_effects(pair: AlignedLog, chosen: Chosen) -> Float64[np.ndarray, "n k"]:
    """Expected samples with some effects and the best constant."""
    return with_constant(pair, expected(pair, chosen))


def with_constant(pair: AlignedLog, model: Float64[np.ndarray, "n k"]) -> Float64[np.ndarray, "n k"]:
    """Expected samples with the best constant; none for an unusable axis."""
    usable = pair.usable
    constant = np.where(usable, pair.real - model, 0.0).sum(axis=0) / np.maximum(usable.sum(axis=0), 1)
    return np.asarray(model + constant)


def noise_floor(logs: Sequence[WhitenedLog]) -> Float64[np.ndarray, " k"]:
    """Noise standard deviation of a sample by axis; neighbours stand in for an unusable one."""
    count = np.sum([log.pair.axes for log in logs], axis=0)
    variance = np.sum([log.pair.axes * noise_std(log.whiten) ** 2 for log in logs], axis=0) / np.maximum(count, 1.0)
    for signal, part in logs[0].pair.signals.items():
        known = count[part] > 0
        variance[part][~known] = variance[part][known].mean() if known.any() else MIN_NOISE[signal] ** 2
    return np.asarray(np.sqrt(variance))


def _residual(log: WhitenedLog, model: Float64[np.ndarray, "n k"], part: slice) -> Float64[np.ndarray, " m"]:
    """Residual of usable held-out samples, within the band in which the reference is known."""
    pair, counts = log.pair, log.whiten.counts
    residual, rows = pair.real - model, pair.held_out[:: log.whiten.every]
    if log.whiten.band is not None:
        residual = log.whiten.band(residual)
    return np.asarray(residual[rows, part].ravel() if counts is None else residual[rows, part][counts[rows, part]])


def gains(logs: Sequence[WhitenedLog], before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> dict[str, Closer]:
    """Gain of all findings together by signal, on held-out time."""
    noise = noise_floor(logs)
    return {
        signal: Closer.computed(held_out_rms(logs, before, after, signal), signal_noise(logs, noise, signal))
        for signal in known_signals(logs)
    }


def signal_noise(logs: Sequence[WhitenedLog], floor: Float64[np.ndarray, " k"], signal: str) -> float:
    """Root mean square noise of a signal over its usable axes."""
    part, axes = logs[0].pair.signals[signal], np.any([log.pair.axes for log in logs], axis=0)
    return float(np.sqrt(np.mean(floor[part][axes[part]] ** 2)))


def held_out_rms(
    logs: Sequence[WhitenedLog], before: Sequence[np.ndarray], after: Sequence[np.ndarray], signal: str
) -> HeldOut:
    """Root mean square residuals over held-out samples of a signal; NaN where none are usable."""
    part, rms = logs[0].pair.signals[signal], []
    for models in (before, after):
        residual = np.concatenate([_residual(log, model, part) for log, model in zip(logs, models, strict=True)])
        rms.append(float(np.sqrt((residual**2).mean())) if len(residual) else float("nan"))
    length = sum(float(log.pair.held_out.sum()) * log.pair.period_s for log in logs)
    return HeldOut(rms[0], rms[1], logs[0].pair.unit_of(signal), round(length, 1))


def unexplained_residuals(
    logs: Sequence[WhitenedLog],
    after: Sequence[Float64[np.ndarray, "_ k"]],
    noises: Float64[np.ndarray, " k"],
) -> dict[str, Unexplained]:
    """Residuals by signal with their noise; against poses, blocks decide on whiteness."""
    out, beside_poses, signals = {}, any(log.whiten.band is not None for log in logs), logs[0].pair.signals
    settings = logs[0].pair.settings.held_out
    for signal in known_signals(logs):
        held_out, noise = held_out_rms(logs, after, after, signal), signal_noise(logs, noises, signal)
        part = signals[signal]
        held_out_count = sum(len(_residual(log, model, part)) for log, model in zip(logs, after, strict=True))
        fitted_count = sum(log.count("fitted") for log in logs) / len(signals)
        maximum, p_value = settings.white_ratio, 1.0
        if held_out_count:
            by_chance = fisher(held_out_count, max(fitted_count, 1.0))
            maximum = max(maximum, float(np.sqrt(by_chance.isf(settings.few_samples_p_value))))
            p_value = float(by_chance.sf((held_out.rms_after / noise) ** 2))
        white = held_out.rms_after < maximum * noise
        if not white and beside_poses:
            p_value = _p_value(logs, after, part, noise)
            white = p_value > settings.white_p_value and held_out.rms_after < settings.max_white_ratio * noise
        minimum = held_out.rms_after or noise  # no noise is larger: it was measured without what the findings explain
        out[signal] = Unexplained(held_out.rms_after, min(noise, minimum), white, p_value)
    return out


def _p_value(logs: Sequence[WhitenedLog], after: Sequence[Float64[np.ndarray, "_ k"]], part: slice, noise: float) -> float:
    """p-value of the power of held-out blocks under white noise (Student's t over blocks)."""
    powers, settings = list[float](), logs[0].pair.settings.held_out
    for log, model in zip(logs, after, strict=True):
        if not log.pair.axes[part].any():
            continue
        rows = log.pair.held_out[:: log.whiten.every]
        residual = log.pair.real - model if log.whiten.band is None else log.whiten.band(log.pair.real - model)
        power = (residual[rows, part][:, log.pair.axes[part]] ** 2).mean(axis=1)
        block = np.floor(log.pair.stamp_s[:: log.whiten.every][rows] / settings.block_s).astype(int)
        powers += [float(power[block == number].mean()) for number in np.unique(block)]
    if len(powers) < 2:
        return 1.0
    return float(ttest_1samp(powers, (settings.white_ratio * noise) ** 2, alternative="greater").pvalue)


def known_signals(logs: Sequence[WhitenedLog]) -> list[str]:
    """Signals with a usable axis."""
    axes = np.any([log.pair.axes for log in logs], axis=0)
    return [signal for signal, part in logs[0].pair.signals.items() if axes[part].any()]


# ── what rings ──


def ringing(logs: Sequence[WhitenedImu], after: Sequence[np.ndarray]) -> list[Finding]:
    """Finding of a mount that rings after shocks, from the residual of the accelerometer alone.

    Shocks between two samples cannot be predicted; their free decay is seen all the same. Poles follow from the residual's
    correlation (covariance-driven subspace identification: Peeters and De Roeck, MSSP 13, 1999), deviations from a jackknife.
    """
    if len(logs) != 1 or not logs[0].pair.exact or not logs[0].pair.axes[3:].any():
        return []
    (log,), rate_hz, settings = logs, 1.0 / logs[0].pair.period_s, logs[0].pair.settings.ringing
    rows = np.asarray(log.pair.usable.any(axis=1))
    residual = np.where(log.pair.usable, log.pair.real - after[0], 0.0)[:, 3:][:, log.pair.axes[3:]]  # limits do not ring
    residual = residual - residual.mean(axis=0)
    f_hz, power = welch(residual, rate_hz, nperseg=min(settings.segment_samples, len(residual)), axis=0)
    total = power.sum(axis=1)
    noise, top = log.pair.noise_left, log.pair.settings.alignment.noise_band
    max_hz = top * min(0.5 * rate_hz, np.inf if noise is None else noise.f_hz[-1])  # above, a simulation has no motion
    seen = (f_hz >= settings.min_hz) & (f_hz <= max_hz)
    if not seen.any():
        return []
    peak = int(np.flatnonzero(seen)[np.argmax(total[seen])])
    at = f_hz / f_hz[peak]
    sides = [np.flatnonzero((at > low) & (at < high)) for low, high in ((0.4, 0.7), (1.4, 2.0))]
    floor = max(float(np.median(total[side])) if len(side) else np.inf for side in sides)
    if total[peak] < settings.peak_factor * floor:
        return []
    lags = int(np.clip(3.0 * rate_hz / f_hz[peak], 16, 256))
    blocks = np.array([_correlation(block, 2 * lags) for block in np.array_split(residual, settings.blocks)])
    poles = np.array([_pole(blocks.sum(axis=0) - left_out, rate_hz, float(f_hz[peak])) for left_out in [0.0, *blocks]])
    (f0, zeta), others = poles[0], poles[1:]
    std = np.sqrt((len(others) - 1) * ((others - others.mean(axis=0)) ** 2).mean(axis=0))
    clear = np.isfinite(poles).all() and std[0] < 0.05 * f0 and 3.0 * std[1] < zeta
    if not clear or not settings.min_damping < zeta < settings.max_damping:
        return []
    edges_hz = f0 / RINGING_BAND, min(f0 * RINGING_BAND, 0.49 * rate_hz)
    alone = sosfiltfilt(butter(2, edges_hz, "bandpass", fs=rate_hz, output="sos"), residual, axis=0)[rows]
    lower = log.pair.settings.search.model_error_reference * float(after[0][rows, 3:].var(axis=0).sum())  # a simulation rounds
    wanders = (alone**4).mean() < settings.min_kurtosis * (alone**2).mean() ** 2  # as a rotor's speed: nothing decays
    if wanders or (alone**2).sum(axis=1).mean() < lower:
        return []
    ratio = float(total[peak]) / floor
    p_value = float(chi2.sf(2.0 * ratio * settings.blocks, 2 * settings.blocks))
    parameters = {"f0": Estimate(float(f0), float(std[0]), "Hz"), "zeta": Estimate(float(zeta), float(std[1]), "-")}
    text = "accel rings after shocks: exp(-zeta w0 t) cos(w0 sqrt(1 - zeta^2) t + phase), w0 = 2 pi f0; no sample predicts it"
    length_s = round(float(rows.sum()) * log.pair.period_s, 1)
    return [Finding("mount_resonance", "accel", 0.0, p_value, p_value, parameters, text, HeldOut(0.0, 0.0, "m/s^2", length_s))]


def _correlation(x: Float64[np.ndarray, "n k"], lags: int) -> Float64[np.ndarray, " l"]:
    """Correlation at lags from 1, summed over columns: without white noise, which is all at lag 0."""
    return np.array([float((x[lag:] * x[:-lag]).sum()) for lag in range(1, lags + 1)])


def _pole(c: Float64[np.ndarray, " l"], rate_hz: float, near_hz: float) -> tuple[float, float]:
    """Frequency (Hz) and damping of the mode nearest to a frequency; NaN where there is none."""
    n = len(c) // 2
    before, after = (hankel(c[k : k + n], c[k + n - 1 : k + 2 * n - 1]) for k in (0, 1))
    U, s, Vt = np.linalg.svd(before)
    root = np.sqrt(s[:MODES])
    A = (U[:, :MODES] / root).T @ after @ (Vt[:MODES].T / root)
    z = np.log(np.linalg.eigvals(A).astype(complex)) * rate_hz
    z = z[(z.imag > 0.0) & (z.real < 0.0)]
    if not len(z):
        return np.nan, np.nan
    nearest = z[np.argmin(np.abs(np.abs(z) - 2.0 * np.pi * near_hz))]
    return float(np.abs(nearest)) / (2.0 * np.pi), float(-nearest.real / np.abs(nearest))


# ── a second simulation ──


def resimulate(logs: Sequence[WhitenedImu], sim: Recording, physics: PhysicsFile, clock: Chosen) -> Mapping[str, Closer]:
    """Gain of a second simulation with some physics by signal, on held-out time.

    `clock` is the offset that is in every fit where the clocks share no epoch.

    Raises:
        DataError: the simulation has no poses that stand for its samples, or they cover too little of a log.
        ImutoolError: its poses are no motion, or the physics cannot act on it.
    """
    if not sim.truths:
        raise DataError("it has no poses", where=sim.name, expected="poses to simulate along")
    motion = smooth_motion(sim.truth)
    rate_hz = 1.0 / sim.imu.period_s
    ideals = motion.ideal_motions(rate_hz * max(1, int(np.ceil(MOTION_HZ / rate_hz))))
    acting = physics.acting()
    covered, before, after = [], [], []
    for log in logs:
        on_its_clock = [_on_clock_of(ideal, motion.start_ns, log.pair) for ideal in ideals]
        plain, simulated = (_read(log.pair, on_its_clock, [*effects, *clock]) for effects in ((), acting))
        finite = np.isfinite(plain).all(axis=1) & np.isfinite(simulated).all(axis=1)
        given = expected(log.pair, clock)
        plain, simulated = (np.where(finite[:, None], read, given) for read in (plain, simulated))  # a filter spreads NaN
        pair = replace(log.pair, fitted=log.pair.fitted & finite, held_out=log.pair.held_out & finite)
        if pair.held_out.sum() < MAX_OF_IT * log.pair.held_out.sum():
            raise DataError("its poses cover too little of the recording", where=sim.name)
        covered.append(WhitenedImu(pair, log.whiten))
        before.append(with_constant(pair, given))
        after.append(with_constant(pair, given + simulated - plain))  # what a curve through poses misses is no physics
        _refuse_unlike(covered[-1], before[-1], with_constant(pair, plain), sim)
    return {
        signal: msgspec.structs.replace(gain, by="second simulation") for signal, gain in gains(covered, before, after).items()
    }


def _on_clock_of(ideal: IdealMotion, start_ns: int, pair: Pair) -> IdealMotion:
    """On the recording's clock, with its channels."""
    t_s = ideal.t_s + (start_ns - pair.log_start_ns - nanoseconds(pair.aligned_s)) * 1e-9
    channels = {name: np.interp(t_s, pair.ideal.t_s, values) for name, values in pair.ideal.channels.items()}
    return replace(ideal, t_s=t_s, channels=channels)


def _read(pair: Pair, ideals: Sequence[IdealMotion], acting: Acting) -> Rows6:
    """What the second simulation reads at the recording's stamps; NaN where it has no motion."""
    stamps = [pair.stamp_s[(pair.stamp_s >= ideal.t_s[0]) & (pair.stamp_s <= ideal.t_s[-1])] for ideal in ideals]
    samples = simulate_stretches(ideals, stamps, acting)
    out = np.full(pair.real.shape, np.nan)
    out[np.searchsorted(pair.stamp_s, samples.stamp_s)] = np.concatenate([samples.gyro, samples.accel], axis=1)
    return out


def _refuse_unlike(log: WhitenedImu, given: Rows6, plain: Rows6, sim: Recording) -> None:
    """Refuse poses so coarse or noisy that they give another simulation than the given one."""
    rows, off = log.pair.held_out[:: log.whiten.every], given - plain
    if log.whiten.band is not None:
        off = log.whiten.band(off)
    if (np.sqrt((off[rows] ** 2).mean(axis=0)) > AS_GOOD * noise_floor([log])).any():
        raise DataError("its samples do not follow from its poses", where=sim.name)
