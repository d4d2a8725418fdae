"""What `imutool debias` costs next to `cp` of the log: `python tests/bench/rewrite.py [--gb 1.5] [--rounds 3] [--in FOLDER]`.

The log is the usual and worst one: a 200 Hz IMU interleaved with images in every chunk of 1 MiB, half of them packed
already and half not, in three compressions; then one whose IMU has chunks of its own. Each job is a process of its own, all
jobs take turns in every round, the first round does not count, and the least is shown (what the machine does besides only
adds). In memory (`--in /dev/shm`) nothing is written to a disk; elsewhere we end with fsync, and `cp` followed by `sync` is the
fairer peer.

Jobs: `debias` is the whole command with its start and a shipped model, checks as by default, and `debias linear` the same with
the model that costs least. The others are parts, shown with `--jobs`, in CPU seconds and memory beyond what a python costs
that only imports what they need: `rewrite` adds the four topics of `imutool debias`, with a constant for a bias; `rewrite
verify none` and `rewrite verify all` check less and more; `pass` adds nothing; `re-encode` is the best existing way, every
message read and written by the `mcap` package; `sha256` is what a digest of all bytes would add; `floor` is the least
that Python can do with a check of every byte: read into one buffer, CRC, write.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.mcap_io.codec.encode import encode_imu, encode_twist, encode_vector3
from imutool.mcap_io.codec.messages import message_head, message_rows
from imutool.mcap_io.codec.records import crc32
from imutool.mcap_io.file_writer import Chunk, LogWriter
from imutool.mcap_io.passthrough.added_topics import DerivedBatch, NewTopic
from imutool.mcap_io.rewrite import rewrite
from imutool.mcap_io.storage.source import sha256

IMU, CAMERA, MONO = "/imu0", "/cam0/image_raw/compressed", "/cam1/image_raw"
IMAGE = "sensor_msgs/msg/Image"
PER_GB = 1_650  # images of each camera
BLOB, MONO_SHAPE = 250_000, (480, 752)
START_NS, PERIOD_NS, IMU_PER_IMAGE = 1_700_000_000_000_000_000, 5_000_000, 20
KEPT = 48  # different images; they come again and again, further apart than any compression looks back
PACKINGS = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}
BIAS = np.array([0.01, -0.02, 0.03])


class Constant:
    """The four topics of `imutool debias`, at no cost of a model."""

    source_topic = IMU
    topics = (
        NewTopic(f"{IMU}/debiased", schemas.IMU),
        NewTopic(f"{IMU}/bias/gyro", schemas.VECTOR3),
        NewTopic(f"{IMU}/bias/accel", schemas.VECTOR3),
        NewTopic(f"{IMU}/bias", schemas.TWIST),
    )

    def __call__(self, batch: ImuBatch) -> DerivedBatch:
        """The same bias for every sample."""
        bias, eye = np.tile(BIAS, (len(batch.stamp_ns), 1)), np.tile(np.eye(6), (len(batch.stamp_ns), 1, 1))
        imu = encode_imu(batch.stamp_ns, batch.gyro - bias, batch.accel - bias, batch.frame_id)
        vector = encode_vector3(batch.stamp_ns, bias, batch.frame_id)
        return DerivedBatch(batch, [imu, vector, vector, encode_twist(batch.stamp_ns, bias, bias, eye, batch.frame_id)])


# ── the logs ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def images() -> tuple[list[bytes], list[bytes]]:
    """Packed images, which no compression makes smaller, and plain ones, of which it takes a third."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[: MONO_SHAPE[0], : MONO_SHAPE[1]]
    plain = [
        ((rows + columns + 40 * k) // 8 % 200 + rng.integers(0, 24, MONO_SHAPE)).astype(np.uint8).tobytes() for k in range(KEPT)
    ]
    return [rng.bytes(BLOB) for _ in range(KEPT)], plain


def imu_rows(first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and payloads of some IMU messages."""
    rng = np.random.default_rng(first)
    t_ns = START_NS + PERIOD_NS * np.arange(first, first + count)
    return t_ns, encode_imu(t_ns, rng.normal(size=(count, 3)), rng.normal(size=(count, 3)), "imu")


def write_mixed(path: Path, gb: float, packing: str) -> None:
    """Everything in the chunks of one writer, as recorders do it."""
    packed, plain = images()
    with path.open("wb") as file:
        writer = Writer(file, compression=PACKINGS[packing])
        writer.start("ros2")
        kind = writer.register_schema(schemas.IMU, "ros2msg", schemas.definition(schemas.IMU).encode())
        imu = writer.register_channel(IMU, "cdr", kind)
        camera = writer.register_channel(CAMERA, "cdr", writer.register_schema(schemas.IMAGE, "ros2msg", b"uint8[] data"))
        mono = writer.register_channel(MONO, "cdr", writer.register_schema(IMAGE, "ros2msg", b"uint8[] data"))
        for k in range(int(gb * PER_GB)):
            t_ns, payloads = imu_rows(IMU_PER_IMAGE * k, IMU_PER_IMAGE)
            for row, (stamp, payload) in enumerate(zip(t_ns.tolist(), payloads, strict=True)):
                writer.add_message(imu, stamp, payload.tobytes(), stamp, IMU_PER_IMAGE * k + row)
            for channel, data in ((camera, packed[k % KEPT]), (mono, plain[k % KEPT])):
                writer.add_message(channel, stamp, data, stamp, k)
        writer.add_attachment(0, 0, "calibration.yaml", "text/yaml", b"k: 1\n" * 1000)
        writer.add_metadata("robot", {"id": "7"})
        writer.finish()


def write_apart(path: Path, gb: float, packing: str, *, data_crc: bool) -> None:
    """IMU in chunks of its own, as we write logs."""
    packed, plain = images()
    with LogWriter(path, compression=packing, data_crc=data_crc) as log:
        imu, camera = log.channel(IMU, schemas.IMU), log.channel(CAMERA, schemas.IMAGE)
        each, pairs = 2_900, 2  # messages of the IMU, and pairs of images, that make a chunk
        for k in range(0, int(gb * PER_GB), pairs):
            if k * IMU_PER_IMAGE % each < pairs * IMU_PER_IMAGE:
                count = min(each, (int(gb * PER_GB) - k) * IMU_PER_IMAGE)
                log.chunk(_chunk(imu, *imu_rows(k * IMU_PER_IMAGE // each * each, count)))
            times = START_NS + PERIOD_NS * IMU_PER_IMAGE * np.arange(k, k + pairs).repeat(2)
            data = [blob for j in range(k, k + pairs) for blob in (packed[j % KEPT], plain[j % KEPT])]
            parts = [
                message_head(camera, k + j // 2, int(t), int(t), len(blob)) + blob
                for j, (t, blob) in enumerate(zip(times, data, strict=True))
            ]
            offsets = np.cumsum([0, *map(len, parts[:-1])])
            log.chunk(Chunk(b"".join(parts), np.full(len(parts), camera, np.uint16), times, offsets))


def _chunk(channel: int, t_ns: np.ndarray, payloads: np.ndarray) -> Chunk:
    rows = message_rows(channel, t_ns, t_ns, np.arange(len(t_ns), dtype=np.uint32), payloads)
    offsets = rows.shape[1] * np.arange(len(rows))
    return Chunk(rows.tobytes(), np.full(len(rows), channel, np.uint16), t_ns, offsets)


# ── the jobs ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def reencode(source: Path, target: Path, packing: str) -> None:
    """Every message through the `mcap` package."""
    with source.open("rb") as file, target.open("wb") as out:
        writer, ids = Writer(out, compression=PACKINGS[packing]), dict[int, int]()
        writer.start("ros2")
        for kind, channel, message in make_reader(file).iter_messages():
            if channel.id not in ids:
                schema_id = writer.register_schema(kind.name, kind.encoding, kind.data)
                ids[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schema_id, channel.metadata)
            writer.add_message(ids[channel.id], message.log_time, message.data, message.publish_time, message.sequence)
        writer.finish()


def floor(source: Path, target: Path) -> None:
    """Every byte read into one buffer, summed and written: no log is looked at."""
    buffer, crc = memoryview(bytearray(1 << 20)), 0
    with source.open("rb", buffering=0) as file, target.open("wb", buffering=0) as out:
        while count := file.readinto(buffer):
            crc = crc32(buffer[:count], crc)
            out.write(buffer[:count])


def job(name: str, source: Path, target: Path, packing: str) -> None:
    """One job, in a process of its own."""
    if name.startswith("rewrite") or name in ("pass", "crc"):
        check = name.partition(" verify ")[2] or "imu"
        rewrite(source, target, [Constant()] if name.startswith("rewrite") else [], metadata={}, check=check)
    elif name == "re-encode":
        reencode(source, target, packing)
    elif name == "sha256":
        sha256(source)
    elif name == "floor":
        floor(source, target)


class Spent(NamedTuple):
    """CPU and wall seconds, and the peak of resident memory in MB."""

    cpu: float
    wall: float
    peak_mb: float

    def beyond(self, other: Spent) -> Spent:
        """What is left when another's is taken off."""
        return Spent(*(a - b for a, b in zip(self, other, strict=True)))


# Starts a command from a small process: the peak memory of a new process begins with that of the one that starts it.
STARTER = """
import os, sys, time
began, quiet = time.perf_counter(), [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
_, status, used = os.wait4(os.posix_spawnp(sys.argv[1], sys.argv[1:], os.environ, file_actions=quiet), 0)
print(used.ru_utime + used.ru_stime, time.perf_counter() - began, used.ru_maxrss / 1e3)
sys.exit(os.waitstatus_to_exitcode(status))
"""


def timed(line: list[str]) -> Spent:
    """A command run to its end."""
    started = [sys.executable, "-ISc", STARTER, *line]
    done = subprocess.run(started, check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=INSTALLED, text=True)
    return Spent(*map(float, done.stdout.split()))


def race(names: list[str], source: Path, packing: str, rounds: int) -> dict[str, Spent]:
    """The least of each job over rounds in which all take turns."""
    target, spent = source.with_name("out.mcap"), dict[str, list[Spent]]()
    imutool = str(Path(sys.executable).with_name("imutool"))
    known = {
        "cp": ["cp", str(source), str(target)],
        "cp, sync": ["sh", "-c", 'cp "$0" "$1" && sync "$1"', str(source), str(target)],
        "debias": [imutool, "debias", str(source), str(target), "-q", "--force", "--model", "euroc-adis16448-hybrid"],
        "debias linear": [imutool, "debias", str(source), str(target), "-q", "--force", "--model", "euroc-adis16448-linear"],
    }
    for count in range(rounds + 1):
        for name in names:
            line = known.get(name) or [sys.executable, __file__, "--job", name, str(source), str(target), packing]
            taken = timed(line)
            target.unlink(missing_ok=True)
            if count:
                spent.setdefault(name, []).append(taken)
    return {name: Spent(*(min(column) for column in zip(*runs, strict=True))) for name, runs in spent.items()}


# ── the tables ───────────────────────────────────────────────────────────────────────────────────────────────────────

WHOLE = ["cp", "cp, sync", "debias", "debias linear"]
# a package is compiled once, when it is installed; a checkout in an environment that keeps no bytecode would be at each start
INSTALLED = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
INSTALLED.setdefault("PYTHONPYCACHEPREFIX", f"{tempfile.gettempdir()}/imutool-bench-bytecode")


def logs(gb: float, folder: Path, chosen: list[str]) -> Iterator[tuple[str, Path, str]]:
    """Each log in turn, made, lent and deleted: its name, where it is, and how it is packed."""
    path = folder / "log.mcap"
    for name in chosen:
        place, _, packing = name.partition("-")
        if place == "mixed":
            write_mixed(path, gb, packing)
        else:
            write_apart(path, gb, packing, data_crc=place == "crc")
        yield name, path, packing
        path.unlink()


def table(name: str, size: int, spent: dict[str, Spent]) -> None:
    """Prints the jobs of one log, ratios against `cp` in the same run."""
    nothing, cp = spent.pop("nothing", None), spent["cp"]
    print(f"\n{name}, {size / 1e6:.0f} MB")
    print(f"{'':24}{'CPU s':>8}{'/ cp':>8}{'wall s':>9}{'/ cp':>8}{'peak MB':>10}")
    for job_name, taken in spent.items():
        mine = taken if nothing is None or job_name in WHOLE else taken.beyond(nothing)
        print(f"{job_name:24}{mine.cpu:8.2f}{mine.cpu / cp.cpu:8.2f}{mine.wall:9.2f}{mine.wall / cp.wall:8.2f}", end="")
        print(f"{mine.peak_mb:10.0f}" if taken.peak_mb else "", flush=True)


def main() -> None:
    """Prints a table for each log."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    every = ["mixed-none", "mixed-lz4", "mixed-zstd", "apart-zstd", "crc-zstd"]
    parser.add_argument("--gb", type=float, default=1.5, help="size of the messages")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--in", dest="folder", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--logs", nargs="*", choices=every, default=every)
    parser.add_argument("--jobs", nargs="*", help="parts of the command")
    args = parser.parse_args()
    need = int(2.2e9 * args.gb)
    assert shutil.disk_usage(args.folder).free > 2 * need, f"{args.folder} has no room for {need / 1e9:.0f} GB"
    with tempfile.TemporaryDirectory(dir=args.folder) as name:
        print(f"{args.rounds} rounds in {args.folder}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
        for log, path, packing in logs(args.gb, Path(name), args.logs):
            chosen = WHOLE if args.jobs is None else ["nothing", "cp", *args.jobs]
            table(log, path.stat().st_size, race(chosen, path, packing, args.rounds))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--job"]:
        job(sys.argv[2], Path(sys.argv[3]), Path(sys.argv[4]), sys.argv[5])
    else:
        main()
