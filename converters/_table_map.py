"""Map of a table: which columns hold time, rates and accelerations, and in which units.

A map is proposed from the names of the columns, the units in them and the magnitude of the values. What these leave open is
for the user to state in a map file.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import msgspec
import numpy as np

from imutool.errors import ConfigError
from imutool.recording.joined_imu import in_order, unit_by_gravity
from imutool.recording.message_log import KINDS

from ._table_names import triples
from ._table_text import Columns

USUAL_TIME_NS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
TIME_NS = {**USUAL_TIME_NS, "100us": 1e5}
XSENS_TIME = r"sample_?time_?fine"  # counts 100 us
GYRO_SI = {"rad/s": 1.0, "deg/s": np.pi / 180.0, "mdeg/s": np.pi / 180.0e3}
STANDARD_GRAVITY = 9.80665
ACCEL_SI = {"m/s^2": 1.0, "g": STANDARD_GRAVITY, "mg": STANDARD_GRAVITY / 1000.0}
PLAUSIBLE_HZ = 5.0, 10_000.0
NO_UNIT = "the names of the columns state no unit of the {}, and its values show none"
MOST_SHOWN = 12  # triples of columns in a message
GRAVITY_BAND = 0.15  # share by which the median acceleration may differ from gravity

ROS_WORDS = r"angular_?velocity|linear_?acceleration"  # fields of ROS messages, which are in SI units
TIME_WORDS = (
    rf"({XSENS_TIME}|times?|timestamps?|time_?stamps?|t|ts|stamp|seconds|seconds_?elapsed|sec|epoch|rosbagtimestamp|time_?(s|ms|us|ns|sec)"
    r"|zeit|zeitstempel|uhrzeit|date_?time|utc|[a-z]*(nanos|micros|millis)|elapsed|(gps_?)?(tow|time_?of_?week))"
)
UNITS = {
    "rad/s": r"rad ?/ ?s|rads|rad s\^?-1|rad/sec|rps|rad_s|radps",
    "deg/s": r"deg ?/ ?s|dps|degs|°/s|deg/sec|deg s\^?-1|deg_s|degps",
    "mdeg/s": r"mdeg ?/ ?s|mdps|mdegs|m°/s|mdeg/sec",
    "m/s^2": r"m/s(\^|\*\*)?2|m/\(s\^?2\)|m/s²|mps2|ms2|m s\^?-2|m_s_?2",
    "mg": r"mg",
    "g": r"g",
    "ns": r"ns|nanoseconds?|nsec",
    "us": r"us|µs|microseconds?|usec",
    "ms": r"ms|milliseconds?|msec",
    "s": r"s|sec|seconds?",
    "m": r"m|met(er|re)s?",
    "cm": r"cm|centimet(er|re)s?",
    "mm": r"mm|millimet(er|re)s?",
}
POSITION_SI = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
UNITS_OF: dict[str, dict[str, float]] = {
    "time_unit": TIME_NS,
    "gyro_unit": GYRO_SI,
    "accel_unit": ACCEL_SI,
    "truth_time_unit": TIME_NS,
    "position_unit": POSITION_SI,
}
DIGITS = str.maketrans("012", "xyz")


Entries = dict[str, str | list[str]]  # of a map


class TableMap(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Map of a table's columns; a column named `-ax` counts with the opposite sign."""

    time: str
    time_unit: str
    gyro: list[str]
    gyro_unit: str
    accel: list[str]
    accel_unit: str
    accel_time: str = ""
    gyro_scale: float | list[float] = 1.0
    gyro_offset: float | list[float] = 0.0
    accel_scale: float | list[float] = 1.0
    accel_offset: float | list[float] = 0.0
    topic: str = "/imu0"
    truth_file: str = ""
    truth_time: str = ""
    truth_time_unit: str = ""
    position: list[str] = []
    position_unit: str = "m"
    quaternion_wxyz: list[str] = []
    rotation_matrix: str = ""
    pose_kind: str = "truth"


def read_map(path: Path) -> TableMap:
    """Map in a TOML file.

    Raises:
        ConfigError: unreadable, no TOML, a missing or unknown entry, or an unknown unit.
    """
    try:
        table = msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), TableMap)
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror})", where=path) from error
    except (ValueError, RecursionError, msgspec.ValidationError) as error:
        raise ConfigError(f"is no map of a table ({error})", where=path) from error
    for name, units in UNITS_OF.items():
        if (unit := getattr(table, name)) not in units and (unit or name != "truth_time_unit"):
            raise ConfigError(f"{name} is {unit!r}", where=path, expected=f"one of {', '.join(units)}")
    if table.pose_kind not in KINDS:
        raise ConfigError(f"pose_kind is {table.pose_kind!r}", where=path, expected=f"one of {', '.join(KINDS)}")
    for name in ("gyro", "accel"):
        if len(getattr(table, name)) != 3:
            raise ConfigError(f"{name} names {len(getattr(table, name))} columns", where=path, expected="three: x, y, z")
    return table


