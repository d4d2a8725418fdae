"""Milliseconds per optimisation step: `python tests/bench/train.py [--released DIR]`, on a made-up flight.

All contestants take 1000 segments of 16 samples (the paper's batch), gyro stage and accel stage:

(a) fast path: what `imutool train` does with such windows. The rest bias is integrated on the grid of the drift, the
    curve is one evaluation for all samples, rotations are a product taken as a tree (`imutool.training.objectives.objective`).
(b) the paper's scheme as `imutool train --method neural_ode --set scheme=paper` takes its steps: the released networks, in
    float32, with a step of Euler's at every sample, and attitudes in charts of SO(3).
(c) with `--released DIR`, the paper's own code, run by its own training functions. DIR holds its BiasDy, SO3diffeq and
    Third_party; nothing in it is edited, and nothing of it is kept here:

        git clone https://github.com/UMich-CURLY/Debias_IMU DIR      (or `git archive HEAD BiasDy SO3diffeq Third_party`)

    The flight is given to it as EuRoC files, which it reads and caches itself. It asks for a GPU, so `Tensor.cuda` and three
    memory statistics of `torch.cuda` are made to do nothing here; its device arguments are given as "cpu". Its
    SummaryWriter is replaced by a stopwatch: a step is the time from one logged training loss to the next, the whole body
    of its loop, with neither tensorboard's writing nor validation nor saving. "mended" is the same with one method
    replaced: the interval of the spline comes from torch.searchsorted where it compares every time with every knot (the
    losses must stay the same, or this stops).

(a) is also timed as `imutool train` really arranges a step, with the default settings' long windows.
Medians of interleaved rounds, after one that does not count. CPU seconds stand next to wall seconds because the machine
may be shared. Ours runs in float64 as in training, the released code in float32 as it does.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor

from imutool.cli.demo import write_asl
from imutool.recording import Recording
from imutool.sensor.made_up_flight import flight
from imutool.training.fit import Training, TrainSettings
from imutool.training.objectives.objective import RobustLoss, error
from imutool.training.objectives.paper_scheme import PaperTraining
from imutool.training.settings import PaperSettings
from imutool.training.training_windows import Windows
from imutool.units import Sensor

STAGES: tuple[Sensor, Sensor] = ("gyro", "accel")
STEPS_A_ROUND = 8
THEIR_STEPS = 4  # the first two are dropped: one warms up, the other's interval holds the validation


class Spent(NamedTuple):
    """Seconds of one step."""

    wall: float
    cpu: float


Round = Callable[[], list[Spent]]


def now() -> Spent:
    """Both clocks."""
    return Spent(time.perf_counter(), time.process_time())


def since(start: Spent, end: Spent) -> Spent:
    """What lies between two readings."""
    return Spent(end.wall - start.wall, end.cpu - start.cpu)


def repeated(step: Callable[[], object], times: int) -> Round:
    """A round of several steps, each timed by itself."""

    def run() -> list[Spent]:
        spent = []
        for _ in range(times):
            start = now()
            step()
            spent.append(since(start, now()))
        return spent

    return run


# --- ours ---------------------------------------------------------------------------------------------------------------


class Batch(NamedTuple):
    """Where some windows of n steps may start, and how many of them a step takes."""

    first: Tensor
    n: int
    count: int


def drawn(training: Training, batch: Batch) -> Windows:
    """Windows at random places, each with the rest bias of its log's track."""
    chosen = batch.first[torch.randint(len(batch.first), (batch.count,), generator=training.generator)]
    pool = training.pool
    return pool.windows(chosen, batch.n, training.tracks.at(pool.log[chosen], pool.t[chosen]))


