"""Rerun's own viewer draws what it is given: every curve of every view, in its colour, found among the pixels."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from imutool.recording import Recording
from imutool.view.rerun import layout, scene, viewer
from imutool.view.rundata import RunData, build

HERE = Path(__file__).parent
VIEWERS = SimpleNamespace(**runpy.run_path(str(HERE.parent / "viewers.py")))
CURVES = SimpleNamespace(**runpy.run_path(str(HERE / "curves.py")))
APART = SimpleNamespace(**runpy.run_path(str(HERE / "apart.py")))

WINDOW = (1600, 1000)
INK = 400  # pixels that differ from the ground, the least of a view that says anything


def one_model() -> list[RunData]:
    made = APART.recording()
    return [build(made, APART.runs(made))]


def nothing_known() -> list[RunData]:
    """A log without truth, read as it is."""
    made = replace(APART.recording(), truths={}, scalars={})
    return [build(made, APART.runs(APART.recording())[:1])]


@pytest.mark.parametrize("case", [one_model, nothing_known], ids=lambda case: case.__name__)
def test_every_view_draws_every_curve_it_holds(case: Callable[[], list[RunData]], tmp_path: Path) -> None:
    logs = case()
    viewer.show(logs, save=tmp_path / "drawn.rrd")
    curves, blueprint = CURVES.curves(tmp_path / "drawn.rrd"), layout.blueprint(logs[0])

    def look(running: Any) -> dict[Any, np.ndarray]:
        return CURVES.pictures(running, blueprint, lambda to: scene.log(logs[0], to), logs[0].duration_s)

    seen = VIEWERS.seen(look, WINDOW)
    views = CURVES.leaves(blueprint.root_container)
    assert [fault for view in views for fault in CURVES.unseen(view, seen[view.id], curves)] == []
    assert [view.name for view in views if ink(seen[view.id]) < INK] == []


def ink(picture: np.ndarray) -> int:
    """How many pixels are not the ground."""
    ground = np.median(picture[::5, ::5].reshape(-1, 3), axis=0)
    return int((np.abs(picture - ground).max(axis=-1) > 40).sum())
