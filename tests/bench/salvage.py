"""Damaged logs: `python tests/bench/salvage.py [MEGABYTES]`, IMU messages saved of those in undamaged chunks, against others.

A log of 2001 IMU messages with images in every chunk is damaged in the ways that happen; each reader saves what it can in a
process of its own, and every message it gives back is held against the original: `bad` ones differ from all of those. The
theoretical count is that of messages in chunks of which no byte is damaged. `open` is the time to open the whole log.
Readers that are not installed are named and left out.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import zstandard
from mcap.writer import CompressionType, Writer

from imutool.errors import LogError
from imutool.log_info.inspection import inspect
from imutool.mcap_io.codec import messages, records, schemas
from imutool.mcap_io.codec.encode import encode_image, encode_imu
from imutool.mcap_io.codec.records import HEAD
from imutool.mcap_io.log import Log
from imutool.mcap_io.recovery.recovered_log import RecoveredLog
from imutool.mcap_io.repair import repair

COUNT = 2001
LIMIT_S = 40
PERIOD_NS = 5_000_000


def made(path: Path, megabytes: int, **options: object) -> None:
    """The log: an IMU at 200 Hz, and random images at 20 Hz that fill it up."""
    rng = np.random.default_rng(5)
    image = megabytes * 1_000_000 // (COUNT // 10)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 20, **{"compression": CompressionType.ZSTD, **options})  # type: ignore[arg-type]
        writer.start("ros2")
        imu = writer.register_schema(schemas.IMU, "ros2msg", schemas.definition(schemas.IMU).encode())
        camera = writer.register_schema(schemas.IMAGE, "ros2msg", schemas.definition(schemas.IMAGE).encode())
        channels = writer.register_channel("/imu0", "cdr", imu), writer.register_channel("/cam0", "cdr", camera)
        for row in range(COUNT):
            t_ns = 10**18 + PERIOD_NS * row
            payload = encode_imu(np.array([t_ns]), rng.normal(size=(1, 3)), rng.normal(size=(1, 3)), "imu").tobytes()
            writer.add_message(channels[0], t_ns, payload, t_ns, row)
            if row % 10 == 0:
                data = encode_image(t_ns, rng.bytes(image), "cam0", "jpeg")
                writer.add_message(channels[1], t_ns, data, t_ns, row)
        writer.finish()


# ── what each reader gives back, as a line of JSON: the digests of its IMU messages ──


def digests(messages: Iterable[bytes]) -> list[str]:
    """One short digest a message; what came before an error counts."""
    found: list[str] = []
    try:
        found.extend(hashlib.blake2b(bytes(data), digest_size=8).hexdigest() for data in messages)
    except Exception as error:  # noqa: BLE001  # a peer may fail in any way; that it did is told
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
    return found


def by_imutool(path: Path) -> Iterator[bytes]:
    """Ours."""
    with RecoveredLog(path) as log:
        for _, rows in log.rows(["/imu0"]):
            yield from (row.tobytes() for row in rows.payload)


def by_mcap(path: Path) -> Iterator[bytes]:
    """The reader of the format's own package, which goes by the index."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        yield from (m.data for _, _, m in make_reader(file, validate_crcs=True).iter_messages(topics=["/imu0"]))


def by_mcap_stream(path: Path) -> Iterator[bytes]:
    """The same, in the order of the file."""
    from mcap.reader import NonSeekingReader
    from mcap.records import Message
    from mcap.stream_reader import StreamReader

    assert NonSeekingReader is not None
    with path.open("rb") as file:
        yield from (
            r.data for r in StreamReader(file, validate_crcs=True).records if isinstance(r, Message) and r.channel_id == 1
        )


def by_rosbags(path: Path) -> Iterator[bytes]:
    """The reader of rosbags."""
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        imu = [c for c in reader.connections if c.topic == "/imu0"]
        yield from (raw for _, _, raw in reader.messages(connections=imu))


def by_pybag(path: Path) -> Iterator[bytes]:
    """`pybag recover`, and what it wrote."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "out.mcap"
        subprocess.run(["pybag", "recover", path, "-o", target], check=False, stdout=subprocess.DEVNULL)
        yield from by_mcap(target)


def by_rerun(path: Path) -> Iterator[bytes]:
    """Rerun's reader, told to recover."""
    from rerun.chunk import McapReader

    for chunk in McapReader(path, include_topic_regex=["^/imu0$"], decoders=["raw"], recover=True).stream():
        batch = chunk.to_record_batch()
        if "McapMessage:data" in batch.schema.names:
            yield from (bytes(row[0]) for row in batch.column("McapMessage:data").to_pylist())


READERS: dict[str, tuple[Callable[[Path], Iterator[bytes]], str]] = {
    "imutool": (by_imutool, "imutool"),
    "mcap": (by_mcap, "mcap"),
    "mcap stream": (by_mcap_stream, "mcap"),
    "rosbags": (by_rosbags, "rosbags"),
    "pybag": (by_pybag, "pybag"),
    "rerun": (by_rerun, "rerun"),
}


# ── the damage ──


def hits(record: bytes, at: int) -> bool:
    """Whether flipping a bit there changes an IMU message of a chunk that still unpacks."""
    head = records.ChunkHead.of(record[:128], len(record), 0)
    contents = []
    for data in (record, record[:at] + bytes([record[at] ^ 1]) + record[at + 1 :]):
        try:
            unpacked = zstandard.ZstdDecompressor().decompress(data[head.data_at :], max_output_size=head.size)
            found = messages.parse(unpacked, 0)
        except (zstandard.ZstdError, LogError):
            return False
        contents.append([payload.tobytes() for _, payload in messages.cut(found, found.heads["channel"] == 1)])
    return contents[0] != contents[1] and [len(one) for one in contents[0]] == [len(one) for one in contents[1]]


