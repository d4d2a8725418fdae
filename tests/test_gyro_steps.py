"""The steps in which a gyro counts are found, and the cheap first look leaves out none of them."""

from __future__ import annotations

import numpy as np
import pytest

from imutool.recording.gyro_steps import STEPS, _counts_in, _likely, unit_by_steps


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
