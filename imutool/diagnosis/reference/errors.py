"""Errors of a reference: wrong intervals, smoothed poses, a turned attitude.

Poses that were lost and bridged give a simulation, or a truth, another motion there. No effect of a sensor lasts two seconds
and leaves no trace, so where all the rest is noise, the reference is wrong. A shock leaves none either, but is faster than a
body moves, and in the recording's own samples.

Poses that were estimated with the gyro follow it from one second to the next, and their own sensor over many. If that sensor
is misaligned, R_ref = R_wb Exp(turned): means of the gyro over seconds are turned by Exp(turned), fast motion is not. No
mount does that, which turns slow and fast motion alike.

Poses that were smoothed turn and move less than the body where that is fast. To first order a symmetric filter of variance s²
takes s²/2 times the second derivative; without it, a gyro against such poses seems to have a scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.signal import butter, sosfiltfilt
from scipy.stats import chi2

from imutool.array_types import Float64, Rows6, Vectors
from imutool.diagnosis.estimation.gauss_newton import fit
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.whitening import WhitenedImu
from imutool.diagnosis.result import Estimate, Finding, HeldOut, Located
from imutool.diagnosis.settings import ReferenceSettings
from imutool.recording import Recording
from imutool.recording.columns import true_ranges
from imutool.sensor import catalogue
from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.samples import IdealMotion
from imutool.units import ASCII_UNITS, AXES, SENSORS

CLEAR = 3.0  # deviations from which a component of the rotation counts
NYQUIST_SHARE, FAST_SHARE = 0.45, 0.5  # of the sample rate, where nothing faster is left; of a shock's squares, that are fast
MOSTLY = 0.8  # of the samples of a block that have to be usable
Matrix = Float64[np.ndarray, "3 3"]
Vector = Float64[np.ndarray, "3"]


def reference_errors(logs: Sequence[WhitenedImu]) -> tuple[list[Finding], tuple[Located, ...]]:
    """Intervals of a wrong reference, as a finding and locations; of shocks their locations.

    Poses that jump part a recording into stretches. Of several recordings nothing is said.
    """
    if len({log.pair.name for log in logs}) != 1 or not any(log.rows("all").any() for log in logs):
        return [], ()
    settings = logs[0].pair.settings.reference
    block_s, p_value = settings.block_s, settings.p_value
    t_s, white = (np.concatenate(each) for each in zip(*map(_white_misfit, logs), strict=True))
    block = np.floor((t_s - t_s[0]) / block_s).astype(int)
    count = np.maximum(np.bincount(block), 1)
    power = np.stack([np.bincount(block, weights=(white[:, k : k + 3] ** 2).sum(axis=1)) for k in (0, 3)])
    loud = chi2.logsf(power, 3 * count) < np.log(p_value)
    runs = _runs(loud.any(axis=0), float(t_s[0]), settings)
    if not runs or not _of_both_sensors(runs, t_s[0] + block_s * np.arange(len(count)), power, loud, settings):
        return [], ()
    inside = np.any([(t_s >= a - block_s) & (t_s <= b + block_s) for a, b in runs], axis=0)
    few = len(runs) <= settings.max_intervals and inside.mean() <= settings.max_of_time
    if not few or (white[~inside] ** 2).mean() > settings.quiet_chi_square:
        return [], ()
    excess = (white[inside] ** 2).sum() - 6.0 * inside.sum()
    share = float(np.clip(excess / max(float((white**2).sum() - 6.0 * len(white)), 1e-300), 0.0, 1.0))
    shock = any(_is_shock(log, runs) for log in logs)
    own = "no regime: shocks of the recording" if shock else "no regime: the reference's own moments"
    places = tuple(
        Located(signal, axes or AXES, tuple(runs), own, share, p_value, extent="intermittent")
        for signal, squares in zip(SENSORS, (white[inside] ** 2).mean(axis=0).reshape(2, 3), strict=True)
        for axes in [tuple(axis for axis, value in zip(AXES, squares, strict=True) if value > 1.3)]
    )
    if shock:
        return [], places
    length = float(np.mean([b - a for a, b in runs]))
    parameters = {"length": Estimate(length, block_s / np.sqrt(6.0 * len(runs)) + 0.1 * length, "s")}
    parameters |= {f"t_{k}": Estimate(a, block_s, "s") for k, (a, _) in enumerate(runs)}
    held_out = _away_from(runs, logs, block_s)
    finding = Finding("reference_error", "both", share, p_value, p_value, parameters, "the reference is wrong there", held_out)
    return [finding], places


def _white_misfit(log: WhitenedImu) -> tuple[Float64[np.ndarray, " n"], Rows6]:
    """Times of a log's rows, and white residuals of no effect without their constants."""
    rows = log.rows("all")
    white, constant = log.whiten(log.pair.real - expected(log.pair, ()))[rows], log.constants[rows]
    middle = np.median(white / np.where(constant == 0, 1.0, constant), axis=0)  # a mean would carry the misfit
    return log.pair.stamp_s[:: log.whiten.every][rows], white - middle * constant


