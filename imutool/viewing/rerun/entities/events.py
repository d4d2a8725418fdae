"""What happened and when: a lane of states for each kind, and a text at the beginning of each event."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from imutool.viewing.model.events import KINDS, Event
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun.entities import clock, names
from imutool.viewing.rerun.entities.names import Scope
from imutool.viewing.rerun.entities.palette import EVENT_COLOR, GREY, MODEL_COLORS, WORST_COLOR, Color

if TYPE_CHECKING:
    import rerun as rr

INSIDE, OUTSIDE = "here", "elsewhere"
LEAST_SHARE = 0.003  # of the log: the width of a moment in its lane, where it would else not be seen; its text is exact
HARMLESS = {"stop"}
COLORS: dict[str, Color] = {
    "stop": GREY,
    "worst": WORST_COLOR,
    "finding": MODEL_COLORS[0],
}  # the others are all the log's faults


def kinds(data: RunData) -> list[str]:
    """The kinds of event that the log has, in the order of their list."""
    found = {event.kind for event in data.events}
    return [kind for kind in KINDS if kind in found]


def log(data: RunData, to: rr.RecordingStream, scope: Scope) -> None:
    """`events/KIND` for each kind there is."""
    import rerun as rr

    for kind in kinds(data):
        events = sorted((event for event in data.events if event.kind == kind), key=lambda event: event.start_ns)
        entity = names.path(scope, "events", kind)
        label = kind.replace("_", " ")
        style = rr.StateConfiguration(
            values=[INSIDE, OUTSIDE], labels=[label, ""], colors=[COLORS.get(kind, EVENT_COLOR), GREY], visible=[True, False]
        )
        to.log(entity, style, static=True, strict=True)
        turns = states(events, data)
        columns = rr.StateChange.columns(state=[state for _, state in turns])
        to.send_columns(entity, clock.at(data, np.array([t_ns for t_ns, _ in turns], dtype=np.int64)), columns, strict=True)
        level = "INFO" if kind in HARMLESS else "WARN"
        texts = rr.TextLog.columns(text=[event.text for event in events], level=[level] * len(events))
        stamps = np.array([event.start_ns for event in events], dtype=np.int64)
        to.send_columns(entity, clock.at(data, stamps), texts, strict=True)


def states(events: Sequence[Event], data: RunData) -> list[tuple[int, str]]:
    """Where `here` and `elsewhere` begin: events that overlap are one, and a moment is as wide as can be seen."""
    least_ns = round(LEAST_SHARE * (data.end_ns - data.start_ns))
    spans: list[tuple[int, int]] = []
    for event in events:
        start_ns, end_ns = event.start_ns, event.end_ns
        if end_ns - start_ns < least_ns:  # backwards, if the log ends before
            start_ns = min(start_ns, data.end_ns - least_ns)
            end_ns = start_ns + least_ns
        if spans and start_ns <= spans[-1][1]:
            spans[-1] = (spans[-1][0], max(spans[-1][1], end_ns))
        else:
            spans.append((start_ns, end_ns))
    turns = [(data.start_ns, OUTSIDE)] if spans[0][0] > data.start_ns else []
    return turns + [turn for first, last in spans for turn in ((first, INSIDE), (last, OUTSIDE))]
