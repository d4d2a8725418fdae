"""Signals come from the filters' own equations, and from samples as they arrive: blocks, gaps and single samples alike."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imutool.sensor.signals import (
    ACCEL,
    ACCEL_DOT,
    ALPHA,
    COUNT,
    GYRO,
    GYRO_DOT,
    GYRO_SLOW,
    POWER_S,
    SLOW_S,
    TURN_S,
    VIBRATION,
    SignalFilter,
    Signals,
    vibration_power,
)

RATE_HZ = 200.0
SAME = 1e-12  # of the largest entry: the single sample's sums are in another order
EXACT = 1e-10  # of a step response: what is left of it after half a second


def samples(seed: int, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return np.arange(n) / RATE_HZ, rng.normal(size=(n, 3)), rng.normal(size=(n, 3)) + np.array([0.0, 0.0, 9.81])


def in_blocks(cuts: list[int], t_s: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> np.ndarray:
    filter_, edges = SignalFilter(RATE_HZ), [0, *cuts, len(t_s)]
    return np.concatenate([filter_(t_s[a:b], gyro[a:b], accel[a:b]).columns for a, b in pairwise(edges)])


def close(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(a, b, rtol=0, atol=SAME * np.abs(b).max())


@given(cuts=st.lists(st.integers(0, 300), max_size=10).map(sorted), seed=st.integers(0, 2**20))
@settings(max_examples=30, deadline=None)
def test_block_borders_change_nothing(cuts: list[int], seed: int) -> None:
    seen = samples(seed, 300)
    close(in_blocks(cuts, *seen), in_blocks([], *seen))


def test_the_vibration_of_a_whole_log_is_that_of_the_filter() -> None:
    t_s, gyro, accel = samples(2, 500)
    close(vibration_power(RATE_HZ, accel), SignalFilter(RATE_HZ)(t_s, gyro, accel).vibration)


def test_one_sample_at_a_time_is_the_block() -> None:
    seen = samples(1, 400)
    close(in_blocks(list(range(1, 400)), *seen), in_blocks([], *seen))


@pytest.mark.parametrize(("wanted", "made"), [(0, 6), (6, 6), (7, 18), (18, 18), (19, 27), (27, 27), (28, COUNT)])
@pytest.mark.parametrize("cuts", [[], list(range(1, 60)), [0, 7, 8, 9, 40]])
def test_what_nobody_wants_is_left_at_zero_and_the_rest_is_the_same(wanted: int, made: int, cuts: list[int]) -> None:
    t_s, gyro, accel = samples(6, 60)
    whole, filter_ = in_blocks(cuts, t_s, gyro, accel), SignalFilter(RATE_HZ, wanted)
    edges = [0, *cuts, 60]
    some = np.concatenate([filter_(t_s[a:b], gyro[a:b], accel[a:b]).columns for a, b in pairwise(edges)])
    assert made == COUNT or np.abs(whole[:, made:]).max() > 0
    np.testing.assert_array_equal(some[:, :made], whole[:, :made])
    assert not some[:, made:].any()


def test_a_single_samples_short_way_is_the_block() -> None:
    t_s, gyro, accel = samples(7, 100)
    filter_ = SignalFilter(RATE_HZ)
    rows = [filter_.one(float(t), u).copy() for t, u in zip(t_s, np.concatenate([gyro, accel], axis=1), strict=True)]
    close(np.array(rows), in_blocks([], t_s, gyro, accel))


def test_what_was_returned_stays_what_it_was() -> None:
    """Neither the filter nor its caller can reach the other's numbers."""
    t_s, gyro, accel = samples(2, 6)
    filter_ = SignalFilter(RATE_HZ)
    first = filter_(t_s[:1], gyro[:1], accel[:1])
    kept = first.columns.copy()
    second = filter_(t_s[1:2], gyro[1:2], accel[1:2])
    assert np.array_equal(first.columns, kept)
    second.columns[:] = 1e9
    rest = [filter_(t_s[k : k + 1], gyro[k : k + 1], accel[k : k + 1]).columns for k in range(2, 6)]
    close(np.concatenate(rest), in_blocks([], t_s, gyro, accel)[2:])


def test_nothing_in_nothing_out() -> None:
    filter_ = SignalFilter(RATE_HZ)
    none = np.zeros((0, 3))
    assert filter_(np.zeros(0), none, none).columns.shape == (0, COUNT)
    t_s, gyro, accel = samples(3, 5)
    close(filter_(t_s, gyro, accel).columns, in_blocks([], t_s, gyro, accel))


