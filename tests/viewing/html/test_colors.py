"""Colours of the runs differ for colour-blind eyes too, on the pages and in the viewer."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from imutool.noise import allan
from imutool.noise_identification import CurveSource
from imutool.units import AXES, SENSORS
from imutool.viewing.html import allan_plot, drawing
from imutool.viewing.html.page import DARK, LIGHT
from imutool.viewing.rerun.entities.styles import MODEL_COLORS, RAW_COLOR

DIFFERENT = 10.0  # CIE 1976 colour difference; one of 2.3 is just noticeable
RUNS = ("before", "after", "second", "third", "fourth")
# linear RGB as it is seen without one kind of cone: Machado, Oliveira, Fernandes 2009, table of severity 1
EYES = {
    "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritan": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
    "all three": np.eye(3).tolist(),
}
XYZ_OF_RGB = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def lab(rgb: np.ndarray, eye: str) -> np.ndarray:
    """CIE L*a*b* of an sRGB colour from 0 to 1, as an eye sees it."""
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz = XYZ_OF_RGB @ np.clip(np.array(EYES[eye]) @ linear, 0.0, 1.0) / XYZ_OF_RGB.sum(axis=1)
    root = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16.0 / 116.0)
    return np.array([116.0 * root[1] - 16.0, 500.0 * (root[0] - root[1]), 200.0 * (root[1] - root[2])])


@pytest.mark.parametrize("eye", EYES)
def test_no_two_runs_have_one_colour(eye: str) -> None:
    light, dark = ([tuple(bytes.fromhex(colors[name][1:])) for name in RUNS] for colors in (LIGHT, DARK))
    for colors in (light, dark, [RAW_COLOR, *MODEL_COLORS]):
        seen = [lab(np.array(color) / 255.0, eye) for color in colors]
        assert min(float(np.linalg.norm(a - b)) for a, b in combinations(seen, 2)) > DIFFERENT


def test_the_axes_of_an_allan_deviation_differ_without_their_colours() -> None:
    from matplotlib.figure import Figure

    figure, still = Figure(), np.random.default_rng(0).normal(size=(4000, 3))
    curves = dict.fromkeys(SENSORS, allan.curve([still], 0.005))
    with drawing._inked(drawing.LIGHT_COLORS, "allan"):
        allan_plot._draw(figure, source=CurveSource.of("at rest", 20.0, curves), sensor="gyro")
    (axes,) = figure.axes
    marks = {container.get_label(): container.lines[0].get_marker() for container in axes.containers}
    assert set(marks) == set(AXES)
    assert len(set(marks.values())) == len(AXES)
