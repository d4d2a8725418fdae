"""Map of a table: which columns hold time, rates and accelerations, and in which units.

A map is proposed from the names of the columns, the units in them and the magnitude of the values. What these leave open is
for the user to state in a map file.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from imutool.errors import ConfigError
from imutool.recording.joined_imu import in_order, unit_by_gravity
from imutool.recording.message_log import KINDS

from ._table_names import CORE_MOTION, ROS_WORDS, TIME_WORDS, WITHOUT_GRAVITY, XSENS_TIME, name_and_unit, spaced_name, triples
from ._table_text import Columns
from ._table_times import PLAUSIBLE_HZ, count_times, counter_of, goes_on, rises, stated_rate
from ._table_units import ACCEL_SI, GYRO_SI, TIME_NS, UNITS_OF, USUAL_TIME_NS, gravity_units

IMU_TOPIC = "/imu0"
NO_UNIT = "the names of the columns state no unit of the {}, and its values show none"
LEAST_GRAVITY = 0.5  # m/s^2; a median below it is that of motion alone
MOST_SHOWN = 12  # triples of columns in a message
OWN_TIME = {"gyro": r"gyro(scope)?_t", "accel": r"accel(erometer)?_t"}  # names of a sensor's own stamps begin so

Entries = dict[str, str | list[str]]  # of a map


class TableMap(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Map of a table's columns; a column named `-ax` counts with the opposite sign.

    Without `gyro` and `accel` it holds for each of several IMUs, which the names of the columns show.
    """

    time: str = ""
    time_unit: str = ""
    rate_hz: float = 0.0  # in place of a time: rows are counted, or what a column `counter` counts
    counter: str = ""
    gyro: list[str] = []
    gyro_unit: str
    accel: list[str] = []
    accel_unit: str
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
    if not (0.0 < table.rate_hz < np.inf) if not table.time else table.rate_hz:
        raise ConfigError(
            "has to name a time or a positive rate_hz", where=path, expected="`time` and `time_unit`, or `rate_hz`"
        )
    needless = {"truth_time_unit", *([] if table.time else ["time_unit"])}
    for name, units in UNITS_OF.items():
        if (unit := getattr(table, name)) not in units and (unit or name not in needless):
            raise ConfigError(f"{name} is {unit!r}", where=path, expected=f"one of {', '.join(units)}")
    if table.pose_kind not in KINDS:
        raise ConfigError(f"pose_kind is {table.pose_kind!r}", where=path, expected=f"one of {', '.join(KINDS)}")
    if isinstance(table.rotation_matrix, list) and len(table.rotation_matrix) != 9:
        raise ConfigError(
            f"rotation_matrix names {len(table.rotation_matrix)} columns", where=path, expected="nine, row by row"
        )
    for name in ("gyro", "accel") if table.gyro or table.accel else ():
        if len(getattr(table, name)) != 3:
            raise ConfigError(f"{name} names {len(getattr(table, name))} columns", where=path, expected="three: x, y, z")
    return table


class Proposal(msgspec.Struct):
    """Map as far as a table shows it, what is open, and why."""

    entries: Entries
    open: list[str]
    reasons: list[str]
    rate_hz: float = 0.0

    def settle_gyro_unit(self, unit: str, reason: str) -> None:
        """Enter the unit of the gyro, which was open."""
        self.open.remove("gyro_unit")
        self.reasons[:] = [each for each in self.reasons if each != NO_UNIT.format("gyro")] + [reason]
        self.entries["gyro_unit"] = unit

    def toml(self, several: Sequence[str] = ()) -> str:
        """The proposal as a map file, with a question behind what is open."""
        lines = [f"rate_hz = {self.rate_hz}"] if self.rate_hz else []
        lines += ['rate_hz = "?"  # please state: the samples a second, as a number'] if "rate_hz" in self.open else []
        times = [] if lines else ["time", "time_unit"]
        asked_for = (*times, "gyro_unit", "accel_unit") if several else (*times, "gyro", "gyro_unit", "accel", "accel_unit")
        left_out = {*asked_for, "time", "time_unit", *(("gyro", "accel") if several else ())}
        for name in (*asked_for, *(name for name in self.entries if name not in left_out)):
            value = self.entries.get(name, ["?", "?", "?"] if name in ("gyro", "accel") else "?")
            text = json.dumps(value, ensure_ascii=False)
            asked = f"please state: {' or '.join(UNITS_OF.get(name, ['the columns']))}"
            asked = "these, or other columns?" if name in self.entries else asked
            lines.append(f"{name} = {text}" + (f"  # {asked}" if name in self.open else ""))
        if several:
            lines.append(
                f"# it holds for {', '.join(several)}; for one of them alone, name its columns: gyro = [...], accel = [...]"
            )
        if "time" in self.open:
            lines.append("# without a column of times: rate_hz = 100.0, the samples a second, in place of time and time_unit")
        lines.append(
            "# raw counts: gyro_offset, gyro_scale, accel_offset, accel_scale give (count - offset) * scale in the unit"
        )
        lines.append(
            "# poses: truth_time, position = [x, y, z] (m), quaternion_wxyz = [w, x, y, z] or rotation_matrix = [nine columns,"
            ' row by row], pose_kind = "truth" or "estimate"; truth_file if they are in another table'
        )
        return "\n".join(lines)


