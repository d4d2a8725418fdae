"""Wrongs that a viewer would hide are planted in what is logged, and each is caught by a test that looks at another thing."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rerun as rr
from support import saved_rrd

from imutool.recording import Recording
from imutool.viewing.model.load_view import build
from imutool.viewing.model.run_data import Run, RunData
from imutool.viewing.rerun import sdk
from tests.viewing.rerun import test_pixels, test_scene

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
ENTITIES, CURVES = (
    test_scene.test_the_file_holds_exactly_the_entities_it_should,
    test_scene.test_every_curve_reads_back_bit_for_bit_with_its_nanoseconds,
)
MUTANTS = {"path dropped": (PATH, ENTITIES), "series dropped": (SERIES, CURVES), "scaled": (scaled, CURVES)} | {
    f"late on {name}": (late(name), CURVES) for name in sdk.TIMELINES
}


@pytest.fixture
def read_back(recording: Recording, runs: list[Run], tmp_path: Path) -> Callable[[], tuple[RunData, SimpleNamespace]]:
    """Writes what test_scene.py looks at, and reads it back."""
    one = test_scene.filled(build(recording, [runs[0], runs[2]]))
    return lambda: (one, SimpleNamespace(all=saved_rrd.read(saved_rrd.written([one], tmp_path / "one.rrd"))))


def test_without_a_wrong_the_tests_pass(read_back: Callable[[], tuple[RunData, SimpleNamespace]]) -> None:
    found = read_back()
    for test in (ENTITIES, CURVES):
        test(*found)


@pytest.mark.parametrize("wrong", MUTANTS)
def test_a_wrong_in_what_is_logged_fails_the_test_that_reads_it_back(
    wrong: str, read_back: Callable[[], tuple[RunData, SimpleNamespace]], monkeypatch: pytest.MonkeyPatch
) -> None:
    plant, catcher = MUTANTS[wrong]
    plant(monkeypatch)
    found = read_back()
    with pytest.raises((AssertionError, KeyError)):
        catcher(*found)


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
