"""Spectra as drawings, since Rerun plots over time alone: the square root of the density over frequency, both logarithmic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from imutool.viewing.model.run_data import RunData, Trace
from imutool.viewing.rerun.entities import names
from imutool.viewing.rerun.entities.names import Scope
from imutool.viewing.rerun.entities.palette import BOLD_WIDTH, GRID, INK, RAW_FADE, XYZ, axis_colors, faded
from imutool.viewing.rerun.entities.signals import rank

if TYPE_CHECKING:
    import rerun as rr

WIDTH, HEIGHT = 200.0, 90.0  # of the drawing, which the viewer scales as a whole
SHOWN_X, SHOWN_Y = (-24.0, WIDTH + 8.0), (-8.0, HEIGHT + 17.0)  # with room for numbers
KINDS = ("gyro", "accel")
SLACK = 0.02  # of a decade: 100.1 Hz need no decade of their own
MOST_POINTS = 400  # of a curve: about two a pixel, of each bucket its lowest and its highest


@dataclass(frozen=True)
class Frame:
    """Whole decades of frequency (Hz) and of the root of the density that all curves of a drawing lie in."""

    low_hz: int
    high_hz: int
    low: int
    high: int

    def at(self, hz: Float64[np.ndarray, " n"], root: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 2"]:
        """Points of the drawing: right with frequency, up with density; what is too low lies on the edge."""
        x = (np.log10(hz) - self.low_hz) / (self.high_hz - self.low_hz) * WIDTH
        y = (np.log10(np.maximum(root, 10.0**self.low)) - self.low) / (self.high - self.low) * HEIGHT
        return np.stack([x, HEIGHT - y], axis=1)


def log(data: RunData, to: rr.RecordingStream, scope: Scope) -> None:
    """`spectrum/{gyro,accel}/{frame,raw,debiased}` where any run has a spectrum."""
    for kind in kinds(data):
        frame = frame_of(data, kind)
        _log_frame(to, names.path(scope, "spectrum", kind, "frame"), frame)
        for trace in data.traces:
            if kind in trace.spectra:
                _log_curves(data, to, names.of(data, trace, scope, "spectrum", kind, names.role(trace)), trace, kind, frame)


def kinds(data: RunData) -> list[str]:
    """The sensors that have a spectrum."""
    return [kind for kind in KINDS if any(kind in trace.spectra for trace in data.traces)]


def frame_of(data: RunData, kind: str) -> Frame:
    """The decades that hold every curve; five at most downwards, below which nothing was measured but rounding."""
    found = [trace.spectra[kind] for trace in data.traces if kind in trace.spectra]
    hz = np.concatenate([spectrum.frequency_hz for spectrum in found])
    root = np.sqrt(np.concatenate([spectrum.density.ravel() for spectrum in found]))
    root = root[root > 0.0]
    high = int(np.ceil(np.log10(root.max()))) if len(root) else 0
    low = max(int(np.floor(np.log10(root.min()))), high - 5) if len(root) else -1
    low_hz, high_hz = int(np.floor(np.log10(hz.min()))), int(np.ceil(np.log10(hz.max()) - SLACK))
    return Frame(low_hz, max(high_hz, low_hz + 1), low, max(high, low + 1))


def thinned(points: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "m 2"]:
    """The lowest and the highest point of each column of the drawing, in their order, with the first and the last."""
    bucket = np.floor(points[:, 0] / WIDTH * MOST_POINTS / 2.0)
    edges = np.flatnonzero(np.diff(bucket, prepend=-1.0))
    rows = {0, len(points) - 1}
    for first, last in zip(edges, [*edges[1:], len(points)], strict=True):
        height = points[first:last, 1]
        rows |= {int(first + height.argmin()), int(first + height.argmax())}
    return points[sorted(rows)]


def _log_curves(data: RunData, to: rr.RecordingStream, entity: str, trace: Trace, kind: str, frame: Frame) -> None:
    import rerun as rr

    spectrum = trace.spectra[kind]
    strips = [thinned(frame.at(spectrum.frequency_hz, np.sqrt(column))) for column in spectrum.density.T]
    faint = trace.is_raw and bool(data.models())
    colors = [faded(color, RAW_FADE) for color in XYZ] if faint else axis_colors(rank(data, trace))
    radius = 0.9 * BOLD_WIDTH if faint else BOLD_WIDTH / 2.0  # of what did not change, raw is the rim
    lines = rr.LineStrips2D(strips, colors=colors, radii=rr.Radius.ui_points(radius), draw_order=1.0 if faint else 2.0)
    to.log(entity, lines, static=True, strict=True)


def _log_frame(to: rr.RecordingStream, entity: str, frame: Frame) -> None:
    """Lines at whole decades, with their numbers left and below."""
    import rerun as rr

    across = np.arange(frame.low_hz, frame.high_hz + 1)
    up = np.arange(frame.low, frame.high + 1)
    x = (across - frame.low_hz) / (frame.high_hz - frame.low_hz) * WIDTH
    y = HEIGHT - (up - frame.low) / (frame.high - frame.low) * HEIGHT
    lines = [[[at, 0.0], [at, HEIGHT]] for at in x] + [[[0.0, at], [WIDTH, at]] for at in y]
    to.log(entity, rr.LineStrips2D(lines, colors=[GRID] * len(lines), radii=rr.Radius.ui_points(0.5)), static=True, strict=True)
    _log_numbers(to, f"{entity}/hz", [[at, HEIGHT + 4.0] for at in x], [f"{_power(power)} Hz" for power in across.tolist()])
    _log_numbers(to, f"{entity}/density", [[-11.0, at - 5.5] for at in y], [_power(power) for power in up.tolist()])


def _log_numbers(to: rr.RecordingStream, entity: str, places: Sequence[Sequence[float]], words: Sequence[str]) -> None:
    import rerun as rr

    dots = rr.Radius.ui_points(0.0)
    text = rr.Points2D(places, labels=list(words), colors=[INK] * len(words), radii=dots, show_labels=True)
    to.log(entity, text, static=True, strict=True)


def _power(power: int) -> str:
    """A power of ten in few letters."""
    return f"{10.0**power:g}" if -2 <= power <= 3 else f"1e{power}"
