"""Unit of a table's gyro by motion, and gravity in its accelerations."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.errors import DataError
from imutool.recording.joined_imu import joined, steady_force, unit_by_gravity

from ..text.delimited import Columns
from ..text.names import spaced_name, split_name
from .map import Proposal, TableMap
from .pose_names import axes_of
from .units import ACCEL_SI, GYRO_SI, STANDARD_GRAVITY, TIME_NS, gravity_units, is_motion_alone

MIN_GRAVITY = 0.5  # m/s^2; a median below it is that of motion alone
STEADY_BAND = 0.3  # share by which the steady part of the acceleration may differ from gravity
DECIDING_BAND = 0.15  # the same, where it decides the unit
NO_GRAVITY = r"(user|free)_?acc"  # in names of accelerations without gravity
WITH_GRAVITY = r"(^|_)(raw|specific_?force)(_|$)"
CORE_MOTION = {  # names of `CMDeviceMotion` on iOS and watchOS, as several programs write them
    "rotation rate": r"(.*_)?rotation_?rate_?(?P<axis>[xyz])",
    "gravity": r"(.*_)?(motion_?)?gravity_?(?P<axis>[xyz])",
    "acceleration": r"(.*_)?(motion_?)?((user_?)?acceleration|user_?acc)_?(?P<axis>[xyz])",
}
APPLE = r"(?i)(?<![a-z])(iphone|ipad|ios|apple_?watch|watchos)(?![a-z])"  # in the name of a file or its folder
UNIT_BAND = 0.02  # of the length of a gravity in g


def add_gravity(columns: Columns) -> None:
    """Add the specific force to a table of CoreMotion, whose acceleration has no gravity.

    Gravity has columns of its own. Both read -1 g along the axis that points up.
    """
    names = {split_name(column)[0]: column for column in columns.values}
    rate, gravity, motion = (axes_of(form, names, "xyz") for form in CORE_MOTION.values())
    if not (rate and gravity and motion) or len({len(columns.values[column]) for column in (*gravity, *motion)}) > 1:
        return
    values = columns.side_by_side(gravity)
    length = np.linalg.norm(values[np.isfinite(values).all(axis=1)], axis=1)
    if not len(length) or np.abs(np.quantile(length, [0.05, 0.95]) - 1.0).max() > UNIT_BAND:
        return
    force = -(values + columns.side_by_side(motion))
    for axis, each, own in zip("xyz", force.T, motion, strict=True):
        columns.values[f"specific_force_{axis} [g]"] = each
        if not re.search(NO_GRAVITY, spaced_name(own)):  # no second accelerometer
            columns.values[f"user_{own}"] = columns.values.pop(own)
    note = f"{motion[0]}/y/z and {gravity[0]}/y/z are of CoreMotion, which takes gravity out and reads -1 g upwards"
    columns.remarks.notes.append(f"{note}: the specific force is minus their sum")


def sign_doubts(path: Path, table: TableMap) -> list[str]:
    """Doubt about the sign of an accelerometer in g, where the path names a device of Apple."""
    named = re.search(APPLE, path.name) or re.search(APPLE, path.resolve().parent.name)
    if named is None or table.accel_unit != "g" or table.accel[0].startswith("-"):
        return []
    what = f"{named[0]!r} in its path may mean CoreMotion, which reads -1 g along the axis that points up"
    return [f"{table.topic}: {what}: its sign stays, and --map accel={','.join(f'-{c}' for c in table.accel)} turns it"]


def doubt_gravity(proposal: Proposal, columns: Columns) -> None:
    """Ask about an acceleration that by its name, size or directions lacks gravity."""
    if "accel" not in proposal.entries or not (unit := str(proposal.entries.get("accel_unit", ""))):
        return
    chosen = [columns.unsigned(column) for column in proposal.entries["accel"]]
    name, (level, _) = spaced_name(chosen[0]), gravity_units(columns, chosen)
    note = f"the median acceleration of {chosen[0]!r} is {level:.3g} {unit}"
    if re.search(NO_GRAVITY, name):
        proposal.reasons.append(f"{note}, and by its name gravity was taken out")
    elif level * ACCEL_SI[unit] < MIN_GRAVITY:
        proposal.reasons.append(f"{note}, much less than gravity: it was taken out, or the unit is another")
    elif is_motion_alone(columns, chosen) and not re.search(WITH_GRAVITY, name) and not _keeps_gravity(proposal, columns):
        why = "it often is much smaller, and all cancel out"
        proposal.reasons.append(f"{note}, {why}: gravity was taken out, or the body turned upside down and back")
    else:
        return
    proposal.open.append("accel")


def _keeps_gravity(proposal: Proposal, columns: Columns) -> bool:
    """Whether the accelerations have a steady part of gravity's size, after the gyro's turns are taken out."""
    needed = {"time", "time_unit", "gyro", "gyro_unit", "accel", "accel_unit"}
    if not needed <= proposal.entries.keys() or needed & {*proposal.open}:
        return False
    rows = _rows(proposal, columns)
    if rows is None:
        return False
    t_ns, gyro, accel = rows
    sizes = GYRO_SI[str(proposal.entries["gyro_unit"])], ACCEL_SI[str(proposal.entries["accel_unit"])]
    steady = steady_force(t_ns, gyro * sizes[0], accel * sizes[1])
    return steady is not None and abs(steady / STANDARD_GRAVITY - 1.0) < STEADY_BAND


def settle_accel_unit(proposal: Proposal, columns: Columns) -> None:
    """Enter the accelerometer's unit, if open, in which its steady part is gravity.

    A body that moves fast has a median far from gravity, and one that turns over has directions that cancel out.
    """
    needed = {"time", "time_unit", "gyro", "gyro_unit", "accel"}
    if proposal.open != ["accel_unit"] or not needed <= proposal.entries.keys():
        return
    if (rows := _rows(proposal, columns)) is None:
        return
    t_ns, gyro, accel = rows
    steady = steady_force(t_ns, gyro * GYRO_SI[str(proposal.entries["gyro_unit"])], accel)
    near = [
        unit
        for unit, size in ACCEL_SI.items()
        if steady is not None and abs(steady * size / STANDARD_GRAVITY - 1.0) < DECIDING_BAND
    ]
    if len(near) == 1:
        reason = f"with the gyro's turns taken out, the acceleration has a steady part of {steady:.4g}: gravity in {near[0]}"
        proposal.settle_unit("accel", near[0], reason)


def unit_by_motion(proposal: Proposal, columns: Columns) -> tuple[str, str] | None:
    """Unit with which gravity turns as the gyro says, and the reason."""
    rows = _rows(proposal, columns)
    found = unit_by_gravity(*rows, GYRO_SI) if rows is not None else None
    return found and (found[0], f"gravity turns in the accelerometer as a gyro in {found[0]} says (t = {found[1]:.1f})")


def _rows(
    proposal: Proposal, columns: Columns
) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]] | None:
    """Times since the first sample, rates and accelerations as recorded, in order; None where they are not side by side."""
    t, gyro, accel = (columns.side_by_side(np.atleast_1d(proposal.entries[name])) for name in ("time", "gyro", "accel"))
    if len(gyro) != len(accel) or not np.isfinite(t).all():
        return None
    t_ns = np.rint((t[:, 0] - t[0, 0]) * TIME_NS[str(proposal.entries["time_unit"])]).astype(np.int64)
    try:
        imu = joined(t_ns, gyro, t_ns, accel, "").imu  # rows may hold one of the two
    except DataError:
        return None
    return (imu.t_ns, imu.gyro, imu.accel) if len(imu) else None