def step_response(name: str) -> np.ndarray:
    """One half second at rest, then the rate and force jump by one and stay."""
    n = 200
    after = (np.arange(n) >= n // 2)[:, None] * np.ones((n, 3))
    signals = SignalFilter(RATE_HZ)(np.arange(n) / RATE_HZ, after, after)
    response: np.ndarray = getattr(signals, name)[n // 2 :]
    return response


@pytest.mark.parametrize(("name", "tau_s"), [("gyro_slow", SLOW_S), ("alpha", TURN_S)])
def test_a_step_is_answered_as_the_equation_says(name: str, tau_s: float) -> None:
    """dy/dt = (x - y) / tau with x held over each period: y = 1 - exp(-t/tau), exactly; what alpha says adds up to the step."""
    left = np.exp(-(np.arange(100) + 1) / (RATE_HZ * tau_s))[:, None]
    expected = 1.0 - left if name == "gyro_slow" else left / left.sum() * RATE_HZ
    np.testing.assert_allclose(step_response(name), np.broadcast_to(expected, (100, 3)), rtol=EXACT, atol=EXACT)


def test_alpha_of_a_steadily_growing_rate_is_its_slope() -> None:
    t_s = np.arange(300) / RATE_HZ
    rate = np.stack([0.3 * t_s, -2.0 * t_s, 0.0 * t_s], axis=1)
    alpha = SignalFilter(RATE_HZ)(t_s, rate, np.zeros((300, 3))).alpha[-1]
    np.testing.assert_allclose(alpha, [0.3, -2.0, 0.0], rtol=1e-9)  # exp(-300 periods / tau) is left of the start


def test_vibration_is_the_power_of_what_is_faster_than_a_tenth_of_a_second() -> None:
    """sin at 40 Hz has power 1/2, a slow tilt none; after ten time constants."""
    n = round(10 * POWER_S * RATE_HZ)
    t_s = np.arange(n) / RATE_HZ
    fast, slow, still = np.sin(2 * np.pi * 40.0 * t_s), 3.0 * np.sin(2 * np.pi * 0.02 * t_s), np.full(n, 9.81)
    signals = SignalFilter(RATE_HZ)(t_s, np.zeros((n, 3)), np.stack([fast, slow, still], axis=1))
    power = signals.vibration[-1]
    assert power[0] == pytest.approx(0.5, rel=0.1)  # the filter of 0.1 s takes a little of it too
    assert power[1] < 4e-3  # it lags the tilt by 0.1 s of 0.38 m/s²/s
    assert power[2] < 1e-24  # rounding of 9.81, squared


def test_derivatives_divide_by_the_stamps_and_a_gap_is_a_long_step() -> None:
    t_s, gyro, accel = samples(4, 50)
    t_s = t_s + np.where(np.arange(50) >= 30, 2.0, 0.0)
    signals = SignalFilter(RATE_HZ)(t_s, gyro, accel)
    for dot, u in ((signals.gyro_dot, gyro), (signals.accel_dot, accel)):
        assert not dot[0].any(), "before the first sample nothing moved"
        np.testing.assert_allclose(dot[1:], np.diff(u, axis=0) / np.diff(t_s)[:, None], rtol=1e-12)
    apart = in_blocks([30], t_s, gyro, accel)
    close(apart, signals.columns)


def test_stamps_that_stand_still_or_run_back_do_not_blow_up() -> None:
    t_s, gyro, accel = samples(5, 20)
    t_s[10:] -= 0.02
    t_s[5] = t_s[4]
    for cuts in ([], list(range(1, 20))):
        dot = in_blocks(cuts, t_s, gyro, accel)[:, GYRO_DOT]
        np.testing.assert_allclose(dot[[5, 10]], (gyro[[5, 10]] - gyro[[4, 9]]) * RATE_HZ / 0.1, rtol=1e-12)


def test_columns_have_names() -> None:
    columns = np.arange(float(COUNT))[None]
    signals = Signals(np.zeros(1), columns)
    names = ("gyro", "accel", "gyro_slow", "gyro_dot", "accel_dot", "alpha", "vibration")
    places = (GYRO, ACCEL, GYRO_SLOW, GYRO_DOT, ACCEL_DOT, ALPHA, VIBRATION)
    for name, place in zip(names, places, strict=True):
        np.testing.assert_array_equal(getattr(signals, name), columns[:, place])
    assert signals.rows(np.array([0, 0])).columns.shape == (2, COUNT)


def test_the_load_of_a_filter_goes_on_in_another() -> None:
    """As after a gap: the quick filters begin anew, the load does not cool."""
    t_s, gyro, accel = samples(8, 900)
    first, second, cold = SignalFilter(RATE_HZ), SignalFilter(RATE_HZ), SignalFilter(RATE_HZ)
    before = first(t_s[:600], gyro[:600], accel[:600]).load
    second.continue_load(first)
    after = second(t_s[600:], gyro[600:], accel[600:]).load
    whole = in_blocks([], t_s, gyro, accel)
    np.testing.assert_allclose(after[:, :, 0], Signals(t_s[600:], whole[600:]).load[:, :, 0], rtol=0, atol=1e-12)
    assert np.abs(after[0] - before[-1]).max() < 2e-3
    assert np.abs(cold(t_s[600:], gyro[600:], accel[600:]).load[0]).max() < 2e-3
