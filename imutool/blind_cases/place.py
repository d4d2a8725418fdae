"""Where a concealed misfit can be seen: which columns, which seconds; clearly, doubtfully, not at all."""

from __future__ import annotations

from typing import Any

import numpy as np

from imutool.blind_cases.effects import ACCEL, AXES, GYRO, Six, Theta
from imutool.blind_cases.scene import RATE_HZ

WINDOW_S = 1.0
CLEAR, NONE = 30.0, 5.0  # squared misfit over the noise in a window, or a column
SMALL_AXIS = (0.05, 0.01)  # of the strongest column: at least, at most
CONTRAST = 0.1  # of the windows show nothing, or the misfit has no place in time
MARKS = ".?#"  # nothing to be seen, doubtful, clear


def place(misfit: Six, sigma: Theta) -> dict[str, Any]:
    """By signal: a mark for each second and for each axis, and whether the misfit has a place in time at all.

    `misfit`: real less simulated without any noise, at 200 Hz; `sigma`: the standard deviation of its noise, by column.
    """
    misfit = (misfit - np.median(misfit, axis=0)) / sigma  # the mean would be wrong wherever an effect is at work rarely
    per_window = round(WINDOW_S * RATE_HZ)
    count = len(misfit) // per_window
    windows = np.sum(misfit[: count * per_window].reshape(count, per_window, 6) ** 2, axis=1)
    columns = np.sum(misfit**2, axis=0)
    floor = np.maximum(np.array([NONE, CLEAR]), np.array(SMALL_AXIS)[::-1] * columns.max())
    found: dict[str, Any] = {"window_s": WINDOW_S}
    for name, part in (("gyro", GYRO), ("accel", ACCEL)):
        seconds = _marks(windows[:, part].sum(axis=1), NONE, CLEAR)
        axes = dict(zip(AXES, _marks(columns[part], float(floor[0]), float(floor[1])), strict=True))
        localised = "#" in seconds and seconds.count(".") >= CONTRAST * count
        found[name] = {"seconds": seconds, "axes": axes, "localised": localised}
    return found


def achievable(misfit: Six, sigma: Theta) -> dict[str, Any]:
    """By signal, the root mean square over samples and axes of real less simulated, bias removed: as it is, and the noise's."""
    misfit = misfit - misfit.mean(axis=0)
    found = {}
    for name, part in (("gyro", GYRO), ("accel", ACCEL)):
        noise = float(np.mean(sigma[part] ** 2))
        before = float(np.sqrt(np.mean(misfit[:, part] ** 2) + noise))
        found[name] = {"rms_before": before, "rms_after": float(np.sqrt(noise))}
    return found


def _marks(energy: np.ndarray, none: float, clear: float) -> str:
    return "".join(MARKS[(value >= none) + (value >= clear)] for value in energy.tolist())
