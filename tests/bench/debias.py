"""How fast a log is debiased: `python tests/bench/debias.py [MODEL...] [--seconds 150]`, on a made-up flight.

In memory, for each model (all that ship, unless named): the stream over all samples in blocks of a chunk's messages, and
`OnlineDebiaser` one sample at a time, from a given start (their numbers must agree) and with the rest bias followed, as a live
node has it unless it gives a start. Times are the least of some rounds: what the machine does besides only adds.

As a whole, unless `--in-memory`: `imutool debias` as a user types it, with a neural_ode of random weights (time does not depend
on them), a process of its own with python and torch to start, next to `cp` of the same log, and against a python that does
nothing but import torch; the same work inside a running process is timed too, and shows what of it is the start. Medians of
interleaved rounds after one that does not count; CPU seconds stand next to wall seconds because the machine may be shared. The
log is in the page cache, as it is for `cp`. Everything on one thread.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from imutool.bias import model_file
from imutool.bias.model import BiasModel
from imutool.bias.networks import neural_ode
from imutool.bias_start.correction import OnlineDebiaser
from imutool.bias_start.initial_bias import InitialBias, prior, tracked_from_prior
from imutool.debiasing import debias
from imutool.mcap_io.write import write
from imutool.recording import Imu, seconds
from imutool.sensor.made_up_flight import flight

BLOCK = 2900  # Imu messages in a chunk of 1 MiB
SAME = 1e-9  # rad/s, m/s²: rounding alone separates a block from its samples


def write_random_model(path: Path, rate_hz: float) -> None:
    """A file with a neural_ode of the default size, its drift set in motion."""
    torch.manual_seed(0)
    network = neural_ode.Network(rate_hz=rate_hz)
    with torch.no_grad():
        for weight in network.parameters():
            weight.add_(0.01 * torch.randn_like(weight))
        network.prior_std += 0.1
    model_file.save(network.frozen(), path)


def in_blocks(model: BiasModel, start: InitialBias, imu: Imu) -> np.ndarray:
    """The bias at every sample, block by block."""
    stream, t_s = model.stream(start.rest), seconds(imu.t_ns, int(imu.t_ns[0]))
    parts = [slice(first, first + BLOCK) for first in range(0, len(imu), BLOCK)]
    return np.concatenate([stream(t_s[part], imu.gyro[part], imu.accel[part]) for part in parts])


def one_by_one(model: BiasModel, start: InitialBias, imu: Imu) -> np.ndarray:
    """The same, as a live node gets it."""
    online = OnlineDebiaser(model, start)
    return np.array([online(int(t), gyro, accel)[2] for t, gyro, accel in zip(imu.t_ns, imu.gyro, imu.accel, strict=True)])


class Spent(NamedTuple):
    """Seconds: on the wall, and of the CPU in this process and those it waited for."""

    wall: float
    cpu: float


def now() -> Spent:
    """Both clocks."""
    mine, waited_for = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return Spent(time.perf_counter(), mine.ru_utime + mine.ru_stime + waited_for.ru_utime + waited_for.ru_stime)


def race(
    racing: Mapping[str, Callable[[], object]], rounds: int, pick: Callable[[Iterable[float]], float] = statistics.median
) -> dict[str, Spent]:
    """Seconds of each, one picked of the rounds; every round runs all of them, the first does not count."""
    spent: dict[str, list[Spent]] = {name: [] for name in racing}
    for count in range(rounds + 1):
        for name, run in racing.items():
            start = now()
            run()
            if count:
                spent[name].append(Spent(*(b - a for a, b in zip(start, now(), strict=True))))
    return {name: Spent(*(pick(column) for column in zip(*runs, strict=True))) for name, runs in spent.items()}


def process(*words: str | Path) -> Callable[[], object]:
    """Runs a command to its end; CalledProcessError if it fails."""
    return lambda: subprocess.run([str(word) for word in words], check=True, capture_output=True)


def single_threaded() -> None:
    """Starts this script over with one thread, which numpy's BLAS only takes from the environment, before it is loaded."""
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    if not threads.items() <= os.environ.items():
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | threads)


