"""Messages of an MCAP log's chunks in log-time order."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from struct import Struct
from typing import Any, BinaryIO

from imutool.recording.message_log import Message

RECORD_HEAD = 9  # bytes of a record ahead of its content: opcode and length
RECORD, MESSAGE, MESSAGE_OPCODE = Struct("<BQ"), Struct("<HIQQ"), 5  # a message: channel, sequence, log and publish times
_Waiting = tuple[int, int, int, int, int, bytes]  # log time, place of its chunk, number in it, channel, publish time, content


def summary_of(reader: Any, file: BinaryIO) -> Any:
    """Summary of a log, with the definitions that its writer put nowhere but among the messages."""
    from mcap.records import Channel, Schema
    from mcap.stream_reader import StreamReader
    from mcap.summary import Summary

    summary = reader.get_summary() or Summary()
    used = {channel for index in summary.chunk_indexes for channel in index.message_index_offsets}
    schemas = {channel.schema_id for channel in summary.channels.values()} - {0}
    if summary.channels and used <= summary.channels.keys() and schemas <= summary.schemas.keys():
        return summary
    file.seek(0)
    for record in StreamReader(file).records:
        if isinstance(record, Channel):
            summary.channels.setdefault(record.id, record)
        elif isinstance(record, Schema):
            summary.schemas.setdefault(record.id, record)
    return summary


def beside_messages(reader: Any, summary: Any, file: BinaryIO) -> tuple[dict[str, dict[str, str]], list[str]]:
    """Metadata by name and names of attachments, also of those that no index lists."""
    from mcap.records import Attachment, Metadata
    from mcap.stream_reader import StreamReader

    stated, metadata, attachments = summary.statistics, dict[str, dict[str, str]](), list[str]()
    listed = len(summary.metadata_indexes), len(summary.attachment_indexes)
    records = reader.iter_metadata()
    if stated is not None and (stated.metadata_count, stated.attachment_count) == listed:
        attachments += [index.name for index in summary.attachment_indexes]
    else:
        file.seek(0)
        records = StreamReader(file, emit_chunks=True).records
    for record in records:
        if isinstance(record, Metadata):
            metadata.setdefault(record.name, {}).update(record.metadata)
        elif isinstance(record, Attachment):
            attachments.append(record.name)
    return metadata, attachments


def in_order(reader: Any, file: BinaryIO) -> Iterator[tuple[Any, Any, Message]]:
    """Schema, channel and content of each message, as `reader.iter_messages()` yields them.

    Chunks are sorted as they come, in place of a heap of single messages.
    """
    from mcap.data_stream import ReadDataStream
    from mcap.records import Chunk

    found = reader.get_summary()
    if found is None or not found.chunk_indexes:
        for schema, channel, record in reader.iter_messages():
            yield schema, channel, Message(channel, record.log_time, record.publish_time, record.data)
        return
    summary, waiting = summary_of(reader, file), list[_Waiting]()
    for start_ns, at in sorted((index.message_start_time, index.chunk_start_offset) for index in summary.chunk_indexes):
        due = bisect_left(waiting, (start_ns, at))
        yield from (_defined(summary, record) for record in waiting[:due])
        del waiting[:due]
        file.seek(at + RECORD_HEAD)
        waiting += _messages_in(Chunk.read(ReadDataStream(file)), at)
        waiting.sort()
    yield from (_defined(summary, record) for record in waiting)


def _messages_in(chunk: Any, at: int) -> Iterator[_Waiting]:
    """Messages of a chunk; the library's own records take three times as long.

    Raises:
        ValueError: a record that is longer than its chunk, or shorter than the head of a message.
    """
    from mcap.stream_reader import get_chunk_data_stream

    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    data, place, number = stream.read(size), 0, 0
    while place < size:
        opcode, length = RECORD.unpack_from(data, place)
        place += RECORD_HEAD
        if length > size - place or (opcode == MESSAGE_OPCODE and length < MESSAGE.size):
            raise ValueError(f"a record of {length} bytes in a chunk of {size}")
        if opcode == MESSAGE_OPCODE:
            channel, _, log_time, publish_time = MESSAGE.unpack_from(data, place)
            yield log_time, at, number, channel, publish_time, data[place + MESSAGE.size : place + length]
            number += 1
        place += length


def _defined(summary: Any, waiting: _Waiting) -> tuple[Any, Any, Message]:
    log_time, _, _, channel_id, publish_time, payload = waiting
    channel = summary.channels[channel_id]
    schema = summary.schemas[channel.schema_id] if channel.schema_id else None
    return schema, channel, Message(channel, log_time, publish_time, payload)
