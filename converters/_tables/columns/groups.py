"""Groups of arrays with times of their own: IMUs, poses, further sensors."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import chain

from ..text.delimited import Columns, matrix_columns
from ..text.names import ESTIMATED, TIME_WORDS, group_of, leaf_of, name_and_unit, spaced_name, split_name, triples
from .geodetic import in_their_world
from .map import IMU_TOPIC, POSE_GROUPS, POSES_GROUP, Entries, column_named
from .pose_names import (
    NED,
    NOT_ALIKE,
    NUMBERS,
    POSITIONS,
    QUATERNION,
    TRUE_GROUPS,
    angles_of,
    axes_of,
    bodies_of,
    from_north,
    matrix_of,
    numbered_quaternion,
    pose_leaves,
    position_of,
    without_true,
)
from .rotations import EITHER_WAY, TURNS, angles_by_motion, matrix_by_motion, order_by_motion, seconds_of
from .times import goes_on
from .units import POSITION_SI, TIME_NS, USUAL_TIME_NS

Axes = dict[str, str]  # columns by x, y, z
CALIBRATED = r"(?i)\bcalibrated\b"  # in the name of a group, next to one of raw counts
MAX_CONSTANTS = 16  # values of an array that has no time and is kept as metadata: a bias, a matrix
MIN_OVERLAP = 0.01  # of two spans of time in the same unit; another unit is a factor of 1000 away
MAX_LONGER = 10.0  # is a span of time than another in the same unit


def imus_apart(columns: Columns) -> dict[str, Columns]:
    """Columns without those of other IMUs, by topic; empty unless several pair by name."""
    names = {column: split_name(column)[0] for column in measured(columns)}
    names = {column: name for column, name in names.items() if not re.search(ESTIMATED, name)}
    spaced = {column: spaced_name(column) for column in names}
    gyros, accels = (triples(sensor, names, spaced) for sensor in ("gyro", "accel"))
    paired = _paired(gyros, accels) if len(gyros) > 1 else {}
    of = {owner: {*gyros[owner].values(), *chain(*(accel.values() for accel in each))} for owner, each in paired.items()}
    groups = {owner: group_of(gyros[owner]["x"]) for owner in of}
    separate = {}
    for owner, own in of.items():
        others = {group for group in groups.values() if group and group != groups[owner]}
        beside = {c for c in columns.values if group_of(c) in others and not is_time(c)}  # an orientation of theirs
        taken = set().union(*of.values(), beside, _raw_counts(columns)) - own
        values = {c: v for c, v in columns.values.items() if c not in taken}
        named = owner if owner[:1].isalpha() else f"imu_{owner}"  # a part of a ROS topic begins with a letter
        separate[f"/{named}/imu" if owner else IMU_TOPIC] = replace(columns, values=values)
    return separate


def _paired(gyros: Mapping[str, Axes], accels: Mapping[str, Axes]) -> dict[str, list[Axes]]:
    """Accelerations of each gyro's owner: `leg` has `leg_wide_range`; empty unless every one has some.

    An acceleration of no gyro, in a table of its own, is no part of an IMU.
    """
    of: dict[str, list[Axes]] = {owner: [] for owner in gyros}
    tables = {group_of(gyro["x"]).split("/")[0] for gyro in gyros.values()}
    for name, accel in accels.items():
        near = [owner for owner in gyros if name == owner or name.startswith(f"{owner}_")]
        if near:
            of[max(near, key=len)].append(accel)
        elif group_of(accel["x"]).split("/")[0] in tables:
            return {}
    return of if all(of.values()) else {}


def group_entries(columns: Columns, entries: Entries, reasons: list[str]) -> Entries:
    """Entries for an accelerometer with a time of its own, and for poses on any time.

    Of several groups with poses true ones come first, and then a table of poses. None are taken whose quaternions have no
    certain order, and none of the IMU's own group without positions: an orientation alone is one that the sensor itself
    estimates, unless it is named as that of a motion capture.
    """
    time, unit = str(entries["time"]), str(entries["time_unit"])
    other = time_beside(columns, columns.unsigned(entries["accel"][0]), time, unit, separate=True)
    own = time_beside(columns, columns.unsigned(entries["gyro"][0]), time, unit, separate=True)
    found: Entries = {"accel_time": other[0]} if other is not None and other[1] == unit and other != own else {}
    found |= _position_beside(columns, entries)
    poses = []
    for shared, named_true, leaves in () if entries.keys() & TURNS else _bodies(columns, time, unit):
        clock = (named_true and shared[0] == time and _own_time(columns, leaves, time, unit)) or shared
        bodies = bodies_of(leaves)
        for body in (leaves, *bodies) if position_of(leaves) else (*bodies, leaves):
            position = position_of(body)
            turns = _turns(columns, entries, body, clock, reasons) if position or named_true or clock[0] != time else {}
            if turns:
                break
        if turns:
            poses.append((not named_true, clock, turns, position))
        elif clock[0] != time or named_true or bodies:
            reasons += _why_no_turns(columns, leaves, bodies, _said_apart(columns, clock, (time, unit)))
    for is_estimate, clock, turns, named in sorted(poses, key=lambda p: (p[0], group_of(p[1][0]) != POSES_GROUP, p[1]))[:1]:
        found |= {"truth_time": clock[0], "truth_time_unit": clock[1], **turns}
        found["pose_kind"] = "estimate" if is_estimate else "truth"
        position, why = in_their_world(columns, {**entries, **turns}, named, clock)
        reasons += filter(None, [why])
        if not position:
            continue
        found |= {"position": position, "position_unit": _unit_of(columns, position)}
        if down := position_of({split_name(leaf_of(c))[0]: c for c in position if c in columns.values}, NED):
            found["pose_world"] = "ned"
            reasons.append(f"{', '.join(down)} are north, east and down: the poses are turned to east, north, up")
        elif (yaw := turns.get("roll_pitch_yaw", [""])[-1]).startswith("-"):
            found["position"] = from_north(position) or position
            reasons.append(f"{yaw} is taken as 0 along {found['position'][0]}; else state `position` in a map, as y, -x, z")
    return found


def _bodies(columns: Columns, time: str, unit: str) -> Iterator[tuple[tuple[str, str], bool, dict[str, str]]]:
    """Clock of columns that may be poses, whether they are named as true, and their names; those of each owner apart."""
    groups: dict[tuple[tuple[str, str], bool], dict[str, dict[str, str]]] = {}
    for column, (owner, leaf) in pose_leaves(columns.values).items():
        in_rows = (time, unit) if len(columns.values[column]) == len(columns.values[time]) else None
        beside = time_beside(columns, column, time, unit, separate=True) or in_rows
        if beside is not None:
            name = without_true(leaf)
            groups.setdefault((beside, is_true(column) or name != leaf), {}).setdefault(owner, {})[name] = column
    for (clock, named_true), owners in groups.items():
        plain = owners.pop("", {})
        yield from ((clock, named_true, plain | each) for each in owners.values() or [plain])


def _own_time(columns: Columns, leaves: dict[str, str], time: str, unit: str) -> tuple[str, str] | None:
    """Time of true poses among the columns of the IMU's table, as `truth_t`, and its unit."""
    own = (c for leaf, c in leaves.items() if c != time and re.fullmatch(TIME_WORDS, leaf) and goes_on(columns.values[c]))
    other = next(own, None)
    return _with_unit(columns, other, time, unit, separate=True) if other else None


