"""Messages of an MCAP log in log-time order, and the records between them.

The data section is followed record by record: an index need not list what is there.
"""

from __future__ import annotations

import zlib
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from struct import Struct
from typing import Any, BinaryIO

from imutool.bag.records import CHUNK_LIMIT

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD = 9  # bytes of a record ahead of its content: opcode and length
RECORD, MESSAGE_HEAD = Struct("<BQ"), Struct("<HIQQ")  # a message: channel, sequence, log and publish times
TIME, CRC_AT = Struct("<Q"), 24  # first in a chunk's content, and where in it its CRC is
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, ATTACHMENT, METADATA, DATA_END = 2, 3, 4, 5, 6, 9, 12, 15  # opcodes; none is larger
MAX_NAMED = 10  # entries, in a loss
RUN_BYTES = 1 << 20  # messages outside chunks are read in runs of about this size
WRITTEN_OVER = ("rosbag2", "imutool")  # metadata whose writers write a newer record behind the one that it replaces
_Waiting = tuple[int, int, int, int, int, bytes]  # log time, place of its chunk, number in it, channel, publish time, content


def summary_of(reader: Any, file: BinaryIO) -> Any:
    """Summary of a log, with the definitions that its writer put nowhere but among the messages."""
    from mcap.records import Channel, Schema
    from mcap.summary import Summary

    summary = reader.get_summary() or Summary()
    used = {channel for index in summary.chunk_indexes for channel in index.message_index_offsets}
    schemas = {channel.schema_id for channel in summary.channels.values()} - {0}
    if summary.channels and used <= summary.channels.keys() and schemas <= summary.schemas.keys():
        return summary
    for record in (record for place in records(file, summary) for record in content(file, *place)):
        if isinstance(record, Channel):
            summary.channels.setdefault(record.id, record)
        elif isinstance(record, Schema):
            summary.schemas.setdefault(record.id, record)
    return summary


def content(file: BinaryIO, opcode: int, at: int, size: int) -> list[Any]:
    """Definitions and messages in the record at a byte, which may be a chunk.

    Records of other kinds hold none. An attachment, which may be larger than memory, is not read.
    """
    from mcap.data_stream import ReadDataStream
    from mcap.records import Channel, Chunk, Schema
    from mcap.records import Message as Record
    from mcap.stream_reader import breakup_chunk

    file.seek(at + RECORD_HEAD)
    stream = ReadDataStream(file)
    if opcode == CHUNK:
        chunk = Chunk.read(stream)
        return breakup_chunk(replace(chunk, compression="", data=_unpacked(chunk), uncompressed_crc=0))
    if opcode == MESSAGE:
        return [Record.read(stream, size - RECORD_HEAD)]
    kind: Any = {SCHEMA: Schema, CHANNEL: Channel}.get(opcode)
    return [] if kind is None else [kind.read(stream)]


def listed(records: Mapping[int, int]) -> str:
    """Counts of records by their opcodes, for a message."""
    return ", ".join(f"{count} of 0x{opcode:02x}" for opcode, count in sorted(records.items()))


class Content:
    """Content of a log's data section, which need not be in its summary.

    Attributes:
        blocks: first log time, place and bytes of each run of messages outside chunks; of each chunk, with 0 bytes.
        metadata: metadata by name.
        attachments: place and bytes of each attachment's record.
        losses, notes: what of it a converted log lacks, and what nothing checks.

    Raises:
        ValueError: a record that crosses the end, or data that have another CRC than is stated.
    """

    def __init__(self, summary: Any, file: BinaryIO) -> None:
        self.blocks: list[tuple[int, int, int]] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: list[tuple[int, int]] = []
        self._file, self._unchecked, self._outside, self._stated = file, 0, 0, 0
        self._replaced, others = Counter[str](), Counter[int]()
        take = {
            CHUNK: self._take_chunk,
            MESSAGE: self._take_message,
            METADATA: self._take_metadata,
            DATA_END: self._take_end,
        }
        for opcode, at, size in records(file, summary):
            if opcode in take:
                take[opcode](at, size)
            elif opcode == ATTACHMENT:
                self.attachments.append((at, size))
            elif opcode > DATA_END:
                others[opcode] += 1
        losses = {
            "records that are none of MCAP's own are not carried over": listed(others),
            "metadata of one name are joined, and later values replace others": _first_of(self._replaced),
        }
        self.losses = [f"{what}: {which}" for what, which in losses.items() if which]
        chunks = f"{self._unchecked} chunks state no CRC: their messages are not checked"
        outside = f"{self._outside} messages lie outside chunks, where no CRC covers them"
        self.notes = [*[chunks][: self._unchecked], *([outside] if self._outside and not self._stated else [])]

    def _take_chunk(self, at: int, _: int) -> None:
        (first_ns,) = TIME.unpack(self._file.read(TIME.size))
        self.blocks.append((first_ns, at, 0))
        self._file.seek(at + RECORD_HEAD + CRC_AT)
        self._unchecked += self._file.read(4) == bytes(4)

    def _take_message(self, at: int, size: int) -> None:
        _, _, log_time, _ = MESSAGE_HEAD.unpack(self._file.read(MESSAGE_HEAD.size))
        first_ns, begin, run = self.blocks[-1] if self.blocks else (0, 0, 0)
        if run and begin + run == at and run < RUN_BYTES:
            self.blocks[-1] = min(first_ns, log_time), begin, run + size
        else:
            self.blocks.append((log_time, at, size))
        self._outside += 1

    def _take_metadata(self, at: int, size: int) -> None:
        from mcap.data_stream import ReadDataStream
        from mcap.records import Metadata

        record = Metadata.read(ReadDataStream(self._file))
        known, new = self.metadata.setdefault(record.name, {}), record.metadata
        if not record.name.startswith(WRITTEN_OVER):
            self._replaced.update(f"{key} of {record.name}" for key in new if new[key] != known.get(key, new[key]))
        known.update(new)

    def _take_end(self, at: int, size: int) -> None:
        self._stated = int.from_bytes(self._file.read(4), "little")
        if self._stated and self._outside and self._stated != _crc(self._file, at):
            raise ValueError("its data have another CRC than it states")


