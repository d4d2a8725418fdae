"""Findings list the first of many intervals and count all; the score takes each kind once."""

from __future__ import annotations

import numpy as np
import pytest

from imutool.cleaning.finding import JOIN, MAX_INTERVALS, Finding, Intervals, score

PERIOD_NS = 5_000_000


def test_intervals_beyond_those_listed_are_counted_whatever_the_blocks() -> None:
    number = np.concatenate([np.arange(5) + 2 * JOIN * k for k in range(MAX_INTERVALS + 20)])
    whole, parts = Intervals(), Intervals()
    whole.add(number, PERIOD_NS * number)
    for part in np.array_split(number, 37):  # which cut intervals in two
        parts.add(part, PERIOD_NS * part)
    assert whole.where() == parts.where()
    assert (whole.count, len(whole.intervals), whole.left_out) == (len(number), MAX_INTERVALS, 20)
    assert whole.intervals[1] == (2 * JOIN * PERIOD_NS, (2 * JOIN + 4) * PERIOD_NS)
    finding = Finding("gaps", "note", "gaps", **whole.where())
    assert finding.when(0) == f"0.000–0.020, 0.640–0.660, 1.280–1.300 and {MAX_INTERVALS + 20 - 3} more"


def test_the_score_is_the_share_of_valid_samples_less_each_kind_of_finding_once() -> None:
    twice = [Finding("saturation", "warning", f"on {axis}", 1) for axis in "xy"]
    dropped = Finding("spikes", "warning", "spikes", 1, action="dropped")
    assert score(90, 81, 10, [*twice, dropped, Finding("gaps", "note", "gaps", 1)]) == pytest.approx(0.81 * 0.95 * 0.98)
    assert score(0, 0, 0, []) == 0.0
