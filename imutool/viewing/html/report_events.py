"""What happened in a log and when, in lanes and in a table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

from imutool.viewing.html.drawing import Panel, Picture
from imutool.viewing.html.page import text
from imutool.viewing.html.report_wording import number
from imutool.viewing.html.theme import AFTER, BEFORE, HELD, MARK
from imutool.viewing.model.events import KINDS, Event
from imutool.viewing.model.run_data import RunData

MOST_ROWS = 40
LEAST_SHARE = 0.002  # of the time, so that one sample in an hour is seen
LANE_INCH, EDGES_INCH = 0.24, 0.75
HARMLESS = {"stop": HELD, "finding": AFTER, "worst": BEFORE}


def lanes(data: RunData) -> Picture | None:
    """A lane for each kind of event that there is; nothing where nothing happened."""
    kinds = [kind for kind in KINDS if any(event.kind == kind for event in data.events)]
    if not kinds:
        return None
    height = EDGES_INCH + LANE_INCH * len(kinds)
    panel = Panel(partial(_draw, data=data, kinds=kinds), height, f"Events over time: {', '.join(map(told, kinds))}", wide=True)
    return Picture("events", "Events", "", (panel,))


def table(data: RunData) -> Iterator[str]:
    """The first events of each kind in words, in the order of time; how many more there are is said."""
    shown = sorted(_first(data.events), key=lambda event: event.start_ns)
    yield '<div class="scroll"><table><thead><tr><th>From (s)</th><th>For</th><th>What</th><th></th></tr></thead><tbody>'
    for event in shown:
        start_s, seconds = (event.start_ns - data.start_ns) * 1e-9, (event.end_ns - event.start_ns) * 1e-9
        length = f"{number(seconds)} s" if seconds > 0.0 else "a moment"
        yield (
            f"<tr><td class=number>{start_s:.3f}</td><td class=number>{length}</td>"
            f"<td class=entry>{told(event.kind)}</td><td>{text(event.text)}</td></tr>"
        )
    yield "</tbody></table></div>"
    if len(shown) < len(data.events):
        yield f'<p class="note">{len(data.events) - len(shown):,} more are drawn above and not listed.</p>'


def told(kind: str) -> str:
    """A kind of event in words."""
    return {"worst": "worst error"}.get(kind, kind.replace("_", " "))


def _first(events: Sequence[Event]) -> list[Event]:
    """As many as there is room for, of every kind the same number."""
    kinds = {event.kind for event in events}
    share = max(1, MOST_ROWS // max(len(kinds), 1))
    return [event for kind in kinds for event in [one for one in events if one.kind == kind][:share]]


def _draw(figure: Any, *, data: RunData, kinds: Sequence[str]) -> None:
    axes = figure.subplots()
    least = LEAST_SHARE * data.duration_s
    for lane, kind in enumerate(kinds):
        bars = []
        for event in data.events:
            if event.kind == kind:
                first, length = (event.start_ns - data.start_ns) * 1e-9, (event.end_ns - event.start_ns) * 1e-9
                bars.append((min(first, data.duration_s - least), max(length, least)))
        axes.broken_barh(bars, (-lane - 0.4, 0.8), color=HARMLESS.get(kind, MARK), lw=0, label=f"{told(kind)}: {len(bars)}")
    axes.set_yticks([-lane for lane in range(len(kinds))], [told(kind) for kind in kinds])
    axes.tick_params(axis="y", length=0)
    axes.set(xlim=(0.0, data.duration_s), ylim=(-len(kinds) + 0.4, 0.6), xlabel="time (s)")
    axes.grid(visible=False, axis="y")
