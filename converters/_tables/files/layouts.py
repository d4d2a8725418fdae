"""Arrays of known data sets."""

from __future__ import annotations

import re

from ..columns.map import Entries, Proposal
from ..text.delimited import Columns
from ..text.names import split_name

RONIN: Entries = {  # HDF5 of the RoNIN data set; what Android has not corrected itself shows the bias
    "time": "synced/time",
    "time_unit": "s",
    "gyro": [f"synced/gyro_uncalib[{axis}]" for axis in range(3)],
    "gyro_unit": "rad/s",
    "accel": [f"synced/acce[{axis}]" for axis in range(3)],
    "accel_unit": "m/s^2",
}
RONIN_POSES: Entries = {  # by the visual-inertial estimate of a second phone
    "position": [f"pose/tango_pos[{axis}]" for axis in range(3)],
    "quaternion_wxyz": [f"pose/tango_ori[{axis}]" for axis in range(4)],
    "pose_kind": "estimate",
}
BLACKBIRD: Entries = {  # HDF5 of Blackbird as github.com/uzh-rpg/learned_inertial_model_odometry prepares it
    "time": "ts",
    "time_unit": "s",
    "gyro": [f"gyro_raw[{axis}]" for axis in range(3)],
    "gyro_unit": "rad/s",
    "accel": [f"accel_raw[{axis}]" for axis in range(3)],
    "accel_unit": "m/s^2",
}
BLACKBIRD_POSES: Entries = {  # by motion capture: x y z qx qy qz qw
    "position": [f"traj_target[{axis}]" for axis in range(3)],
    "quaternion_wxyz": [f"traj_target[{axis}]" for axis in (6, 3, 4, 5)],
    "pose_kind": "truth",
}
KALIBR = {"omega_[xyz]": "rad/s", "alpha_[xyz]": "m/s^2"}  # names of rates and accelerations
COLUMN_ENTRIES = "time", "gyro", "accel", "position", "quaternion_wxyz"
LAYOUTS: list[tuple[str, Entries, Entries]] = [  # what is said of the data set, its IMU, and its poses if there
    ("its arrays are those of RoNIN", RONIN, RONIN_POSES),
    (
        "its arrays are those of RoNIN, with rates that Android has corrected",
        {**RONIN, "gyro": [f"synced/gyro[{axis}]" for axis in range(3)]},
        RONIN_POSES,
    ),
    ("its arrays are those of Blackbird for learned inertial odometry", {**BLACKBIRD, **BLACKBIRD_POSES}, {}),
]


def state_units(columns: Columns) -> None:
    """Enter the units of a table for `kalibr_bagcreater`, whose header names none."""
    units = {c: unit for c in columns.values for name, unit in KALIBR.items() if re.fullmatch(name, split_name(c)[0])}
    if len(units) == 6 and not any(columns.units.get(column) for column in units):
        columns.units |= units


def known_layout(columns: Columns) -> Proposal | None:
    """Map of the first data set whose arrays are there."""
    for reason, imu, poses in LAYOUTS:
        if _columns_of(imu) <= columns.values.keys():
            known = poses if _columns_of(poses) <= columns.values.keys() else {}
            return Proposal({**imu, **known}, [], [reason])
    return None


def _columns_of(entries: Entries) -> set[str]:
    """Columns that a map names."""
    parts = [[value] if isinstance(value, str) else value for name, value in entries.items() if name in COLUMN_ENTRIES]
    return {column for part in parts for column in part}
