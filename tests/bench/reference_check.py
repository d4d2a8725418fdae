"""How far a recording's true poses can be a witness against its IMU: `python tests/bench/reference_check.py LOG...`.

Poses that an estimator made from the same IMU agree with it whatever its errors; poses with errors of their own make every
scale look too small (regression dilution: with noise n in the expected signal E = f + n, the slope of the readings over E is
var f / var E, and that of E over the readings, turned over, is above the true one by as much as the readings' own noise). The
true scale lies between the two. Compared are turning and specific force between `SLOW_HZ` and `FAST_HZ`, in the longest
stretch that can be differentiated; and by how much readings come before the poses, in windows, scale and misalignment fitted.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.signal import butter, sosfiltfilt
from sensor_tables import markdown

from imutool.diagnosis.estimation.alignment import with_truth
from imutool.diagnosis.estimation.jacobians import expected
from imutool.mcap_io.read import read
from imutool.sensor.trajectory import smooth_motion

SLOW_HZ, FAST_HZ = 0.3, 4.0
END_S = 3.0  # left out at either end, where a filter that runs both ways has not settled
WINDOW_S = 8.0

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


def in_band(x: Signal, rate_hz: float) -> Signal:
    """Between the two frequencies, without the ends."""
    band = butter(4, [SLOW_HZ, FAST_HZ], "band", fs=rate_hz, output="sos")
    end = round(END_S * rate_hz)
    return np.asarray(sosfiltfilt(band, x, axis=0)[end:-end])


def row(log: Path, truth: str | None) -> list[str]:
    """One log's cells."""
    recording = read(log, truth=truth)
    if truth is None:
        recording = recording.with_truth(next(iter(recording.truths)))
    motion = smooth_motion(recording.truth)
    felt = max(motion.ideal_motions(1.0 / recording.imu.period_s), key=lambda one: len(one.t_s))
    pair = with_truth(recording, felt, motion.start_ns, FAST_HZ)
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
    options = parser.parse_args()
    head = ["log", "s", "turning, rms (mrad/s)", "gyro less poses (mrad/s)", "gyro scale x, y, z between (%)"]
    head += ["accel scale x, y, z between (%)", "gyro ahead, first and last third (ms)", "accel ahead (ms)"]
    print(markdown(head, (row(log, options.truth) for log in options.logs)))


if __name__ == "__main__":
    main()
