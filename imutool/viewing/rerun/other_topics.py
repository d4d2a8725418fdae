"""Import cameras and other topics of the log into the recording, through Rerun."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from imutool.errors import LogError
from imutool.mcap_io.codec import ros2_definition, schemas
from imutool.mcap_io.codec.formats import MAX_FIELDS
from imutool.mcap_io.index import LogIndex
from imutool.mcap_io.recovery.recovered_log import RecoveredLog
from imutool.mcap_io.topics import DERIVED_KEY
from imutool.recording import Times
from imutool.viewing.model.run_data import TRUE_BIAS, RunData
from imutool.viewing.rerun import rr, sdk
from imutool.viewing.rerun.sdk import Scope, entity_path

if TYPE_CHECKING:
    from rerun.chunk import Chunk

logger = logging.getLogger(__name__)

SOURCE_LIMIT = 256_000_000  # bytes: a larger log is not imported into the viewer's memory
DECODERS = ("ros2msg", "ros2_reflection", "foxglove", "protobuf")  # not `raw`: bytes without a meaning
MARGIN_NS = 60_000_000_000  # header stamps further outside the IMU's time come from another clock
OWN_ENTITIES = {"world", "imu", "bias", "error", "spectrum", "events", "report", "legend", "compare", "run", "source"}
NOT_SHOWN = "The log's other topics are not shown"


@dataclass(frozen=True)
class ImportPlan:
    """Import of a log by Rerun: cameras, topics already drawn, and the reason for no import."""

    wanted: bool = False
    left_out: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()  # entities
    sentence: str = ""


def plan_import(data: RunData, scope: Scope) -> ImportPlan:
    """Plan the import of a log's file; no import without a file or above SOURCE_LIMIT bytes."""
    if not isinstance(data.source, Path):
        return ImportPlan()
    try:
        size = data.source.stat().st_size
        if size > SOURCE_LIMIT:
            return ImportPlan(
                sentence=f"{NOT_SHOWN}: the log has {size / 1e6:.0f} MB, more than the limit of {SOURCE_LIMIT / 1e6:.0f} MB."
            )
        with RecoveredLog(data.source) as log:
            topics = tuple(log.topics.values())
            endless = tuple(log.index.channels[i].topic for i in sorted(log.index.channels) if _is_endless(log.index, i))
    except (OSError, LogError) as error:
        return ImportPlan(sentence=f"{NOT_SHOWN}: {error}")
    drawn = {data.provenance[key] for key in ("IMU", "truth") if key in data.provenance}
    drawn |= {TRUE_BIAS[kind] for kind in data.true_bias}
    left_out = tuple(topic.name for topic in topics if topic.name in drawn or topic.metadata.get(DERIVED_KEY) in drawn)
    left_out += endless
    sentence = f"{', '.join(endless)} not shown: the definition has too many fields, or is none." if endless else ""
    if scope and (frames := tuple(topic.name for topic in topics if topic.schema_name in (schemas.TF, schemas.TRANSFORM))):
        left_out += frames  # a viewer has one set of frames, and both logs would move the same ones
        sentence += " " * bool(sentence)
        sentence += f"Its transforms ({', '.join(frames)}) are not shown: the other logs may name the same frames."
    names = [topic.name.split("/") for topic in topics if topic.schema_name == schemas.IMAGE and topic.count]
    cameras = tuple(_entity_of_topic(entity_path((), *filter(None, parts)), data, scope) for parts in names)
    return ImportPlan(True, left_out, cameras, sentence)


def _is_endless(index: LogIndex, channel: int) -> bool:
    """Whether a channel's definition is too large for Rerun, which takes each nested message anew and cannot be stopped."""
    schema = index.schemas.get(index.channels[channel].schema_id)
    if schema is None or schema.encoding != "ros2msg":
        return False
    try:
        definition = ros2_definition.parse(schema.name, schema.data)
    except LogError:
        return True
    sizes: dict[str, int] = {}

    def size(kind: str) -> int:
        if kind not in sizes:
            sizes[kind] = sum(1 + (size(field.kind) if field.kind in definition else 0) for field in definition[kind])
        return sizes[kind]

    return size("") > MAX_FIELDS


