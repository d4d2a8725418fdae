"""Aided path: the inertial filter over debiased samples and aids, forward and backward.

At the end of each of the filter's blocks (`imutool.inertial.inertial_filter`) an aid measures

    odometry   v_odometry = (1 + s) Exp(d) R_vb (R_wb^T v + (gyro - b_g) x l) + n      forward, and what else it measures
    ground     0 = the sideways and the vertical component of the same
    barometer  h = p_z + o + n

with the lever arm l from the IMU to the vehicle's point, the mount's error d and the scale factor s as constants, and the
barometer's offset o as a random walk; all are states. At `stops` velocity and rate are zero, and without odometry speed is
bounded between them. A value far from the expected one, as of a wheel that slips, gets less weight (Huber).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

import numpy as np
from msgspec import Meta

from imutool.array_types import Bool, Float64, Rows6
from imutool.bias.model import Vector6
from imutool.bias_start.bias_tracking import Aiding, BiasFilter, FilteredBlock, smooth_blocks
from imutool.bias_start.initial_bias import AT_REST_STD, MIN_STD, InitialBias, relative_samples
from imutool.bias_start.prior_width import BiasPrior
from imutool.config import Settings
from imutool.geometry import quaternion
from imutool.inertial.aids import GROUND, STOPS, Aids
from imutool.inertial.inertial_filter import HUBER, POSITION, SIZE, TURN, VELOCITY, FilterSettings, State, update
from imutool.inertial.preintegration import exp, hat
from imutool.inertial.stationary import CALM, white_noise
from imutool.inertial.strapdown import StartPose, dead_reckon
from imutool.recording import Imu, Poses, seconds

START_STD = np.array([1e-3] * 3 + [1e-2] * 3 + [1e-3] * 3)  # rad, m/s, m: of the start pose
HEIGHT, LEVER, MOUNT, SCALE = slice(0, 1), slice(1, 4), slice(4, 7), slice(7, 8)  # of the offsets
OFFSETS = 8
RAW_STD = (0.1, 0.1, 0.1, 0.5, 0.5, 0.5)  # rad/s and m/s²: biases of a consumer sensor nobody calibrated
UNBOUNDED_M_S = 1e3  # a bound on speed that says nothing

Positive = Annotated[float, Meta(gt=0)]


class AidSettings(Settings, frozen=True, kw_only=True):
    """Noise of aids at the end of a block, and widths of what they leave open.

    Orders of magnitude of MEMS barometers and of wheels on a hard floor; not tuned on any recording.
    """

    odometry_m_s: Positive = 0.05
    odometry_share: Positive = 0.02  # of the speed
    ground_m_s: Positive = 0.05
    lever_m: Positive = 0.5
    mount_rad: Positive = 0.03  # least error of a mount that the log shows
    levelled_rad: Positive = 0.1  # of an IMU whose x is taken for forward
    scale: Positive = 0.03
    height_m: Positive = 0.1  # without the barometer's own white noise
    height_walk_m: Positive = 0.05  # per second^1/2
    height_window_s: Positive = 0.5
    rate_window_s: Positive = 0.1


def residual_prior(start: InitialBias | None = None, std: Rows6 | None = None) -> BiasPrior:
    """Prior of the bias that is left after a model.

    It is as wide as the start states, or less where `std`, the deviation of the subtracted bias, became smaller.
    """
    median = np.array(RAW_STD) if std is None else np.median(std, axis=0)
    minimum = median if start is None else np.minimum(start.std, median)
    return BiasPrior(np.zeros(6), np.maximum(minimum, MIN_STD), AT_REST_STD)


def aided_path(imu: Imu, start: StartPose, prior: BiasPrior, aids: Aids) -> Poses:
    """Smoothed trajectory at the IMU's stamps from `start` at the first.

    `imu` is debiased; `prior` is that of the residual bias. Between the filter's blocks of half a second, and in a recording
    shorter than a block, samples are integrated as in pure integration. Over a gap the pose stays, less certain.

    Raises:
        DataError: no samples.
        NumericsError: the numbers overflow.
    """
    s = AidSettings()
    t_s = relative_samples(imu)[0]
    measure = _Measurements(imu, t_s, aids, s)
    walk = np.zeros(OFFSETS)
    walk[HEIGHT] = s.height_walk_m
    bounded = STOPS in aids.signals and aids.odometry is None
    speed = FilterSettings() if bounded else FilterSettings(speed_m_s=UNBOUNDED_M_S)
    filter_ = BiasFilter(prior, speed, ahead=True, aiding=Aiding(measure, STOPS in aids.signals, walk))
    filter_.state = _state(start, prior, measure.std, speed)
    pieces, first, state = [], 0, filter_.state
    for end_s, resting, over, after in _estimates(filter_, imu, t_s):
        last = int(np.searchsorted(t_s, end_s))
        pieces.append(_between(imu.rows(slice(first, last + 1)), over, resting).rows(slice(0, last - first)))
        first, state = last, after
    pieces.append(_between(imu.rows(slice(first, len(imu))), state, False))
    p_wb, q_wb_wxyz, v_w = (np.concatenate([getattr(piece, n) for piece in pieces]) for n in ("p_wb", "q_wb_wxyz", "v_w"))
    return Poses(imu.t_ns, p_wb + start.p_wb, q_wb_wxyz, v_w)


class _Measurements:
    """What the aids measure at each sample, and the filter's update by it; positions count from the start."""

    def __init__(self, imu: Imu, t_s: Float64[np.ndarray, " n"], aids: Aids, s: AidSettings) -> None:
        self._t_s, self._s = t_s, s
        self._ground = GROUND in aids.signals
        self._rate = _window_mean(t_s, imu.gyro, t_s, s.rate_window_s)[0]
        mount_rad = s.levelled_rad
        self._R_vb = _levelled(imu) if self._ground and aids.odometry is None else np.eye(3)
        self._v, self._known = np.zeros((len(imu), 3)), np.zeros(len(imu), bool)
        self._measured = np.zeros(3, bool)
        if aids.odometry is not None:
            at, self._known = aids.odometry.poses.at(imu.t_ns)
            self._R_vb, mount_rad = aids.odometry.R_vb, max(aids.odometry.std_rad, s.mount_rad)
            assert at.v_w is not None
            self._v = quaternion.rotate(quaternion.inverse(at.q_wb_wxyz), at.v_w)
            self._measured = np.abs(self._v[self._known]).max(axis=0, initial=0.0) > s.odometry_m_s
            self._measured[0] = True
        self._height, self._height_std = np.zeros(len(imu)), np.full(len(imu), np.inf)
        if aids.height is not None:
            given = aids.height
            mean, count = _window_mean(seconds(given.t_ns, int(imu.t_ns[0])), given.values, t_s, s.height_window_s)
            noise = CALM * float(white_noise(given.values)[0])
            self._height = mean[:, 0]
            self._height_std = np.where(count > 0, np.sqrt(s.height_m**2 + noise**2 / np.maximum(count, 1)), np.inf)
        self.std = np.concatenate([[1.0], np.full(3, s.lever_m), np.full(3, mount_rad), [s.scale]])

    def __call__(self, x: State, t_s: float) -> State:
        row = min(int(np.searchsorted(self._t_s, t_s)), len(self._t_s) - 1)
        return self._by_height(self._by_velocity(x, row), row)

    def _by_velocity(self, x: State, row: int) -> State:
        use = (self._measured & self._known[row]) | (self._constrained() & self._ground)
        if not use.any():
            return x
        scale, rate = 1.0 + float(x.offsets[SCALE][0]), self._rate[row] - x.bias[:3]
        R = scale * exp(x.offsets[MOUNT]) @ self._R_vb
        v = R @ (x.R_wb.T @ x.v_w + np.cross(rate, x.offsets[LEVER]))
        H = np.zeros((3, SIZE + OFFSETS))
        H[:, VELOCITY] = R @ x.R_wb.T
        H[:, SIZE + LEVER.start : SIZE + LEVER.stop] = R @ hat(rate)
        H[:, SIZE + MOUNT.start : SIZE + MOUNT.stop] = -hat(v)
        H[:, SIZE + SCALE.start] = v / scale
        wheels = np.hypot(self._s.odometry_m_s, self._s.odometry_share * np.linalg.norm(self._v[row]))
        std = np.where(self._measured, wheels, self._s.ground_m_s)
        return _robust(x, H[use], (v - np.where(self._measured, self._v[row], 0.0))[use], std[use])

    def _constrained(self) -> Bool[np.ndarray, "3"]:
        """Components that contact with the ground makes zero: sideways and vertical, where wheels measure none."""
        return np.array([False, True, True]) & ~self._measured

    def _by_height(self, x: State, row: int) -> State:
        if not np.isfinite(self._height_std[row]):
            return x
        H = np.zeros((1, SIZE + OFFSETS))
        H[0, TURN], H[0, POSITION], H[0, SIZE] = -hat(x.p_wb)[2], [0.0, 0.0, 1.0], 1.0
        return _robust(x, H, x.p_wb[2:] + x.offsets[HEIGHT] - self._height[row], self._height_std[row : row + 1])


