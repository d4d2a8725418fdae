"""Fit of a simulated IMU to its poses: gravity, frame, axes, transport term, point, timing.

The samples are compared with the motion of the simulation's own poses. First the frame (body or world) and the axes (48 signed
permutations P) of each sensor are chosen by least squares. Then the parts of the specific force are weighed, m and k and c
being 1, 1 and 0 in a right simulation. A gyro may also hold the rates of roll, pitch and yaw::

    accel = P (m R^T a_w - k R^T g_w - c omega x v + alpha x r + omega x (omega x r) - tau_a R^T j_w + tau_f omega x f) + b
    gyro = P (omega - tau_g alpha) + b

tau_a delays the acceleration alone (a difference of velocities), tau_f the attitude in which it is given. Samples and parts are
compared in the band that the smoothed poses show: what contacts shake above it would be taken for a part that is like it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from imutool.array_types import Float64, Rows6, Vectors
from imutool.diagnosis.audit.axes import Hypotheses, Matrix
from imutool.diagnosis.result import Estimate
from imutool.errors import DataError
from imutool.inertial.kinematics import G_W
from imutool.recording import Recording
from imutool.sensor.trajectory import smooth_motion
from imutool.units import SENSORS, Sensor

JERK_S = 1e-3  # half of the step of a central difference
BLOCK_S = 2.0  # of the robust covariance
SHOWN, ORDER = 0.5, 4  # of a curve's cut-off, up to which it follows a motion to 2 %; of the filter
MIN_BLOCK = 4.0  # periods of the highest frequency in a block, so that blocks are independent
BANDS = (1.0, 0.5, 0.25)  # of the band that the poses show: a curve follows the slower motion better
MAX_ALIKE = 0.98  # correlation of neighbouring blocks
AGREE = 3.0  # standard deviations by which two bands may differ
RIDGE = 1e-6  # of biases and misalignment: a body that stays level shows them and gravity alike, and gravity is the larger
SMALL = 0.01  # rad, or a share: deviation of misalignment and scales before they are fitted
MAX_SMALL = 0.06  # rad, or a share, that is a sensor's error: more is none of a right one
MIN_COSINE = 1e-3  # of the pitch, towards which rates of roll and yaw grow without bound
MIN_S = 5.0
OTHER_UNIT: Mapping[Sensor, float] = {"gyro": np.pi / 180.0, "accel": 9.80665}  # deg/s, standard gravity
MISALIGNMENT = np.array(  # and scales of the axes: the 8 matrices of which none changes all scales alike
    [*(np.outer(a, b) for a, b in permutations(np.eye(3), 2)), np.diag([1.0, -1.0, 0.0]), np.diag([1.0, 1.0, -2.0])]
)
UNIT_OF = {**dict.fromkeys("mkc", "-"), **dict.fromkeys("xyz", "m"), "tau_a": "s", "tau_f": "s"}


@dataclass(frozen=True, eq=False)
class Kinematics:
    """Samples of a log and the motion of its poses, one row each; world vectors end in _w."""

    t_s: Float64[np.ndarray, " n"]
    gyro: Vectors
    accel: Vectors
    R_wb: Float64[np.ndarray, "n 3 3"]
    omega: Vectors
    alpha: Vectors
    v_w: Vectors
    a_w: Vectors
    j_w: Vectors
    period_s: float
    band_hz: float

    def to_body(self, x_w: Vectors) -> Vectors:
        """World vectors in the body frame."""
        return np.asarray(np.einsum("nji,nj->ni", self.R_wb, x_w))

    def rates(self) -> dict[str, Vectors]:
        """Angular rate in the body, in the world, and as rates of roll, pitch and yaw (R_wb = Rz Ry Rx)."""
        (p, q, r), (s, sin_roll, cos_roll) = self.omega.T, self.R_wb[:, 2].T  # both times the cosine of the pitch, -s its sine
        level = np.maximum(np.hypot(sin_roll, cos_roll), MIN_COSINE)
        yaw = (q * sin_roll + r * cos_roll) / level**2
        euler = np.stack([p - s * yaw, (q * cos_roll - r * sin_roll) / level, yaw], axis=1)
        return {"body": self.omega, "world": np.einsum("nij,nj->ni", self.R_wb, self.omega), "euler": euler}

    def shown(self, x: Float64[np.ndarray, "n ..."]) -> Float64[np.ndarray, "n ..."]:
        """Columns in the band of the motion that the poses show, without delay."""
        share = 2.0 * self.band_hz * self.period_s  # of Nyquist
        return x if share >= 1.0 else np.asarray(sosfiltfilt(butter(ORDER, share, output="sos"), x, axis=0))


@dataclass(frozen=True, eq=False)
class KinematicFit:
    """Fitted model of both sensors: estimates, frames, axes and residual (gyro, accel)."""

    estimates: dict[str, Estimate]
    frames: tuple[str, str]
    axes: tuple[Matrix, Matrix]
    residual: Rows6


def kinematics(log: Recording) -> Kinematics:
    """Samples within all stretches of a log's poses.

    Raises:
        DataError: less than five seconds of poses that can be differentiated.
    """
    motion, imu, step_ns = smooth_motion(log.truth), log.imu, round(JERK_S * 1e9)
    since_s = (imu.t_ns - motion.start_ns) * 1e-9
    used, parts = np.zeros(len(imu), bool), list[list[Vectors]]()
    for stretch in motion.stretches:
        rows = (since_s > stretch.start_s + JERK_S) & (since_s < stretch.end_s - JERK_S)
        if rows.any():
            at, before, after = (stretch.trajectory.at(imu.t_ns[rows] + shift) for shift in (0, -step_ns, step_ns))
            R_wb = Rotation.from_quat(at.q_wb_wxyz, scalar_first=True).as_matrix()
            j_w = (after.a_w - before.a_w) / (2.0 * JERK_S)
            parts.append([R_wb, at.omega_b, at.alpha_b, at.v_w, at.a_w, j_w])
            used |= rows
    if used.sum() < MIN_S / imu.period_s:
        raise DataError(
            "its poses cover too little", where=log.name, expected=f"{MIN_S:g} s of poses without a hole or an impact"
        )
    t_s = np.asarray((imu.t_ns[used] - imu.t_ns[used][0]) * 1e-9, dtype=np.float64)
    R_wb, omega, alpha, v_w, a_w, j_w = (np.concatenate(each) for each in zip(*parts, strict=True))
    longest = max(motion.stretches, key=lambda stretch: stretch.duration_s)
    band_hz = max(SHOWN * min(longest.cutoff_hz), MIN_BLOCK / BLOCK_S)
    return Kinematics(
        t_s, imu.gyro[used], imu.accel[used], R_wb, omega, alpha, v_w, a_w, j_w, period_s=imu.period_s, band_hz=band_hz
    )


def kinematic_fit(k: Kinematics) -> KinematicFit:
    """Frames, axes and parts of the samples that explain them best."""
    parts = _force_parts(k)
    rates = k.rates()
    gyro_frame, P_gyro = _of_gyro(k).frame(k.shown(k.gyro))
    accel_frame, P_accel = _of_accel(k, parts).frame(k.shown(k.accel))
    force = k.to_body(k.a_w - G_W)
    arms = np.stack([np.cross(k.alpha, e) + np.cross(k.omega, np.cross(k.omega, e)) for e in np.eye(3)], axis=2)
    late = np.stack([-k.to_body(k.j_w), np.cross(k.omega, force)], axis=2)
    columns = np.concatenate([parts, arms, late], axis=2)
    if accel_frame == "world":  # there neither gravity nor the transport term nor the attitude is anything of its own
        columns = np.einsum("nij,njp->nip", k.R_wb, columns)
        columns[:, :, [2, 7]] = 0.0
        force = np.einsum("nij,nj->ni", k.R_wb, force)
    small = np.einsum("nj,qij->niq", force, MISALIGNMENT)
    theta, std, left_accel = _solved(k, k.accel @ P_accel, columns, np.array([1.0, 1.0] + [0.0] * 6), small)
    estimates = {name: Estimate(float(a), float(s), UNIT_OF[name]) for name, a, s in zip(UNIT_OF, theta, std, strict=True)}
    slope = k.alpha if gyro_frame == "body" else np.gradient(rates[gyro_frame], k.t_s, axis=0)
    columns = np.stack([rates[gyro_frame], -slope], axis=2)
    theta, std, left_gyro = _solved(k, k.gyro @ P_gyro, columns, np.array([1.0, 0.0]), columns[:, :, :0])
    of_gyro = zip(("scale", "tau_g"), ("-", "s"), theta, std, strict=True)
    estimates |= {name: Estimate(float(a), float(s), unit) for name, unit, a, s in of_gyro}
    residual = np.concatenate([left_gyro, left_accel], axis=1)
    return KinematicFit(estimates, (gyro_frame, accel_frame), (P_gyro, P_accel), residual)


def units(k: Kinematics) -> dict[Sensor, float]:
    """Factor of each sensor's samples: 1, or what makes rad/s of deg/s and m/s² of g."""
    samples, columns = {"gyro": k.gyro, "accel": k.accel}, {"gyro": _of_gyro(k), "accel": _of_accel(k, _force_parts(k))}
    return {sensor: columns[sensor].unit(k.shown(samples[sensor]), OTHER_UNIT[sensor]) for sensor in SENSORS}


