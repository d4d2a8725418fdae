"""Names of columns that are poses: quaternions, matrices, angles, positions."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from imutool.array_types import Float64
from imutool.geometry import quaternion

from ..text.delimited import Columns, matrix_columns
from ..text.names import DIGITS, TIME_WORDS, group_of, leaf_of, split_name
from .geodetic import EASTING, LOCAL
from .map import TableMap, vectors_named
from .rotations import of_matrices
from .units import ANGLE_SI

TRUE_GROUPS = (
    r"(data_?)?(mocap|motion_?capture|vicon|opti_?track|opt|optical|omc|qualisys|leica|ground_?truth|truth|gt)(_?data)?\d*"
)
TRUE_BEHIND = r"((?<=^q)|_)(mocap|vicon|opti_?track|omc|qualisys|leica|ground_?truth|truth|true|gt)(_?ref(erence)?)?(?=_|$)"
FRAMES = r"(_[a-z]{2})?"  # of a rotation or a position, as in q_wb, R_wb, p_wb
ROTATION = rf"(q|quats?|quaternions?|orient|orientations?|rotations?|attitudes?|ori|rot){FRAMES}_?"
QUATERNION = rf"{ROTATION}(?P<axis>[wxyz])"
QUATERNION_ARRAY = rf"(.*_)?{ROTATION}(?P<axis>[0-4])"  # from 0, or as MATLAB counts
COMMANDED = r"(.*_)?(des|desired|sp|set_?point|cmd|command|target|ref|reference|demand|err|error)_"
ANGLES = (
    (rf"(?!{COMMANDED})(.*_)?(?P<axis>roll|pitch|yaw)(_?angle)?(_?(deg|rad)[a-z]*)?", ("roll", "pitch", "yaw")),
    (r"(.*_)?(euler|rpy|angles?)_?(angles?_?)?(?P<axis>[xyz012])(_?(deg|rad)[a-z]*)?", "xyz"),
)
GREEK = {"phi": "roll", "theta": "pitch", "psi": "yaw"}
HEADING = r"((compass|true|magnetic)_)?(heading|hdg|azimuth|azi)"  # a yaw
POSITION = r"((t|p|(processed_?)?pos|positions?|translations?|trans|[pr]_[a-z]{2}(_[a-z]{1,2})?)_?)?(?P<axis>[xyz012])"
POSITIONS: tuple[tuple[str, Sequence[str]], ...] = (
    (POSITION, "xyz"),
    (r"(p(os(ition)?)?_?)?(?P<axis>east|north|up)", ("east", "north", "up")),
    (rf"(p(os(ition)?)?_?|{LOCAL})?(?P<axis>north|east|down)", ("north", "east", "down")),
    (r"p(os(ition)?)?_?(?P<axis>[ned])", "ned"),
    (r"(p(os(ition)?)?_?)?ned_?(?P<axis>[xyz])", "xyz"),
    (r"(p(os(ition)?)?_?)?(?P<axis>[xyz])_?ned", "xyz"),
    *((rf"(?P<axis>{EASTING}|northing|{up})", (EASTING, "northing", up)) for up in ("height", "altitude", "up")),
)
NED = POSITIONS[2:-3]
MATRIX = rf"(.*_)?(mat|matrix|matrices|rots?|rotations?|rotmats?|dcms?|r|c){FRAMES}_?(?P<axis>[0-3][0-3]|\d)"  # or Rot[8]
OWNED = (  # columns of a body's poses: ABBquaternion[0], robot_qw, tool_x
    rf"(?!{COMMANDED})(?P<body>[a-z0-9_]+?)_?"
    r"(?P<leaf>(quats?|quaternions?|orientations?|rotations?|attitudes?|pos|positions?|translations?)_?[wxyz0-3])",
    rf"(?!{COMMANDED})(?P<body>[a-z0-9_]+)_(?P<leaf>((q|t|p|ori|rot|trans)_?)?[wxyz0-3])",
)
NOT_ALIKE = "do not turn as the gyro does"
INDICES = [[f"{row + first}{column + first}" for row in range(3) for column in range(3)] for first in (0, 1)]
NUMBERS = "012345678", "123456789"


def pose_leaves(columns: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Owner and name of columns in their groups.

    The name of axes alone begins with that of their group: `pose.position.x` is `position_x` of `pose`. So a magnetometer
    `mag.x` is no position, and the `x` of a body with `qw` is one. Columns of other groups have no owner.
    """
    leaves = {column: split_name(leaf_of(column))[0] for column in columns}
    beside: dict[str, set[str]] = {}
    for column, leaf in leaves.items():
        beside.setdefault(group_of(column), set()).add(leaf)
    alone = {group for group, names in beside.items() if all(re.fullmatch(rf"[wxyz]|{TIME_WORDS}", name) for name in names)}
    groups = {c: group_of(c) for c, leaf in leaves.items() if re.fullmatch("[wxyz]", leaf) and group_of(c) in alone - {""}}
    own = {c: (group_of(group), f"{split_name(leaf_of(group))[0]}_{leaves[c]}".lstrip("_")) for c, group in groups.items()}
    return {column: own.get(column, ("", leaf)) for column, leaf in leaves.items()}


def without_true(leaf: str) -> str:
    """Name of a column without its word for a true pose: `vicon_qw`, `px_gt`, `qVicon`."""
    name = re.sub(rf"^{TRUE_GROUPS}_", "", leaf)
    return name if name != leaf else re.sub(TRUE_BEHIND, "", leaf)


