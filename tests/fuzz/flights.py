"""Damaged ULogs, DataFlash logs and ROS 2 bags in SQLite: a finite log that says what was lost, or an error with its place."""

from __future__ import annotations

import random
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from support.flight_logs import ulog_flight, write_dataflash

from fuzz import command, outside_contract
from fuzz._inputs import START_NS, STEP_NS, finite_log, only_below, put
from fuzz._inputs import damaged as damaged_text
from imutool.errors import LogError

STORE = get_typestore(Stores.ROS2_HUMBLE)
ROWS = 40
SIZES = (1, 2, 8, 60, 600)


@cache
def whole(kind: str) -> dict[str, bytes]:
    """Files of a flight by name; the first is the one that the command is given."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if kind == "ulog":
            return {"log.ulg": ulog_flight().write(folder / "log.ulg").read_bytes()}
        if kind != "bag":
            return {f"log.{kind}": write_dataflash(folder / f"log.{kind}", text=kind == "log").read_bytes()}
        _write_bag(folder / "bag")
        return {f"bag/{path.name}": path.read_bytes() for path in sorted((folder / "bag").iterdir())}


def _write_bag(folder: Path) -> None:
    """A bag of an IMU as rosbag2 writes it into SQLite."""
    types = STORE.types
    stamp, header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    vector = types["geometry_msgs/msg/Vector3"]
    turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    imu, unknown = types["sensor_msgs/msg/Imu"], np.zeros(9)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        topic = bag.add_connection("/imu", imu.__msgtype__, typestore=STORE)
        for n in range(ROWS):
            t_ns = START_NS + n * STEP_NS
            at = header(stamp(t_ns // 10**9, t_ns % 10**9), "imu")
            message = imu(at, turn, unknown, vector(0.1, 0.2, 0.3), unknown, vector(0.0, 0.5, 9.8), unknown)
            bag.write(topic, t_ns, STORE.serialize_cdr(message, imu.__msgtype__))


def damaged(raw: bytes, rng: random.Random) -> bytes:
    """Bytes after something happened to them."""
    at, size = rng.randrange(len(raw)), rng.choice(SIZES)
    new = rng.choice((bytes(size), b"\xff" * size, rng.randbytes(size)))
    a, b, c = sorted(rng.randrange(len(raw) + 1) for _ in range(3))
    flipped = bytes([raw[at] ^ 1 << rng.randrange(8)])
    return rng.choice(
        (
            raw[:at],
            raw[:at] + flipped + raw[at + 1 :],
            raw[:at] + new + raw[at + size :],
            raw[:at] + new + raw[at:],
            raw[:at] + raw[at + size :],
            raw[:a] + raw[b:c] + raw[a:b] + raw[c:],
            raw + raw[a:b],
        )
    )


def problems(rng: random.Random, folder: Path) -> Iterator[str]:
    """Converts a damaged flight, and reads what came out."""
    kind = rng.choice(("ulog", "ulog", "BIN", "BIN", "log", "bag"))
    files = dict(whole(kind))
    name = rng.choice(sorted(files))
    is_text = kind == "log" or name.endswith(".yaml")
    for _ in range(rng.choice((1, 1, 2, 5))):
        files[name] = (damaged_text(rng, files[name]) if is_text and rng.random() < 0.5 else damaged(files[name], rng)) or b"?"
    put(folder, files)
    source = "bag" if kind == "bag" else name
    with only_below(folder, "out.mcap") as wrong:
        done = command(folder, "convert", source, "out.mcap", "-q")
    yield from wrong
    yield from outside_contract(done, (0, 3, 4))
    log = folder / "out.mcap"
    if log.exists() and done.returncode != 0 and "warning: out.mcap: " not in done.stderr:
        yield f"exit code {done.returncode}, a log, and no word of a loss: {done.stderr!r}"
    if log.exists():
        read = command(folder, "info", "out.mcap", "--json", "-")
        yield from outside_contract(read, (0, 3, 5))
        with suppress(LogError):  # names a message of the recording itself that is none, or has no finite numbers
            yield from finite_log(log)
    elif "error:" not in done.stderr:
        yield f"no message: {done.stderr!r}"
    if len(done.stderr) > 4000:
        yield f"a message of {len(done.stderr)} letters"
    if any(not letter.isprintable() and letter != "\n" for letter in done.stderr):
        yield f"control characters in a message: {done.stderr!r}"
