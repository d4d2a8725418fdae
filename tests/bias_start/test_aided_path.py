"""A path with aids: what drifts in pure integration is held by stops, wheels, the ground and a barometer."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import driven
from support.driven import R_VB, Drive

from imutool.bias_start.aided_path import AidSettings, aided_path
from imutool.bias_start.prior_width import BiasPrior
from imutool.errors import DataError
from imutool.inertial.aids import Aids, Odometry
from imutool.inertial.inertial_filter import update
from imutool.inertial.strapdown import StartPose, dead_reckon
from imutool.recording import Imu, Poses, Scalars
from imutool.sensor.made_up_flight import FlightSettings, TriadSettings, flight, trajectory

NOISE = TriadSettings(
    noise_density=2e-4, walk_density=0.0, typical_bias=0.0, turn_on_bias=0.0, warm_up=0.0, scale=0.0, misalignment_rad=0.0
)
SETTINGS = FlightSettings(gyro=NOISE, accel=NOISE, room_m=0.6, position_knot_s=0.9, tilt_rad=0.25, duration_s=20.0, still_s=4.0)
LEFT = np.array([5e-4, -3e-4, 4e-4, 0.02, -0.01, 0.015])
KNOWN = BiasPrior(np.zeros(6), np.array([1e-3] * 3 + [0.03] * 3), np.array([1e-4] * 3 + [0.03] * 3))
DRIVEN = BiasPrior(np.zeros(6), np.array([5e-3] * 3 + [0.1] * 3), np.array([1e-4] * 3 + [0.03] * 3))
STOPS = Aids({"stops": ""})
WHEELS = {"stops": "", "odometry": "/odom", "ground": ""}
TURNED_RAD = np.radians(1.5)  # error of the mount that the path begins with


def there_and_back() -> tuple[Imu, Poses]:
    """Still, a flight, the same flight backwards, still: the stop in the end is exact, and so is its truth."""
    imu = flight(0, SETTINGS).imu
    poses = trajectory(0, SETTINGS).poses(imu.t_ns)
    assert poses.v_w is not None
    period = int(np.diff(imu.t_ns)[0])
    t_ns = imu.t_ns[0] + period * np.arange(2 * len(imu) - 1)
    gyro = np.concatenate([imu.gyro, -imu.gyro[-2::-1]]) + LEFT[:3]
    accel = np.concatenate([imu.accel, imu.accel[-2::-1]]) + LEFT[3:]
    p, q = (np.concatenate([x, x[-2::-1]]) for x in (poses.p_wb, poses.q_wb_wxyz))
    return Imu(t_ns, gyro, accel), Poses(t_ns, p, q, np.concatenate([poses.v_w, -poses.v_w[-2::-1]]))


@pytest.fixture(scope="module")
def drive() -> Drive:
    return driven.drive(duration_s=60.0)


def wheels(drive: Drive, share: float = 0.0, speed: np.ndarray | None = None) -> Odometry:
    """Odometry of wheels whose radius is wrong by a share, with a mount that is a little wrong."""
    v = (1.0 + share) * (drive.speed if speed is None else speed)
    R = Rotation.from_quat(drive.vehicle.q_wb_wxyz.copy(), scalar_first=True)
    v_w = R.apply(np.column_stack([v, np.zeros((len(v), 2))]))
    poses = Poses(drive.vehicle.t_ns, drive.vehicle.p_wb, drive.vehicle.q_wb_wxyz, v_w)
    return Odometry(poses, (Rotation.from_rotvec([0.0, 0.0, TURNED_RAD]) * R_VB).as_matrix(), TURNED_RAD)


def error_m(estimate: Poses, true: Poses) -> np.ndarray:
    return np.linalg.norm(estimate.p_wb - true.p_wb, axis=1)


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt((errors**2).mean()))


def test_stops_take_back_what_drifted() -> None:
    imu, true = there_and_back()
    pure = dead_reckon(imu, StartPose.of(true))
    stopped = aided_path(imu, StartPose.of(true), KNOWN, STOPS)
    assert error_m(pure, true)[-1] > 10.0
    assert error_m(stopped, true)[-1] < 0.2 * error_m(pure, true)[-1]
    assert rms(error_m(stopped, true)) < 0.2 * rms(error_m(pure, true))
    assert stopped.v_w is not None
    assert np.linalg.norm(stopped.v_w[-100:], axis=1).max() < 0.1, "it knows that it stands"
    np.testing.assert_array_equal(stopped.t_ns, imu.t_ns)


def test_a_stop_helps_on_the_way_to_it() -> None:
    imu, true = there_and_back()
    until = len(imu) - 900  # the last stop begins there
    with_stop = aided_path(imu, StartPose.of(true), KNOWN, STOPS)
    without = aided_path(imu.rows(slice(0, until)), StartPose.of(true), KNOWN, STOPS)
    before = slice(until - 1000, until)
    assert rms(error_m(with_stop, true)[before]) < 0.6 * rms(error_m(without, true.rows(slice(0, until)))[before])


@pytest.mark.parametrize("far_m", [0.0, 5e6])
def test_it_begins_where_it_is_told_to(far_m: float) -> None:
    """Also in the coordinates of a map: a small error of attitude does not turn the path about their origin."""
    imu, true = there_and_back()
    start = StartPose.of(true)
    near = aided_path(imu, start, KNOWN, STOPS)
    made = aided_path(imu, start._replace(p_wb=start.p_wb + far_m), KNOWN, STOPS)
    np.testing.assert_allclose(made.p_wb - far_m, near.p_wb, rtol=0, atol=1e-6)
    np.testing.assert_allclose(near.p_wb[0], true.p_wb[0], rtol=0, atol=5e-3)
    assert np.abs(np.sum(made.q_wb_wxyz[0] * true.q_wb_wxyz[0])) > 1 - 1e-5


def test_wheels_on_the_ground_hold_the_position(drive: Drive) -> None:
    """The lever arm of 0.3 m, a mount that is off by 1.5 degrees and a radius by 5 % are estimated with it."""
    start = StartPose.of(drive.truth)
    pure = dead_reckon(drive.imu, start)
    aided = aided_path(drive.imu, start, DRIVEN, Aids(WHEELS, odometry=wheels(drive, 0.05)))
    assert rms(error_m(pure, drive.truth)) > 50.0
    assert rms(error_m(aided, drive.truth)) < 0.5
    assert aided.v_w is not None
    assert drive.truth.v_w is not None
    assert rms(np.linalg.norm(aided.v_w - drive.truth.v_w, axis=1)) < 0.05
    alone = aided_path(drive.imu, start, DRIVEN, Aids({"stops": "", "odometry": ""}, odometry=wheels(drive, 0.003)))
    assert rms(error_m(alone, drive.truth)) > 2.0 * rms(error_m(aided, drive.truth)), "the ground adds to the wheels"


def test_a_vehicle_that_drives_sideways_in_its_own_frame_has_the_same_path(drive: Drive) -> None:
    """What wheels measure is no sideways velocity that the ground forbids."""
    few, quarter = slice(0, 4000), Rotation.from_euler("z", 90.0, degrees=True)
    imu, start, ahead = drive.imu.rows(few), StartPose.of(drive.truth), wheels(drive)
    turned = (Rotation.from_quat(ahead.poses.q_wb_wxyz.copy(), scalar_first=True) * quarter).as_quat(scalar_first=True)
    aside = Odometry(replace(ahead.poses, q_wb_wxyz=turned), quarter.inv().as_matrix() @ ahead.R_vb, ahead.std_rad)
    one, other = (aided_path(imu, start, DRIVEN, Aids(WHEELS, odometry=of)) for of in (ahead, aside))
    assert rms(error_m(one, drive.truth.rows(few))) < 0.3
    np.testing.assert_allclose(other.p_wb, one.p_wb, rtol=0, atol=0.1)


def test_a_wheel_that_slips_is_not_believed(drive: Drive) -> None:
    slips = (np.arange(len(drive.speed)) % 500) < 50  # one second in ten the wheels spin
    odometry = wheels(drive, speed=np.where(slips, drive.speed + 3.0, drive.speed))
    start = StartPose.of(drive.truth)
    aided = aided_path(drive.imu, start, DRIVEN, Aids(WHEELS, odometry=odometry))
    assert rms(error_m(aided, drive.truth)) < 1.5  # six seconds at 3 m/s are 18 m


def test_wheels_say_nothing_while_they_are_silent(drive: Drive) -> None:
    """Their last speed held over 15 s."""
    whole = wheels(drive)
    t_s = (whole.poses.t_ns - whole.poses.t_ns[0]) * 1e-9
    odometry = replace(whole, poses=whole.poses.rows((t_s < 25.0) | (t_s > 40.0)))
    aided = aided_path(drive.imu, StartPose.of(drive.truth), DRIVEN, Aids(WHEELS, odometry=odometry))
    assert rms(error_m(aided, drive.truth)) < 0.3


def test_contact_with_the_ground_alone(drive: Drive) -> None:
    """Without wheels the IMU's own x is taken for forward."""
    straight = driven.drive(1, duration_s=40.0, mount=Rotation.from_euler("y", 4.0, degrees=True))
    start = StartPose.of(straight.truth)
    pure = dead_reckon(straight.imu, start)
    aided = aided_path(straight.imu, start, DRIVEN, Aids({"stops": "", "ground": ""}))
    assert rms(error_m(aided, straight.truth)) < 0.2 * rms(error_m(pure, straight.truth))


