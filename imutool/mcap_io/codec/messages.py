"""Message and MessageIndex records: columns of messages to and from a chunk's bytes.

A log holds millions of messages, so they go through numpy instead of the classes of the `mcap` package.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode

from imutool.array_types import Bool, Int64, Shaped, UInt8, UInt16, UInt32, UInt64
from imutool.errors import LogError
from imutool.mcap_io.codec.records import HEAD

RUN_AFTER = 8  # equal lengths in a row before a whole run is tested at once
LOOK_AHEAD = 64  # records of a run that are tested first
BATCH_BYTES = 1 << 18  # of IMU messages are decoded at once: one chunk holds too few among its images for numpy to be quick
MESSAGE = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
MESSAGE_HEAD = struct.Struct("<BQHIQQ")  # of a Message record, up to its payload
SINGLE_INDEX = struct.Struct("<BQHIQQ")  # a MessageIndex record with one entry
AT_ZERO = np.zeros(1, np.int64)
FIXED = MESSAGE.itemsize - HEAD.size  # the part of a message's length that is not payload


class Messages(NamedTuple):
    """Messages of one stretch of bytes, in file order, and the definitions among them."""

    data: UInt8[np.ndarray, " b"]
    offsets: Int64[np.ndarray, " n"]
    heads: Shaped[np.ndarray, " n"]  # of dtype MESSAGE
    definitions: list[tuple[int, int, int]]  # opcode, first byte and length of a Schema's or Channel's body

    def times(self) -> Int64[np.ndarray, " n"]:
        """Log times.

        Raises:
            LogError: one beyond 2^63 ns.
        """
        return signed(self.heads["log_time"])

    def of_channels(self, channels: Collection[int]) -> Bool[np.ndarray, " n"]:
        """Messages of some channels; `np.isin` takes ten times as long for the few there are."""
        of, mask = self.heads["channel"], np.zeros(len(self.heads), bool)
        for channel in channels:
            mask |= of == channel
        return mask

    def entries(self, channels: Collection[int]) -> dict[int, UInt64[np.ndarray, "n 2"]]:
        """Log times and offsets of the messages of some channels, by channel, as message indexes list them."""
        order = np.argsort(self.heads["channel"], kind="stable")
        ids, first = np.unique(self.heads["channel"][order], return_index=True)
        table = np.stack([self.heads["log_time"], self.offsets.view(np.uint64)], axis=1)[order]
        return {c: part for c, part in zip(ids.tolist(), np.split(table, first[1:]), strict=False) if c in channels}


class Rows(NamedTuple):
    """Consecutive messages of equal size, as columns.

    Every array is a copy, so the chunk they came from is freed.
    """

    channel: UInt16[np.ndarray, " n"]
    log_time: Int64[np.ndarray, " n"]
    publish_time: Int64[np.ndarray, " n"]
    sequence: UInt32[np.ndarray, " n"]
    payload: UInt8[np.ndarray, "n L"]

    def where(self, mask: Bool[np.ndarray, " n"] | slice) -> Rows:
        """Some of the rows."""
        return Rows(*(column[mask] for column in self))


def signed(times: UInt64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """MCAP's uint64 nanoseconds as int64.

    Raises:
        LogError: a time beyond 2^63 ns (the year 2262), which only a damaged or wrapped clock writes.
    """
    if len(times) == 1 and int(times[0]) < 2**63:
        return times.astype(np.int64)
    if len(times) and times.max() >= 2**63:
        raise LogError(f"a message has the log time {times.max()} ns", expected="less than 2^63")
    return times.astype(np.int64)


def scan(data: bytes | memoryview, *, bare: bool = False) -> tuple[Int64[np.ndarray, " n"], list[tuple[int, int, int]], int]:
    """Offsets of messages and definitions in a stretch of records, and where whole records end.

    A `bare` stretch lies outside chunks and also ends before the first record that is not a valid message.
    Stretches of equally long messages, which topic-grouped chunks consist of, are recognised as a matrix; the framing is still
    followed record by record, only not in Python.
    """
    pieces: list[Int64[np.ndarray, " n"]] = []
    singles: list[int] = []
    definitions: list[tuple[int, int, int]] = []
    view = np.frombuffer(data, np.uint8)
    size, position, last, equal, wait = len(view), 0, -1, 0, RUN_AFTER
    unpack = HEAD.unpack_from
    while size - position >= HEAD.size:
        opcode, length = unpack(data, position)
        if length > size - position - HEAD.size:
            break
        if opcode == Opcode.MESSAGE:
            if length < FIXED:
                if bare:
                    break
                raise LogError(f"a message has {length} bytes", expected=f"at least {FIXED}")
            equal, last = (equal + 1, last) if length == last else (0, length)
            if equal >= wait:
                count = _run(view, position, HEAD.size + length)
                pieces += [np.array(singles, np.int64), position + np.arange(count) * (HEAD.size + length)]
                singles.clear()
                position += count * (HEAD.size + length)
                equal, wait = 0, (RUN_AFTER if count > RUN_AFTER else 2 * wait)
                continue
            singles.append(position)
        elif bare:
            break
        elif not opcode:  # the format has no such record; zeros would make 28 million a chunk
            raise LogError(f"a record has the opcode 0, at byte {position}")
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            definitions.append((opcode, position + HEAD.size, length))
        position += HEAD.size + length
    pieces.append(np.array(singles, np.int64))
    return np.concatenate(pieces), definitions, position


def _run(view: UInt8[np.ndarray, " b"], position: int, stride: int) -> int:
    """Number of records in a row that start with the same opcode and length as the one at `position`.

    The look ahead grows with the run: to look at the whole chunk for each short run takes time with the square of its size.
    """
    count, known, ahead = (len(view) - position) // stride, 0, LOOK_AHEAD
    head = view[position : position + HEAD.size]
    while known < count:
        rows = min(ahead, count - known)
        first = position + known * stride
        same = (view[first : first + rows * stride].reshape(rows, stride)[:, : HEAD.size] == head).all(axis=1)
        if not same.all():
            return known + int(np.argmin(same))
        known, ahead = known + rows, 4 * ahead
    return count


def parse(data: bytes | memoryview, offset: int) -> Messages:
    """Messages in the unpacked bytes of a chunk, or in a run of records outside chunks.

    Raises:
        LogError: the records do not fill the bytes exactly; `offset` says where in the file they came from.
    """
    if len(data) >= MESSAGE.itemsize and HEAD.unpack_from(data) == (Opcode.MESSAGE, len(data) - HEAD.size):
        # in a hundredth of the time
        return Messages(np.frombuffer(data, np.uint8), AT_ZERO, np.frombuffer(data, MESSAGE, 1), [])
    try:
        offsets, definitions, end = scan(data)
    except LogError as error:
        raise LogError(f"the chunk at byte {offset} is damaged: {error.what}", expected=error.expected) from error
    view = np.frombuffer(data, np.uint8)
    if end != len(view):
        raise LogError(f"the chunk at byte {offset} is damaged: a record crosses its end, at byte {end} of {len(view)}")
    return Messages(view, offsets, _matrix(view, offsets, MESSAGE.itemsize).view(MESSAGE)[:, 0], definitions)


def parse_at(data: bytes | memoryview, offsets: Int64[np.ndarray, " n"]) -> Messages | None:
    """Messages at these offsets; None unless they alone fill the bytes from end to end.

    As `parse`, which follows the records one by one, where an index lists the offsets: a tenth of the time
    where lengths alternate.
    """
    view, count = np.frombuffer(data, np.uint8), len(offsets)
    if not count or offsets[0] != 0 or offsets[-1] + MESSAGE.itemsize > len(view):
        return None
    sizes = np.empty(count, np.int64)
    np.subtract(offsets[1:], offsets[:-1], out=sizes[:-1])
    sizes[-1] = len(view) - offsets[-1]
    if sizes.min() < MESSAGE.itemsize:
        return None
    heads = _matrix(view, offsets, MESSAGE.itemsize).view(MESSAGE)[:, 0]
    wrong = (heads["opcode"] != Opcode.MESSAGE.value) | (heads["length"].view(np.int64) + HEAD.size != sizes)
    return None if wrong.any() else Messages(view, offsets, heads, [])


def _matrix(view: UInt8[np.ndarray, " b"], offsets: Int64[np.ndarray, " n"], width: int) -> UInt8[np.ndarray, "n w"]:
    """Copies of the `width` bytes at each offset.

    A view, where the spacing would allow one, made decoding slower.
    """
    if not len(offsets):
        return np.zeros((0, width), np.uint8)
    # a window on every byte; numpy's sliding_window_view makes the same, and takes longer than the copies out of one chunk
    windows = np.ndarray((len(view) - width + 1, width), np.uint8, view, strides=(1, 1))
    cut: UInt8[np.ndarray, "n w"] = windows[offsets]
    return cut


def cut(found: Messages, mask: Bool[np.ndarray, " n"]) -> Iterator[tuple[Shaped[np.ndarray, " n"], UInt8[np.ndarray, "n L"]]]:
    """Heads (dtype MESSAGE) and payloads of the chosen messages, per stretch of equal size."""
    heads, offsets = found.heads[mask], found.offsets[mask]
    edges = np.flatnonzero(heads["length"][1:] != heads["length"][:-1]) + 1
    for first, last in pairwise([0, *edges.tolist(), len(heads)] if len(heads) else []):
        size = int(heads["length"][first]) - FIXED
        yield heads[first:last], _matrix(found.data, offsets[first:last] + MESSAGE.itemsize, size)


def columns(heads: Shaped[np.ndarray, " n"], payload: UInt8[np.ndarray, "n L"]) -> Rows:
    """Messages of one size as columns.

    Raises:
        LogError: a log time beyond 2^63 ns.
    """
    publish_time = heads["publish_time"].astype(np.int64)  # only copied: whatever a publisher's clock shows, its bits stay
    return Rows(heads["channel"].copy(), signed(heads["log_time"]), publish_time, heads["sequence"].copy(), payload)


def joined(parts: Iterable[tuple[str, Rows]]) -> Iterator[tuple[str, Rows]]:
    """Rows of small chunks as longer stretches of messages of equal size, by topic."""
    waiting = dict[str, list[Rows]]()
    size = Counter[str]()
    for topic, rows in parts:
        if (of := waiting.setdefault(topic, [])) and of[-1].payload.shape[1] != rows.payload.shape[1]:
            yield topic, _concatenated(of)
            waiting[topic], size[topic] = (of := []), 0
        of.append(rows)
        size[topic] += rows.payload.size
        if size[topic] >= BATCH_BYTES:
            yield topic, _concatenated(waiting.pop(topic))
            size[topic] = 0
    yield from ((topic, _concatenated(of)) for topic, of in waiting.items() if of)


def _concatenated(parts: list[Rows]) -> Rows:
    return parts[0] if len(parts) == 1 else Rows(*map(np.concatenate, zip(*parts, strict=True)))


def message_rows(
    channel: int,
    log_time: Int64[np.ndarray, " n"],
    publish_time: Int64[np.ndarray, " n"],
    sequence: UInt32[np.ndarray, " n"],
    payload: UInt8[np.ndarray, "n L"],
    out: UInt8[np.ndarray, "n M"] | None = None,
) -> UInt8[np.ndarray, "n M"]:
    """One Message record per row, in `out` if given."""
    count, size = payload.shape
    records = np.empty((count, MESSAGE.itemsize + size), np.uint8) if out is None else out
    heads = np.empty(count, MESSAGE)
    heads["opcode"], heads["length"], heads["channel"] = Opcode.MESSAGE, FIXED + size, channel
    heads["sequence"], heads["log_time"], heads["publish_time"] = sequence, log_time, publish_time
    records[:, : MESSAGE.itemsize] = heads.view(np.uint8).reshape(count, MESSAGE.itemsize)
    records[:, MESSAGE.itemsize :] = payload
    return records


def message_head(channel: int, sequence: int, log_time: int, publish_time: int, size: int) -> bytes:
    """The bytes of a Message record ahead of a payload of `size` bytes."""
    return MESSAGE_HEAD.pack(Opcode.MESSAGE, FIXED + size, channel, sequence, log_time, publish_time)


def scatter(data: UInt8[np.ndarray, " b"], offsets: Int64[np.ndarray, " n"], rows: UInt8[np.ndarray, "n M"]) -> None:
    """Puts each row at its own offset; the rows must not overlap there."""
    width = rows.shape[1]
    if len(data) == rows.size:
        data.reshape(rows.shape)[:] = rows
    else:
        np.lib.stride_tricks.sliding_window_view(data, width, writeable=True)[offsets] = rows


def span(times: Int64[np.ndarray, " n"]) -> tuple[int, int]:
    """The first and the last of some times; zeros where there are none."""
    if len(times) < 2:  # in a tenth of the time; some logs have chunks of one message
        return (int(times[0]),) * 2 if len(times) else (0, 0)
    return int(times.min()), int(times.max())


def message_index(channel: int, times: Int64[np.ndarray, " n"], offsets: Int64[np.ndarray, " n"]) -> bytes:
    """A MessageIndex record, its entries in order of log time, then of the file."""
    if len(times) == 1:
        return SINGLE_INDEX.pack(Opcode.MESSAGE_INDEX, 22, channel, 16, int(times[0]), int(offsets[0]))
    entries = np.empty((len(times), 2), "<u8")
    order = np.argsort(times, kind="stable")
    entries[:, 0], entries[:, 1] = times[order], offsets[order]
    body = entries.tobytes()
    return HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(body)) + struct.pack("<HI", channel, len(body)) + body
