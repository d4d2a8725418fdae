"""The colours and widths of every picture in the viewer: axes are red, green and blue, raw is thin, a model bold."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, UInt8

from imutool.viewing.model.run_data import RunData, Trace

Color = tuple[int, int, int]

XYZ: tuple[Color, ...] = ((230, 60, 60), (40, 170, 70), (60, 120, 240))  # the same three everywhere, on dark and light
GREY: Color = (128, 128, 128)
TRUTH_COLOR: Color = (150, 150, 150)
RAW_COLOR: Color = (230, 110, 20)
# Okabe and Ito's palette, told apart by colour-blind eyes too; orange belongs to raw.
MODEL_COLORS: tuple[Color, ...] = ((30, 140, 230), (0, 158, 115), (204, 121, 167), (190, 160, 0))
COLOR_NAMES = ("blue", "green", "pink", "yellow")
WORST_COLOR: Color = (240, 60, 140)
EVENT_COLOR: Color = (230, 167, 0)
GROUND: Color = (24, 26, 30)  # of drawings in space, in a light viewer too: the colours of errors are chosen for it
INK: Color = (255, 255, 255)  # of words in them: a light viewer lays a grey box under words, a dark one a black box
GRID: Color = (70, 72, 78)
RAW_WIDTH, BOLD_WIDTH = 1.0, 2.0
RAW_FADE, TRUE_FADE, NEXT_MODEL_FADE = 0.6, 0.45, 0.3  # how far a colour goes towards grey

# Viridis (van der Walt and Smith) from a quarter up: perceptually even, and its darkest blue still stands out from the ground.
HEAT = np.array(
    [(59, 82, 139), (44, 114, 142), (33, 145, 140), (40, 174, 128), (94, 201, 98), (173, 220, 48), (253, 231, 37)], dtype=float
)


def color_of(data: RunData, trace: Trace) -> Color:
    """The colour of a run's path and total error; raw always has the same one."""
    if trace.is_raw:
        return RAW_COLOR
    return MODEL_COLORS[data.models().index(trace) % len(MODEL_COLORS)]


def color_name(data: RunData, trace: Trace) -> str:
    """The same in a word, for titles."""
    return "orange" if trace.is_raw else COLOR_NAMES[data.models().index(trace) % len(COLOR_NAMES)]


def axis_colors(rank: int = 0) -> list[Color]:
    """Red, green and blue; of each further model a little greyer, so that several can be told apart in one plot."""
    return [faded(color, min(NEXT_MODEL_FADE * rank, 0.75)) for color in XYZ]


def faded(color: Color, share: float) -> Color:
    """A colour moved towards grey: faint on a dark and on a light ground alike, which transparency is not."""
    red, green, blue = (round(c + share * (g - c)) for c, g in zip(color, GREY, strict=True))
    return red, green, blue


def heat(values: Float64[np.ndarray, " n"], top: float) -> UInt8[np.ndarray, "n 3"]:
    """The colour of each value between 0 and `top`; grey where it is NaN, the last colour above."""
    place = np.clip(values / top, 0.0, 1.0) * (len(HEAT) - 1)
    known = np.isfinite(place)
    steps = np.arange(len(HEAT))
    colors = np.stack([np.interp(np.where(known, place, 0.0), steps, channel) for channel in HEAT.T], axis=1)
    return np.where(known[:, None], np.rint(colors), GREY).astype(np.uint8)


def end_of_scale(highest: float) -> float:
    """The next number of the form 1, 2 or 5 times a power of ten, so that a legend has numbers that can be read."""
    decade = 10.0 ** np.floor(np.log10(highest)) if highest > 0.0 else 1.0
    return float(next(step for step in (1.0, 2.0, 5.0, 10.0) if step * decade >= highest * (1.0 - 1e-9)) * decade)
