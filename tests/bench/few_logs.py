"""Models of few logs: `train` as it is typed on some logs of a sensor, judged by all its others.

    python tests/bench/few_logs.py LOG.mcap... [--logs 3] [--set model.remainder=false]

Each set of neighbours in the row of logs is trained on once. AOE in degrees, mean over the other logs and over the starts; and
the drift of attitude in windows of 5 s from the truth (root mean square), next to what the model's covariance lets one expect.
A data set's test sequences do not belong here: settings are chosen by these figures.
"""

from __future__ import annotations

import argparse
import logging
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from imutool.bias.model_file import load
from imutool.config import load as load_settings
from imutool.errors import ModelError
from imutool.evaluation import evaluate
from imutool.training.run import train
from imutool.training.settings import settings_of

STARTS: dict[str, dict[str, Any]] = {"auto": {}, "smooth": {"smooth": True}, "truth": {"init": "truth"}}
EXPECTED = "drift_orientation_std_deg"
DRIFT = "drift_orientation_deg"


def main() -> None:
    """A row for each set of training logs, then their mean."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", type=Path, nargs="+")
    parser.add_argument("--logs", type=int, default=3)
    parser.add_argument("--method", default="hybrid")
    parser.add_argument("--set", action="append", default=[])
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    settings, rows = load_settings(settings_of(options.method), None, options.set), list[list[float]]()
    columns = ("raw", *(f"static, {start}" for start in STARTS), *(f"model, {start}" for start in STARTS), "5 s", "expected")
    print(f"| training logs | {' | '.join(columns)} | kept |\n|{'---|' * (len(columns) + 2)}")
    for place in range(len(options.paths)):
        turned = [*options.paths[place:], *options.paths[:place]]
        training, others = turned[: options.logs], turned[options.logs :]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "model.safetensors"
            train(training, path, method=options.method, settings=settings)
            rows.append(scored(path, others))
            names = ", ".join(log.stem for log in training)
            print(f"| {names} | {shown(rows[-1])} | {kept(path)} |", flush=True)
    columns_of = ([value for value in column if np.isfinite(value)] for column in zip(*rows, strict=True))
    print(f"| mean | {shown([float(np.mean(column)) if column else np.nan for column in columns_of])} | |")


def shown(values: list[float]) -> str:
    """Cells of a row."""
    return " | ".join(f"{value:.2f}" if np.isfinite(value) else "–" for value in values)


def scored(model: Path, logs: list[Path]) -> list[float]:
    """Mean AOE of raw samples, of `static` and of the model; drift of the model from the truth, measured and expected."""
    results = {start: [one for log in logs for one in results_of(log, model, options)] for start, options in STARTS.items()}

    def mean(start: str, name: str) -> float:
        errors = [float(one["aoe_deg"]) for one in results[start] if one["model"] == name]
        return float(np.mean(errors)) if errors else np.nan

    def square(key: str) -> float:
        return float(np.sqrt(np.mean([one[key] ** 2 for one in results["truth"] if one["model"] == model.stem])))

    aoe = [mean(start, name) for name in ("static", model.stem) for start in STARTS]
    return [mean("truth", "raw"), *aoe, square(DRIFT), square(EXPECTED)]


def results_of(log: Path, model: Path, options: dict[str, Any]) -> list[dict[str, Any]]:
    """Results of a log; without those of `static` where the log has no rest."""
    try:
        return evaluate(log, models=["static", model], **options)
    except ModelError:
        return evaluate(log, models=[model], **options)


def kept(path: Path) -> str:
    """Candidate kept for each sensor, and whether the neural ODE was."""
    card = load(path).card
    words = [f"{sensor}: {name}" for sensor, name in card.get("left_out", {}).get("kept", {}).items()]
    with_ode = card.get("held_out") == card.get("compared", {}).get("effects and neural_ode")
    return ", ".join([*words, *(["neural ODE"] if with_ode else [])])


if __name__ == "__main__":
    main()
