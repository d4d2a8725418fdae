"""Map of a table: which columns hold time, rates and accelerations, and in which units.

What the columns themselves leave open is for the user to state: in a map file, or as single entries of one.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from imutool.array_types import Float64, Int64
from imutool.errors import ConfigError, did_you_mean
from imutool.recording.message_log import KINDS

from ..text.delimited import Columns
from .times import COUNTED
from .units import TIME_NS, UNITS_OF
from .wraps import stamps, without_ends

IMU_TOPIC = "/imu0"
WORLDS = ("ned",)
LISTS = {  # entries that name several columns
    **dict.fromkeys(("gyro", "accel", "position"), (3, "x, y, z")),
    "quaternion_wxyz": (4, "w, x, y, z"),
    "roll_pitch_yaw": (3, "roll, pitch, yaw"),
    "rotation_matrix": (9, "row by row"),
}
TRUE_ENTRIES = {"truth_time", "position", "quaternion_wxyz", "roll_pitch_yaw", "rotation_matrix"}  # columns of the poses
CLOCKS = "time", "accel_time", "truth_time", "counter"
IMU_GROUP = "imu"  # in front of the columns of an IMU next to another table
TRUTH_GROUP, POSES_GROUP = "ground_truth", "poses"  # of that other table
POSE_GROUPS = f"{TRUTH_GROUP}/", f"{POSES_GROUP}/"
OF_COUNTS = {"gyro_scale", "gyro_offset", "accel_scale", "accel_offset"}
NO_UNIT = "the names of the columns state no unit of the {} that imutool knows, and its values show none"
RATE_TO_STATE = "SAMPLES_A_SECOND"  # no number: one that is copied would be wrong

Entries = dict[str, Any]  # of a map: names, lists of names, numbers
IN_WHOLE = "gyro", "gyro_unit", "accel", "accel_unit"  # entries with which, and a time, a map needs nothing from the table


class TableMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Map of a table's columns; a column named `-ax` counts with the opposite sign.

    Without `gyro` and `accel` it holds for each of several IMUs, which the names of the columns show.
    """

    time: str = ""
    time_unit: str = ""
    rate_hz: float = 0.0  # in place of a time: rows are counted, or what a column `counter` counts
    counter: str = ""
    gyro: list[str] = []
    gyro_unit: str = ""
    accel: list[str] = []
    accel_unit: str = ""
    accel_time: str = ""
    gyro_scale: float | list[float] = 1.0
    gyro_offset: float | list[float] = 0.0
    accel_scale: float | list[float] = 1.0
    accel_offset: float | list[float] = 0.0
    topic: str = IMU_TOPIC
    truth_file: str = ""
    truth_time: str = ""
    truth_time_unit: str = ""
    position: list[str] = []
    position_unit: str = "m"
    quaternion_wxyz: list[str] = []
    rotation_matrix: str | list[str] = ""  # an array, or nine columns, row by row
    roll_pitch_yaw: list[str] = []  # body to world is Rz(yaw) Ry(pitch) Rx(roll)
    roll_pitch_yaw_unit: str = "deg"
    pose_kind: str = "truth"
    pose_world: str = ""  # "ned": poses in north, east, down, which become east, north, up

    def described(self) -> dict[str, str]:
        """Entries that say something; columns as `a, b, c`."""
        blank = msgspec.structs.asdict(TableMap())
        entries = {key: value for key, value in msgspec.structs.asdict(self).items() if value != blank[key] or key == "topic"}
        return {key: ", ".join(map(str, value)) if isinstance(value, list) else str(value) for key, value in entries.items()}


def read_map(mapping: Path | Mapping[str, Any]) -> Entries:
    """Entries that a TOML file or a program states; a text `a,b,c` is a list, too.

    Raises:
        ConfigError: unreadable, no TOML, an unknown entry or unit, no three columns, or a scale without units.
    """
    where = mapping if isinstance(mapping, Path) else "mapping"
    values = _toml(mapping) if isinstance(mapping, Path) else dict(mapping)
    for name in {*LISTS, *OF_COUNTS} & {*values}:
        if isinstance(values[name], str) and "," in values[name]:
            columns = [column.strip() for column in values[name].split(",")]
            values[name] = [*map(_number, columns)] if name in OF_COUNTS else columns
    for name in [name for name in values if name not in TableMap.__struct_fields__]:
        known = TableMap.__struct_fields__
        fix = did_you_mean(name, known, "{}")
        raise ConfigError(f"{name!r} is no entry of a map", where=where, expected=f"one of {', '.join(known)}", fix=fix)
    try:
        table = msgspec.convert(values, TableMap)
    except msgspec.ValidationError as error:
        name = re.sub(r"\W.*", "", str(error).partition("`$.")[2])
        expected = "numbers" if name in {"rate_hz", *OF_COUNTS} else "names of columns" if name in LISTS else "text"
        raise ConfigError(f"{name} is {values[name]!r}", where=where, expected=expected) from error
    given = {name: getattr(table, name) for name, value in values.items() if value not in ("", [])}
    for name, units in {**UNITS_OF, "pose_kind": KINDS, "pose_world": WORLDS}.items():
        if name in given and given[name] not in units:
            raise ConfigError(f"{name} is {given[name]!r}", where=where, expected=f"one of {', '.join(units)}")
    if "rate_hz" in given and ("time" in given or not 0.0 < given["rate_hz"] < np.inf):
        raise ConfigError("has to name a time or a positive rate_hz", where=where, expected="`time`, or `rate_hz`")
    if not given.keys().isdisjoint(OF_COUNTS) and not {"gyro_unit", "accel_unit"} <= given.keys():
        what = f"{min(OF_COUNTS & given.keys())} without both units: the values alone no longer show them"
        raise ConfigError(what, where=where, expected="`gyro_unit` and `accel_unit`")
    for name, (count, of) in LISTS.items():
        if name in given and not isinstance(given[name], str) and len(given[name]) != count:
            raise ConfigError(f"{name} names {len(given[name])} columns", where=where, expected=f"{count}: {of}")
    return given


