"""A diagnosis as an .rrd for the Rerun viewer: real, before and after by axis, what is left, where and when, and the words."""

from __future__ import annotations

import re
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from imutool.diagnosis.result import Diagnosis, Located, Traces
from imutool.diagnosis.wording import lines, where
from imutool.mcap_io.storage.target import Target
from imutool.units import AXES, UNITS
from imutool.viewing.html.diagnosis_figures import located_in
from imutool.viewing.html.drawing import spans
from imutool.viewing.rerun.entities.palette import BOLD_WIDTH, GREY, MODEL_COLORS, RAW_COLOR, RAW_WIDTH
from imutool.viewing.rerun.sdk import FLUSH_S, entity_path, need_sdk

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

TITLES = {"gyro": "Angular rate", "accel": "Specific force"}
LINES = ("real", "before", "after")  # in this order in every `samples`; `left` holds real minus the other two
INSIDE, OUTSIDE = "here", "elsewhere"
MARK_COLOR, HELD_COLOR = (230, 167, 0), (122, 122, 122)
COLORS = (GREY, RAW_COLOR, MODEL_COLORS[0])
WIDTHS = (BOLD_WIDTH, RAW_WIDTH, RAW_WIDTH)


def save(d: Diagnosis, path: Path, *, overwrite: bool = False) -> None:
    """Writes the .rrd.

    Raises:
        ConfigError: Rerun is not installed, or the file exists (without `overwrite`) or cannot be written.
    """
    with Target(path, overwrite=overwrite) as target:  # refuses before the work is done, leaves nothing after a failure
        target.write(rrd(d))


def rrd(d: Diagnosis) -> bytes:
    """The content of the file: the recording and its layout.

    Raises:
        ConfigError: Rerun is not installed.
    """
    need_sdk()
    import rerun as rr

    plain = re.sub(r"[^A-Za-z0-9_-]", "_", Path(d.real[0]).stem if d.real else "")[:100]
    recording = rr.RecordingStream(f"imutool diagnosis {plain}", recording_id=f"{plain}-{uuid.uuid4().hex[:8]}")
    stream = rr.binary_stream(recording)
    recording.send_blueprint(blueprint(d))
    log(d, recording)
    content = stream.read(flush_timeout_sec=FLUSH_S)
    assert content, "a stream that was written to holds bytes"
    return bytes(content)


def log(d: Diagnosis, to: rr.RecordingStream) -> None:
    """Everything there is to see, as whole columns over `elapsed`.

    Entities: `/LOG/{gyro,accel}/{x,y,z}/samples` (real, before, after), `…/left` (real minus before, real minus after),
    `/LOG/events` (texts where a located stretch or unseen time begins and ends), `/LOG/where/{SIGNAL}/{AXIS}` and
    `/LOG/where/unseen` (states `here` and `elsewhere`), `/report`. Two logs of one name get a number.

    Raises:
        ConfigError: Rerun is not installed.
    """
    need_sdk()
    import rerun as rr

    to.log("report", rr.TextDocument(_report(d), media_type="text/markdown"), static=True, strict=True)
    for name, trace in zip(names(d.traces), d.traces, strict=True):
        t = _time(trace.t_s)
        for column in range(6):
            axis = _axis(name, column)
            real, before, after = (values[:, column] for values in (trace.real, trace.before, trace.after))
            _log_scalars(to, axis, "samples", t, np.stack([real, before, after], axis=1), slice(0, 3))
            _log_scalars(to, axis, "left", t, np.stack([real - before, real - after], axis=1), slice(1, 3))
        _log_places(to, d, name, trace)


def blueprint(d: Diagnosis) -> rrb.Blueprint:
    """The layout: a tab for each log with samples and what is left by axis, events under them; the report beside them.

    Raises:
        ConfigError: Rerun is not installed.
    """
    need_sdk()
    import rerun.blueprint as rrb

    report = rrb.TextDocumentView(origin="/report", name="Report")
    tabs: list[Any] = []
    for name, trace in zip(names(d.traces), d.traces, strict=True):
        kinds: list[Any] = [
            rrb.Horizontal(
                *(rrb.Vertical(*(_plot(name, trace, column, of) for column in part)) for part in (range(3), range(3, 6))),
                name=title,
            )
            for of, title in (("left", "What is left"), ("samples", "Samples"))
        ]
        below: list[Any] = [
            rrb.StateTimelineView(origin=_origin(entity_path(name, "where")), name="Where it differs", time_view=_whole(trace)),
            rrb.TextLogView(origin=_origin(entity_path(name, "events")), name="Events"),
        ]
        above = rrb.Tabs(*kinds, active_tab=0)
        tabs.append(rrb.Vertical(above, rrb.Horizontal(*below), row_shares=[5, 2], name=name))
    shown: Any = rrb.Horizontal(rrb.Tabs(*tabs, active_tab=0), report, column_shares=[3, 1]) if tabs else report
    return rrb.Blueprint(
        shown,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="elapsed"),
        auto_layout=False,
        auto_views=False,
    )


def names(traces: Sequence[Traces]) -> list[str]:
    """A name for each log, its own unless an earlier one has it, then with a number."""
    out: list[str] = []
    for trace in traces:
        name, number = trace.log or "log", 2
        while name in out or name == "report":
            name, number = f"{trace.log or 'log'} ({number})", number + 1
        out.append(name)
    return out


