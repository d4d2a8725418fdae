"""A drawing with few points has the extremes, the ends and the holes of the whole line."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imutool.viewing.model.decimation import curve_rows, path_rows


@settings(max_examples=60, deadline=None)
@given(n=st.integers(1, 3000), k=st.integers(1, 6), more=st.integers(0, 500), seed=st.integers(0, 2**32 - 1))
def test_a_thinned_curve_has_every_column_s_extremes_and_its_ends(n: int, k: int, more: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    maximum = 2 * k + 3 + more
    values = rng.normal(size=(n, k))
    values[rng.integers(0, n)] = 100.0
    rows = curve_rows(values, maximum)
    assert len(rows) <= max(maximum, 0)
    assert (np.diff(rows) > 0).all()
    assert rows[0] == 0
    assert rows[-1] == n - 1
    assert np.array_equal(values[rows].max(axis=0), values.max(axis=0))
    assert np.array_equal(values[rows].min(axis=0), values.min(axis=0))


def test_every_bucket_keeps_its_own_extremes() -> None:
    n, maximum = 100_000, 2000
    values = np.random.default_rng(0).normal(size=(n, 3))
    rows = curve_rows(values, maximum)
    size = -(-n // ((maximum - 2) // 7))
    for first in range(0, n, size):
        inside = rows[(rows >= first) & (rows < first + size)]
        assert np.array_equal(values[inside].max(axis=0), values[first : first + size].max(axis=0))
        assert np.array_equal(values[inside].min(axis=0), values[first : first + size].min(axis=0))


def test_a_hole_stays_a_hole_and_hides_no_extreme() -> None:
    values = np.sin(np.linspace(0.0, 50.0, 10_000))[:, None].repeat(2, axis=1)
    values[5_000:5_003] = np.nan
    values[7_000:9_000, 1] = np.nan  # one column alone
    values[4_999] = 9.0
    rows = curve_rows(values, 500)
    assert np.isnan(values[rows]).any(axis=1).any()
    between = rows[(rows >= 5_000) & (rows < 5_003)]
    assert len(between) == 1
    assert 4_999 in rows
    assert np.isnan(values[rows[(rows > 7_100) & (rows < 8_900)], 1]).any()
    everything = np.full((1000, 1), np.nan)
    assert np.isnan(everything[curve_rows(everything, 50)]).all()


def test_a_short_curve_is_whole() -> None:
    assert np.array_equal(curve_rows(np.zeros((1000, 3)), 1000), np.arange(1000))
    assert np.array_equal(path_rows(np.zeros((1000, 3)), 1000), np.arange(1000))
    assert len(curve_rows(np.zeros((0, 3)))) == 0


@pytest.mark.parametrize("maximum", [10, 101, 1000])
def test_what_is_left_out_of_a_path_is_near_what_is_drawn_in_time_and_along_it(maximum: int) -> None:
    n = 20_000
    steps = np.random.default_rng(1).normal(size=(n, 3))
    steps[5_000:9_000] = 0.0  # at rest
    steps[15_000:15_100] *= 500.0  # and suddenly away
    p_wb = np.cumsum(steps, axis=0)
    rows = path_rows(p_wb, maximum)
    assert rows[0] == 0
    assert rows[-1] == n - 1
    assert len(rows) <= maximum
    assert (np.diff(rows) > 0).all()
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p_wb, axis=0), axis=1))])
    before = rows[np.searchsorted(rows, np.arange(n), side="right") - 1]
    share = 2.0 / (maximum - 2)
    assert (travelled - travelled[before]).max() <= share * travelled[-1]
    assert (np.arange(n) - before).max() <= share * n + 1


def test_a_path_that_never_moves_is_thinned_too() -> None:
    rows = path_rows(np.ones((5000, 3)), 100)
    assert len(rows) <= 100
    assert {0, 4999} <= set(rows.tolist())


def test_a_path_whose_length_overflows_is_thinned_too() -> None:
    with np.errstate(over="ignore"):
        rows = path_rows(np.linspace(0.0, 1e200, 5000)[:, None] * np.ones(3), 100)
    assert len(rows) <= 100
    assert {0, 4999} <= set(rows.tolist())
