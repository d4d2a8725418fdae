"""Scan a ROS 1 bag from its first byte to its last, chunk by chunk, without its index.

Where the framing is broken, the scan goes on at the next chunk, and inside an unpacked chunk at the next message. A message
counts as found when what follows it is a record, or the end of its chunk.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from imutool.bag import records
from imutool.bag.records import HEAD_LIMIT, MAGIC, Chunk, ChunkInfo, Connection, Head, Loss, Message, Op
from imutool.errors import LogError
from imutool.file_location import Location
from imutool.mcap_io.storage.source import Source

SCAN_BYTES = 4096, 1 << 20  # looked through at once, first and at most: what is sought may be near
HEAD_BYTES = 256  # of a record, read at first; most heads are shorter
MAX_LOSSES = 10_000  # in `losses`
MAX_REASONS = 5  # for one chunk


class Bag:
    """A bag open for reading; with `recover` damage goes to `losses`, else it is an error.

    Memory is bounded by the largest chunk.

    Raises:
        ConfigError: the file cannot be opened.
        LogError: empty, no ROS 1 bag, or encrypted.
    """

    def __init__(self, path: Location, *, recover: bool = False) -> None:
        self.path, self.recover = path, recover
        self.connections: dict[int, Connection] = {}
        self.doubtful: set[int] = set()  # numbers that two connections may share
        self.infos: list[ChunkInfo] = []  # of an indexed bag
        self.losses: list[Loss] = []
        self.lost = 0  # number of losses, also beyond those in `losses`
        self.source = Source(path, expected="a ROS 1 bag")
        try:
            self.header = self._begin()
            self.indexed = self._index(self.header)
        except LogError as error:
            self.source.file.close()
            raise error.at(path) from error
        except BaseException:
            self.source.file.close()
            raise

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: object) -> None:
        self.source.file.close()

    def _begin(self) -> Head | None:
        """The bag header record, if it can be read."""
        size = self.source.size
        start = self.source.at(0, min(len(MAGIC), size))
        if start != MAGIC:
            what = "the file is empty" if not size else f"this is not a ROS 1 bag: it starts with {start!r}"
            old = "Bring it to version 2.0 with the rosbag of ROS 1: rosbag filter OLD.bag NEW.bag True"
            raise LogError(what, expected=repr(MAGIC), fix=old if start.startswith(b"#ROSRECORD") else "")
        found = self._head(len(MAGIC))
        if found is not None and found.op == Op.BAG and found.fields.get(b"encryptor"):
            raise LogError(f"the bag is encrypted with {found.fields[b'encryptor'][:80]!r}", expected="one that is not")
        return found if found is not None and found.op == Op.BAG and found.end <= size else None

    def _index(self, header: Head | None) -> bool:
        """Whether the bag has its index; its connections are then known from the start."""
        if header is None or not (position := header.number(b"index_pos")):
            return False
        for _ in range(header.number(b"conn_count")):
            found = self._head(position)
            if found is None or found.op != Op.CONNECTION or found.end > self.source.size:
                return False
            try:
                self._define(found)
            except LogError:
                return False
            position = found.end
        for _ in range(header.number(b"chunk_count")):
            found = self._head(position)
            if found is None or found.op != Op.INFO or found.end > self.source.size:
                return False
            self.infos.append(records.chunk_info_of(found, self.source.at(found.data_at, found.size)))
            position = found.end
        return position <= self.source.size

    def _head(self, at: int) -> Head | None:
        """The head of the record at a byte of the file."""
        remaining = self.source.size - at
        if remaining < 8:
            return None
        raw = self.source.at(at, min(HEAD_BYTES, remaining))
        size = int.from_bytes(raw[:4], "little")
        if size > HEAD_LIMIT or size > remaining - 8:
            return None
        if size + 8 > len(raw):
            raw = self.source.at(at, size + 8)
        found = records.head(raw, 0)
        return found and found._replace(at=at, data_at=found.data_at + at)

    def _define(self, found: Head) -> None:
        if found.size > records.DEFINITION_LIMIT:
            raise LogError(f"a connection record has {found.size} bytes", expected=f"at most {records.DEFINITION_LIMIT}")
        raw = self.source.at(found.at, found.end - found.at)
        self.add_connection(records.connection(found, raw[found.data_at - found.at :], raw))

    def add_connection(self, new: Connection) -> None:
        """Adds a connection.

        Raises:
            LogError: its number belongs to another one.
        """
        known = self.connections.setdefault(new.number, new)
        if (known.topic, known.kind) != (new.topic, new.kind):
            self.doubtful.add(new.number)
            raise LogError(f"connection {new.number} is both {known.topic} and {new.topic}")
        self.doubtful.discard(new.number)

    def lose(self, offset: int, length: int, reason: str, messages: int | None = None) -> None:
        """Notes a loss, or refuses the bag.

        Raises:
            LogError: without `recover`.
        """
        if not self.recover:
            raise LogError(
                f"the bag is damaged at byte {offset}: {reason}",
                where=self.path,
                fix="Save what is there with `imutool repair`",
            )
        self.lost += 1
        if len(self.losses) < MAX_LOSSES:
            self.losses.append(Loss(offset, length, reason, messages))

    def chunks(self) -> Iterator[Chunk]:
        """Every chunk with messages in it, in file order.

        Raises:
            LogError: damage, without `recover`; or the disk does not give the bytes.
        """
        position, size = len(MAGIC), self.source.size
        while position < size:
            found = self._head(position)
            if found is None and self.source.at(position, min(len(MAGIC), size - position)) == MAGIC:
                self.doubtful |= self.connections.keys()  # another bag, which gives the same numbers again
                position += len(MAGIC)
            elif found is None or (found.end > size and found.op != Op.CHUNK):
                following = self._next_chunk(position + 1)
                cut = following == size
                self.lose(position, following - position, "the bag ends inside a record" if cut else "no record begins here")
                position = following
            elif found.op == Op.CHUNK:
                end = self._end(found)
                chunk = self._chunk(found, end)
                if chunk.messages:
                    yield chunk
                position = end
            elif found.op == Op.MESSAGE or not self._is_boundary(found.end):  # it would lead past the record behind it
                position = self._next_chunk(found.data_at)
                outside = "a message lies outside chunks" if found.op == Op.MESSAGE else "a record does not end where it says"
                self.lose(found.at, position - found.at, outside)
            else:
                if found.op == Op.CONNECTION:
                    self._try_define(found)
                position = found.end
        if self.header is not None and (index_pos := self.header.number(b"index_pos")) > size:
            self.lose(size, index_pos - size, f"the bag's header says its index begins at byte {index_pos}")

    def _try_define(self, found: Head) -> None:
        try:
            self._define(found)
        except LogError as error:
            self.lose(found.at, found.end - found.at, error.what)

    def _next_chunk(self, start: int) -> int:
        """Offset of the next chunk or bag at or behind a byte, or the end of the file."""
        size, (scan, maximum) = self.source.size, SCAN_BYTES
        while start < size:
            raw = self.source.at(start, min(scan + HEAD_BYTES, size - start))
            found = records.next_head(raw, Op.CHUNK, 0)
            nearest = [at for at in (found.at if found else -1, raw.find(MAGIC)) if at >= 0]
            if nearest:
                return start + min(nearest)
            start, scan = start + scan, min(2 * scan, maximum)
        return size

    def _end(self, found: Head) -> int:
        """End of a chunk: where it says, if a record follows there; else the next chunk's start."""
        return found.end if self._is_boundary(found.end) else self._next_chunk(found.data_at)

    def _is_boundary(self, end: int) -> bool:
        """Whether a record may end there: a record, another bag or the end of the file follows."""
        remaining = self.source.size - end
        if 0 <= remaining < 8 or (remaining > 0 and self._head(end) is not None):
            return True
        return remaining >= len(MAGIC) and self.source.at(end, len(MAGIC)) == MAGIC

    def _chunk(self, found: Head, end: int) -> Chunk:
        """The readable part of a chunk; all its damage is one loss."""
        compression = found.fields[b"compression"].decode("ascii", "replace")
        wrong = end != found.end
        reasons = ["the chunk does not end where it says"] if wrong else []
        data, messages, indexed = b"", list[Message](), self._indexed_count(end)
        try:
            data = self._unpacked(found, end, compression)
        except LogError as error:
            reasons.append(f"the chunk cannot be unpacked: {error.what}")
        else:
            scan = _ChunkScan(self, data, wrong)
            messages = scan.messages()
            reasons += scan.reasons
        missing = None if indexed is None else max(0, indexed - len(messages))
        if missing and not reasons:
            reasons.append("its index counts more messages than are in it")
        if reasons:
            self.lose(found.at, end - found.at, "; ".join(reasons), missing)
        return Chunk(found.at, end - found.at, data, messages, not reasons)

    def _unpacked(self, found: Head, end: int, compression: str) -> bytes:
        if compression == "none" and end == found.end and found.number(b"size") != found.size:
            raise LogError(f"it has {found.size} bytes", expected=str(found.number(b"size")))
        cut, packed = end != found.end, end - found.data_at
        if packed > records.CHUNK_LIMIT:
            raise LogError(f"it has {packed} bytes", expected=f"at most {records.CHUNK_LIMIT}")
        return records.unpack(compression, self.source.at(found.data_at, packed), found.number(b"size"), cut=cut)

    def _indexed_count(self, position: int) -> int | None:
        """Messages that the index records behind a chunk count, or None without any."""
        total: int | None = None
        while (found := self._head(position)) is not None and found.op == Op.INDEX:
            if found.size != 12 * found.number(b"count"):
                return None
            total = (total or 0) + found.number(b"count")
            position = found.end
        return total


