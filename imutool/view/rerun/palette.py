"""The colours and widths of every picture in the viewer: axes are red, green and blue, raw is thin, a model bold."""

from __future__ import annotations

from imutool.view.rundata import RunData, Trace

Color = tuple[int, int, int]

AXES = ("x", "y", "z")
XYZ: tuple[Color, ...] = ((230, 60, 60), (40, 170, 70), (60, 120, 240))  # the same three everywhere, on dark and light
GREY: Color = (128, 128, 128)
TRUTH_COLOR: Color = (150, 150, 150)
RAW_COLOR: Color = (230, 110, 20)
# Okabe and Ito's palette, told apart by colour-blind eyes too; orange belongs to raw.
MODEL_COLORS: tuple[Color, ...] = ((30, 140, 230), (0, 158, 115), (204, 121, 167), (190, 160, 0))
RAW_WIDTH, BOLD_WIDTH = 1.0, 2.0
RAW_FADE, TRUE_FADE, NEXT_MODEL_FADE = 0.6, 0.45, 0.3  # how far a colour goes towards grey


def color_of(data: RunData, trace: Trace) -> Color:
    """The colour of a run's path and total error; raw always has the same one."""
    if trace.is_raw:
        return RAW_COLOR
    return MODEL_COLORS[data.models().index(trace) % len(MODEL_COLORS)]


def axis_colors(data: RunData, trace: Trace) -> list[Color]:
    """Red, green and blue; each further model a little greyer, so that several can be told apart in one plot."""
    rank = 0 if trace.is_raw else data.models().index(trace)
    return [faded(color, min(NEXT_MODEL_FADE * rank, 0.75)) for color in XYZ]


def faded(color: Color, share: float) -> Color:
    """A colour moved towards grey: faint on a dark and on a light ground alike, which transparency is not."""
    red, green, blue = (round(c + share * (g - c)) for c, g in zip(color, GREY, strict=True))
    return red, green, blue
