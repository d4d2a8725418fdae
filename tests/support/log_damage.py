"""One small log damaged in every way there is, and what of that should not have happened.

It runs in another process, because annotations that are checked at every call make a hundred thousand small files take minutes.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import random
import signal
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

from mcap.opcode import Opcode
from mcap.reader import make_reader

from imutool.errors import LogError
from imutool.mcap_io.codec import messages
from imutool.mcap_io.codec.records import HEAD, MAGIC
from imutool.mcap_io.log import Log
from imutool.mcap_io.recovery.losses import describe
from imutool.mcap_io.recovery.recovered_log import RecoveredLog
from imutool.mcap_io.repair import repair

Message = tuple[str, int, int, int, bytes]  # topic, log time, publish time, sequence, payload

CASES = 80  # seeded corruptions of a log in each layout
BUDGET_S = 5.0  # for one small file: it takes milliseconds
KINDS = ("flip", "zero", "length", "garbage", "cut", "duplicate", "remove", "reorder", "join", "several")
IN_PLACE = KINDS[:5]  # what is not damaged by these lies where it lay
NEAR = range(-1, 3)  # bytes around the first of a record where a log is cut: in its head and in the end of the one before
APART = 7  # bytes between other cuts: no length of a head, and of no record
CHUNK_TIMES, RECORDS_SIZE, NAME_SIZE = 28, 8, struct.Struct("<I")  # bytes of a chunk before and after its compression
DOUBTFUL = 3  # messages outside chunks that may be given up for nothing: nothing shows where the one before a damage ends


@contextlib.contextmanager
def in_time(seconds: float = BUDGET_S, error: type[BaseException] = TimeoutError) -> Iterator[None]:
    """Ends a case that hangs."""

    def late(number: int, frame: object) -> None:
        raise error

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def content(log: Log) -> list[Message]:
    """Every message, as it comes back."""
    found = []
    for block in log.index.blocks:
        each = log.index.unpack_or_lose(block)
        if each is not None:
            found += of_block(log, each)
    return found


def of_block(log: Log, each: messages.Messages) -> list[Message]:
    channels, data = log.index.channels, each.data
    return [
        (
            channels[int(head["channel"])].topic,
            int(head["log_time"]),
            int(head["publish_time"]),
            int(head["sequence"]),
            data[at + messages.MESSAGE.itemsize : at + HEAD.size + int(head["length"])].tobytes(),
        )
        for at, head in zip(each.offsets.tolist(), each.heads, strict=True)
    ]


def stretches(path: Path) -> list[tuple[int, int, list[Message]]]:
    """First and last byte of every chunk, or message outside chunks, of a whole log, with what is in it."""
    found = []
    with Log(path) as log:
        for block in log.index.blocks:
            each = log.index.unpack(block)
            if block.compression is not None:
                found.append((block.offset, block.offset + block.length, of_block(log, each)))
                continue
            for at, head, message in zip(each.offsets.tolist(), each.heads, of_block(log, each), strict=True):
                found.append((block.offset + at, block.offset + at + HEAD.size + int(head["length"]), [message]))
    return found


def by_mcap(path: Path) -> list[Message]:
    """The messages as the `mcap` package reads them by the index."""
    with path.open("rb") as file:
        found = make_reader(file, validate_crcs=True).iter_messages()
        return [(c.topic, m.log_time, m.publish_time, m.sequence, bytes(m.data)) for _, c, m in found]


def damaged(raw: bytes, kind: str, rng: random.Random, other: bytes) -> bytes:  # noqa: PLR0911  # one way a line
    """The bytes of a log after something happened to them."""
    size = len(raw)
    at = rng.randrange(size)
    until = min(size, at + rng.randrange(1, 600))
    if kind == "flip":
        changed = bytearray(raw)
        for _ in range(rng.randrange(1, 4)):
            changed[rng.randrange(size)] ^= 1 << rng.randrange(8)
        return bytes(changed)
    if kind == "zero":
        return raw[:at] + bytes(until - at) + raw[until:]
    if kind == "length":
        value = rng.choice((0, 1, 5, 2**31, 2**62, 2**64 - 1))
        return raw[:at] + value.to_bytes(8, "little") + raw[at + 8 :]
    if kind == "garbage":
        return raw[:at] + rng.randbytes(until - at) + raw[until:]
    if kind == "cut":
        return raw[:at]
    if kind == "duplicate":
        return raw[:until] + raw[at:]
    if kind == "remove":
        return raw[:at] + raw[until:]
    if kind == "reorder":
        a, b, c = sorted(rng.randrange(size) for _ in range(3))
        return raw[:a] + raw[b:c] + raw[a:b] + raw[c:]
    if kind == "join":
        return raw[: rng.choice((size, at))] + other
    for each in rng.sample(KINDS[:7], 3):
        raw = damaged(raw, each, rng, other) or raw
    return raw


_cut: set[bytes] = set()
"""Digests of the cut files that were looked at: layouts that differ in their summary alone are the same up to it."""


def edges(raw: bytes) -> set[int]:
    """First bytes of all records of a log, of those in its unpacked chunks too, and of the closing magic."""
    found, ends = set[int](), [(len(MAGIC), len(raw) - len(MAGIC))]
    for first, end in ends:
        at = first
        while at < end:
            opcode, length = HEAD.unpack_from(raw, at)
            found.add(at)
            body, at = at + HEAD.size, at + HEAD.size + length
            if opcode == Opcode.CHUNK:
                (size,) = NAME_SIZE.unpack_from(raw, body + CHUNK_TIMES)
                ends += [] if size else [(body + CHUNK_TIMES + NAME_SIZE.size + RECORDS_SIZE, at)]
    return found | {len(raw) - len(MAGIC)}


def after_a_cut(path: Path) -> Iterator[str]:
    """Cuts the file at and around every record and at every `APART` bytes.

    All messages before the cut must come back, and the cut be told.
    """
    whole, raw, running, new = stretches(path), path.read_bytes(), hashlib.sha256(), []
    cuts = {edge + near for edge in edges(raw) for near in NEAR} | set(range(0, len(raw), APART))
    end_of_data = max(end for _, end, _ in whole)
    for cut in range(len(raw)):
        if cut in cuts and (digest := running.digest()) not in _cut:
            new.append(cut)
            _cut.add(digest)
        running.update(raw[cut : cut + 1])
    for cut in reversed(new):
        os.truncate(path, cut)
        theory = [message for _, end, each in whole if end <= cut for message in each]
        try:
            with in_time(), RecoveredLog(path) as log:
                found, losses = content(log), log.losses
        except LogError as error:
            if theory:
                yield f"cut at {cut}: {error}"
            continue
        assert losses is not None
        if found != theory:
            yield f"cut at {cut}: {len(found)} messages, not {len(theory)}: {describe(losses.plain())}"
        if not losses and (not losses.harmless or cut <= end_of_data):
            yield f"cut at {cut}: not told"


def after_corruption(path: Path, other: Path, seed: str) -> Iterator[str]:
    """Damages the file by seed; sound messages must come back, others not, and the file stay as it is."""
    whole, raw, joined = stretches(path), path.read_bytes(), other.read_bytes()
    every = Counter(message for _, _, each in whole for message in each)
    known = set(every) | {message for _, _, each in stretches(other) for message in each}
    with Log(path) as log:
        chunked = any(block.compression is not None for block in log.index.blocks)
    for case in range(CASES):
        rng, kind = random.Random(f"{seed} {case}"), KINDS[case % len(KINDS)]
        broken = damaged(raw, kind, rng, joined)
        path.write_bytes(broken)
        with in_time():
            yield from (
                f"{kind} {case}: {what}"
                for what in check(path, whole, known, in_place=kind in IN_PLACE, raw=raw, chunked=chunked)
            )
            if case % 8 == 0:
                yield from (f"{kind} {case}: {what}" for what in check_repair(path, rng.choice(("drop", "keep"))))
        if path.read_bytes() != broken:
            yield f"{kind} {case}: the input changed"


def check(
    path: Path, whole: list[tuple[int, int, list[Message]]], known: set[Message], *, in_place: bool, raw: bytes, chunked: bool
) -> Iterator[str]:
    """What is wrong with what comes back from a damaged file."""
    try:
        with RecoveredLog(path) as log:
            found, losses = content(log), log.losses
    except LogError:
        return
    assert losses is not None
    lines, broken = describe(losses.plain()), path.read_bytes()
    bad = [message for message in found if message not in known and message[0] not in losses.unchecked_topics]
    if bad and not losses.unchecked:
        yield f"{len(bad)} bad messages: {lines}"
    if not in_place:
        return
    sound = Counter(m for start, end, each in whole if broken[start:end] == raw[start:end] for m in each)
    if losses.unchecked_topics:  # a topic may be called otherwise now, which is told
        sound, found = Counter(("", *m[1:]) for m in sound.elements()), [("", *m[1:]) for m in found]
        whole = [(start, end, [("", *m[1:]) for m in each]) for start, end, each in whole]
    missed = (sound - Counter(found)).total()
    if missed > (0 if chunked else DOUBTFUL) and not any("not defined" in line for line in lines):
        yield f"{missed} sound messages missing: {lines}"
    every = Counter(m for _, _, each in whole for m in each)
    if (every - Counter(found)).total() and not losses and not losses.unchecked:
        yield f"{(every - Counter(found)).total()} messages missing, and nothing told"


def check_repair(path: Path, damage: str) -> Iterator[str]:
    """What is wrong with the log that is written from a damaged one."""
    target = path.with_name("repaired.mcap")
    try:
        with RecoveredLog(path) as log:
            found = content(log)
        report = repair(path, target, overwrite=True, damaged=damage)
    except LogError as error:
        if "nothing in it can be saved" not in str(error) and "not an MCAP log" not in str(error):
            yield f"not repaired: {error}"
        return
    if Counter(by_mcap(target)) != Counter(found):
        yield "the repaired log holds something else"
    if report.messages != Counter(message[0] for message in found):
        yield "the report counts something else"


def findings(damage: Callable[..., Iterator[str]], *how: object) -> str:
    """What should not have happened to a damaged log (`after_a_cut`, `after_corruption`), or was said meanwhile."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        for line in damage(*how):
            print(line)
    return said.getvalue()
