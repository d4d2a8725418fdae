"""Samples that share a stamp are kept and spread at the sensor's rate; gaps, repeats and clocks set back stay what they are."""

from __future__ import annotations

import numpy as np
import pytest

from imutool.recording.joined_imu import joined
from imutool.recording.sample_order import in_order

MS = 1_000_000
START_NS = 1_700_000_000_000 * MS


def arrived(t: np.ndarray, late_s: float, tick_s: float = 1e-3) -> np.ndarray:
    """Stamps in whole ticks of samples that arrive one after the other, late by `late_s` in the mean."""
    late = np.random.default_rng(5).exponential(late_s, len(t)) if late_s else 0.0
    ticks = np.maximum.accumulate(np.floor((t + late) / tick_s + 1e-6)).astype(np.int64)
    return START_NS + ticks * round(tick_s * 1e9)


def motion(t: np.ndarray) -> np.ndarray:
    return np.random.default_rng(6).normal(0.0, 1.0, (len(t), 6)) + np.sin(t)[:, None]


def errors_ms(stamps: np.ndarray, t: np.ndarray) -> tuple[float, float]:
    error = (stamps - START_NS) * 1e-6 - t * 1e3
    return float(np.abs(error).max()), float(np.sqrt((error**2).mean()))


T_200, T_400, T_1000 = np.arange(12_000) / 200, np.arange(24_000) / 400, np.arange(30_000) / 1000


@pytest.mark.parametrize(
    ("t", "stamps", "kept_before", "max_ms", "rms_ms"),
    [  # bounds are those measured, rounded up
        pytest.param(T_400, arrived(T_400, 2e-3), 0.78, 11.5, 1.8, id="400 Hz, late by 2 ms"),
        pytest.param(T_400, arrived(T_400, 0.0, 0.01), 0.26, 2.6, 0.5, id="400 Hz, whole 10 ms"),
        pytest.param(T_200, arrived(np.repeat(T_200[::5], 5), 0.0), 0.21, 1e-3, 1e-3, id="200 Hz in batches of 5"),
        pytest.param(T_1000, arrived(T_1000, 5e-4), 0.87, 3.1, 0.3, id="1000 Hz, late by 0.5 ms"),
        pytest.param(T_1000 / 4, arrived(T_1000 / 4, 0.0), 0.26, 0.3, 0.05, id="4000 Hz, whole ms"),
        pytest.param(T_1000 * 20, arrived(T_1000 * 20, 0.0, 1.0), 0.03, 1e-3, 1e-3, id="50 Hz, whole seconds"),
    ],
)
def test_samples_of_one_stamp_are_all_kept_near_the_truth(t, stamps, kept_before, max_ms, rms_ms):
    values = motion(t)
    first = np.diff(stamps, prepend=0) != 0
    assert first.mean() < kept_before
    found = in_order(stamps, values, "imu")
    assert np.array_equal(found.values, values)
    assert np.array_equal(found.rows, np.arange(len(t)))
    assert np.diff(found.t_ns).min() > 0
    worst, rms = errors_ms(found.t_ns, t)
    assert worst < max_ms
    assert rms < rms_ms
    assert worst <= errors_ms(stamps[first], t[first])[0] + 1e-6
    (note,) = found.notes
    assert note.startswith(f"imu: {np.count_nonzero(found.t_ns != stamps)} of {len(t)} samples share the stamp of another one")
    alone = np.add.reduceat(np.ones(len(t)), np.flatnonzero(first))[np.cumsum(first) - 1] == 1
    assert np.array_equal(found.t_ns[alone], stamps[alone])


def test_a_first_stamp_that_had_begun_before_the_recording_ends_at_the_next_one():
    """Two of a batch of five: they are its last two, and not two that a step of the others apart."""
    stamps = arrived(np.repeat(T_200[::5], 5), 0.0)[3:]
    found = in_order(stamps, motion(T_200[3:]), "imu")
    assert errors_ms(found.t_ns, T_200[3:])[0] < 1e-3


def test_late_samples_move_back_and_those_of_a_rounded_stamp_ahead():
    t = T_400[:4000]
    assert "earlier than recorded" in in_order(arrived(t, 2e-3), motion(t), "imu").notes[0]
    assert "later than recorded" in in_order(arrived(t, 0.0, 0.01), motion(t), "imu").notes[0]


