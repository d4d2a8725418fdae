"""Drawings by matplotlib: inline SVG in the colours of the page, or PNG."""

from __future__ import annotations

import io
import re
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from imutool.errors import required
from imutool.viewing.html.page import GRID, INK, LIGHT, printable, text

WIDTH_INCH = 11.5  # on a page of 1150 pixels, letters of 9 points are 12 pixels high
HALF_INCH = 5.6  # two side by side, or one on a phone, where letters are 9 pixels high
DOTS_PER_INCH = 200  # sharp in print
SVG_DOTS_PER_INCH = 72  # of matplotlib's SVG
HEADING_INCH = 0.45
LEGEND_LETTERS, HANDLE_LETTERS = 76, 8  # in a row of a legend at half width
MAX_LETTERS = 48  # of a name in a legend
EMPTY_DECADES = 0.1, 10.0
MAX_DECADES = 5  # labels of a logarithmic axis

# placeholder colour for each of the page's colours in an SVG; none is one of matplotlib's own
VARIABLES = {f"#{3 * k + 1:02x}{3 * k + 2:02x}{3 * k + 3:02x}": name for k, name in enumerate(LIGHT)}
PLACEHOLDER_COLORS = {f"imutool:{name}": color for color, name in VARIABLES.items()}
LIGHT_COLORS = {f"imutool:{name}": color for name, color in LIGHT.items()}

STYLE = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # no label is above the axes: to find that out takes a twentieth of a drawing
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
    "figure.constrained_layout.w_pad": 0.2,  # inches: labels are measured once, and grow by a digit and a sign
    "grid.color": GRID,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "svg.fonttype": "none",
    "text.parse_math": False,  # channel names may contain a dollar
    "axes.formatter.useoffset": False,  # readers overlook +1.2e-3 in a corner
    "axes.formatter.limits": (-6, 9),  # or a power of ten above an axis
    "axes.formatter.use_mathtext": False,
    "axes.unicode_minus": True,
}
_drawing = threading.RLock()  # matplotlib's settings and colour names are global


@dataclass(frozen=True)
class Panel:
    """One drawing of half or the whole width of a page; `label` describes it for screen readers."""

    draw: Callable[[Any], None]
    height_inch: float
    label: str
    wide: bool = False


@dataclass(frozen=True)
class Picture:
    """Panels under one title; `name` ends the name of their file."""

    name: str
    title: str
    caption: str
    panels: tuple[Panel, ...]


def svg(draw: Callable[[Any], None], height_inch: float, name: str, *, width_inch: float = WIDTH_INCH) -> str:
    """Draw an `<svg>` element: colours are CSS variables, numbers have two decimals.

    Every labelled curve has a `<title>`, which a browser shows as a tooltip.

    Raises:
        ConfigError: matplotlib is not installed.
    """
    with _inked(PLACEHOLDER_COLORS, name):
        from matplotlib.backends.backend_svg import FigureCanvasSVG
        from matplotlib.figure import Figure

        figure = Figure(figsize=(width_inch, height_inch), dpi=SVG_DOTS_PER_INCH)
        FigureCanvasSVG(figure)
        draw(figure)
        titles = _curves(figure)
        drawn = _content(figure, format="svg", transparent=True, metadata={"Date": None}).decode()
    drawn = drawn[drawn.index("<svg") :]
    drawn = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->", "", drawn, flags=re.DOTALL)
    drawn = re.sub(r' (?:width|height)="[\d.]+pt"', "", drawn, count=2)
    drawn = re.sub(r'(?<= d=")[^"]*', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path[0]).replace(" \n", "\n"), drawn)
    drawn = re.sub(r'<g id="(curve-\d+)">', lambda g: f"{g[0]}<title>{text(titles[g[1]])}</title>", drawn)
    for color, variable in VARIABLES.items():
        drawn = drawn.replace(color, f"var(--{variable})")
    return drawn.replace("<svg", '<svg class="wide"', 1) if width_inch > HALF_INCH else drawn