def _of_both_sensors(
    runs: Sequence[tuple[float, float]],
    at_s: Float64[np.ndarray, " b"],
    power: Float64[np.ndarray, "2 b"],
    loud: np.ndarray,
    settings: ReferenceSettings,
) -> bool:
    """Whether both sensors show short intervals that hold most of the misfit: at the edge of one, one sensor may be loud."""
    parts = [(at_s >= a - 1e-6) & (at_s < b) for a, b in runs]
    both = [part for part in parts if loud[:, part].any(axis=1).all()]
    shown, whole = (sum(float(power[:, part].sum()) for part in some) for some in (both, parts))
    return shown > settings.both_share * whole and all(b - a <= settings.longest_s for a, b in runs)


def _away_from(runs: Sequence[tuple[float, float]], logs: Sequence[WhitenedImu], block_s: float) -> HeldOut:
    """Misfit of the accelerometer on held-out time, with and without some intervals."""
    before, after, seconds = [], [], 0.0
    for pair in (log.pair for log in logs):
        residual = pair.real - expected(pair, ())
        residual, t_s = residual - np.median(residual, axis=0), pair.stamp_s
        away = pair.held_out & ~np.any([(t_s >= a - block_s) & (t_s <= b + block_s) for a, b in runs], axis=0)
        before.append(residual[pair.held_out, 3:])
        after.append(residual[away, 3:])
        seconds += float(pair.held_out.sum()) * pair.period_s
    rms_before, rms_after = (float(np.sqrt((np.concatenate(each) ** 2).mean())) for each in (before, after))
    return HeldOut(rms_before, rms_after, ASCII_UNITS["accel"], round(seconds, 1))


def _is_shock(log: WhitenedImu, runs: Sequence[tuple[float, float]]) -> bool:
    """Whether the misfit in some intervals is in the recording's own fast samples: a landing or a blow.

    A body moves slower than `motion_hz`. So a reference that lost its motion misses slow samples, and one that jumps has fast
    samples that the recording lacks.
    """
    pair, rate_hz = log.pair, 1.0 / log.pair.period_s
    own_hz = pair.settings.noise.motion_hz
    if own_hz >= NYQUIST_SHARE * rate_hz:
        return False
    fast = sosfiltfilt(butter(2, own_hz, "high", fs=rate_hz, output="sos"), pair.real, axis=0)
    inside = np.any([(pair.stamp_s >= a) & (pair.stamp_s <= b) for a, b in runs], axis=0)
    if not inside.any():
        return False
    misfit = pair.real - expected(pair, ())
    misfit = misfit - np.median(misfit, axis=0)
    shaken, missed = ((x[inside] ** 2).mean(axis=0) - (x[~inside] ** 2).mean(axis=0) for x in (fast, misfit))
    return all(shaken[part].sum() > FAST_SHARE * missed[part].sum() for part in pair.signals.values())


def _runs(loud: np.ndarray, start_s: float, settings: ReferenceSettings) -> list[tuple[float, float]]:
    """Stretches of loud blocks (s), those close to one another joined."""
    out: list[tuple[float, float]] = []
    for first, last in true_ranges(loud):
        begin, end = start_s + first * settings.block_s, start_s + last * settings.block_s
        if out and begin - out[-1][1] < settings.join_s:
            out[-1] = out[-1][0], end
        else:
            out.append((begin, end))
    return out


def reference_caveat(recordings: Sequence[Recording]) -> str:
    """Caveat on true poses that were estimated with the IMU, by their description; else empty."""
    texts = (str(text) for recording in recordings for record in recording.metadata.values() for text in record.values())
    if any("and IMU measurements" in text for text in texts):
        return "its poses were estimated with this IMU, and hide errors of the gyro"
    return next((recording.truth_caveat for recording in recordings if recording.truth_caveat), "")


# ── smoothed poses ──


def _sharpened(motion: IdealMotion, theta: Theta) -> IdealMotion:
    gyro, accel = (
        _less_curvature(x, weight, motion.rate_hz) for x, weight in ((motion.gyro, theta[0]), (motion.accel, theta[1]))
    )
    return replace(motion, gyro=gyro, accel=accel)


def _less_curvature(x: Vectors, weight: float, rate_hz: float) -> Vectors:
    """Columns less their second derivative times a weight, each column one piece of memory as before."""
    out = x.copy(order="K")
    second = x[2:] - 2.0 * x[1:-1]
    second += x[:-2]
    second *= rate_hz**2
    second *= weight
    out[1:-1] -= second
    return out


