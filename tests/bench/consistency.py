"""Whether debiasing knows how sure it is: NEES of the gyro's rest bias along sequences, against what their truth says.

    python tests/bench/consistency.py --model M.safetensors LOG... [--start truth] [--start auto] [--start smooth]
    python tests/bench/consistency.py --left-out TRAINING_LOG...

Every `TRUTH_S` of a log the bias is measured from the truth around (the slope, in time, of what integration misses), and the
difference to the bias in use is weighed by its covariance plus that of the measurement. Three degrees of freedom: honest
covariances give a mean of 3; the bounds are chi-square's. The coverage is the share of windows within the ellipsoids that
should hold 68, 95 and 99.7 % of them. With `--left-out` each log is judged by the closed form of all others. V1_01 is compared
with its recomputed truth.

The calibration's share of a window's covariance is that of the slope: its unknowns are the same at every sample, and what goes
with the motion mostly cancels over 15 s, which the samples' covariances one by one do not show. What a measurement is worth is
seen in the log itself, for truths differ by a factor of eight from log to log: how far half windows differ from the next ones
(Allan's variance), carried over to whole ones as errors of an attitude go, with T^-3/2. Where the truth's errors last for
seconds that is too little, and too much is never forgiven. Errors of a rest bias last longer than a window: the bounds, for
independent windows, are a little narrow.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float64
from scipy.stats import chi2

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from nees import consistency

from imutool.bias.io import load
from imutool.bias.model import BiasModel
from imutool.bias_start.bias_covariance import BiasEstimator
from imutool.bias_start.bias_from_truth import TRUTH_S, bias_from_truth
from imutool.bias_start.model_choice import find_initial_bias, smooth_in_memory
from imutool.geometry import so3
from imutool.geometry.quaternion import unit
from imutool.inertial.strapdown import with_velocity
from imutool.inertial.windows import running_product, step_means
from imutool.mcap_io.read import read
from imutool.recording import Recording, seconds

LEAST_TRUSTED = 0.5
SHARES = (0.68, 0.95, 0.997)
RECOMPUTED = "/ground_truth_recomputed/pose"


class Seen(NamedTuple):
    """The samples of a log, and its truth at their times."""

    t_s: Float64[np.ndarray, " n"]
    samples: Float64[np.ndarray, "n 6"]
    q_wb_wxyz: np.ndarray
    v_w: np.ndarray
    trusted: np.ndarray

    @classmethod
    def of(cls, recording: Recording) -> Seen:
        """A recording's own."""
        imu = recording.imu
        poses, trusted = with_velocity(recording.truth).at(imu.t_ns)
        assert poses.v_w is not None
        samples = np.concatenate([imu.gyro, imu.accel], axis=1)
        return cls(seconds(imu.t_ns, int(imu.t_ns[0])), samples, unit(poses.q_wb_wxyz), poses.v_w, trusted)

    def window(self, from_s: float, length_s: float) -> slice | None:
        """The samples from a time on, if the truth can be trusted there."""
        first, last = (int(np.searchsorted(self.t_s, t)) for t in (from_s, from_s + length_s))
        rows = slice(first, last + 1)
        whole = last < len(self.t_s) and self.trusted[first] and self.trusted[rows].mean() >= LEAST_TRUSTED
        return rows if whole else None

    def gyro_offset(self, rows: slice, bias: Float64[np.ndarray, "n 6"]) -> Float64[np.ndarray, "3"]:
        """What a bias leaves of the rest bias over a window."""
        left = self.samples[rows] - bias[rows]
        return bias_from_truth(self.t_s[rows], left, self.q_wb_wxyz[rows], self.v_w[rows], self.trusted[rows])[:3]

    def slope_of(
        self, rows: slice, gyro: Float64[np.ndarray, "n 3"], S: Float64[np.ndarray, "n 3 p"]
    ) -> Float64[np.ndarray, "3 p"]:
        """What errors S of a window's debiased rate look like as an offset: the slope of their integral, by least squares."""
        dt, seen = torch.from_numpy(np.diff(self.t_s[rows])), self.trusted[rows][1:]
        R = running_product(so3.exp(step_means(torch.from_numpy(gyro[rows])[None]) * dt[None, :, None]))[0] * dt[:, None, None]
        integral = torch.cumsum(R @ step_means(torch.from_numpy(S[rows]).movedim(2, 0)).movedim(0, 2), dim=0)[seen]
        X = torch.cat([torch.cumsum(R, dim=0)[seen], torch.eye(3, dtype=R.dtype).expand(len(integral), 3, 3)], dim=2)
        found = torch.linalg.lstsq(X.flatten(0, 1), integral.flatten(0, 1)).solution[:3]
        return np.asarray(found)


