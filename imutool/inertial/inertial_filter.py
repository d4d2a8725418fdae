"""Invariant Kalman filter of pose, velocity and biases from the samples of one IMU.

Errors are right-invariant on SE_2(3), augmented by the biases (Barrau and Bonnabel, "The invariant extended Kalman filter
as a stable observer", TAC 2017; the "imperfect" filter with biases: Hartley et al., IJRR 2020, section 5)::

    (R^, v^, p^) = Exp(xi_R, xi_v, xi_p) (R, v, p)        zeta = b^ - b
    d xi_R/dt = -R zeta_g        d xi_v/dt = g x xi_R - [v]x R zeta_g - R zeta_a        d xi_p/dt = xi_v - [p]x R zeta_g

Without biases the Jacobians do not depend on the estimate, and "the body does not move" observes only xi_v, by a constant
matrix: the filter cannot become certain of an unobservable heading. Heading starts at zero with zero variance, which only
names the horizontal axes: the equations do not depend on it.

The bias in motion is b; at rest on the ground it is b + d. The two differ (motors; on EuRoC by 1e-3 rad/s); d is unknown and
constant for the run. Measurements: at rest, velocity and rate are zero; in motion, velocity is bounded. An arm that swings, or
a drone that leans into its turns, turns about a pivot r off the sensor, and a vehicle drives where it points, with c::

    v + R (omega x r) - R c ~ N(0, speed²)        with correlation time `speed_correlation_s`

r and c are constants of the body, unknown, and states. Without them the velocity of a swinging arm, which follows the rate,
looks like an error of the gyro. Over tens of seconds the bound makes tilt observable through gravity, and with it the bias
across gravity. For a body at several times `speed_m_s` the measurement gets less weight (Huber).

Settings: about two dozen variants were compared on the training sequences, one changed at a time, with models trained on the
test sequences. `tests/bench/starts.py` measures the result on the same sequences, so it is slightly optimistic.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta

from imutool.array_types import Float64
from imutool.config import Settings
from imutool.inertial.kinematics import G_W
from imutool.inertial.preintegration import EYE, SMALL_RAD2, Increment, Matrix3, Vector3, exp_and_jacobian, hat, log, matvec
from imutool.recording import GRAVITY_M_S2

TURN, VELOCITY, POSITION = slice(0, 3), slice(3, 6), slice(6, 9)
POSE, BIAS, GROUND, STEADY = slice(0, 9), slice(9, 15), slice(15, 21), slice(21, 27)
SIZE = 27
HAT_G, ONES = hat(G_W), np.ones(3)
STOPPED = np.zeros((3, SIZE))  # rows of d(velocity)/d(error)
STOPPED[:, VELOCITY] = np.eye(3)
PLACE = np.zeros((3, SIZE))  # rows of d(position)/d(error), about the origin
PLACE[:, POSITION] = np.eye(3)
STILL = np.zeros((3, SIZE))  # rows of d(gyro bias at rest)/d(error)
STILL[:, 9:12] = STILL[:, 15:18] = np.eye(3)
HUBER = 2.0  # standard deviations of a speed, above which it gets less weight
MIN_FORCE_M_S2 = 1e-6  # below, a mean specific force has no direction
MIN_VARIANCE = 1e-14  # that a step adds to every error: keeps the covariance invertible
MISSING_RAD_S, MISSING_M_S2 = 2.0, 10.0  # standard deviation of the motion during missing samples
PAUSE_RAD, PAUSE_M_S, PAUSE_M = 0.3, 3.0, 1e3  # of turn, velocity and (at most) position over a gap in which the pose stays

Covariance = Float64[np.ndarray, "*filters _ _"]  # SIZE, and one for each offset
Vector6 = Float64[np.ndarray, "*filters 6"]
Error = Float64[np.ndarray, "*filters _"]
Walk = Float64[np.ndarray, " _"]  # of b, then of the offsets, per second^1/2
Positive = Annotated[float, Meta(gt=0)]


class FilterSettings(Settings, frozen=True, kw_only=True):
    """Filter settings: noise of the samples, and statistics of motion and rest."""

    gyro_density: Positive = 5e-4  # rad/s/sqrt(Hz)
    accel_density: Positive = 0.02  # m/s²/sqrt(Hz): of a calibration in motion rather than of the sensor
    gyro_scale: Positive = 2e-3  # error of a turn, as a share of it
    speed_m_s: Positive = 0.7  # per axis, of the pivot; of the mean velocity
    speed_correlation_s: Positive = 0.5
    pivot_m: Positive = 0.5  # per axis, of the pivot's place
    room_m: Positive = math.inf  # per axis, of the position at each block in motion, about the first; infinite: no bound
    rest_m_s: Positive = 0.05  # of a block at rest
    rest_rad_s: Positive = 2e-4  # motion within a stop: it begins and ends slowly
    start_m_s2: Positive = 1.5  # mean acceleration over the first block: its tilt of "up"


class State(NamedTuple):
    """Filter state: pose, biases, steady motion, covariance and offsets of other sensors.

    Biases are gyro (rad/s), then accel (m/s²): b in motion, and the offset d at rest. The steady motion is the pivot's place r
    (m) and the mean velocity c (m/s), in body axes.
    """

    R_wb: Matrix3
    v_w: Vector3
    p_wb: Vector3
    bias: Vector6
    ground: Vector6
    steady: Vector6
    P: Covariance
    offsets: Float64[np.ndarray, "*filters _"] = np.zeros(0)  # of other sensors

    def rest_bias(self, resting: bool) -> Vector6:
        """Bias of the sensor, at rest or in motion."""
        return self.bias + self.ground if resting else self.bias

    def covariance(self, resting: bool) -> Float64[np.ndarray, "6 6"]:
        """Covariance of `rest_bias`."""
        P = self.P
        both = P[BIAS, BIAS] + P[BIAS, GROUND] + P[GROUND, BIAS] + P[GROUND, GROUND]
        return both if resting else P[BIAS, BIAS]

    def moved(self, e: Error, P: Covariance) -> State:
        """State with an added error e: Exp(e) of the pose, and sums."""
        E, J = exp_and_jacobian(e[..., TURN])
        v, p = matvec(E, self.v_w) + matvec(J, e[..., VELOCITY]), matvec(E, self.p_wb) + matvec(J, e[..., POSITION])
        bias, ground, steady = self.bias + e[..., BIAS], self.ground + e[..., GROUND], self.steady + e[..., STEADY]
        return State(E @ self.R_wb, v, p, bias, ground, steady, P, self.offsets + e[..., SIZE:])

    def minus(self, other: State) -> Error:
        """Error e with `self == other.moved(e)`."""
        E = self.R_wb @ other.R_wb.T
        xi = log(E)
        J = exp_and_jacobian(xi)[1]
        v, p = (np.linalg.solve(J, a - E @ b) for a, b in ((self.v_w, other.v_w), (self.p_wb, other.p_wb)))
        sums = (getattr(self, name) - getattr(other, name) for name in ("bias", "ground", "steady", "offsets"))
        return np.concatenate([xi, v, p, *sums])


class Step(NamedTuple):
    """Filter step over a block: states before, predicted and after; over a gap no innovation."""

    before: State
    expected: State
    F: Covariance
    after: State
    innovation: tuple[Vector3, Matrix3] | None = None  # of the last bound, in world axes, and its covariance

    def of(self, k: int) -> Step:
        """Step of one filter of several."""
        before, expected, after = (State(*(x[k] for x in s)) for s in (self.before, self.expected, self.after))
        return Step(before, expected, self.F[k], after, self.innovation and tuple(x[k] for x in self.innovation))


def start(accel: Vector3, bias: Vector6, std: Float64[np.ndarray, "12"], s: FilterSettings) -> State:
    """First state of a log: levelled, with a bias, and deviations of bias and offset."""
    P = np.diag(np.concatenate([np.zeros(9), std, np.repeat([s.pivot_m, s.speed_m_s], 3)]) ** 2)
    return level(accel, State(EYE, np.zeros(3), np.zeros(3), bias, np.zeros(6), np.zeros(6), P), s)


def level(accel: Vector3, x: State, s: FilterSettings) -> State:
    """Levelled state from the direction of the mean specific force.

    Heading 0, unknown velocity, at the origin. Biases and steady motion are those of `x`.
    """
    force = accel - x.bias[3:]
    size = float(np.linalg.norm(force))
    if size < MIN_FORCE_M_S2:  # no direction at all
        force, size = np.array([0.0, 0.0, 1.0]), 1.0
    up_b = force / size
    axis = np.array([up_b[1], -up_b[0], 0.0])  # up_b x z
    sine = float(np.linalg.norm(axis))
    turn = axis / sine * np.arctan2(sine, up_b[2]) if sine > SMALL_RAD2 else np.array([0.0 if up_b[2] > 0 else np.pi, 0.0, 0.0])
    P = np.zeros((SIZE, SIZE))
    P[9:, 9:] = x.P[9:, 9:]
    P[0, 0] = P[1, 1] = (s.start_m_s2**2 + np.diag(P)[12:15].max()) / GRAVITY_M_S2**2
    P[VELOCITY, VELOCITY] = np.eye(3) * s.speed_m_s**2
    return State(exp_and_jacobian(turn)[0], np.zeros(3), np.zeros(3), x.bias, x.ground, x.steady, P)


def motion_step(x: State, motion: Increment, rate: Vector3, missing_s: float, walk: Walk, s: FilterSettings) -> Step:
    """Filter step over a block in motion.

    Prediction with the bias of `x`, then the bounded velocity. `rate` is the gyro's at the end, minus that bias; `walk` is the
    random walk of b and of the offsets per second^1/2.
    """
    T = motion.duration_s
    R = x.R_wb @ motion.R
    turned = s.gyro_density**2 * T + (s.gyro_scale * motion.turned_rad) ** 2 + (MISSING_RAD_S * missing_s) ** 2
    push = s.accel_density**2 * T + (MISSING_M_S2 * missing_s) ** 2
    step = _predict(x, R, motion.v, motion.p, motion.by_bias, T, (turned, push), walk, resting=False)
    H = np.zeros((*R.shape[:-1], SIZE))
    H[..., VELOCITY] = EYE
    H[..., STEADY] = steady = np.concatenate([R @ hat(rate), -R], axis=-1)
    noise = 2.0 * s.speed_m_s**2 * s.speed_correlation_s / T
    step = _bounded(step, H, step.expected.v_w + matvec(steady, x.steady), noise, HUBER)
    return _bounded(step, PLACE, step.after.p_wb, s.room_m**2, HUBER) if math.isfinite(s.room_m) else step


def _bounded(step: Step, H: Float64[np.ndarray, "... 3 m"], z: Vector3, noise: float, maximum: float) -> Step:
    """Step after a vector that is zero but for `noise` per axis; with less weight above `maximum` standard deviations."""
    S = H @ step.after.P[..., :SIZE, :SIZE] @ H.swapaxes(-1, -2) + noise * EYE
    size = np.sqrt(np.einsum("...i,...i->...", z, z) / np.einsum("...ii->...", S))
    after = update(step.after, H, z, noise * np.maximum(1.0, size / maximum)[..., None] ** 2 * ONES)
    return step._replace(after=after, innovation=(z, S))


def rest_step(x: State, mean: Vector6, variance: Vector3, T: float, walk: Walk, s: FilterSettings) -> Step:
    """Filter step over a block at rest, from the mean and the variance of the gyro's mean."""
    dv = (mean[..., 3:] - x.bias[..., 3:] - x.ground[..., 3:]) * T
    by_bias = np.zeros((*dv.shape[:-1], 9, 6))
    by_bias[..., VELOCITY, 3:], by_bias[..., POSITION, 3:] = -T * EYE, -0.5 * T**2 * EYE
    push = s.accel_density**2 * T
    step = _predict(x, x.R_wb, dv, 0.5 * T * dv, by_bias, T, (MIN_VARIANCE, push), walk, resting=True)
    step = _bounded(step, STOPPED, step.expected.v_w, s.rest_m_s**2, math.inf)
    rate = step.after.rest_bias(True)[..., :3] - mean[..., :3]
    return step._replace(after=update(step.after, STILL, rate, variance + s.rest_rad_s**2))