def propose(columns: Columns) -> Proposal:
    """Map that names, units and magnitudes of the columns suggest."""
    proposal = Proposal({}, [], [])
    names = {column: name_and_unit(column, columns.units.get(column, "")) for column in columns.values}
    for sensor, units in (("gyro", GYRO_SI), ("accel", ACCEL_SI)):
        _propose_sensor(proposal, sensor, units, names, columns)
    _propose_time(proposal, names, columns)
    if proposal.open == ["gyro_unit"]:
        _propose_gyro_unit(proposal, columns)
    accel = proposal.entries.get("accel", [""])
    if re.match(CORE_MOTION, spaced_name(accel[0])):
        proposal.entries["accel"] = [f"-{column}" for column in accel]
        proposal.reasons.append(
            f"{accel[0]}/y/z are of CoreMotion, whose accelerometer reads -1 g along the axis that points up"
        )
    return proposal


def _propose_sensor(
    proposal: Proposal, sensor: str, units: dict[str, float], names: dict[str, tuple[str, str]], columns: Columns
) -> None:
    """Columns of the three axes, and their unit."""
    plain = {column: name for column, (name, _) in names.items()}
    spaced = {column: spaced_name(column) for column in names}
    found = [*triples(sensor, plain, spaced).values()]
    whole = _with_gravity(found, spaced, columns) if sensor == "accel" else found
    if len(whole) < len(found):
        proposal.reasons.append(f"of {len(found)} accelerations {whole[0]['x']}/y/z is the one with gravity")
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
    elif len(stated) > 1:
        proposal.open += [sensor, f"{sensor}_unit"]
        listed = ", ".join(chosen)
        proposal.reasons.append(f"{listed} state different units: {sensor}_scale = [x, y, z] in a map brings them to one")
    elif re.search(ROS_WORDS, names[chosen[0]][0]):
        proposal.entries[f"{sensor}_unit"] = next(iter(units))
    else:
        _propose_unit(proposal, sensor, columns)
    if sensor == "accel" and (unit := proposal.entries.get("accel_unit")):
        level, _ = gravity_units(columns, chosen)
        if level * ACCEL_SI[str(unit)] < LEAST_GRAVITY or re.search(r"(user|free)_?acc", spaced[chosen[0]]):
            proposal.open.append("accel")
            proposal.reasons.append(f"the median acceleration of {chosen[0]!r} is {level:.3g} {unit}: gravity was taken out")


def _with_gravity(found: Sequence[dict[str, str]], spaced: dict[str, str], columns: Columns) -> Sequence[dict[str, str]]:
    """The one of several accelerations that has gravity, by its name or by its size; all where none stands out."""
    named = [triple for triple in found if not re.search(WITHOUT_GRAVITY, spaced[triple["x"]])]
    sized = [triple for triple in named if gravity_units(columns, list(triple.values()))[1]]
    return next((each for each in (named, sized) if len(each) == 1), found)


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
        proposal.settle_gyro_unit(
            found[0], f"gravity turns in the accelerometer as a gyro in {found[0]} says (t = {found[1]:.1f})"
        )


def _propose_unit(proposal: Proposal, sensor: str, columns: Columns) -> None:
    """Unit from the magnitude: gravity shows that of an accelerometer; no magnitude shows that of a gyro."""
    if sensor == "accel":
        level, near = gravity_units(columns, proposal.entries[sensor])
        if near:
            proposal.reasons.append(f"the median acceleration is {level:.4g}: gravity in {' or '.join(near)}")
        if len(near) == 1:
            proposal.entries["accel_unit"] = near[0]
            return
    proposal.open.append(f"{sensor}_unit")
    proposal.reasons.append(NO_UNIT.format(sensor))


