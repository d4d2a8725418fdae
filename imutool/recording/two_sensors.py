"""IMU from two sensors: on the gyro's stamps, the accelerometer interpolated."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64, Int64

from imutool.errors import DataError
from imutool.recording import Imu
from imutool.recording.sensor_delay import sensor_delay

SHOWN_STDS = 3.0  # standard deviations from which on a delay is told from none
MAX_GAP_PERIODS = 4.0  # of the accelerometer, across which nothing is interpolated


@dataclass
class Cleaned:
    """Samples in time order without repeated stamps and without values that are not finite."""

    t_ns: Int64[np.ndarray, " n"]
    values: Float64[np.ndarray, "n k"]
    notes: list[str] = field(default_factory=list)


def in_order(t_ns: Int64[np.ndarray, " n"], values: Float64[np.ndarray, "n k"], name: str) -> Cleaned:
    """Samples whose stamps increase; notes say how many were left out, and why."""
    finite = np.isfinite(values).all(axis=1)
    later = np.maximum.accumulate(t_ns) if len(t_ns) else t_ns
    fresh = np.concatenate([[True], t_ns[1:] > later[:-1]]) if len(t_ns) else np.zeros(0, bool)
    notes = []
    if not finite.all():
        notes.append(f"{name}: {int((~finite).sum())} samples that are not finite are left out of the IMU")
    if (finite & ~fresh).any():
        notes.append(f"{name}: {int((finite & ~fresh).sum())} samples whose stamp repeats or goes back are left out of the IMU")
    keep = finite & fresh
    return Cleaned(t_ns[keep], values[keep], notes)


def joined(
    gyro_ns: Int64[np.ndarray, " n"],
    gyro: Float64[np.ndarray, "n 3"],
    accel_ns: Int64[np.ndarray, " m"],
    accel: Float64[np.ndarray, "m 3"],
    name: str,
) -> tuple[Imu, list[str]]:
    """IMU on the gyro's stamps, with notes on what was interpolated and left out.

    Raises:
        DataError: the two sensors share no time.
    """
    rates, forces = in_order(gyro_ns, gyro, f"{name} gyro"), in_order(accel_ns, accel, f"{name} accel")
    notes = rates.notes + forces.notes
    if np.array_equal(rates.t_ns, forces.t_ns):
        return Imu(rates.t_ns, rates.values, forces.values), notes
    if len(rates.t_ns) < 2 or len(forces.t_ns) < 2 or rates.t_ns[0] >= forces.t_ns[-1] or rates.t_ns[-1] <= forces.t_ns[0]:
        raise DataError("gyro and accelerometer share no time", where=name, expected="two sensors that run together")
    after = np.clip(np.searchsorted(forces.t_ns, rates.t_ns), 1, len(forces.t_ns) - 1)
    periods = np.diff(forces.t_ns)
    limit = MAX_GAP_PERIODS * float(np.median(periods))
    inside = (rates.t_ns >= forces.t_ns[0]) & (rates.t_ns <= forces.t_ns[-1]) & (periods[after - 1] <= limit)
    start = forces.t_ns[0]
    t, knots = (rates.t_ns[inside] - start).astype(float), (forces.t_ns - start).astype(float)
    accel_there = np.stack([np.interp(t, knots, column) for column in forces.values.T], axis=1)
    rate_hz = [1e9 / float(np.median(np.diff(c.t_ns))) for c in (rates, forces)]
    notes.append(
        f"{name}: gyro at {rate_hz[0]:.1f} Hz and accelerometer at {rate_hz[1]:.1f} Hz became one IMU on the gyro's stamps, "
        f"the accelerometer interpolated; {_delay_sentence(rates, forces)}"
    )
    if not inside.all():
        notes.append(f"{name}: {int((~inside).sum())} gyro samples have no accelerometer sample near them")
    return Imu(rates.t_ns[inside], rates.values[inside], accel_there), notes


def _delay_sentence(rates: Cleaned, forces: Cleaned) -> str:
    """Delay between the sensors, as the motion shows it."""
    delay = sensor_delay(rates.t_ns, rates.values, forces.t_ns, forces.values)
    if delay is None:
        return "the motion does not show the delay between them"
    if abs(delay.seconds) < SHOWN_STDS * delay.std_s:
        return f"the motion shows no delay between them ({1e3 * delay.seconds:+.1f} ± {1e3 * delay.std_s:.1f} ms)"
    side = "later" if delay.seconds > 0 else "earlier"
    size = f"{abs(delay.seconds) * 1e3:.1f} ms {side} than the gyro's (standard deviation {delay.std_s * 1e3:.1f} ms)"
    return f"by the motion the accelerometer's stamps are {size}, which is not corrected"
