"""The page about a fleet: its labels can be read, and what it says of logs is whole."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from imutool.fleet import page
from imutool.fleet.results import Statistics
from imutool.fleet.task import Result, Settings
from imutool.viewing.html import drawing

LETTER = 6.0  # pixels between two numbers: a browser has another font


def test_what_is_said_of_logs_counts_without_their_topics_and_stays_whole() -> None:
    statistics = Statistics()
    for topic in ("/imu0", "/imu1"):
        said = (f"{topic}: 4 samples missing", "the record at byte 956 is damaged: it says it has 190982 bytes")
        statistics.add(Result(key=topic, source=topic, target="", status="ok", warnings=said))
    assert statistics.warnings == {"4 samples missing": 2, "the record at byte 956 is damaged: it says it has 190982 bytes": 2}
    assert statistics.first_warned["4 samples missing"] == "imu0"  # of a warning alone nobody knows the log


def test_of_logs_with_one_name_the_folder_says_which_was_warned_of() -> None:
    results = [
        Result(key=robot, source=f"/fleet/{robot}/log.mcap", target=f"{robot}/log.json", status="ok", warnings=said)
        for robot, said in (("robot_a", ()), ("robot_b", ("4 samples missing",)))
    ]
    assert "<td>robot_b/log</td>" in page.html(results, Settings(command="info"), seconds=1.0, source="fleet")


def test_of_logs_that_are_not_whole_the_common_folder_stands_once() -> None:
    places = [f"/fleet/{robot}/log.mcap" for robot in ("robot_a", "robot_b")]
    results = [
        Result(key=place, source=place, target="", status="failed", error=f"{place}: the file is empty") for place in places
    ]
    said = page.html(results, Settings(command="info"), seconds=1.0, source="logs")
    assert said.count("/fleet/") == 1
    assert all(f">{robot}/log.mcap<" in said for robot in ("robot_a", "robot_b"))
    assert said.count(">the file is empty<") == 2


def test_the_page_of_a_diagnosis_says_what_it_takes_to_do_it_again() -> None:
    settings = Settings(command="diagnose", robot_from=r"^(\w+)/", sim="/sims", imu=("/imu1",), truth="/mocap")
    said = page.html([], settings, seconds=1.0, source="logs")
    assert all(f"<dd>{words}</dd>" in said for words in (r"^(\w+)/", "/sims", "/imu1", "/mocap"))


def test_without_a_model_there_is_no_digest_of_one() -> None:
    said = page.html([], Settings(command="debias", model_sha256="0123"), seconds=1.0, source="logs")
    assert "as each log says" in said
    assert "0123" not in said


def test_the_numbers_below_the_histograms_do_not_overlap(monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn: list[Any] = []

    def svg(draw: Callable[[Any], None], height: float, name: str) -> str:
        with drawing._inked(drawing.PLACEHOLDER_COLORS, name):
            figure = Figure(figsize=(drawing.WIDTH_INCH, height))
            FigureCanvasAgg(figure).draw()
            draw(figure)
            figure.canvas.draw()
        drawn.append(figure)
        return ""

    monkeypatch.setattr(page, "svg", svg)
    for rows in (
        [[0.0097, -0.02006, 0.005], [0.0101, -0.01985, 0.03]],
        [[-5e-4, -2.1e-4, -0.1], [0.0, 0.0, 0.0]],
        [[-123.4, 1e-7, -7.0], [-123.1, 2.5e-7, 9.0]],
    ):
        page._axes(np.array(rows), "gyro bias (rad/s)")
    assert len(drawn) == 3
    for figure in drawn:
        for axes in figure.axes:
            low, high = axes.get_xlim()
            labels = [
                label
                for at, label in zip(axes.get_xticks(), axes.get_xticklabels(), strict=True)
                if low <= at <= high and label.get_text()
            ]
            boxes = [label.get_window_extent() for label in labels]
            assert boxes
            assert all(left.x1 + LETTER < right.x0 for left, right in pairwise(boxes)), [label.get_text() for label in labels]


def test_a_histogram_of_what_cannot_be_negative_ends_at_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib.figure import Figure

    figure = Figure()
    monkeypatch.setattr(page, "svg", lambda draw, height, name: draw(figure))
    monkeypatch.setattr(page, "AFTER", "red")  # `svg` puts in the colour
    page._histograms([([0.1, 40.0, 60.0], "seconds a log"), ([50.0, 55.0, 60.0], "MB/s of one worker")], "times")
    near, far = (axes.get_xlim()[0] for axes in figure.axes)
    assert near == 0.0
    assert 0.0 < far < 50.0


@pytest.mark.parametrize("value", [-0.0137, 0.0, 9.8])
def test_a_histogram_of_equal_values_is_as_wide_as_they_are_large(value: float) -> None:
    """Starts of logs without a rest are all those of the model's training."""
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    page._histogram(axes, value * (1.0 + 1e-15 * np.arange(27)), "x: gyro bias (rad/s)", "red")
    first, last = axes.get_xlim()
    assert first < value < last
    assert last - first <= 1.5 * (abs(value) or 1.0)
    assert sum(bar.get_height() for bar in axes.patches) == 27
