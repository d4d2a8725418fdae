"""What each way to know the rest bias is worth: `python tests/bench/starts.py LOG... --model MODEL`.

MODEL is of the same sensor and trained on other logs than these, as those of `python examples/reproduce_tables.py DATA -o OUT
--swap` are for the training sequences. Prints the AOE in degrees of pure integration from the true pose:

    truth     `--init truth`: its first seconds, then followed                prior    mean of the training logs
    rest      first stop, else the prior (the rule before there was a filter) VQF      its bias estimate, causal
    VQF all   its offline estimate                                            auto     `--init auto`
    smooth    `--smooth`                                                      oracle   each log's own constant, by truth

VQF (Laidig and Seel, 2023) is given the same samples, less what the model says of the motion and less the prior's mean, and a
clip of 20 instead of 2 deg/s. Below stands how consistent `auto` is: the mean NEES of its last gyro bias against the oracle's,
3 if it is as sure as it should be. V1_01 is compared with its recomputed truth.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import torch
import vqf
from thawed import thawed

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.benchmarks import recordings

from imutool.bias.model import BiasModel, Vector6
from imutool.bias.model_file import load
from imutool.bias_start import bias_at_rest, bias_from_truth, initial_bias
from imutool.bias_start.bias_tracking import BiasTrajectory, Samples, filter_blocks
from imutool.bias_start.initial_bias import InitialBias
from imutool.errors import DataError
from imutool.inertial import metrics
from imutool.inertial.strapdown import along_truth
from imutool.recording import Imu, Recording, seconds
from imutool.training.calibration import closed_form
from imutool.training.training_windows import Pool, corrected

CLIP_DEG_S = 20.0
WINDOW_S = {"gyro": (15.0,), "accel": (2.0,)}
COLUMNS = ("truth", "prior", "rest", "VQF", "VQF all", "auto", "smooth", "oracle")


def main() -> None:
    """One row a training sequence, and their mean."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="+", metavar="LOG")
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--turn-error", type=float, help="share of a turn, in place of the calibration's own")
    options = parser.parse_args()
    model = load(options.model)
    if options.turn_error:
        model.card = {**model.card, "turn_error": options.turn_error}
    logs = recordings(options.logs)
    oracle = own_bias(model, logs)
    print(f"{'':16}" + "".join(f"{column:>9}" for column in COLUMNS) + "   s: auto, smooth; how")
    rows, nees = [], []
    for i, recording in enumerate(logs):
        row, how, error, P = score(model, recording, oracle[i])
        rows.append(row)
        nees.append(error @ np.linalg.solve(P, error))
        print(f"{recording.name:16}" + "".join(f"{value:9.2f}" for value in row) + how, flush=True)
    print(f"{'mean':16}" + "".join(f"{value:9.2f}" for value in np.mean(rows, axis=0)))
    print(f"NEES of auto's last gyro bias: mean {np.mean(nees):.1f}, each {np.round(nees, 1).tolist()}")


def score(model: BiasModel, recording: Recording, own: Vector6) -> tuple[list[float], str, np.ndarray, np.ndarray]:
    """AOE of each way, a word on time, and how far the filter's last gyro bias is from the log's own."""
    imu = recording.imu
    began = time.perf_counter()
    auto = bias_at_rest.auto(model, imu)
    auto.stream(model)(*samples(imu))
    halfway = time.perf_counter()
    smooth = initial_bias.smoothed_start(model, [samples(imu)], initial_bias.bias_prior(model))
    ended = time.perf_counter()
    starts = {
        "truth": bias_from_truth.from_truth(model, recording),
        "prior": initial_bias.prior(model),
        "rest": at_rest_else_prior(model, imu),
        "VQF": by_vqf(model, imu, offline=False),
        "VQF all": by_vqf(model, imu, offline=True),
        "auto": auto,
        "smooth": smooth,
        "oracle": InitialBias(own, np.zeros(6), "oracle"),
    }
    last = list(filter_blocks(model, [samples(imu)], initial_bias.bias_prior(model)))[-1].step.after
    row = [aoe(model, starts[column], recording) for column in COLUMNS]
    return row, f"   {halfway - began:.2f} {ended - halfway:.2f}; {auto.how}", (last.bias - own)[:3], last.P[9:12, 9:12]


def aoe(model: BiasModel, start: InitialBias, recording: Recording) -> float:
    """AOE in degrees of pure integration with this start."""
    imu = recording.imu
    bias = start.stream(model)(*samples(imu))
    corrected = Imu(imu.t_ns, imu.gyro - bias[:, :3], imu.accel - bias[:, 3:])
    return float(metrics.absolute(*along_truth(corrected, recording.truth, recording.name))["aoe_deg"] or 0.0)


def own_bias(model: BiasModel, recordings: list[Recording]) -> np.ndarray:
    """Each log's own constant, in closed form from all its truth."""
    pool = Pool.of(recordings)
    rest = torch.from_numpy(model.prior_mean).expand(len(recordings), 6).clone()
    scored, pool = corrected(thawed(model), pool)
    for sensor, columns in (("gyro", slice(0, 3)), ("accel", slice(3, 6))):
        solved = closed_form.solve(scored, sensor, pool, rest, WINDOW_S[sensor], matrix=False, part="all", nuisances=False)  # type: ignore[arg-type]
        rest[:, columns] = solved.rest
    return rest.numpy()


def at_rest_else_prior(model: BiasModel, imu: Imu) -> InitialBias:
    try:
        return bias_at_rest.at_rest(model, imu)
    except DataError:
        return initial_bias.prior(model)


def by_vqf(model: BiasModel, imu: Imu, *, offline: bool) -> InitialBias:
    """VQF's bias at every sample, on top of the prior's mean."""
    t_s, gyro, accel = samples(imu)
    start = initial_bias.prior(model)
    bias = model.stream(start.rest)(t_s, gyro, accel)
    rate, force = np.ascontiguousarray(gyro - bias[:, :3]), np.ascontiguousarray(accel - bias[:, 3:])
    settings = {"biasClip": CLIP_DEG_S}
    if offline:
        found = vqf.offlineVQF(rate, force, None, imu.period_s, settings)["bias"]
    else:
        found = vqf.VQF(imu.period_s, **settings).updateBatch(rate, force)["bias"]
    rest = np.tile(start.rest, (len(imu), 1))
    rest[:, :3] += found
    return InitialBias(rest[0], start.std, "VQF", track=BiasTrajectory(t_s, rest, np.tile(start.std, (len(imu), 1))))


def samples(imu: Imu) -> Samples:
    """Seconds from the first sample, rates and forces."""
    return seconds(imu.t_ns, int(imu.t_ns[0])), imu.gyro, imu.accel


if __name__ == "__main__":
    main()
