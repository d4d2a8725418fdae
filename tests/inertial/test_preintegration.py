"""Increments are what pure integration gives, and their derivatives are those of the integral."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.inertial.preintegration import exp, hat, integrate
from imutool.recording import seconds
from imutool.sensor.made_up_flight import FlightSettings, TriadSettings, flight, trajectory

SECOND_ORDER = 2e-4  # of the mean of two samples, over half a second at 200 Hz in a lively flight: rad, m/s, m
DIFFERENCE = 1e-5  # rad/s and m/s²: the step of a central difference, whose error is its square
PERFECT = TriadSettings(
    noise_density=0.0, walk_density=0.0, typical_bias=0.0, turn_on_bias=0.0, warm_up=0.0, scale=0.0, misalignment_rad=0.0
)
G_W = np.array([0.0, 0.0, -9.81])


def block(seed: int = 0, first: int = 800, steps: int = 100) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    imu = flight(seed, FlightSettings(gyro=PERFECT, accel=PERFECT), duration_s=8.0).imu.rows(slice(first, first + steps + 1))
    return seconds(imu.t_ns, int(imu.t_ns[0])), imu.gyro, imu.accel


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 9.9e-5, 1.01e-4, 1e-2, 1.0, np.pi])
def test_exp_is_the_rotation_on_both_sides_of_the_series(angle: float) -> None:
    xi = angle * np.array([0.6, -0.0, 0.8])
    np.testing.assert_allclose(exp(xi), Rotation.from_rotvec(xi).as_matrix(), rtol=0, atol=1e-15)
    np.testing.assert_allclose(hat(xi) @ np.array([1.0, 2.0, 3.0]), np.cross(xi, [1.0, 2.0, 3.0]), rtol=0, atol=1e-14)


def test_an_increment_takes_the_true_state_to_the_next() -> None:
    settings = FlightSettings(gyro=PERFECT, accel=PERFECT, duration_s=8.0)
    imu = flight(0, settings).imu.rows(slice(800, 901))
    poses = trajectory(0, settings).poses(imu.t_ns)
    motion = integrate(seconds(imu.t_ns, int(imu.t_ns[0])), imu.gyro, imu.accel)
    R = Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True).as_matrix()
    assert poses.v_w is not None
    T = motion.duration_s
    assert pytest.approx(0.5) == T
    np.testing.assert_allclose(R[0] @ motion.R, R[-1], rtol=0, atol=SECOND_ORDER)
    np.testing.assert_allclose(poses.v_w[0] + G_W * T + R[0] @ motion.v, poses.v_w[-1], rtol=0, atol=10 * SECOND_ORDER)
    end = poses.p_wb[0] + poses.v_w[0] * T + 0.5 * T**2 * G_W + R[0] @ motion.p
    np.testing.assert_allclose(end, poses.p_wb[-1], rtol=0, atol=10 * SECOND_ORDER)


def test_the_derivative_by_the_bias_is_that_of_the_integral() -> None:
    t, gyro, accel = block()
    here = integrate(t, gyro, accel)
    for axis in range(6):
        c = np.zeros(6)
        c[axis] = DIFFERENCE
        more, less = (integrate(t, gyro - s * c[:3], accel - s * c[3:]) for s in (1.0, -1.0))
        turn = [Rotation.from_matrix(here.R.T @ other.R).as_rotvec() for other in (more, less)]
        slope = np.concatenate([turn[0] - turn[1], more.v - less.v, more.p - less.p]) / (2 * DIFFERENCE)
        # Jr to first order in the turn of one step: off by its square, 1e-4
        np.testing.assert_allclose(here.by_bias[:, axis], slope, rtol=0, atol=1e-4)


def test_a_steady_turn_under_a_steady_force_in_closed_form() -> None:
    t = np.linspace(0.0, 1.0, 401)
    gyro, accel = np.tile([0.0, 0.0, 2.0], (401, 1)), np.tile([1.0, 0.0, 3.0], (401, 1))
    motion = integrate(t, gyro, accel)
    np.testing.assert_allclose(motion.R, Rotation.from_rotvec([0.0, 0.0, 2.0]).as_matrix(), rtol=0, atol=1e-12)
    np.testing.assert_allclose(motion.v, [np.sin(2) / 2, (1 - np.cos(2)) / 2, 3.0], rtol=0, atol=1e-5)
    np.testing.assert_allclose(motion.p, [(1 - np.cos(2)) / 4, (2 - np.sin(2)) / 4, 1.5], rtol=0, atol=1e-5)
    assert motion.turned_rad == pytest.approx(2.0)