def damages(whole: bytes, chunks: list[tuple[int, int, int]]) -> dict[str, bytes]:
    """Every kind of damage, around the middle of the log; a chunk is its offset, length and the end of its indexes."""
    start, length, end = chunks[len(chunks) // 2]

    def put(at: int, data: bytes) -> bytes:
        return whole[:at] + data + whole[at + len(data) :]

    flipped = next(at for at in range(start + 60, start + length) if hits(whole[start : start + length], at - start))
    page = (start + 2048) // 4096 * 4096
    return {
        "whole": whole,
        "cut mid-chunk": whole[: start + length // 2],
        "cut mid-MessageIndex": whole[: end - 20],
        "cut at a chunk's end": whole[:end],
        "cut in the summary": whole[: len(whole) - 200],
        "one byte flipped in a chunk": put(flipped, bytes([whole[flipped] ^ 1])),
        "4 KiB zeroed over a chunk's head": put(page, bytes(4096))
        if page <= start < page + 4096
        else put(start - 100, bytes(4096)),
        "a chunk's length is 2^62": put(start + 1, (2**62).to_bytes(8, "little")),
        "zeroed head, no summary": put(start - 100, bytes(4096))[: len(whole) - 5000],
        "joined, the first cut": whole[: start + length // 2] + whole,
        "a chunk missing": whole[:start] + whole[end:],
    }


def ask(name: str, path: Path) -> tuple[list[str], str]:
    """A reader's digests, and how it ended."""
    line = [sys.executable, __file__, "--read", name, str(path)]
    try:
        done = subprocess.run(line, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    except subprocess.TimeoutExpired:
        return [], "hangs"
    return (json.loads(done.stdout) if done.stdout else []), ("!" if done.stderr.strip() or done.returncode else "")


def main() -> None:
    """Prints the table."""
    megabytes = int(sys.argv[1]) if len(sys.argv) > 1 else 50
    there = [name for name, (_, package) in READERS.items() if importlib.util.find_spec(package) or shutil.which(package)]
    for name in READERS.keys() - set(there):
        print(f"{name} is not installed, so it is left out")
    with tempfile.TemporaryDirectory() as folder:
        log, damaged = Path(folder) / "log.mcap", Path(folder) / "damaged.mcap"
        made(log, megabytes)
        whole = log.read_bytes()
        with Log(log) as opened:
            chunks = [(b.offset, b.length, b.end) for b in opened.index.blocks]
            imu = {}
            for block in opened.index.blocks:
                found = opened.index.unpack(block)
                rows = [o for o, c in zip(found.offsets.tolist(), found.heads["channel"].tolist(), strict=True) if c == 1]
                size = 31
                imu[block.offset] = [
                    hashlib.blake2b(
                        found.data[
                            o + size : o + HEAD.size + int.from_bytes(found.data[o + 1 : o + 9].tobytes(), "little")
                        ].tobytes(),
                        digest_size=8,
                    ).hexdigest()
                    for o in rows
                ]
        original = {digest for each in imu.values() for digest in each}
        print(
            f"{len(original)} IMU messages in {len(chunks)} chunks, {len(whole) / 1e6:.0f} MB; saved / bad, ! for an error told"
        )
        print(f"{'damage':36}{'in theory':>10}" + "".join(f"{name:>14}" for name in there))
        for kind, content in damages(whole, chunks).items():
            damaged.write_bytes(content)
            sound = {d for at, length, _ in chunks if whole[at : at + length] in content for d in imu[at]}
            cells = []
            for name in there:
                found, ended = ask(name, damaged)
                cells.append(f"{len(set(found) & original)}/{len(set(found) - original)}{ended}")
            print(f"{kind:36}{len(sound):10}" + "".join(f"{cell:>14}" for cell in cells), flush=True)
        for opener in (Log, RecoveredLog, Log, RecoveredLog):
            began = time.process_time()
            with opener(log):
                print(f"open as {opener.__name__:14} {1e3 * (time.process_time() - began):8.1f} ms CPU")


def small_chunks(count: int) -> None:
    """CPU seconds of `info` and `repair` for a log of so many chunks of one message, whole and with one flipped byte."""
    with tempfile.TemporaryDirectory() as name:
        log = Path(name) / "log.mcap"
        with log.open("wb") as file:
            writer = Writer(file, chunk_size=1)
            writer.start("ros2")
            channel = writer.register_channel(
                "/talk", "cdr", writer.register_schema("std_msgs/msg/Int64", "ros2msg", b"int64 data\n")
            )
            for row in range(count):
                writer.add_message(channel, 10**18 + row, struct.pack("<Iq", 256, row), 10**18 + row, row)
            writer.finish()
        for state in ("whole", "one byte flipped"):
            for what, work in (
                ("info", lambda: inspect(log)),
                ("repair", lambda: repair(log, log.with_name("out"), overwrite=True)),
            ):
                began = time.process_time()
                work()
                print(f"{state}, {what}: {time.process_time() - began:.1f} CPU s", flush=True)
            if state == "whole":
                with Log(log) as opened:
                    block = opened.index.blocks[count // 3]
                raw = bytearray(log.read_bytes())
                raw[block.offset + block.length - 1] ^= 1
                log.write_bytes(raw)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--small-chunks"]:
        small_chunks(int(sys.argv[2]))
        sys.exit()
    if sys.argv[1:2] == ["--read"]:
        print(json.dumps(digests(READERS[sys.argv[2]][0](Path(sys.argv[3])))))
    else:
        main()
