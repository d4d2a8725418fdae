"""Rerun recording of a diagnosis: samples, residuals, located intervals and conclusion."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from imutool.array_types import Float64
from imutool.diagnosis.result import Diagnosis, Located, Traces
from imutool.diagnosis.wording.conclusion import lines, location_text
from imutool.mcap_io.storage.target import Target
from imutool.recording import Times
from imutool.units import AXES, NOUNS, SENSORS, UNITS
from imutool.viewing.html.diagnosis_figures import intervals_in_log
from imutool.viewing.model.decimation import true_intervals
from imutool.viewing.rerun import rr, rrb
from imutool.viewing.rerun.entities import styles
from imutool.viewing.rerun.entities.styles import BOLD_WIDTH, EVENT_COLOR, GREY, MODEL_COLORS, RAW_COLOR, RAW_WIDTH, Color
from imutool.viewing.rerun.plots import frame, whole_time_axis
from imutool.viewing.rerun.sdk import elapsed_column, entity_path, log_columns, log_static, new_stream, rrd_bytes, unique_names

CURVES = ("real", "before", "after")  # columns of `samples`; `left` holds real minus before and real minus after
COLORS: tuple[Color, ...] = (GREY, RAW_COLOR, MODEL_COLORS[0])
WIDTHS: tuple[float, ...] = (BOLD_WIDTH, RAW_WIDTH, RAW_WIDTH)
UNSEEN_COLOR: Color = (122, 122, 122)
UNSEEN_TEXTS = ("unseen by any fit from here", "seen again from here")


def save(d: Diagnosis, path: Path) -> None:
    """Write the .rrd file (ConfigError: no Rerun, or the file exists or cannot be written)."""
    with Target(path) as target:  # refuses before the work is done, leaves nothing after a failure
        target.write(rrd(d))


def rrd(d: Diagnosis) -> bytes:
    """Content of the .rrd file: recording and layout.

    Raises:
        ConfigError: Rerun is not installed.
    """

    def send(recording: rr.RecordingStream) -> None:
        recording.send_blueprint(blueprint(d))
        log(d, recording)

    return rrd_bytes(new_stream(f"diagnosis {Path(d.real[0]).stem if d.real else ''}"), send)


def log(d: Diagnosis, to: rr.RecordingStream) -> None:
    """Log all entities as whole columns on `elapsed`.

    `/LOG/{gyro,accel}/{x,y,z}/samples` (real, before, after), `…/left` (real minus before, real minus after),
    `/LOG/events` (texts at the ends of located and unseen intervals), `/LOG/where/{SIGNAL}/{AXIS}` and
    `/LOG/where/unseen` (states `here` and `elsewhere`), `/report`. Two logs of one name get a number.
    """
    log_static(to, "report", rr.TextDocument(_report(d), media_type="text/markdown"))
    for name, trace in zip(names(d.traces), d.traces, strict=True):
        t_ns = _nanoseconds(trace.t_s)
        for column in range(6):
            axis = (name, SENSORS[column // 3], AXES[column % 3])
            real, before, after = (values[:, column] for values in (trace.real, trace.before, trace.after))
            _log_curves(to, entity_path(axis, "samples"), t_ns, np.stack([real, before, after], axis=1), slice(0, 3))
            _log_curves(to, entity_path(axis, "left"), t_ns, np.stack([real - before, real - after], axis=1), slice(1, 3))
        _log_intervals(to, d, name, trace)


def blueprint(d: Diagnosis) -> rrb.Blueprint:
    """Layout: a tab for each log with residuals, samples and events, next to the report.

    Raises:
        ConfigError: Rerun is not installed.
    """
    report = rrb.TextDocumentView(origin="/report", name="Report")
    tabs = [_log_tab(name, trace) for name, trace in zip(names(d.traces), d.traces, strict=True)]
    shown: Any = rrb.Horizontal(rrb.Tabs(*tabs, active_tab=0), report, column_shares=[3, 1]) if tabs else report
    return frame(shown, play_state=None)


def names(traces: Sequence[Traces]) -> list[str]:
    """Entity name of each log, numbered where logs share a name."""
    return unique_names([trace.log or "log" for trace in traces], taken=["report"])


def _log_tab(name: str, trace: Traces) -> rrb.Vertical:
    span_s = float(trace.t_s[0]), float(trace.t_s[-1])

    def view(kind: str, sensor: str, axis: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin=entity_path((name, sensor, axis), kind),
            name=f"{NOUNS[sensor]} {axis} ({UNITS[sensor]})",
            axis_x=whole_time_axis(span_s),
            plot_legend=rrb.Corner2D.LeftTop,
        )

    curves = [
        rrb.Horizontal(*(rrb.Vertical(*(view(kind, sensor, axis) for axis in AXES)) for sensor in SENSORS), name=title)
        for kind, title in (("left", "Residuals"), ("samples", "Samples"))
    ]
    lanes = rrb.StateTimelineView(
        origin=entity_path((name,), "where"), name="Where it differs", time_view=whole_time_axis(span_s)
    )
    texts = rrb.TextLogView(origin=entity_path((name,), "events"), name="Events")
    return rrb.Vertical(rrb.Tabs(*curves, active_tab=0), rrb.Horizontal(lanes, texts), row_shares=[5, 2], name=name)


def _log_curves(to: rr.RecordingStream, entity: str, t_ns: Times, values: Float64[np.ndarray, "n k"], which: slice) -> None:
    """One curve per column after its style, so that the viewer chooses no colour."""
    style = styles.line_style(CURVES[which], COLORS[which], WIDTHS[which])
    log_columns(to, entity, style, [elapsed_column(t_ns)], rr.Scalars.columns(scalars=values))


def _log_intervals(to: rr.RecordingStream, d: Diagnosis, name: str, trace: Traces) -> None:
    """Located and unseen intervals as texts at their ends, and as states."""
    unseen = true_intervals(trace.t_s, trace.held_out)
    texts = [(t_s, "INFO", words) for ends in unseen for t_s, words in zip(ends, UNSEEN_TEXTS, strict=True)]
    inside: dict[tuple[str, ...], list[tuple[float, float]]] = {("unseen",): unseen}
    for located in d.located:
        what = location_text(Located(located.signal, located.axes, (), located.regime, located.share, located.p_value))
        for first, last in intervals_in_log(trace, located):
            texts += [(first, "WARN", f"begins: {what}"), (last, "INFO", f"ends: {what}")]
            for axis in located.axes or ("",):
                inside.setdefault((located.signal, axis) if axis else (located.signal,), []).append((first, last))
    for key, intervals in inside.items():
        entity, color = entity_path((name, "where"), *key), UNSEEN_COLOR if key == ("unseen",) else EVENT_COLOR
        style = styles.state_style(" ".join(key), color)
        times, states = styles.state_changes(
            sorted((round(first * 1e9), round(last * 1e9)) for first, last in intervals), round(float(trace.t_s[0]) * 1e9)
        )
        log_columns(to, entity, style, [elapsed_column(np.array(times))], rr.StateChange.columns(state=states))
    if texts:
        t_s, levels, words = zip(*sorted(texts, key=lambda text: text[0]), strict=True)
        columns = rr.TextLog.columns(text=list(words), level=list(levels))
        to.send_columns(entity_path((name,), "events"), [elapsed_column(_nanoseconds(t_s))], columns, strict=True)


def _nanoseconds(t_s: Float64[np.ndarray, " n"] | Sequence[float]) -> Times:
    times: Times = np.rint(np.asarray(t_s) * 1e9).astype(np.int64)
    return times


def _report(d: Diagnosis) -> str:
    """Conclusion as Markdown; names from logs are escaped."""
    escaped = [re.sub(r"([\\`*_{}\[\]<>#|!])", r"\\\1", line) for line in lines(d)]
    return "\n\n".join(["# Diagnosis", *escaped])
