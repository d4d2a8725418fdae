"""Stamps in two columns, sensors with times of their own, and poses in two tables."""

from __future__ import annotations

import re
from itertools import compress, product

import numpy as np

from ..columns.map import IMU_GROUP
from ..columns.pose_names import has_turns, pose_leaves, position_of
from ..columns.times import NS, goes_on, units_of_time, usual_step
from ..columns.units import TIME_NS
from ..text.delimited import Columns
from ..text.names import TIME_WORDS, name_and_unit, spaced_name, split_name, triples
from .sensors import SENSORS

LAST_S = 9_223_372_036  # in the year 2262, where nanoseconds in 64 bits end
SECONDS = re.compile(r"(.*?)(?:secs?|seconds?|(?:unix|utc|posix)[ _]?time)(_\w+)?", re.IGNORECASE)
BELOW_SECONDS = {  # names of the rest of a second in a column of its own, and its unit in ns
    re.compile(r"n(ano)?s(ec(ond)?s?)?", re.IGNORECASE): 1,
    re.compile(r"(u|micro)s(ec(ond)?s?)?", re.IGNORECASE): 1000,
}
CALENDAR = {  # names of columns that hold a part of a date or of a clock
    "year": r"years?|yyyy",
    "month": r"months?",
    "day": r"days?|day_of_month",
    "hour": r"hours?|hh|hrs?",
    "minute": r"min(ute)?s?",
    "second": r"sec(ond)?s?",
}
RANGES = {"year": (1970, 2261), "month": (1, 12), "day": (1, 31), "hour": (0, 23), "minute": (0, 59), "second": (0, 60)}
JOINED = "time [ns]"
MILLISECONDS = re.compile(r"(m|milli)s(ec(ond)?s?)?|millis", re.IGNORECASE)
ALWAYS = 0.99  # share of the steps of a time that do not go back
POSITIONS = r"(.*_)?(pos(e|ition)?s?|translations?|traj(ectory)?|locations?|xyz)(_.*)?"  # names of a table of positions
MAX_UNTIMED = 0.01  # share of the rows of a table that may lack its time: a mean below them, a garbled field
MAX_STEPS = 4.0  # median steps of positions, over which none are interpolated
QUARTER_NS, FARTHEST_NS, MAX_OFF_NS = 900 * 10**9, 14 * 3600 * 10**9, 60 * 10**9  # of zones; between two clocks of a table
SINCE_NS = 10**18  # in 2001; smaller times may count from any start
SINCE_1970 = rf"(.*_)?{TIME_WORDS}|.*(since_?1970|epoch|unix|posix).*"
TIME_OF = rf"((?P<before>.+?)_)?{TIME_WORDS}|{TIME_WORDS}_(?P<behind>.+)"  # imu_time, time_gps


