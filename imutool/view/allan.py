"""A picture of Allan deviations on paper, with the slopes that were read off them."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from imutool import allan
from imutool.identify import SENSORS, Identified, Sensor, Sight
from imutool.mcap_io.target import Target
from imutool.view.report import DOTS_PER_INCH, SIZE_INCH, STYLE, UNITS, _matplotlib

AXIS_COLORS = ("#d55e00", "#009e73", "#0072b2")
LINES = {
    "quantisation": (0, (1, 3)),
    "density": (0, (6, 2)),
    "instability": (0, (3, 1, 1, 1)),
    "walk": (0, (1, 1)),
    "ramp": (0, (1, 3)),
}
TITLES = {"gyro": "Gyro", "accel": "Accel"}


def deviations(found: Identified, path: Path, *, overwrite: bool = False) -> None:
    """Writes a PNG of 2560 x 1440: the deviation of each axis as points, the fitted sum as a line, each slope seen as its own.

    Above what was seen at rest, below what was left in motion; only one of them where there is only one.

    Raises:
        ConfigError: matplotlib is not installed, or the file exists or cannot be written.
    """
    with Target(path, overwrite=overwrite) as target:  # refuses before the work is done, leaves nothing after a failure
        target.write(png(found))


def png(found: Identified) -> bytes:
    """The picture of `deviations` as the content of a file.

    Raises:
        ConfigError: matplotlib is not installed.
    """
    matplotlib = _matplotlib()
    with matplotlib.rc_context(STYLE):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=SIZE_INCH, dpi=DOTS_PER_INCH)
        FigureCanvasAgg(figure)
        figure.suptitle(f"{found.log} {found.topic}", x=0.01, ha="left", fontsize=14, fontweight="bold")
        sights = [sight for sight in (found.at_rest, found.in_motion) if sight is not None]
        panels = figure.subplots(len(sights), 2, squeeze=False)
        for row, sight in zip(panels, sights, strict=True):
            for axes, sensor in zip(row, SENSORS, strict=True):
                _draw(axes, sight, sensor)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _draw(axes: Any, sight: Sight, sensor: Sensor) -> None:
    curve = sight.curves[sensor]
    for axis, (slopes, color) in enumerate(zip(sight.slopes[sensor], AXIS_COLORS, strict=True)):
        error = curve.deviation[:, axis] / np.sqrt(2.0 * curve.freedom)
        axes.errorbar(curve.tau_s, curve.deviation[:, axis], error, fmt="o", ms=4, color=color, lw=0.8, label="xyz"[axis])
        if not slopes.powers:
            continue
        tau_s = np.geomspace(slopes.from_s, curve.tau_s[-1], 200)
        total = sum(allan.part(name, value, tau_s) ** 2 for name, value in slopes.powers.items())
        axes.plot(tau_s, np.sqrt(total), color=color, lw=1.4)
        for name, value in slopes.seen.items():
            axes.plot(tau_s, allan.part(name, value, tau_s), color=color, lw=0.9, ls=LINES[name], alpha=0.8)
    axes.set_xscale("log")
    axes.set_yscale("log")
    if len(curve.tau_s):
        axes.set_ylim(curve.deviation.min() / 3.0, curve.deviation.max() * 2.0)
    axes.set_title(f"{TITLES[sensor]}: {sight.how}".replace(", ", ",\n"), fontsize=9)
    axes.set_xlabel("averaging time (s)")
    axes.set_ylabel(f"Allan deviation ({UNITS[sensor]})")
    axes.grid(True, which="major", color="#dddddd", linewidth=0.6)
    named = sorted({name for slopes in sight.slopes[sensor] for name in slopes.seen}, key=list(LINES).index)
    for name in named:
        axes.plot([], [], color="#555555", lw=0.9, ls=LINES[name], label=name)
    axes.legend(loc="best", fontsize=8, ncols=2)
