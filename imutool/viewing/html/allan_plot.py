"""Plot of Allan deviations with the fitted noise terms, as a PNG."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from imutool.mcap_io.storage.target import Target
from imutool.noise import allan
from imutool.noise_identification import CurveSource, IdentifiedNoise
from imutool.units import AXES, SENSORS, UNITS, Sensor
from imutool.viewing.html.drawing import Panel, Picture, decades, legend, plain_tick_labels, png
from imutool.viewing.html.page import AXIS_COLORS, SOFT, TITLES

LINES = {
    "quantisation": (0, (1, 3)),
    "density": (0, (6, 2)),
    "instability": (0, (3, 1, 1, 1)),
    "walk": (0, (1, 1)),
    "ramp": (0, (1, 3)),
}
MARKERS = ("o", "s", "^")  # red and green alone are one colour to some
HEIGHT_INCH = 3.8


def write_png(identified: IdentifiedNoise, path: Path, *, overwrite: bool) -> None:
    """Write a PNG of the Allan deviation of each axis, the fitted sum and each noise term.

    Above from rest, below from the residual in motion, where the log has them.

    Raises:
        ConfigError: matplotlib is not installed, or the file exists or cannot be written.
    """
    sources = [source for source in (identified.at_rest, identified.in_motion) if source is not None]
    panels = [
        Panel(partial(_draw, source=source, sensor=sensor), HEIGHT_INCH, f"{TITLES[sensor]}: {source.how}")
        for source in sources
        for sensor in SENSORS
    ]
    picture = Picture("allan", "Allan deviation", "", tuple(panels))
    with Target(path, overwrite=overwrite) as target:  # leaves nothing after a failure
        target.write(png(picture, f"{identified.log} {identified.topic}"))


def _draw(figure: Any, *, source: CurveSource, sensor: Sensor) -> None:
    axes = figure.subplots()
    curve = source.curves[sensor]
    for axis, (slopes, color, marker) in enumerate(zip(source.slopes[sensor], AXIS_COLORS, MARKERS, strict=True)):
        error = curve.deviation[:, axis] / np.sqrt(2.0 * curve.freedom)
        axes.errorbar(curve.tau_s, curve.deviation[:, axis], error, fmt=marker, ms=4, color=color, lw=0.8, label=AXES[axis])
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
        decades(axes)
    axes.set_title(f"{TITLES[sensor]}: {source.how}".replace(", ", ",\n"), fontsize=9)
    axes.set_xlabel("averaging time (s)")
    axes.set_ylabel(f"Allan deviation ({UNITS[sensor]})")
    plain_tick_labels(axes.xaxis, axes.yaxis)
    for name in sorted({name for slopes in source.slopes[sensor] for name in slopes.seen}, key=list(LINES).index):
        axes.plot([], [], color=SOFT, lw=0.9, ls=LINES[name], label=name)
    legend(figure, axes.get_legend_handles_labels()[0])
