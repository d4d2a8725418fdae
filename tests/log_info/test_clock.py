"""Steps of stamps in blocks against the same in memory."""

from __future__ import annotations

import numpy as np
import pytest

from imutool.cleaning.stamp_line import usual_period
from imutool.log_info import clock
from imutool.log_info.clock import SensorStamps, clocks

START_NS, PERIOD_NS, COUNT = 1_700_000_000_000_000_000, 5_000_000, 20_000
COARSE = 2e-4  # of a median from the histogram
BLOCK = 1000


def late(seed: int = 1) -> np.ndarray:
    """Stamps with delays of 0.3 ms, lost samples and a pause of two minutes."""
    rng = np.random.default_rng(seed)
    t_ns = START_NS + PERIOD_NS * np.arange(COUNT) + (3e5 * rng.random(COUNT)).astype(np.int64)
    t_ns[COUNT // 2 :] += 120_000_000_000
    return np.delete(t_ns, rng.choice(COUNT, 40, replace=False))


def seen(t_ns: np.ndarray) -> SensorStamps:
    stamps = SensorStamps()
    for first in range(0, len(t_ns), BLOCK):
        stamps.see(t_ns[first : first + BLOCK])
    return stamps


@pytest.mark.parametrize("max_exact", [clock.MAX_EXACT, 4096])
def test_a_clock_is_that_of_all_steps(monkeypatch: pytest.MonkeyPatch, max_exact: int) -> None:
    monkeypatch.setattr(clock, "MAX_EXACT", max_exact)
    t_ns = late()
    steps, found = np.diff(t_ns), seen(t_ns)
    median, exact = float(np.median(steps)), max_exact > COUNT
    assert found.steps.median() == (median if exact else pytest.approx(median, rel=COARSE))
    assert found.period_ns == (usual_period(t_ns) if exact else pytest.approx(usual_period(t_ns), rel=COARSE))
    steady, usual = steps[steps <= 60_000_000_000], steps[np.abs(steps - median) <= 0.5 * median]
    read = found.clock()
    assert read.rate_hz == pytest.approx(1e9 / usual.mean(), rel=1e-12)
    assert read.jitter_s == pytest.approx(steady.std() * 1e-9, rel=1e-9)
    assert read.largest_gap_s == steps.max() * 1e-9
    assert (read.first_ns, read.last_ns) == (t_ns[0], t_ns[-1])
    assert found.long_ns.tolist() == [steps.max()]
    assert found.sound


def test_a_histogram_takes_the_same_memory_for_any_number_of_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clock, "MAX_EXACT", 4096)
    steps = clock.Steps()
    for _ in range(20):
        steps.see(np.diff(late()))
    assert sum(map(len, steps._parts)) <= 4096
    assert steps.count == 20 * len(np.diff(late()))


def test_stamps_that_go_back_or_repeat_are_sorted() -> None:
    t_ns = late()
    mixed = t_ns.copy()
    mixed[[5, 6]] = mixed[[6, 5]]
    assert not seen(mixed).sound
    parts = [("/a", part) for part in np.array_split(mixed, 300)] + [("/b", t_ns), ("/b", t_ns[-1:])]
    (_, a), (count, b) = clocks(lambda topics: [part for part in parts if part[0] in topics], {"/a": COUNT, "/b": COUNT})
    assert a == seen(t_ns).clock()
    assert (count, b.largest_gap_s) == (len(t_ns) + 1, a.largest_gap_s)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_stamps_have_no_clock_or_one_step(count: int) -> None:
    ((_, read),) = clocks(lambda _: [("/a", START_NS + PERIOD_NS * np.arange(count))], {"/a": count})
    assert read.rate_hz == (200.0 if count == 2 else None)
    assert read.first_ns == (START_NS if count else None)


def test_stamps_in_batches_or_in_another_unit_are_not_sound() -> None:
    number = np.arange(4000)
    assert not seen(START_NS + PERIOD_NS * (number // 10 * 10 + 9) + 1000 * (number % 10)).sound
    even = START_NS + PERIOD_NS * number
    assert seen(even).sound
    assert not seen(even // 10**9 * 10**9 + even % 10**9 // 1000).sound  # microseconds where nanoseconds should be
