"""The sensor.yaml of an exported IMU: its rate and its noise."""

from __future__ import annotations

import json

import numpy as np

from imutool.mcap_io.storage.target import SIGNATURE
from imutool.noise import datasheet
from imutool.noise.datasheet import Noise
from imutool.recording import Recording

DEFAULT_SHEET = "adis16448"  # EuRoC's own
DENSITIES = {
    "gyroscope_noise_density": ("gyro_density", "rad/s/sqrt(Hz)"),
    "gyroscope_random_walk": ("gyro_walk", "rad/s^2/sqrt(Hz)"),
    "accelerometer_noise_density": ("accel_density", "m/s^2/sqrt(Hz)"),
    "accelerometer_random_walk": ("accel_walk", "m/s^3/sqrt(Hz)"),
}
IDENTITY = "  cols: 4\n  rows: 4\n  data: [1.0, 0.0, 0.0, 0.0,\n" + (
    "         0.0, 1.0, 0.0, 0.0,\n         0.0, 0.0, 1.0, 0.0,\n         0.0, 0.0, 0.0, 1.0]\n"
)


def imu_yaml(recording: Recording, kept: str, rate_hz: float, given: Noise | None) -> str:
    """The source's sensor.yaml, `kept`, unless noise is given; else a data sheet's figures."""
    note = f"{SIGNATURE} from {_line(recording.name)}, topic {_line(recording.imu_topic)}\n"
    if kept and given is None:
        directive, rest = (kept + "\n").split("\n", 1) if kept.startswith("%") else ("", kept)  # %YAML must come first
        return f"{directive}\n{note}{rest}" if directive else note + kept
    named = recording.metadata.get("imutool", {}).get("sensor", "").lower()
    sheet = given or datasheet.SHEETS[named if named in datasheet.SHEETS else DEFAULT_SHEET]
    lines = [note + "sensor_type: imu", f"comment: {json.dumps(named or 'unknown')}", "T_BS:", IDENTITY.rstrip("\n")]
    lines.append(f"rate_hz: {rate_hz:.6g}")
    if given is None:
        why = f"there is none of {_line(named)}" if named else "the log does not name its sensor"
        origin = f"the sensor's, {named}" if named in datasheet.SHEETS else f"{DEFAULT_SHEET}'s, as {why}"
        lines.append(f"# Noise: defaults of a data sheet ({origin}), not measured on this sensor")
    for key, (quantity, unit) in DENSITIES.items():
        axes = sheet.values(quantity)
        known = axes[np.isfinite(axes)]
        if len(known):
            source = sheet.sources.get(quantity, "")
            value = float(np.sqrt(np.mean(known**2)))
            lines.append(f"{key}: {value!r}  # [{unit}] {_line(source)}".rstrip())
        else:
            lines.append(f"# {key} is not known")
    return "\n".join([*lines, ""])


def _line(text: str) -> str:
    """Text that stays in its line, also of a file others parse."""
    return "".join(c if c.isprintable() else " " for c in text)
