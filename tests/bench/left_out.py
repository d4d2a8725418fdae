"""How the training logs of a data set predict one another: where settings are chosen, away from every test sequence.

    python tests/bench/left_out.py LOG.mcap... [--set model.gyro_effects=[...]] [--start truth:5 --start auto ...]
    python tests/bench/left_out.py LOG.mcap... --switched-on-again
    python tests/bench/left_out.py LOG.mcap... --minute

For each log the effects of `hybrid` (without the neural ODE, which would take a minute each) are found on all the others, and
the log is integrated from every start; AOE in degrees. How long a start from the truth takes, which starts are worth their
name, and whether an effect earns its place was asked here. With `--switched-on-again` a usual turn-on bias is added to the log
left out, within the hours of its session. With `--minute` it is the other way round: `train`'s closed form
on the middle minute of each log alone, scored on all others next to raw samples and `static` (mean AOE of these logs). How much
of that the minute has to cost: the last columns hold the orientation by which models differ whose parameters are drawn from the
deviations that the minute leaves, each started in the log as its own model is (root mean square over `DRAWS`).
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.benchmarks import recordings

from imutool.array_types import Bool
from imutool.bias import hybrid
from imutool.bias.model import BiasModel
from imutool.bias_start.correction import apply
from imutool.bias_start.model_choice import estimate_at_rest, find_initial_bias, smooth_in_memory
from imutool.config import load
from imutool.errors import ModelError
from imutool.inertial import metrics
from imutool.inertial.strapdown import along_truth
from imutool.recording import Imu, Poses, Recording, nanoseconds
from imutool.training.bias_spread import TURN_ON_STD
from imutool.training.calibration.effect_selection import PhysicsFirst
from imutool.training.calibration.filter_settings import filter_settings
from imutool.training.fit import Training
from imutool.training.settings import settings_of
from imutool.training.training_windows import Pool
from imutool.units import SENSORS

MINUTE_S, SCORED, DRAWS = 60.0, ("truth", "auto", "smooth"), 5
STARTS = ("prior", "truth:2", "truth:5", "truth:10", "truth:15", "auto", "smooth")


def main() -> None:
    """A Markdown table: a row a log, and their mean."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="+")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--start", action="append")
    parser.add_argument("--minute", action="store_true")
    parser.add_argument("--switched-on-again", action="store_true", help="the log left out gets another turn-on bias")
    parser.add_argument("--turn-error", type=float, help="share of a turn, in place of the calibration's own")
    options = parser.parse_args()
    starts = options.start or list(STARTS)
    logs = recordings(options.logs)
    if options.minute:
        minutes(logs, options.start or list(SCORED), options.set)
        return
    print(f"| left out | {' | '.join(starts)} | effects |\n|{'---|' * (len(starts) + 2)}")
    table, rng = [], np.random.default_rng(5)
    for left_out in logs:
        model = learned([r for r in logs if r is not left_out], options.set)
        if options.turn_error:
            model.card = {**model.card, "turn_error": options.turn_error}
        scored = replace(left_out, imu=moved(left_out.imu, rng)) if options.switched_on_again else left_out
        table.append([aoe(model, scored, start) for start in starts])
        found = ", ".join((*(model.config.gyro_effects or ()), *(model.config.accel_effects or ())))
        print(f"| {left_out.name} | {' | '.join(f'{a:.2f}' for a in table[-1])} | {found} |", flush=True)
    print(f"| mean | {' | '.join(f'{a:.2f}' for a in np.mean(table, axis=0))} | |")


def moved(imu: Imu, rng: np.random.Generator) -> Imu:
    """The samples of the same motion after another switching-on."""
    gyro, accel = (TURN_ON_STD[sensor] * rng.normal(size=3) for sensor in SENSORS)
    return replace(imu, gyro=imu.gyro + gyro, accel=imu.accel + accel)


