"""Kinematics of a trajectory.

Angular rate, angular acceleration and specific force, as of an ideal IMU.

The trajectory is a pair of splines, one for the position, one for the quaternion. The quaternion spline need not stay
on the unit sphere: any positive multiple of a unit quaternion is the same rotation. So four free coordinates have no
singularity, whatever the angles, and every derivative has a closed form.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from imutool.array_types import Float, Float64, Vectors
from imutool.errors import DataError, NumericsError
from imutool.geometry import quaternion
from imutool.recording import GRAVITY_M_S2, Imu, Poses, Times, seconds

DEGREE = 5  # continuous angular acceleration needs 3; 5 also keeps its slope and the jerk continuous
SMALLEST_NORM = 0.1  # a quaternion spline of smaller norm has knots too far apart
G_W = np.array([0.0, 0.0, -GRAVITY_M_S2])
G_W.flags.writeable = False
LEVEL = 0.01  # of gravity, by which the mean force of a body in a room may differ from it
GRAVITIES_M_S2 = (GRAVITY_M_S2, 9.80665, 9.8)  # of simulators, which know no other

Spline = Any  # a BSpline: scipy.interpolate is imported where one is made, for its import takes 0.2 s


def lever_acceleration(omega: Any, alpha: Any, arms: Any) -> tuple[Any, Any, Any]:
    """Lever-arm acceleration alpha x r + omega x (omega x r) of a rigid body at r (m/s²).

    It comes back by axis.

    Component i is that of the point `arms[i]`, because the axes of an accelerometer may be at different points. omega and alpha
    are three floats or three columns each; written out, because for floats numpy costs several times the arithmetic.
    """
    (wx, wy, wz), (ax, ay, az) = omega, alpha
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = arms
    wx_wx, wy_wy, wz_wz = wx * wx, wy * wy, wz * wz
    return (
        ay * xz - az * xy + wx * (wy * xy + wz * xz) - (wy_wy + wz_wz) * xx,
        az * yx - ax * yz + wy * (wz * yz + wx * yx) - (wz_wz + wx_wx) * yy,
        ax * zy - ay * zx + wz * (wx * zx + wy * zy) - (wx_wx + wy_wy) * zz,
    )


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion at some instants: poses and derivatives; the suffix names the frame, world or body."""

    p_wb: Vectors
    q_wb_wxyz: Float64[np.ndarray, "n 4"]
    v_w: Vectors
    a_w: Vectors
    omega_b: Vectors
    alpha_b: Vectors

    def specific_force(self, r_b: Float[np.ndarray, "3"] | None = None, g_w: Float[np.ndarray, "3"] = G_W) -> Vectors:
        """Specific force at `r_b` in the body frame (m/s²): R_wb^T (a_w - g_w); at rest +g up."""
        force = self._rotation().apply(self.a_w - g_w, inverse=True)
        if r_b is not None:
            force = force + np.stack(lever_acceleration(self.omega_b.T, self.alpha_b.T, (r_b, r_b, r_b)), axis=1)
        return np.asarray(force)

    def _rotation(self) -> Any:
        from scipy.spatial.transform import Rotation

        return Rotation.from_quat(self.q_wb_wxyz, scalar_first=True)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Smooth trajectory: splines of position (m) and of a multiple of `q_wb_wxyz`.

    Time is in seconds since `start_ns`.
    """

    start_ns: int
    position: Spline
    quaternion: Spline

    def at(self, t_ns: Times) -> Motion:
        """Motion at some instants.

        With Q the spline and n = |Q|², the derivative of R(Q) is omega_b = 2 Im(Q* Q') / n, and the second one
        alpha_b = 2 Im(Q* Q'') / n - omega_b n' / n, because Im(Q'* Q') is zero.

        Raises:
            NumericsError: an instant outside the splines, or a quaternion too near zero for a rotation.
        """
        t = seconds(t_ns, self.start_ns)
        self._inside(t)
        q, dq, ddq = (np.asarray(self.quaternion(t, order), dtype=np.float64) for order in range(3))
        p, v, a = (np.asarray(self.position(t, order), dtype=np.float64) for order in range(3))
        n = np.sum(q * q, axis=1, keepdims=True)
        if len(n) and n.min() < SMALLEST_NORM**2:
            raise NumericsError(
                f"the quaternion spline shrinks to {float(np.sqrt(n.min())):.2g} at {t[int(np.argmin(n))]:.3f} s",
                expected=f"a norm above {SMALLEST_NORM}",
                fix="Put its knots closer together",
            )
        omega_b = 2.0 * _conjugate_product(q, dq) / n
        alpha_b = 2.0 * _conjugate_product(q, ddq) / n - omega_b * (2.0 * np.sum(q * dq, axis=1, keepdims=True) / n)
        return Motion(p, q / np.sqrt(n), v, a, omega_b, alpha_b)

    def poses(self, t_ns: Times) -> Poses:
        """Poses and velocities at some instants.

        Raises:
            NumericsError: as `at`.
        """
        motion = self.at(t_ns)
        return Poses(t_ns, motion.p_wb, motion.q_wb_wxyz, motion.v_w)

    def imu(self, t_ns: Times, r_b: Float[np.ndarray, "3"] | None = None, g_w: Float[np.ndarray, "3"] = G_W) -> Imu:
        """Samples of an ideal IMU at `r_b`: no bias, no noise, no filter.

        Raises:
            NumericsError: as `at`.
        """
        motion = self.at(t_ns)
        return Imu(t_ns, motion.omega_b, motion.specific_force(r_b, g_w))

    def _inside(self, t: Float64[np.ndarray, " n"]) -> None:
        for spline in (self.position, self.quaternion):
            first, last = float(spline.t[spline.k]), float(spline.t[-spline.k - 1])
            outside = (t < first - 1e-9) | (t > last + 1e-9)  # a nanosecond: the clock's own resolution
            if outside.any():
                raise NumericsError(
                    f"{t[int(np.argmax(outside))]:.9f} s is outside the trajectory", expected=f"{first:g} to {last:g} s"
                )


def fit_trajectory(poses: Poses) -> Trajectory:
    """Spline trajectory through every true pose, with time from the first pose.

    The noise of the second derivative is that of the poses times 1/dt².

    Raises:
        DataError: too few poses.
    """
    from scipy.interpolate import make_interp_spline

    if len(poses) <= DEGREE:
        raise DataError(f"{len(poses)} true poses", expected=f"more than {DEGREE} for a spline of degree {DEGREE}")
    t = seconds(poses.t_ns, int(poses.t_ns[0]))
    position, quaternion = (make_interp_spline(t, y, k=DEGREE) for y in (poses.p_wb, continuous(poses.q_wb_wxyz)))
    return Trajectory(int(poses.t_ns[0]), position, quaternion)


def attitude_by_gyro(
    t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3 3"] | None:
    """R_wb of samples without noise, level by their mean specific force; heading zero at first.

    A body that stays in a room accelerates by nothing on average. None unless both halves show one gravity of the Earth's size.
    """
    from scipy.spatial.transform import Rotation

    turns = quaternion.exp(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(t_s)[:, None])
    R_0b = quaternion.matrix(quaternion.unit(quaternion.running_product(np.concatenate([[[1.0, 0.0, 0.0, 0.0]], turns]))))
    force = np.einsum("nij,nj->ni", R_0b, accel)
    ups, up = [half.mean(axis=0) for half in np.array_split(force, 2)], force.mean(axis=0)
    size = float(np.linalg.norm(up))
    if abs(size - GRAVITY_M_S2) > LEVEL * GRAVITY_M_S2 or np.linalg.norm(ups[1] - ups[0]) > LEVEL * GRAVITY_M_S2:
        return None
    level, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])
    return np.asarray(level.as_matrix() @ R_0b)


def gravity_error(R_wb: Float64[np.ndarray, "n 3 3"], y: Vectors, minimum: float) -> Float64[np.ndarray, "3"]:
    """By how much a simulator's own gravity differs from the usual one (m/s², world frame).

    `y` is what its accelerometer reads beyond its motion, with a constant of the body. If another gravity gains fewer than
    `minimum` squares of noise, it is the nearest of those that simulators have.
    """
    R_wb, y = (x[:: len(y) // 20_000 + 1] for x in (R_wb, y))
    columns = np.concatenate([R_wb.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R_wb.shape)], axis=2)
    found = np.asarray(np.linalg.lstsq(columns.reshape(-1, 6), y.ravel(), rcond=1e-6)[0])
    without, remaining = y.var(axis=0).mean(), np.square(y - columns @ found).mean()
    if (without - remaining) * y.size > minimum * remaining:
        return found[:3]
    return np.array([0.0, 0.0, min((g - GRAVITY_M_S2 for g in GRAVITIES_M_S2), key=lambda more: abs(more - found[2]))])


def _conjugate_product(a: Float64[np.ndarray, "n 4"], b: Float64[np.ndarray, "n 4"]) -> Vectors:
    """Im(a* b) of wxyz quaternions."""
    a_w, a_v, b_w, b_v = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    imaginary: Vectors = a_w * b_v - b_w * a_v - np.cross(a_v, b_v)
    return imaginary


def continuous(q_wxyz: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
    """Quaternions with signs such that neighbours are in one hemisphere.

    q and -q are one rotation.
    """
    flips = np.where(np.sum(q_wxyz[1:] * q_wxyz[:-1], axis=1) < 0.0, -1.0, 1.0)
    signed: Float64[np.ndarray, "n 4"] = q_wxyz * np.concatenate([[1.0], np.cumprod(flips)])[:, None]
    return signed


def trapezoidal(imu: Imu) -> Imu:
    """Samples whose Euler steps are those of the trapezoidal rule of the given ones.

    The Euler rule, by which the paths are integrated, lags by half a sample, as if the poses were early.
    """
    gyro, accel = (np.concatenate([0.5 * (u[1:] + u[:-1]), u[-1:]]) for u in (imu.gyro, imu.accel))
    for column in (gyro, accel):  # so that the samples need no copy
        column.flags.writeable = False
    return Imu(imu.t_ns, gyro, accel)
