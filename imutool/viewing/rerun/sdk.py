"""Rerun SDK access: recording streams, entity paths and the three timelines."""

from __future__ import annotations

import re
import uuid
from collections.abc import Callable, Sequence
from typing import Literal

from imutool.errors import ConfigError
from imutool.recording import Times
from imutool.viewing.model.run_data import RunData, Trace
from imutool.viewing.rerun import rr

Role = Literal["raw", "debiased"]
Scope = tuple[str, ...]  # leading parts of the entity paths of one log; empty for the root

FLUSH_S = 30.0

# Rerun's MCAP reader gives the last two names to header stamps and log times, so that the log's other topics line up.
ELAPSED, STAMP, LOG_TIME = TIMELINES = ("elapsed", "ros2_timestamp", "message_log_time")


def new_stream(name: str, *, application: str | None = None, recording: str | None = None) -> rr.RecordingStream:
    """Create a recording stream in an application of its own: Rerun keeps a layout for each.

    `application` and `recording` are the ids of a recording that a viewer shows already.

    The stream has no `log_time` and no `log_tick`: the time of drawing tells the user nothing.

    Raises:
        ConfigError: Rerun is not installed.
    """
    short = safe_name(name)
    stream = rr.RecordingStream(application or f"imutool {short}", recording_id=recording or f"{short}-{uuid.uuid4().hex[:8]}")
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    return stream


def rrd_bytes(recording: rr.RecordingStream, send: Callable[[rr.RecordingStream], None]) -> bytes:
    """Content of an .rrd file with what `send` logs into a recording."""
    written = rr.binary_stream(recording)
    send(recording)
    content = written.read(flush_timeout_sec=FLUSH_S)
    assert content, "a stream that was written to holds bytes"
    return bytes(content)


def recording_name(logs: Sequence[RunData]) -> str:
    """Name of a recording of one or several logs, valid as a file name and as an application id.

    Raises:
        ConfigError: no log.
    """
    if not logs:
        raise ConfigError("there is no log to show", where="view")
    more = f"_and_{len(logs) - 1}_more" if len(logs) > 1 else ""
    return safe_name(logs[0].name) + more


def safe_name(name: str) -> str:
    """Name with every character replaced that is unsafe in file names, paths or application ids."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", name)[:100] or "_"


def rerun_version() -> str:
    """Version of the installed Rerun SDK and of the viewer that ships with it."""
    return str(rr.__version__)


def scopes(logs: Sequence[RunData], root: Scope) -> list[Scope]:
    """Scope of each log: the root for one log, `run/NAME` below it for several."""
    if len(logs) == 1:
        return [root]
    return [(*root, "run", name) for name in unique_names([data.name or "log" for data in logs])]


def unique_names(names: Sequence[str], taken: Sequence[str] = ()) -> list[str]:
    """Names that differ from each other and from `taken`: repeated ones get a number from 2 on."""
    unique: list[str] = []
    for name in names:
        candidate, number = name, 2
        while candidate in unique or candidate in taken:
            candidate, number = f"{name} ({number})", number + 1
        unique.append(candidate)
    return unique


def role(trace: Trace) -> Role:
    """Name of a trace in an entity path."""
    return "raw" if trace.is_raw else "debiased"


def label(data: RunData, trace: Trace) -> str:
    """Name of a trace in a title; model names without their common first words."""
    if trace.is_raw or len(data.models()) < 2:
        return role(trace)
    return trace.name[_common_prefix_length([model.name for model in data.models()]) :] or trace.name


def _common_prefix_length(names: Sequence[str]) -> int:
    """Number of letters in the hyphen-ended words that all names begin with."""
    shortest = min(map(len, names))
    same = next((k for k in range(shortest) if len({name[k] for name in names}) > 1), shortest)
    return names[0].rfind("-", 0, same) + 1


def entity_path(scope: Scope, *parts: str) -> str:
    """Entity path from the root; each part may hold any character."""
    return f"/{str(rr.new_entity_path([*scope, *parts])).removeprefix('/')}"


def trace_path(data: RunData, trace: Trace, scope: Scope, *parts: str) -> str:
    """Entity path of one trace; each of several models has its own scope."""
    if not trace.is_raw and len(data.models()) > 1:
        scope = (*(scope or ("run",)), trace.name)
    return entity_path(scope, *parts)


def log_static(to: rr.RecordingStream, entity: str, *what: rr.AsComponents) -> None:
    """Log what holds at all times."""
    to.log(entity, *what, static=True, strict=True)


def log_columns(
    to: rr.RecordingStream, entity: str, style: rr.AsComponents, times: Sequence[rr.TimeColumn], columns: rr.ComponentColumnList
) -> None:
    """Log columns after their style, so that the viewer chooses none."""
    log_static(to, entity, style)
    # strict: Rerun only warns of a length that does not match, and then the rows are missing
    to.send_columns(entity, times, columns, strict=True)


def time_columns(stamp_ns: Times, log_ns: Times, start_ns: int) -> list[rr.TimeColumn]:
    """Time columns in nanoseconds: time since the first IMU sample, header stamp, log time."""
    return [
        elapsed_column(stamp_ns - start_ns),
        rr.TimeColumn(STAMP, timestamp=stamp_ns.astype("datetime64[ns]")),
        rr.TimeColumn(LOG_TIME, timestamp=log_ns.astype("datetime64[ns]")),
    ]


def elapsed_column(elapsed_ns: Times) -> rr.TimeColumn:
    """Time column of nanoseconds since the start."""
    return rr.TimeColumn(ELAPSED, duration=elapsed_ns.astype("timedelta64[ns]"))


def data_times(data: RunData, stamp_ns: Times) -> list[rr.TimeColumn]:
    """Time columns for header stamps of one log."""
    return time_columns(stamp_ns, data.log_ns(stamp_ns), data.start_ns)