class Proposal(msgspec.Struct):
    """Map as far as a table shows it, what is open, and why."""

    entries: Entries
    open: list[str]
    reasons: list[str]

    def toml(self) -> str:
        """The proposal as a map file, with a question behind what is open."""
        lines = []
        asked_for = "time", "time_unit", "gyro", "gyro_unit", "accel", "accel_unit"
        for name in (*asked_for, *(name for name in self.entries if name not in asked_for)):
            value = self.entries.get(name, ["?", "?", "?"] if name in ("gyro", "accel") else "?")
            text = f'"{value}"' if isinstance(value, str) else "[" + ", ".join(f'"{part}"' for part in value) + "]"
            asked = f"please state: {' or '.join(UNITS_OF.get(name, ['the columns']))}"
            asked = "these, or other columns?" if name in self.entries else asked
            lines.append(f"{name} = {text}" + (f"  # {asked}" if name in self.open else ""))
        lines.append(
            "# raw counts: gyro_offset, gyro_scale, accel_offset, accel_scale give (count - offset) * scale in the unit"
        )
        lines.append(
            '# poses: truth_time, position = [x, y, z], quaternion_wxyz = [w, x, y, z] (m), pose_kind = "truth" or "estimate";'
            " truth_file if they are in another table"
        )
        return "\n".join(lines)


def propose(columns: Columns) -> Proposal:
    """Map that names, units and magnitudes of the columns suggest."""
    proposal = Proposal({}, [], [])
    names = {column: name_and_unit(column, columns.units.get(column, "")) for column in columns.values}
    for sensor, units in (("gyro", GYRO_SI), ("accel", ACCEL_SI)):
        _propose_sensor(proposal, sensor, units, names, columns)
    _propose_time(proposal, names, columns)
    if "gyro_unit" in proposal.open and not {"gyro", "accel", "accel_unit", "time", "time_unit"} & {*proposal.open}:
        _propose_gyro_unit(proposal, columns)
    return proposal


def name_and_unit(column: str, beside: str) -> tuple[str, str]:
    """Name and unit of a column; a unit `beside` the column counts where its name has none."""
    name, unit = split_name(column)
    return name, unit or next((known for known, pattern in UNITS.items() if re.fullmatch(pattern, beside.lower())), "")


def split_name(column: str) -> tuple[str, str]:
    """Name in lower case with underscores, and the unit in brackets or at the end."""
    text = column.strip().lower()
    bracket = re.search(r"[\[(]([^\])]*[a-zµ°][^\])]*)[\])]\s*$", text)
    unit = next((u for u, p in UNITS.items() if bracket and re.fullmatch(p, bracket[1].strip())), "")
    if bracket:
        text = text[: bracket.start()]
    name = re.sub(r"[^a-z0-9]+", "_", text).strip("_")
    if not unit and (
        end := re.search(r"_(m?dps|deg_s|degps|degs|rad_s|radps|rads|mps2|ms2|m_s_?2|mg|g|ns|us|ms|s|sec)$", name)
    ):
        unit = next(u for u, p in UNITS.items() if re.fullmatch(p, end[1]))
        name = name[: end.start()]
    return name, unit


def _propose_sensor(
    proposal: Proposal, sensor: str, units: dict[str, float], names: dict[str, tuple[str, str]], columns: Columns
) -> None:
    """Columns of the three axes, and their unit."""
    plain = {column: name for column, (name, _) in names.items()}
    spaced = {c: split_name(re.sub(r"(?<=[a-z]{2})(?=[A-Z][a-z])", "_", c))[0] for c in names}  # UncompGyro_0
    whole = triples(sensor, plain, spaced)
    if len(whole) != 1:
        proposal.open += [sensor] if whole else [sensor, f"{sensor}_unit"]
        shown = "".join(f"{': ' if n == 0 else ', '}{triple['x']}/y/z" for n, triple in enumerate(whole[:MOST_SHOWN]))
        proposal.reasons.append(f"{len(whole)} triples of columns look like the {sensor}{shown}")
    if not whole:
        return
    chosen = [whole[0][axis] for axis in "xyz"]
    proposal.entries[sensor] = chosen
    stated = {names[column][1] for column in chosen} - {""}
    if len(stated) == 1 and stated <= units.keys():
        proposal.entries[f"{sensor}_unit"] = stated.pop()
    elif re.search(ROS_WORDS, names[chosen[0]][0]):
        proposal.entries[f"{sensor}_unit"] = next(iter(units))
    else:
        _propose_unit(proposal, sensor, np.stack([columns.values[c].astype(float) for c in chosen], axis=1))