SMOOTHED = Effect(
    "reference_smoothing",
    Stage.MOTION,
    ("gyro", "accel"),
    "omega -= turn d²omega/dt², f -= move d²f/dt²",
    (Parameter("turn", "s^2", 1e-4), Parameter("move", "s^2", 1e-4)),
    "it moves fast",
    _sharpened,
)


# ── an attitude that is turned throughout ──


def turned_reference(logs: Sequence[WhitenedImu], chosen: Chosen) -> list[Finding]:
    """Finding of poses whose attitude is turned by a constant rotation; none for another misfit.

    Means over seconds of the gyro's residual are r = b + turned x omega, those of the accelerometer b + turned x f; the two
    have to agree, and the samples themselves must not follow the rotation (then it is the mount's).
    """
    if any(log.pair.exact or log.pair.ideal.R_wb is None for log in logs) or len({log.pair.name for log in logs}) > 1:
        return []
    settings = logs[0].pair.settings.reference
    means = [_slow_means(log, chosen) for log in logs]
    residual, signal = (np.concatenate([part[k] for part in means]) for k in (0, 1))
    if len(residual) < settings.min_turned_blocks:
        return []
    turned, C_gyro, share = _rotation(residual[:, :3], signal[:, :3])
    by_gravity, C_gravity, _ = _rotation(residual[:, 3:], signal[:, 3:])
    p_value = float(chi2.sf(turned @ np.linalg.solve(C_gyro, turned), 3))
    off = turned - by_gravity
    alike = chi2.sf(off @ np.linalg.solve(C_gyro + C_gravity, off), 3) > settings.turned_alike_p_value
    std = np.sqrt(np.diag(C_gyro))
    clear = np.where(np.abs(turned) > CLEAR * std, turned, 0.0)
    large = np.linalg.norm(clear) > settings.min_turned_rad and share > settings.min_turned_share
    if p_value > settings.p_value or not alike or not large:
        return []
    (mount,) = catalogue.diagnosed(["mount_rotation"])
    others = tuple(entry for entry in chosen if entry[0].name != mount.name)
    fitted = fit(logs, (*others, (mount, mount.null_value.astype(float))), part="all")
    off = turned + fitted.chosen[-1][1]
    C_both = C_gyro + np.diag(np.square(fitted.stds()[mount.key]))
    if chi2.sf(off @ np.linalg.solve(C_both, off), 3) > settings.p_value:
        return []
    parameters = {f"turned_{axis}": Estimate(float(a), float(s), "rad") for axis, a, s in zip(AXES, turned, std, strict=True)}
    held_out = HeldOut(0.0, 0.0, ASCII_UNITS["gyro"], round(len(residual) * settings.turned_block_s, 1))
    return [Finding("reference_error", "both", share, p_value, p_value, parameters, "R_ref = R_wb Exp(turned)", held_out)]


def _slow_means(log: WhitenedImu, chosen: Chosen) -> tuple[Float64[np.ndarray, "b 6"], Float64[np.ndarray, "b 6"]]:
    """Means of the residual and of the expected samples over blocks that are usable throughout."""
    pair, model = log.pair, expected(log.pair, chosen)
    count = round(pair.settings.reference.turned_block_s / pair.period_s)
    blocks = len(model) // count
    usable = np.asarray(pair.usable.all(axis=1), dtype=float)[: blocks * count]
    used = np.flatnonzero(usable.reshape(blocks, count).mean(axis=1) > MOSTLY)

    def means(x: Rows6) -> Float64[np.ndarray, "b 6"]:
        return np.asarray(x[: blocks * count].reshape(blocks, count, 6).mean(axis=1)[used])

    return means(pair.real - model), means(model)


def _rotation(residual: Float64[np.ndarray, "b 3"], signal: Float64[np.ndarray, "b 3"]) -> tuple[Vector, Matrix, float]:
    """Rotation with residual = constant + rotation x signal, its covariance by blocks, its share of the squares."""
    J = np.stack([np.cross(axis, signal) for axis in np.eye(3)], axis=2)
    J, y = J - J.mean(axis=0), residual - residual.mean(axis=0)
    information = np.einsum("bkp,bkq->pq", J, J)
    information += 1e-9 * np.trace(information) * np.eye(3)
    rotation = np.linalg.solve(information, np.einsum("bkp,bk->p", J, y))
    remaining = y - np.einsum("bkp,p->bk", J, rotation)
    scores = np.einsum("bkp,bk->bp", J, remaining)
    C = np.linalg.solve(information, np.linalg.solve(information, scores.T @ scores).T) * len(y) / max(len(y) - 2, 1)
    return rotation, C, 1.0 - float((remaining**2).sum() / max((y**2).sum(), 1e-300))
