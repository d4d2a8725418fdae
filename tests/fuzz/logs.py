"""Damaged MCAP logs.

The oracle knows nothing of imutool: it finds every chunk that a CRC proves, wherever it lies in the file. Its messages must
come back, once, in order of time; what comes back must be a message of an original on its own topic.
"""

from __future__ import annotations

import io
import random
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.writer import CompressionType, IndexType, Writer
from support.log_damage import by_mcap, content

from fuzz import command, outside_contract
from imutool.errors import LogError
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.encode import encode_imu, encode_pose
from imutool.mcap_io.recovery.losses import describe
from imutool.mcap_io.recovery.recovered_log import RecoveredLog
from imutool.mcap_io.repair import repair

Message = tuple[str, int, int, int, bytes]  # topic, log time, publish time, sequence, payload
HEAD, CHUNK = struct.Struct("<BQ"), struct.Struct("<QQQII")
MAGIC = b"\x89MCAP0\r\n"
LARGEST = 1 << 26  # bytes of a chunk that the oracle unpacks
ORIGINALS = 24  # pairs of whole logs, from which all cases are made
SHORTEST_SUMMARY = 200  # bytes of one that lists the chunks; without one, nobody misses a chunk
COMMAND_EVERY = 12  # cases are also given to the commands

LAYOUTS: tuple[dict[str, Any], ...] = (
    {"compression": CompressionType.ZSTD},
    {"compression": CompressionType.LZ4},
    {"compression": CompressionType.NONE},
    {"compression": CompressionType.ZSTD, "enable_data_crcs": True},
    {"index_types": IndexType.CHUNK},
    {"index_types": IndexType.MESSAGE, "repeat_channels": False, "repeat_schemas": False, "use_statistics": False},
    {"index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False, "use_statistics": False},
    {"repeat_channels": False, "repeat_schemas": False},
    {"use_chunking": False},
)


class Original(NamedTuple):
    """A whole log, its records and its messages."""

    raw: bytes
    records: list[tuple[int, int]]  # first byte and end of every record outside chunks
    chunks: dict[bytes, list[Message]]  # by the bytes of their records
    own: dict[bytes, tuple[dict[int, tuple[str, int]], dict[int, str]]]  # channels and schemas that a chunk defines
    messages: Counter[Message]
    channels: dict[int, tuple[str, str]]  # topic and type
    summary: bytes  # from the first record of the summary to the end of the file
    chunked: bool


class Chunk(NamedTuple):
    """A chunk that a CRC proves."""

    offset: int
    record: bytes
    contents: bytes


def whole(seed: int, *, second: bool = False) -> Original:
    """A log of up to four topics; the second of a pair defines other ids."""
    rng = random.Random(seed)
    layout = dict(rng.choice(LAYOUTS))
    file = io.BytesIO()
    writer = Writer(file, chunk_size=rng.choice((300, 1500, 4000)), **layout)
    writer.start("ros2")
    topics = [("/imu0", schemas.IMU), ("/imu1", schemas.IMU), ("/pose", schemas.POSE), ("/talk", "std_msgs/msg/String")]
    topics = rng.sample(topics, rng.randrange(2, 5))
    start = 1_700_000_000_000_000_000 + (rng.choice((777, 1000, 10**12)) if second else 0)
    ids: dict[str, int] = {}
    for row in range(rng.randrange(20, 90)):
        topic, kind = topics[row % len(topics)] if row < len(topics) else rng.choice(topics)
        if topic not in ids:
            text = schemas.definition(kind) if kind in (schemas.IMU, schemas.POSE) else "string data\n"
            ids[topic] = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", text.encode()))
        t_ns = start + 5_000_000 * row
        writer.add_message(ids[topic], t_ns, _payload(kind, t_ns, rng), t_ns, (1 << 20) * second + row)
        if row == 10:
            writer.add_attachment(t_ns, t_ns, "calib.yaml", "text/yaml", rng.randbytes(140))
    writer.add_metadata("vehicle", {"id": str(seed)})
    writer.finish()
    return _original(file.getvalue(), layout.get("use_chunking", True))


def _payload(kind: str, t_ns: int, rng: random.Random) -> bytes:
    draw = np.random.default_rng(rng.randrange(2**32))
    stamp = np.array([t_ns])
    if kind == schemas.IMU:
        return encode_imu(stamp, draw.normal(size=(1, 3)), draw.normal(size=(1, 3)), "imu").tobytes()
    if kind == schemas.POSE:
        return encode_pose(stamp, draw.normal(size=(1, 3)), np.array([[1.0, 0, 0, 0]]), "world").tobytes()
    text = rng.randbytes(rng.randrange(3, 9)).hex().encode() + b"\0"
    return b"\0\1\0\0" + struct.pack("<I", len(text)) + text


def _original(raw: bytes, chunked: bool) -> Original:
    records, position = [], len(MAGIC)
    while position < len(raw) - len(MAGIC):
        end = position + HEAD.size + HEAD.unpack_from(raw, position)[1]
        records.append((position, end))
        position = end
    data_end = next(end for start, end in records if raw[start] == 0x0F)
    tables = [_definitions(raw[start:end]) for start, end in records] + [_definitions(c.contents) for c in proven(raw)]
    types = {number: name for _, names in tables for number, name in names.items()}
    channels = {n: (topic, types[kind]) for found, _ in tables for n, (topic, kind) in found.items()}
    chunks, own = {}, {}
    for chunk in proven(raw):
        chunks[chunk.record] = _messages(chunk.contents, channels)
        own[chunk.record] = _definitions(chunk.contents)
    every = Counter(m for each in chunks.values() for m in each) if chunked else Counter(_messages(raw[8:data_end], channels))
    return Original(raw, records, chunks, own, every, channels, raw[data_end:], chunked)


def _fields(contents: bytes) -> Iterator[tuple[int, bytes]]:
    position = 0
    while len(contents) - position >= HEAD.size:
        opcode, length = HEAD.unpack_from(contents, position)
        yield opcode, contents[position + HEAD.size : position + HEAD.size + length]
        position += HEAD.size + length


def _definitions(contents: bytes) -> tuple[dict[int, tuple[str, int]], dict[int, str]]:
    """Channels with topic and schema id, and schemas with their name."""
    channels, names = {}, {}
    for opcode, body in _fields(contents):
        if opcode in (3, 4):
            size = struct.unpack_from("<I", body, 2 if opcode == 3 else 4)[0]
            start = 6 if opcode == 3 else 8
            text = body[start : start + size].decode()
            if opcode == 3:
                names[struct.unpack_from("<H", body)[0]] = text
            else:
                number, kind = struct.unpack_from("<HH", body)
                channels[number] = text, kind
    return channels, names


def _messages(contents: bytes, channels: dict[int, tuple[str, str]]) -> list[Message]:
    found = []
    for opcode, body in _fields(contents):
        if opcode == 5:
            channel, sequence, log_time, publish_time = struct.unpack_from("<HIQQ", body)
            found.append((channels.get(channel, ("", ""))[0], log_time, publish_time, sequence, body[22:]))
    return found


def proven(raw: bytes) -> list[Chunk]:
    """Every chunk whose CRC proves it; what lies inside one is its content."""
    found, at = [], raw.find(b"\6")
    while at >= 0:
        end = at
        if len(raw) - at >= HEAD.size + CHUNK.size + 8:
            _, length = HEAD.unpack_from(raw, at)
            contents = _unpacked(raw[at : at + HEAD.size + length]) if length <= len(raw) - at - HEAD.size else None
            if contents is not None:
                end = at + HEAD.size + length
                found.append(Chunk(at, raw[at:end], contents))
        at = raw.find(b"\6", max(end, at + 1))
    return found


def _unpacked(record: bytes) -> bytes | None:
    """Contents of a Chunk record whose own CRC covers them."""
    if len(record) < HEAD.size + CHUNK.size + 8:
        return None
    _, _, size, crc, name = CHUNK.unpack_from(record, HEAD.size)
    start = HEAD.size + CHUNK.size + name + 8
    if not crc or size > LARGEST or start > len(record) or name > 4:
        return None
    if struct.unpack_from("<Q", record, start - 8)[0] != len(record) - start:
        return None
    try:
        packing = record[start - 8 - name : start - 8]
        if packing == b"zstd":
            contents = zstandard.ZstdDecompressor().decompress(record[start:], max_output_size=size)
        elif packing == b"lz4":
            contents = lz4.frame.decompress(record[start:])
        else:
            contents = record[start:] if not name else b""
    except (zstandard.ZstdError, RuntimeError, MemoryError):  # a flipped frame may state any size
        return None
    return contents if len(contents) == size and zlib.crc32(contents) == crc else None


@cache
def pair(number: int) -> tuple[Original, Original]:
    """Two whole logs."""
    return whole(2 * number), whole(2 * number + 1, second=True)


# ── damage ───────────────────────────────────────────────────────────────────────────────────────────────────────────

Damage = Callable[[bytes, Original, Original, random.Random], bytes]


def flip(raw: bytes, a: Original, b: Original, rng: random.Random) -> bytes:
    """Some bits are flipped."""
    changed = bytearray(raw)
    for _ in range(rng.randrange(1, 4)):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def overwrite(raw: bytes, a: Original, b: Original, rng: random.Random) -> bytes:
    """A stretch is overwritten: with zeros, random bytes, or bytes of the other log."""
    at, size = rng.randrange(len(raw)), rng.choice((8, 60, 600, 3000))
    other = b.raw[rng.choice((0, rng.randrange(len(b.raw)), rng.choice(b.records)[0])) :]
    new = rng.choice((bytes(size), rng.randbytes(size), other[:size], other))[: len(raw) - at]
    return raw[:at] + new + raw[at + len(new) :]


def cut(raw: bytes, a: Original, b: Original, rng: random.Random) -> bytes:
    """The end is missing."""
    return raw[: rng.randrange(len(raw))]


def length(raw: bytes, a: Original, b: Original, rng: random.Random) -> bytes:
    """The length of a record is wrong."""
    start, _ = rng.choice(a.records)
    value = rng.choice((0, 1, 5, 77, 2**31, 2**62, 2**64 - 1)).to_bytes(8, "little")
    return raw[: start + 1] + value + raw[start + 9 :] if start + 9 < len(raw) else raw


def _of_kind(a: Original, rng: random.Random, count: int, *, indexes: bool) -> list[tuple[int, int]]:
    """Some chunks, or other records where there are none, with the message indexes behind them or without."""
    found: list[tuple[int, int]] = []
    for start, end in a.records:
        if a.raw[start] == 7 and found and indexes and found[-1][1] == start:
            found[-1] = found[-1][0], end
        elif a.raw[start] in (5, 6):
            found.append((start, end))
    return sorted(rng.sample(found, min(count, len(found)))) if found else []


def remove(raw: bytes, a: Original, b: Original, rng: random.Random) -> bytes:
    """A chunk is gone, perhaps with its message indexes."""
    for start, end in _of_kind(a, rng, 1, indexes=rng.random() < 0.5):
        return raw[:start] + raw[end:]
    return raw


def duplicate(raw: bytes, a: Original, b: Original, rng: random.Random) -> bytes:
    """A chunk is there twice."""
    for start, end in _of_kind(a, rng, 1, indexes=rng.random() < 0.5):
        return raw[:end] + raw[start:]
    return raw


def exchange(raw: bytes, a: Original, b: Original, rng: random.Random) -> bytes:
    """Two chunks have changed places."""
    both = _of_kind(a, rng, 2, indexes=rng.random() < 0.5)
    if len(both) < 2:
        return raw
    (p, q), (r, s) = both
    return raw[:p] + raw[r:s] + raw[q:r] + raw[p:q] + raw[s:]


def record(raw: bytes, a: Original, b: Original, rng: random.Random) -> bytes:
    """Any record is missing, twice there, or another log's stands in front of it."""
    start, end = rng.choice(a.records)
    other = b.raw[slice(*rng.choice(b.records))]
    return raw[:start] + rng.choice((b"", raw[start:end] * 2, other + raw[start:end])) + raw[end:]


def newer(raw: bytes, a: Original, b: Original, rng: random.Random) -> bytes:
    """The other log is written over the front."""
    stop = rng.choice((rng.randrange(len(b.raw)), rng.choice(b.records)[1], len(b.raw)))
    return b.raw[:stop] + raw[stop:]


def join(raw: bytes, a: Original, b: Original, rng: random.Random) -> bytes:
    """The other log follows, whole or a part of it."""
    stop = rng.choice((len(raw), rng.randrange(len(raw)), rng.choice(a.records)[1]))
    begin = rng.choice((0, 0, rng.randrange(len(b.raw)), rng.choice(b.records)[0]))
    return raw[:stop] + b.raw[begin:]


def overlap(raw: bytes, a: Original, b: Original, rng: random.Random) -> bytes:
    """One log goes over into the other at the same place."""
    at = rng.randrange(len(b.raw))
    return raw[:at] + b.raw[at:]


def old_index(raw: bytes, a: Original, b: Original, rng: random.Random) -> bytes:
    """The summary is the other log's."""
    return raw[: len(raw) - len(a.summary)] + b.summary


def wrong_index(raw: bytes, a: Original, b: Original, rng: random.Random) -> bytes:
    """Numbers of the summary's chunk indexes are wrong, and its CRC is right: of a summary without other damage.

    A recorder computes the CRC of what it writes; no CRC is right over bytes that were flipped later.
    """
    if raw[-len(MAGIC) :] != MAGIC or len(raw) < 60:
        return raw
    start = struct.unpack_from("<Q", raw, len(raw) - 28)[0]
    changed, by, field = bytearray(raw), rng.choice((-1, 1, 7, 10**9)), rng.choice((0, 8, 16, 24, 28, 36))
    position = start
    while 0 < position < len(raw) - 37:
        opcode, size = HEAD.unpack_from(raw, position)
        if opcode == 8 and size >= 60:
            at = position + HEAD.size + field
            value = (int.from_bytes(changed[at : at + 8], "little") + by) % 2**64
            changed[at : at + 8] = value.to_bytes(8, "little")
        position += HEAD.size + size
    if 0 < start < len(raw) - 37 and zlib.crc32(raw[start:-12]).to_bytes(4, "little") == raw[-12:-8]:
        changed[-12:-8] = zlib.crc32(bytes(changed[start:-12])).to_bytes(4, "little")
    return bytes(changed)


def no_crc(raw: bytes, a: Original, b: Original, rng: random.Random) -> bytes:
    """A chunk's CRC is wrong, or states nothing."""
    for start, _ in _of_kind(a, rng, 1, indexes=False):
        if a.chunked and start + 37 < len(raw):
            return raw[: start + 33] + rng.choice((bytes(4), rng.randbytes(4))) + raw[start + 37 :]
    return raw


def bomb(raw: bytes, a: Original, b: Original, rng: random.Random) -> bytes:
    """A chunk of few bytes says that it unpacks to many."""
    size = rng.choice((1 << 20, HEAD.size + (50 << 20), 1 << 30, 1 << 40, 2**63))
    packed = _bomb() if size < 1 << 30 else rng.randbytes(50)
    body = CHUNK.pack(0, 1, size, rng.choice((0, 1)), 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    start, _ = rng.choice(a.records)
    return raw[:start] + HEAD.pack(6, len(body)) + body + raw[start:]


@cache
def _bomb() -> bytes:
    one = HEAD.pack(0, 50 << 20) + bytes(50 << 20)  # record: of millions another library would make an object each
    return zstandard.ZstdCompressor(level=1).compress(one)


DAMAGES: tuple[Damage, ...] = (
    *(flip, overwrite, cut, length, remove, duplicate, exchange, record),
    *(newer, join, overlap, old_index, wrong_index, no_crc, bomb),
)
ALONE = (flip, cut, length, remove, duplicate, exchange, wrong_index)  # of these the other log is no part


# ── the oracle ───────────────────────────────────────────────────────────────────────────────────────────────────────


def problems(rng: random.Random, folder: Path) -> Iterator[str]:
    """Damages a log in up to three ways, and judges what is read and what is repaired."""
    a, b = pair(rng.randrange(ORIGINALS))
    damages = rng.choices(DAMAGES, k=rng.choice((1, 1, 1, 2, 3)))
    raw = a.raw
    for damage in damages:
        raw = damage(raw, a, b, rng) or raw
    path, target = folder / "log.mcap", folder / "out.mcap"
    path.write_bytes(raw)
    name = "+".join(damage.__name__ for damage in damages)
    for what in judged(path, target, (a, b), damages):
        yield f"{name}: {what}"
    if rng.randrange(COMMAND_EVERY) == 0:
        for words in (("info", "log.mcap", "--json", "info.json"), ("repair", "log.mcap", "out.mcap", "--overwrite", "-q")):
            yield from outside_contract(command(folder, *words), (0, 3, 5))
        yield from outside_contract(command(folder, "convert", "log.mcap", "converted.mcap", "-q"), (0, 3, 4))
    if path.read_bytes() != raw:
        yield f"{name}: the input changed"


def judged(path: Path, target: Path, originals: tuple[Original, Original], damages: Sequence[Damage]) -> Iterator[str]:
    """What is wrong with what comes back."""
    raw = path.read_bytes()
    chunks = proven(raw)
    must = [m for chunk in chunks for m in _must(chunk, chunks, raw, originals)]
    try:
        with RecoveredLog(path) as log:
            log.check()
            found, losses = content(log), log.losses
    except LogError as error:
        if must:
            yield f"{len(must)} proven messages, and: {error}"
        return
    lines = describe(losses.plain())
    known = {m for o in originals for m in o.messages} | {m for c in chunks for m in _crafted(c, originals)}
    known |= _undefined(chunks, raw, originals)
    wrong = [m for m in found if m not in known]
    if len(wrong) > losses.unchecked and not any(m[0] in losses.unchecked_topics for m in wrong):
        topics = Counter(m[0] for m in wrong)
        yield f"{len(wrong)} messages of none of the originals on {dict(topics)}: {lines}"
    moved = {m[1:] for m in wrong if m[0] in losses.unchecked_topics}  # on a topic that is named as unproven
    missed = Counter(m for m in set(must) if m[1:] not in moved) - Counter(found)
    undefined = 0 if set(damages) <= set(ALONE) else sum(n for t, n in losses.topics.items() if "not defined" in t)
    if missed.total() > losses.unproven + undefined:
        yield f"{missed.total()} of {len(must)} proven messages are missing, {losses.unproven} are told as unproven: {lines}"
    if not losses.unchecked and max(Counter(found).values(), default=1) > 1:
        yield f"messages come twice: {lines}"
    first, flipped = originals[0], set(damages) == {flip}
    if (
        set(damages) <= set(ALONE)
        and first.chunked
        and (len(first.summary) > SHORTEST_SUMMARY or flipped)
        and first.messages - Counter(found)
        and (losses.intact or (flipped and not losses))  # what is gone with its entry in the summary, nobody can miss
    ):
        yield f"{(first.messages - Counter(found)).total()} messages are missing, and nothing is told"
    yield from _repaired(path, target, found)


def _defined(original: Original, chunks: Sequence[Chunk], raw: bytes) -> set[int]:
    """Channels of an original that a proven record defines."""
    each = [original.own[c.record] for c in chunks if c.record in original.own]
    kinds = {kind for _, found in each for kind in found}
    defined = {n for channels, _ in each for n, (_, kind) in channels.items() if kind in kinds}
    if original.summary in raw and any(opcode == 4 for opcode, _ in _fields(original.summary)):
        defined = set(original.channels)
    return defined


def _must(chunk: Chunk, chunks: Sequence[Chunk], raw: bytes, originals: tuple[Original, Original]) -> Iterator[Message]:
    """Messages of a chunk that must come back: some proven record defines their channels."""
    for original in originals:
        if chunk.record in original.chunks:
            ids = {struct.unpack_from("<H", body)[0] for opcode, body in _fields(chunk.contents) if opcode == 5}
            if ids <= _defined(original, chunks, raw):
                yield from original.chunks[chunk.record]
            return


def _undefined(chunks: Sequence[Chunk], raw: bytes, originals: tuple[Original, Original]) -> set[Message]:
    """Messages whose own definition is gone, on the topics of the same type of the other log: nobody can tell."""
    found: set[Message] = set()
    for mine, other in (originals, originals[::-1]):
        gone = set(mine.channels) - _defined(mine, chunks, raw)
        alike = {i: c for i, c in other.channels.items() if i in gone and c[1] == mine.channels[i][1]}
        for chunk in chunks:
            if chunk.record in mine.chunks:
                found.update(_messages(chunk.contents, alike))
    return found


def _crafted(chunk: Chunk, originals: tuple[Original, Original]) -> Iterator[Message]:
    """Messages of a chunk that is proven and yet of no original."""
    if not any(chunk.record in original.chunks for original in originals):
        for original in originals:
            yield from _messages(chunk.contents, original.channels)


def _repaired(path: Path, target: Path, found: list[Message]) -> Iterator[str]:
    """What is wrong with the repaired log."""
    try:
        report = repair(path, target, overwrite=True)
    except LogError as error:
        if found or "nothing in it can be saved" not in str(error):
            yield f"not repaired: {error}"
        return
    saved = by_mcap(target)
    if Counter(saved) != Counter(found):
        yield f"the repaired log has {len(saved)} messages, the damaged one {len(found)}: {describe(report.losses.plain())}"
    if report.messages != Counter(m[0] for m in found):
        yield "the report counts other messages"
    with RecoveredLog(target) as log:
        log.check()
        if not log.losses.intact:
            yield f"the repaired log is damaged: {describe(log.losses.plain())}"
        starts = [block.start_ns for block in log.index.blocks]
    if not report.whole and starts != sorted(starts):
        yield "the chunks of the repaired log are not in order of time"
