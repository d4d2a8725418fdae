"""What no model should be learned from is refused before a step is made, and what is merely hard is not."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from imutool.errors import DataError
from imutool.log_info.convention_report import check_conventions
from imutool.mcap_io.read import read
from imutool.recording import Imu, Poses, Recording
from imutool.sensor.made_up_flight import flight
from imutool.training.log_agreement import warn_of_smoothed_poses
from imutool.training.training_windows import Pool, check_trainable


def checked(*recordings: Recording) -> None:
    check_trainable(recordings, Pool.of(recordings))


@pytest.fixture(scope="module")
def flown() -> Recording:
    return flight(1, duration_s=20.0)


def with_gyro(recording: Recording, gyro: np.ndarray) -> Recording:
    return replace(recording, imu=Imu(recording.imu.t_ns, gyro, recording.imu.accel))


def of_sensor(recording: Recording, name: str, sensor: str) -> Recording:
    return replace(recording, name=name, metadata={"imutool": {"sensor": sensor}})


def test_a_flight_with_a_poor_sensor_is_accepted(flown: Recording) -> None:
    """Scale wrong by a fifth, a bias of 11 degrees a second."""
    checked(with_gyro(flown, 1.2 * flown.imu.gyro + 0.2))


def test_logs_of_two_sensors_are_told_by_name(flown: Recording) -> None:
    with pytest.raises(DataError, match=r"different sensors \(a: bmi160, b: adis16448\)"):
        checked(of_sensor(flown, "a", "bmi160"), of_sensor(flown, "b", "adis16448"))


def test_a_log_that_does_not_say_its_sensor_goes_with_any(flown: Recording) -> None:
    checked(of_sensor(flown, "a", "bmi160"), replace(flown, name="b", metadata={}))


def test_a_sensor_on_a_table_is_refused(flown: Recording) -> None:
    still = np.full_like(flown.imu.gyro, 0.05) + 1e-3 * np.random.default_rng(0).normal(size=flown.imu.gyro.shape)
    with pytest.raises(DataError, match="hardly turns"):
        checked(with_gyro(flown, still))


@pytest.mark.parametrize(("seldom", "accepted"), [(0.2, True), (0.02, False)])
def test_a_sensor_that_seldom_turns_is_accepted(seldom: float, accepted: bool) -> None:
    """A car on straight roads turns its heading for a share of the time."""
    t_s, noise = np.arange(0.0, 100.0, 0.01), 5e-3 * np.random.default_rng(0).normal(size=(10_000, 3))
    rate = np.where(t_s % 50.0 < 50.0 * seldom, 0.3, 0.0)
    heading = np.cumsum(rate) * 0.01
    t_ns, q_wxyz = (
        np.round(1e9 * t_s).astype(np.int64),
        np.stack([np.cos(heading / 2), 0 * t_s, 0 * t_s, np.sin(heading / 2)], 1),
    )
    imu = Imu(t_ns, np.outer(rate, [0.0, 0.0, 1.0]) + noise, np.tile([0.0, 0.0, 9.81], (len(t_s), 1)))
    car = Recording("car", imu, {"/ground_truth/pose": Poses(t_ns, np.zeros((len(t_s), 3)), q_wxyz)})
    with nullcontext() if accepted else pytest.raises(DataError, match="90% of the time"):
        checked(car)


def test_truths_of_other_flights_are_refused_by_their_names(flown: Recording) -> None:
    other = flight(2, duration_s=20.0)
    t_ns = flown.truth.t_ns
    swapped = replace(other.truth, t_ns=t_ns) if len(other.truth) == len(t_ns) else None
    assert swapped is not None, "made-up flights have one clock"
    wrong = {"/ground_truth/pose": swapped}
    with pytest.raises(
        DataError, match=r"worthless, spoilt: .*do not follow the gyro: .* rad a second, of .*; .* leave these logs out"
    ):
        checked(replace(flown, name="worthless", truths=wrong), flown, replace(flown, name="spoilt", truths=wrong))


def test_a_truth_of_another_frame_is_refused(flown: Recording) -> None:
    """The axes of the gyro in another order than the truth's body."""
    with pytest.raises(DataError, match="do not follow the gyro"):
        checked(with_gyro(flown, flown.imu.gyro[:, [1, 2, 0]]))


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [1, 2, 3, 0]], ids=["inverse", "x, y, z, w"])
def test_quaternions_that_are_inverse_or_in_another_order_are_refused(flown: Recording, order: list[int]) -> None:
    sign = np.array([1.0, -1.0, -1.0, -1.0]) if order == [0, 1, 2, 3] else np.ones(4)
    poses = replace(flown.truth, q_wb_wxyz=(flown.truth.q_wb_wxyz * sign)[:, order], v_w=None)
    with pytest.raises(DataError, match="do not follow the gyro"):
        checked(replace(flown, truths={"/ground_truth/pose": poses}))


