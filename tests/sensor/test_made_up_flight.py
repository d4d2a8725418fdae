"""A made-up flight is repeatable, physically consistent, and carries exactly the errors it says it carries."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.rates import rates_from_poses

from imutool import config
from imutool.errors import ConfigError
from imutool.inertial.strapdown import StartPose, dead_reckon
from imutool.recording import Recording, seconds
from imutool.sensor.made_up_flight import ACCEL_BIAS, GYRO_BIAS, FlightSettings, TriadSettings, flight, trajectory

PERFECT = TriadSettings(
    noise_density=0.0,
    walk_density=0.0,
    typical_bias=0.0,
    turn_on_bias=0.0,
    warm_up=0.0,
    scale=0.0,
    misalignment_rad=0.0,
)


def perfect(**changes: Any) -> FlightSettings:
    """A flight without any error in its IMU or its truth."""
    none = {"gyro": PERFECT, "accel": PERFECT, "truth_noise_m": 0.0, "truth_noise_rad": 0.0}
    return FlightSettings(**(none | changes))


def elapsed(recording: Recording) -> np.ndarray:
    return seconds(recording.imu.t_ns, int(recording.imu.t_ns[0]))


def test_the_same_arguments_give_the_same_bits() -> None:
    assert flight(5, duration_s=4.0) == flight(5, duration_s=4.0)


def test_a_shorter_flight_is_the_beginning_of_a_longer_one() -> None:
    short, long = flight(5, duration_s=4.0), flight(5, duration_s=9.0)
    cut = long.between(int(short.truth.t_ns[0]), int(short.imu.t_ns[-1]))
    assert cut.imu == short.imu
    assert cut.truth == short.truth.between(0, int(short.imu.t_ns[-1]))
    assert dict(cut.scalars) == dict(short.scalars)


def test_another_seed_is_another_flight_of_the_same_sensor() -> None:
    noiseless = msgspec.structs.replace(PERFECT, scale=0.01, misalignment_rad=0.01)
    a, b = (flight(seed, duration_s=6.0, gyro=noiseless, accel=PERFECT) for seed in (1, 2))
    assert not np.array_equal(a.imu.gyro, b.imu.gyro)
    # With no bias and no noise the reading is M times the ideal one; M is the same for both flights.
    M = [np.linalg.lstsq(trajectory(s).at(r.imu.t_ns).omega_b, r.imu.gyro, rcond=None)[0] for s, r in ((1, a), (2, b))]
    np.testing.assert_allclose(M[0], M[1], atol=1e-9)
    assert np.abs(M[0] - np.eye(3)).max() > 1e-3
    other = flight(1, duration_s=6.0, gyro=noiseless, accel=PERFECT, sensor_seed=9)
    assert other.truth == a.truth
    assert not np.array_equal(other.imu.gyro, a.imu.gyro)


def test_it_stands_still_first_and_reads_plus_g_there() -> None:
    recording = flight(2, perfect(duration_s=10.0))
    still = elapsed(recording) <= 3.0
    accel = recording.imu.accel[still]
    assert np.abs(recording.imu.gyro[still]).max() < 1e-12
    assert np.ptp(accel, axis=0).max() < 1e-12
    up_w = Rotation.from_quat(recording.truth.q_wb_wxyz[0], scalar_first=True).apply(accel[0])
    np.testing.assert_allclose(up_w, [0.0, 0.0, 9.81], atol=1e-12)
    assert np.ptp(recording.truth.between(0, int(recording.imu.t_ns[600])).p_wb, axis=0).max() == 0.0


def test_it_then_moves_vigorously_and_smoothly() -> None:
    recording = flight(2)
    motion = trajectory(2).at(recording.imu.t_ns)
    moving = elapsed(recording) > 5.0
    assert (motion.omega_b[moving].std(axis=0) > 0.3).all()
    assert (motion.a_w[moving].std(axis=0) > 1.0).all()
    # No jump: consecutive specific forces differ by no more than the motion's own rates allow in 5 ms.
    assert np.abs(np.diff(motion.specific_force(), axis=0)).max() < 0.5


def errors(rate_hz: float) -> tuple[float, float]:
    """Largest orientation (rad) and position (m) error of dead reckoning a perfect IMU over 10 s."""
    settings = perfect(duration_s=10.0, rate_hz=rate_hz)
    imu, exact = flight(4, settings).imu, trajectory(4, settings).poses(flight(4, settings).imu.t_ns)
    reckoned = dead_reckon(imu, StartPose.of(exact))
    true, found = (Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True) for poses in (exact, reckoned))
    return float((true.inv() * found).magnitude().max()), float(np.linalg.norm(reckoned.p_wb - exact.p_wb, axis=1).max())


def test_dead_reckoning_a_perfect_imu_follows_the_truth_and_converges_with_order_one() -> None:
    rates = (200.0, 400.0, 800.0, 1600.0)
    found = np.array([errors(rate) for rate in rates])
    # The rule holds each sample until the next, so both errors are proportional to the step: half a step of lag, which
    # at these rates is 2.5 ms of 2 rad/s, and the position it tilts gravity into.
    assert found[0, 0] < np.deg2rad(0.6)
    assert found[0, 1] < 1.0
    order = np.log2(found[:-1] / found[1:])
    assert np.abs(order - 1.0).max() < 0.3


def test_the_truth_is_the_trajectory_with_the_stated_noise_and_its_own_clock() -> None:
    recording = flight(6, truth_noise_m=1e-3, truth_noise_rad=2e-3)
    truth, exact = recording.truth, trajectory(6).poses(recording.truth.t_ns)
    n = len(truth)
    assert truth.period_s == pytest.approx(1.0 / 120.0, rel=1e-6)
    assert not np.isin(truth.t_ns, recording.imu.t_ns).any()
    assert truth.t_ns[0] < recording.imu.t_ns[0]
    assert truth.t_ns[-1] > recording.imu.t_ns[-1]
    assert truth.v_w is not None
    np.testing.assert_array_equal(truth.v_w, exact.v_w)
    five_sigma = 5.0 / np.sqrt(2.0 * 3 * n)  # a sample standard deviation of 3 n numbers is this far off at most
    assert (truth.p_wb - exact.p_wb).std() == pytest.approx(1e-3, rel=five_sigma)
    rotations = [Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True) for poses in (exact, truth)]
    assert (rotations[0].inv() * rotations[1]).as_rotvec().std() == pytest.approx(2e-3, rel=five_sigma)
    # A clean truth turns as its trajectory does half-way between the poses.
    clean = flight(6, perfect()).truth
    middle = (clean.t_ns[:-1] + clean.t_ns[1:]) // 2
    np.testing.assert_allclose(rates_from_poses(clean), trajectory(6, perfect()).at(middle).omega_b, atol=2e-3)


def test_reading_minus_true_bias_is_the_scaled_motion_with_the_data_sheets_noise() -> None:
    recording = flight(7)
    motion = trajectory(7).at(recording.imu.t_ns)
    for reading, ideal, topic, density in (
        (recording.imu.gyro, motion.omega_b, GYRO_BIAS, 1.6968e-4),
        (recording.imu.accel, motion.specific_force(), ACCEL_BIAS, 2.0e-3),
    ):
        bias = recording.scalars[topic]
        np.testing.assert_array_equal(bias.t_ns, recording.imu.t_ns)
        M, *_ = np.linalg.lstsq(ideal, reading - bias.values, rcond=None)
        rest = reading - bias.values - ideal @ M
        n = rest.size
        assert rest.std() == pytest.approx(density * np.sqrt(200.0), rel=5.0 / np.sqrt(2.0 * n))
        assert np.abs(rest.mean(axis=0)).max() < 5.0 * rest.std() / np.sqrt(n / 3)
        assert 1e-3 < np.abs(M - np.eye(3)).max() < 0.05  # there is something to calibrate


def test_the_bias_drifts_slowly_around_the_sensors_typical_value() -> None:
    starts = []
    for seed in range(8):
        bias = flight(seed).scalars[GYRO_BIAS].values
        assert np.abs(np.diff(bias, axis=0)).max() < 1e-4  # no jump from sample to sample
        assert 5e-4 < np.ptp(bias, axis=0).max() < 2e-2  # but it moves in a minute
        starts.append(bias[0])
    spread, typical = np.std(starts, axis=0), np.mean(starts, axis=0)
    assert (spread > 0.0).all()
    assert np.linalg.norm(typical) > 3.0 * np.linalg.norm(spread)


def test_rates_and_durations_other_than_the_usual_keep_their_clocks() -> None:
    recording = flight(1, duration_s=7.0, rate_hz=333.0, truth_rate_hz=60.0)
    steps = np.diff(recording.imu.t_ns)
    assert len(recording.imu) == 7 * 333 + 1
    assert recording.imu.t_ns[-1] - recording.imu.t_ns[0] == 7_000_000_000
    assert set(steps.tolist()) == {3_003_003, 3_003_004}  # rounded one by one: no error adds up


def test_a_flight_shorter_than_its_still_start_never_moves() -> None:
    recording = flight(1, perfect(duration_s=2.0))
    assert np.abs(recording.imu.gyro).max() < 1e-12


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"duraton_s": 3.0}, "Did you mean duration_s"),
        ({"rate_hz": -1.0}, "rate_hz"),
        ({"gyro": {**config.plain(PERFECT), "scale": -1.0}}, "scale"),
    ],
)
def test_a_wrong_setting_is_refused_with_its_name(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        flight(0, **changes)


def test_a_negative_seed_is_refused() -> None:
    with pytest.raises(ConfigError, match="seed -1"):
        flight(-1)