def records(file: BinaryIO, summary: Any, end: int | None = None) -> Iterator[tuple[int, int, int]]:
    """Opcode, place and size of each record of the data section.

    The file is at the content of the record. A log that was cut is read up to `end`.

    Raises:
        ValueError: a record that crosses the end.
    """
    listed = {index.chunk_start_offset: index.message_index_length for index in summary.chunk_indexes}
    last = file.seek(0, 2) - len(MAGIC) if end is None else end
    at, opcode = len(MAGIC), 0
    while opcode not in (DATA_END, FOOTER) and at != end:
        file.seek(at)
        opcode, length = RECORD.unpack(file.read(RECORD_HEAD))
        size = RECORD_HEAD + length
        if size > last - at or not (opcode or end):  # zeros end a log that was cut by a loss of power
            raise ValueError(f"the record at byte {at} is none, or crosses the end")
        yield opcode, at, size
        at += size + (listed.get(at, 0) if opcode == CHUNK else 0)


def whole_size(path: Path) -> int:
    """Bytes of a log up to the end of its last whole record."""
    size, at = path.stat().st_size, len(MAGIC)
    with path.open("rb") as file:
        file.seek(at)
        while len(record := file.read(RECORD_HEAD)) == RECORD_HEAD:
            following = at + RECORD_HEAD + int.from_bytes(record[1:], "little")
            if following > size:
                break
            at = following
            file.seek(at)
    return at


def _first_of(counts: Mapping[str, int]) -> str:
    """First names, each with its count, and how many more there are: a log may have thousands."""
    names = [f"{name} ({count} times)" if count > 1 else name for name, count in counts.items()]
    return ", ".join(names[:MAX_NAMED]) + (f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else "")


def _crc(file: BinaryIO, end: int) -> int:
    """CRC of a file up to a byte."""
    file.seek(0)
    crc = 0
    for at in range(0, end, RUN_BYTES):
        crc = zlib.crc32(file.read(min(RUN_BYTES, end - at)), crc)
    return crc


def in_order(summary: Any, file: BinaryIO, others: Counter[int]) -> Iterator[_Waiting]:
    """Messages in order of log time, then of the file.

    Chunks are sorted as they come, in place of a heap of single messages. `others` counts records that are none of MCAP's own.
    """
    from mcap.data_stream import ReadDataStream
    from mcap.records import Chunk

    waiting = list[_Waiting]()
    for start_ns, at, size in sorted(Content(summary, file).blocks):
        due = bisect_left(waiting, (start_ns, at))
        yield from waiting[:due]
        del waiting[:due]
        if size:
            file.seek(at)
            data = file.read(size)
        else:
            file.seek(at + RECORD_HEAD)
            data = _unpacked(Chunk.read(ReadDataStream(file)))
        waiting += _messages_in(data, at, others)
        waiting.sort()
    yield from waiting


def _unpacked(chunk: Any) -> bytes:
    """Records of a chunk, whose data may be several frames in a row: the library reads the first alone.

    Raises:
        ValueError: data of another size or CRC than the chunk states, or too large.
    """
    import lz4.frame
    import zstandard

    data, size = chunk.data, chunk.uncompressed_size
    if size > CHUNK_LIMIT:
        raise ValueError(f"a chunk says it unpacks to {size} bytes, expected at most {CHUNK_LIMIT}")
    if chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True).read(size + 1)
    elif chunk.compression == "lz4":
        first = lz4.frame.decompress_chunk(lz4.frame.create_decompression_context(), data, max_length=size + 1)
        one_frame = first[1:] == (len(data), True)  # that takes a fifth of the time of the class that goes on
        data = first[0] if one_frame else lz4.frame.LZ4FrameFile(BytesIO(data)).read(size + 1)
    elif chunk.compression:
        raise ValueError(f"a chunk is compressed with {chunk.compression!r}")
    if len(data) != size or chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError(f"the contents of a chunk of {size} bytes have another size or CRC than it states")
    return bytes(data)


def _messages_in(data: bytes, at: int, others: Counter[int]) -> Iterator[_Waiting]:
    """Messages of a chunk or a run; the library's own records take three times as long.

    Raises:
        ValueError: a record that is longer than its chunk, or shorter than the head of a message.
    """
    place, number, size = 0, 0, len(data)
    while place < size:
        opcode, length = RECORD.unpack_from(data, place)
        place += RECORD_HEAD
        if length > size - place or (opcode == MESSAGE and length < MESSAGE_HEAD.size):
            raise ValueError(f"a record of {length} bytes in a chunk of {size}")
        if opcode == MESSAGE:
            channel, _, log_time, publish_time = MESSAGE_HEAD.unpack_from(data, place)
            yield log_time, at, number, channel, publish_time, data[place + MESSAGE_HEAD.size : place + length]
            number += 1
        elif opcode > DATA_END:
            others[opcode] += 1
        place += length