def turned(columns: Columns, entries: Entries) -> Entries:
    """Entries with the orientations next to a sensor's rates, in place of poses."""
    entries = {name: value for name, value in entries.items() if name not in TURNS}
    group, length = group_of(columns.unsigned(entries["gyro"][0])), len(columns.values[str(entries["time"])])
    beside = [c for c, values in columns.values.items() if group_of(c) == group and len(values) == length]
    leaves = {split_name(column.removeprefix(group))[0]: column for column in beside}
    clock = str(entries["time"]), str(entries["time_unit"])
    found = _turns(columns, entries, leaves, clock, [])
    return entries | (found | {"truth_time": clock[0], "truth_time_unit": clock[1]} if found else {})


def _position_beside(columns: Columns, entries: Entries) -> Entries:
    """Entries of the positions x, y, z in the table of poses of which a map names the rotations alone."""
    named = next((each for name in TURNS if (each := entries.get(name))), "")
    group = group_of(columns.unsigned(matrix_columns(named)[0])) if named and "truth_file" not in entries else ""
    if "position" in entries or not f"{group}/".startswith(POSE_GROUPS):
        return {}
    position = position_of({split_name(leaf_of(c))[0]: c for c in columns.values if group_of(c) == group}, POSITIONS[:1])
    return {"position": position, "position_unit": _unit_of(columns, position)} if position else {}


