"""Initial bias from true poses.

The constant bias that explains the drift of the integrated samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from imutool.array_types import Bool, Float64, Int64, Rows6, Vectors
from imutool.bias.model import Array, BiasModel, Vector6
from imutool.bias_start.bias_at_rest import UNUSUAL, refuted_stops, rest_differences
from imutool.bias_start.initial_bias import (
    MIN_STD,
    TRACKED_BY,
    InitialBias,
    accuracy,
    bias_prior,
    prior,
    relative_samples,
)
from imutool.bias_start.prior_width import MAX_UNKNOWN, BiasPrior, supported_std
from imutool.cleaning.rules.saturation import at_limit
from imutool.errors import ConfigError, DataError
from imutool.geometry import quaternion
from imutool.inertial.strapdown import GRAVITY_W, with_velocity
from imutool.log_info.convention_report import check_start_poses
from imutool.recording import Imu, Poses, Recording, nanoseconds, seconds
from imutool.recording.columns import median
from imutool.units import COLUMNS

TRUTH_S = 15.0  # length of truth for a start: of 3, 5, 8, 10 and 15 s the best on training logs left out in turn
MIN_TRUTH_S = 1.0
CHECKED_S = 60.0  # of truth and gyro that are compared first: 15 s do not always show a clock
NOT_SEEN = 1e3  # m/s²: deviation of the accelerometer's bias from poses without positions
WORLD_TILT_STD = np.array([0.0] * 3 + [0.1] * 3)  # m/s²: half a degree, as of EuRoC's second Vicon room
STEP_S = 0.1  # over which turns of poses and gyro are compared
JUMP_RAD, JUMP_MEDIANS, JUMP_SHARE = np.deg2rad(5.0), 10.0, 0.2  # as `imutool info` counts jumps of poses
BRIDGED_S = 2.0  # longest gap of the poses over which turns are compared: of a wrong pose between gaps both jumps count
LOST = 2.5  # median periods, beyond which samples are lost
MOUNT_STD = 0.05  # rad: plausible rotation of markers that were meant to be straight
OWN_MOUNT_STD = 0.005  # rad: of a log's markers against those of the training logs, which the model knows
SAME = 100.0  # samples whose poses have the same error
PARTS, CONTRADICTED = 3, 22.5  # of a start; chi-square of their scatter on three axes, exceeded once in a thousand usual starts
MIN_TRUTH_STD = np.array([5e-5] * 3 + [2e-3] * 3)  # rad/s and m/s²: no poses show a bias better
ITERATIONS = 4
HUBER_MEDIANS = 1.5  # threshold of an outlier, in medians of the residuals, as `inertial.windows`, which imports PyTorch
MAX_TURN_RAD = 2.0  # by a bias: a turn is known up to pi, so that of a larger bias begins near the median of its steps

Quaternions = Float64[np.ndarray, "n 4"]


def from_truth(model: BiasModel, recording: Recording, truth_s: float = TRUTH_S) -> InitialBias:
    """Initial bias from up to `truth_s` seconds of true poses and the prior; gaps do no harm.

    It holds as long as those poses last; after them the rest bias is tracked. Tracking uses gravity, and the world of the
    truth may be tilted against gravity. The tilt is a bias of the accelerometer while true poses are used, and an error later.

    Raises:
        DataError: no truth, or less than a second; another unit, clock, body or motion than the gyro's.
    """
    both = recording.overlap()
    first_ns = int(both.imu.t_ns[0])
    late_s = check_start_poses(both.between(first_ns, first_ns + nanoseconds(max(truth_s, CHECKED_S))))
    imu, truth = both.imu, replace(both.truth, t_ns=both.truth.t_ns - nanoseconds(late_s))
    poses, trusted = with_velocity(truth).at(imu.t_ns)
    t = seconds(imu.t_ns, int(imu.t_ns[0]))
    usable = np.flatnonzero(trusted)
    usable = usable[t[usable] <= t[usable[0]] + truth_s] if len(usable) else usable
    length_s = float(t[usable[-1]] - t[usable[0]]) if len(usable) else 0.0
    if length_s < MIN_TRUTH_S:
        expected = f"at least {MIN_TRUTH_S:g} s of it at the start"
        raise DataError(f"{length_s:.1f} s of truth", where=recording.name, expected=expected)
    rows = slice(int(usable[0]), int(usable[-1]) + 1)
    piece, poses = imu.rows(rows), poses.rows(rows)
    assert poses.v_w is not None
    start = prior(model, int(imu.t_ns[0]))
    residual = np.concatenate([piece.gyro, piece.accel], axis=1) - model.stream(start.rest)(*relative_samples(piece))
    alone = poses_turn_alone(replace(piece, gyro=residual[:, :3]), truth)
    mount_std = OWN_MOUNT_STD if model.card else MOUNT_STD
    q_wxyz, v_w, known = quaternion.unit(poses.q_wb_wxyz), poses.v_w, trusted[rows]
    parts = [np.arange(len(t[rows])), *np.array_split(np.arange(len(t[rows])), PARTS)]
    offset, *thirds = [
        bias_from_truth(t[rows][at], residual[at], q_wxyz[at], v_w[at], known[at], mount_std, alone[at])
        for at in parts
        if known[at].sum() > 1
    ]
    usual = model.truth_std**2 * (TRUTH_S / length_s) ** 2
    variance = _variance(usual, thirds, _by_calibration(model, piece, parts[1:])) if len(thirds) == PARTS else usual
    if not truth.has_positions:
        offset[3:], variance[3:] = 0.0, NOT_SEEN**2
    start = replace(start, std=supported_std(start.std, start.minimum, offset, variance + WORLD_TILT_STD**2))
    rest, std = _updated(start, offset, variance)
    late = f", of poses {1e3 * abs(late_s):.0f} ms {'late' if late_s > 0 else 'early'}" if late_s else ""
    doubt = ", whose thirds contradict each other" if (variance > usual)[:3].any() else ""
    weighed = ", weighed against the training logs" if model.card else ""
    how = f"truth over {length_s:.1f} s{late}{doubt}{weighed}, {accuracy(std)}"
    if not model.card:
        return InitialBias(rest, std, how)
    mean, spread = _updated(start, offset, variance + WORLD_TILT_STD**2)
    before = replace(bias_prior(model), mean=mean, std=np.maximum(spread, MIN_STD), minimum=None)
    if _turns_steadily(model, recording.imu.between(first_ns, first_ns + nanoseconds(CHECKED_S)), before):
        before, how = replace(before, stops=False), f"{how}; its stops are steady turns"
    ends_s = seconds(piece.t_ns[-1:], int(recording.imu.t_ns[0]))[0]
    return InitialBias(rest, std, f"{how}, then {TRACKED_BY}", follows=before, hold_s=float(ends_s))


def _turns_steadily(model: BiasModel, imu: Imu, known: BiasPrior) -> bool:
    """Whether what looks like a stop is a turn: its rate is not the known bias, and gravity in motion refutes it."""
    samples = relative_samples(imu)
    (at_stops,) = rest_differences(model, [samples], known.mean[None])
    off = np.linalg.norm(at_stops[:, :3] / np.hypot(known.std[:3], MAX_UNKNOWN), axis=1)
    return bool((off > UNUSUAL).any()) and refuted_stops(samples, model) is not None


def truth_seconds(init: str) -> float:
    """Seconds of `truth:SECONDS`.

    Raises:
        ConfigError: not a positive number.
    """
    text = init.partition(":")[2] or str(TRUTH_S)
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise ConfigError(f"{init!r}", where="init", expected="truth:SECONDS, for instance truth:5")
    return value


def _by_calibration(model: BiasModel, piece: Imu, thirds: Sequence[Int64[np.ndarray, " _"]]) -> Vector6:
    """Variance, from third to third, of what the calibration does not know of the motion."""
    out, root_at = np.zeros(6), model.calibration_covariance()
    for sensor, S in {} if root_at is None else root_at(*relative_samples(piece)).items():
        out[COLUMNS[sensor]] = np.var([S[at].mean(axis=0) for at in thirds], axis=0, ddof=1).sum(axis=1)
    return out


def _variance(usual: Vector6, thirds: Sequence[Vector6], by_calibration: Vector6) -> Vector6:
    """Variance of an offset: the usual one, or if those of thirds of the poses contradict it, what these show.

    Poses of a log may be worse than those of the training logs: markers are exchanged, a clock wanders. The usual variance of a
    third is 9 (errors that last) to 27 times (white ones) as large. Errors that contradict it are taken to last even longer:
    the variance of the whole is a third of what the thirds show. `by_calibration` is the variance among thirds that the model's
    calibration allows, because the body moves otherwise in each.
    """
    variance, shown = usual.copy(), np.var(thirds, axis=0, ddof=1)
    minimum = PARTS**2.5 * (np.maximum(usual, MIN_TRUTH_STD**2) + WORLD_TILT_STD**2) + by_calibration
    for axes in COLUMNS.values():
        if (PARTS - 1) * (shown[axes] / minimum[axes]).sum() > CONTRADICTED:
            variance[axes] = np.maximum(usual[axes], np.maximum(shown[axes], shown[axes].mean()) / PARTS)
    return variance


def poses_turn_alone(imu: Imu, truth: Poses) -> Bool[np.ndarray, " n"]:
    """Samples over which the poses turn and the gyro does not.

    The gyro was clipped, samples are lost, or the poses jump: no bias mends that, and a path keeps the error to its end. Poses
    often jump where some are missing, so turns over a short gap of the poses are compared, too. Poses that jump and are back in
    the next step leave nothing to mend: half of such a jump would stay.
    """
    t, (poses, valid) = seconds(imu.t_ns, int(imu.t_ns[0])), truth.at(imu.t_ns)
    dt, out = np.diff(t), np.zeros(len(t), bool)
    first = np.arange(0, len(t), max(1, round(STEP_S / median(dt)))) if len(dt) else np.zeros(1, int)
    step = np.flatnonzero(valid[first])
    begin, end = first[step[:-1]], first[step[1:]]
    known = (np.diff(step) == 1) | (t[end] - t[begin] < BRIDGED_S)
    if known.any():
        steps = quaternion.running_product(quaternion.exp(imu.gyro[:-1] * dt[:, None]))
        by_gyro = quaternion.unit(np.concatenate([[[1.0, 0.0, 0.0, 0.0]], steps]))
        seen, true = (quaternion.multiply(quaternion.inverse(q[begin]), q[end]) for q in (by_gyro, poses.q_wb_wxyz))
        more, span = quaternion.log(quaternion.multiply(seen, quaternion.inverse(true))), (t[end] - t[begin])[:, None]
        off = np.where(known[:, None], more - np.median((more / span)[known], axis=0) * span, 0.0)
        off = quaternion.rotate(by_gyro[begin], off)  # in one frame, that of the first sample: the body turns over a gap
        padded = np.pad(off, ((1, 1), (0, 0)))
        misfit, lasting = (np.linalg.norm(x, axis=1) for x in (off, padded[:-2] + off + padded[2:]))
        maximum = np.maximum(
            JUMP_SHARE * np.linalg.norm(quaternion.log(seen), axis=1), max(JUMP_RAD, JUMP_MEDIANS * median(misfit[known]))
        )
        clipped = np.logical_or.reduce([at_limit(column) for column in imu.gyro.T])[:-1]
        lost = np.logical_or.reduceat(clipped | (dt > LOST * median(dt)), begin)
        out[begin[0] : end[-1]] = np.repeat(known & (lost | ((misfit > maximum) & (lasting > maximum))), end - begin)
    return out


def _updated(start: InitialBias, offset: Vector6, variance: Vector6) -> tuple[Vector6, Vector6]:
    """Rest bias and standard deviation after measuring an offset of the start with a variance."""
    var = start.std**2
    gain = np.divide(var, var + variance, out=np.zeros(6), where=var > 0)  # a prior of zero variance stays
    return start.rest + gain * offset, np.sqrt(gain * variance)


def bias_from_truth(
    t_s: Float64[np.ndarray, " n"],
    samples: Rows6,
    q_wb_wxyz: Quaternions,
    v_w: Vectors,
    trusted: Bool[np.ndarray, " n"],
    mount_std: float = 0.0,
    alone: Bool[np.ndarray, " n"] | None = None,
) -> Vector6:
    """Constant bias of samples with true poses: the slope in time of the integration error.

    With `mount_std` (rad) the body of the poses may be turned against the gyro, which a constant else takes up in motion.
    Over the samples `alone` the poses turn and the gyro does not: these turns are left out.

    Rotation and velocity are integrated from the first true pose; their errors e(t) = e_0 + (sum of A) b are fitted at all
    trusted poses with Huber's weights, e_0 being the error of the first pose itself. The accelerometer is rotated with the true
    attitude (half a degree of drift would be a tenth of m/s²), carried through gaps by the gyro.
    """
    dt = np.diff(t_s)[:, None]
    rate, force, offset = samples[:, :3], samples[:, 3:], np.zeros(6)
    turned = quaternion.multiply(quaternion.inverse(q_wb_wxyz[:1]), q_wb_wxyz[1:])
    steps = quaternion.multiply(quaternion.inverse(q_wb_wxyz[:-1]), q_wb_wxyz[1:])
    known = trusted[:-1] & trusted[1:]
    of_poses = quaternion.log(steps[known]) / dt[known]
    coarse = np.median(_step_means(rate)[known] - of_poses, axis=0) if known.any() else np.zeros(3)
    if float(np.linalg.norm(coarse)) * float(t_s[-1] - t_s[0]) > MAX_TURN_RAD:
        offset[:3] = coarse
    for _ in range(ITERATIONS):
        running = _integrated(rate - offset[:3], dt)
        if alone is not None and alone.any():
            own = quaternion.exp(_step_means(rate - offset[:3]) * dt)
            turned = quaternion.unit(quaternion.running_product(np.where(alone[:-1, None], own, steps)))
        R = quaternion.matrix(running)
        error = quaternion.rotate(running, quaternion.log(quaternion.multiply(quaternion.inverse(running), turned)))
        offset[:3] -= _slope(error, np.cumsum(R * dt[..., None], axis=0), trusted[1:], mount_std * (R - np.eye(3)))
    R_wb = quaternion.matrix(_attitudes(t_s, rate - offset[:3], q_wb_wxyz, trusted))
    a_w = (R_wb @ force[..., None])[..., 0] + np.array(GRAVITY_W)
    dv = np.cumsum(_step_means(a_w) * dt, axis=0)
    by_force = np.cumsum(_step_means(R_wb) * dt[..., None], axis=0)
    offset[3:] = -_slope(v_w[1:] - v_w[0] - dv, by_force, trusted[1:], by_force[..., :0])
    return offset


def _step_means(u: Array) -> Array:
    """Means of each sample and the next: the value over the step between them (reason: `imutool.inertial.windows`)."""
    means: Array = 0.5 * (u[:-1] + u[1:])
    return means


def _integrated(rate: Vectors, dt: Float64[np.ndarray, "m 1"]) -> Float64[np.ndarray, "m 4"]:
    """Rotation from the first sample to each later one."""
    return quaternion.unit(quaternion.running_product(quaternion.exp(_step_means(rate) * dt)))


def _attitudes(
    t_s: Float64[np.ndarray, " n"], rate: Vectors, q_wb_wxyz: Quaternions, trusted: Bool[np.ndarray, " n"]
) -> Quaternions:
    """Integrated attitude, corrected by its error at trusted poses, interpolated in gaps."""
    q_hat_wxyz = np.concatenate([q_wb_wxyz[:1], quaternion.multiply(q_wb_wxyz[:1], _integrated(rate, np.diff(t_s)[:, None]))])
    error = quaternion.log(quaternion.multiply(quaternion.inverse(q_hat_wxyz), q_wb_wxyz))
    filled = [np.interp(t_s, t_s[trusted], error[trusted, axis]) for axis in range(3)]
    return quaternion.unit(quaternion.multiply(q_hat_wxyz, quaternion.exp(np.stack(filled, axis=1))))


def _slope(
    error: Vectors, by: Float64[np.ndarray, "n 3 3"], valid: Bool[np.ndarray, " n"], by_nuisance: Float64[np.ndarray, "n 3 k"]
) -> Float64[np.ndarray, "3"]:
    """b of error = e_0 + by b + by_nuisance z, by least squares with Huber's weights; z ~ N(0, 1)."""
    y = error[valid]
    X = np.concatenate([by[valid], np.broadcast_to(np.eye(3), (len(y), 3, 3)), by_nuisance[valid]], axis=2)
    k, weight, ridge = X.shape[2], np.ones(len(y)), np.zeros((X.shape[2],) * 2)
    for _ in range(ITERATIONS):
        weighted = (X * weight[:, None, None]).reshape(-1, k).T
        solution = np.linalg.lstsq(weighted @ X.reshape(-1, k) + ridge, weighted @ y.ravel(), rcond=None)[0]
        size = quaternion.length(y - X @ solution)
        middle = (len(size) - 1) // 2
        limit = max(HUBER_MEDIANS * float(np.partition(size, middle)[middle]), 1e-9)
        weight = limit / np.maximum(size, limit)
        ridge[range(6, k), range(6, k)] = SAME * limit**2
    slope: Float64[np.ndarray, "3"] = solution[:3]
    return slope
