"""Rerun's own viewer draws what it is given: every curve of every view, in its colour, found among the pixels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import drawn_curves, image_difference, saved_rrd, viewers

from imutool.viewing.model.load_view import build
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import layout, scene

HERE = Path(__file__).parent

WINDOW, WIDE = (1280, 800), (1600, 1000)  # the second for what lies close together
INK = 400  # pixels that differ from the ground, the least of a view that says anything


def one_model() -> list[RunData]:
    made = image_difference.recording()
    return [build(made, image_difference.runs(made))]


def nothing_known() -> list[RunData]:
    """A log without truth, read as it is."""
    made = replace(image_difference.recording(), truths={}, scalars={})
    return [build(made, image_difference.runs(made, models=0))]


def two_models() -> list[RunData]:
    made = image_difference.recording()
    return [build(made, image_difference.runs(made, models=2))]


def two_logs() -> list[RunData]:
    made = [image_difference.recording(seed) for seed in (3, 4)]
    return [build(one, image_difference.runs(one)) for one in made]


EVERYTHING = None  # tabs
CASES = {one_model: EVERYTHING, nothing_known: EVERYTHING, two_models: 2, two_logs: 2}


def curves_of(case: Callable[[], list[RunData]], folder: Path) -> list[Any]:
    """Every curve that is logged."""
    path = saved_rrd.written(case(), folder / "logged.rrd")
    found: list[Any] = drawn_curves.curves(path)
    return found


def drawn(case: Callable[[], list[RunData]], tabs: int | None) -> tuple[list[Any], dict[Any, np.ndarray]]:
    """The views behind the first so many tabs, and their pictures."""
    logs = case()
    blueprint = layout.blueprint(logs)

    def look(running: Any) -> dict[Any, np.ndarray]:
        return drawn_curves.pictures(running, blueprint, lambda to: scene.log(logs, to), logs[0].duration_s, tabs)

    seen = viewers.seen(look, WINDOW if tabs is EVERYTHING else WIDE)
    return [view for view in saved_rrd.views(blueprint) if view.id in seen], seen


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_every_view_draws_every_curve_it_holds(case: Callable[[], list[RunData]], tmp_path: Path) -> None:
    curves = curves_of(case, tmp_path)
    views, seen = drawn(case, CASES[case])
    assert [fault for view in views for fault in drawn_curves.unseen(view, seen[view.id], curves)] == []
    assert [view.name for view in views if ink(seen[view.id]) < INK] == []


def ink(picture: np.ndarray) -> int:
    """How many pixels are not the ground."""
    ground = np.median(picture[::5, ::5].reshape(-1, 3), axis=0)
    return int((np.abs(picture - ground).max(axis=-1) > 40).sum())