def _unit_of(columns: Columns, position: list[str]) -> str:
    """Stated unit of positions; else metres."""
    stated = name_and_unit(position[0], columns.units.get(position[0], ""))[1]
    return stated if stated in POSITION_SI else "m"


def pose_clock(columns: Columns, entries: Entries) -> Entries:
    """Entries of the time of rotations named without one: that next to them, or the IMU's.

    Raises:
        ConfigError: a named column does not exist.
    """
    named = [each for name in TURNS if (each := entries.get(name))]
    if not named or entries.get("truth_time") or entries.get("truth_file"):
        return {}
    names = [columns.unsigned(column) for column in matrix_columns(named[0])]
    for column in names:
        column_named(columns, column, "mapping")
    own = str(entries["time"]), str(entries["time_unit"])
    time, unit = time_beside(columns, names[0], *own, separate=True) or own
    return {"truth_time": time, "truth_time_unit": unit}


def _turns(columns: Columns, entries: Entries, leaves: dict[str, str], clock: tuple[str, str], reasons: list[str]) -> Entries:
    """Entries of the rotations of a group: quaternions, or angles that turn as the gyro does."""
    arrays = {m[1][int(m[2])]: c for leaf, c in leaves.items() if (m := re.fullmatch(r".*(wxyz|xyzw)_([0-3])", leaf))}
    q = [arrays[axis] for axis in "wxyz"] if len(arrays) == 4 else axes_of(QUATERNION, leaves, "wxyz")
    nine = matrix_of(leaves)
    if not q and not nine and (four := numbered_quaternion(leaves)):
        q, order = order_by_motion(columns, entries, four, clock)
        if q:
            reasons.append(f"{', '.join(four)} turn as the gyro does in the order {order}")
    if q:
        return {"quaternion_wxyz": q}
    if nine:
        rows, is_shown = matrix_by_motion(columns, entries, nine, clock)
        if rows and (is_shown or nine != matrix_of(leaves, NUMBERS)):  # the order of numbers is no convention
            way = "" if rows == nine else ", transposed"
            reasons.append(f"the matrices {nine[0]}, ... turn as the gyro does{way}{'' if is_shown else EITHER_WAY}")
            return {"rotation_matrix": rows}
    if found := next(filter(None, (angles_by_motion(columns, entries, three, clock) for three in angles_of(leaves))), {}):
        reasons.append(f"{', '.join(found['roll_pitch_yaw'])} turn as the gyro does, as roll, pitch and yaw")
    return found


def _said_apart(columns: Columns, clock: tuple[str, str], own: tuple[str, str]) -> str:
    """Why turns cannot be compared, where the clock of rotations shares no time with the IMU's; else empty."""
    (first, last), (start, end) = (seconds_of(columns, each)[[0, -1]] for each in (own, clock))
    return ": their clocks share no time" if start > last or end < first else ""


def _why_no_turns(columns: Columns, leaves: dict[str, str], bodies: list[dict[str, str]], reason: str) -> list[str]:
    """Reasons why the rotations of a group make no poses."""
    array = next((c[:-3] for c in leaves.values() if c.endswith("[3]") and f"{c[:-3]}[4]" not in columns.values), "")
    named = [array] if array else next(filter(None, map(numbered_quaternion, bodies)), [])
    if named:
        return [f"{', '.join(named)} has four columns of no certain order; `quaternion_wxyz` of a map makes poses of them"]
    if nine := matrix_of(leaves):
        text = f"{NOT_ALIKE}, nor do their transposes{reason}"
        return [f"the matrices {nine[0]}, ... {text}; `rotation_matrix` of a map, row by row, makes poses of them"]
    if three := next(iter(angles_of(leaves)), []):
        text = f"{NOT_ALIKE}, as Rz(yaw) Ry(pitch) Rx(roll){reason}"
        return [f"{', '.join(three)} {text}; `roll_pitch_yaw` of a map makes poses of them"]
    return []


