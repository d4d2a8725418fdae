"""How the training logs of a data set predict one another: where settings are chosen, away from every test sequence.

    python tests/bench/left_out.py LOG.mcap... [--set model.gyro_effects=[...]] [--start truth:5 --start auto ...]

For each log the effects of `hybrid` (without the neural ODE, which would take a minute each) are found on all the others, and
the log is integrated from every start; AOE in degrees. How long a start from the truth takes, which starts are worth their
name, and whether an effect earns its place was asked here.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from imutool.bias.model import BiasModel
from imutool.bias_start.correction import apply
from imutool.bias_start.model_choice import find_initial_bias, smooth_in_memory
from imutool.config import load
from imutool.inertial import metrics
from imutool.inertial.strapdown import along_truth
from imutool.mcap_io.read import read
from imutool.recording import Recording
from imutool.training.calibration import PhysicsFirst
from imutool.training.fit import Training
from imutool.training.settings import settings_of

STARTS = ("prior", "truth:2", "truth:5", "truth:10", "truth:15", "auto", "smooth")


def main() -> None:
    """A Markdown table: a row a log, and their mean."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="+")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--start", action="append")
    options = parser.parse_args()
    starts = options.start or list(STARTS)
    recordings = [read(log) for log in options.logs]
    recordings = [r.with_truth(next(iter(r.truths))) for r in recordings]
    print(f"| left out | {' | '.join(starts)} | effects |\n|{'---|' * (len(starts) + 2)}")
    table = []
    for left_out in recordings:
        model = learned([r for r in recordings if r is not left_out], options.set)
        table.append([aoe(model, left_out, start) for start in starts])
        found = ", ".join((*(model.config.gyro_effects or ()), *(model.config.accel_effects or ())))
        print(f"| {left_out.name} | {' | '.join(f'{a:.2f}' for a in table[-1])} | {found} |", flush=True)
    print(f"| mean | {' | '.join(f'{a:.2f}' for a in np.mean(table, axis=0))} | |")


def learned(recordings: list[Recording], words: list[str]) -> BiasModel:
    """The effects of some logs, with their statistics."""
    settings = load(settings_of("hybrid"), None, ["model.remainder=false", *words])
    physics = PhysicsFirst.of(recordings, settings, "cpu", lambda epoch: None)
    training = Training(physics.recordings, "static", settings_of("static")())
    for _ in training.epochs():
        pass
    model = physics.finish(training.model)
    model.card = {"logs": [r.name for r in recordings], "sessions": [session.card() for session in training.sessions]}
    return model.frozen()


def aoe(model: BiasModel, recording: Recording, start: str) -> float:
    """Orientation error of pure integration, in degrees."""
    begun = (
        smooth_in_memory(model, recording.imu, recording.name)
        if start == "smooth"
        else find_initial_bias(start, model, recording)
    )
    debiased = apply(model, begun, recording.imu).imu
    return float(metrics.evaluate(*along_truth(debiased, recording.truth, recording.name))["aoe_deg"])


if __name__ == "__main__":
    main()
