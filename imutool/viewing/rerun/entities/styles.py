"""Colours, line widths and styles of curves, paths and bodies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from imutool.array_types import Float64, UInt8
from imutool.units import AXES
from imutool.viewing.model.run_data import RunData, Trace
from imutool.viewing.rerun import rr
from imutool.viewing.rerun.sdk import Role

Color = tuple[int, int, int]

XYZ: tuple[Color, ...] = ((230, 60, 60), (40, 170, 70), (60, 120, 240))  # the same three everywhere, on dark and light
GREY: Color = (128, 128, 128)
TRUTH_COLOR: Color = (150, 150, 150)
RAW_COLOR: Color = (230, 110, 20)
# Okabe and Ito's colour-blind safe palette; orange belongs to raw.
MODEL_COLORS: tuple[Color, ...] = ((30, 140, 230), (0, 158, 115), (204, 121, 167), (139, 85, 246))
COLOR_NAMES = ("blue", "green", "pink", "purple")
WORST_COLOR: Color = (240, 60, 140)
EVENT_COLOR: Color = (230, 167, 0)
BACKGROUND: Color = (24, 26, 30)  # of spatial views, also in a light viewer: the error colours are chosen for it
INK: Color = (255, 255, 255)  # of labels: a light viewer lays a grey box under them, a dark one a black box
GRID: Color = (70, 72, 78)
RAW_WIDTH, BOLD_WIDTH = 1.0, 2.0
RAW_FADE, TRUE_FADE, NEXT_MODEL_FADE = 0.6, 0.45, 0.3  # how far a colour goes towards grey
PATH_RADII = {"gt": 1.0, "raw": 0.7, "debiased": 2.0}  # screen points, at every distance
LABEL_SIDES = {"gt": 1.0, "raw": 0.6, "debiased": -1.0}  # label height above the body, so that labels do not cover each other
AXIS_SHARE = 0.1  # length of a body's axes over the size of the scene

# Viridis (van der Walt and Smith) from a quarter up: perceptually even, and its darkest blue stands out from the background.
HEAT = np.array(
    [(59, 82, 139), (44, 114, 142), (33, 145, 140), (40, 174, 128), (94, 201, 98), (173, 220, 48), (253, 231, 37)], dtype=float
)


def color_of(data: RunData, trace: Trace) -> Color:
    """Colour of a run's path and total error; raw always has the same one."""
    return RAW_COLOR if trace.is_raw else MODEL_COLORS[data.models().index(trace) % len(MODEL_COLORS)]


def color_name(data: RunData, trace: Trace) -> str:
    """Name of a run's colour, for titles."""
    return "orange" if trace.is_raw else COLOR_NAMES[data.models().index(trace) % len(COLOR_NAMES)]


def axis_colors(rank: int) -> list[Color]:
    """Red, green and blue; greyer for each further model."""
    return [blend_to_grey(color, min(NEXT_MODEL_FADE * rank, 0.75)) for color in XYZ]


def blend_to_grey(color: Color, share: float) -> Color:
    """Blend a colour with grey, which is pale on dark and light backgrounds alike."""
    red, green, blue = (round(c + share * (g - c)) for c, g in zip(color, GREY, strict=True))
    return red, green, blue


def heat_colors(values: Float64[np.ndarray, " n"], top: float) -> UInt8[np.ndarray, "n 3"]:
    """Colour of each value from 0 to `top`: grey for NaN, the last colour above `top`."""
    position = np.clip(values / top, 0.0, 1.0) * (len(HEAT) - 1)
    finite = np.isfinite(position)
    steps = np.arange(len(HEAT))
    colors = np.stack([np.interp(np.where(finite, position, 0.0), steps, channel) for channel in HEAT.T], axis=1)
    return np.where(finite[:, None], np.rint(colors), GREY).astype(np.uint8)