def time_beside(columns: Columns, column: str, time: str, unit: str, *, separate: bool = False) -> tuple[str, str] | None:
    """Time in the group of a column or in one around it, if not the IMU's, and its unit."""
    length = len(columns.values[column])
    if "/" not in column and not columns.has_structures and length == len(columns.values[time]):
        return None
    group, found = group_of(column), list[str]()
    while group and not found:
        long = {c: group_of(c) for c, values in columns.values.items() if len(values) == length}
        headers = [f"{group}/header", f"{group}.header"]  # of ROS, whose stamps count before the time of the recorder
        rising = [c for each in (*headers, group) for c, of in long.items() if of == each and goes_on(columns.values[c])]
        longer = rf"(.*_)?{TIME_WORDS}|time_?stamp_.*"  # imuTimestamp, timestamp_global
        found = list(filter(is_time, rising)) or [c for c in rising if re.fullmatch(longer, spaced_name(leaf_of(c)))]
        group = group_of(group)
    if not found or time in found:
        return None
    together = (_with_unit(columns, each, time, unit, separate=False) for each in found)
    return next(filter(None, together), None) or _with_unit(columns, found[0], time, unit, separate=separate)


def _with_unit(columns: Columns, other: str, time: str, unit: str, *, separate: bool) -> tuple[str, str] | None:
    """A time next to the IMU's, and its unit.

    A unit that is not stated is the one in which it covers the IMU's time best; of a clock `separate` from the IMU's the one in
    which it lasts about as long.
    """
    stated = name_and_unit(other, columns.units.get(other, ""))[1]
    if stated in TIME_NS:
        return other, stated
    first, last = columns.values[time][[0, -1]].astype(float) * TIME_NS[unit]
    overlap, longer = {}, {}
    for each, size in USUAL_TIME_NS.items():
        start, end = columns.values[other][[0, -1]].astype(float) * size
        overlap[each] = (min(end, last) - max(start, first)) / (max(end, last) - min(start, first))
        longer[each] = max((end - start) / (last - first), (last - first) / (end - start))
    best, alike = max(overlap, key=lambda each: overlap[each]), min(longer, key=lambda each: longer[each])
    if overlap[best] > MIN_OVERLAP:
        return other, best
    return (other, alike) if separate and longer[alike] < MAX_LONGER else None


def is_time(column: str) -> bool:
    """Whether a column is named as a time."""
    return re.fullmatch(TIME_WORDS, split_name(column.removeprefix(group_of(column)))[0]) is not None


def measured(columns: Columns) -> list[str]:
    """Columns that may be a sensor's.

    Poses that are true are none, nor are parameters, which are shorter, and raw counts next to calibrated values.
    """
    longest = max(map(len, columns.values.values()), default=0)
    long = [c for c, values in columns.values.items() if len(values) > MAX_CONSTANTS or longest <= MAX_CONSTANTS]
    counts = _raw_counts(columns)
    return [column for column in long if not is_true(column) and column not in counts]


def _raw_counts(columns: Columns) -> set[str]:
    """Columns of a group `Raw` next to one `Calibrated`."""
    calibrated = {re.sub(CALIBRATED, "raw", group_of(c)).lower() for c in columns.values if re.search(CALIBRATED, group_of(c))}
    return {column for column in columns.values if calibrated and group_of(column).lower() in calibrated}


def is_true(column: str) -> bool:
    """Whether a column is in a group of true poses."""
    return any(re.fullmatch(TRUE_GROUPS, part.lower()) for part in re.split(r"[/.]", group_of(column)))


def shared_group(time: str, column: str) -> int:
    """Depth of a time's group, if a column is in it; -1 otherwise."""
    around, own = ([part for part in re.split(r"[/.]", group_of(each)) if part] for each in (time, column))
    return len(around) if own[: len(around)] == around else -1
