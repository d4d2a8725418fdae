"""Trains on the training sequences, scores the test sequences, and prints the table of docs/accuracy.md as Markdown.

    python tests/bench/accuracy.py ../shared/data --method linear --method neural_ode --seeds 5

Nothing is chosen here: settings are the defaults, the split is the paper's, the test sequences are read once a model is done.
V1_01 starts and is scored on its recomputed truth. APE is that of pure integration, in m.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from imutool.convert import convert
from imutool.evaluate import evaluate
from imutool.train.fit import TrainSettings
from imutool.train.run import train

TRAIN = {
    "euroc": ("MH_01_easy", "MH_03_medium", "MH_05_difficult", "V1_02_medium", "V2_01_easy", "V2_03_difficult"),
    "tumvi": ("room1", "room3", "room5"),
    "fetch": ("01_square", "03_um", "04_eight", "06_right_turn", "07_left_turn", "08_origin"),
}
TEST = {
    "euroc": ("MH_04_difficult", "V1_01_easy", "V1_03_difficult", "V2_02_medium"),
    "tumvi": ("room2", "room4", "room6"),
    "fetch": ("05_random",),
}
PUBLISHED = {  # AOE in degrees of raw, linear, neural_ode: the paper, tables III and V
    "MH_04_difficult": (130.33, 4.08, 1.06),
    "V1_01_easy": (113.47, 4.89, 1.27),
    "V1_03_difficult": (120.13, 2.52, 2.26),
    "V2_02_medium": (116.92, 4.62, 4.27),
    "room2": (32.82, 15.02, 1.69),
    "room4": (70.19, 4.07, 1.71),
    "room6": (65.15, 8.47, 1.97),
    "05_random": (73.28, 2.42, 1.96),
}
OTHER_TRUTH = {"V1_01_easy": "/ground_truth_recomputed/pose"}


def main() -> None:
    """Prints one row a test sequence and method: mean over the seeds and spread."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--set", dest="sets", action="append", choices=sorted(TRAIN), help="data set; default all")
    parser.add_argument("--method", action="append")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--swap", action="store_true", help="train on the test sequences, test on the training ones")
    parser.add_argument("--keep", type=Path, help="folder for logs and models; default a temporary one")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        rows = []
        for name in options.sets or sorted(TRAIN):
            for row in score(
                name, options.data, folder, options.method or ["linear", "neural_ode"], options.seeds, options.swap
            ):
                rows.append(row)
                print(json.dumps(row), flush=True)
    print(table(rows))


def score(name: str, data: Path, folder: Path, methods: list[str], seeds: int, swap: bool) -> Iterator[dict[str, object]]:
    """One result per test sequence, method, seed and way to start."""
    logs = folder / name
    if not logs.exists():
        convert(data / name, logs)
    learn, test = (TEST, TRAIN) if swap else (TRAIN, TEST)
    for method in methods:
        for seed in range(seeds if method != "linear" else 1):
            model = folder / f"{name}-{method}-{seed}{'-swapped' if swap else ''}.safetensors"
            began = time.perf_counter()
            if not model.exists():
                train([logs / f"{n}.mcap" for n in learn[name]], model, method=method, settings=TrainSettings(seed=seed))
            trained_s = time.perf_counter() - began
            for sequence in test[name]:
                for init in ("truth", "auto", "prior"):
                    raw, result = evaluate(
                        logs / f"{sequence}.mcap", models=[model], init=init, truth=OTHER_TRUTH.get(sequence)
                    )
                    keys = ("log", "init", "init_how", "aoe_deg", "ape_m", "velocity_rmse_m_s")
                    row = {key: result[key] for key in keys}
                    yield {"set": name, "method": method, "seed": seed, "trained_s": trained_s, "raw": raw["aoe_deg"], **row}


def table(rows: list[dict[str, object]]) -> str:
    """Markdown: AOE with its spread over the seeds, beside the published figures."""
    lines = [
        "| sequence | raw: published / ours | linear: published / ours | neural_ode: published / ours, start from truth | "
        "start auto | APE m (truth) |",
        "|---|---|---|---|---|---|",
    ]
    for log in dict.fromkeys(str(row["log"]) for row in rows):
        published = PUBLISHED.get(log, (float("nan"),) * 3)

        def figures(method: str, init: str, key: str, log: str = log) -> np.ndarray:
            return np.array([r[key] for r in rows if (r["log"], r["method"], r["init"]) == (log, method, init)], float)

        raw = next(row["raw"] for row in rows if row["log"] == log)
        linear, node = figures("linear", "truth", "aoe_deg"), figures("neural_ode", "truth", "aoe_deg")
        auto, ape = figures("neural_ode", "auto", "aoe_deg"), figures("neural_ode", "truth", "ape_m")
        lines.append(
            f"| {log} | {published[0]:.2f} / {raw:.2f} | {published[1]:.2f} / {_spread(linear)} "
            f"| {published[2]:.2f} / {_spread(node)} | {_spread(auto)} | {_spread(ape, '.0f')} |"
        )
    return "\n".join(lines)


def _spread(values: np.ndarray, form: str = ".2f") -> str:
    if not len(values):
        return "–"
    return f"{values.mean():{form}}" + (f" ± {values.std(ddof=1):{form}}" if len(values) > 1 else "")


if __name__ == "__main__":
    main()
