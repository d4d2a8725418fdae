"""Samples that no sensor should give: constant, dead, huge, denormal, not finite, and clocks that jump."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
from mcap.writer import Writer

from fuzz import command, outside_contract
from fuzz._inputs import finite_log, only_below
from imutool.bias.model_file import library
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.encode import encode_imu, encode_pose
from imutool.recording import Poses, Recording
from imutool.sensor.made_up_flight import flight

EXTREMES = (0.0, -0.0, 1.0, 9.81, 1e-310, 5e-324, 1e-30, 1e4, 1e30, -1e30, 1e150, 1e300, 1.7e308)
NOT_FINITE = (math.nan, math.inf, -math.inf)
DAY_NS = 86_400 * 10**9
STARTS = ("auto", "stationary", "prior", "truth", "0,0,0,0,0,0")


@cache
def whole(rows: int) -> Recording:
    """A recording of a made-up flight."""
    return flight(1, duration_s=rows / 200.0)


@cache
def models() -> tuple[str, ...]:
    """Models that ship, the static one, and the log's own choice."""
    return ("", "static", *(path.stem for path in sorted(library().glob("*.safetensors"))))


def problems(rng: random.Random, folder: Path) -> Iterator[str]:
    """Debiases, cleans and describes such samples: a finite log out of finite samples, or a refusal; always in time."""
    source = whole(rng.choice((2, 5, 400, 1500)))
    t_ns, gyro, accel = source.imu.t_ns.copy(), source.imu.gyro.copy(), source.imu.accel.copy()
    names = []
    for _ in range(rng.choice((1, 1, 2))):
        what = rng.choice((_constant, _dead, _spike, _jump, _jump, _scaled))
        t_ns, gyro, accel = what(rng, t_ns, gyro, accel)
        names.append(what.__name__)
    finite = bool(np.isfinite(gyro).all() and np.isfinite(accel).all())
    put_log(folder / "in.mcap", t_ns, gyro, accel, next(iter(source.truths.values())) if rng.random() < 0.7 else None)
    model = rng.choice(models())
    words = ["debias", "in.mcap", "out.mcap", "-q", "--init", rng.choice(STARTS)]
    words += ["--model", model] if model else []
    words += rng.choice(([], [], ["--smooth"], ["--clean"]))
    with only_below(folder, "out.mcap", "out", "out.html", "out.safetensors") as wrong:
        commands = [words, ["info", "in.mcap", "--json", "-"], ["clean", "in.mcap", "--json", "-"]]
        commands += [["evaluate", "in.mcap", *(["--model", model] if model else []), "--json", "-"]]
        commands += [["export", "in.mcap", "out", "--format", "euroc", "-q"], ["audit", "in.mcap", "--json", "-"]]
        commands += [["live", "--from", "in.mcap", "--speed", "1e9", "--seconds", "5", "--no-view", "--print"]]
        commands += [["view", "in.mcap", "--html", "out.html", "-q"]]
        commands += [["train", "in.mcap", "-o", "out.safetensors", "--method", "linear", "--json", "-"]]
        answers = [command(folder, *line) for line in rng.sample(commands, 2)]
    yield from wrong
    for done in answers:
        for sentence in outside_contract(done):
            yield f"{'+'.join(names)}: {sentence}"
        if any(word in done.stdout for word in ("NaN", "Infinity")):
            yield f"{'+'.join(names)}: {' '.join(done.args)} prints a number that is not finite"
    if finite and (folder / "out.mcap").exists():
        yield from (f"{'+'.join(names)}: {' '.join(words)}: {sentence}" for sentence in finite_log(folder / "out.mcap"))


def put_log(
    path: Path, t_ns: np.ndarray, gyro: np.ndarray, accel: np.ndarray, poses: Poses | None, *, crcs: bool = True
) -> None:
    """Writes any samples, also those that a `Recording` refuses."""
    with path.open("wb") as file:
        out = Writer(file, chunk_size=20_000, enable_crcs=crcs)
        out.start("ros2")
        topics = [("/imu0", schemas.IMU, t_ns, encode_imu(t_ns, gyro, accel, "imu0"))]
        if poses is not None:
            topics.append(
                ("/ground_truth/pose", schemas.POSE, poses.t_ns, encode_pose(poses.t_ns, poses.p_wb, poses.q_wb_wxyz, "world"))
            )
        for topic, kind, times, payloads in topics:
            schema = out.register_schema(kind, "ros2msg", schemas.definition(kind).encode())
            channel = out.register_channel(topic, "cdr", schema)
            for row, (stamp, payload) in enumerate(zip(times.tolist(), payloads, strict=True)):
                out.add_message(channel, stamp, payload.tobytes(), stamp, row)
        out.finish()


Arrays = tuple[np.ndarray, np.ndarray, np.ndarray]


def _constant(rng: random.Random, t_ns: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> Arrays:
    for values in rng.choice(((gyro,), (accel,), (gyro, accel))):
        values[:] = rng.choice(EXTREMES)
    return t_ns, gyro, accel


def _dead(rng: random.Random, t_ns: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> Arrays:
    values, at = rng.choice((gyro, accel)), rng.randrange(len(t_ns))
    values[at:, rng.randrange(3)] = rng.choice((*EXTREMES, *NOT_FINITE))
    return t_ns, gyro, accel


def _spike(rng: random.Random, t_ns: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> Arrays:
    for _ in range(rng.choice((1, 5, 50))):
        rng.choice((gyro, accel))[rng.randrange(len(t_ns)), rng.randrange(3)] = rng.choice((*EXTREMES, *NOT_FINITE))
    return t_ns, gyro, accel


def _scaled(rng: random.Random, t_ns: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> Arrays:
    factor = rng.choice((1e-300, 1e-9, 1e6, 1e30, 1e200, -1.0))
    with np.errstate(over="ignore", invalid="ignore"):
        return t_ns, gyro * factor, accel * rng.choice((1.0, factor))


def _jump(rng: random.Random, t_ns: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> Arrays:
    at, step = rng.randrange(len(t_ns)), rng.choice((1, 10**6, 10**9, 1800 * 10**9, DAY_NS, 4000 * DAY_NS))
    moved = t_ns.copy()
    moved[at:] += step
    if rng.random() < 0.3:  # a clock without a battery begins in 1970, until it hears of the time
        moved[: rng.choice((at, len(t_ns)))] -= t_ns[0]
    fits = moved.max() < 2**31 * 10**9  # what a stamp of ROS 2 holds
    return moved if fits else t_ns, gyro, accel
