"""Whether debiasing knows how sure it is: NEES of the gyro's rest bias along sequences, against what their truth says.

    python tests/bench/consistency.py --model M.safetensors LOG... [--start truth] [--start auto] [--start smooth]

Every `EVERY_S` seconds of a log the rest bias is measured from the truth around (the slope of what integration misses), and the
difference to the bias in use is weighed by its covariance plus that of the measurement (the model's `truth_std`, of windows
of the same length). Three degrees of freedom: honest covariances give a mean of 3; the bounds are chi-square's for as many
independent windows. V1_01 is compared with its recomputed truth.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from imutool import metrics, so3
from imutool.bias._base import BiasModel
from imutool.bias._file import load
from imutool.certainty import Certainty
from imutool.debias import smooth_in_memory
from imutool.mcap_io.read import read
from imutool.recording import Recording, seconds
from imutool.strapdown import with_velocity
from imutool.turn_on import TRUTH_S, find, truth_offset

LEAST_TRUSTED = 0.5
RECOMPUTED = "/ground_truth_recomputed/pose"


def main() -> None:
    """One line a log and start, and one for all logs together."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="+")
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--start", action="append", choices=("truth", "auto", "smooth"))
    options = parser.parse_args()
    model = load(options.model)
    for start in options.start or ("truth", "auto", "smooth"):
        errors, covariances = [], []
        for path in options.logs:
            recording = read(path)
            truths = list(recording.truths)
            recording = recording.with_truth(RECOMPUTED if RECOMPUTED in truths else truths[0])
            e, P = windows(model, recording, start)
            if len(e):
                print(f"{start:7}{recording.name:18}", told(e, P), flush=True)
                errors.append(e)
                covariances.append(P)
        print(f"{start:7}{'all':18}", told(np.concatenate(errors), np.concatenate(covariances)), flush=True)


def windows(model: BiasModel, recording: Recording, start: str) -> tuple[np.ndarray, np.ndarray]:
    """Differences of the gyro's rest bias to what the truth says, window by window, and what covariance they should have."""
    imu = recording.imu
    t_s = seconds(imu.t_ns, int(imu.t_ns[0]))
    begun = smooth_in_memory(model, imu, recording.name) if start == "smooth" else find(start, model, recording)
    stream = begun.stream(model)
    bias = stream(t_s, imu.gyro, imu.accel)
    P = Certainty(model, begun, stream)(t_s, imu.gyro, imu.accel)[:, :3, :3]
    poses, trusted = with_velocity(recording.truth).at(imu.t_ns)
    assert poses.v_w is not None
    R_wb = so3.matrix_from_quaternion_wxyz(torch.from_numpy(np.array(poses.q_wb_wxyz)))
    left = np.concatenate([imu.gyro, imu.accel], axis=1) - bias
    measured = np.diag(model.truth_std.double().numpy()[:3] ** 2)
    errors, covariances = [], []
    first = int(np.argmax(trusted))
    if start == "truth":  # what it was found from proves nothing
        first = int(np.searchsorted(t_s, t_s[first] + TRUTH_S))
    while (last := int(np.searchsorted(t_s, t_s[min(first, len(t_s) - 1)] + TRUTH_S))) < len(t_s):
        rows = slice(first, last + 1)
        if trusted[first] and trusted[rows].mean() >= LEAST_TRUSTED:
            v_w = torch.from_numpy(np.array(poses.v_w[rows]))
            errors.append(truth_offset(t_s[rows], left[rows], R_wb[rows], v_w, trusted[rows])[:3])
            covariances.append(P[rows].mean(axis=0) + measured)
        first = last
    return np.reshape(errors, (-1, 3)), np.reshape(covariances, (-1, 3, 3))


def told(e: np.ndarray, P: np.ndarray) -> str:
    """The figures of `metrics.consistency` in a line."""
    found = metrics.consistency(e, P)
    bounds = f"95 % bounds {found['nees_lower']:.2f} to {found['nees_upper']:.2f}"
    return f"NEES {found['nees_mean']:6.2f}  {bounds}  windows {found['samples']:3.0f}  consistent: {found['consistent']}"


if __name__ == "__main__":
    main()
