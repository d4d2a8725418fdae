"""Export a log as a EuRoC (ASL) folder, or as a rosbag2 folder around a copy.

Both are folders that appear whole or not at all. The log stays as it is.
"""

from __future__ import annotations

import difflib
from pathlib import Path

from imutool.errors import ConfigError
from imutool.exporting import euroc, rosbag2
from imutool.exporting.folder import ExportReport, Progress

FORMATS = ("euroc", "rosbag2")


def export(
    log: Path,
    out: Path,
    *,
    format: str,
    imu: str | None = None,
    sensor_noise: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> ExportReport:
    """Writes the folder `out` in one of `FORMATS`.

    `imu` is the topic that goes into a EuRoC folder: by default the debiased one, else the only raw one. `sensor_noise` is
    a data sheet or a TOML file (`imutool.noise.datasheet.read`) for its `sensor.yaml`. With `overwrite` an earlier export of
    the same
    format is replaced; any other folder is refused all the same.

    Raises:
        ConfigError: unknown format, an option that says nothing for it, a target that exists or cannot be written.
        LogError: the log is damaged, or holds what the format cannot.
    """
    if format not in FORMATS:
        near = difflib.get_close_matches(format, FORMATS, n=1)
        raise ConfigError(
            f"unknown format {format!r}",
            where="format",
            expected=" or ".join(FORMATS),
            fix=f"Did you mean {near[0]}?" if near else "",
        )
    tell: Progress = progress or (lambda done, total, word: None)
    if format == "euroc":
        return euroc.write(log, out, imu, sensor_noise, overwrite, tell)
    if imu is not None or sensor_noise is not None:
        raise ConfigError("a rosbag2 folder holds the whole log", where="imu, sensor_noise", fix="Leave them out")
    return rosbag2.write(log, out, overwrite, tell)