def _predict(
    x: State,
    R: Matrix3,
    dv: Vector3,
    dp: Vector3,
    by_bias: Float64[np.ndarray, "*filters 9 6"],
    T: float,
    noise: tuple[Float64[np.ndarray, "*filters"] | float, float],
    walk: Walk,
    *,
    resting: bool,
) -> Step:
    """Predicted state after a block."""
    v = x.v_w + G_W * T + matvec(x.R_wb, dv)
    p = x.p_wb + x.v_w * T + 0.5 * T**2 * G_W + matvec(x.R_wb, dp)
    by_bias_w = x.R_wb[..., None, :, :] @ by_bias.reshape(*by_bias.shape[:-2], 3, 3, 6)
    by_bias_w[..., 0, :, :] = of_turn = R @ by_bias[..., :3, :]
    hats = hat(np.concatenate([v, p], axis=-1).reshape(*v.shape[:-1], 2, 3))
    by_bias_w[..., 1:, :, :] += hats @ of_turn[..., None, :, :]
    F = np.zeros(x.P.shape) + np.eye(x.P.shape[-1])
    F[..., VELOCITY, TURN], F[..., POSITION, TURN], F[..., POSITION, VELOCITY] = T * HAT_G, 0.5 * T**2 * HAT_G, T * EYE
    F[..., POSE, BIAS] = by_bias_w.reshape(by_bias.shape)
    if resting:
        F[..., POSE, GROUND] = F[..., POSE, BIAS]
    P = F @ x.P @ F.swapaxes(-1, -2)
    by_noise, of_noise = np.zeros(by_bias.shape), np.empty(x.bias.shape)  # of the turn, then of the push
    by_noise[..., TURN, :3], by_noise[..., 3:, :3] = EYE, hats.reshape(*v.shape[:-1], 6, 3)
    by_noise[..., VELOCITY, 3:], by_noise[..., POSITION, 3:] = EYE, 0.5 * T * EYE
    of_noise[..., :3], of_noise[..., 3:] = np.asarray(noise[0])[..., None], noise[1]
    P[..., POSE, POSE] += (by_noise * of_noise[..., None, :]) @ by_noise.swapaxes(-1, -2)
    variances, walked = np.einsum("...ii->...i", P), walk**2 * T
    variances += MIN_VARIANCE
    variances[..., BIAS] += walked[:6]
    variances[..., SIZE:] += walked[6:]
    expected = State(R, v, p, x.bias, x.ground, x.steady, P, x.offsets)
    return Step(x, expected, F, expected)