def _number(text: str) -> float | str:
    """Number in a text, or the text where it is none."""
    try:
        return float(text)
    except ValueError:
        return text


def _toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror})", where=path) from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"is no map of a table ({error})", where=path) from error


def within_groups(given: Entries, columns: Columns) -> Entries:
    """Entries with the group in front of the names of columns, if one table alone has them.

    A map of a folder also holds for a table without a group, which has none next to it.
    """
    out = dict(given)
    beside = {c for e in TRUE_ENTRIES & given.keys() for c in np.atleast_1d(given[e]).tolist() if c.startswith(POSE_GROUPS)}
    if beside and not any(column.startswith(POSE_GROUPS) for column in columns.values):
        out = {entry: value for entry, value in given.items() if entry not in {*TRUE_ENTRIES, "truth_time_unit", "pose_kind"}}
        unused = ", ".join(sorted(given.keys() - out.keys()))
        columns.remarks.notes.append(f"no table of poses lies next to it: {unused} are left out")
    for entry in {*LISTS, *CLOCKS} & out.keys():
        of_imu = entry not in TRUE_ENTRIES
        if of_imu or "truth_file" not in given:
            names = [given[entry]] if isinstance(given[entry], str) else given[entry]
            found = [_within_group(name, columns, of_imu) for name in names]
            out[entry] = found[0] if isinstance(given[entry], str) else found
    return out


def _within_group(name: str, columns: Columns, of_imu: bool) -> str:
    plain = columns.unsigned(name)
    names = {*columns.values, *(column.removesuffix("[0][0]") for column in columns.values)}
    if plain not in names and (alone := plain.removeprefix(f"{IMU_GROUP}/")) in names:
        return name.replace(plain, alone)
    among = [] if plain in names else [each for each in names if each.endswith(f"/{plain}")]
    own = [each for each in among if each.startswith(f"{IMU_GROUP}/" if of_imu else POSE_GROUPS)]
    own = own or [each for each in among if of_imu or not each.startswith(f"{IMU_GROUP}/")] or among
    return name.replace(plain, own[0]) if len(own) == 1 else name


def is_whole(given: Entries) -> bool:
    """Whether entries name an IMU, its units and its time."""
    return {*IN_WHOLE} <= given.keys() and ("rate_hz" in given or {"time", "time_unit"} <= given.keys())