def png(picture: Picture, heading: str) -> bytes:
    """Content of a PNG file in light colours: two panels per row under a heading.

    Raises:
        ConfigError: matplotlib is not installed.
    """
    rows = _rows(picture.panels)
    heights = [max(panel.height_inch for panel in row) for row in rows]
    columns = 2 if any(len(row) > 1 or row[0].wide for row in rows) else 1
    with _inked(LIGHT_COLORS, picture.name):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(HALF_INCH * columns, sum(heights) + HEADING_INCH), dpi=DOTS_PER_INCH)
        FigureCanvasAgg(figure)
        figure.suptitle(printable(heading), x=0.01, ha="left", fontsize=12, fontweight="bold")
        parts = figure.subfigures(len(rows), 1, squeeze=False, height_ratios=heights)[:, 0]
        for part, row in zip(parts, rows, strict=True):
            alone = part.subfigures(1, 1 if row[0].wide else columns, squeeze=False)[0]
            for place, panel in zip(alone, row, strict=False):
                panel.draw(place)
        return _content(figure, format="png", metadata={"Software": None})


def figure_of(drawn: str, prefix: str, caption: str = "", label: str = "") -> str:
    """Figure of a drawing with its caption or label; a prefix makes its identifiers unique."""
    own = re.sub(r'(?<= id=")|(?<=href="#)|(?<=url\(#)', f"{prefix}-", drawn)
    name = f'aria-labelledby="{prefix}-caption"' if caption else f'aria-label="{text(label)}"'
    own = own.replace("<svg", f'<svg role="img" {name}', 1)
    return f"<figure>{own}{f'<figcaption id={prefix}-caption>{caption}</figcaption>' if caption else ''}</figure>"


def legend(figure: Any, artists: Sequence[Any]) -> None:
    """Legend in rows above the axes, where it covers no curve."""
    names = [legend_name(str(artist.get_label())) for artist in artists]
    widths = [len(name) + HANDLE_LETTERS for name in names]
    columns = len(names) if sum(widths) <= LEGEND_LETTERS else max(1, min(len(names), LEGEND_LETTERS // max(widths)))
    figure.legend(artists, names, loc="outside upper left", ncols=columns, handlelength=1.6, fontsize=8.5)


def legend_name(name: str) -> str:
    """Name for a legend: short, and without a leading underscore, which matplotlib would hide."""
    name = printable(name).strip() or "?"
    name = name if len(name) <= MAX_LETTERS else f"{name[: MAX_LETTERS - 1]}…"
    return f"\u200a{name}" if name.startswith("_") else name


def at_least_three_ticks(axes: Any) -> None:
    """Choose the ticks of a linear vertical axis so that a low panel has three or more."""
    from matplotlib.ticker import MaxNLocator

    axes.yaxis.set_major_locator(MaxNLocator(nbins=4, min_n_ticks=3, steps=[1, 2, 2.5, 5, 10]))


def decades(axes: Any) -> None:
    """Set limits of a logarithmic vertical axis to whole decades, with three or more labels."""
    from matplotlib.ticker import LogLocator

    low, high = axes.get_ylim()
    if not 0.0 < low < high < np.inf:  # no curve above zero: a sensor that reads zero
        low, high = EMPTY_DECADES
    first, last = np.floor(np.log10(low)), np.ceil(np.log10(high))
    axes.set_ylim(10.0**first, 10.0**last)
    axes.yaxis.set_major_locator(LogLocator(numticks=MAX_DECADES))
    if last - first < 2:
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=MAX_DECADES))


