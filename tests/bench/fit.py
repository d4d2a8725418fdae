"""Verdicts of `imutool.bias_start.fitness` on pieces of logs: false alarms on its own sensor, and what is caught of others.

    python tests/bench/fit.py --model M.safetensors --own LOG... [--other LOG...] [--pieces 2] [--seed 0]

`--own` are logs of the model's training, `--other` logs of other sensors. Each is cut at random into pieces of 20, 50 and 100 s
(or its whole length); nothing but the samples is known of them. Own pieces are also tampered with, and made-up flights with a
sensor of their own each are added. A model that is `doubtful` or `unfit` is caught; on its own sensor that is a false alarm.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from imutool.bias.model import BiasModel
from imutool.bias.model_file import find_model
from imutool.bias_start.bias_at_rest import auto
from imutool.bias_start.fitness import judge
from imutool.bias_start.initial_bias import relative_samples
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.recording import Imu, nanoseconds
from imutool.sensor.made_up_flight import FlightSettings, flight

LENGTHS_S = (20.0, 50.0, 100.0)
MADE_UP = 12
TAMPERED: dict[str, Callable[[Imu], Imu]] = {
    "own, all axes permuted": lambda imu: replace(imu, gyro=imu.gyro[:, [1, 2, 0]], accel=imu.accel[:, [1, 2, 0]]),
    "own, axes of the gyro permuted": lambda imu: replace(imu, gyro=imu.gyro[:, [1, 2, 0]]),
    "own, x and y turned by 180 degrees": lambda imu: replace(imu, gyro=imu.gyro * [-1, -1, 1], accel=imu.accel * [-1, -1, 1]),
    "own, y and z turned by 180 degrees": lambda imu: replace(imu, gyro=imu.gyro * [1, -1, -1], accel=imu.accel * [1, -1, -1]),
    "own, gyro in deg/s": lambda imu: replace(imu, gyro=np.degrees(imu.gyro)),
    "own, accelerometer in g": lambda imu: replace(imu, accel=imu.accel / 9.81),
    "own, another switching-on (0.02 rad/s)": lambda imu: replace(imu, gyro=imu.gyro + np.array([0.0, 0.02, 0.0])),
}


def pieces(logs: list[Path], count: int, seed: int) -> Iterator[Imu]:
    """Random pieces of the first IMU of each log."""
    rng = np.random.default_rng(seed)
    for path in logs:
        with Log(path) as log:
            topic = log.imu_topics[0]
        imu = read(path, imu=topic).imu
        for length_s in LENGTHS_S:
            for _ in range(count):
                spare_ns = max(0, int(imu.t_ns[-1] - imu.t_ns[0]) - nanoseconds(length_s))
                start_ns = int(imu.t_ns[0]) + round(rng.uniform(0.0, spare_ns))
                yield imu.between(start_ns, start_ns + nanoseconds(length_s))


def main() -> None:
    """Print a row for each kind of samples."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", required=True)
    parser.add_argument("--own", type=Path, nargs="+", required=True)
    parser.add_argument("--other", type=Path, nargs="*", default=[])
    parser.add_argument("--pieces", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    model = find_model(options.model)
    own = list(pieces(options.own, options.pieces, options.seed))
    row("own", model, own)
    row("other sensors", model, list(pieces(options.other, options.pieces, options.seed)))
    settings = [FlightSettings(duration_s=40.0, sensor_seed=100 + k, rate_hz=round(model.rate_hz)) for k in range(MADE_UP)]
    row("made-up sensors", model, [flight(k, chosen).imu for k, chosen in enumerate(settings)])
    for name, tamper in TAMPERED.items():
        row(name, model, [tamper(imu) for imu in own[::3]])


def row(name: str, model: BiasModel, imus: list[Imu]) -> None:
    """Print counts of verdicts, and what share is caught."""
    if not imus:
        return
    found = Counter(judge(model, auto(model, imu), [relative_samples(imu)], {}).verdict for imu in imus)
    counts = "  ".join(f"{verdict} {found[verdict]:4d}" for verdict in ("fits", "doubtful", "unfit"))
    print(f"{model.card['name']:26} {name:40} {counts}  caught {1.0 - found['fits'] / len(imus):5.0%}", flush=True)


if __name__ == "__main__":
    main()
