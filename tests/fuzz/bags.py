"""Damaged ROS 1 bags: nothing that a bz2 chunk's own checks prove is lost or altered; nothing hangs or ends in a traceback."""

from __future__ import annotations

import random
import tempfile
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from fuzz import command, outside_contract
from imutool.bag.repair import repair_bag
from imutool.bag.scan import Bag
from imutool.errors import LogError

STORE = get_typestore(Stores.ROS1_NOETIC)
TEXT = STORE.types["std_msgs/msg/String"]
COMMAND_EVERY = 12
Message = tuple[str, int, bytes]


@cache
def whole(number: int) -> tuple[bytes, bool]:
    """A bag of two topics in small chunks, and whether its chunks check themselves."""
    rng = random.Random(number)
    packing = ("none", "bz2", "lz4")[number % 3]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "one.bag"
        writer = Writer(path)
        writer.chunk_threshold = rng.choice((200, 900))
        if packing != "none":
            writer.set_compression(Writer.CompressionFormat[packing.upper()])
        with writer as bag:
            numbers = [bag.add_connection(topic, TEXT.__msgtype__, typestore=STORE) for topic in ("/imu", "/pose")]
            for n in range(30):
                payload = bytes(STORE.serialize_ros1(TEXT(rng.randbytes(rng.randrange(40)).hex()), TEXT.__msgtype__))
                bag.write(numbers[n % 2], 10**18 + n * 10**6, payload)
        return path.read_bytes(), packing == "bz2"


def read(path: Path) -> list[Message]:
    """Every message that comes back."""
    with Bag(path, recover=True) as bag:
        return [
            (bag.connections[m.connection].topic, m.time_ns, chunk.data[m.data_at : m.end])
            for chunk in bag.chunks()
            for m in chunk.messages
        ]


def damaged(raw: bytes, other: bytes, rng: random.Random) -> bytes:
    """The bytes of a bag after something happened to them."""
    at, size = rng.randrange(len(raw)), rng.choice((1, 8, 60, 600))
    new = rng.choice((bytes(size), rng.randbytes(size), other[at : at + size], other))[: len(raw) - at]
    a, b, c = sorted(rng.randrange(len(raw)) for _ in range(3))
    return rng.choice(
        (raw[:at], raw[:at] + new + raw[at + len(new) :], raw[:a] + raw[b:c] + raw[a:b] + raw[c:], raw[:at] + other)
    )


def problems(rng: random.Random, folder: Path) -> Iterator[str]:
    """Damages a bag in up to three ways, and judges what is read and what is repaired."""
    number = rng.randrange(12)
    (raw, checked), (other, _) = whole(number), whole(number + 12)
    for _ in range(rng.choice((1, 1, 2, 3))):
        raw = damaged(raw, other, rng) or raw
    path, target = folder / "log.bag", folder / "out.bag"
    path.write_bytes(raw)
    originals = Counter[Message]()
    for number_, each in enumerate((whole(number)[0], other)):
        (folder / f"{number_}.bag").write_bytes(each)
        originals.update(read(folder / f"{number_}.bag"))
    try:
        found = read(path)
        report = repair_bag(path, target)
    except LogError:
        found, report = [], None
    if checked and (wrong := [m for m in found if m not in originals]):
        yield f"{len(wrong)} messages of neither original"
    if report is not None and Counter(read(target)) != Counter(found):
        yield "the repaired bag has other messages"
    if rng.randrange(COMMAND_EVERY) == 0:
        yield from outside_contract(command(folder, "repair", "log.bag", "again.bag", "-q"), (0, 3, 5))
    if path.read_bytes() != raw:
        yield "the input changed"