def test_a_barometer_holds_the_height_though_its_offset_drifts() -> None:
    imu, true = there_and_back()
    t_s = 1e-9 * (imu.t_ns - imu.t_ns[0])
    rng = np.random.default_rng(3)
    height = true.p_wb[::10, 2] + 30.0 + 0.01 * t_s[::10] + 0.1 * rng.normal(size=len(t_s[::10]))
    aids = Aids({"barometer": ""}, height=Scalars(imu.t_ns[::10], (height - height[0])[:, None], "m"))
    start = StartPose.of(true)
    pure = dead_reckon(imu, start)
    aided = aided_path(imu, start, KNOWN, aids)
    up = rms((aided.p_wb - true.p_wb)[:, 2])
    assert rms((pure.p_wb - true.p_wb)[:, 2]) > 3.0
    assert up < 0.3


@pytest.mark.parametrize("from_s", [0.0, 8.0])
def test_heights_may_count_from_anywhere(from_s: float) -> None:
    """Of a log whose truth begins 30 m above its first height, the vertical error was three times as large."""
    imu, true = there_and_back()
    t_ns, z = imu.t_ns[::10], true.p_wb[::10, 2] + 0.1 * np.random.default_rng(3).normal(size=len(imu.t_ns[::10]))
    heard = 1e-9 * (t_ns - t_ns[0]) >= from_s
    paths = [
        aided_path(
            imu, StartPose.of(true), KNOWN, Aids({"barometer": ""}, height=Scalars(t_ns[heard], (z + off)[heard][:, None], "m"))
        )
        for off in (-true.p_wb[0, 2], 30.0)
    ]
    np.testing.assert_allclose(paths[1].p_wb[:, 2], paths[0].p_wb[:, 2], rtol=0, atol=1e-3)
    assert rms((paths[1].p_wb - true.p_wb)[:, 2]) < 0.3


