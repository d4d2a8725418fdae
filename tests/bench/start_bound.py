"""What a start must cost, from fifteen seconds of truth and without: `python tests/bench/start_bound.py LOG... --model M`.

The truth's attitude differs from the integrated gyro, of which the model and the log's own best constant are taken, by an error
that wanders: its variogram over the whole log says how far. In the first seconds it hides the bias. The best linear unbiased
estimate of a constant bias from them, with that variogram, the model's prior and a free initial attitude, has a covariance; for
Gaussian errors no unbiased estimate has a smaller one (Cramér-Rao). Carried through the log it is an orientation error.
Printed for each log, in degrees:

    own       AOE of pure integration with the log's own best constant, from all of its truth
    start     root mean square of what the covariance of the start adds
    heading   the mean error that stays if gravity told the biases of both tilts exactly, from the first sample on
    reached   AOE of `evaluate --init truth`
    auto      the mean error of the heading that the filter of `--init auto` expects, by its covariance
    smooth    the same of `--smooth`

Without truth a stop shows the bias that turns the heading, and nothing else does. The filter knows the heading at least as well
as its bias integrated, and no other estimate knows it better if the model's statistics are right: the prior, the walk and the
offset between rest and motion.

The variogram also holds the walk of the bias within the log, which hides the log's constant as the truth's error does.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.optimize import nnls
from starts import aoe, own_bias, samples

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.benchmarks import recordings

from imutool.bias.model import BiasModel
from imutool.bias.model_file import load
from imutool.bias_start import bias_from_truth, initial_bias
from imutool.bias_start.bias_tracking import filter_blocks, smooth_blocks
from imutool.bias_start.initial_bias import InitialBias, model_samples
from imutool.geometry import quaternion
from imutool.inertial.strapdown import along_truth
from imutool.recording import Imu, Recording, seconds

START_S = 15.0
STEP_S = 0.25
TIMES_S = np.geomspace(0.05, 500.0, 30)  # the longest is a random walk over these seconds
COLUMNS = ("own", "start", "heading", "reached", "auto", "smooth")
MEAN_SIZE = np.sqrt(2.0 / np.pi)  # of a normal variable, in its standard deviations


def main() -> None:
    """One row a log, and their mean."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="+", metavar="LOG")
    parser.add_argument("--model", type=Path, required=True)
    options = parser.parse_args()
    model = load(options.model)
    logs = recordings(options.logs)
    print(f"{'':16}" + "".join(f"{column:>9}" for column in COLUMNS) + "   deviation of the start's bias, rad/s")
    rows = []
    for recording, own in zip(logs, own_bias(model, logs), strict=True):
        row, std = bound(model, recording, InitialBias(own, np.zeros(6), "own"))
        rows.append(row)
        print(
            f"{recording.name:16}" + "".join(f"{value:9.2f}" for value in row) + f"   {np.round(std, 5).tolist()}", flush=True
        )
    print(f"{'mean':16}" + "".join(f"{value:9.2f}" for value in np.mean(rows, axis=0)))


def bound(model: BiasModel, recording: Recording, own: InitialBias) -> tuple[list[float], Float64[np.ndarray, "3"]]:
    """Errors of a log in the order of `COLUMNS`, and the standard deviation of the bias after the start."""
    t_s, error_w, turned = wander(model, recording, own)
    step = round(STEP_S / float(np.median(np.diff(t_s))))
    t_s, error_w, turned = t_s[::step], error_w[::step], turned[::step]
    gamma = variogram(error_w, int(START_S / STEP_S))
    first = t_s <= t_s[0] + START_S
    P = covariance(turned[first], gamma, np.diag(initial_bias.bias_prior(model).std[:3] ** 2))
    up = turned[-1, 2] / np.linalg.norm(turned[-1, 2])  # the bias that turns the heading
    heading = MEAN_SIZE * rms_deg((turned @ up) / np.sqrt(up @ np.linalg.solve(P, up)))
    start = rms_deg(turned @ np.linalg.cholesky(P))
    reached = aoe(model, bias_from_truth.from_truth(model, recording), recording)
    row = [aoe(model, own, recording), start, float(heading), reached, *without_truth(model, recording)]
    return row, np.sqrt(np.diag(P))


def without_truth(model: BiasModel, recording: Recording) -> tuple[float, float]:
    """Mean errors of the heading that filter and smoother expect, in degrees."""
    filtered = list(filter_blocks(model, [model_samples(model, recording.imu)], initial_bias.bias_prior(model)))
    states = [block.step.after for block in filtered], [state for _, state in smooth_blocks(filtered)]
    auto, smooth = (MEAN_SIZE * rms_deg(np.array([np.sqrt(state.P[2, 2]) for state in some])) for some in states)
    return auto, smooth


def wander(
    model: BiasModel, recording: Recording, own: InitialBias
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3 3"]]:
    """Seconds, truth against integrated gyro (rad, world frame), and the rotation that a unit of each axis' bias gives.

    The second is NaN where there is no truth.
    """
    imu = recording.imu
    bias = own.stream(model)(*samples(imu))
    estimate, true, valid = along_truth(Imu(imu.t_ns, imu.gyro - bias[:, :3], imu.accel), recording.truth, recording.name)
    t_s = seconds(true.t_ns, int(true.t_ns[0]))
    R_true = quaternion.matrix(true.q_wb_wxyz)
    error_w = quaternion.log(quaternion.multiply(true.q_wb_wxyz, quaternion.inverse(estimate.q_wb_wxyz)))
    error_w[~valid] = np.nan
    steps = 0.5 * (R_true[1:] + R_true[:-1]) * np.diff(t_s)[:, None, None]
    return t_s, error_w, np.concatenate([np.zeros((1, 3, 3)), np.cumsum(steps, axis=0)])


def variogram(error_w: Float64[np.ndarray, "n 3"], lags: int) -> Float64[np.ndarray, " lags"]:
    """Half the mean square by which an axis' error changes over each number of steps, as a sum of exponential ones.

    Such a sum belongs to an error that can be; the bare means, with holes in the truth, need not.
    """
    steps = np.arange(1, lags + 1)
    found = np.array([0.5 * np.nanmean((error_w[lag:] - error_w[:-lag]) ** 2) for lag in steps])
    terms = 1.0 - np.exp(-np.arange(lags + 1)[:, None] / (TIMES_S / STEP_S))
    weights, _ = nnls(terms[1:] / found[:, None], np.ones(lags))
    return terms @ weights


def covariance(
    turned: Float64[np.ndarray, "n 3 3"], gamma: Float64[np.ndarray, " lags"], prior: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "3 3"]:
    """Covariance of the bias by generalized least squares; the initial attitude is free, so the variogram is enough."""
    n = min(len(turned), len(gamma))
    turned = turned[:n]
    S = 2.0 * gamma.max() - gamma[np.abs(np.subtract.outer(np.arange(n), np.arange(n)))]
    S += 1e-9 * gamma.max() * np.eye(n)
    X = np.concatenate([np.tile(np.eye(3), (n, 1, 1)), turned], axis=2)
    whitened = np.linalg.solve(np.linalg.cholesky(S), X.reshape(n, 18)).reshape(3 * n, 6)
    information = whitened.T @ whitened
    information[3:, 3:] += np.linalg.inv(prior)
    return np.linalg.inv(information)[3:, 3:]


def rms_deg(turned: Float64[np.ndarray, "n ..."]) -> float:
    """Root mean square over a log of a rotation error, in degrees."""
    return float(np.degrees(np.sqrt((turned.reshape(len(turned), -1) ** 2).sum(axis=1).mean())))


if __name__ == "__main__":
    main()
