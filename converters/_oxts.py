"""OXTS of KITTI raw: `oxts/data/*.txt`, 30 numbers a file (the development kit says which)."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from imutool.errors import DataError
from imutool.geometry import quaternion
from imutool.recording import Imu, Poses, Scalars
from imutool.recording.message_log import Remarks
from imutool.recording.sample_order import in_order

OXTS = re.compile(r"(.*/)?oxts/data/\d+\.txt")
TIMES = "oxts/timestamps.txt"
EARTH_M = 6_378_137.0


def read_oxts(
    names: Sequence[str], text: Callable[[str], str], where: Path, remarks: Remarks
) -> tuple[Imu, dict[str, Poses], dict[str, Scalars]]:
    """IMU of OXTS (x forward, y left, z up) and its poses by GNSS and INS (east, north, up).

    Raises:
        DataError: the times are missing, there are not as many as files, or a file holds no numbers.
    """
    times = next((path for path in names if path.endswith(TIMES)), None)
    if times is None:
        raise DataError("is missing", where=f"{where}/{TIMES}", expected="a time for each file of OXTS")
    stamps = [line.strip() for line in text(times).splitlines() if line.strip()]
    paths = sorted(path for path in names if OXTS.fullmatch(path))
    rows = [text(path).split() for path in paths]
    if len(stamps) != len(rows) or any(len(row) < 23 for row in rows):
        raise DataError(f"has {len(stamps)} times and {len(rows)} files", where=where, expected="as many, of 30 numbers each")
    try:
        t_ns = np.array([stamp.replace(" ", "T") for stamp in stamps], "datetime64[ns]").astype(np.int64)
        values = np.array([row[:23] for row in rows], np.float64)
    except (ValueError, OverflowError) as error:
        raise DataError(f"holds no numbers ({error})", where=where) from error
    kept = in_order(t_ns, values, times)
    remarks.notes.extend(kept.notes)
    values = kept.values
    latitude, longitude = np.deg2rad(values[:, 0]), np.deg2rad(values[:, 1])
    scale = EARTH_M * np.cos(latitude[0])
    east, north = scale * longitude, scale * np.log(np.tan(np.pi / 4 + latitude / 2))
    p = np.stack([east - east[0], north - north[0], values[:, 2] - values[0, 2]], axis=1)
    poses = Poses(kept.t_ns, p, quaternion.of_roll_pitch_yaw(values[:, 3:6]))
    remarks.notes.append("/oxts/pose is an estimate of GNSS and this IMU")
    return Imu(kept.t_ns, values[:, 17:20], values[:, 11:14]), {"/oxts/pose": poses}, {}
