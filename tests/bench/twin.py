"""Can a classifier tell a twin's windows from real ones? `python tests/bench/twin.py DIAGNOSIS LOG... [--sheet NAME]`.

DIAGNOSIS is the folder of `imutool diagnose` on other recordings of the sensor; the LOGs were not in it. Along the true poses
of each LOG an IMU is simulated as a twin (physics.toml and noise.toml of the diagnosis), with the physics and a data sheet's
noise, and ideal with a data sheet's noise. Windows of a second are told from the recorded ones by gradient boosted trees on
their mean, size, differences, tails and spectrum, by axis, trained on other blocks of ten seconds. AUC 0.5 is a guess, 1 a
certainty. Needs scikit-learn, which is no dependency of the project.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.signal import periodogram
from scipy.stats import kurtosis
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.metrics import roc_auc_score
from sklearn.model_selection import GroupKFold, cross_val_predict

from imutool.mcap_io.read import read
from imutool.recording import Imu
from imutool.sensor.simulate import simulate

WINDOW_S, BLOCK_S, FOLDS = 1.0, 10.0, 5
EDGES = (0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.01)  # of the spectrum's bands, over Nyquist


def features(imu: Imu, begins_ns: Float64[np.ndarray, " w"]) -> Float64[np.ndarray, "w f"]:
    """Numbers of each window."""
    samples = np.concatenate([imu.gyro, imu.accel], axis=1)
    count, rows = round(WINDOW_S / imu.period_s), []
    for first in np.searchsorted(imu.t_ns, begins_ns):
        x = samples[first : first + count]
        f_hz, power = periodogram(x, 1.0 / imu.period_s, "hann", axis=0)
        band = np.digitize(f_hz / f_hz[-1], EDGES) - 1
        powers = [power[band == k].sum(axis=0) for k in range(len(EDGES) - 1)]
        difference = np.diff(x, axis=0)
        parts = [x.mean(axis=0), *np.log([x.std(axis=0), difference.std(axis=0), *powers]), kurtosis(difference, axis=0)]
        rows.append(np.concatenate(parts))
    return np.array(rows)


def auc(real: Float64[np.ndarray, "w f"], made: Float64[np.ndarray, "w f"]) -> float:
    """Area under the curve on blocks that were not trained on."""
    blocks = np.arange(len(real)) // round(BLOCK_S / WINDOW_S)
    x, y, groups = np.concatenate([real, made]), np.repeat([0, 1], len(real)), np.tile(blocks, 2)
    model = HistGradientBoostingClassifier(max_iter=100, random_state=0)
    scores = cross_val_predict(model, x, y, groups=groups, cv=GroupKFold(FOLDS), method="predict_proba")[:, 1]
    return float(roc_auc_score(y, scores))


def windows(real: Imu, made: Imu) -> Float64[np.ndarray, " w"]:
    """Beginnings of the windows that both have without a gap."""
    window_ns = int(WINDOW_S * 1e9)
    begins = np.arange(max(real.t_ns[0], made.t_ns[0]), min(real.t_ns[-1], made.t_ns[-1]) - 2 * window_ns, window_ns)
    whole = np.ones(len(begins), bool)
    for imu in (real, made):
        counts = np.searchsorted(imu.t_ns, begins + window_ns) - np.searchsorted(imu.t_ns, begins)
        whole &= counts > 0.98 * WINDOW_S / imu.period_s
    return begins[whole].astype(float)


def main() -> None:
    """A line for each log."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("diagnosis", type=Path)
    parser.add_argument("logs", type=Path, nargs="+")
    parser.add_argument("--sheet", default="adis16448")
    options = parser.parse_args()
    physics, noise = options.diagnosis / "physics.toml", options.diagnosis / "noise.toml"
    for log in options.logs:
        real, told = read(log).imu, []
        with tempfile.TemporaryDirectory() as folder:
            for k, (with_physics, with_noise) in enumerate(((physics, noise), (physics, options.sheet), (None, options.sheet))):
                made = simulate(log, Path(folder) / f"{k}.mcap", physics=with_physics, noise=with_noise, seed=1).recording.imu
                begins = windows(real, made)
                told.append(auc(features(real, begins), features(made, begins)))
        twin, half, sheet = told
        print(f"{log.stem}: {len(begins)} windows; AUC of the twin {twin:.2f}, physics with {options.sheet} {half:.2f}, "
              f"{options.sheet} alone {sheet:.2f}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