def plain_tick_labels(*rulers: Any) -> None:
    """Label logarithmic axes with plain numbers at the decades."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    for ruler in rulers:
        ruler.set_major_formatter(FuncFormatter(lambda number, _: f"{number:g}"))
        ruler.set_minor_formatter(NullFormatter())


def require_matplotlib(where: str = "report") -> Any:
    """Import matplotlib at its first use.

    Raises:
        ConfigError: it is not installed.
    """
    return required("matplotlib", "report", where=where)


@contextmanager
def _inked(colors: Mapping[str, str], salt: str) -> Iterator[None]:
    """Our style and names of colours, set only while something is drawn."""
    matplotlib = require_matplotlib()
    known = matplotlib.colors.get_named_colors_mapping()
    with _drawing, warnings.catch_warnings():  # the browser draws letters that this font lacks
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        for name, color in colors.items():
            known[name] = color
        try:
            with matplotlib.rc_context({**STYLE, "svg.hashsalt": salt}):
                yield
        finally:
            for name in colors:
                del known[name]


def _content(figure: Any, **saving: Any) -> bytes:
    """A figure as the bytes of a file."""
    _lay_out(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, **saving)
    return buffer.getvalue()


def _lay_out(figure: Any) -> None:
    """Place the axes once; `savefig` would draw everything an extra time to do so.

    matplotlib asks again and again where labels end, and how far they reach beyond moved axes.
    """
    import matplotlib

    every = figure.get_axes()
    measured = every if all(axes.get_aspect() == "auto" and axes.get_label() != "<colorbar>" for axes in every) else []
    for axes in every:
        for axis in (axes.xaxis, axes.yaxis):
            _add_ticks(axis.majorTicks, len(axis.get_majorticklocs()))
            _add_ticks(axis.minorTicks, len(axis.get_minorticklocs()))
            axis.get_tightbbox = _remembered(axes, axis.get_tightbbox)
    for axes in measured:
        axes.get_tightbbox = _measured_once(axes, axes.get_tightbbox)
    figure.get_layout_engine().execute(figure)
    for axes in measured:
        del axes.get_tightbbox
    with matplotlib.rc_context({"figure.constrained_layout.use": False}):
        figure.set_layout_engine(None)


def _add_ticks(ticks: list[Any], count: int) -> None:
    """Add copies of an axis' first tick: to make one takes six times as long."""
    while 0 < len(ticks) < count:
        tick = copy(ticks[0])
        for part in ("label1", "label2", "tick1line", "tick2line", "gridline"):
            setattr(tick, part, copy(getattr(tick, part)))
        tick.gridline.set_clip_box(None)  # a grid line ends where the axes do
        ticks.append(tick)


def _remembered(axes: Any, measure: Callable[..., Any]) -> Callable[..., Any]:
    """Last box of an axis, measured anew where the limits or the place of its axes changed."""
    known: list[Any] = []

    def box(*asked: Any, **how: Any) -> Any:
        state = *axes.viewLim.bounds, *axes.bbox.bounds, asked, how
        if not known or known[0] != state:
            known[:] = state, measure(*asked, **how)
        return known[1]

    return box


def _measured_once(axes: Any, measure: Callable[..., Any]) -> Callable[..., Any]:
    """Box around axes and their labels, which reach as far beyond the axes as when they were first measured."""
    from matplotlib.transforms import Bbox

    beyond = lru_cache(lambda *asked, **how: measure(*asked, **how).get_points() - axes.bbox.get_points())
    return lambda *asked, **how: Bbox(axes.bbox.get_points() + beyond(*asked, **how))


def _curves(figure: Any) -> dict[str, str]:
    """Give every labelled curve an identifier; returns the labels by identifier."""
    from matplotlib.collections import Collection
    from matplotlib.lines import Line2D

    titles: dict[str, str] = {}
    for axes in figure.get_axes():
        for artist in (*axes.lines, *axes.collections):
            name = str(artist.get_label())
            if isinstance(artist, Line2D | Collection) and name and not name.startswith("_"):
                artist.set_gid(f"curve-{len(titles)}")
                titles[f"curve-{len(titles)}"] = name
    return titles


def _rows(panels: Sequence[Panel]) -> list[list[Panel]]:
    """Panels in rows of two; a wide one has its own row."""
    rows: list[list[Panel]] = []
    for panel in panels:
        if rows and len(rows[-1]) == 1 and not panel.wide and not rows[-1][0].wide:
            rows[-1].append(panel)
        else:
            rows.append([panel])
    return rows