def in_memory(names: Iterable[str], imu: Imu, rounds: int) -> None:
    """Prints a line a model: blocks, one by one, and their ratio."""
    heads = ("in blocks", "real time", "in blocks", "one by one", "ratio", "followed", "apart")
    units = ("s", "/ wall", "us/sample", "us/sample", "", "us/sample", "")
    for first, row in (("", heads), (f"least of {rounds} rounds", units)):
        print(f"{first:30}" + "".join(f"{word:>12}" for word in row))
    for name in names:
        model = model_file.find_model(name)
        start, followed = prior(model), tracked_from_prior(model)
        apart = float(np.abs(in_blocks(model, start, imu) - one_by_one(model, start, imu)).max())
        assert apart < SAME, apart
        racing = {
            "blocks": lambda m=model, s=start: in_blocks(m, s, imu),
            "one": lambda m=model, s=start: one_by_one(m, s, imu),
            "followed": lambda m=model, s=followed: one_by_one(m, s, imu),
        }
        blocks, one, live = (1e6 * spent.wall / len(imu) for spent in race(racing, rounds, min).values())
        block_s = blocks * len(imu) / 1e6
        print(f"{Path(name).stem:30}{block_s:12.3f}{imu.duration_s / block_s:12,.0f}{blocks:12.2f}{one:12.1f}", end="")
        print(f"{one / blocks:12.1f}{live:12.1f}{apart:12.1g}", flush=True)


def as_a_command(seconds_long: float, rounds: int) -> None:
    """Prints the times of the whole command, and their ratios to real time and to `cp`."""
    cp, imutool = shutil.which("cp"), Path(sys.executable).with_name("imutool")
    assert cp, "needs cp"
    assert imutool.exists(), "needs imutool installed beside this python"
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        recording = flight(5, duration_s=seconds_long)
        log, weights, inside = work / "flight.mcap", work / "model.safetensors", work / "inside.mcap"
        write(recording, log)
        write_random_model(weights, 1.0 / recording.imu.period_s)
        flags = ("--model", weights, "--init", "stationary", "--overwrite", "--quiet")
        racing = {
            "debias() in a running process": lambda: debias(
                log, inside, model=weights, init="stationary", force=True, overwrite=True
            ),
            "imutool debias": process(imutool, "debias", log, work / "out.mcap", *flags),
            "python -c 'import torch'": process(sys.executable, "-c", "import torch"),
            "cp": process(cp, log, work / "copy.mcap"),
        }
        medians = race(racing, rounds)
        size = {file.name: file.stat().st_size / 1e6 for file in (log, work / "out.mcap")}
    print(f"log {size['flight.mcap']:.1f} MB, debiased {size['out.mcap']:.1f} MB; medians of {rounds} rounds")
    print(f"{'':32}{'wall s':>10}{'CPU s':>10}{'CPU us/sample':>15}{'real time / wall':>18}{'wall / cp':>11}")
    for what, taken in medians.items():
        print(f"{what:32}{taken.wall:10.3f}{taken.cpu:10.3f}{1e6 * taken.cpu / len(recording.imu):15.2f}", end="")
        print(f"{seconds_long / taken.wall:18,.0f}{taken.wall / medians['cp'].wall:11.1f}")


def main() -> None:
    """Prints two tables: models in memory, and the whole command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("models", nargs="*", metavar="MODEL", help="names or files (default: all that ship)")
    parser.add_argument("--seconds", type=float, default=150.0)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--in-memory", action="store_true", help="leave the whole command out")
    args = parser.parse_args()
    single_threaded()
    imu = flight(5, duration_s=args.seconds).imu
    print(f"torch {torch.__version__}, {torch.get_num_threads()} thread of {os.cpu_count()} cores", end="")
    print(f", load {os.getloadavg()[0]:.1f}; {args.seconds:g} s at {1 / imu.period_s:.0f} Hz, {len(imu)} samples")
    in_memory(args.models or sorted(path.stem for path in model_file.library().glob("*.safetensors")), imu, args.rounds)
    if not args.in_memory:
        as_a_command(args.seconds, args.rounds)


if __name__ == "__main__":
    main()
