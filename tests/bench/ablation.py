"""What the length of training segments does: accuracy, time and memory for N samples a segment, adjoint and backpropagation.

    python tests/bench/ablation.py TRAIN.mcap... --test TEST.mcap... [--n 4 --n 16 ...] [--steps 150]

Trains `neural_ode` from windows of N samples alone (in place of the usual 1, 4 and 15 s), a process each, so that the peak of
memory is its own, with 1000 windows a step as in the paper; the last line has the usual windows. Held-out error over 20 s
(the measure everything is chosen by), AOE on the test logs (start from truth), CPU seconds of both stages, peak memory.
The adjoint needs a solver that it is the adjoint of: rk4, in both columns.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

WINDOWS = 1000
LENGTHS = (4, 8, 16, 32, 64, 96)


def main() -> None:
    """A Markdown table, a row a length."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="+")
    parser.add_argument("--test", type=Path, action="append", required=True)
    parser.add_argument("--n", type=int, action="append")
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(one(options.logs, options.test, json.loads(options.one))))
        return
    print("| segment | gradients | held out, ° over 20 s | AOE, ° | CPU s | peak MB |\n|---|---|---|---|---|---|")
    for n in [*(options.n or LENGTHS), 0]:
        for adjoint in (False, True):
            what = json.dumps({"n": n, "adjoint": adjoint, "steps": options.steps})
            words = [*map(str, options.logs), *(w for path in options.test for w in ("--test", str(path))), "--one", what]
            done = subprocess.run([sys.executable, __file__, *words], capture_output=True, text=True, check=True)
            found = json.loads(done.stdout.splitlines()[-1])
            length = f"{n} samples" if n else "1, 4, 15 s"
            figures = f"{found['held_out']:.3f} | {found['aoe']:.2f} | {found['cpu_s']:.0f} | {found['peak_mb']:.0f}"
            print(f"| {length} | {'adjoint' if adjoint else 'backpropagation'} | {figures} |", flush=True)


def one(logs: list[Path], test: list[Path], what: dict[str, int | bool]) -> dict[str, float]:
    """One training, its figures."""
    import torch

    from imutool.evaluation import evaluate
    from imutool.mcap_io.read import read
    from imutool.training.run import train
    from imutool.training.settings import TrainSettings

    torch.set_num_threads(1)
    rate_hz = 1.0 / read(logs[0]).imu.period_s
    n = int(what["n"])
    windows = {} if not n else {"gyro_window_s": (n / rate_hz,), "accel_window_s": (n / rate_hz,), "samples": WINDOWS * n}
    model = {"solver": "rk4", "adjoint": bool(what["adjoint"])}
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        path = Path(folder) / "model.safetensors"
        settings = TrainSettings(steps=int(what["steps"]), model=model, **windows)  # type: ignore[arg-type]
        trained = train(logs, path, method="neural_ode", settings=settings)
        cpu_s = time.process_time() - began
        aoe = [evaluate(log, models=[path], init="truth")[1]["aoe_deg"] for log in test]
    held_out = float(np.degrees(trained.card["held_out"]["gyro"]["error"]))
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"held_out": held_out, "aoe": float(np.mean(aoe)), "cpu_s": cpu_s, "peak_mb": peak_mb}


if __name__ == "__main__":
    main()