def update(x: State, H: Float64[np.ndarray, "... k m"], z: Error, noise: Error) -> State:
    """Kalman update by z = H e + n.

    With e the first m errors of the estimate and `noise` the variances of n.
    """
    H = H if (more := x.P.shape[-1] - H.shape[-1]) == 0 else np.pad(H, ((0, 0), (0, more)))
    K, P = gain(x.P, H, noise)
    return x.moved(-matvec(K, z), P)


def gain(
    P: Float64[np.ndarray, "*batch s s"], H: Float64[np.ndarray, "... k s"], noise: Float64[np.ndarray, "*batch k"]
) -> tuple[Float64[np.ndarray, "*batch s k"], Float64[np.ndarray, "*batch s s"]]:
    """Kalman gain of a measurement z = H e + n, and the covariance after it (Joseph form)."""
    HP = H @ P
    S = HP @ H.swapaxes(-1, -2)
    variances = np.einsum("...kk->...k", S)  # a view
    variances += noise
    K = np.linalg.solve(S, HP).swapaxes(-1, -2)
    I_KH = np.eye(P.shape[-1]) - K @ H
    after = I_KH @ P @ I_KH.swapaxes(-1, -2) + (K * noise[..., None, :]) @ K.swapaxes(-1, -2)
    return K, 0.5 * (after + after.swapaxes(-1, -2))


