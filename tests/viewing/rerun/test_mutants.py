"""Wrongs that a viewer would hide are planted in what is logged, and each is caught by a test that looks at another thing."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr

from imutool.viewing.rerun import sdk
from tests.viewing.rerun import test_pixels

HERE = Path(__file__).parent

Plant = Callable[[pytest.MonkeyPatch], None]
SCALE, LATE_NS = 1.001, 1


def without(ending: str) -> Plant:
    """Nothing of the entities whose path ends so is ever sent."""

    def plant(patch: pytest.MonkeyPatch) -> None:
        for name in ("log", "send_columns"):
            patch.setattr(rr.RecordingStream, name, silent(getattr(rr.RecordingStream, name)))

    def silent(send: Any) -> Any:
        @wraps(send)
        def sent(self: Any, entity_path: Any, *rest: Any, **named: Any) -> None:
            if not str(entity_path).endswith(ending):
                send(self, entity_path, *rest, **named)

        return sent

    return plant


def scaled(patch: pytest.MonkeyPatch) -> None:
    """Every curve is a thousandth too high."""
    columns = rr.Scalars.columns
    patch.setattr(rr.Scalars, "columns", lambda *, scalars: columns(scalars=scalars * SCALE))


def late(timeline: str) -> Plant:
    """Every stamp on one timeline is a nanosecond late."""

    def plant(patch: pytest.MonkeyPatch) -> None:
        make = rr.TimeColumn.__init__

        def made(self: Any, name: str, **times: Any) -> None:
            late_by = np.timedelta64(LATE_NS if name == timeline else 0, "ns")
            make(self, name, **{kind: t + late_by for kind, t in times.items()})

        patch.setattr(rr.TimeColumn, "__init__", made)

    return plant


PATH, SERIES = without("world/debiased/path"), without("error/position/debiased")
MUTANTS = {"path dropped": PATH, "series dropped": SERIES, "scaled": scaled} | {
    f"late on {name}": late(name) for name in sdk.TIMELINES
}
CURVES_READ_BACK = "test_every_curve_reads_back_bit_for_bit_with_its_nanoseconds"
CATCHERS = {"path dropped": "test_the_file_holds_exactly_the_entities_it_should", "series dropped": CURVES_READ_BACK} | {
    name: CURVES_READ_BACK for name in MUTANTS if name not in ("path dropped", "series dropped")
}


class Outcomes:
    """What became of each test of a run within a test."""

    def __init__(self) -> None:
        self.failed: dict[str, str] = {}
        self.passed: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        name = report.nodeid.rpartition("::")[2]
        if report.failed:
            self.failed[name] = report.longreprtext
        elif report.when == "call":
            self.passed.append(name)


def run(name: str) -> Outcomes:
    """One test of test_scene.py, in this process, so that what is planted here is there."""
    found = Outcomes()
    alone = ["-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--override-ini", "addopts=--import-mode=importlib"]
    pytest.main([*alone, f"{HERE / 'test_scene.py'}::{name}"], plugins=[found])
    return found


@pytest.mark.parametrize("name", sorted(set(CATCHERS.values())))
def test_without_a_wrong_the_tests_pass(name: str) -> None:
    assert run(name).passed == [name]


@pytest.mark.parametrize("wrong", MUTANTS)
def test_a_wrong_in_what_is_logged_fails_the_test_that_reads_it_back(wrong: str, monkeypatch: pytest.MonkeyPatch) -> None:
    MUTANTS[wrong](monkeypatch)
    found = run(CATCHERS[wrong])
    assert list(found.failed) == [CATCHERS[wrong]]
    assert "AssertionError" in found.failed[CATCHERS[wrong]] or "KeyError" in found.failed[CATCHERS[wrong]]


def test_what_is_missing_is_missing_among_the_pixels(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Of a view in space and of one of curves, and of no other."""
    curves = test_pixels.curves_of(test_pixels.one_model, tmp_path)
    for plant in (PATH, SERIES):
        plant(monkeypatch)
    views, seen = test_pixels.drawn(test_pixels.one_model, 1)
    faults = [fault for view in views for fault in test_pixels.drawn_curves.unseen(view, seen[view.id], curves)]
    missing = ("/world/debiased/path", "/error/position/debiased")
    assert all(any(entity in fault for fault in faults) for entity in missing), faults
    assert all(any(entity in fault for entity in missing) for fault in faults), faults