@pytest.mark.parametrize(
    ("over_s", "motion"),
    [(0.0, {}), (0.4, {}), (0.0, {"rate_hz": 100.0, "tilt_rad": 0.02, "turn_rad": 0.02, "truth_noise_rad": 5e-3})],
)
def test_poses_that_are_means_over_some_time_are_named(
    over_s: float, motion: dict[str, float], caplog: pytest.LogCaptureFixture
) -> None:
    flown = flight(1, duration_s=20.0, attitude_knot_s=0.35, **motion)
    poses, rate_hz = flown.truth, 1.0 / flown.truth.period_s
    n = 2 * round(0.5 * over_s * rate_hz) + 1
    mean = np.apply_along_axis(np.convolve, 0, poses.q_wb_wxyz, np.full(n, 1.0 / n), "same")
    q = mean / np.linalg.norm(mean, axis=1, keepdims=True)
    kept = slice(n, -n)
    smoothed = Poses(poses.t_ns[kept], poses.p_wb[kept], q[kept])
    warn_of_smoothed_poses(Pool.of([replace(flown, truths={"/ground_truth/pose": smoothed})]))
    assert ("smoothed over about 0.39 s" in caplog.text) == ("smoothed" in caplog.text) == (over_s > 0.0), caplog.text


def test_poses_that_are_far_apart_are_not_called_smoothed(caplog: pytest.LogCaptureFixture) -> None:
    """A GNSS and INS, or a lidar: on straight lines between its poses a turn is too small, as if they were means."""
    warn_of_smoothed_poses(Pool.of([flight(1, duration_s=60.0, rate_hz=100.0, truth_rate_hz=5.0, attitude_knot_s=0.35)]))
    assert "smoothed" not in caplog.text


def test_stamps_in_batches_are_refused_before_the_poses_clock_that_they_seem_to_shift(flown: Recording) -> None:
    imu, row = flown.imu, np.arange(len(flown.imu))
    stamps = imu.t_ns[np.minimum(row // 5 * 5 + 4, len(imu) - 1)] + 100_000 * (row % 5)
    with pytest.raises(DataError, match=r"batches of about 5.0 samples.*--restamp corrects it"):
        check_conventions([replace(flown, imu=Imu(stamps, imu.gyro, imu.accel))])


def test_a_few_seconds_are_not_enough() -> None:
    with pytest.raises(DataError, match="expected at least 10 s"):
        checked(flight(1, duration_s=6.0))


def test_every_training_log_of_the_data_sets_is_accepted(data: Path, tmp_path: Path) -> None:
    """Among them one of whose truth a tenth is missing, and a robot that stands for a fifth of the time."""
    from imutool.api.logs import convert

    convert(data / "fetch", tmp_path / "fetch")
    convert(data / "tumvi" / "dataset-room1.tar.gz", tmp_path / "room1.mcap")
    convert(data / "euroc" / "V2_01_easy.zip", tmp_path / "V2_01.mcap")
    checked(*(read(path) for path in sorted((tmp_path / "fetch").iterdir())))
    checked(read(tmp_path / "room1.mcap"))
    checked(read(tmp_path / "V2_01.mcap", truth="/ground_truth/pose"))