def smooth(steps: Sequence[Step]) -> list[State]:
    """Smoothed states (Rauch, Tung and Striebel) before the first block and after each block."""
    later = steps[-1].after
    states = [later]
    for step in reversed(steps):
        scale = np.sqrt(np.diag(step.expected.P))  # rad/s and metres differ in size: solved with unit variances
        scaled = step.expected.P / scale[:, None] / scale
        C = np.linalg.solve(scaled, (step.F @ step.before.P) / scale[:, None]).T / scale
        P = step.before.P + C @ (later.P - step.expected.P) @ C.T
        later = step.before.moved(C @ later.minus(step.expected), 0.5 * (P + P.T))
        states.append(later)
    return states[::-1]


def pause_step(x: State, T: float, walk: Walk) -> Step:
    """Step over a gap of T seconds in the samples: the state stays, less certain of its pose."""
    std = np.repeat([PAUSE_RAD, PAUSE_M_S, min(PAUSE_M_S * T, PAUSE_M)], 3)
    noise = np.concatenate([std**2, walk[:6] ** 2 * T, np.zeros(12), walk[6:] ** 2 * T]) + MIN_VARIANCE
    expected = x._replace(P=x.P + np.diag(noise))
    return Step(x, expected, np.eye(len(x.P)), expected)


def reset_pose(x: State, accel: Vector3, T: float, walk: Vector6, maximum: Vector6, s: FilterSettings) -> Step:
    """Reset of the pose after a gap of T seconds in the samples; the biases stay.

    The variance of b grows by walk² T, up to `maximum`, the variance of a run's bias before its first sample.
    """
    fresh = level(accel, x, s)
    P = fresh.P + MIN_VARIANCE * np.eye(SIZE)
    grown = np.arange(9, 15)
    P[grown, grown] += np.minimum(walk**2 * T, np.maximum(maximum - P[grown, grown], 0.0))
    F = np.zeros((SIZE, SIZE))
    F[9:, 9:] = np.eye(SIZE - 9)
    fresh = fresh._replace(P=P)
    return Step(x, fresh, F, fresh)
