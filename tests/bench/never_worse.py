"""Trained models on logs of other switchings-on, against doing the simple thing.

    python tests/bench/never_worse.py [--method hybrid --set model.remainder=false] [--sensors 4] [--large]

Made-up sensors: six training logs of one switching-on, eight test logs of others (`tests/support/switchings_on.py`: turn-on
bias 10 mrad/s wide, long rests, scale errors of half a percent, a mount that differs by half a degree and a clock by 4 ms from
log to log). AOE in degrees, mean over the test logs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from support.switchings_on import Switchings, log

from imutool.config import load
from imutool.evaluation import evaluate
from imutool.mcap_io.write import write
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
    options = parser.parse_args()
    large = {"rest_s": 60.0, "duration_s": 120.0, "rate_hz": 200.0} if options.large else {}
    for sensor in range(options.first, options.first + options.sensors):
        kind = Switchings(sensor_seed=sensor, scale=options.scale, **large)
        with tempfile.TemporaryDirectory() as folder:
            score(Path(folder), kind, options.method or ["linear", "hybrid"], options.set)


def score(folder: Path, kind: Switchings, methods: list[str], words: list[str]) -> None:
    """Trains every method, and prints its mean AOE for each start."""
    seed = 100 * kind.sensor_seed
    training = [save(folder, seed + k, seed, kind) for k in range(TRAINING)]
    tests = [save(folder, seed + 50 + k, seed + 50 + k, kind) for k in range(TESTS)]
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


def save(folder: Path, seed: int, switching: int, kind: Switchings) -> Path:
    """Log on disk."""
    path = folder / f"{seed}.mcap"
    write(log(seed, switching, kind), path)
    return path


if __name__ == "__main__":
    main()
