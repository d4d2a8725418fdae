"""What no constant calibration gets below: velocity drift over 5 s windows with the best constants of each log itself.

    python tests/bench/velocity_floor.py LOG... [--model M.safetensors]...

Every window starts from the true attitude and velocity, as `evaluate` scores it (`strapdown.drift`). To a log's windows 27
constants are fitted, by least squares on the very figure that is reported: a matrix and a bias for the gyro, the same for the
accelerometer, and gravity in the truth's world. A model that was learned on other logs cannot know them. What they leave is
what changes within the log and the truth's own errors at the ends of windows (half a degree of attitude is g sin(0.5°) 5 s =
0.43 m/s). V1_01 is compared with its recomputed truth.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float64

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.benchmarks import recordings

from imutool.bias.model_file import load
from imutool.bias_start.correction import apply
from imutool.bias_start.model_choice import find_initial_bias
from imutool.inertial.strapdown import GRAVITY_W, StartPose, along_truth, dead_reckon, drift, with_velocity
from imutool.recording import Imu, Poses, Recording, seconds

WINDOW_S, EVERY_S = 5.0, 1.0
CONSTANTS = 27
STEP = np.concatenate([np.full(12, 1e-5), np.full(15, 1e-4)])
ROUNDS = 3


def main() -> None:
    """A row a log: what is left in m/s of the samples as recorded, of each model, and of the log's own constants."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="+")
    parser.add_argument("--model", type=Path, action="append", default=[])
    options = parser.parse_args()
    models = [load(path) for path in options.model]
    print(f"| m/s after {WINDOW_S:g} s | {' | '.join(path.stem for path in options.model)} | own constants |")
    print("|---" * (len(models) + 2) + "|")
    for recording in recordings(options.logs):
        debiased = [apply(model, find_initial_bias("truth", model, recording), recording.imu).imu for model in models]
        drifts = [drift(*along_truth(imu, recording.truth, recording.name), WINDOW_S) for imu in debiased]
        cells = [float(np.sqrt(np.mean(one.velocity_m_s**2))) for one in drifts]
        print(f"| {recording.name} | {' | '.join(f'{cell:.2f}' for cell in (*cells, floor(recording)))} |", flush=True)


def floor(recording: Recording) -> float:
    """Root mean square velocity drift (m/s) that the log's own best constants leave; also of windows they were fitted to."""
    true, valid = with_velocity(recording.truth).at(recording.imu.t_ns)
    t_s = seconds(recording.imu.t_ns, int(recording.imu.t_ns[0]))
    windows = [
        (first, last)
        for first, last in _windows(t_s)
        if valid[first] and valid[last] and np.diff(t_s[first : last + 1]).max() < EVERY_S / 10
    ]
    constants = np.zeros(CONSTANTS)
    for _ in range(ROUNDS):
        e = missed(recording.imu, true, windows, constants)
        columns = [
            (missed(recording.imu, true, windows, constants + STEP * unit) - e) / STEP[k]
            for k, unit in enumerate(np.eye(CONSTANTS))
        ]
        constants = constants - np.linalg.lstsq(np.stack(columns, axis=1), e, rcond=None)[0]
    e = missed(recording.imu, true, windows, constants).reshape(-1, 3)
    return float(np.sqrt((e**2).sum(axis=1).mean()))


def missed(
    imu: Imu, true: Poses, windows: list[tuple[int, int]], constants: Float64[np.ndarray, "27"]
) -> Float64[np.ndarray, " m"]:
    """The velocity (m/s) that each window misses at its end, three numbers a window."""
    A_gyro, A_accel = (np.eye(3) + constants[k : k + 9].reshape(3, 3) for k in (0, 12))
    gyro, accel = imu.gyro @ A_gyro.T - constants[9:12], imu.accel @ A_accel.T - constants[21:24]
    g_w = tuple(float(x) for x in np.array(GRAVITY_W) + constants[24:])
    assert true.v_w is not None
    out = []
    for first, last in windows:
        rows = slice(first, last + 1)
        end = dead_reckon(Imu(imu.t_ns[rows], gyro[rows], accel[rows]), StartPose.of(true, first), (g_w[0], g_w[1], g_w[2]))
        assert end.v_w is not None
        out.append(end.v_w[-1] - true.v_w[last])
    return np.concatenate(out)


def _windows(t_s: Float64[np.ndarray, " n"]) -> list[tuple[int, int]]:
    starts = np.arange(0.0, t_s[-1] - WINDOW_S, EVERY_S)
    return [(int(np.searchsorted(t_s, s)), int(np.searchsorted(t_s, s + WINDOW_S))) for s in starts]


if __name__ == "__main__":
    main()
