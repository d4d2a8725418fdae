"""A picture of the error curves on paper: what each way of reading the IMU costs over time, and what it took off."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from imutool.errors import ConfigError, DataError
from imutool.mcap_io.target import Target
from imutool.view.rundata import RunData, Trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE_INCH, DOTS_PER_INCH = (12.8, 7.2), 200  # 2560 x 1440: sharp in print, and still readable at half of it
TRUE_COLOR = "#111111"
RAW_COLOR = "#d55e00"
MODEL_COLORS = ("#0072b2", "#009e73", "#cc79a7", "#8a6d00")  # with raw's, from Okabe and Ito's palette
DECADES = 2.5  # shown below the largest error of the best run: nothing is decided further down
LEGEND_LETTERS, LEGEND_HANDLE_LETTERS, LEGEND_ROW_POINTS = 64, 7, 18  # over half the picture's width, at font size 11
AXES = ("x", "y", "z")
UNITS = {"gyro": "rad/s", "accel": "m/s²"}
STYLE = {
    "font.size": 11,
    "axes.titlesize": 12,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
}


def error_curves(data: RunData, path: Path, *, overwrite: bool = False) -> None:
    """Writes a PNG of 2560 x 1440: orientation and position error of every run, biases against the truth where known.

    Errors are on a logarithmic axis, so that a raw error of 100 degrees and a debiased one of half a degree can both
    be read. Without truth there are biases alone; without a model, errors alone.

    Raises:
        ConfigError: matplotlib is not installed, or the file exists or cannot be written.
        DataError: neither truth nor model: there is nothing to draw.
    """
    with Target(path, overwrite=overwrite) as target:  # refuses before the work is done, leaves nothing after a failure
        target.write(png(data))


def png(data: RunData) -> bytes:
    """The picture of `error_curves` as the content of a file.

    Raises:
        ConfigError: matplotlib is not installed.
        DataError: neither truth nor model: there is nothing to draw.
    """
    scored = any(trace.errors is not None for trace in data.traces)
    kinds = _bias_kinds(data, alone=not scored)
    if not scored and not kinds:
        raise DataError("there is neither truth nor a model, so there are no curves to draw", where=data.name)
    matplotlib = _matplotlib()
    with matplotlib.rc_context(STYLE):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=SIZE_INCH, dpi=DOTS_PER_INCH)
        FigureCanvasAgg(figure)
        figure.suptitle(f"{data.name}, {data.duration_s:.0f} s", x=0.01, ha="left", fontsize=14, fontweight="bold")
        columns = figure.subfigures(1, scored + len(kinds), squeeze=False, wspace=0.02)[0]
        if scored:
            _draw_errors(columns[0], data)
        for column, kind in zip(columns[int(scored) :], kinds, strict=True):
            _draw_biases(column, data, kind)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _bias_kinds(data: RunData, alone: bool) -> list[str]:
    """Which biases to draw: the gyroscope's beside the errors, both where there are no errors."""
    if not data.models():
        return []
    return ["gyro", "accel"] if alone else ["gyro"]


def _draw_errors(figure: Any, data: RunData) -> None:
    above, below = figure.subplots(2, 1, sharex=True)
    _draw_error(above, data, "orientation", "aoe_deg", "°")
    _draw_error(below, data, "position", "ape_m", " m")
    _title(above, "Orientation error, and its root mean square (AOE)")
    _title(below, "Position error, and its root mean square (APE)")
    above.set_ylabel("error (deg)")
    below.set_ylabel("error (m)")
    below.set_xlabel("time (s)")
    below.set_xlim(0.0, data.duration_s)


def _draw_error(axes: Any, data: RunData, kind: str, figure_name: str, unit: str) -> None:
    from matplotlib.ticker import FuncFormatter

    tops = []
    for trace in data.traces:
        if trace.errors is None:
            continue
        total = trace.errors.orientation_total_deg if kind == "orientation" else trace.errors.position_total_m
        shown = np.where(total > 0.0, total, np.nan)  # the start is exact, which a logarithm cannot show
        label = f"{trace.name} {_figure(trace, figure_name)}{unit}"
        axes.plot(data.elapsed_s(trace.errors.t_ns), shown, label=label, **_line(data, trace))
        tops.append(float(np.nanmax(total)))
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    if min(tops) > 0.0:
        axes.set_ylim(min(tops) * 10.0**-DECADES, max(tops) * 2.0)


def _draw_biases(figure: Any, data: RunData, kind: str) -> None:
    """One panel per axis: differences of a thousandth are lost beside offsets of a tenth."""
    panels: Sequence[Axes] = figure.subplots(3, 1, sharex=True)
    true = data.true_bias.get(kind)
    for column, axes in enumerate(panels):
        for trace in data.models():
            bias = trace.run.gyro_bias if kind == "gyro" else trace.run.accel_bias
            axes.plot(data.elapsed_s(trace.run.imu.t_ns), bias[:, column], label=trace.name, **_line(data, trace))
        if true is not None:
            line: dict[str, Any] = {"color": TRUE_COLOR, "linewidth": 1.6, "linestyle": (0, (4, 2))}
            axes.plot(data.elapsed_s(true.t_ns), true.values[:, column], label="true", **line)
        axes.set_ylabel(f"{AXES[column]} ({UNITS[kind]})")
        axes.margins(y=0.15)
    name = "Gyro" if kind == "gyro" else "Accel"
    title = f"{name} bias: what was subtracted" + (", and the true one" if true is not None else "")
    _title(panels[0], title)
    panels[-1].set_xlabel("time (s)")
    panels[-1].set_xlim(0.0, data.duration_s)


def _title(axes: Any, title: str) -> None:
    """A title with the legend in rows of its own under it: inside the axes it would cover a curve sooner or later."""
    labels = axes.get_legend_handles_labels()[1]
    columns = max(1, min(len(labels), LEGEND_LETTERS // (max(map(len, labels)) + LEGEND_HANDLE_LETTERS)))
    rows = -(-len(labels) // columns)
    axes.set_title(title, pad=6 + LEGEND_ROW_POINTS * rows)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2, borderpad=0.1, ncols=columns, handlelength=1.6)


def _line(data: RunData, trace: Trace) -> dict[str, Any]:
    if trace.is_raw:
        return {"color": RAW_COLOR, "linewidth": 1.0}
    return {"color": MODEL_COLORS[data.models().index(trace) % len(MODEL_COLORS)], "linewidth": 1.6}


def _figure(trace: Trace, name: str) -> str:
    value = trace.figures.get(name)
    return "?" if value is None else f"{value:.3g}" if abs(value) < 1000.0 else f"{value:.0f}"


def _matplotlib() -> Any:
    """The library, imported when first asked for.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import matplotlib
    except ImportError as error:
        raise ConfigError(
            f"matplotlib is not installed ({error})",
            where="report",
            fix="Install it with: pip install 'imutool[report]'",
        ) from error
    return matplotlib