def has_poses(columns: Columns) -> bool:
    """Whether a table has positions and quaternions, matrices or angles, in whatever order."""
    leaves = {leaf: column for column, (_, leaf) in pose_leaves(columns.values).items()}
    return has_turns(leaves) and bool(position_of(leaves))


def why_no_poses(columns: Columns, group: str) -> str:
    """Reason why a table that is named as poses gives none, and what to do."""
    noted = (note for note in columns.remarks.notes if NOT_ALIKE in note and f"{group}/" in note)
    if group and (note := next(noted, "")):
        return note
    own = {name.removeprefix(f"{group}/"): name for name in columns.values if name.startswith(f"{group}/")}
    leaves = {leaf: own[name] for name, (_, leaf) in pose_leaves(own).items()}
    if position_of(leaves) and not has_turns(leaves):
        return "it has positions without orientations, and imutool uses no positions alone; its columns are topics of the log"
    reason = "no time with positions and rotations of a certain order was found in it"
    return f"{reason}; a map names its columns (truth_time, position, quaternion_wxyz or another rotation)"


def numbered_quaternion(leaves: dict[str, str]) -> list[str]:
    """Columns of a quaternion that are numbered, in an order that its name does not show."""
    return axes_of(QUATERNION_ARRAY, leaves, "0123") or axes_of(QUATERNION_ARRAY, leaves, "1234")


def has_turns(leaves: dict[str, str]) -> bool:
    """Whether there are quaternions, matrices or angles."""
    quaternion = axes_of(QUATERNION, leaves, "wxyz") or numbered_quaternion(leaves)
    return bool(quaternion or matrix_of(leaves) or angles_of(leaves))


def bodies_of(leaves: dict[str, str]) -> list[dict[str, str]]:
    """Columns of each body with a position and quaternions in its own name, without it."""
    bodies: dict[str, dict[str, str]] = {}
    for leaf, column in leaves.items():
        if match := next(filter(None, (re.fullmatch(form, leaf) for form in OWNED)), None):
            bodies.setdefault(match["body"], {})[match["leaf"]] = column
    return [body for body in bodies.values() if len(body) >= 7 and position_of(body)]


def matrix_of(leaves: dict[str, str], forms: Iterable[Sequence[str]] = (*INDICES, *NUMBERS)) -> list[str]:
    """Columns of a matrix, row by row, whose indices or numbers count from 0 or from 1."""
    found = {re.sub(r"_(?=\d$)", "", leaf): column for leaf, column in leaves.items()}
    return next(filter(None, (axes_of(MATRIX, found, axes) for axes in forms)), [])


def position_of(leaves: dict[str, str], forms: Sequence[tuple[str, Sequence[str]]] = POSITIONS) -> list[str]:
    """Columns x, y, z of a position, or east, north, up, or north, east, down."""
    return next(filter(None, (axes_of(pattern, leaves, axes) for pattern, axes in forms)), [])


def from_north(position: list[str]) -> list[str]:
    """Columns along north, west and up of positions named east, north and up; else none.

    A heading counts from north.
    """
    east = position_of({split_name(leaf_of(column))[0]: column for column in position}, (POSITIONS[1], *POSITIONS[-3:]))
    return [east[1], f"-{east[0]}", east[2]] if east else []


def angles_of(leaves: dict[str, str]) -> list[list[str]]:
    """Columns of each roll, pitch and yaw."""
    yaws = {re.sub(HEADING, "yaw", leaf): column for leaf, column in leaves.items()}
    yaws |= {re.sub(rf"(^|.*_){letter}", rf"\1{axis}", leaf): c for leaf, c in leaves.items() for letter, axis in GREEK.items()}
    return [three for pattern, axes in ANGLES for three in _every(pattern, yaws | leaves, axes)]


def axes_of(pattern: str, leaves: dict[str, str], axes: Sequence[str]) -> list[str]:
    """Columns of all axes of the first name that has them; `leaves` are columns by their names."""
    return next(iter(_every(pattern, leaves, axes)), [])


def _every(pattern: str, leaves: dict[str, str], axes: Sequence[str]) -> list[list[str]]:
    """Columns of all axes of each name that has them."""
    found: dict[str, dict[str, str]] = {}
    for leaf, column in leaves.items():
        if match := re.fullmatch(pattern, leaf):
            axis = match["axis"].translate(DIGITS) if "x" in axes else match["axis"]
            found.setdefault(leaf[: match.start("axis")], {})[axis] = column
    return [[columns[axis] for axis in axes] for columns in found.values() if {*columns} == {*axes}]


def rotations_named(columns: Columns, table: TableMap, where: Path) -> Float64[np.ndarray, "n 4"]:
    """Quaternions (wxyz) of the columns that the map names for the poses."""
    if table.quaternion_wxyz:
        return vectors_named(columns, table.quaternion_wxyz, 1.0, 0.0, where)
    if table.roll_pitch_yaw:
        angles = vectors_named(columns, table.roll_pitch_yaw, ANGLE_SI[table.roll_pitch_yaw_unit], 0.0, where)
        return quaternion.of_roll_pitch_yaw(angles)
    nine = matrix_columns(table.rotation_matrix)
    return of_matrices(vectors_named(columns, nine, 1.0, 0.0, where).reshape(-1, 3, 3), where)
