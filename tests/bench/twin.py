"""Can a classifier tell a twin's windows from real ones? `python tests/bench/twin.py DIAGNOSIS LOG... [--sheet NAME]`.

DIAGNOSIS is the folder of `imutool diagnose` on other recordings of the sensor; the LOGs were not in it. Along the true poses
of each LOG an IMU is simulated as a twin (physics.toml and noise.toml of the diagnosis), with the physics and a data sheet's
noise, and ideal with a data sheet's noise. Windows of a second are told from the recorded ones by gradient boosted trees on
their mean, size, differences, tails and spectrum, by axis, trained on other blocks of ten seconds. AUC 0.5 is a guess, 1 a
certainty. `--drawn` names the recordings of the diagnosis: what they leave of the physics is drawn again, in pieces of 2 s of
a similar motion, in place of the twin's noise. No model of that noise can be expected to do better along these poses.
Needs scikit-learn, which is no dependency of the project.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.signal import periodogram
from scipy.stats import kurtosis

from imutool.mcap_io.read import read
from imutool.recording import Imu
from imutool.sensor.simulate import simulate

WINDOW_S, BLOCK_S, FOLDS = 1.0, 10.0, 5
PIECE_S, NEAREST = 2.0, 10  # of the noise that is drawn again, and among how many of the most similar motion
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
    from sklearn.ensemble import HistGradientBoostingClassifier
    from sklearn.metrics import roc_auc_score
    from sklearn.model_selection import GroupKFold, cross_val_predict

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


Pieces = list[tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "n 6"]]]  # motion of each, and its noise


def pieces(real: Imu, made: Imu) -> Pieces:
    """What a recording leaves of its noise-free simulation, by motion, in overlapping pieces without a gap."""
    t_ns, expected = made.t_ns, np.concatenate([made.gyro, made.accel], axis=1)
    recorded = np.concatenate([real.gyro, real.accel], axis=1)
    nearest = np.clip(np.searchsorted(real.t_ns, t_ns - int(real.period_s * 5e8)), 0, len(real) - 1)
    at_ns = real.t_ns[nearest].astype(float)
    left = recorded[nearest] - np.stack([np.interp(at_ns, t_ns, column) for column in expected.T], axis=1)
    count, found = round(PIECE_S / made.period_s), []
    for first in range(0, len(left) - count, count // 4):
        rows = slice(first, first + count)
        apart_ns = np.abs(at_ns[rows] - t_ns[rows]).max()
        if t_ns[rows][-1] - t_ns[rows][0] < 1.02e9 * PIECE_S and apart_ns < 1e9 * real.period_s:
            found.append((motion(expected[rows], made.period_s), left[rows]))
    return found


def motion(expected: Float64[np.ndarray, "n 6"], period_s: float) -> Float64[np.ndarray, "2"]:
    """Logarithm of the rms rate of change of gyro and accelerometer."""
    rates = (np.diff(expected, axis=0) / period_s).reshape(-1, 2, 3)
    return np.asarray(0.5 * np.log((rates**2).sum(axis=2).mean(axis=0)))


def drawn(made: Imu, library: Pieces) -> Imu:
    """Noise-free simulation with noise of pieces of a similar motion, faded into each other at constant power."""
    rng, expected = np.random.default_rng(0), np.concatenate([made.gyro, made.accel], axis=1)
    motions, out = np.array([of for of, _ in library]), expected.copy()
    count = len(library[0][1])
    fade = np.sin(np.pi * (np.arange(count) + 0.5) / count)[:, None]
    for first in range(-count // 2, len(out) - 2, count // 2):
        rows = np.arange(max(first, 0), min(first + count, len(out)))
        near = np.argsort(((motions - motion(expected[rows], made.period_s)) ** 2).sum(axis=1))[:NEAREST]
        out[rows] += (fade * library[rng.choice(near)][1])[rows - first]
    return Imu(made.t_ns, out[:, :3], out[:, 3:])


def main() -> None:
    """A line for each log."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("diagnosis", type=Path)
    parser.add_argument("logs", type=Path, nargs="+")
    parser.add_argument("--sheet", default="adis16448")
    parser.add_argument("--drawn", type=Path, nargs="+", default=[])
    options = parser.parse_args()
    physics, noise = options.diagnosis / "physics.toml", options.diagnosis / "noise.toml"
    library = [piece for log in options.drawn for piece in pieces(read(log).imu, simulated(log, physics, "none"))]
    for log in options.logs:
        real = read(log).imu
        makes = {
            "the twin": simulated(log, physics, noise),
            f"physics with {options.sheet}": simulated(log, physics, options.sheet),
            f"{options.sheet} alone": simulated(log, None, options.sheet),
        }
        if library:
            makes["physics with noise drawn again"] = drawn(simulated(log, physics, "none"), library)
        told = []
        for name, made in makes.items():
            begins = windows(real, made)
            told.append(f"{name} {auc(features(real, begins), features(made, begins)):.2f}")
        print(f"{log.stem}: {len(begins)} windows; AUC of {', '.join(told)}", flush=True)


def simulated(log: Path, physics: Path | None, noise: str | Path) -> Imu:
    """IMU along the poses of a log."""
    with tempfile.TemporaryDirectory() as folder:
        return simulate(log, Path(folder) / "made.mcap", physics=physics, noise=noise, seed=1).recording.imu


if __name__ == "__main__":
    main()
