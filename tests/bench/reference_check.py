"""How far a recording's true poses can be a witness against its IMU: `python tests/bench/reference_check.py LOG...`.

Poses that an estimator made from the same IMU agree with it whatever its errors; poses with errors of their own make every
scale look too small (regression dilution: with noise n in the expected signal E = f + n, the slope of the readings over E is
var f / var E, and that of E over the readings, turned over, is above the true one by as much as the readings' own noise). The
true scale lies between the two. Compared are turning and specific force between `SLOW_HZ` and `FAST_HZ`, in the longest
stretch that can be differentiated; and by how much readings come before the poses, in windows, scale and misalignment fitted.

--by-frequency asks two things of narrow bands. Do positions come later than orientations? Then the accelerometer leads the
poses' specific force in the world frame: accel - f = tau R^T d(R f)/dt. And does a lever arm depend on the band in which it is
fitted? A rigid one does not; one that grows with the band is an error of the poses.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float64
from scipy.signal import butter, sosfiltfilt
from sensor_tables import markdown

from imutool.diagnosis.diagnose import EVERY_UNIT, candidates_for
from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.gauss_newton import fit
from imutool.diagnosis.estimation.jacobians import expected
from imutool.diagnosis.estimation.noise_estimate import whitened
from imutool.diagnosis.estimation.significance import scatter
from imutool.diagnosis.estimation.time_alignment import with_truth
from imutool.diagnosis.reference.coverage import align, without_unusable
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.mcap_io.read import read
from imutool.recording import Recording
from imutool.sensor.trajectory import smooth_motion

SLOW_HZ, FAST_HZ = 0.3, 4.0
END_S = 3.0  # left out at either end, where a filter that runs both ways has not settled
WINDOW_S = 8.0
LAG_BANDS_HZ = ((0.3, 0.6), (0.6, 1.0), (1.0, 1.5), (1.5, 2.5))
ARM_BANDS_HZ = (3.0, 6.0, 15.0)

Signal = Float64[np.ndarray, "n 3"]


class Slopes(NamedTuple):
    """Of readings over what is expected, by axis: as they are (noise of the latter makes them small), and reversed."""

    forward: Float64[np.ndarray, "3"]
    reverse: Float64[np.ndarray, "3"]


def slopes(there: Signal, real: Signal) -> Slopes:
    """Both slopes, of signals without a mean."""
    both = (there * real).sum(axis=0)
    return Slopes(both / (there**2).sum(axis=0), (real**2).sum(axis=0) / both)


def lags_s(there: Signal, real: Signal, rate_hz: float, window_s: float = WINDOW_S) -> Float64[np.ndarray, " w"]:
    """By how much readings come early (s), in windows: real = M there(t + lag), M a matrix of all windows together."""
    M = np.linalg.lstsq(there, real)[0]
    along = np.gradient(there, axis=0) @ M * rate_hz
    size = round(window_s * rate_hz)
    parts = [slice(k, k + size) for k in range(0, len(there) - size + 1, size)]
    left = real - there @ M
    return np.array([(along[part] * left[part]).sum() / (along[part] ** 2).sum() for part in parts])


def in_band(x: Signal, rate_hz: float, slow_hz: float = SLOW_HZ, fast_hz: float = FAST_HZ) -> Signal:
    """Between the two frequencies, without the ends."""
    band = butter(4, [slow_hz, fast_hz], "band", fs=rate_hz, output="sos")
    end = round(END_S * rate_hz)
    return np.asarray(sosfiltfilt(band, x, axis=0)[end:-end])


def longest_pair(log: Path, truth: str | None) -> tuple[Recording, Pair]:
    """A log, and the longest stretch of it that can be compared with its poses."""
    recording = read(log, truth=truth)
    if truth is None:
        recording = recording.with_truth(next(iter(recording.truths)))
    motion = smooth_motion(recording.truth)
    felt = max(motion.ideal_motions(1.0 / recording.imu.period_s), key=lambda one: len(one.t_s))
    since_s = 1e-9 * (motion.start_ns - int(recording.imu.t_ns[0]))
    return recording, with_truth(recording, replace(felt, t_s=felt.t_s + since_s), FAST_HZ)


def position_lags_s(pair: Pair) -> Iterator[tuple[float, float]]:
    """By how much positions come later than orientations (s), by band, with a deviation from windows."""
    rate_hz, f_b = 1.0 / pair.period_s, expected(pair, ())[:, 3:]
    R_wb = pair.ideal.sample(pair.stamp_s, pair.stamp_s).at.R_wb
    assert R_wb is not None
    f_w = np.einsum("nij,nj->ni", R_wb, f_b)
    along = np.einsum("nji,nj->ni", R_wb, np.gradient(f_w, axis=0) * rate_hz)
    for band in LAG_BANDS_HZ:
        x, y = (in_band(signal, rate_hz, *band) for signal in (along, pair.real[:, 3:] - f_b))
        lag = (x * y).sum() / (x**2).sum()
        score = (x * (y - lag * x)).sum(axis=1)
        windows = np.add.reduceat(score, np.arange(0, len(score), round(WINDOW_S * rate_hz)))
        yield float(lag), float(np.sqrt((windows**2).sum()) / (x**2).sum())


def arms_mm(recording: Recording) -> Iterator[str]:
    """Height of the lever arm as it is fitted up to some frequencies, whatever the poses know, and as far as they do.

    It is fitted next to what every unit has a little of.
    """
    settings = DiagnoseSettings()
    pairs = [*map(without_unusable, align(recording, None, None, settings))]
    candidates, trusting = candidates_for(pairs), msgspec.structs.replace(settings.band, diluted_share=1.0)
    for max_hz, band in (*((hz, trusting) for hz in ARM_BANDS_HZ), (np.inf, settings.band)):
        known = msgspec.structs.replace(settings, band=band)
        limited = [replace(pair, band_hz=min(pair.band_hz or max_hz, max_hz), settings=known) for pair in pairs]
        logs = [whitened(pair, candidates) for pair in limited]
        left_in = (*EVERY_UNIT, "clock_wander", "reference_smoothing")
        chosen = tuple((one, one.null_value.astype(float)) for one in candidates if one.name in left_in)
        found = fit(logs, chosen, part="all")
        arm = dict(zip(found.keys, (theta for _, theta in found.chosen), strict=True))["lever_arm"]
        std = scatter(found).std["lever_arm"]
        reached_hz = max(log.pair.band_hz or 0.0 for log in logs)
        yield f"{1e3 * arm[2]:.1f} ± {1e3 * std[2]:.1f} ({reached_hz:.1f} Hz)"


def row_by_frequency(log: Path, truth: str | None) -> list[str]:
    """One log's cells of the table by frequency."""
    recording, pair = longest_pair(log, truth)
    lags = [f"{1e3 * lag:.1f} ± {1e3 * std:.1f}" for lag, std in position_lags_s(pair)]
    return [log.stem, *lags, *arms_mm(recording)]