def join_stamps(columns: Columns) -> None:
    """Make one column of a stamp in two, seconds and the rest, as ROS' header.stamp has."""
    for seconds, match in [(column, match) for column in columns.values if (match := SECONDS.fullmatch(column))]:
        stem, end = match.groups("")
        ends = product((c for c in columns.values if c.startswith(stem) and c.endswith(end)), BELOW_SECONDS.items())
        found = ((c, size) for c, (name, size) in ends if name.fullmatch(c[len(stem) : len(c) - len(end)]))
        rest, size = next(found, ("", 1))
        name = f"{stem.rstrip('._/ ') or 'stamp'}{end} [ns]"
        if name in columns.values or not rest or not (_is_whole(columns, seconds) and _is_whole(columns, rest)):
            continue
        sec, below = columns.values[seconds], columns.values[rest]
        known = np.isfinite(sec.astype(float))
        if len(sec) != len(below) or not np.array_equal(known, np.isfinite(below.astype(float))) or not known.any():
            continue
        sec, below = sec[known].astype(np.int64), below[known].astype(np.int64)
        if not (0 <= sec.min() <= sec.max() < LAST_S and 0 <= below.min() <= below.max() < 10**9 // size):
            continue
        t_ns = sec * 10**9 + below * size
        for column in (seconds, rest):
            del columns.values[column]
            columns.texts.pop(column, None)
        columns.values[name], columns.units[name] = t_ns, "ns"
        if not known.all():  # float64 rounds nanoseconds since 1970: the texts do not
            columns.values[name], texts = np.full(len(known), np.nan), [""] * len(known)
            columns.values[name][known] = t_ns
            for row, t in zip(np.flatnonzero(known).tolist(), t_ns.tolist(), strict=True):
                texts[row] = str(t)
            columns.texts[name] = texts


def join_calendar(columns: Columns) -> None:
    """Make one time of an hour, a minute, a second, and perhaps a date, in columns of their own."""
    named = {split_name(column)[0]: column for column in columns.values}
    found = {part: next((named[n] for n in named if re.fullmatch(pattern, n)), "") for part, pattern in CALENDAR.items()}
    has_date = all(map(found.get, ("year", "month", "day")))
    wanted = [part for part in CALENDAR if has_date or part in ("hour", "minute", "second")]
    if not all(map(found.get, wanted)) or "time" in named:
        return
    values = {part: columns.values[found[part]].astype(float) for part in wanted}
    fits = [np.all((each >= RANGES[part][0]) & (each <= RANGES[part][1])) for part, each in values.items()]  # NaN fits none
    if not all(fits) or len({*map(len, values.values())}) != 1:
        return
    t_ns = np.rint((values["hour"] * 3600.0 + values["minute"] * 60.0 + values["second"]) * NS).astype(np.int64)
    if has_date:
        months = ((values["year"] - 1970) * 12 + values["month"] - 1).astype(np.int64).astype("M8[M]")
        t_ns += (months.astype("M8[D]").astype(np.int64) + values["day"].astype(np.int64) - 1) * 86_400 * NS
    for part in wanted:
        del columns.values[found[part]]
        columns.texts.pop(found[part], None)
    columns.values, columns.units[JOINED] = {JOINED: t_ns, **columns.values}, "ns"
    columns.local_times.extend([JOINED] if has_date else [])
    names = ", ".join(repr(found[part]) for part in wanted)
    columns.remarks.notes.append(f"{names} are one time, which names no zone and counts as UTC")


def join_milliseconds(columns: Columns) -> None:
    """Give a time in whole seconds the milliseconds that stand in a column of their own.

    They are those of the second, or count from a start and lead up within the same second in each row.
    """
    counts = {c: values.astype(np.int64) for c, values in columns.values.items() if values.dtype.kind in "iu"}
    spelled = {c: name_and_unit(c, columns.units.get(c, "")) for c in counts}
    parts = [c for c in counts if MILLISECONDS.fullmatch(c) or spelled[c] == ("time", "ms")]
    for part, column in product(parts, counts):
        (name, unit), seconds, ns = spelled[column], counts[column], counts[part] * 1_000_000
        size = {"ns": 1, "s": NS, "": NS}.get(unit, 0)
        is_time = part != column and size and re.fullmatch(rf"(.*_)?{TIME_WORDS}|sec(ond)?s?", name or unit)
        if not is_time or not len(seconds) == len(ns) > 1 or not 0 < seconds.max() <= LAST_S * NS // size:
            continue
        t_ns = seconds * size
        if (t_ns % NS).any():
            continue
        start = t_ns - ns
        if 0 <= ns.min() <= ns.max() < NS:
            t_ns = t_ns + ns
        elif MILLISECONDS.fullmatch(part) and start.max() < start.min() + NS:
            t_ns = ns + start.max()
        if np.mean(np.diff(t_ns) >= 0) >= ALWAYS and np.mean(np.diff(t_ns) > 0) > np.mean(np.diff(seconds) > 0):
            columns.values[column], columns.units[column] = t_ns, "ns"
            columns.texts.pop(column, None)
            columns.remarks.notes.append(f"{part!r} holds the milliseconds of {column!r}")


def settle_zones(columns: Columns) -> None:
    """Take the zone of dates that name none from a time since 1970 next to them, row by row."""
    for local in columns.local_times:
        dates = columns.values[local]
        for column, values in columns.values.items():
            name, unit = name_and_unit(column, columns.units.get(column, ""))
            if column in columns.local_times or len(values) != len(dates) or not re.fullmatch(SINCE_1970, name or unit):
                continue
            if not np.isfinite(times := values.astype(float)).all():
                continue
            units = [unit] if unit in TIME_NS else units_of_time(float(times[0]), usual_step(times))
            times = times * TIME_NS[units[0]] if len(units) == 1 else np.zeros(len(times))
            if not SINCE_NS < times.min() <= times.max() < LAST_S * NS:
                continue
            ahead_ns = dates - np.rint(times).astype(np.int64)
            zone_ns = np.rint(ahead_ns / QUARTER_NS).astype(np.int64) * QUARTER_NS
            if np.abs(ahead_ns - zone_ns).max() < MAX_OFF_NS and 0 < np.abs(zone_ns).max() <= FARTHEST_NS:
                columns.values[local] = dates - zone_ns
                hours = " and ".join(f"{each / 3.6e12:+g} h" for each in np.unique(zone_ns))
                columns.remarks.notes.append(f"{local} is in a zone of {hours} by {column!r}, and is UTC in the log")
                break


def _is_whole(columns: Columns, column: str) -> bool:
    """Whether a column holds whole numbers; some may be missing."""
    values = columns.values[column]
    return values.dtype.kind in "iu" or bool((np.mod(values[np.isfinite(values)], 1.0) == 0.0).all())


def sort_by_clock(columns: Columns) -> None:
    """Give each sensor of a table its rows, where its time is blank in those of the others.

    The columns of `time_gps` become `gps/time`, `gps/lat`, ...; a column of several sensors is in each of their groups. A table
    with a time in every row, or with values in rows without any, stays as it is.
    """
    known = {column: np.isfinite(values.astype(float)) for column, values in columns.values.items()}
    named = {c: match for c in known if (match := re.fullmatch(TIME_OF, name_and_unit(c, "")[0] or "time"))}
    clocks = {c: known[c] for c in named if known[c].any() and goes_on(columns.values[c][known[c]])}
    if len({len(rows) for rows in known.values()}) != 1 or not clocks:
        return
    if any(rows.all() for rows in clocks.values()):
        _cut_blocks(columns, known, clocks)
        _cut_held(columns, {c: named[c]["before"] for c in clocks if named[c]["before"]}, clocks)
        return
    timed = np.any([*clocks.values()], axis=0)
    if any((rows & ~timed).any() for rows in known.values()):
        if len(clocks) > 1 or np.mean(~timed) > MAX_UNTIMED:
            return
        first = f"the first is row {int((~timed).argmax()) + 1}"
        note = f"{int((~timed).sum())} rows without a number in {next(iter(clocks))!r} are left out"
        columns.remarks.losses.append(f"{note} ({first})")
    groups = {c: named[c]["before"] or named[c]["behind"] or c for c in clocks}
    separate = Columns()
    if [*groups.values()] == [*clocks] and len(clocks) == 1:  # of one table, with blank rows
        for column in [c for c in known if known[c].any()]:
            _take_rows(columns, column, timed, separate, column)
        columns.values, columns.units, columns.texts = separate.values, separate.units, separate.texts
        return
    for column in [c for c in known if c not in clocks and known[c].any()]:
        holders = [clock for clock, rows in clocks.items() if not (known[column] & ~rows).any()]
        smallest = [min(holders, key=lambda clock: clocks[clock].sum())] if holders else [*clocks]
        for clock in smallest:
            _take_rows(columns, column, clocks[clock], separate, f"{groups[clock]}/{column}")
    for clock, rows in clocks.items():
        _take_rows(columns, clock, rows, separate, f"{groups[clock]}/time")
        separate.units[f"{groups[clock]}/time"] = columns.units.get(clock) or name_and_unit(clock, "")[1]
    columns.remarks.notes.append(f"each of {', '.join(clocks)} is the time of the rows in which it stands")
    columns.values, columns.units, columns.texts = separate.values, separate.units, separate.texts


def _cut_blocks(columns: Columns, known: dict[str, np.ndarray], clocks: dict[str, np.ndarray]) -> None:
    """Give sensors side by side, each behind its own time, their rows and a group each.

    The columns of `Time (s), Acc x (g), ..., Time (s), Gyro x (deg/s), ...` become `block 1/time`, `block 1/Acc x (g)`, ....
    """
    if next(iter(known)) not in clocks or all(rows.all() for rows in clocks.values()):
        return
    separate, of, groups = Columns(), "", dict[str, str]()
    for column, rows in known.items():
        of = column if column in clocks else of
        count = int(clocks[of].sum())
        if rows[count:].any() or not clocks[of][:count].all():  # values without a time, or blank rows in between
            return
        name = "time" if column == of else column
        groups[column] = f"block {[*clocks].index(of) + 1}/{name}"
        _take_rows(columns, column, clocks[of], separate, groups[column])
        if column == of:
            separate.units[groups[column]] = columns.units.get(column) or name_and_unit(column, "")[1]
    columns.remarks.notes.append(f"each of {', '.join(clocks)} is the time of the columns behind it, and of as many rows")
    columns.values, columns.units, columns.texts = separate.values, separate.units, separate.texts


def _cut_held(columns: Columns, before: dict[str, str], clocks: dict[str, np.ndarray]) -> None:
    """Give an IMU that the rows of faster samples repeat, time and all, its own rows and a group: `imu_t`, `imu_gx`, ....

    Joins of tables leave it so (`pandas.merge_asof`).
    """
    different = {clock: len(np.unique(columns.values[clock])) for clock in clocks if clock in columns.values}
    finest, separate = max(different, key=lambda clock: different[clock], default=""), Columns()
    spelled = {c: name_and_unit(c, columns.units.get(c, ""))[0] for c in columns.values}
    for clock in [c for c in before if 1 < different.get(c, 0) < different[finest]]:
        is_still = np.diff(columns.values[clock].astype(float)) == 0.0
        steps = ((c, np.diff(columns.values[c])) for c in spelled if spelled[c].startswith(f"{before[clock]}_"))
        of = [c for c, each in steps if not each[is_still].any()]
        names, spaced = {c: spelled[c] for c in of}, {c: spaced_name(c) for c in of}
        if finest in of or not all(triples(sensor, names, spaced) for sensor in ("gyro", "accel")):
            continue
        rows = np.concatenate([[True], ~is_still]) & clocks[clock]
        for column in sorted(of, key=lambda c: c != clock):
            _take_rows(columns, column, rows, separate, f"{before[clock]}/{'time' if column == clock else column}")
            del spelled[column]
        separate.units[f"{before[clock]}/time"] = columns.units.get(clock) or name_and_unit(clock, "")[1]
        columns.remarks.notes.append(f"{is_still.sum()} rows repeat the samples at {clock!r}, which are taken once")
    for column in spelled if separate.values else ():
        group, name = before.get(finest) or finest, "time" if column == finest else column
        _take_rows(columns, column, clocks[finest], separate, f"{group}/{name}")
        separate.units |= (
            {f"{group}/time": columns.units.get(finest) or name_and_unit(finest, "")[1]} if column == finest else {}
        )
    if separate.values:
        columns.values, columns.units, columns.texts = separate.values, separate.units, separate.texts


def _take_rows(columns: Columns, column: str, rows: np.ndarray, into: Columns, name: str) -> None:
    """Put some rows of a column into other columns."""
    into.values[name], into.units[name] = columns.values[column][rows], columns.units.get(column, "")
    if column in columns.texts:
        into.texts[name] = [*compress(columns.texts[column], rows)]


def join_positions(columns: Columns) -> None:
    """Give orientations in a table of their own the positions of another one.

    They are interpolated to the times of the orientations, but not across gaps.
    """
    turns, places = dict[str, str](), dict[str, list[str]]()  # times of such tables, by group
    for group in columns.sources.keys() - {IMU_GROUP, *SENSORS}:
        own = {column.removeprefix(f"{group}/"): column for column in columns.values if column.startswith(f"{group}/")}
        leaves = {leaf: own[name] for name, (_, leaf) in pose_leaves(own).items()}
        times = [c for leaf, c in leaves.items() if re.fullmatch(TIME_WORDS, leaf) and goes_on(columns.values[c])]
        position, is_turned = position_of(leaves), has_turns(leaves)
        if times and is_turned and not position:
            turns[group] = times[0]
        elif times and position and not is_turned and re.fullmatch(POSITIONS, split_name(group)[0]):
            places[group] = [times[0], *position]
    if len(turns) != 1 or len(places) != 1:
        return
    ((group, time),), ((other, (at, *position)),) = turns.items(), places.items()
    units = [name_and_unit(each, columns.units.get(each, ""))[1] for each in (time, at)]
    t, t_p = (columns.values[each].astype(float) for each in (time, at))
    if units[0] != units[1] or len(t_p) < 2:
        return
    behind = np.clip(np.searchsorted(t_p, t), 1, len(t_p) - 1)
    is_known = (t >= t_p[0]) & (t <= t_p[-1]) & (np.diff(t_p)[behind - 1] <= MAX_STEPS * np.median(np.diff(t_p)))
    for axis, column in zip("xyz", position, strict=True):
        name = f"{group}/position_{axis}"
        columns.values[name] = np.where(is_known, np.interp(t, t_p, columns.values[column].astype(float)), np.nan)
        columns.units[name] = name_and_unit(column, columns.units.get(column, ""))[1]
    note = f"the positions of {columns.sources[other]} are interpolated to the times of {columns.sources[group]}"
    columns.remarks.notes.append(f"{note}, which has orientations")