def _log_scalars(
    to: rr.RecordingStream, axis: Sequence[str], kind: str, t: rr.TimeColumn, values: Float64[np.ndarray, "n k"], which: slice
) -> None:
    """One curve a column; the style goes first, so that no curve is ever drawn in a colour of the viewer's choice."""
    import rerun as rr

    entity = entity_path(*axis, kind)
    # by default the viewer draws the mean of what falls on a pixel: noise would look smaller than it is
    extremes = rr.components.AggregationPolicy.MinMax
    style = rr.SeriesLines(
        names=list(LINES[which]), colors=list(COLORS[which]), widths=WIDTHS[which], aggregation_policy=extremes
    )
    to.log(entity, style, static=True, strict=True)
    # strict: Rerun only warns of a length that does not match, and then the rows are missing
    to.send_columns(entity, [t], rr.Scalars.columns(scalars=values), strict=True)


def _log_places(to: rr.RecordingStream, d: Diagnosis, name: str, trace: Traces) -> None:
    """Located stretches and unseen time as texts at their ends, and as states."""
    import rerun as rr

    events: list[tuple[float, str, str]] = []
    inside: dict[tuple[str, ...], list[tuple[float, float]]] = {("unseen",): spans(trace.t_s, trace.held_out)}
    for first, last in inside["unseen",]:
        events += [(first, "INFO", "unseen by any fit from here"), (last, "INFO", "seen again from here")]
    for place in d.located:
        for stretch in located_in(trace, place):
            events += [(stretch[0], "WARN", f"begins: {_place(place)}"), (stretch[1], "INFO", f"ends: {_place(place)}")]
            for axis in place.axes or ("",):
                inside.setdefault((place.signal, axis) if axis else (place.signal,), []).append(stretch)
    for key, stretches in inside.items():
        entity = entity_path(name, "where", *key)
        color = HELD_COLOR if key == ("unseen",) else MARK_COLOR
        style = rr.StateConfiguration(
            values=[INSIDE, OUTSIDE], labels=[" ".join(key), ""], colors=[color, GREY], visible=[True, False]
        )
        to.log(entity, style, static=True, strict=True)
        turns = [(float(trace.t_s[0]), OUTSIDE)] if not stretches or stretches[0][0] > trace.t_s[0] else []
        for first, last in _merged(stretches):
            turns += [(first, INSIDE), (last, OUTSIDE)]
        columns = rr.StateChange.columns(state=[state for _, state in turns])
        to.send_columns(entity, [_time(np.array([t for t, _ in turns]))], columns, strict=True)
    if events:
        events.sort(key=lambda event: event[0])
        columns = rr.TextLog.columns(text=[text for _, _, text in events], level=[level for _, level, _ in events])
        to.send_columns(entity_path(name, "events"), [_time(np.array([t for t, _, _ in events]))], columns, strict=True)


def _time(t_s: Float64[np.ndarray, " n"]) -> rr.TimeColumn:
    """Seconds as whole nanoseconds."""
    import rerun as rr

    return rr.TimeColumn("elapsed", duration=np.rint(t_s * 1e9).astype("timedelta64[ns]"))


def _axis(name: str, column: int) -> tuple[str, str, str]:
    """Log, sensor and axis of a column."""
    return name, "gyro" if column < 3 else "accel", AXES[column % 3]


def _plot(name: str, trace: Traces, column: int, kind: str) -> rrb.TimeSeriesView:
    _, signal, axis = _axis(name, column)
    return _view(entity_path(name, signal, axis, kind), f"{TITLES[signal]} {axis} ({UNITS[signal]})", trace)


def _view(entity: str, title: str, trace: Traces) -> rrb.TimeSeriesView:
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(origin=_origin(entity), name=title, axis_x=_whole(trace), plot_legend=rrb.Corner2D.LeftTop)


def _whole(trace: Traces) -> rrb.TimeAxis:
    """The whole log: by default Rerun shows a minute around the cursor."""
    import rerun as rr
    import rerun.blueprint as rrb

    ends = [rr.TimeRangeBoundary.absolute(seconds=float(t)) for t in (trace.t_s[0], trace.t_s[-1])]
    return rrb.TimeAxis(link="Independent", view_range=rr.TimeRange(start=ends[0], end=ends[1]))


def _origin(entity: str) -> str:
    """An entity as a view wants it: from the root."""
    return f"/{entity.removeprefix('/')}"


def _merged(stretches: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The same time in stretches that do not overlap: two regimes may hold of one axis at once."""
    out: list[tuple[float, float]] = []
    for first, last in sorted(stretches):
        if out and first <= out[-1][1]:
            out[-1] = (out[-1][0], max(last, out[-1][1]))
        else:
            out.append((first, last))
    return out


def _place(place: Located) -> str:
    """Where, without the times that the text itself stands at."""
    return where(Located(place.signal, place.axes, (), place.regime, place.share, place.p_value))


def _report(d: Diagnosis) -> str:
    """The words as Markdown; what logs are called is no markup."""
    escaped = [re.sub(r"([\\`*_{}\[\]<>#|!])", r"\\\1", line) for line in lines(d)]
    return "\n\n".join(["# Diagnosis", *escaped])
