"""The steps in which a gyro counts are found, and the cheap first look leaves out none of them."""

from __future__ import annotations

import numpy as np
import pytest

from imutool.recording.gyro_steps import MAX_OFF, STEPS, _counts_in, _likely, unit_by_steps


@pytest.mark.parametrize(("unit", "step"), STEPS)
@pytest.mark.parametrize("decimals", [3, 7, None])  # of a step, as a text or a float32 rounds them
def test_the_first_look_keeps_every_step_that_counts(unit: str, step: float, decimals: int | None) -> None:
    rng = np.random.default_rng(0)
    counts = rng.normal(scale=30.0, size=(400, 3)).round() + np.array([0.0, 0.3, 1000.5])
    rates = step * (counts if decimals is None else counts.round(decimals))
    ordered = [np.sort(axis) for axis in rates.T]
    likely = list(_likely(ordered, np.array([size for _, size in STEPS])))
    found = [_counts_in(ordered, size) for _, size in STEPS]
    assert any(found)
    assert not any(counted and not kept for counted, kept in zip(found, likely, strict=True))


@pytest.mark.parametrize("rates", [np.zeros((0, 3)), np.zeros((1, 3)), np.ones((50, 3)), np.full((20, 3), np.nan)])
def test_values_without_a_neighbour_show_no_unit(rates: np.ndarray) -> None:
    assert unit_by_steps(rates) is None


def test_noise_has_no_steps() -> None:
    rates = np.random.default_rng(1).normal(size=(4000, 3))
    assert unit_by_steps(rates) is None
    assert sum(_likely([np.sort(axis) for axis in rates.T], np.array([step for _, step in STEPS]))) < len(STEPS) / 2


@pytest.mark.parametrize(("step", "unit"), [(2000.0 / 2**15, "deg/s"), (np.deg2rad(1.0 / 16.4), "rad/s")])
def test_a_fast_motion_counts_in_whole_steps_though_few_values_are_near_its_median(step: float, unit: str) -> None:
    counts = np.random.default_rng(2).normal(scale=8000.0, size=(500, 3)).round()
    assert unit_by_steps(step * counts) == (unit, pytest.approx(step))
    assert unit_by_steps(step * (counts + 0.3)) is None, "between the steps"
    assert unit_by_steps(step * 7.0 * counts) is None, "a multiple of them"
    assert unit_by_steps(step * counts[:50]) is None, "few values"
    assert unit_by_steps(step * 50.0 * counts) is None, "more than a register holds"


def test_a_calm_motion_counts_in_steps_about_an_offset() -> None:
    """As of a bias that was taken off: its values are no whole steps."""
    step = np.deg2rad(1.0 / 16.4)
    counts = np.random.default_rng(3).normal(scale=20.0, size=(2000, 3)).round() + np.array([0.0, 0.3, -0.4])
    assert unit_by_steps(step * counts) == ("rad/s", pytest.approx(step, rel=MAX_OFF))