def test_rows_that_repeat_another_are_dropped_and_no_stamp_moves():
    t_ns, values = START_NS + 5 * MS * np.arange(1000), motion(T_200[:1000])
    twice = in_order(np.repeat(t_ns, 2), np.repeat(values, 2, axis=0), "imu")
    assert np.array_equal(twice.t_ns, t_ns)
    assert np.array_equal(twice.values, values)
    assert twice.notes == ["imu: 1000 samples that repeat another one, stamp and values, are left out"]
    some = np.sort(np.concatenate([np.arange(1000), [3, 500, 500, 999]]))
    few = in_order(t_ns[some], values[some], "imu")
    assert np.array_equal(few.t_ns, t_ns)
    assert few.notes == ["imu: 4 samples that repeat another one, stamp and values, are left out"]


def test_rows_written_twice_of_late_samples_are_dropped_and_the_others_are_as_without_them():
    stamps, values = arrived(T_400[:4000], 2e-3), motion(T_400[:4000])
    whole, twice = in_order(stamps, values, "imu"), in_order(np.repeat(stamps, 2), np.repeat(values, 2, axis=0), "imu")
    assert np.array_equal(twice.values, values)
    assert np.abs(twice.t_ns - whole.t_ns).max() < 5 * MS


def test_equal_samples_of_a_sensor_at_rest_are_no_repeats_where_batches_are_regular():
    stamps, values = np.repeat(START_NS + 25 * MS * np.arange(400), 5), motion(T_200[:2000])
    values[500:700] = values[500]
    found = in_order(stamps, values, "imu")
    assert np.array_equal(found.values, values)
    assert np.array_equal(np.diff(found.t_ns), np.full(1999, 5 * MS))
    again = in_order(np.insert(stamps, 13, stamps[12]), np.insert(values, 13, values[12], axis=0), "imu")
    assert np.array_equal(again.values, values)


def test_a_lost_second_stays_a_gap():
    t = np.concatenate([T_200[:3000], T_200[3000:6000] + 1.0])
    for stamps in (
        arrived(np.repeat(t[::5], 5), 0.0),
        arrived(np.repeat(t[4::5], 5), 2e-3),
        arrived(t, 0.0, 0.01),
        arrived(t, 3e-3),
    ):
        found = in_order(stamps, motion(t), "imu")
        gap = found.t_ns[3000] - found.t_ns[2999]
        assert len(found.t_ns) == len(t)
        assert abs(gap - 1005 * MS) < 21 * MS
        assert np.sum(np.diff(found.t_ns) > 100 * MS) == 1


def test_a_clock_that_goes_back_loses_what_it_lost_before():
    stamps = np.repeat(START_NS + 25 * MS * np.arange(400), 5)
    back = np.concatenate([stamps[:1000], stamps[1000:] - 2_000 * MS])
    found = in_order(back, motion(T_200[:2000]), "imu")
    assert np.array_equal(found.rows, np.concatenate([np.arange(1000), np.arange(1400, 2000)]))
    assert np.diff(found.t_ns).min() > 0
    assert found.notes[:2] == [
        "imu: 400 samples whose stamp goes back are left out",
        "imu: the clock was set back by 1.975 s: that much of the motion is missing there",
    ]


def test_without_a_second_stamp_nothing_shows_the_rate():
    found = in_order(np.full(50, START_NS), motion(T_200[:50]), "imu")
    assert len(found.t_ns) == 1
    assert found.notes == ["imu: 49 samples whose stamp repeats are left out"]
    assert not len(in_order(np.zeros(0, np.int64), np.zeros((0, 6)), "imu").t_ns)


def test_gyro_and_accelerometer_in_one_row_stay_together():
    """A gyro at rest repeats its values while the accelerometer does not."""
    stamps, values = arrived(T_400[:4000], 2e-3), motion(T_400[:4000])
    values[1000:1500, :3] = 0.01
    imu, rows, notes = joined(stamps, values[:, :3], stamps.copy(), values[:, 3:], "/imu0")
    assert np.array_equal(np.concatenate([imu.gyro, imu.accel], axis=1), values)
    assert np.array_equal(rows, np.arange(4000))
    assert len(notes) == 1


def test_rows_that_hold_one_of_the_sensors_are_joined_as_before():
    """A row for each sensor with one stamp for both is no stamp that two samples share."""
    stamps = np.repeat(START_NS + 5 * MS * np.arange(1000), 2)
    gyro, accel = np.full((2000, 3), np.nan), np.full((2000, 3), np.nan)
    gyro[::2], accel[1::2] = motion(T_200[:1000])[:, :3], motion(T_200[:1000])[:, 3:]
    imu, _, _ = joined(stamps, gyro, stamps, accel, "/imu0")
    assert np.array_equal(imu.t_ns, stamps[::2])
    assert np.array_equal(imu.accel, accel[1::2])
