"""The delay between two sensors is measured where the motion shows it, and only there."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.errors import DataError
from imutool.recording.joined_imu import joined, sensor_delay, unit_by_gravity
from imutool.recording.sample_order import in_order

RNG = np.random.default_rng(11)
DURATION_S = 60.0
UNITS = {"rad/s": 1.0, "deg/s": np.pi / 180.0}
WITHIN_S = 0.001  # the delays of interest are those of several milliseconds


def attitude(t: np.ndarray) -> Rotation:
    """Body to world of a camera held in the hand."""
    angles = [0.5 * np.sin(2 * np.pi * f * t + k) for k, f in enumerate((0.7, 1.1, 0.4))]
    return Rotation.from_euler("ZYX", np.stack(angles, axis=1))


def measured(delay_s: float, rates_hz: tuple[float, float] = (400.0, 250.0), shaken: float = 0.3) -> tuple[np.ndarray, ...]:
    t_gyro, t_accel = (np.arange(0.0, DURATION_S, 1.0 / hz) for hz in rates_hz)
    step = 1e-4
    gyro = (attitude(t_gyro - step).inv() * attitude(t_gyro + step)).as_rotvec() / (2 * step)
    world = np.array([0.0, 0.0, 9.81]) + shaken * np.stack([np.sin(9.0 * t_accel + k) for k in range(3)], axis=1)
    accel = attitude(t_accel).inv().apply(world)
    gyro_ns, accel_ns = ((10**18 + np.rint(t * 1e9)).astype(np.int64) for t in (t_gyro, t_accel + delay_s))
    return (
        gyro_ns,
        gyro + RNG.normal(0.01, 0.005, gyro.shape),
        accel_ns,
        accel + RNG.normal(0.0, 0.05, accel.shape),
    )


@pytest.mark.parametrize("delay_s", [-0.031, 0.0, 0.004, 0.012, 0.08])
def test_a_planted_delay_is_found(delay_s):
    found = sensor_delay(*measured(delay_s))
    assert found is not None
    assert abs(found.seconds - delay_s) < WITHIN_S
    assert found.std_s < WITHIN_S


@pytest.mark.parametrize(("delay_s", "side"), [(0.012, "later"), (-0.012, "earlier")])
def test_a_delay_is_said_with_its_side(delay_s, side):
    gyro_ns, gyro, accel_ns, accel = measured(delay_s)
    note, *_ = joined(gyro_ns, gyro, accel_ns, accel, "/imu0").notes
    assert "gyro at 400.0 Hz and accelerometer at 250.0 Hz" in note
    (size_ms,) = re.findall(rf"the accelerometer's stamps are ([\d.]+) ms {side} than the gyro's", note)
    assert float(size_ms) == pytest.approx(12.0, abs=1e3 * WITHIN_S)


def test_the_accelerometer_is_interpolated_but_not_over_a_gap():
    gyro_ns, gyro, accel_ns, accel = measured(0.0)
    kept = (accel_ns < accel_ns[5000]) | (accel_ns > accel_ns[5050])  # 0.2 s are missing
    imu, rows, notes = joined(gyro_ns, gyro, accel_ns[kept], accel[kept], "/imu0")
    inside = (gyro_ns <= accel_ns[4999]) | (gyro_ns > accel_ns[5051])
    assert np.array_equal(rows, np.flatnonzero(inside & (gyro_ns <= accel_ns[-1])))
    assert np.array_equal(imu.gyro, gyro[rows])
    expected = [np.interp(imu.t_ns - accel_ns[0], accel_ns - accel_ns[0], column) for column in accel.T]
    np.testing.assert_allclose(imu.accel, np.stack(expected, axis=1), rtol=0, atol=1e-9)
    assert notes[-1] == f"/imu0: gyro samples without an accelerometer sample near them: {len(gyro) - len(rows)}"


@pytest.mark.parametrize("later_s", [-2.0 * DURATION_S, 2.0 * DURATION_S])
def test_sensors_of_two_times_are_no_imu(later_s):
    gyro_ns, gyro, accel_ns, accel = measured(0.0)
    with pytest.raises(DataError, match="gyro and accelerometer share no time"):
        joined(gyro_ns, gyro, accel_ns + round(1e9 * later_s), accel, "/imu0")


def test_a_slow_motion_that_repeats_is_not_certain_of_a_delay():
    """Its own acceleration goes with its turns, in each stretch alike, and looks like a delay of tens of milliseconds."""
    t, step = 0.005 * np.arange(12_000), 1e-3

    def moves(t: np.ndarray, sizes: tuple[float, ...], rates: tuple[float, ...], phases: tuple[float, ...]) -> np.ndarray:
        begun = np.clip((t - 6.0) / 2.0, 0.0, 1.0)
        begun = begun**2 * (3.0 - 2.0 * begun)
        return np.stack([a * np.sin(w * t + p) for a, w, p in zip(sizes, rates, phases, strict=True)], axis=1) * begun[:, None]

    def turned(t: np.ndarray) -> Rotation:
        return Rotation.from_euler("xyz", moves(t, (0.35, 0.3, 1.2), (0.9, 0.7, 0.4), (4.0, 1.69, 0.26)))

    def place(t: np.ndarray) -> np.ndarray:
        return moves(t, (2.0, 1.5, 0.8), (0.5, 0.6, 0.8), (0.1, 5.11, 5.73))

    gyro = (turned(t - step).inv() * turned(t + step)).as_rotvec() / (2 * step)
    moved = (place(t + step) - 2 * place(t) + place(t - step)) / step**2 + [0.0, 0.0, 9.81]
    t_ns = np.rint(1e9 * t).astype(np.int64)
    found = sensor_delay(t_ns, gyro, t_ns, turned(t).inv().apply(moved) + RNG.normal(0.0, 0.02, (len(t), 3)))
    assert found is not None
    assert abs(found.seconds) < 3.0 * found.std_s


@pytest.mark.parametrize("unit", UNITS)
def test_the_unit_of_the_gyro_shows_where_gravity_turns(unit):
    gyro_ns, gyro, _, accel = measured(0.0, (400.0, 400.0))
    found = unit_by_gravity(gyro_ns, gyro / UNITS[unit], accel, UNITS)
    assert found is not None
    assert found[0] == unit
    assert found[1] > 3.0
    assert unit_by_gravity(gyro_ns, gyro / 0.1, accel, UNITS) is None  # in neither of the two
    assert unit_by_gravity(gyro_ns, gyro / UNITS[unit], accel[:, [1, 2, 0]], UNITS) is None  # axes that do not belong together
    still = np.array([0.0, 0.0, 9.81]) + RNG.normal(0.0, 0.05, accel.shape)
    assert unit_by_gravity(gyro_ns, gyro / UNITS[unit], still, UNITS) is None  # the thrust of a drone


def test_a_log_at_rest_or_of_vibration_shows_none():
    gyro_ns, _, accel_ns, accel = measured(0.01)
    noise = RNG.normal(0.0, 0.01, (len(gyro_ns), 3))
    assert sensor_delay(gyro_ns, noise, accel_ns, np.array([0.0, 0.0, 9.81]) + RNG.normal(0.0, 0.05, accel.shape)) is None
    assert sensor_delay(gyro_ns, noise, accel_ns, accel) is None
    assert sensor_delay(gyro_ns[:400], noise[:400], accel_ns[:250], accel[:250]) is None


def test_of_one_clock_a_sample_that_one_sensor_lacks_is_left_out_and_nothing_is_interpolated():
    gyro_ns, gyro, _, accel = measured(0.0)
    accel = accel[: len(gyro_ns)].copy()
    gyro_ns, gyro = gyro_ns[: len(accel)], gyro[: len(accel)].copy()
    gyro[50], accel[70] = np.nan, np.nan
    imu, rows, notes = joined(gyro_ns, gyro, gyro_ns.copy(), accel, "/imu0")
    kept = np.delete(np.arange(len(gyro)), [50, 70])
    assert np.array_equal(rows, kept)
    assert np.array_equal(imu.t_ns, gyro_ns[kept])
    assert np.array_equal(imu.gyro, gyro[kept])
    assert np.array_equal(imu.accel, accel[kept])
    *lost, alone = notes
    assert all("not finite" in note for note in lost)
    assert alone == "/imu0: 2 samples that gyro or accel alone has are left out"


def test_a_clock_that_is_set_back_is_said_with_what_is_missing():
    t_ns = 10_000_000 * np.arange(1000, dtype=np.int64)
    values = np.ones((1000, 3))
    assert in_order(t_ns, values, "imu").notes == []
    late = t_ns.copy()
    late[500] -= 2_000_000_000  # one stamp alone
    assert in_order(late, values, "imu").notes == ["imu: 1 samples whose stamp goes back are left out"]
    back = np.concatenate([t_ns[:600], t_ns[600:] - 2_000_000_000])
    found = in_order(back, values, "imu")
    assert len(found.t_ns) == 800
    assert found.notes == [
        "imu: 200 samples whose stamp goes back are left out",
        "imu: the clock was set back by 1.99 s: that much of the motion is missing there",
    ]
