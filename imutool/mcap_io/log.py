"""A log opened for reading: whole columns at a time, one chunk in memory, every chunk's CRC checked.

Topics are found by schema, not by name; messages come in file order.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType, TracebackType

import numpy as np
from jaxtyping import Int64
from mcap.opcode import Opcode
from mcap.records import Metadata

from imutool.errors import DataError, LogError
from imutool.location import Location, to_location
from imutool.mcap_io.batches import Clock, ImuBatch, PoseBatch, ScalarBatch, finite
from imutool.mcap_io.codec import records, schemas
from imutool.mcap_io.codec.decode import TwistColumns, decode_image, decode_imu, decode_poses, decode_scalars, decode_twist
from imutool.mcap_io.codec.records import HEAD
from imutool.mcap_io.index import Block, LogIndex, Span
from imutool.mcap_io.losses import Losses
from imutool.mcap_io.recovery.recovered_index import RecoveredIndex
from imutool.mcap_io.storage.memory import keep_buffers
from imutool.mcap_io.storage.source import Source
from imutool.mcap_io.topics import DERIVED_KEY, ENCODINGS, MESSAGE_POSES, SCALARS, Topic, topics_of


class Log:
    """One MCAP file or object in a store, open for reading: chunked or not, with or without a summary or message indexes.

    Memory is bounded by its largest chunk. Times given to a method select by log time, both ends included.

    With `salvage` a damaged log opens too: what cannot be proven is left out, and `losses` says what and why. It is complete
    once everything was read (`check`), because the damage inside a chunk shows when that is unpacked.

    Raises:
        ConfigError: the file cannot be opened.
        LogError: empty, not an MCAP log, cut short or damaged; with `salvage`, if there is nothing in it to be saved.
    """

    def __init__(self, path: str | Location, *, salvage: bool = False) -> None:
        keep_buffers()
        self.path = to_location(path) if isinstance(path, str) else path
        self._source = Source(self.path)
        try:
            with self.named():
                self.structure = RecoveredIndex(self._source) if salvage else LogIndex(self._source)
                self.topics = MappingProxyType(topics_of(self.structure))
        except BaseException:
            self._source.file.close()
            raise

    def __enter__(self) -> Log:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._source.file.close()

    def check(self) -> None:
        """Reads every chunk and attachment and compares its CRC, so that `losses` is complete.

        Raises:
            LogError: without salvage, the first damage.
        """
        with self.named():
            self.structure.check()

    @contextmanager
    def named(self, topic: str = "") -> Iterator[None]:
        """Gives errors from below their address."""
        try:
            yield
        except (LogError, DataError) as error:
            if isinstance(error, LogError) and error.where is not None:
                raise
            where = f"{self.path} {topic}" if topic else self.path
            raise LogError(error.what, where=where, expected=error.expected, fix=error.fix) from error

    @property
    def losses(self) -> Losses | None:
        """What is lost so far, nothing of a whole log; None without salvage, where the first damage is an error."""
        return self.structure.losses

    @property
    def profile(self) -> str:
        """What the header says the log follows: `ros2`, `ros1` or nothing."""
        return str(self.structure.header.profile)

    @property
    def imu_topics(self) -> list[str]:
        """Topics with IMU messages, without those that imutool computed itself."""
        return [t.name for t in self.with_schema((schemas.IMU,)) if DERIVED_KEY not in t.metadata]

    def only_imu(self) -> str:
        """The log's IMU, where there is one and only one.

        Raises:
            LogError: there are others, or none.
        """
        found = self.imu_topics
        if len(found) != 1:
            listed = ", ".join(found) or "none"
            raise LogError(f"IMU topics: {listed}", where=self.path, expected="one", fix="Choose with --imu" if found else "")
        return found[0]

    @property
    def pose_topics(self) -> list[str]:
        """Topics with poses; /tf counts only where nothing else has any, and never the static one."""
        dedicated = [t.name for t in self.with_schema(MESSAGE_POSES)]
        return dedicated or [t.name for t in self.with_schema((schemas.TF,)) if not t.name.endswith("tf_static")]

    def with_schema(self, schema_names: Collection[str]) -> list[Topic]:
        """The topics that carry one of these messages, in order of their channel ids."""
        return [t for t in self.topics.values() if t.schema_name in schema_names]

    def topic(self, name: str, schema_names: Collection[str]) -> Topic:
        """A topic by name, which must carry one of these messages in an encoding that is read here.

        Raises:
            LogError: no such topic, other messages, or another encoding.
        """
        if name not in self.topics:
            raise LogError(f"there is no topic {name}", where=self.path, expected=self.listing())
        found = self.topics[name]
        if found.schema_name not in schema_names:
            raise LogError(
                f"{name} carries {found.schema_name or 'messages without schema'}",
                where=self.path,
                expected=" or ".join(schema_names),
            )
        if found.message_encoding not in ENCODINGS:
            raise LogError(f"{name} is encoded as {found.message_encoding!r}", where=self.path, expected=" or ".join(ENCODINGS))
        return found

    def listing(self) -> str:
        """The topics there are, for a message."""
        every = [f"{t.name} ({t.schema_name or 'no schema'})" for t in self.topics.values()]
        return ", ".join(every) if every else "a log with topics (this one has none)"

    def metadata(self) -> dict[str, dict[str, str]]:
        """The metadata records by name; where a name comes twice, the later record's entries lie over the earlier's."""
        found: dict[str, dict[str, str]] = {}
        for name, values in self.metadata_records():
            found.setdefault(name, {}).update(values)
        return found

    def metadata_records(self) -> list[tuple[str, dict[str, str]]]:
        """Every metadata record, in file order.

        Raises:
            LogError: one of them is damaged.
        """
        found = []
        with self.named():
            for item in self.structure.items:
                if isinstance(item, Span) and item.opcode == Opcode.METADATA:
                    body = self._source.at(item.offset + HEAD.size, item.length - HEAD.size)
                    record = records.parse(Metadata, body, item.offset)
                    found.append((record.name, dict(record.metadata)))
        return found

    def stamps(self, topic: str) -> Iterator[Int64[np.ndarray, " n"]]:
        """Log times of one topic in file order, from the message indexes where there are any: nothing is unpacked.

        Raises:
            LogError: no such topic, or a damaged log.
        """
        if topic not in self.topics:
            raise LogError(f"there is no topic {topic}", where=self.path, expected=self.listing())
        channels = self.channel_ids(topic)
        with self.named(topic):
            for block in self.structure.blocks:
                if not block.holds(channels):
                    continue
                indexed = sorted(channels & block.indexes.keys()) if block.vouched and not block.edited else []
                entries = [self.structure.index(block, c) for c in indexed]
                if indexed and all(len(entry) for entry in entries):
                    table = np.concatenate(entries)
                    yield records.signed(table[np.argsort(table[:, 1], kind="stable"), 0])
                elif (found := self.structure.found(block)) is not None:
                    times = found.times()[np.isin(found.heads["channel"], list(channels))]
                    if len(times):
                        yield times

    def imu_batches(self, topic: str, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[ImuBatch]:
        """The messages of an IMU topic in file order, a chunk at a time.

        Raises:
            LogError: no such IMU topic, another encoding, NaN or infinite values, stamps that do not increase, damage.
        """
        self.topic(topic, (schemas.IMU,))
        clock = Clock()
        for rows in self.rows([topic], start_ns, end_ns):
            with self.named(topic):
                for batch in self.decode_imu(topic, rows[1]):
                    clock.take(batch)
                    yield batch

    def decode_imu(self, topic: str, rows: records.Rows) -> Iterator[ImuBatch]:
        """IMU messages from their bytes, one batch per stretch with one frame; nothing is asked of their values.

        Raises:
            LogError: a payload that is no such message.
        """
        encoding = self.topics[topic].message_encoding
        for part, layout in schemas.runs(rows.payload, schemas.IMU, encoding):
            cut = rows.where(part)
            columns = decode_imu(cut.payload, encoding, layout)
            yield ImuBatch(cut.log_time, cut.publish_time, cut.sequence, *columns)

    def pose_batches(self, topic: str, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[PoseBatch]:
        """The poses of a topic in file order; of a TFMessage one batch per transform in it.

        Raises:
            LogError: no such pose topic, another encoding, NaN or infinite values, damage.
        """
        self.topic(topic, (*MESSAGE_POSES, schemas.TF))
        for rows in self.rows([topic], start_ns, end_ns):
            with self.named(topic):
                yield from self.decode_poses(topic, rows[1])

    def decode_poses(self, topic: str, rows: records.Rows) -> Iterator[PoseBatch]:
        """Poses from their bytes, one batch per stretch with the same frames, and per transform in a TFMessage.

        Raises:
            LogError: a payload that is no such message, NaN or infinite values.
        """
        kind, encoding = self.topics[topic].schema_name, self.topics[topic].message_encoding
        for part, layout in schemas.runs(rows.payload, kind, encoding):
            cut = rows.where(part)
            for columns in decode_poses(cut.payload, kind, encoding, layout):
                finite(cut.sequence, position=columns.p_wb, orientation=columns.q_wb_wxyz)
                yield PoseBatch(cut.log_time, cut.publish_time, cut.sequence, *columns)

    def scalar_batches(self, topic: str, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[ScalarBatch]:
        """The messages of a Float64 or Vector3Stamped topic in file order.

        Raises:
            LogError: no such topic, another encoding, NaN or infinite values, damage.
        """
        self.topic(topic, SCALARS)
        for rows in self.rows([topic], start_ns, end_ns):
            with self.named(topic):
                yield from self.decode_scalars(topic, rows[1])

    def decode_scalars(self, topic: str, rows: records.Rows) -> Iterator[ScalarBatch]:
        """Numbers from their bytes, one batch per stretch with one frame.

        Raises:
            LogError: a payload that is no such message, NaN or infinite values.
        """
        kind, encoding = self.topics[topic].schema_name, self.topics[topic].message_encoding
        for part, layout in schemas.runs(rows.payload, kind, encoding):
            cut = rows.where(part)
            columns = decode_scalars(cut.payload, kind, encoding, layout)
            finite(cut.sequence, values=columns.values)
            stamp_ns = cut.log_time if columns.stamp_ns is None else columns.stamp_ns
            yield ScalarBatch(cut.log_time, cut.publish_time, cut.sequence, stamp_ns, columns.values, columns.frame_id)

    def decode_twist(self, topic: str, rows: records.Rows) -> Iterator[TwistColumns]:
        """Biases with their covariance from their bytes, a batch per stretch with one frame; nothing is asked of their values.

        Raises:
            LogError: a payload that is no such message.
        """
        encoding = self.topics[topic].message_encoding
        for part, layout in schemas.runs(rows.payload, schemas.TWIST, encoding):
            yield decode_twist(rows.where(part).payload, encoding, layout)

    def images(self, topic: str, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[tuple[int, bytes]]:
        """Stamp and encoded bytes of every image of a CompressedImage topic, in file order.

        Raises:
            LogError: no such topic, another encoding, damage.
        """
        encoding = self.topic(topic, (schemas.IMAGE,)).message_encoding
        for _, rows in self.rows([topic], start_ns, end_ns):
            with self.named(topic):
                for payload in rows.payload:
                    stamp_ns, _, image = decode_image(payload.tobytes(), encoding)
                    yield stamp_ns, image

    def channel_ids(self, topic: str) -> set[int]:
        """The channels of a topic."""
        return {i for i, channel in self.structure.channels.items() if channel.topic == topic}

    def rows(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[tuple[str, records.Rows]]:
        """The messages of some topics in file order, every chunk unpacked once whatever the number of topics."""
        wanted = {topic: self.channel_ids(topic) for topic in topics}
        every = set().union(*wanted.values()) if wanted else set()
        first = -1 if start_ns is None else start_ns
        last = 2**63 - 1 if end_ns is None else end_ns
        with self.named():
            for block in self.structure.blocks:
                if block.holds(every) and block.start_ns <= last and block.end_ns >= first:
                    yield from self._rows_of(block, wanted, first, last)

    def _rows_of(
        self, block: Block, wanted: Mapping[str, set[int]], first: int, last: int
    ) -> Iterator[tuple[str, records.Rows]]:
        found = self.structure.found(block)
        if found is None:
            return
        times = found.times()
        inside = (times >= first) & (times <= last)
        for topic, channels in wanted.items():
            mask = inside & np.isin(found.heads["channel"], list(channels))
            for rows in records.rows(found, mask):
                yield topic, rows
