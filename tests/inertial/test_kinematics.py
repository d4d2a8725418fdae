"""Motions whose angular rate and specific force are known in closed form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation
from support.rates import rates_from_poses

from imutool.errors import DataError, NumericsError
from imutool.inertial.kinematics import G_W, Trajectory, attitude_by_gyro, fit_trajectory, gravity_error
from imutool.recording import Poses

START_NS = 1_700_000_000_000_000_123
# A quintic interpolant on 10 ms knots is off by h^6 f^(6) in value and by h^4 f^(6) in its second derivative; the
# motions below have f^(6) under 1e4, which leaves 1e-8 and 1e-4, the latter mostly at the ends of the interval.
RATE_TOLERANCE = 1e-6
SECOND_DERIVATIVE_TOLERANCE = 1e-4
EXACT = 1e-12  # only rounding separates the two sides


def follow(
    p: Callable[[np.ndarray], np.ndarray], rotation: Callable[[np.ndarray], Rotation], duration_s: float = 4.0
) -> Trajectory:
    """The spline through a motion sampled every 10 ms."""
    t = np.arange(0.0, duration_s + 1e-12, 0.01)
    t_ns = START_NS + np.round(t * 1e9).astype(np.int64)
    return fit_trajectory(Poses(t_ns, p(t), np.ascontiguousarray(rotation(t).as_quat(scalar_first=True))))


def inside(duration_s: float = 4.0) -> np.ndarray:
    """Instants off the knots, away from the ends where an interpolant is worst."""
    return np.arange(0.1037, duration_s - 0.1, 0.0173)


def ns(t: np.ndarray) -> np.ndarray:
    return START_NS + np.round(t * 1e9).astype(np.int64)


def still(t: np.ndarray) -> np.ndarray:
    return np.tile([1.0, 2.0, 3.0], (len(t), 1))


def test_at_rest_it_reads_plus_g_along_the_body_axis_that_points_up() -> None:
    tilted = Rotation.from_euler("xyz", [0.3, -0.7, 1.1])
    imu = follow(still, lambda t: Rotation.concatenate([tilted] * len(t))).imu(ns(inside()))
    up_b = tilted.inv().apply([0.0, 0.0, 1.0])
    assert np.abs(imu.gyro).max() < SECOND_DERIVATIVE_TOLERANCE
    np.testing.assert_allclose(imu.accel, np.tile(9.81 * up_b, (len(imu), 1)), atol=RATE_TOLERANCE)


def test_gravity_of_the_log_replaces_the_standard_one() -> None:
    imu = follow(still, lambda t: Rotation.identity(len(t))).imu(ns(inside()), g_w=np.array([0.0, 0.0, -9.79]))
    np.testing.assert_allclose(imu.accel, np.tile([0.0, 0.0, 9.79], (len(imu), 1)), atol=RATE_TOLERANCE)


@given(st.tuples(*[st.floats(-4.0, 4.0)] * 3))
@settings(max_examples=20, deadline=None)
def test_a_constant_turn_reads_its_constant_rate_and_no_angular_acceleration(rate: tuple[float, float, float]) -> None:
    omega = np.array(rate)
    motion = follow(still, lambda t: Rotation.from_rotvec(t[:, None] * omega)).at(ns(inside()))
    np.testing.assert_allclose(motion.omega_b, np.tile(omega, (len(motion.p_wb), 1)), atol=RATE_TOLERANCE)
    assert np.abs(motion.alpha_b).max() < SECOND_DERIVATIVE_TOLERANCE


def test_on_a_circle_it_reads_the_centripetal_force_and_gravity() -> None:
    radius, rate = 2.0, 3.0
    trajectory = follow(
        lambda t: np.stack([radius * np.cos(rate * t), radius * np.sin(rate * t), 0 * t], axis=1),
        lambda t: Rotation.from_rotvec(rate * t[:, None] * [0.0, 0.0, 1.0]),  # body x points outwards, y ahead
    )
    motion = trajectory.at(ns(inside()))
    expected = np.tile([-(rate**2) * radius, 0.0, 9.81], (len(motion.p_wb), 1))
    np.testing.assert_allclose(motion.specific_force(), expected, atol=SECOND_DERIVATIVE_TOLERANCE)
    speed = np.linalg.norm(motion.v_w, axis=1)
    np.testing.assert_allclose(speed, rate * radius, atol=RATE_TOLERANCE)


def test_coning_reads_its_closed_form_rate_and_angular_acceleration() -> None:
    half_angle, rate = 0.2, 5.0  # the axis of a fixed angle goes round: phi(t) = theta (cos wt, sin wt, 0)

    def rotation(t: np.ndarray) -> Rotation:
        axis = np.stack([np.cos(rate * t), np.sin(rate * t), 0 * t], axis=1)
        return Rotation.from_rotvec(half_angle * axis)

    t = inside()
    motion = follow(still, rotation).at(ns(t))
    s, c = np.sin(half_angle), np.cos(half_angle)
    # R = Rz(wt) Rx(theta) Rz(-wt): omega_b = w (Rz Rx^T - I) e_z, a vector going round with the axis.
    expected = rate * np.stack([-s * np.sin(rate * t), s * np.cos(rate * t), (c - 1.0) * np.ones_like(t)], axis=1)
    slope = rate**2 * np.stack([-s * np.cos(rate * t), -s * np.sin(rate * t), 0 * t], axis=1)
    np.testing.assert_allclose(motion.omega_b, expected, atol=RATE_TOLERANCE)
    np.testing.assert_allclose(motion.alpha_b, slope, atol=SECOND_DERIVATIVE_TOLERANCE)


def test_a_point_of_the_body_feels_what_a_trajectory_of_that_point_feels() -> None:
    r_b = np.array([0.3, -0.2, 0.5])

    def p(t: np.ndarray) -> np.ndarray:
        return np.stack([np.sin(t), np.cos(2 * t), 0.5 * t * t], axis=1)

    def rotation(t: np.ndarray) -> Rotation:
        return Rotation.from_euler("zyx", np.stack([2 * np.sin(t), 0.4 * np.cos(3 * t), 0.3 * t], axis=1))

    at = ns(inside())
    tracked = follow(p, rotation).at(at)
    directly = follow(lambda t: p(t) + rotation(t).apply(r_b), rotation).at(at)
    np.testing.assert_allclose(tracked.specific_force(r_b), directly.specific_force(), atol=SECOND_DERIVATIVE_TOLERANCE)


def test_derivatives_of_an_unnormalised_quaternion_spline_match_differences_of_its_rotations() -> None:
    rng = np.random.default_rng(3)
    t = np.arange(0.0, 5.01, 0.5)
    q = rng.normal(size=(len(t), 4)) * 0.4 + [1.0, 0.0, 0.0, 0.0]  # norms far from one on purpose
    trajectory = Trajectory(START_NS, make_interp_spline(t, np.zeros((len(t), 3)), k=5), make_interp_spline(t, q, k=5))
    at, h_ns = ns(np.arange(0.5, 4.5, 0.037)), 1_000_000
    before, now, after = (trajectory.at(at + shift) for shift in (-h_ns, 0, h_ns))
    R_before, R_after = (Rotation.from_quat(m.q_wb_wxyz, scalar_first=True) for m in (before, after))
    rate = (R_before.inv() * R_after).as_rotvec() / (2e-9 * h_ns)
    # A central difference over 1 ms is off by h² f'''/6; rates here reach some 10 rad/s on a scale of 0.1 s.
    size = np.abs(now.alpha_b).max()
    np.testing.assert_allclose(now.omega_b, rate, atol=1e-5 * size)
    np.testing.assert_allclose(now.alpha_b, (after.omega_b - before.omega_b) / (2e-9 * h_ns), atol=1e-3 * size)


def test_rates_from_poses_of_a_constant_turn_are_that_turn() -> None:
    omega = np.array([0.4, -2.0, 1.5])
    t = np.array([0.0, 0.005, 0.02, 0.021, 0.5])
    q = Rotation.from_rotvec(t[:, None] * omega).as_quat(scalar_first=True)
    poses = Poses(ns(t), still(t), np.ascontiguousarray(q * np.array([1, -1, 1, -1, 1])[:, None]))
    np.testing.assert_allclose(rates_from_poses(poses), np.tile(omega, (4, 1)), atol=1e-12 / 1e-3)


def test_the_spline_passes_through_its_poses_whatever_their_signs() -> None:
    t = np.arange(0.0, 3.0, 0.05)
    q = Rotation.from_rotvec(t[:, None] * [0.0, 0.0, 4.0]).as_quat(scalar_first=True)
    p = np.stack([t, t**2, np.sin(t)], axis=1)
    signs = np.where(np.arange(len(t)) % 3 == 0, -1.0, 1.0)[:, None]
    poses = Poses(ns(t), p, np.ascontiguousarray(q * signs))
    back = fit_trajectory(poses).poses(poses.t_ns)
    np.testing.assert_allclose(back.p_wb, poses.p_wb, atol=EXACT)
    assert np.abs(np.abs(np.sum(back.q_wb_wxyz * poses.q_wb_wxyz, axis=1)) - 1.0).max() < EXACT


def test_the_noise_of_the_poses_is_in_the_acceleration() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 6.0, 0.01)
    p = np.stack([np.sin(t), np.cos(t), t], axis=1)
    noisy = Poses(ns(t), p + 1e-3 * rng.normal(size=p.shape), np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1)))
    error = fit_trajectory(noisy).at(noisy.t_ns).a_w - np.stack([-np.sin(t), -np.cos(t), 0 * t], axis=1)
    assert np.sqrt(np.mean(error[50:-50] ** 2)) > 10.0  # 1 mm over (10 ms)²: the reason smoothing exists


@pytest.mark.parametrize("t_s", [-0.1, 4.1])
def test_an_instant_outside_the_trajectory_is_refused(t_s: float) -> None:
    trajectory = follow(still, lambda t: Rotation.identity(len(t)))
    with pytest.raises(NumericsError, match="outside the trajectory"):
        trajectory.at(ns(np.array([t_s])))


def test_a_quaternion_spline_through_zero_is_refused() -> None:
    t = np.linspace(0.0, 1.0, 6)
    through_zero = np.stack([1 - 2 * t, 0 * t, 0 * t, 0 * t], axis=1)
    trajectory = Trajectory(START_NS, make_interp_spline(t, np.zeros((6, 3)), k=5), make_interp_spline(t, through_zero, k=5))
    with pytest.raises(NumericsError, match="shrinks"):
        trajectory.at(ns(np.array([0.5])))


def test_too_few_poses_are_refused() -> None:
    t = np.array([0.0, 0.1, 0.2, 0.3, 0.4])
    with pytest.raises(DataError, match="more than 5"):
        fit_trajectory(Poses(ns(t), still(t), np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))))


def test_standard_gravity_points_down_and_cannot_be_changed_by_accident() -> None:
    np.testing.assert_array_equal(G_W, [0.0, 0.0, -9.81])
    with pytest.raises(ValueError, match="read-only"):
        G_W[2] = 0.0


@pytest.mark.parametrize(("g", "noise", "told"), [(9.80665, 0.1, 9.80665), (9.81, 0.1, 9.81), (9.7803, 1e-3, 9.7803)])
def test_a_simulators_gravity_is_a_usual_one_unless_its_samples_show_another(g: float, noise: float, told: float) -> None:
    rng = np.random.default_rng(1)
    R_wb = Rotation.from_euler("xyz", rng.uniform(-1.0, 1.0, (20_000, 3))).as_matrix()
    y = np.einsum("nji,j->ni", R_wb, [0.0, 0.0, g + G_W[2]]) + [0.1, -0.2, 0.05] + noise * rng.normal(size=(20_000, 3))
    off = gravity_error(R_wb, y, 36.0)
    np.testing.assert_allclose(off, [0.0, 0.0, told + G_W[2]], atol=1e-12 if noise > 0.01 else 1e-4)


@pytest.mark.parametrize(("carried", "unit"), [(1e-4, 1.0), (1e-2, 1.0), (1e-4, 1.0 / 9.81)])
def test_rates_and_forces_give_the_attitude_of_a_body_that_stays_in_a_room(carried: float, unit: float) -> None:
    """Not of one that is carried off, nor in g."""
    motion = follow(
        lambda t: np.outer(carried * t**3, [1.0, 0.0, 0.0]) + np.outer(np.sin(3.0 * t), [0.1, 0.2, 0.1]),
        lambda t: Rotation.from_rotvec(np.outer(np.sin(2.0 * t), [0.5, 0.3, 0.0])),
        duration_s=20.0,
    )
    t, at = inside(20.0), motion.at(ns(inside(20.0)))
    R_wb = attitude_by_gyro(t, at.omega_b, unit * at.specific_force())
    if carried > 1e-3 or unit < 1.0:
        assert R_wb is None
    else:
        assert R_wb is not None
        true = Rotation.from_quat(at.q_wb_wxyz, scalar_first=True)
        turned = (Rotation.from_matrix(R_wb) * true.inv()).as_rotvec()
        np.testing.assert_allclose(turned[:, :2], 0.0, atol=0.02)
        np.testing.assert_allclose(turned, turned.mean(axis=0, keepdims=True).repeat(len(t), 0), atol=1e-3)