def _propose_gyro_unit(proposal: Proposal, columns: Columns) -> None:
    """Unit of the gyro from how gravity turns in the accelerometer."""
    t, gyro, accel = (
        np.stack([columns.values[c].astype(float) for c in np.atleast_1d(proposal.entries[name])], axis=1)
        for name in ("time", "gyro", "accel")
    )
    t_ns = np.rint((t[:, 0] - t[0, 0]) * TIME_NS[str(proposal.entries["time_unit"])]).astype(np.int64)
    if len(gyro) != len(accel):
        return
    kept = in_order(t_ns, np.concatenate([gyro, accel], axis=1), "")
    found = unit_by_gravity(kept.t_ns, kept.values[:, :3], kept.values[:, 3:], GYRO_SI) if len(kept.t_ns) else None
    if found is not None:
        proposal.open.remove("gyro_unit")
        proposal.reasons.remove(NO_UNIT.format("gyro"))
        proposal.entries["gyro_unit"] = found[0]
        proposal.reasons.append(f"gravity turns in the accelerometer as a gyro in {found[0]} says (correlation {found[1]:.2f})")


def _propose_unit(proposal: Proposal, sensor: str, values: np.ndarray) -> None:
    """Unit from the magnitude: gravity shows that of an accelerometer; no magnitude shows that of a gyro."""
    if sensor == "accel":
        level = float(np.nanmedian(np.linalg.norm(values, axis=1)))
        for unit, size in ACCEL_SI.items():
            if abs(level * size / STANDARD_GRAVITY - 1.0) < GRAVITY_BAND:
                proposal.entries["accel_unit"] = unit
                proposal.reasons.append(f"the median acceleration is {level:.4g}: gravity in {unit}")
                return
    proposal.open.append(f"{sensor}_unit")
    proposal.reasons.append(NO_UNIT.format(sensor))


def _propose_time(proposal: Proposal, names: dict[str, tuple[str, str]], columns: Columns) -> None:
    """Column of the time and its unit, from its name or from a plausible rate."""
    length = len(columns.values[proposal.entries["gyro"][0]]) if "gyro" in proposal.entries else None
    found = [c for c, (name, _) in names.items() if re.fullmatch(rf"(.*_)?{TIME_WORDS}", name or names[c][1])]
    found = [c for c in found if length in (None, len(columns.values[c])) and rises(columns.values[c])]
    if "gyro" in proposal.entries:
        group = proposal.entries["gyro"][0].rpartition("/")[0]
        found.sort(key=lambda c: c.rpartition("/")[0] != group)
    found.sort(key=lambda c: not (names[c][0].endswith("header_stamp") and columns.values[c].dtype.kind in "iu"))
    if not found and len(rising := [c for c, v in columns.values.items() if length in (None, len(v)) and rises(v)]) == 1:
        proposal.reasons.append(f"{rising[0]!r} is the only column that rises, and counts as the time")
        found = rising
    if not found:
        proposal.open += ["time", "time_unit"]
        proposal.reasons.append("no column that rises looks like a time")
        return
    column = proposal.entries["time"] = found[0]
    if (unit := names[column][1]) in TIME_NS:
        proposal.entries["time_unit"] = unit
        return
    if re.fullmatch(rf"(.*_)?{XSENS_TIME}", names[column][0]):
        proposal.entries["time_unit"] = "100us"
        proposal.reasons.append(f"{column!r} counts 100 us, as an Xsens sensor does")
        return
    values = columns.values[column].astype(float)
    step = float(np.median(np.diff(values)))
    plausible = [u for u, size in USUAL_TIME_NS.items() if PLAUSIBLE_HZ[0] <= 1e9 / (step * size) <= PLAUSIBLE_HZ[1]]
    epochs = [u for u in plausible if 1e18 < values[0] * TIME_NS[u] < 4e18]  # 2001 to 2096
    certain = epochs or plausible
    if len(certain) == 1:
        proposal.entries["time_unit"] = certain[0]
        proposal.reasons.append(f"{column!r} counts {certain[0]}: {1e9 / (step * TIME_NS[certain[0]]):.1f} samples a second")
    else:
        proposal.open.append("time_unit")
        proposal.reasons.append(f"{column!r} states no unit, and a step of {step:.4g} fits {' and '.join(certain) or 'none'}")


def rises(values: np.ndarray) -> bool:
    """Whether nearly every value exceeds the one before it, and the one half a table before.

    The second tells a time from the nanoseconds of a stamp, which begin again each second.
    """
    later = values[len(values) // 2 :].astype(float) - values[: len(values) - len(values) // 2].astype(float)
    return len(values) > 1 and float(min(np.mean(np.diff(values.astype(float)) > 0), np.mean(later > 0))) > 0.9