def _force_parts(k: Kinematics) -> Float64[np.ndarray, "n 3 3"]:
    """Acceleration, gravity and the transport term, in the body frame."""
    gravity, centripetal = k.to_body(np.tile(-np.asarray(G_W), (len(k.t_s), 1))), -np.cross(k.omega, k.to_body(k.v_w))
    return np.stack([k.to_body(k.a_w), gravity, centripetal], axis=2)


def _of_gyro(k: Kinematics) -> Hypotheses:
    return Hypotheses({frame: k.shown(rate[:, :, None]) for frame, rate in k.rates().items()}, free_bias=True, turns=True)


def _of_accel(k: Kinematics, parts: Float64[np.ndarray, "n 3 p"]) -> Hypotheses:
    frames = {"body": parts, "world": np.einsum("nij,njp->nip", k.R_wb, parts)}
    return Hypotheses({frame: k.shown(x) for frame, x in frames.items()}, free_bias=False, turns=True)


def _solved(
    k: Kinematics,
    y: Vectors,
    x: Float64[np.ndarray, "n 3 p"],
    ideal: Float64[np.ndarray, " p"],
    small: Float64[np.ndarray, "n 3 q"],
) -> tuple[Float64[np.ndarray, " p"], Float64[np.ndarray, " p"], Vectors]:
    """Coefficients with deviations, and what they and the biases leave; `small` errors of the sensor are fitted, too.

    A part is the same at every frequency. What smoothing takes of a motion grows at least with the square of its frequency, and
    looks like a part. So where slower bands contradict the whole one (Hausman's test), the difference tells this error of each
    band, and the band with the least deviation of both kinds is taken.
    """
    p = x.shape[2]
    whole, target = np.concatenate([x, np.tile(np.eye(3), (len(y), 1, 1)), small], axis=2), y - x @ ideal
    bands = sorted({max(share * k.band_hz, MIN_BLOCK / BLOCK_S) for share in BANDS}, reverse=True)
    each = [_in_band(replace(k, band_hz=band_hz), target, whole, p) for band_hz in bands]
    theta, std = (np.array(values) for values in zip(*each, strict=True))
    square = (np.array(bands)[:, None] / bands[0]) ** 2
    with np.errstate(invalid="ignore"):  # of parts that the motion does not show, whose deviation is infinite
        by_chance = AGREE * np.sqrt(np.maximum(std**2 - std[0] ** 2, 0.0))
    change = np.abs(theta - theta[0])
    stated = np.max(np.where(change > by_chance, change, 0.0)[1:] / (1.0 - square[1:]), axis=0, initial=0.0)
    # in no slower band more of it is gone than this one tells: a band that is nearly empty may tell anything
    error = np.minimum(stated, np.min((change + AGREE * std)[1:] / (1.0 - square[1:]), axis=0, initial=np.inf))
    total = np.hypot(std, square * error)
    best = total.argmin(axis=0), np.arange(len(total[0]))
    taken = np.concatenate([theta[0, : p + 3], np.clip(theta[0, p + 3 :], -MAX_SMALL, MAX_SMALL)])
    return ideal + theta[best][:p], total[best][:p], np.asarray(target - whole @ taken)


