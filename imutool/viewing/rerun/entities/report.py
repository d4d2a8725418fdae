"""Markdown report in the viewer: figures, windows, events, notes and provenance."""

from __future__ import annotations

import re
from collections.abc import Sequence

from imutool.viewing.model.run_data import RunData
from imutool.viewing.model.trajectory_error import WINDOWS_NOTE
from imutool.viewing.rerun import rr, sdk
from imutool.viewing.rerun.entities.paths import error_scale_top
from imutool.viewing.rerun.entities.styles import color_name
from imutool.viewing.rerun.sdk import Scope

MAX_EVENTS = 40  # in the list; the Events tab shows all


def log_report(data: RunData, to: rr.RecordingStream, scope: Scope, more: Sequence[str]) -> None:
    """Log the text of `markdown` as `report`."""
    text = rr.TextDocument(markdown(data, more), media_type="text/markdown")
    sdk.log_static(to, sdk.entity_path(scope, "report"), text)


def log_comparison(logs: Sequence[RunData], to: rr.RecordingStream) -> None:
    """Log a table of the figures of several logs as `compare`."""
    sdk.log_static(to, "compare", rr.TextDocument(comparison(logs), media_type="text/markdown"))


def markdown(data: RunData, more: Sequence[str]) -> str:
    """Report on one log as Markdown; `more` are sentences after the log's own notes."""
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
    """Table with a row for each run of each log and a column for each figure."""
    labels = list(dict.fromkeys(label for data in logs for label, _ in data.table()))
    rows = []
    for data in logs:
        values = dict(data.table())
        for k, trace in enumerate(data.traces):
            cells = [_cell(values[label][k]) if label in values else "" for label in labels]
            rows.append([escape(data.name), escape(trace.name), *cells])
    return "\n".join([f"# {len(logs)} logs", "", *table(["log", "run", *labels], rows)])


def _colors(data: RunData) -> list[str]:
    """Meaning of the colours of the paths."""
    top = error_scale_top(data)
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
    return ["## Figures", "", *table(["figure", *(escape(trace.name) for trace in data.traces)], rows), ""] if rows else []


def _windows(data: RunData) -> list[str]:
    """Root mean square errors at the ends of windows, one row for each length and run."""
    rows = [
        [f"{w.length_s:g} s", escape(trace.name), str(w.count), *map(_cell, (w.orientation_deg, w.velocity_m_s, w.position_m))]
        for trace in data.traces
        for w in trace.windows
    ]
    heads = ["window", "run", "count", "orientation (deg)", "velocity (m/s)", "position (m)"]
    return ["## Windows", "", WINDOWS_NOTE, "", *table(heads, rows), ""] if rows else []


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
        for e in data.events[:MAX_EVENTS]
    ]
    hidden = len(data.events) - len(rows)
    more = [f"The tab Events shows {hidden} more.", ""] if hidden > 0 else []
    return ["## Events", "", *table(["at (s)", "for (s)", "kind", "what"], rows), "", *more]


def _cell(value: float | None) -> str:
    """Four digits, without an exponent for larger numbers."""
    if value is None:
        return ""
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.4g}"


def escape(text: str) -> str:
    """Escape a text from a log on one line of Markdown."""
    plain = "".join(letter if letter.isprintable() else " " for letter in text)
    return re.sub(r"([\\`*_{}\[\]<>#|!~&])", r"\\\1", plain)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table; its cells must be escaped already."""
    return [_row(head), _row(["---"] * len(head)), *map(_row, rows)]


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
