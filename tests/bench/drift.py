"""Made-up sensors whose gyro bias really evolves: what each method makes of it.

    python tests/bench/drift.py [--kind rate] [--method hybrid --set model.remainder=false] [--start truth]

Six training logs of 60 to 120 s, four test logs of other motions (100 s, one of five minutes); every log is a switching-on of
its own, cold (`tests/support/drifting.py`). With `--cut-s` the test logs begin later: warm and in motion; with `--warm-s` the
training logs do, each by another of the times. AOE in degrees, mean over the test logs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from never_worse import mean_aoe
from support.drifting import KINDS, Drifting, log

from imutool.config import load
from imutool.mcap_io.write import write
from imutool.training.run import train
from imutool.training.settings import settings_of

STARTS = ("truth", "auto", "smooth")
TRAINING_S, TEST_S = (60.0, 70.0, 80.0, 90.0, 100.0, 120.0), (100.0, 100.0, 100.0, 300.0)


def main() -> None:
    """One row for each kind of drift and start."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", action="append")
    parser.add_argument("--method", action="append")
    parser.add_argument("--set", action="append", default=[], help="Of hybrid and neural_ode.")
    parser.add_argument("--start", action="append")
    parser.add_argument("--sensor", type=int, default=0)
    parser.add_argument("--cut-s", type=float, default=0.0, help="Seconds cut off at the start of each test log.")
    parser.add_argument("--warm-s", type=float, nargs="+", default=[0.0], help="The same of the training logs, in turn.")
    options = parser.parse_args()
    methods = options.method or ["linear", "neural_ode", "hybrid"]
    columns = ["raw", *["static"] * (not options.cut_s), *methods]
    print(f"| drift, start | {' | '.join(columns)} |\n|{'---|' * (len(columns) + 1)}")
    for kind in options.kind or KINDS:
        with tempfile.TemporaryDirectory() as folder:
            sensor = Drifting(kind=kind, sensor_seed=options.sensor)
            score(Path(folder), sensor, methods, options.set, options.start or STARTS, options.cut_s, options.warm_s)


def score(
    folder: Path,
    sensor: Drifting,
    methods: list[str],
    words: list[str],
    starts: list[str] | tuple[str, ...],
    cut_s: float,
    warm_s: Sequence[float],
) -> None:
    """Trains every method, and prints its mean AOE for each start."""
    begin_s = [warm_s[seed % len(warm_s)] for seed in range(len(TRAINING_S))]
    training = [save(folder, seed, sensor, TRAINING_S[seed], cut) for seed, cut in enumerate(begin_s)]
    tests = [save(folder, seed, sensor, duration_s, cut_s) for seed, duration_s in enumerate(TEST_S, start=50)]
    models = ["static"] * (not cut_s)  # what is left does not begin at rest
    for method in methods:
        models.append(str(folder / f"{method}.safetensors"))
        known = {"hybrid": words, "neural_ode": [word for word in words if not word.startswith("model.remainder")]}
        settings = load(settings_of(method), None, known.get(method, []))
        card = train(training, Path(models[-1]), method=method, settings=settings).card
        print(
            sensor.kind, method, {key: card[key] for key in ("physics", "compared", "held_out") if key in card}, file=sys.stderr
        )
    for start in starts:
        print(f"| {sensor.kind}, {start} | {mean_aoe(tests, models, start)} |", flush=True)


def save(folder: Path, seed: int, sensor: Drifting, duration_s: float, cut_s: float = 0.0) -> Path:
    """Log on disk: what follows the first `cut_s` of a longer one."""
    path, whole = folder / f"{seed}.mcap", log(seed, sensor, cut_s + duration_s)
    write(whole.between(int(whole.imu.t_ns[0] + 1e9 * cut_s), int(whole.imu.t_ns[-1])), path)
    return path


if __name__ == "__main__":
    main()
