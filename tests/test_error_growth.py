"""Errors over windows are those that were planted, and their covariances are as large as they are."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.error_growth import BiasCovariance, Grown, Motion, grown, pose_errors
from support.nees import consistency

from imutool.sensor.made_up_flight import FlightSettings, trajectory

LENGTH_S, RATE_HZ = 60.0, 100.0
GYRO_ERROR, ACCEL_ERROR = np.array([2e-5, -3e-5, 1e-5]), np.array([1e-3, 2e-3, -1e-3])
FIRST_ORDER = 0.02  # of an error: what is left of second order, and of the trapezoidal rule
NOTHING = np.zeros(6)


@pytest.fixture(scope="module")
def exact() -> Motion:
    """Exact samples and poses of a flight."""
    path = trajectory(3, FlightSettings(duration_s=LENGTH_S, rate_hz=RATE_HZ, still_s=0.0))
    t_ns = path.start_ns + np.round(np.arange(int(LENGTH_S * RATE_HZ)) * 1e9 / RATE_HZ).astype(np.int64)
    imu, poses = path.imu(t_ns), path.poses(t_ns)
    assert poses.v_w is not None
    samples = np.concatenate([imu.gyro, imu.accel], axis=1)
    return Motion((t_ns - t_ns[0]) * 1e-9, samples, poses.q_wb_wxyz, poses.v_w, np.ones(len(t_ns), bool))


def judged(motion: Motion, length_s: float, stated: BiasCovariance | None = None, pose_std: np.ndarray = NOTHING) -> Grown:
    n = len(motion.t_s)
    nothing = BiasCovariance(np.zeros((n, 6, 6)), np.zeros((n, 6, 0)))
    return grown(motion, motion.windows(length_s), stated or nothing, NOTHING, pose_std)


def planted(motion: Motion, errors: np.ndarray) -> Motion:
    """Samples whose bias is known with some errors."""
    return motion._replace(samples=motion.samples - errors)


@pytest.mark.parametrize("length_s", [1.0, 5.0])
def test_a_constant_error_of_the_bias_is_carried_to_attitude_and_velocity(exact: Motion, length_s: float) -> None:
    zeta, n = np.concatenate([GYRO_ERROR, ACCEL_ERROR]), len(exact.t_s)
    stated = BiasCovariance(np.broadcast_to(np.outer(zeta, zeta), (n, 6, 6)), np.zeros((n, 6, 0)))
    without = judged(exact, length_s).error
    found = judged(planted(exact, zeta), length_s, stated)
    errors = found.error - without
    expected = np.sqrt(found.bias.diagonal(axis1=1, axis2=2))[:, :3]
    np.testing.assert_allclose(np.abs(errors[:, :3]), expected, rtol=FIRST_ORDER, atol=FIRST_ORDER * expected.max())


def test_an_error_of_the_calibration_goes_with_the_motion(exact: Motion) -> None:
    scale = np.zeros((len(exact.t_s), 6))
    scale[:, :3] = 1e-3 * exact.samples[:, :3]
    stated = BiasCovariance(np.zeros((len(scale), 6, 6)), scale[:, :, None])
    found = judged(planted(exact, scale), 5.0, stated)
    errors, variance = found.error - judged(exact, 5.0).error, found.bias.diagonal(axis1=1, axis2=2)
    np.testing.assert_allclose(errors[:, :3] ** 2, variance[:, :3], atol=FIRST_ORDER * variance[:, :3].max())


def test_noise_and_poses_are_as_large_as_stated(exact: Motion) -> None:
    rng, n = np.random.default_rng(0), len(exact.t_s)
    noise, pose_std = np.repeat([2e-3, 3e-2], 3), np.repeat([1e-3, 1e-2], 3)
    turned = Rotation.from_rotvec(pose_std[:3] * rng.normal(size=(n, 3))) * Rotation.from_quat(
        exact.q_wb_wxyz, scalar_first=True
    )
    noisy = exact._replace(
        samples=exact.samples + noise * rng.normal(size=(n, 6)),
        q_wb_wxyz=turned.as_quat(scalar_first=True),
        v_w=exact.v_w + pose_std[3:] * rng.normal(size=(n, 3)),
    )
    np.testing.assert_allclose(pose_errors(noisy, noise), pose_std, rtol=0.35)  # 59 differences of neighbours
    stated = BiasCovariance(np.zeros((n, 6, 6)), np.zeros((n, 6, 0)))
    found = grown(noisy, noisy.windows(1.0)[::2], stated, noise, pose_std)
    assert consistency(found.error, found.other)["consistent"]


def test_the_lean_of_the_world_is_no_error_of_the_sensor(exact: Motion) -> None:
    leaning = exact._replace(v_w=exact.v_w + exact.t_s[:, None] * np.array([0.1, -0.05, 0.0]))
    error = judged(leaning, 5.0).error - judged(exact, 5.0).error
    assert np.abs(error[:, 3:]).max() < FIRST_ORDER * 0.5  # m/s; the lean alone makes 0.5


def test_windows_need_truth_at_both_ends(exact: Motion) -> None:
    trusted = exact.trusted.copy()
    trusted[500] = False
    assert len(exact._replace(trusted=trusted).windows(5.0)) == len(exact.windows(5.0)) - 2
    assert not np.isfinite(pose_errors(exact._replace(trusted=exact.t_s < 3.0), NOTHING)).any(), "too short to say"