def _robust(x: State, H: Float64[np.ndarray, "k m"], z: Float64[np.ndarray, " k"], std: Float64[np.ndarray, " k"]) -> State:
    """Kalman update with less weight on values far from the expected ones."""
    size = np.abs(z) / np.sqrt(np.einsum("ki,ij,kj->k", H, x.P, H) + std**2)
    return update(x, H, z, (std * np.maximum(1.0, size / HUBER)) ** 2)


def _window_mean(
    t_s: Float64[np.ndarray, " n"], values: Float64[np.ndarray, "n k"], at_s: Float64[np.ndarray, " m"], window_s: float
) -> tuple[Float64[np.ndarray, "m k"], Float64[np.ndarray, " m"]]:
    """Mean of the values in a window about each time, and their number; zeros where there is none."""
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values - values[:1], axis=0)])
    first, last = np.searchsorted(t_s, at_s - 0.5 * window_s), np.searchsorted(t_s, at_s + 0.5 * window_s, side="right")
    count = (last - first).astype(np.float64)
    mean = (sums[last] - sums[first]) / np.maximum(count, 1.0)[:, None] + values[:1]
    return np.where(count[:, None] > 0, mean, 0.0), count


def _levelled(imu: Imu) -> Float64[np.ndarray, "3 3"]:
    """Smallest turn that makes the IMU level, by its mean specific force."""
    from scipy.spatial.transform import Rotation

    turn, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [imu.accel.mean(axis=0)])
    return np.asarray(turn.as_matrix())


