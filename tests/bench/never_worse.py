"""Trained models on logs of other switchings-on, against doing the simple thing.

    python tests/bench/never_worse.py [--method hybrid --set model.remainder=false] [--sensors 4] [--large | --vehicle-m-s 6]

Made-up sensors: six training logs of one switching-on, eight test logs of others (`tests/support/switchings_on.py`: turn-on
bias 10 mrad/s wide, long rests, scale errors of half a percent, a mount that differs by half a degree and a clock by 4 ms from
log to log). With `--vehicle-m-s` they drive at this speed for 100 s, turn about the vertical alone and rest for two seconds.
AOE in degrees, mean over the test logs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from support import driven
from support.switchings_on import DAY_NS, TEN_MINUTES_NS, Switchings, log

from imutool.config import load
from imutool.evaluation import evaluate
from imutool.mcap_io.write import write
from imutool.recording import Imu, Poses, Recording
from imutool.training.run import train
from imutool.training.settings import settings_of

STARTS = ("auto", "stationary", "smooth", "truth")
TRAINING, TESTS = 6, 8


def main() -> None:
    """One table a sensor."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", action="append")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--sensors", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--scale", type=float, default=0.005)
    parser.add_argument("--large", action="store_true", help="Logs of two minutes with a minute of rest, at 200 Hz.")
    parser.add_argument("--vehicle-m-s", type=float, default=0.0)
    options = parser.parse_args()
    large = {"rest_s": 60.0, "duration_s": 120.0, "rate_hz": 200.0} if options.large else {}
    for sensor in range(options.first, options.first + options.sensors):
        kind = Switchings(sensor_seed=sensor, scale=options.scale, **large)
        with tempfile.TemporaryDirectory() as folder:
            score(Path(folder), kind, options.method or ["linear", "hybrid"], options.set, options.vehicle_m_s)


def score(folder: Path, kind: Switchings, methods: list[str], words: list[str], vehicle_m_s: float) -> None:
    """Trains every method, and prints its mean AOE for each start."""
    seed = 100 * kind.sensor_seed
    training = [save(folder, seed + k, seed, kind, vehicle_m_s) for k in range(TRAINING)]
    tests = [save(folder, seed + 50 + k, seed + 50 + k, kind, vehicle_m_s) for k in range(TESTS)]
    models = ["static"]
    for method in methods:
        models.append(str(folder / f"{method}.safetensors"))
        settings = load(settings_of(method), None, words if method == "hybrid" else [])
        card = train(training, Path(models[-1]), method=method, settings=settings).card
        print(method, {key: card[key] for key in ("physics", "compared") if key in card}, file=sys.stderr)
    names = ["raw", *(Path(model).stem for model in models)]
    print(f"| sensor {kind.sensor_seed} | {' | '.join(names)} |\n|{'---|' * (len(names) + 1)}")
    for start in STARTS:
        print(f"| {start} | {mean_aoe(tests, models, start)} |", flush=True)


def mean_aoe(tests: list[Path], models: list[str], start: str) -> str:
    """Cells of a table: mean AOE over the logs, of the raw samples and of each model."""
    smooth = start == "smooth"
    rows = [evaluate(test, models=models, init="auto" if smooth else start, smooth=smooth) for test in tests]
    table = np.array([[result["aoe_deg"] for result in row] for row in rows])
    return " | ".join(f"{value:.2f}" for value in table.mean(axis=0))


def save(folder: Path, seed: int, switching: int, kind: Switchings, vehicle_m_s: float) -> Path:
    """Log on disk."""
    path = folder / f"{seed}.mcap"
    write(driving(seed, switching, kind, vehicle_m_s) if vehicle_m_s else log(seed, switching, kind), path)
    return path


def driving(seed: int, switching: int, kind: Switchings, vehicle_m_s: float) -> Recording:
    """Drive with the scale errors of a sensor and the biases of a switching-on."""
    made, sensor = driven.drive(seed, 100.0, usual_m_s=vehicle_m_s), np.random.default_rng([kind.sensor_seed, 3])
    bias = np.random.default_rng([switching, 4]).normal(size=6) * np.repeat([kind.turn_on_rad_s, kind.turn_on_m_s2], 3)
    scale = 1.0 + kind.scale * sensor.normal(size=6)
    u = (np.concatenate([made.imu.gyro, made.imu.accel], axis=1) - driven.BIAS) * scale + bias
    t_ns = made.imu.t_ns + DAY_NS * switching + TEN_MINUTES_NS * (seed - switching)
    truth = Poses(made.truth.t_ns - made.imu.t_ns[0] + t_ns[0], made.truth.p_wb, made.truth.q_wb_wxyz)
    return Recording(f"drive_{seed}", Imu(t_ns, u[:, :3].copy(), u[:, 3:].copy()), {"/ground_truth/pose": truth})


if __name__ == "__main__":
    main()
