"""The picture on paper: its size, its dependence on the data, and its refusals."""

from __future__ import annotations

import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from imutool.errors import ConfigError, DataError
from imutool.recording import Recording
from imutool.view import report
from imutool.view.rundata import Run, RunData, build


def size(png: bytes) -> tuple[int, int]:
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", png[16:24])
    return width, height


def pixels(png: bytes) -> np.ndarray:
    import io

    from matplotlib.image import imread

    image: np.ndarray = imread(io.BytesIO(png))[:, :, :3]
    return image


def painted(png: bytes, color: str) -> int:
    """How many pixels have exactly this colour."""
    wanted = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    return int((np.abs(pixels(png) - wanted).max(axis=2) < 1e-3).sum())


def test_it_is_a_sharp_png_with_every_run_in_its_colour(data: RunData, tmp_path: Path) -> None:
    report.error_curves(data, tmp_path / "errors.png")
    png = (tmp_path / "errors.png").read_bytes()
    assert size(png) == (2560, 1440)
    # A legend handle of one run is about 300 pixels; a curve in two or five panels is thousands.
    for color in (report.RAW_COLOR, *report.MODEL_COLORS[:2], report.TRUE_COLOR):
        assert painted(png, color) > 2000, color


def test_other_data_give_another_picture_and_the_same_data_the_same(
    recording: Recording, runs: list[Run], data: RunData
) -> None:
    worse = replace(runs[1], imu=replace(runs[1].imu, gyro=runs[1].imu.gyro + 0.01))
    assert report.png(data) == report.png(data)
    assert report.png(build(recording, [runs[0], worse, runs[2]])) != report.png(data)


def test_without_truth_the_biases_are_drawn_and_raw_is_not(recording: Recording, runs: list[Run]) -> None:
    png = report.png(build(replace(recording, truths={}), runs))
    assert size(png) == (2560, 1440)
    assert painted(png, report.MODEL_COLORS[0]) > 2000
    assert painted(png, report.RAW_COLOR) == 0


def test_without_a_model_the_errors_are_drawn_alone(recording: Recording, runs: list[Run]) -> None:
    png = report.png(build(recording, runs[:1]))
    assert painted(png, report.RAW_COLOR) > 2000
    assert painted(png, report.MODEL_COLORS[0]) == 0


def test_with_neither_there_is_nothing_to_draw(recording: Recording, runs: list[Run], tmp_path: Path) -> None:
    with pytest.raises(DataError, match="neither truth nor a model"):
        report.error_curves(build(replace(recording, truths={}), runs[:1]), tmp_path / "errors.png")
    assert not list(tmp_path.iterdir())


def test_an_existing_picture_is_kept(data: RunData, tmp_path: Path) -> None:
    (tmp_path / "errors.png").write_bytes(b"mine")
    with pytest.raises(ConfigError, match="exists"):
        report.error_curves(data, tmp_path / "errors.png")
    assert (tmp_path / "errors.png").read_bytes() == b"mine"


def test_a_missing_matplotlib_says_how_to_get_it(data: RunData, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ConfigError, match=r"pip install 'imutool\[report\]'"):
        report.png(data)


def test_importing_the_views_costs_no_viewer_no_plotting_and_no_torch() -> None:
    code = (
        "import sys, imutool.view.rundata, imutool.view.rerun.viewer, imutool.view.report\n"
        "print(sorted({'torch', 'rerun', 'matplotlib'} & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
