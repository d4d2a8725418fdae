"""Read an MCAP log in file order: whole columns, one chunk in memory, every CRC checked."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType, TracebackType

import numpy as np
from mcap.opcode import Opcode

from imutool.array_types import Int64, UInt64
from imutool.errors import ConfigError, DataError, LogError
from imutool.file_location import Location, location
from imutool.mcap_io.blocks import MessageBlock, RecordSpan
from imutool.mcap_io.codec import messages, records, schemas
from imutool.mcap_io.codec.decode import CLEAN_FIX, ImuBatch, PoseBatch, StampCheck, check_finite
from imutool.mcap_io.codec.joined_imu import choice_of, no_imu_fix, parse_parts, whole_of
from imutool.mcap_io.codec.records import HEAD, keep_buffers
from imutool.mcap_io.index import LogIndex
from imutool.mcap_io.passthrough.chunk_check import KeptChunks, neighbours, unpack_together
from imutool.mcap_io.storage.source import Source
from imutool.mcap_io.topics import ENCODINGS, MESSAGE_POSES, PART_KEY, Topic, joined_topic, reflected_topics, topics_of
from imutool.recording.message_log import COMMAND

logger = logging.getLogger(__name__)


class Log:
    """An MCAP file or object in a store, open for reading.

    Memory is bounded by the largest chunk; a chunk of more than `max_chunk` bytes is refused. The path may also be an open
    `Source`. Times in a method's arguments select by log time, both ends included. The first damage is an error;
    `recovery.recovered_log.RecoveredLog` reads the intact part of a damaged log. Threads open a log each. A log without
    `reads_topics` is copied or checked as it is: a topic may have two types.

    Raises:
        ConfigError: the file cannot be opened, or `max_chunk` is less than one.
        LogError: empty, not an MCAP log, cut short or damaged.
    """

    index: LogIndex

    def __init__(self, path: str | Location | Source, *, max_chunk: int | None = None, reads_topics: bool = True) -> None:
        if max_chunk is not None and max_chunk < 1:
            raise ConfigError(f"{max_chunk} bytes", where="max_chunk", expected="1 or more")
        keep_buffers()
        self._reads_topics = reads_topics
        self.max_chunk = records.MAX_CHUNK if max_chunk is None else max_chunk
        self._source = path if isinstance(path, Source) else Source(location(path))
        self._owns_source, self.path = True, self._source.path
        self.kept: KeptChunks | None = None
        self._ids = (0, 0), dict[str, set[int]]()  # channels by topic, of an index and so many channels
        try:
            with self.named():
                self.index = self._read_index(self._source)
                self._read_topics()
        except BaseException:
            self.close()
            raise

    def _read_index(self, source: Source) -> LogIndex:
        return LogIndex(source, self.max_chunk)

    def _read_topics(self) -> None:
        """Reads the topics from the index; IMUs of other types may need the first messages."""
        if not self._reads_topics:
            return
        self.topics = MappingProxyType(topics_of(self.index))
        self.topics = MappingProxyType({**self.topics, **reflected_topics(self.index, self.topics, self.firsts, self.rows)})

    def __repr__(self) -> str:
        return f"<log {self.path}: {self.listing()}>"

    def __enter__(self) -> Log:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Closes the file, unless another `Log` has taken it over (`RecoveredLog.strict`)."""
        if self._owns_source:
            self._source.file.close()

    def check(self) -> None:
        """Reads every chunk and attachment and compares its CRC; LogError at the first damage."""
        with self.named():
            self.index.check()

    @contextmanager
    def named(self, topic: str = "") -> Iterator[None]:
        """Adds the log's path and a topic to errors that have no place yet."""
        try:
            yield
        except (LogError, DataError) as error:
            if isinstance(error, LogError) and error.where is not None:
                raise
            where = f"{self.path} {topic}" if topic else self.path
            raise LogError(error.what, where=where, expected=error.expected, fix=error.fix) from error

    @property
    def imu_topics(self) -> list[str]:
        """IMU topics, none of them computed or part of another; silent ones only if all are."""
        found = [t for t in self.with_schema((schemas.IMU,)) if not t.is_derived and PART_KEY not in t.metadata]
        return [t.name for t in found if t.count] or [t.name for t in found]

    def only_imu(self) -> str:
        """The log's IMU, where there is exactly one; LogError of others, or none."""
        found = self.imu_topics
        if not found:
            raise self.no_imu()
        if len(found) > 1:
            raise LogError(f"the log has {len(found)} IMU topics: {', '.join(found)}", where=self.path, fix=choice_of(found))
        return found[0]

    def no_imu(self) -> LogError:
        """Error of a log without an IMU."""
        fix = no_imu_fix((t.schema_name, t.message_encoding, t.schema_encoding) for t in self.topics.values())
        return LogError("the log has no IMU topic", where=self.path, expected=f"{schemas.IMU} among {self.listing()}", fix=fix)

    @property
    def pose_topics(self) -> list[str]:
        """Topics with poses of a body; /tf where it is the truth or no other topic has poses, and never /tf_static."""
        dedicated = [t.name for t in self.with_schema(MESSAGE_POSES) if t.pose_kind != COMMAND]
        trees = (t for t in self.with_schema((schemas.TF,)) if not t.name.endswith("tf_static"))
        return dedicated + [t.name for t in trees if not dedicated or t.pose_kind == "truth"]

    @property
    def truth_topics(self) -> list[str]:
        """Pose topics that may serve as truth: true ones first, then those of unknown kind; no estimate and no odometry."""
        return [n for kind in ("truth", "unknown") for n in self.pose_topics if self.topics[n].pose_kind == kind]

    def with_schema(self, schema_names: Collection[str]) -> list[Topic]:
        """Topics with one of these message types, in order of their channel ids."""
        return [t for t in self.topics.values() if t.schema_name in schema_names]

    def topic(self, name: str, schema_names: Collection[str]) -> Topic:
        """A topic by name, with one of these message types in an encoding that imutool reads.

        `gyro=TOPIC,accel=TOPIC` joins two topics to one IMU, and logs the delay between them. LogError if there is none such.
        """
        if (parts := parse_parts(name)) is not None:
            return self._join(*(self.topic(part, (schemas.IMU, *schemas.VECTORS)) for part in parts))
        fitting = " or ".join(topic.name for topic in self.with_schema(schema_names))
        if name not in self.topics:
            raise LogError(f"there is no topic {name}", where=self.path, expected=fitting or self.listing())
        found = self.topics[name]
        if found.schema_name not in schema_names:
            what = f"{name} carries {found.schema_name or 'messages without schema'}"
            raise LogError(what, where=self.path, expected=fitting or " or ".join(schema_names))
        if not found.is_read:
            raise LogError(f"{name} is encoded as {found.message_encoding!r}", where=self.path, expected=" or ".join(ENCODINGS))
        return found

    def _join(self, gyro: Topic, accel: Topic) -> Topic:
        if (known := self.topics.get(name := whole_of((gyro.name, accel.name)))) is None:
            with self.named(name):
                known, notes = joined_topic(gyro, accel, lambda topic: (rows for _, rows in self.rows([topic])))
            self.topics = MappingProxyType({**self.topics, name: known})
            for note in notes:
                logger.warning("%s: %s", self.path, note)
        return known

    def listing(self) -> str:
        """The log's topics and their schemas, for a message."""
        every = (f"{t.name} ({t.schema_name or 'no schema'})" for t in self.topics.values())
        return ", ".join(every) or "topics (the log has none)"

    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata records by name; in records of the same name, later entries replace earlier ones."""
        found: dict[str, dict[str, str]] = {}
        for name, values in self.metadata_records():
            found.setdefault(name, {}).update(values)
        return found

    def metadata_records(self) -> list[tuple[str, dict[str, str]]]:
        """Every metadata record, in file order; LogError of a damaged one."""
        found = []
        with self.named():
            for item in self.index.items:
                if isinstance(item, RecordSpan) and item.opcode == Opcode.METADATA:
                    record = item.metadata(self._source)
                    found.append((record.name, dict(record.metadata)))
        return found

    def stamps(self, topic: str) -> Iterator[Int64[np.ndarray, " n"]]:
        """Log times of one topic in file order; LogError as `stamps_of`."""
        return (times for _, times in self.stamps_of([topic]))

    def stamps_of(self, topics: Collection[str]) -> Iterator[tuple[str, Int64[np.ndarray, " n"]]]:
        """Log times of some topics in file order, from message indexes where possible; LogError as `topic`, or for damage."""
        wanted: dict[int, list[str]] = {}  # topics by channel: a joined IMU has that of its gyroscope
        for topic in topics:
            if topic not in self.topics:
                raise LogError(f"there is no topic {topic}", where=self.path, expected=self.listing())
            for channel in self.channel_ids(topic):
                wanted.setdefault(channel, []).append(topic)
        channels = set(wanted)
        with self.named(*topics if len(topics) == 1 else ()):
            for block in (block for block in self.index.blocks if block.may_hold(channels)):
                tables: dict[str, list[UInt64[np.ndarray, "n 2"]]] = {}
                for channel, entries in self._entries(block, channels).items():
                    for topic in wanted[channel]:
                        tables.setdefault(topic, []).append(entries)
                for topic, parts in tables.items():
                    table = np.concatenate(parts)
                    yield topic, messages.signed(table[np.argsort(table[:, 1], kind="stable"), 0])

    def _entries(self, block: MessageBlock, channels: set[int]) -> dict[int, UInt64[np.ndarray, "n 2"]]:
        """Log times and offsets of a block's messages, by channel."""
        if block.trusted and not block.edited:
            listed = {channel: self.index.entries(block, channel) for channel in channels & block.indexes.keys()}
            if listed and all(map(len, listed.values())):
                return listed
        return {} if (found := self.index.unpack_or_lose(block)) is None else found.entries(channels)

    def imu_batches(self, topic: str) -> Iterator[ImuBatch]:
        """The messages of an IMU topic in file order; LogError as `topic`, of NaN, stamps that do not increase, or damage."""
        described, stamps = self.topic(topic, (schemas.IMU,)), StampCheck(fix=CLEAN_FIX)
        for _, rows in self.rows([described.name]):
            with self.named(described.name):
                for batch in described.decode_imu(rows):
                    check_finite(batch, CLEAN_FIX, angular_velocity=batch.gyro, linear_acceleration=batch.accel)
                    stamps.check(batch.stamp_ns, batch.sequence)
                    yield batch

    def pose_batches(self, topic: str, end_ns: int | None = None) -> Iterator[PoseBatch]:
        """The poses of a topic in file order; of a TFMessage one batch per transform in it; LogError as `topic`."""
        described = self.topic(topic, (*MESSAGE_POSES, schemas.TF))
        for _, rows in self.rows([topic], end_ns=end_ns):
            with self.named(topic):
                yield from described.decode_poses(rows)

    def firsts(self, topics: Collection[str]) -> Iterator[tuple[str, bytes]]:
        """First messages of some topics, in a pass that ends with the last of them; together they may not fit in memory."""
        wanted, found = {channel: topic for topic in topics for channel in self.channel_ids(topic)}, set[str]()
        channels = set(wanted)
        with self.named():
            for block in (block for block in self.index.blocks if channels and block.may_hold(channels)):
                if (read := self.index.unpack_or_lose(block)) is None:
                    continue
                for channel, table in sorted(read.entries(channels).items(), key=lambda entries: int(entries[1][0, 1])):
                    at, topic = int(table[0, 1]), wanted[channel]
                    end = at + HEAD.size + HEAD.unpack_from(read.data.data, at)[1]
                    if topic not in found:
                        found.add(topic)
                        yield topic, read.data[at + messages.MESSAGE.itemsize : end].tobytes()
                channels = {channel for channel in channels if wanted[channel] not in found}

    def channel_ids(self, topic: str) -> set[int]:
        """Channels of a topic; for a joined IMU those of its gyroscope."""
        name = (found.recorded_on if (found := self.topics.get(topic)) else "") or topic
        if self._ids[0] != (known := (id(self.index), len(self.index.channels))):  # asked for each of many topics
            self._ids = known, {}
            for i, channel in self.index.channels.items():
                self._ids[1].setdefault(channel.topic, set()).add(i)
        return set(self._ids[1].get(name, ()))

    def keep(self, topics: Collection[str]) -> None:
        """Keeps the chunks that are read for some topics from now on: a copy need not read them again."""
        known = {t: (self.topics[t], self.channel_ids(t)) for t in topics if t in self.topics}
        self.kept = KeptChunks(self._source, known, self.max_chunk)

    def rows(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[tuple[str, messages.Rows]]:
        """The messages of some topics in file order; each chunk is unpacked once for all topics."""
        wanted = {topic: self.channel_ids(topic) for topic in topics}
        every = set().union(*wanted.values()) if wanted else set()
        first, last = -1 if start_ns is None else start_ns, 2**63 - 1 if end_ns is None else end_ns
        with self.named():
            inside = (b for b in self.index.blocks if (end_ns is None or b.start_ns <= last) and (b.end_ns or last) >= first)
            blocks = (block for block in inside if block.may_hold(every))
            for near in neighbours(blocks) if self.kept is None else ([block] for block in blocks):
                yield from self._rows_of(near, wanted, first, last)

    def _rows_of(
        self, blocks: Sequence[MessageBlock], wanted: Mapping[str, set[int]], first: int, last: int
    ) -> Iterator[tuple[str, messages.Rows]]:
        if len(blocks) > 1 and (together := unpack_together(self._source, blocks, self.max_chunk)) is not None:
            yield from self._cut(together, wanted, first, last)
            return
        for block in blocks:
            if self.kept is not None and (kept := self.kept.rows(block, wanted, first, last)) is not None:
                yield from kept
            elif (found := self.index.unpack_or_lose(block)) is not None:
                yield from self._cut(found, wanted, first, last)

    def _cut(
        self, found: messages.Messages, wanted: Mapping[str, set[int]], first: int = -1, last: int = 2**63 - 1
    ) -> Iterator[tuple[str, messages.Rows]]:
        inside = ((times := found.times()) >= first) & (times <= last)
        for topic, channels in wanted.items():
            for heads, payload in self.topics[topic].cut(found, inside & found.of_channels(channels)):
                yield topic, messages.columns(heads, payload)
