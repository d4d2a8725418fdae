"""What reading and debiasing a log in a store asks of it: requests and bytes, by kind of cache and size of block.

    python tests/bench/store.py [LOG.mcap]        without a log: 25 MB made up, images and an IMU in the same chunks

Of every way of caching that fsspec has: how many GETs, against the fewest there can be with blocks of that size (each byte
that the pass needs, once), and how many bytes against those the log has. Runs its own S3 server on loopback.
"""

from __future__ import annotations

import os
import runpy
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer

from imutool import file_location as places
from imutool.cleaning.survey import raw_batches
from imutool.debiasing import debias
from imutool.file_location import to_location
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.encode import encode_imu
from imutool.mcap_io.log import Log
from imutool.mcap_io.rewrite import rewrite
from imutool.mcap_io.storage.source import sha256

MIB = 1 << 20
SECONDS, RATE_HZ, IMAGE_BYTES = 6, 200, 200_000


def mixed(path: Path) -> Path:
    """A log whose every chunk holds both: the usual and the worst."""
    rng = np.random.default_rng(1)
    t_ns = 10**18 + np.arange(SECONDS * RATE_HZ) * 5_000_000
    payload = encode_imu(
        t_ns, 0.01 * rng.normal(size=(len(t_ns), 3)), rng.normal(size=(len(t_ns), 3)) * 0.05 + [0, 0, 9.81], "imu"
    )
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start("ros2")
        imu = writer.register_channel(
            "/imu0", "cdr", writer.register_schema(schemas.IMU, "ros2msg", schemas.definition(schemas.IMU).encode())
        )
        images = writer.register_channel("/cam0", "raw", 0)
        for row, time_ns in enumerate(t_ns.tolist()):
            writer.add_message(imu, time_ns, payload[row].tobytes(), time_ns, row)
            if row % 10 == 0:
                writer.add_message(images, time_ns, rng.bytes(IMAGE_BYTES), time_ns, row)
        writer.finish()
    return path


def main() -> None:
    """Measures and prints."""
    store = runpy.run_path(str(Path(__file__).parents[1] / "support" / "object_store.py"))["Store"]()
    os.environ.update(store.environment)
    with tempfile.TemporaryDirectory() as folder:
        source = Path(sys.argv[1]) if len(sys.argv) > 1 else mixed(Path(folder) / "mixed.mcap")
        store.empty()
        url, size = store.put("in.mcap", source.read_bytes()), source.stat().st_size
        passes: dict[str, Callable[[], object]] = {
            "open": lambda: Log(to_location(url)).__exit__(None, None, None),
            "sha256": lambda: sha256(to_location(url)),
            "imu": lambda: [len(batch.gyro) for batch in raw_batches(Log(to_location(url)), "/imu0")],
            "copy": lambda: rewrite(to_location(url), to_location("s3://fleet/out.mcap"), [], metadata={}, overwrite=True),
            "debias": lambda: debias(to_location(url), to_location("s3://fleet/out.mcap"), model="static", overwrite=True),
        }
        print(f"{source.name}: {size / MIB:.1f} MiB; GETs and MiB read of the source, seconds")
        print(f"{'cache':>12} {'block MiB':>9} " + " ".join(f"{name:>22}" for name in passes) + "   one pass needs")
        for cache, options in (
            ("readahead", {}),
            ("bytes", {}),
            ("blockcache", {"maxblocks": 4}),
            ("background", {"maxblocks": 4}),
        ):
            for block in (1, 4, 8):
                places.CACHE, places.CACHE_OPTIONS, places.BLOCK_BYTES = cache, options, block * MIB
                cells = []
                for run in passes.values():
                    store.requests.clear()
                    began = time.perf_counter()
                    run()
                    taken = time.perf_counter() - began
                    gets = [
                        r.range.removeprefix("bytes=").split("-")
                        for r in store.requests
                        if r.range and r.path.endswith("/in.mcap")
                    ]
                    read = sum(min(int(last), size - 1) + 1 - int(first) for first, last in gets)
                    cells.append(f"{len(gets):>6} {read / MIB:>7.1f} {taken:>5.1f} s")
                print(
                    f"{cache:>12} {block:>9} " + " ".join(f"{cell:>22}" for cell in cells) + f"   {-(-size // (block * MIB))}",
                    flush=True,
                )
    store.stop()


if __name__ == "__main__":
    main()
