"""How curves, paths and bodies look, live and afterwards: logged before their data, so that nothing has a chance colour."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from imutool.units import AXES
from imutool.viewing.rerun.entities.names import Role
from imutool.viewing.rerun.entities.palette import (
    BOLD_WIDTH,
    INK,
    RAW_FADE,
    RAW_WIDTH,
    TRUE_FADE,
    XYZ,
    Color,
    axis_colors,
    faded,
)

if TYPE_CHECKING:
    import rerun as rr

PATH_RADII = {"gt": 1.0, "raw": 0.7, "debiased": 2.0}  # in points of the screen, at every distance
LABEL_SIDES = {"gt": 1.0, "raw": 0.6, "debiased": -1.0}  # how far above the body its label hangs: they would cover each other
AXIS_SHARE = 0.1  # of the size of the scene: the length of a body's axes


def curves(names: Sequence[str], colors: Sequence[Color], width: float) -> rr.SeriesLines:
    """One curve per name. Rerun would draw the mean of what falls on a pixel; here the extremes are drawn."""
    import rerun as rr

    extremes = rr.components.AggregationPolicy.MinMax
    return rr.SeriesLines(names=list(names), colors=list(colors), widths=[width] * len(names), aggregation_policy=extremes)


def axes(role: Role, name: str, *, rank: int = 0, alone: bool = False) -> rr.SeriesLines:
    """Three curves x, y and z: raw thin and faint (unless it is `alone`), a model's bold, each further model's greyer."""
    names = [f"{axis} {name}" for axis in AXES]
    if role == "raw" and not alone:
        return curves(names, [faded(color, RAW_FADE) for color in XYZ], RAW_WIDTH)
    return curves(names, axis_colors(rank), BOLD_WIDTH)


def true_bias() -> rr.SeriesLines:
    """Three broad pale curves, on which the estimate lies if it is right."""
    return curves([f"{axis} true" for axis in AXES], [faded(color, TRUE_FADE) for color in XYZ], 2.0 * BOLD_WIDTH)


def sigma(name: str, *, rank: int = 0) -> rr.SeriesLines:
    """Six thin curves: three standard deviations above the estimate, and three below."""
    names = [f"{axis} {name} {sign}3σ" for sign in "+-" for axis in AXES]
    return curves(names, [faded(color, RAW_FADE) for color in axis_colors(rank)] * 2, RAW_WIDTH)


def total(role: Role, name: str, color: Color) -> rr.SeriesLines:
    """One curve in the run's own colour, raw's thin."""
    return curves([name], [color], RAW_WIDTH if role == "raw" else BOLD_WIDTH)


def path(role: str, color: Color | None) -> rr.LineStrips3D:
    """The width of a path (`gt`, `raw` or `debiased`) and its colour; none where every piece brings its own."""
    import rerun as rr

    radii = rr.Radius.ui_points([PATH_RADII[role]])
    return rr.LineStrips3D.from_fields(radii=radii, colors=None if color is None else [color])


def body(role: str, name: str, color: Color, size_m: float) -> list[rr.AsComponents]:
    """Axes that move with a body, a dot where it is and its label beside it."""
    import rerun as rr

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