def our_step(recording: Recording, sensor: Sensor, batches: list[Batch]) -> Callable[[], float]:
    """One optimisation step as `imutool train` takes it."""
    both = {"drift": ["gyro", "accel"]}  # as in the paper; by default the accelerometer's rest bias does not drift
    training = Training([recording], "neural_ode", TrainSettings(model=both))
    optimizer, rate = training.begin(sensor).optimizer, getattr(training.settings, f"{sensor}_rate")
    loss = RobustLoss({batch.n: torch.ones(1, dtype=torch.float64) for batch in batches})
    if sensor == "accel":  # the paper's second stage leaves the gyro's network alone
        for part in (training.model.curve, training.model.drift):
            part["gyro"].requires_grad_(False)

    def step() -> float:
        total = training.tracks.wandering(sensor) / (len(training.pool.t) / training.pool.rate_hz)
        for batch in batches:
            windows = drawn(training, batch)
            total = total + loss(error(training.model, sensor, windows), windows.log, batch.n)
        for weight in optimizer.state:
            weight.grad = None
        total.backward()
        optimizer.step(rate)
        return float(total.detach())

    return step


def paper_step(recording: Recording, sensor: Sensor, samples: int, segments: int) -> Callable[[], float]:
    """One optimisation step of the paper's scheme."""
    paper = PaperSettings(samples=samples - 1, segments=segments)
    training = PaperTraining([recording], "neural_ode", TrainSettings(model={"scheme": "paper"}, paper=paper))
    stage = training.begin(sensor)
    return lambda: training._one_step(stage)


# --- theirs -------------------------------------------------------------------------------------------------------------


class Stopwatch:
    """Stands in for tensorboard's SummaryWriter: notes when each training loss is logged, and its value."""

    marks: list[tuple[Spent, float]] = []  # noqa: RUF012  the released functions make the object, so the class keeps the marks

    def __init__(self, folder: str) -> None:
        type(self).marks = []

    def add_scalar(self, name: str, value: float, epoch: int) -> None:
        if name == "train_loss":
            self.marks.append((now(), value))

    def close(self) -> None:
        pass


def nearest_knot(spline: object, t: Tensor) -> tuple[Tensor, Tensor]:
    """The mended search: where in the spline's knots each time lies, and how far past that knot."""
    times, last = spline._times, spline._b.size(-2) - 1  # type: ignore[attr-defined]
    index = (torch.searchsorted(times, t.contiguous(), right=True) - 1).clamp(0, last)
    return t - times[index], index


class Released:
    """The paper's code, imported from its folder with its GPU calls silenced."""

    def __init__(self, folder: Path, recording: Recording, samples: int, segments: int, work: Path) -> None:
        torch.Tensor.cuda = lambda self, *_, **__: self  # type: ignore[method-assign]
        torch.cuda.reset_peak_memory_stats = torch.cuda.synchronize = lambda *_: None
        torch.cuda.max_memory_allocated = lambda *_: 0
        stub = ModuleType("torch.utils.tensorboard")
        stub.SummaryWriter = Stopwatch  # type: ignore[attr-defined]
        sys.modules["torch.utils.tensorboard"] = stub
        sys.path[:0] = [str(folder), str(folder / "BiasDy")]
        self.learning = importlib.import_module("learning")
        self.network = importlib.import_module("network_for_BiadDy")
        self.spline = importlib.import_module("Interpolation").CubicHermiteSpline
        self.search, self.work = self.spline._interpret_t, work

        write_asl(recording, work / "data" / recording.name)
        (work / "cache").mkdir()
        sequences = [recording.name]
        settings = {
            "dataset_name": "EUROC",
            "data_dir": str(work / "data"),
            "data_cache_dir": str(work / "cache"),
            "train_seqs": sequences,
            "val_seqs": sequences,
            "test_seqs": [],
            "dt": recording.imu.period_s,
            "percent_for_val": 0.2,
            "loss_window": samples,
            "batch_size": segments,
            "sg_window_bw": 1,
            "sg_order_bw": 0,
            "sg_window_ba": 1,
            "sg_order_ba": 0,
        }
        dataset = importlib.import_module("dataset")
        with contextlib.redirect_stdout(io.StringIO()):
            self.train = dataset.EUROCDataset(**settings, mode="train")
            self.validate = dataset.EUROCDataset(**settings, mode="val")

    def run(self, sensor: Sensor, *, mended: bool) -> list[tuple[Spent, float]]:
        """Its own training function for a few steps: when each loss was logged, and the losses (their seed is fixed)."""
        self.spline._interpret_t = nearest_knot if mended else self.search
        with contextlib.redirect_stdout(io.StringIO()):
            out, common = str(self.work), {"device": "cpu", "epoch": THEIR_STEPS}
            if sensor == "gyro":
                self.learning.Gyro_train(self.train, self.validate, out, "bw_func_net", **common)
            else:
                torch.manual_seed(0)
                gyro = self.network.bw_func_choose("bw_func_net", "cpu")
                self.learning.Acc_train(self.train, self.validate, out, gyro, "ba_func_net", **common)
        return list(Stopwatch.marks)

    def round(self, sensor: Sensor, *, mended: bool) -> Round:
        """The steps after the second: the one before holds the validation that the first step ends with."""

        def run() -> list[Spent]:
            marks = [mark for mark, _ in self.run(sensor, mended=mended)]
            return [since(a, b) for a, b in pairwise(marks[1:])]

        return run

    def check(self, sensor: Sensor) -> None:
        """The mended search changes no loss by a bit."""
        as_is, mended = ([loss for _, loss in self.run(sensor, mended=how)] for how in (False, True))
        assert as_is == mended, (as_is, mended)


