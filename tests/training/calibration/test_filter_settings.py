"""What the training logs show of the motion of a body, and of the turns that the filter integrates."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.bias import conv, hybrid, static
from imutool.bias_start.initial_bias import UNKNOWN_BODY, bias_prior
from imutool.inertial.inertial_filter import FilterSettings
from imutool.recording import Imu, Poses, Recording
from imutool.training.calibration.filter_settings import MIN_TURN_ERROR, filter_settings
from imutool.training.training_windows import Pool


def pool(imu: Imu, poses: Poses) -> Pool:
    return Pool.of([Recording("circle", imu, {"/pose": poses})])


def test_logs_of_a_vehicle_widen_the_bound_on_speed() -> None:
    """Fifteen metres a second on a circle that takes 20 s, and the same path a hundred times smaller."""
    t_s, rate = np.arange(0.0, 100.0, 0.05), 2 * np.pi / 20.0
    heading = Rotation.from_rotvec(np.outer(rate * t_s, [0.0, 0.0, 1.0])).as_quat(scalar_first=True)
    t_ns, speeds = np.round(1e9 * t_s).astype(np.int64), {}
    imu = Imu(t_ns, np.tile([0.0, 0.0, rate], (len(t_s), 1)), np.tile([0.0, 15.0 * rate, 9.81], (len(t_s), 1)))
    for speed in (0.15, 15.0):
        p_wb = speed / rate * np.stack([np.sin(rate * t_s), 1.0 - np.cos(rate * t_s), 0.0 * t_s], axis=1)
        speeds[speed] = filter_settings(static.Model(), pool(imu, Poses(t_ns, p_wb, heading))).get("speed")
    assert speeds[0.15] is None
    turned_alone = filter_settings(static.Model(), pool(imu, Poses(t_ns, np.zeros((len(t_s), 3)), heading)))
    assert turned_alone["speed"] == UNKNOWN_BODY, "poses without positions"
    found = speeds[15.0]
    assert found is not None
    np.testing.assert_allclose(found["speed_m_s"], 15.0 / np.sqrt(3.0), rtol=0.02)
    assert 1.0 < found["speed_correlation_s"] < 20.0


@pytest.mark.parametrize(("scale_std", "error"), [(1e-5, MIN_TURN_ERROR), (1.5e-3, 1.5e-3), (0.1, FilterSettings().gyro_scale)])
def test_a_sure_calibration_lets_the_filter_believe_in_turns(scale_std: float, error: float) -> None:
    """Turns to and fro, whose scale is known to `scale_std`, of a gyro with a bias that is no turn."""
    t_s, rate_hz = np.arange(0.0, 60.0, 0.05), 20.0
    angle = 2.0 * np.sin(np.outer(t_s, [0.5, 0.7, 0.9]))
    gyro = 0.3 + np.gradient(angle, t_s, axis=0)
    upright = Poses(np.round(1e9 * t_s).astype(np.int64), np.zeros((len(t_s), 3)), np.tile([1.0, 0.0, 0.0, 0.0], (len(t_s), 1)))
    logs = pool(Imu(upright.t_ns, gyro, np.tile([0.0, 0.0, 9.81], (len(t_s), 1))), upright)
    tensors = {"theta_gyro": np.zeros(3), "covariance_gyro": scale_std**2 * np.eye(3)}
    model = hybrid.Model(hybrid.Config(gyro_effects=("gyro_scale",), remainder=False), rate_hz, tensors)
    model.card = filter_settings(model, logs)
    np.testing.assert_allclose(bias_prior(model).settings.gyro_scale, error, rtol=1e-6)
    unknown = conv.Model(conv.Config(), rate_hz)
    assert "turn_error" not in filter_settings(unknown, logs), "a network knows no covariance"
    assert bias_prior(unknown).settings.gyro_scale == FilterSettings().gyro_scale
