"""The report in the viewer, as Markdown: figures, windows, events, alignment, notes and what it was made from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun.entities import names
from imutool.viewing.rerun.entities.markdown import escape, table
from imutool.viewing.rerun.entities.names import Scope
from imutool.viewing.rerun.entities.palette import color_name
from imutool.viewing.rerun.entities.paths import heat_top

if TYPE_CHECKING:
    import rerun as rr

MOST_EVENTS = 40  # in the list; the lanes and their texts hold all


def log(data: RunData, to: rr.RecordingStream, scope: Scope, more: Sequence[str] = ()) -> None:
    """`report`: what `markdown` says, with sentences of the one who logs after the log's own notes."""
    import rerun as rr

    text = rr.TextDocument(markdown(data, more), media_type="text/markdown")
    to.log(names.path(scope, "report"), text, static=True, strict=True)


def log_comparison(logs: Sequence[RunData], to: rr.RecordingStream) -> None:
    """`compare`: the figures of several logs side by side."""
    import rerun as rr

    to.log("compare", rr.TextDocument(comparison(logs), media_type="text/markdown"), static=True, strict=True)


def markdown(data: RunData, more: Sequence[str] = ()) -> str:
    """All the words about one log."""
    lines = [f"# {escape(data.name)}", ""]
    lines += [f"{data.duration_s:.1f} s, read {' and '.join(escape(trace.name) for trace in data.traces)}.", ""]
    for note in (*data.notes, *_colors(data), *more):
        lines += [escape(note), ""]
    lines += _figures(data) + _windows(data) + _events(data)
    if data.provenance:
        rows = [[escape(key), escape(value)] for key, value in data.provenance.items()]
        lines += ["## Made from", "", *table(["what", ""], rows), ""]
    return "\n".join(lines)


def comparison(logs: Sequence[RunData]) -> str:
    """One table: a row for each run of each log, a column for each figure that any has."""
    labels = list(dict.fromkeys(label for data in logs for label, _ in data.table()))
    rows = []
    for data in logs:
        values = dict(data.table())
        for place, trace in enumerate(data.traces):
            cells = [_cell(values[label][place]) if label in values else "" for label in labels]
            rows.append([escape(data.name), escape(trace.name), *cells])
    heads = ["log", "run", *labels]
    return "\n".join([f"# {len(logs)} logs", "", *table(heads, rows)])


def _colors(data: RunData) -> list[str]:
    """What the colours of the paths mean."""
    top = heat_top(data)
    if top is not None:
        return [
            f"The debiased path is coloured by its orientation error: dark blue is none, yellow is {top:g} degrees and more."
        ]
    if len(data.models()) > 1:
        colors = ", ".join(f"{trace.name} {color_name(data, trace)}" for trace in data.models())
        return [f"Each model's path has a colour of its own, the same as in the plots of total errors: {colors}."]
    return []


def _figures(data: RunData) -> list[str]:
    rows = [[label, *map(_cell, values)] for label, values in data.table()]
    return ["## Figures", "", *table(["figure", *_names(data)], rows), ""] if rows else []


def _windows(data: RunData) -> list[str]:
    """Root mean square errors at the ends of windows, a row for each length and run."""
    rows = [
        [f"{w.length_s:g} s", escape(trace.name), str(w.count), *map(_cell, (w.orientation_deg, w.velocity_m_s, w.position_m))]
        for trace in data.traces
        for w in trace.windows
    ]
    heads = ["window", "run", "count", "orientation (deg)", "velocity (m/s)", "position (m)"]
    said = "Root mean square errors at the ends of windows that each start from the truth."
    return ["## Windows", "", said, "", *table(heads, rows), ""] if rows else []


def _events(data: RunData) -> list[str]:
    if not data.events:
        return []
    first_ns = data.start_ns
    rows = [
        [
            f"{(e.start_ns - first_ns) * 1e-9:.3f}",
            f"{(e.end_ns - e.start_ns) * 1e-9:.3f}",
            e.kind.replace("_", " "),
            escape(e.text),
        ]
        for e in data.events[:MOST_EVENTS]
    ]
    left = len(data.events) - len(rows)
    more = [f"{left} more are in the tab Events.", ""] if left > 0 else []
    return ["## Events", "", *table(["at (s)", "for (s)", "kind", "what"], rows), "", *more]


def _names(data: RunData) -> list[str]:
    return [escape(trace.name) for trace in data.traces]


def _cell(value: float | None) -> str:
    """Four digits are enough to compare; no exponent for what has more."""
    if value is None:
        return ""
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.4g}"