# --- the race -----------------------------------------------------------------------------------------------------------


def contestants(
    sensor: Sensor, recording: Recording, samples: int, segments: int, released: Released | None
) -> dict[str, Round]:
    """Everyone who runs in a stage."""
    settings, pool = TrainSettings(), Training([recording], "neural_ode").pool
    batch = Batch(pool.starts(samples - 1, "train"), samples - 1, segments)
    lengths = [pool.samples(s) for s in (settings.gyro_window_s if sensor == "gyro" else settings.accel_window_s)]
    arranged = [Batch(pool.starts(n, "train"), n, max(4, settings.samples // n)) for n in lengths]
    racing = {
        "(a) imutool, fast path": repeated(our_step(recording, sensor, [batch]), STEPS_A_ROUND),
        "(b) imutool, the paper's scheme": repeated(paper_step(recording, sensor, samples, segments), STEPS_A_ROUND // 4),
    }
    if released:
        released.check(sensor)
        racing["(c) released, as it is"] = released.round(sensor, mended=False)
        racing["(c) released, mended"] = released.round(sensor, mended=True)
    words = "+".join(f"{b.count}x{b.n + 1}" for b in arranged)
    racing[f"imutool train's own step: {words}"] = repeated(our_step(recording, sensor, arranged), STEPS_A_ROUND // 4)
    return racing


def race(racing: dict[str, Round], rounds: int) -> dict[str, Spent]:
    """Median step of each contestant; every round runs all of them, the first does not count."""
    spent: dict[str, list[Spent]] = {name: [] for name in racing}
    for count in range(rounds + 1):
        for name, run in racing.items():
            steps = run()
            if count:
                spent[name] += steps
    return {name: Spent(*(statistics.median(column) for column in zip(*steps, strict=True))) for name, steps in spent.items()}


def main() -> None:
    """Prints a table for each stage."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--released", type=Path, metavar="DIR", help="the paper's released code")
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--segments", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=120.0, help="length of the flight (EuRoC's training logs: 84 to 182)")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    recording = flight(1, duration_s=args.seconds)
    print(f"torch {torch.__version__} on the CPU, {torch.get_num_threads()} thread(s) of {os.cpu_count()} cores", end="")
    print(f", load {os.getloadavg()[0]:.1f}; flight of {args.seconds:g} s at {1 / recording.imu.period_s:.0f} Hz", end="")
    print(f"; {args.segments} segments of {args.samples} samples; medians of {args.rounds} interleaved rounds")
    with tempfile.TemporaryDirectory() as work:
        theirs = Released(args.released, recording, args.samples, args.segments, Path(work)) if args.released else None
        for sensor in STAGES:
            medians = race(contestants(sensor, recording, args.samples, args.segments, theirs), args.rounds)
            base = next(iter(medians.values()))
            print(f"\n{sensor + ' stage, ms per step':54}{'wall':>9}{'CPU':>9}{'against (a), CPU':>18}")
            for name, step in medians.items():
                print(f"{name:54}{1e3 * step.wall:9.1f}{1e3 * step.cpu:9.1f}{step.cpu / base.cpu:17.1f}x")


if __name__ == "__main__":
    main()