def test_a_barometer_has_the_whole_white_noise_of_its_values(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a mean over half a second; it had five sixths of the noise."""
    imu, true = there_and_back()
    t_ns, variances = imu.t_ns[::10], []

    def told(*arguments: Any) -> Any:
        variances.append(arguments[-1][0])
        return update(*arguments)

    monkeypatch.setattr("imutool.bias_start.aided_path.update", told)
    height = true.p_wb[::10, 2] + 2.0 * np.random.default_rng(3).normal(size=len(t_ns))
    aided_path(imu, StartPose.of(true), KNOWN, Aids({"barometer": ""}, height=Scalars(t_ns, height[:, None], "m")))
    count = AidSettings().height_window_s / (1e-9 * np.median(np.diff(t_ns)))
    assert np.median(variances) == pytest.approx(2.0**2 / count + AidSettings().height_m ** 2, rel=0.15)


def test_a_gap_of_samples_breaks_nothing(drive: Drive) -> None:
    """Five seconds without samples leave the heading open, and the wheels say how fast it is behind them."""
    t_s = 1e-9 * (drive.imu.t_ns - drive.imu.t_ns[0])
    kept = (t_s < 20.0) | (t_s > 25.0)
    imu, truth = drive.imu.rows(kept), drive.truth.rows(kept)
    aided = aided_path(imu, StartPose.of(truth), DRIVEN, Aids(WHEELS, odometry=wheels(drive)))
    assert np.isfinite(aided.p_wb).all()
    assert rms(error_m(aided, truth)[t_s[kept] < 20.0]) < 0.5
    behind = t_s[kept] > 26.0
    assert aided.v_w is not None
    assert truth.v_w is not None
    speeds = (np.linalg.norm(v, axis=1)[behind] for v in (aided.v_w, truth.v_w))
    assert rms(np.subtract(*speeds)) < 0.1


@pytest.mark.parametrize("count", [1, 2, 60])
def test_less_than_a_block_is_pure_integration(count: int) -> None:
    imu, true = there_and_back()
    few = imu.rows(slice(1200, 1200 + count))
    start = StartPose.of(true, 1200)
    made, pure = aided_path(few, start, KNOWN, STOPS), dead_reckon(few, start)
    np.testing.assert_allclose(made.p_wb, pure.p_wb, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.abs((made.q_wb_wxyz * pure.q_wb_wxyz).sum(axis=1)), 1.0, rtol=0, atol=1e-12)


def test_no_samples_are_refused() -> None:
    imu, true = there_and_back()
    with pytest.raises(DataError, match="the IMU has no samples"):
        aided_path(imu.rows(slice(0, 0)), StartPose.of(true), KNOWN, STOPS)