def _in_band(
    k: Kinematics, y: Vectors, x: Float64[np.ndarray, "n 3 q"], p: int
) -> tuple[Float64[np.ndarray, " q"], Float64[np.ndarray, " q"]]:
    """Coefficients with deviations by blocks of two seconds; Huber weights against shocks. From p on they are small."""
    A, target = k.shown(x), k.shown(y)
    size = np.sqrt((A**2).sum(axis=(0, 1)))
    size[size < 1e-9 * size.max()] = np.inf
    A = A / size
    weight, q = np.ones(len(y)), x.shape[2]
    ridge = np.diag([1e-9] * p + [RIDGE] * (q - p))
    small, alike = np.arange(p + 3, q), max(0.5 / (k.band_hz * k.period_s), 1.0)  # samples, of which one is independent
    for _ in range(3):
        H = (A * weight[:, None, None]).reshape(-1, q).T @ A.reshape(-1, q) + ridge
        theta = np.linalg.solve(H, np.einsum("n,nap,na->p", weight, A, target))
        residual = target - A @ theta
        length = np.sqrt((residual**2).sum(axis=1))
        weight = 1.0 / np.maximum(1.0, length / max(3.0 * float(np.median(length)), 1e-12))
        variance = alike * float((weight * length**2).sum()) / (3.0 * float(weight.sum()))
        ridge[small, small] = RIDGE + variance / (SMALL * size[small]) ** 2
    half = np.linalg.solve(H, by_block(k, np.einsum("n,nap,na->np", weight, A, residual)).T)
    std = of_sum(half) / size
    std[~np.isfinite(size)] = np.inf
    return theta / size, std


def by_block(k: Kinematics, x: Float64[np.ndarray, "n p"]) -> Float64[np.ndarray, "b p"]:
    """Sums over blocks of two seconds."""
    block = np.floor(k.t_s / BLOCK_S).astype(int)
    sums = np.zeros((int(block.max()) + 1, x.shape[1]))
    np.add.at(sums, block, x)
    return sums


def of_sum(blocks: Float64[np.ndarray, "p b"]) -> Float64[np.ndarray, " p"]:
    """Deviation of a sum over blocks, which as in a first-order autoregression may be alike."""
    square, n = (blocks**2).sum(axis=1), blocks.shape[1]
    alike = np.clip((blocks[:, 1:] * blocks[:, :-1]).sum(axis=1) / np.maximum(square, 1e-300), 0.0, MAX_ALIKE)
    return np.asarray(np.sqrt(square * (1.0 + alike) / (1.0 - alike) * n / max(n - 2, 1)))