def _propose_time(proposal: Proposal, names: dict[str, tuple[str, str]], columns: Columns) -> None:
    """Column of the time and its unit, from its name or from a plausible rate."""
    length = len(columns.values[proposal.entries["gyro"][0]]) if "gyro" in proposal.entries else None
    spelled = {c: (name or unit, spaced_name(c)) for c, (name, unit) in names.items()}
    found = [c for c, each in spelled.items() if any(re.fullmatch(rf"(.*_)?{TIME_WORDS}", name) for name in each)]
    found = [c for c in found if length in (None, len(columns.values[c]))]
    still, found = [c for c in found if not goes_on(columns.values[c])], [c for c in found if goes_on(columns.values[c])]
    if "gyro" in proposal.entries:
        group = proposal.entries["gyro"][0].rpartition("/")[0]
        found.sort(key=lambda c: c.rpartition("/")[0] != group)
        found.sort(key=lambda c: not re.match(OWN_TIME["gyro"], spelled[c][1]))
    found.sort(key=lambda c: not (names[c][0].endswith("header_stamp") and columns.values[c].dtype.kind in "iu"))
    counter = counter_of(columns, length or 0)
    measured = {counter, *proposal.entries.get("gyro", ()), *proposal.entries.get("accel", ())}
    rising = [c for c, v in columns.values.items() if c not in measured and length in (None, len(v)) and rises(v)]
    if not found and len(rising) == 1:
        proposal.reasons.append(f"{rising[0]!r} is the only column that rises, and counts as the time")
        found = rising
    if not found:
        for column in still:
            values = columns.values[column]
            counts = f"{len(np.unique(values))} different values in {len(values)} rows"
            proposal.reasons.append(f"{column!r} is named as a time and does not rise: {counts}")
        _propose_rate(proposal, columns, counter, length)
        return
    column = proposal.entries["time"] = found[0]
    if re.match(OWN_TIME["gyro"], spelled[column][1]):
        own = [c for c in found if re.match(OWN_TIME["accel"], spelled[c][1]) and names[c][1] == names[column][1]]
        proposal.entries |= {"accel_time": own[0]} if own else {}
    if (unit := names[column][1]) in TIME_NS:
        proposal.entries["time_unit"] = unit
        return
    values = columns.values[column].astype(float)
    step = float(np.median(np.diff(values)))
    if re.fullmatch(rf"(.*_)?{XSENS_TIME}", names[column][0]):
        counts = "100us" if step * TIME_NS["100us"] <= 1e9 / PLAUSIBLE_HZ[0] else "us"
        proposal.entries["time_unit"] = counts
        proposal.reasons.append(f"{column!r} counts {counts.replace('00us', '00 us')}, as an Xsens sensor does")
        return
    plausible = [u for u, size in USUAL_TIME_NS.items() if PLAUSIBLE_HZ[0] <= 1e9 / (step * size) <= PLAUSIBLE_HZ[1]]
    epochs = [u for u in plausible if 1e18 < values[0] * TIME_NS[u] < 4e18]  # 2001 to 2096
    certain = epochs or plausible
    if len(certain) == 1:
        proposal.entries["time_unit"] = certain[0]
        proposal.reasons.append(f"{column!r} counts {certain[0]}: {1e9 / (step * TIME_NS[certain[0]]):.1f} samples a second")
    else:
        proposal.open.append("time_unit")
        proposal.reasons.append(f"{column!r} states no unit, and a step of {step:.4g} fits {' and '.join(certain) or 'none'}")


def _propose_rate(proposal: Proposal, columns: Columns, counter: str, length: int | None) -> None:
    """Sampling rate of samples that are counted, in place of a time."""
    counted = f"{counter!r} counts the samples" if counter else "no column holds the time: rows are counted"
    rate = stated_rate(columns, proposal.entries.get("gyro", [""])[0])
    proposal.entries |= {"counter": counter} if counter else {}
    if rate is None:
        proposal.open += ["rate_hz"] if counter else ["time", "time_unit"]
        what = counted if counter else "no column that rises looks like a time"
        proposal.reasons.append(f"{what}, and no number in the file is named as a sampling rate")
        return
    proposal.rate_hz = rate[1]
    proposal.reasons.append(f"{counted}, at the {rate[0]!r} of {rate[1]:.6g} Hz that the file states")
    if length:
        proposal.entries |= {"time": count_times(columns, rate[1], length, counter), "time_unit": "s"}