def minutes(recordings: list[Recording], starts: list[str], words: list[str]) -> None:
    """A row for each log that gave its middle minute."""
    raw = [float(metrics.evaluate(*along_truth(r.imu, r.truth, r.name))["aoe_deg"]) for r in recordings]
    static = [at_rest(r) for r in recordings]
    expected = [f"{start}, by deviations" for start in starts]
    print(f"| minute of | raw | static | {' | '.join([*starts, *expected])} | effects |\n|{'---|' * (2 * len(starts) + 4)}")
    for place, minute_of in enumerate(recordings):
        both = minute_of.overlap().imu
        spare_ns = max(0, int(both.t_ns[-1] - both.t_ns[0]) - nanoseconds(MINUTE_S))
        begin_ns = int(both.t_ns[0]) + spare_ns // 2
        model = learned([replace(minute_of, imu=both.between(begin_ns, begin_ns + nanoseconds(MINUTE_S)))], words)
        others = [k for k in range(len(recordings)) if k != place]
        scores = [np.mean([values[k] for k in others]) for values in (raw, static)]
        scores += [np.mean([aoe(model, recordings[k], start) for k in others]) for start in starts]
        scores += [np.mean([by_deviations(model, recordings[k], start) for k in others]) for start in starts]
        found = ", ".join((*(model.config.gyro_effects or ()), *(model.config.accel_effects or ())))
        print(
            f"| {minute_of.name} | {' | '.join('–' if np.isnan(score) else f'{score:.2f}' for score in scores)} | {found} |",
            flush=True,
        )


def at_rest(recording: Recording) -> float:
    """AOE with the log's own bias at rest; NaN where it never rests."""
    try:
        model, begun = estimate_at_rest(recording.imu, recording.name)
    except ModelError:
        return float("nan")
    return float(
        metrics.evaluate(*along_truth(apply(model, begun, recording.imu).imu, recording.truth, recording.name))["aoe_deg"]
    )


def learned(recordings: list[Recording], words: list[str]) -> BiasModel:
    """The effects of some logs, with their statistics."""
    settings = load(settings_of("hybrid"), None, ["model.remainder=false", *words])
    physics = PhysicsFirst.of(recordings, settings, "cpu", lambda epoch: None)
    training = Training(physics.recordings, "static", settings_of("static")())
    for _ in training.epochs():
        pass
    model = physics.finish(training.model)
    pool = Pool.of(recordings, floors=settings.pose_floors)
    model.card = {"logs": [r.name for r in recordings], **training.turn_on.card(), **filter_settings(model.frozen(), pool)}
    return model.frozen()


def aoe(model: BiasModel, recording: Recording, start: str) -> float:
    """Orientation error of pure integration, in degrees."""
    return float(metrics.evaluate(*integrated(model, recording, start))["aoe_deg"])


def integrated(model: BiasModel, recording: Recording, start: str) -> tuple[Poses, Poses, Bool[np.ndarray, " n"]]:
    """Path of pure integration of the debiased samples, the true one, and the mask of valid rows."""
    begun = (
        smooth_in_memory(model, recording.imu, recording.name)
        if start == "smooth"
        else find_initial_bias(start, model, recording)
    )
    return along_truth(apply(model, begun, recording.imu).imu, recording.truth, recording.name)


def by_deviations(model: BiasModel, recording: Recording, start: str) -> float:
    """Orientation by which models differ within the deviations of the effects' parameters, in degrees."""
    assert isinstance(model, hybrid.Model)
    rng, (path, _, valid) = np.random.default_rng(0), integrated(model, recording, start)
    squares = []
    for _ in range(DRAWS):
        drawn = {
            f"theta_{sensor}": rng.multivariate_normal(model.tensors[f"theta_{sensor}"], model.tensors[f"covariance_{sensor}"])
            for sensor in SENSORS
        }
        other = hybrid.Model(model.config, model.rate_hz, model.tensors | drawn)
        other.card = model.card
        squares.append(metrics.evaluate(integrated(other, recording, start)[0], path, valid)["aoe_deg"] ** 2)
    return float(np.sqrt(np.mean(squares)))


if __name__ == "__main__":
    main()