def row(log: Path, truth: str | None) -> list[str]:
    """One log's cells."""
    _, pair = longest_pair(log, truth)
    rate_hz = 1.0 / pair.period_s
    there, real = (in_band(x, rate_hz) for x in (expected(pair, ()), pair.real))
    rms = [1e3 * float(np.sqrt((x[:, :3] ** 2).mean())) for x in (there, real - there)]
    cells = [log.stem, f"{pair.stamp_s[-1] - pair.stamp_s[0]:.0f}", f"{rms[0]:.0f}", f"{rms[1]:.2f}"]
    for part in (slice(0, 3), slice(3, 6)):
        told = slopes(there[:, part], real[:, part])
        cells.append(", ".join(f"{100 * (a - 1):+.1f} … {100 * (b - 1):+.1f}" for a, b in zip(*told, strict=True)))
    for part in (slice(0, 3), slice(3, 6)):
        lags = 1e3 * lags_s(there[:, part], real[:, part], rate_hz)
        third = max(1, len(lags) // 3)
        cells.append(f"{np.median(lags[:third]):+.2f}, {np.median(lags[-third:]):+.2f}")
    return cells


def main() -> None:
    """A row a log."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="+")
    parser.add_argument("--truth")
    parser.add_argument("--by-frequency", action="store_true", help="lag of positions and lever arm in narrow bands")
    options = parser.parse_args()
    if options.by_frequency:
        head = ["log", *(f"positions late, {slow:g}–{fast:g} Hz (ms)" for slow, fast in LAG_BANDS_HZ)]
        head += [f"arm z up to {max_hz:g} Hz (mm)" for max_hz in ARM_BANDS_HZ]
        head += ["as diagnosed"]
        print(markdown(head, (row_by_frequency(log, options.truth) for log in options.logs)))
        return
    head = ["log", "s", "turning, rms (mrad/s)", "gyro less poses (mrad/s)", "gyro scale x, y, z between (%)"]
    head += ["accel scale x, y, z between (%)", "gyro ahead, first and last third (ms)", "accel ahead (ms)"]
    print(markdown(head, (row(log, options.truth) for log in options.logs)))


if __name__ == "__main__":
    main()