def main() -> None:
    """One line a log and start, and one for all logs together."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="+")
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--model", type=Path)
    which.add_argument("--left-out", action="store_true")
    parser.add_argument("--start", action="append", choices=("truth", "auto", "smooth"))
    options = parser.parse_args()
    recordings = []
    for path in options.logs:
        recording = read(path)
        recordings.append(recording.with_truth(RECOMPUTED if RECOMPUTED in recording.truths else next(iter(recording.truths))))
    models = {r.name: load(options.model) if options.model else of_others(recordings, r) for r in recordings}
    for start in options.start or ("truth", "auto", "smooth"):
        logs = []
        for recording in recordings:
            model = models[recording.name]
            one = windows(model, recording, start)
            if len(one[0]):
                print(f"{start:7}{recording.name:18}", told([one]), flush=True)
                logs.append(one)
        print(f"{start:7}{'all':18}", told(logs), flush=True)


def of_others(recordings: list[Recording], left_out: Recording) -> BiasModel:
    """Closed form of all logs but one."""
    from left_out import learned

    return learned([recording for recording in recordings if recording is not left_out], [])


def windows(
    model: BiasModel, recording: Recording, start: str
) -> tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, "m 3 3"]]:
    """Differences of the gyro's rest bias to what the truth says, window by window, and what covariance they should have."""
    imu, seen = recording.imu, Seen.of(recording)
    begun = smooth_in_memory(model, imu, recording.name) if start == "smooth" else find_initial_bias(start, model, recording)
    bias, P, roots = BiasEstimator(model, begun).parts(seen.t_s, imu.gyro, imu.accel)
    S = roots.get("gyro", np.zeros((len(bias), 3, 0)))
    measured = np.diag(measured_variance(model, seen))
    errors, covariances = [], []
    from_s = float(seen.t_s[np.argmax(seen.trusted)])
    if start == "truth":  # what it was found from proves nothing
        from_s += TRUTH_S
    while from_s + TRUTH_S <= seen.t_s[-1]:
        if rows := seen.window(from_s, TRUTH_S):
            T = seen.slope_of(rows, imu.gyro - bias[:, :3], S)
            errors.append(seen.gyro_offset(rows, bias))
            covariances.append(P[rows, :3, :3].mean(axis=0) + T @ T.T + measured)
        from_s += TRUTH_S
    return np.reshape(errors, (-1, 3)), np.reshape(covariances, (-1, 3, 3))


def measured_variance(model: BiasModel, seen: Seen) -> Float64[np.ndarray, "3"]:
    """Of an offset from a window, by axis; the training logs' where a log is too short to show it."""
    bias = model.stream(model.prior_mean)(seen.t_s, seen.samples[:, :3], seen.samples[:, 3:])
    starts_s = np.arange(seen.t_s[np.argmax(seen.trusted)], seen.t_s[-1] - TRUTH_S / 2, TRUTH_S / 4)  # half overlapping
    half = [seen.gyro_offset(rows, bias) if (rows := seen.window(t, TRUTH_S / 2)) else np.full(3, np.nan) for t in starts_s]
    change = np.reshape(half[2:], (-1, 3)) - np.reshape(half[:-2], (-1, 3))
    change = change[np.isfinite(change).all(axis=1)]
    if not len(change):
        return np.asarray(model.truth_std[:3] ** 2)
    return np.asarray(0.5 * (change**2).mean(axis=0) / 2.0**3)


def told(logs: list[tuple[np.ndarray, np.ndarray]]) -> str:
    """The figures of `support.nees` in a line."""
    e, P = (np.concatenate(parts) for parts in zip(*logs, strict=True))
    found = consistency(e, P)
    bounds = f"95 % bounds {found['nees_lower']:.2f} to {found['nees_upper']:.2f}"
    squares = np.einsum("mi,mij,mj->m", e, np.linalg.inv(P), e)
    covered = " / ".join(f"{100 * (squares <= chi2.ppf(share, 3)).mean():.0f}" for share in SHARES)
    return f"NEES {found['nees_mean']:6.2f}  {bounds}  windows {found['samples']:3.0f}  coverage {covered} %"


if __name__ == "__main__":
    main()