def _estimates(filter_: BiasFilter, imu: Imu, t_s: Float64[np.ndarray, " n"]) -> Iterator[tuple[float, bool, State, State]]:
    """End of each block, whether it is at rest, and the smoothed estimates at its start and end."""

    def blocks() -> Iterator[FilteredBlock]:
        yield from filter_.feed(t_s, imu.gyro, imu.accel)
        yield from filter_.finish()

    previous: tuple[FilteredBlock, State] | None = None
    for block, state in smooth_blocks(blocks()):
        if previous is not None:
            yield previous[0].end_s, previous[0].resting, previous[1], state
        previous = block, state
    if previous is not None:  # the last block has no later estimate
        yield previous[0].end_s, previous[0].resting, previous[1], previous[0].step.after


def _state(start: StartPose, prior: BiasPrior, offsets_std: Float64[np.ndarray, " _"], s: FilterSettings) -> State:
    (R_wb,) = quaternion.matrix(quaternion.unit(start.q_wb_wxyz[None]))
    steady_std = np.repeat([s.pivot_m, s.speed_m_s], 3)
    P = np.diag(np.concatenate([START_STD, prior.std, prior.ground_std, steady_std, offsets_std]) ** 2)
    return State(R_wb, start.v_w.copy(), np.zeros(3), prior.mean.copy(), np.zeros(6), np.zeros(6), P, np.zeros(OFFSETS))


def _between(imu: Imu, state: State, resting: bool) -> Poses:
    """Pure integration over a block, with the filter's bias at its start."""
    bias: Vector6 = state.rest_bias(resting)
    from scipy.spatial.transform import Rotation

    q_wb_wxyz = Rotation.from_matrix(state.R_wb).as_quat(scalar_first=True)
    return dead_reckon(Imu(imu.t_ns, imu.gyro - bias[:3], imu.accel - bias[3:]), (q_wb_wxyz, state.p_wb, state.v_w))
