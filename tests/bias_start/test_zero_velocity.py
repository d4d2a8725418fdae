"""A robot that stops now and then: what drifted between two stops is taken back at the second."""

from __future__ import annotations

import numpy as np
import pytest

from imutool.bias_start.prior_width import BiasPrior
from imutool.bias_start.zero_velocity import zero_velocity_trajectory
from imutool.errors import DataError
from imutool.inertial.strapdown import StartPose, dead_reckon
from imutool.recording import Imu, Poses
from imutool.sensor.made_up_flight import FlightSettings, TriadSettings, flight, trajectory

NOISE = TriadSettings(
    noise_density=2e-4, walk_density=0.0, typical_bias=0.0, turn_on_bias=0.0, warm_up=0.0, scale=0.0, misalignment_rad=0.0
)
SETTINGS = FlightSettings(gyro=NOISE, accel=NOISE, room_m=0.6, position_knot_s=0.9, tilt_rad=0.25, duration_s=20.0, still_s=4.0)
LEFT = np.array([5e-4, -3e-4, 4e-4, 0.02, -0.01, 0.015])
KNOWN = BiasPrior(np.zeros(6), np.array([1e-3] * 3 + [0.03] * 3), np.array([1e-4] * 3 + [0.03] * 3))


def there_and_back(seed: int = 0) -> tuple[Imu, Poses]:
    """Still, a flight, the same flight backwards, still: the stop in the end is exact, and so is its truth."""
    imu = flight(seed, SETTINGS).imu
    poses = trajectory(seed, SETTINGS).poses(imu.t_ns)
    assert poses.v_w is not None
    period = int(np.diff(imu.t_ns)[0])
    t_ns = imu.t_ns[0] + period * np.arange(2 * len(imu) - 1)
    gyro = np.concatenate([imu.gyro, -imu.gyro[-2::-1]]) + LEFT[:3]
    accel = np.concatenate([imu.accel, imu.accel[-2::-1]]) + LEFT[3:]
    p, q = (np.concatenate([x, x[-2::-1]]) for x in (poses.p_wb, poses.q_wb_wxyz))
    return Imu(t_ns, gyro, accel), Poses(t_ns, p, q, np.concatenate([poses.v_w, -poses.v_w[-2::-1]]))


def error_m(estimate: Poses, true: Poses) -> np.ndarray:
    return np.linalg.norm(estimate.p_wb - true.p_wb, axis=1)


def test_stops_take_back_what_drifted() -> None:
    imu, true = there_and_back()
    pure = dead_reckon(imu, StartPose.of(true))
    stopped = zero_velocity_trajectory(imu, StartPose.of(true), KNOWN)
    assert error_m(pure, true)[-1] > 10.0
    assert error_m(stopped, true)[-1] < 0.2 * error_m(pure, true)[-1]
    assert stopped.v_w is not None
    assert np.linalg.norm(stopped.v_w[-100:], axis=1).max() < 0.1, "it knows that it stands"
    np.testing.assert_array_equal(stopped.t_ns, imu.t_ns)


def test_it_begins_where_it_is_told_to() -> None:
    imu, true = there_and_back()
    for smooth in (False, True):
        made = zero_velocity_trajectory(imu, StartPose.of(true), KNOWN, smooth=smooth)
        np.testing.assert_allclose(made.p_wb[0], true.p_wb[0], rtol=0, atol=5e-3)
        assert np.abs(np.sum(made.q_wb_wxyz[0] * true.q_wb_wxyz[0])) > 1 - 1e-5


def test_knowing_the_end_helps_on_the_way() -> None:
    imu, true = there_and_back()
    causal, smooth = (zero_velocity_trajectory(imu, StartPose.of(true), KNOWN, smooth=way) for way in (False, True))
    assert np.sqrt((error_m(smooth, true) ** 2).mean()) < np.sqrt((error_m(causal, true) ** 2).mean())


def test_causal_means_that_later_samples_change_nothing() -> None:
    imu, true = there_and_back()
    cut = 3000
    other = Imu(imu.t_ns, np.where(np.arange(len(imu))[:, None] < cut, imu.gyro, 0.5), imu.accel)
    one, two = (zero_velocity_trajectory(some, StartPose.of(true), KNOWN) for some in (imu, other))
    np.testing.assert_array_equal(one.p_wb[:cut], two.p_wb[:cut])


@pytest.mark.parametrize("count", [1, 2, 60])
def test_less_than_a_block_is_pure_integration(count: int) -> None:
    imu, true = there_and_back()
    few = imu.rows(slice(1200, 1200 + count))
    start = StartPose.of(true, 1200)
    made, pure = zero_velocity_trajectory(few, start, KNOWN), dead_reckon(few, start)
    np.testing.assert_allclose(made.p_wb, pure.p_wb, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.abs((made.q_wb_wxyz * pure.q_wb_wxyz).sum(axis=1)), 1.0, rtol=0, atol=1e-12)


def test_no_samples_are_refused() -> None:
    imu, true = there_and_back()
    with pytest.raises(DataError, match="the IMU has no samples"):
        zero_velocity_trajectory(imu.rows(slice(0, 0)), StartPose.of(true), KNOWN)
