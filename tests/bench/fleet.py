"""How fast a fleet goes: `python tests/bench/fleet.py [--logs 40] [--mb 50]`, and what 100 000 logs of 5 GB would cost.

The logs are made up in the usual, worst layout: images and IMU messages side by side in every chunk of 1 MiB. In the same run,
all from the page cache: a shell loop of `cp`, then `imutool fleet debias` with one and with two workers, as a user types it.
The time of a fleet is told with and without the start of the command and of its workers: that is paid once. CPU seconds are
those of the tasks, as each says them; the first of each worker, which imports what it needs, is left out of the figures.

A log four times as large tells what a byte costs and what a log costs. With that, `price` says what a fleet costs on a cluster,
and what limits it: CPU (and of that how much is the codec) or network. Nothing of a cluster is measured here: prices, cores and
network of a node are assumptions, printed with the answer and given as arguments.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow.parquet as pq
from mcap.writer import CompressionType, Writer

from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.encode import encode_imu
from imutool.mcap_io.log import Log
from imutool.sensor.made_up_flight import flight

IMAGE_BYTES, IMU_PER_IMAGE = 250_000, 20  # 10 images a second next to 200 Hz
MODEL = "euroc-adis16448-hybrid"
LARGER = 4


class Cost(NamedTuple):
    """What one worker spends: CPU seconds for a log of any size, for a GB of it, and how much of that is the codec."""

    cpu_s_per_log: float
    cpu_s_per_gb: float
    codec_s_per_gb: float
    written_per_read: float


class Price(NamedTuple):
    """What a fleet costs: what one node of a cluster gets through, for how long, for how much, and what limits it."""

    limit: str
    cpu_gb_per_s: float
    network_gb_per_s: float
    core_hours: float
    node_hours: float
    hours: float
    money: float
    requests_money: float


def price(
    cost: Cost,
    *,
    logs: int = 100_000,
    gb: float = 5.0,
    nodes: int = 100,
    cores: int = 16,
    core_hour: float = 0.04,
    network_gb_s: float = 1.5,
    part_mb: float = 16.0,
    read_mb: float = 4.0,
    put_per_1000: float = 0.005,
    get_per_1000: float = 0.0004,
) -> Price:
    """Time and money for a fleet on nodes of so many cores and so much network, which reading and writing share.

    A task holds one core; the store is taken to be as fast as all nodes together. Requests: a GET each `read_mb`, a PUT each
    `part_mb`, and a handful a log for listing, copying and the journal.
    """
    total_gb = logs * gb
    core_s = logs * cost.cpu_s_per_log + total_gb * cost.cpu_s_per_gb
    by_cpu = total_gb / (core_s / cores)
    by_network = network_gb_s / (1.0 + cost.written_per_read)
    node_s = total_gb / min(by_cpu, by_network)
    gets = total_gb * 1e3 / read_mb + 4 * logs
    puts = total_gb * cost.written_per_read * 1e3 / part_mb + 6 * logs
    return Price(
        "network" if by_network < by_cpu else "CPU",
        by_cpu,
        by_network,
        core_s / 3600.0,
        node_s / 3600.0,
        node_s / 3600.0 / nodes,
        node_s / 3600.0 * cores * core_hour,
        puts / 1e3 * put_per_1000 + gets / 1e3 * get_per_1000,
    )


def make(path: Path, mb: float, compression: str) -> None:
    """A log of images and IMU messages side by side."""
    images = max(2, round(mb * 1e6 / (IMAGE_BYTES + IMU_PER_IMAGE * 350)))
    imu = flight(1, duration_s=images * IMU_PER_IMAGE / 200.0).imu
    payloads = encode_imu(imu.t_ns, imu.gyro, imu.accel, "imu0")
    rng = np.random.default_rng(0)
    with path.open("wb") as file:
        out = Writer(file, compression=CompressionType[compression.upper()], chunk_size=1 << 20)
        out.start("ros2")
        kinds = {
            name: out.register_schema(name, "ros2msg", schemas.definition(name).encode())
            for name in (schemas.IMU, schemas.IMAGE)
        }
        imu_id = out.register_channel("/imu0", "cdr", kinds[schemas.IMU])
        image_id = out.register_channel("/cam0/image_raw/compressed", "cdr", kinds[schemas.IMAGE])
        for k in range(images):
            for row in range(k * IMU_PER_IMAGE, min((k + 1) * IMU_PER_IMAGE, len(imu))):
                t_ns = int(imu.t_ns[row])
                out.add_message(imu_id, t_ns, payloads[row].tobytes(), t_ns, row)
            out.add_message(image_id, t_ns, rng.bytes(IMAGE_BYTES), t_ns, k)
        out.finish()


def codec_s_per_gb(path: Path) -> float:
    """CPU seconds to unpack and check every chunk of a log, a GB."""
    with Log(path) as log:
        began = time.process_time()
        for block in log.index.blocks:
            log.index.unpack(block)
        return (time.process_time() - began) / (path.stat().st_size / 1e9)


def copied(source: Path, out: Path) -> float:
    """Seconds of a shell loop of `cp`."""
    out.mkdir()
    began = time.perf_counter()
    subprocess.run(["sh", "-c", f'for f in "{source}"/*.mcap; do cp "$f" "{out}"/; done'], check=True)
    return time.perf_counter() - began


class Spent(NamedTuple):
    """A fleet: seconds in all and without the start, and its rows but for the first of each worker."""

    whole_s: float
    work_s: float
    rows: list[dict[str, Any]]


def debiased(source: Path, out: Path, workers: int) -> Spent:
    """The same logs through `imutool fleet debias`."""
    imutool = Path(sys.executable).with_name("imutool")
    words = [
        "fleet",
        "debias",
        source,
        out,
        "--model",
        MODEL,
        "--init",
        "prior",
        "--force",
        "--workers",
        workers,
        "-q",
        "--json",
        "-",
    ]
    began = time.perf_counter()
    done = subprocess.run([imutool, *map(str, words)], check=True, capture_output=True, text=True)
    whole = time.perf_counter() - began
    assert json.loads(done.stdout)["statuses"].keys() == {"ok"}, done.stdout
    rows = pq.read_table(out / "fleet.parquet").to_pylist()
    later = sorted(rows, key=lambda row: row["cpu_seconds"])[: max(1, len(rows) - workers)]
    return Spent(whole, sum(row["seconds"] for row in later) / workers, later)


def main() -> None:
    """Prints the table, the cost of a log and of a byte, and the price of a fleet."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--logs", type=int, default=40)
    parser.add_argument("--mb", type=float, default=50.0)
    parser.add_argument("--compression", choices=("none", "lz4", "zstd"), default="lz4")
    parser.add_argument("--folder", type=Path, help="where to work (default: the system's temporary folder)")
    for name, value in (price.__kwdefaults__ or {}).items():
        parser.add_argument(f"--price-{name.replace('_', '-')}", type=type(value), default=value)
    args = parser.parse_args()
    assumed = {name: getattr(args, f"price_{name}") for name in price.__kwdefaults__ or {}}
    with tempfile.TemporaryDirectory(dir=args.folder) as name:
        work = Path(name)
        needed = 3.2 * args.logs * args.mb * 1e6
        assert shutil.disk_usage(work).free > needed, f"needs {needed / 1e9:.1f} GB on disk: fewer --logs"
        cost = measure(work, args.logs, args.mb, args.compression)
    print_price(price(cost, **assumed), assumed)


