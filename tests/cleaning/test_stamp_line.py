"""Stamps in batches, late stamps and counters that wrap: told where they are, and led back to the sensor's clock."""

from __future__ import annotations

import numpy as np
import pytest

from imutool.cleaning.rules.gaps import missing
from imutool.cleaning.stamp_line import GAP_NS, read_stamps, restamped, unrounded, usual_period
from imutool.log_info.clock import IncreasingStamps
from imutool.recording.sample_order import ticked

PERIOD_NS = 5_000_321
START_NS = 1_700_000_000_000_000_000


def sampled(n: int = 12_000) -> np.ndarray:
    """A sensor's clock whose crystal warms up: 20 ppm over the log."""
    number = np.arange(n)
    return START_NS + number * PERIOD_NS + (1e-5 * PERIOD_NS * number**2 / n).astype(np.int64)


def in_batches(true: np.ndarray, size: int, apart_ns: int = 0, seed: int = 1) -> np.ndarray:
    """Stamps that a driver puts on when it reads `size` samples, a little late."""
    last = true[np.minimum(np.arange(len(true)) // size * size + size - 1, len(true) - 1)]
    late = np.random.default_rng(seed).exponential(200_000, len(true))[np.arange(len(true)) // size]
    return last + late.astype(np.int64) + apart_ns * (np.arange(len(true)) % size)


@pytest.mark.parametrize(("size", "apart_ns"), [(4, 0), (5, 50_000), (20, 0)])
def test_batches_are_told_and_the_sensors_clock_comes_back(size: int, apart_ns: int) -> None:
    true = sampled()
    stamps = in_batches(true, size, apart_ns)
    assert read_stamps(stamps).batch == pytest.approx(size, rel=0.15)
    again = restamped(stamps)
    assert (np.diff(again) > 0).all()
    assert np.abs(again - true).max() < 300_000  # the stamps themselves are late by up to 20 periods
    assert read_stamps(again).faults == []


@pytest.mark.parametrize("name", ["32 bit of us", "32 bit of ns", "16 bit of ms"])
def test_a_counter_that_wraps_is_named_and_runs_on(name: str) -> None:
    bits, unit = int(name[:2]), {"us": 1000, "ns": 1, "ms": 1_000_000}[name[-2:]]
    size = 2**bits * unit
    true = np.arange(12_000) * PERIOD_NS
    origin = size - 10_000_000_000 if size > 10_000_000_000 else size // 2
    counted = (true + origin) // unit * unit % size
    found = read_stamps(counted)
    assert dict(found.wraps) == {name: int((np.diff(counted) < 0).sum())}
    assert np.abs(found.stamp_ns - found.stamp_ns[0] - true).max() <= unit
    assert (np.diff(restamped(counted)) > 0).all()


@pytest.mark.parametrize("jitter_ns", [0, 100_000, 1_000_000])
def test_stamps_one_by_one_are_no_batches(jitter_ns: int) -> None:
    stamps = sampled() + np.random.default_rng(3).integers(-jitter_ns, jitter_ns + 1, 12_000)
    assert read_stamps(stamps).faults == []


LOST = 1000, 2500, 2501, 7000  # samples that a driver lost, two of them in a row


@pytest.mark.parametrize("late_ns", [0, 1_000_000, 4_500_000])
@pytest.mark.parametrize("lost", [(), LOST])
def test_stamps_that_are_late_by_up_to_a_period_are_led_back_and_lost_samples_stay_lost(late_ns: int, lost: tuple) -> None:
    true = np.delete(sampled(), lost)
    late = true + np.random.default_rng(5).integers(0, late_ns + 1, len(true))
    stamps = np.maximum.accumulate(late)  # read in turn
    assert usual_period(stamps) == pytest.approx(PERIOD_NS, rel=0.01)
    off = np.abs(restamped(stamps) - true)
    assert np.quantile(off, 0.999) < (0.6e6 if late_ns else 1000)
    assert off.max() <= late_ns + 6000  # next to a lost sample that late stamps hide
    assert missing(stamps, usual_period(stamps)).sum() == len(lost)  # late ones next to a lost one do not count


@pytest.mark.parametrize("periods", [1.5, 3.0, 6.0])
def test_a_late_stamp_behind_a_lost_sample_is_no_further_loss(periods: float) -> None:
    true = np.delete(sampled(), LOST)
    late = true.copy()
    late[np.array(LOST) - np.arange(len(LOST))] += round(periods * PERIOD_NS)  # those behind the lost ones
    stamps = np.sort(late)
    assert missing(stamps, usual_period(stamps)).sum() == len(LOST)
    assert missing(restamped(stamps), usual_period(stamps)).sum() == len(LOST)


@pytest.mark.parametrize("dropped", [0, 5])
@pytest.mark.parametrize("held_back", [8, 20])
def test_samples_that_a_program_held_back_are_late_and_only_those_it_dropped_are_lost(held_back: int, dropped: int) -> None:
    late, starts = sampled(), range(1000, 11_000, 1000)
    for start in starts:
        late[start : start + held_back] = late[start + held_back]
    stamps = np.delete(late, [start + n for start in starts for n in range(dropped)])
    assert missing(stamps, usual_period(stamps)).sum() == dropped * len(starts)


def test_many_lost_samples_are_counted_though_they_make_long_steps() -> None:
    kept = np.random.default_rng(6).random(12_000) > 0.1
    kept[[0, -1]] = True
    stamps = sampled()[kept]
    assert usual_period(stamps) == pytest.approx(PERIOD_NS, rel=1e-3)
    assert missing(stamps, usual_period(stamps)).sum() == 12_000 - kept.sum()


@pytest.mark.parametrize("rate_hz", [416, 800, 952])
@pytest.mark.parametrize("lost", [(), (900, 901, 5000)])
def test_whole_milliseconds_of_an_even_sensor_show_its_rate_and_what_is_lost(rate_hz: int, lost: tuple[int, ...]) -> None:
    """Their steps alternate, as 1, 1, 1 and 2 ms at 800 Hz, which is no loss of every fourth sample at 1000 Hz."""
    true = START_NS + np.arange(8000) * 10**9 // rate_hz
    kept = np.delete(true, lost) if lost else true
    stamps = kept // 1_000_000 * 1_000_000
    assert missing(stamps, usual_period(stamps), ticked(stamps)).sum() == len(lost)
    assert 1e9 / usual_period(stamps) == pytest.approx(rate_hz, rel=1e-3)
    clock = IncreasingStamps()
    clock.see(stamps)
    assert clock.clock().rate_hz == pytest.approx(rate_hz, rel=1e-3)
    if not lost:
        assert np.ptp(restamped(stamps) - true) < 200_000


def test_samples_lost_by_chance_are_lost_though_the_stamps_are_whole_milliseconds() -> None:
    stamps = (START_NS + np.arange(12_000) * 1_000_000)[np.random.default_rng(6).random(12_000) > 0.03]
    assert ticked(stamps) is None
    assert missing(stamps, usual_period(stamps)).sum() == pytest.approx(12_000 - len(stamps), rel=0.02)


def test_a_logger_that_slows_down_does_not_write_in_batches() -> None:
    """A rocket's computer logs at 100 Hz until the apogee and at 10 Hz on its parachute."""
    true = START_NS + np.cumsum(np.where(np.arange(1700) < 1200, 10_000_000, 100_000_000))
    assert read_stamps(true).faults == []
    assert np.abs(restamped(true) - true).max() < 1000


@pytest.mark.parametrize("late_ns", [0, 4_000_000])
@pytest.mark.parametrize("burst", [140, 1030])
def test_the_line_does_not_bend_where_the_rate_changes(burst: int, late_ns: int) -> None:
    """A board sends a burst at 400 Hz before it goes on at 100 Hz, and the reader is late by a good part of a period."""
    true = START_NS + np.cumsum(np.where(np.arange(4000) < burst, 2_500_000, 10_000_000))
    stamps = np.maximum.accumulate(true + np.random.default_rng(8).integers(0, late_ns + 1, len(true)))
    assert np.abs(restamped(stamps) - true).max() <= late_ns + 1000
    assert np.quantile(np.abs(restamped(stamps) - true)[1200:], 0.99) < 0.3e6


def test_a_stamp_that_is_late_for_long_is_no_change_of_the_rate() -> None:
    true = sampled()
    stamps = true.copy()
    stamps[5000:5012] = stamps[5012]  # the reader slept
    assert np.abs(restamped(stamps) - true).max() < 20_000


def test_a_clock_set_back_is_no_wrap_and_a_pause_ends_the_line() -> None:
    true = sampled()
    assert not read_stamps(np.where(np.arange(12_000) < 6000, true, true - 3_000_000_000)).wraps
    paused = true + np.where(np.arange(12_000) < 6000, 0, 7_000_000_000)
    again = restamped(in_batches(paused, 6))
    assert np.abs(again - paused).max() < 600_000
    assert again[6000] - again[5999] > GAP_NS


@pytest.mark.parametrize(("unit", "name"), [(100, "100 ns"), (1000, "us"), (1_000_000, "ms")])
def test_fractions_of_a_second_in_another_unit_are_named_and_undone(unit: int, name: str) -> None:
    true = START_NS + np.arange(2000) * 25_000_321
    written = true // 10**9 * 10**9 + true % 10**9 // unit
    found = read_stamps(written)
    assert found.fraction == name
    assert found.faults[0] == f"the stamps' fractions of a second are written in {name}, not in ns"
    assert np.abs(found.stamp_ns - true).max() < unit
    assert np.abs(restamped(written) - true).max() <= unit


def test_bursts_of_a_second_are_no_fractions_of_another_unit() -> None:
    number = np.arange(2000)
    for start_ns in (0, 2_000_000, 400_000_000):
        bursts = START_NS + start_ns + number // 40 * 10**9 + number % 40 * 200_000  # 40 samples in 8 ms, then a pause
        assert read_stamps(bursts).fraction == ""
    assert read_stamps(sampled()).fraction == ""
    assert read_stamps(START_NS + np.arange(2000) * 10**9).fraction == ""


@pytest.mark.parametrize("grid_ns", [256, 1000])
def test_stamps_that_are_rounded_lie_on_their_even_clock(grid_ns: int) -> None:
    """256 ns: of seconds since 1970 as a float."""
    even = START_NS + np.delete(np.arange(4000), [700, 701, 2500]) * 3_003_003
    assert np.ptp(unrounded(even // grid_ns * grid_ns) - even) < 0.1 * grid_ns


def test_stamps_that_are_not_even_stay() -> None:
    late = START_NS + np.arange(4000) * 5_000_000 + np.random.default_rng(0).integers(0, 5000, 4000)
    assert unrounded(late) is late
    assert unrounded(late[:1]) is not None