def curves(names: Sequence[str], colors: Sequence[Color], width: float) -> rr.SeriesLines:
    """Style of one curve per name; draws the extremes per pixel instead of the mean."""
    return line_style(names, colors, [width] * len(names))


def line_style(names: Sequence[str], colors: Sequence[Color], widths: Sequence[float]) -> rr.SeriesLines:
    """Style of curves of different widths; a mean per pixel would make noise look smaller."""
    extremes = rr.components.AggregationPolicy.MinMax
    return rr.SeriesLines(names=list(names), colors=list(colors), widths=list(widths), aggregation_policy=extremes)


def axis_curves(role: Role, names: Sequence[str], *, rank: int = 0, alone: bool = False) -> rr.SeriesLines:
    """Style of three curves: raw thin and pale unless `alone`, each further model greyer."""
    if role == "raw" and not alone:
        return curves(names, [blend_to_grey(color, RAW_FADE) for color in axis_colors(rank)], RAW_WIDTH)
    return curves(names, axis_colors(rank), BOLD_WIDTH)


def axis_names(name: str, axes: Sequence[str] = AXES) -> list[str]:
    """Names of the curves of one run."""
    return [f"{axis} {name}" for axis in axes]


def true_bias_curves() -> rr.SeriesLines:
    """Style of three broad pale curves, on which a correct estimate lies."""
    return curves(axis_names("true"), [blend_to_grey(color, TRUE_FADE) for color in XYZ], 2.0 * BOLD_WIDTH)


def sigma_curves(rank: int = 0) -> rr.SeriesLines:
    """Style of six thin curves: three standard deviations above the estimate, and three below."""
    names = [f"{axis} estimated {sign}3σ" for sign in "+-" for axis in AXES]
    return curves(names, [blend_to_grey(color, RAW_FADE) for color in axis_colors(rank)] * 2, RAW_WIDTH)


def total_error_curve(role: Role, name: str, color: Color) -> rr.SeriesLines:
    """Style of one curve in the run's colour, thin for raw."""
    return curves([name], [color], RAW_WIDTH if role == "raw" else BOLD_WIDTH)


def path_style(role: str, color: Color | None) -> rr.LineStrips3D:
    """Width of a path (`gt`, `raw` or `debiased`) and its colour, if it has only one."""
    radii = rr.Radius.ui_points([PATH_RADII[role]])
    return rr.LineStrips3D.from_fields(radii=radii, colors=None if color is None else [color])


def body_style(role: str, name: str, color: Color, size_m: float) -> list[rr.AsComponents]:
    """Axes that move with a body, a dot at its position and a label."""
    length = AXIS_SHARE * size_m
    label = [0.0, 0.0, 1.3 * length * LABEL_SIDES[role]]
    dots = rr.Points3D(
        [[0.0, 0.0, 0.0], label],
        colors=[color, INK],
        radii=rr.Radius.ui_points([4.0, 0.0]),
        labels=["", name],
        show_labels=True,
    )
    return [rr.TransformAxes3D(axis_length=length), dots]


def state_style(label: str, color: Color) -> rr.StateConfiguration:
    """Style of a lane of states that is visible only inside an interval."""
    return rr.StateConfiguration(values=list(STATES), labels=[label, ""], colors=[color, GREY], visible=[True, False])


STATES = INSIDE, OUTSIDE = ("here", "elsewhere")


def state_changes(intervals_ns: Sequence[tuple[int, int]], start_ns: int) -> tuple[list[int], list[str]]:
    """Times and states at the ends of sorted intervals; overlapping intervals become one."""
    merged: list[tuple[int, int]] = []
    for first, last in intervals_ns:
        if merged and first <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(merged[-1][1], last))
        else:
            merged.append((first, last))
    times = [start_ns] if not merged or merged[0][0] > start_ns else []
    states = [OUTSIDE] * len(times) + [INSIDE, OUTSIDE] * len(merged)
    return [*times, *(time for interval in merged for time in interval)], states