def log(data: RunData, to: rr.RecordingStream, scope: Scope) -> list[str]:
    """Log the log's other topics and return notes on missing ones.

    Times are the log's own on `ros2_timestamp` and `message_log_time`; `elapsed` follows from the header stamp, or from
    the log time where a message has none on the IMU's clock.
    """
    plan = plan_import(data, scope)
    notes = [plan.sentence] if plan.sentence else []
    if not plan.wanted or data.source is None:
        return notes
    from rerun.chunk import McapReader

    exclude = [f"^{re.escape(topic)}$" for topic in plan.left_out]
    try:
        reader = McapReader(data.source, decoders=DECODERS, exclude_topic_regex=exclude, recover=True)
        to.send_chunks(_on_our_timelines(reader.stream(), data, scope))
    except (ValueError, RuntimeError, OSError) as error:
        logger.debug("%s", error, exc_info=True)
        return [*notes, f"{NOT_SHOWN}: Rerun cannot read them ({error})."]
    return notes


def _entity_of_topic(entity: str, data: RunData, scope: Scope) -> str:
    """Entity path of a topic: its own name, below `source` where we use that name."""
    first = entity.removeprefix("/").partition("/")[0]
    taken = OWN_ENTITIES | {entity_path((), trace.name).removeprefix("/") for trace in data.traces}
    below = (*scope, "source") if first in taken else scope
    return f"{entity_path(below) if below else ''}{entity}"


def _on_our_timelines(chunks: Iterable[Chunk], data: RunData, scope: Scope) -> Iterator[Chunk]:
    """Chunks of topics at their entity paths, on our timelines."""
    for chunk in chunks:
        if chunk.is_empty or chunk.entity_path.startswith("/__"):  # properties of the file
            continue
        moved = chunk.with_entity_path(_entity_of_topic(chunk.entity_path, data, scope))
        yield from [moved] if chunk.is_static else _with_elapsed(moved, data)


def _with_elapsed(chunk: Chunk, data: RunData) -> list[Chunk]:
    """Chunk with `elapsed` and without the publish time, on which nothing else lies."""
    import pyarrow as pa
    from rerun.chunk import Chunk

    batch = chunk.to_record_batch()
    elapsed = elapsed_ns(_times_ns(batch, sdk.STAMP), _times_ns(batch, sdk.LOG_TIME), data)
    fields, columns = [], []
    for field, column in zip(batch.schema, batch.columns, strict=True):
        if field.name == "message_publish_time":
            continue
        fields.append(field)
        columns.append(column)
        if field.name == sdk.LOG_TIME:
            metadata = {**(field.metadata or {}), b"rerun:index_name": sdk.ELAPSED.encode()}
            metadata.pop(b"rerun:is_sorted", None)  # of the log time; header stamps may be in another order
            fields.append(pa.field(sdk.ELAPSED, pa.duration("ns"), nullable=False, metadata=metadata))
            columns.append(pa.array(elapsed, pa.duration("ns")))
    return Chunk.from_record_batch(pa.record_batch(columns, schema=pa.schema(fields, metadata=batch.schema.metadata)))


def elapsed_ns(stamp_ns: Times | None, log_ns: Times | None, data: RunData) -> Times:
    """Time since the first IMU sample, by header stamps on its clock, else by log times."""
    if stamp_ns is not None:
        inside = (stamp_ns > data.start_ns - MARGIN_NS) & (stamp_ns < data.end_ns + MARGIN_NS)
        if inside.all():
            elapsed: Times = stamp_ns - data.start_ns
            return elapsed
    assert log_ns is not None, "every message of an MCAP log has a log time"
    begin: Times = data.log_ns(np.array([data.start_ns], dtype=np.int64))
    since: Times = log_ns - begin[0]
    return since


def _times_ns(batch: Any, name: str) -> Times | None:
    """Timeline of a batch as int64 nanoseconds, or None."""
    if name not in batch.schema.names:
        return None
    times: Times = batch.column(name).cast("int64").to_numpy()
    return times