class Proposal(msgspec.Struct):
    """Map as far as a table shows it, what is open, and why."""

    entries: Entries
    open: list[str]
    reasons: list[str]
    rate_hz: float = 0.0
    hints: list[str] = []  # lines to confirm

    def state(self, given: Entries) -> None:
        """Enter what the user states; it is open no more."""
        self.entries |= {name: value for name, value in given.items() if name != "rate_hz"}
        self.rate_hz = given.get("rate_hz", self.rate_hz)
        self.open[:] = [name for name in self.open if name not in given]
        self.reasons[:] = [each for each in self.reasons if each not in (NO_UNIT.format(name[:-5]) for name in given)]

    def unsigned(self, sensor: str, columns: Columns) -> list[str]:
        """Columns of a sensor without signs; none where none is found."""
        return [columns.unsigned(column) for column in self.entries.get(sensor, ())]

    def settle_unit(self, sensor: str, unit: str, reason: str) -> None:
        """Enter the unit of a sensor, which was open."""
        self.open.remove(f"{sensor}_unit")
        self.reasons[:] = [each for each in self.reasons if each != NO_UNIT.format(sensor)] + [reason]
        self.entries[f"{sensor}_unit"] = unit

    def in_words(self) -> str:
        """What is open as `name=value`, where names and numbers settle it."""
        asked = {name: f"{name}={' or '.join(UNITS_OF.get(name, [RATE_TO_STATE]))}" for name in self.open}
        if "time" in self.open:
            others = {name: text for name, text in asked.items() if not name.startswith("time")}
            asked = {"rate_hz": f"rate_hz={RATE_TO_STATE}", **others}
        return f"what is open ({', '.join(asked.values())}), or " if asked.keys() <= {*UNITS_OF, "rate_hz"} else ""

    def toml(self, several: Sequence[str] = (), *, own_times: bool = False) -> str:
        """The proposal as a map file, with a question behind what is open; `several` are the topics of more than one IMU."""
        lines = [f"rate_hz = {self.rate_hz}"] if self.rate_hz else []
        lines += ['rate_hz = "?"  # please state: the samples a second, as a number'] if "rate_hz" in self.open else []
        times = [] if lines else ["time_unit"] if own_times else ["time", "time_unit"]
        asked_for = (*times, "gyro_unit", "accel_unit") if several else (*times, "gyro", "gyro_unit", "accel", "accel_unit")
        left_out = {*asked_for, "time", "time_unit", *(("gyro", "accel") if several else ())}
        for name in (*asked_for, *(name for name in self.entries if name not in left_out)):
            value = self.entries.get(name, ["?", "?", "?"] if name in ("gyro", "accel") else "?")
            text = json.dumps(value, ensure_ascii=False)
            choices = " or ".join(UNITS_OF.get(name, ["the columns"]))
            proposed = "these columns" if isinstance(value, list) else "this column" if name == "counter" else choices
            asked = f"please confirm: {proposed}?" if name in self.entries else f"please state: {choices}"
            lines.append(f"{name} = {text}" + (f"  # {asked}" if name in self.open else ""))
        if several:
            lines.append(
                f"# it holds for {', '.join(several)}; for one of them alone, name its columns: gyro = [...], accel = [...]"
            )
        if {"time", "time_unit"} & {*self.open}:
            lines.append(f"# without a column of times: rate_hz = {RATE_TO_STATE}, in place of time and time_unit")
        lines += [f"# {hint}" for hint in self.hints]
        lines.append(
            "# raw counts: gyro_offset, gyro_scale, accel_offset, accel_scale give (count - offset) * scale in the unit"
        )
        lines.append(
            "# poses: truth_time, position = [x, y, z] (m), quaternion_wxyz = [w, x, y, z], rotation_matrix = [nine columns,"
            " row by row] or roll_pitch_yaw = [roll, pitch, yaw] (deg, Rz(yaw) Ry(pitch) Rx(roll)),"
            ' pose_kind = "truth" or "estimate"; truth_file if they are in another table'
        )
        return "\n".join(lines)


def share_units(proposals: Mapping[str, Proposal]) -> None:
    """Enter an open unit of the gyro that other IMUs with columns of the same names have."""
    found: dict[tuple[str, ...], set[str]] = {}
    for topic, proposal in proposals.items():
        if "gyro_unit" not in proposal.open and "gyro_unit" in proposal.entries:
            found.setdefault(_leaves(topic, proposal), set()).add(str(proposal.entries["gyro_unit"]))
    for topic, proposal in proposals.items():
        if proposal.open == ["gyro_unit"] and len(units := found.get(_leaves(topic, proposal), set())) == 1:
            (unit,) = units
            proposal.settle_unit("gyro", unit, f"the other IMUs, whose columns have the same names, are in {unit}")


def _leaves(topic: str, proposal: Proposal) -> tuple[str, ...]:
    """Names of an IMU's columns without their groups and the IMU's own: of `left_gyr_x` on `/left/imu` `_gyr_x`."""
    names = (
        name.rpartition("/")[2].lower() for name in (*proposal.entries.get("gyro", []), *proposal.entries.get("accel", []))
    )
    return tuple(name.replace(topic.split("/")[1], "", 1) for name in names)


def column_named(columns: Columns, wanted: str, where: Path | str) -> np.ndarray:
    """Values of a column.

    Raises:
        ConfigError: there is none of this name.
    """
    if wanted not in columns.values:
        named = ", ".join(column for column in columns.values if not column.startswith(COUNTED))
        raise ConfigError(f"no column {wanted!r}", where=where, expected=f"one of {named}")
    return columns.values[wanted]


def times_named(columns: Columns, wanted: str, unit: str, where: Path) -> Int64[np.ndarray, " n"]:
    """Stamps in nanoseconds, which go on where a clock begins again.

    Raises:
        ConfigError: there is no such column.
        DataError: no numbers, or beyond the year 2262.
    """
    values, unit_ns = column_named(columns, wanted, where), int(TIME_NS[unit])
    t_ns = stamps(values, columns.texts.get(wanted), unit_ns, f"{where}: {wanted}")
    return without_ends(t_ns, unit_ns, wanted, columns.remarks.notes)


def vectors_named(
    columns: Columns, wanted: list[str], scale: float | list[float], offset: float | list[float], where: Path
) -> Float64[np.ndarray, "n k"]:
    """Columns side by side, (value - offset) * scale; a minus before a name turns its sign.

    Raises:
        ConfigError: there is no such column, or they have different numbers of rows.
    """
    if len({len(column_named(columns, columns.unsigned(name), where)) for name in wanted}) > 1:
        raise ConfigError(f"{', '.join(wanted)} have different numbers of rows", where=where)
    values = columns.side_by_side(columns.unsigned(name) for name in wanted)
    np.multiply(np.subtract(values, offset, out=values), scale, out=values)
    values *= np.array([1.0 if name in columns.values else -1.0 for name in wanted])
    return values
