"""The log itself in the same recording, read by Rerun: cameras and other topics on our timelines, under their own names."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from imutool.errors import LogError
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.recovery.recovered_log import RecoveredLog
from imutool.mcap_io.topics import DERIVED_KEY, Topic
from imutool.recording import Times
from imutool.viewing.model.run_data import TRUE_BIAS, RunData
from imutool.viewing.rerun.entities import clock
from imutool.viewing.rerun.entities.names import Scope, path

if TYPE_CHECKING:
    import rerun as rr
    from rerun.chunk import Chunk

logger = logging.getLogger(__name__)

SOURCE_LIMIT = 256_000_000  # bytes of a log that are read into a viewer's memory unasked
DECODERS = ("ros2msg", "ros2_reflection", "foxglove", "protobuf")  # not `raw`: bytes that nobody can look at
MARGIN_NS = 60_000_000_000  # header stamps further outside the IMU's time are another clock's
OURS = {"world", "imu", "bias", "error", "spectrum", "events", "report", "legend", "compare", "run", "source"}
SENTENCE = "The log's other topics are not shown"


@dataclass(frozen=True)
class Import:
    """What of a log Rerun reads: every topic but those that are drawn already, cameras among them; and why not, in words."""

    wanted: bool = False
    left_out: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()  # entities
    sentence: str = ""


def plan(data: RunData, scope: Scope) -> Import:
    """What will be read of a log's file: nothing where there is none, or where it is larger than SOURCE_LIMIT bytes."""
    if not isinstance(data.source, Path):
        return Import()
    try:
        size = data.source.stat().st_size
        if size > SOURCE_LIMIT:
            return Import(
                sentence=f"{SENTENCE}: it has {size / 1e6:.0f} MB, and {SOURCE_LIMIT / 1e6:.0f} is the most that is read."
            )
        with RecoveredLog(data.source) as log:
            topics = tuple(log.topics.values())
    except (OSError, LogError) as error:
        return Import(sentence=f"{SENTENCE}: {error}")
    drawn = {data.provenance[key] for key in ("IMU", "truth") if key in data.provenance}
    drawn |= {TRUE_BIAS[kind] for kind in data.true_bias}
    left_out = tuple(topic.name for topic in topics if topic.name in drawn or topic.metadata.get(DERIVED_KEY) in drawn)
    sentence = ""
    if scope and (frames := tuple(topic.name for topic in topics if topic.schema_name in (schemas.TF, schemas.TRANSFORM))):
        left_out += frames  # a viewer has one set of frames, and both logs would move the same
        sentence = f"Its transforms ({', '.join(frames)}) are not shown: other logs are, which may name the same frames."
    cameras = tuple(_camera(topic, data, scope) for topic in topics if topic.schema_name == schemas.IMAGE and topic.count)
    return Import(True, left_out, cameras, sentence)


def log(data: RunData, to: rr.RecordingStream, scope: Scope) -> list[str]:
    """Sends the log's other topics, and returns sentences about what is missing.

    Times are those of the log on `ros2_timestamp` and `message_log_time`; `elapsed` follows from the header stamp, or from
    the log time where a message has none on the IMU's clock.
    """
    what = plan(data, scope)
    said = [what.sentence] if what.sentence else []
    if not what.wanted or data.source is None:
        return said
    from rerun.chunk import McapReader

    exclude = [f"^{re.escape(topic)}$" for topic in what.left_out]
    try:
        reader = McapReader(data.source, decoders=DECODERS, exclude_topic_regex=exclude, recover=True)
        to.send_chunks(_placed(reader.stream(), data, scope))
    except (ValueError, RuntimeError, OSError) as error:
        logger.debug("%s", error, exc_info=True)
        return [*said, f"{SENTENCE}: Rerun cannot read them ({error})."]
    return said


def _camera(topic: Topic, data: RunData, scope: Scope) -> str:
    return _place(path((), *(part for part in topic.name.split("/") if part)), data, scope)


def _place(entity: str, data: RunData, scope: Scope) -> str:
    """Where a topic's entity lies: under its own name, below `source` where that is a name of ours."""
    first = entity.removeprefix("/").partition("/")[0]
    taken = OURS | {path((), trace.name).removeprefix("/") for trace in data.traces}
    below = (*scope, "source") if first in taken else scope
    return f"{path(below) if below else ''}{entity}"


def _placed(chunks: Iterable[Chunk], data: RunData, scope: Scope) -> Iterator[Chunk]:
    """The chunks of topics, in place and on our timelines."""
    for chunk in chunks:
        if chunk.is_empty or chunk.entity_path.startswith("/__"):  # properties of the file as Rerun sees it
            continue
        moved = chunk.with_entity_path(_place(chunk.entity_path, data, scope))
        yield from [moved] if chunk.is_static else _timed(moved, data)


def _timed(chunk: Chunk, data: RunData) -> list[Chunk]:
    """A chunk with `elapsed`, and without the publish time that nothing else here is on."""
    import pyarrow as pa
    from rerun.chunk import Chunk

    batch = chunk.to_record_batch()
    elapsed = elapsed_ns(_ns(batch, clock.STAMP), _ns(batch, clock.LOG_TIME), data)
    fields, columns = [], []
    for field, column in zip(batch.schema, batch.columns, strict=True):
        if field.name == "message_publish_time":
            continue
        fields.append(field)
        columns.append(column)
        if field.name == clock.LOG_TIME:
            metadata = {**(field.metadata or {}), b"rerun:index_name": clock.ELAPSED.encode()}
            metadata.pop(b"rerun:is_sorted", None)  # of the log time; header stamps may be in another order
            fields.append(pa.field(clock.ELAPSED, pa.duration("ns"), nullable=False, metadata=metadata))
            columns.append(pa.array(elapsed, pa.duration("ns")))
    return Chunk.from_record_batch(pa.record_batch(columns, schema=pa.schema(fields, metadata=batch.schema.metadata)))


def elapsed_ns(stamp_ns: Times | None, log_ns: Times | None, data: RunData) -> Times:
    """Time since the first IMU sample, by header stamps if all are on its clock, else by log times."""
    if stamp_ns is not None:
        inside = (stamp_ns > data.start_ns - MARGIN_NS) & (stamp_ns < data.end_ns + MARGIN_NS)
        if inside.all():
            elapsed: Times = stamp_ns - data.start_ns
            return elapsed
    assert log_ns is not None, "every message of an MCAP log has a log time"
    begin: Times = data.log_ns(np.array([data.start_ns], dtype=np.int64))
    since: Times = log_ns - begin[0]
    return since


def _ns(batch: Any, name: str) -> Times | None:
    """A timeline of a batch as int64 nanoseconds; none where it has none."""
    if name not in batch.schema.names:
        return None
    times: Times = batch.column(name).cast("int64").to_numpy()
    return times