class _ChunkScan:
    """The records of one chunk."""

    def __init__(self, bag: Bag, data: bytes, loose: bool) -> None:
        self.bag, self.data, self.loose = bag, data, loose
        self.reasons: list[str] = []  # why something is lost, the first few

    def _lose(self, reason: str) -> None:
        if len(self.reasons) < MAX_REASONS:
            self.reasons.append(reason)

    def messages(self) -> list[Message]:
        """Messages of known connections, each followed by a record or the end."""
        found: list[Message] = []
        unknown: Counter[int] = Counter()
        position, end, bag = 0, len(self.data), self.bag
        head = records.head(self.data, 0)
        while position < end:
            if head is not None and head.op not in (Op.MESSAGE, Op.CONNECTION):
                if not self.loose:
                    self._lose(f"a record of kind {head.op} lies inside the chunk, at its byte {position}")
                break  # the chunk ended ahead of it
            after = position if head is None else head.end
            following = records.head(self.data, after) if position < after < end else None
            if head is None or not (after == end or following is not None or self._cut(after)):
                head = self._resume(position, end)
                position = end if head is None else head.at
                continue
            number = head.number(b"conn")
            if head.op == Op.CONNECTION:
                self._define(head)
            elif number in bag.connections and number not in bag.doubtful:
                found.append(Message(number, head.time_ns, head.at, head.data_at, after))
            else:
                unknown[number] += 1
            position, head = after, following
        for number, count in unknown.items():
            self._lose(f"{count} messages are of connection {number}, which nothing defines for sure")
        return found

    def _cut(self, position: int) -> bool:
        """Whether the chunk was cut off inside the head at `position`."""
        remaining = len(self.data) - position
        return self.loose and 0 < remaining < HEAD_BYTES and records.next_head(self.data, Op.MESSAGE, position) is None

    def _resume(self, position: int, end: int) -> Head | None:
        """The next message behind damage."""
        following = records.next_head(self.data, Op.MESSAGE, position + 1)
        self._lose(f"no whole record at its bytes {position} to {end if following is None else following.at}")
        return following

    def _define(self, head: Head) -> None:
        try:
            self.bag.add_connection(records.connection(head, self.data[head.data_at : head.end], self.data[head.at : head.end]))
        except LogError as error:
            self._lose(error.what)