def measure(work: Path, logs: int, mb: float, compression: str) -> Cost:
    """Runs everything, prints the table, and says what a worker spends."""
    small, large = work / "small", work / "large"
    for folder, size, count in ((small, mb, logs), (large, LARGER * mb, 3)):
        folder.mkdir()
        make(folder / "0.mcap", size, compression)
        for k in range(1, count):
            shutil.copy(folder / "0.mcap", folder / f"{k}.mcap")
    gb = sum(path.stat().st_size for path in small.iterdir()) / 1e9
    print(f"{logs} logs of {gb / logs * 1e3:.1f} MB ({compression}, IMU in every chunk)")
    print(f"{'':22}{'s':>9}{'MB/s':>9}{'/ cp':>8}{'without start s':>17}{'MB/s':>9}{'CPU s / log':>13}{'peak MB':>9}")
    cp_s = copied(small, work / "cp")
    shutil.rmtree(work / "cp")
    print(f"{'cp in a loop':22}{cp_s:9.2f}{gb * 1e3 / cp_s:9.0f}{1.0:8.1f}")
    spent: dict[int, Spent] = {}
    for workers in (1, 2):
        out = work / f"out{workers}"
        spent[workers] = one = debiased(small, out, workers)
        shutil.rmtree(out)
        shares = len(one.rows) / logs
        cpu, peak = statistics.median(row["cpu_seconds"] for row in one.rows), max(row["peak_bytes"] for row in one.rows)
        print(
            f"{f'fleet, {workers} worker(s)':22}{one.whole_s:9.2f}{gb * 1e3 / one.whole_s:9.0f}{one.whole_s / cp_s:8.1f}",
            end="",
        )
        print(f"{one.work_s:17.2f}{gb * 1e3 * shares / one.work_s:9.0f}{cpu:13.3f}{peak / 1e6:9.0f}", flush=True)
    speeds = {workers: len(one.rows) / one.work_s for workers, one in spent.items()}
    print(f"two workers against one: {speeds[2] / speeds[1]:.2f} times the logs per second")
    whole = {workers: logs / one.whole_s for workers, one in spent.items()}
    print(f"logs per second, start included: {whole[1]:.1f} with one worker, {whole[2]:.1f} with two")
    larger = debiased(large, work / "out", 1)
    sizes = [statistics.median(row["source_bytes"] for row in rows) / 1e9 for rows in (spent[1].rows, larger.rows)]
    cpus = [statistics.median(row["cpu_seconds"] for row in rows) for rows in (spent[1].rows, larger.rows)]
    slope = (cpus[1] - cpus[0]) / (sizes[1] - sizes[0])
    written = larger.rows[0]["target_bytes"] / larger.rows[0]["source_bytes"]
    cost = Cost(max(0.0, cpus[0] - slope * sizes[0]), slope, codec_s_per_gb(large / "0.mcap"), written)
    print(f"a log costs {cost.cpu_s_per_log:.3f} CPU s and {cost.cpu_s_per_gb:.2f} CPU s a GB, of which one pass of", end=" ")
    print(f"unpacking is {cost.codec_s_per_gb:.2f}; a byte read is {cost.written_per_read:.3f} written")
    return cost


def print_price(told: Price, assumed: dict[str, Any]) -> None:
    """Prints what a fleet costs, and on what assumptions."""
    print("\nassumed: " + ", ".join(f"{name} {value:g}" for name, value in assumed.items()))
    print(
        f"a node gets through {told.cpu_gb_per_s:.2f} GB/s by CPU, {told.network_gb_per_s:.2f} by network: {told.limit} limits"
    )
    print(f"{told.core_hours:,.0f} core hours of work, {told.node_hours:,.0f} node hours held, {told.hours:.1f} h on all nodes")
    print(f"{told.money:,.0f} for nodes, {told.requests_money:,.0f} for requests, in the currency of the prices")


if __name__ == "__main__":
    main()
