"""How fast a log is debiased: `python tests/bench/debias.py [--seconds 150]`, on a made-up flight, against real time and `cp`.

In memory: a neural_ode model's stream over all samples, in blocks of a chunk's messages, and `OnlineDebiaser` one sample at a
time (their numbers must agree). As a whole: `imutool debias` as a user types it, a process of its own with python and
torch to start, beside `cp` of the same log, and beside a python that does nothing but import torch; the same work inside a
running process is timed too, and shows what of it is the start. The weights are random: time does not depend on them.
Medians of interleaved rounds after one that does not count, everything on one thread; CPU seconds stand beside wall seconds
because the machine may be shared. The log is in the page cache, as it is for `cp`.
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
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from imutool.bias import _file, neural_ode
from imutool.bias._base import BiasModel
from imutool.debias import OnlineDebiaser, debias
from imutool.mcap_io.write import write
from imutool.physics.flight import flight
from imutool.recording import Imu, seconds
from imutool.turn_on import TurnOn, at_rest

BLOCK = 2900  # Imu messages in a chunk of 1 MiB
SAME = 1e-9  # rad/s, m/s²: rounding alone separates a block from its samples


def random_model(path: Path, rate_hz: float) -> BiasModel:
    """A neural_ode of the default size, its drift set in motion, written to a file and read back."""
    torch.manual_seed(0)
    model = neural_ode.Model(rate_hz=rate_hz)
    with torch.no_grad():
        for weight in model.parameters():
            weight.add_(0.01 * torch.randn_like(weight))
        model.prior_std += 0.1
    _file.save(model, path)
    return _file.load(path)


def in_blocks(model: BiasModel, start: TurnOn, imu: Imu) -> np.ndarray:
    """The bias at every sample, block by block."""
    stream, t_s = model.stream(start.rest), seconds(imu.t_ns, int(imu.t_ns[0]))
    parts = [slice(first, first + BLOCK) for first in range(0, len(imu), BLOCK)]
    return np.concatenate([stream(t_s[part], imu.gyro[part], imu.accel[part]) for part in parts])


def one_by_one(model: BiasModel, start: TurnOn, imu: Imu) -> np.ndarray:
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


def race(racing: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, Spent]:
    """Median seconds of each; every round runs all of them, the first does not count."""
    spent: dict[str, list[Spent]] = {name: [] for name in racing}
    for count in range(rounds + 1):
        for name, run in racing.items():
            start = now()
            run()
            if count:
                spent[name].append(Spent(*(b - a for a, b in zip(start, now(), strict=True))))
    return {name: Spent(*(statistics.median(column) for column in zip(*runs, strict=True))) for name, runs in spent.items()}


def process(*words: str | Path) -> Callable[[], object]:
    """Runs a command to its end; CalledProcessError if it fails."""
    return lambda: subprocess.run([str(word) for word in words], check=True, capture_output=True)


def single_threaded() -> None:
    """Starts this script over with one thread, which numpy's BLAS only takes from the environment, before it is loaded."""
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    if not threads.items() <= os.environ.items():
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | threads)


def main() -> None:
    """Prints a table of times and their ratios to real time and to `cp`."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=150.0)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    single_threaded()
    cp, imutool = shutil.which("cp"), Path(sys.executable).with_name("imutool")
    assert cp, "needs cp"
    assert imutool.exists(), "needs imutool installed beside this python"

    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        recording = flight(5, duration_s=args.seconds)
        imu, log, weights = recording.imu, work / "flight.mcap", work / "model.safetensors"
        write(recording, log)
        model = random_model(weights, 1.0 / imu.period_s)
        start = at_rest(model, imu)
        apart = float(np.abs(in_blocks(model, start, imu) - one_by_one(model, start, imu)).max())
        assert apart < SAME, apart

        flags = ("--model", weights, "--init", "stationary", "--overwrite", "--quiet")
        racing = {
            "stream, in blocks": lambda: in_blocks(model, start, imu),
            "OnlineDebiaser, one by one": lambda: one_by_one(model, start, imu),
            "debias() in a running process": lambda: debias(
                log, work / "inside.mcap", model=weights, init="stationary", overwrite=True
            ),
            "imutool debias": process(imutool, "debias", log, work / "out.mcap", *flags),
            "python -c 'import torch'": process(sys.executable, "-c", "import torch"),
            "cp": process(cp, log, work / "copy.mcap"),
        }
        medians = race(racing, args.rounds)
        size = {file.name: file.stat().st_size / 1e6 for file in (log, work / "out.mcap")}

    print(f"torch {torch.__version__}, {torch.get_num_threads()} thread of {os.cpu_count()} cores", end="")
    print(f", load {os.getloadavg()[0]:.1f}; ", end="")
    print(f"{args.seconds:g} s at {1 / imu.period_s:.0f} Hz, {len(imu)} samples; ", end="")
    print(f"log {size['flight.mcap']:.1f} MB, debiased {size['out.mcap']:.1f} MB; medians of {args.rounds} rounds")
    print(f"{'':32}{'wall s':>10}{'CPU s':>10}{'CPU us/sample':>15}{'real time / wall':>18}{'wall / cp':>11}")
    for what, taken in medians.items():
        print(f"{what:32}{taken.wall:10.3f}{taken.cpu:10.3f}{1e6 * taken.cpu / len(imu):15.2f}", end="")
        print(f"{args.seconds / taken.wall:18,.0f}{taken.wall / medians['cp'].wall:11.1f}")


if __name__ == "__main__":
    main()
