"""Time of a table's samples: a column and its unit, or a rate at which they are counted."""

from __future__ import annotations

import re

import numpy as np

from ..text.delimited import Columns
from ..text.names import OWN_TIME, TIME_WORDS, XSENS_TIME, name_and_unit, spaced_name, unit_named
from .groups import shared_group
from .map import RATE_TO_STATE, Entries, Proposal, column_named
from .pose_names import TRUE_GROUPS
from .times import (
    MAX_SKIPPED,
    PLAUSIBLE_HZ,
    count_times,
    counters_of,
    counts_others,
    goes_on,
    in_batches,
    rate_of_rows,
    rises,
    said_steps,
    share_skipped,
    stated_rate,
    units_of_time,
    usual_step,
)
from .units import TIME_NS
from .wraps import begun_anew

MAX_APART, WHOLE_NS = 0.1, 2e9  # between the spans of two times of a table, of which one may count whole seconds
SENSOR_TIME = r"(.*_)?(sensor|event|hardware|hw|device|imu)_?(event_?)?(time|t_|ts|stamp)"  # next to the time of the program
OF_MAVLINK = r"time_(usec|boot_ms)$"  # the same, next to the receiver's `timestamp`


def propose_time(proposal: Proposal, names: dict[str, tuple[str, str]], columns: Columns, given: Entries) -> None:
    """Column of the time and its unit, as stated, from its name or from a plausible rate."""
    gyro = proposal.unsigned("gyro", columns)
    length = len(columns.values[gyro[0]]) if gyro else None
    if "rate_hz" in given:
        _count_at(proposal, columns, given, length or 0)
        return
    if "time" in given:
        column_named(columns, given["time"], "mapping")
        proposal.entries["time"] = given["time"]
        _propose_time_unit(proposal, given["time"], names, columns)
        return
    spelled = {c: (name or unit, spaced_name(c)) for c, (name, unit) in names.items()}
    forms = rf"(.*_)?{TIME_WORDS}|{OWN_TIME['gyro']}|{OWN_TIME['accel']}"
    found = named = [c for c, each in spelled.items() if any(re.fullmatch(forms, name) for name in each)]
    others = [c for c in found if length not in (None, len(columns.values[c])) and rises(columns.values[c])]
    found = [c for c in found if length in (None, len(columns.values[c]))]
    still, found = [c for c in found if not goes_on(columns.values[c])], [c for c in found if goes_on(columns.values[c])]
    found.sort(key=lambda c: names[c][0] == "t")  # next to a longer name it may be a temperature, which rises too
    found.sort(key=lambda c: in_batches(columns.values[c]))
    if gyro:
        found.sort(key=lambda c: (_table_of(c) != _table_of(gyro[0]), -shared_group(c, gyro[0])))
        found.sort(key=lambda c: not re.match(OWN_TIME["gyro"], spelled[c][1]))
    found.sort(key=lambda c: re.match(rf"{TRUE_GROUPS}_", names[c][0]) is not None)
    found = _steadiest_first(found, spelled, columns, proposal)
    found.sort(key=lambda c: not names[c][0].endswith("header_stamp"))
    shown = (proposal.unsigned("accel", columns) or [*names])[:1]
    counters = counters_of(columns, length or len(columns.values[shown[0]]) if shown else 0)
    if not found:
        measured = {*counters, *gyro, *proposal.unsigned("accel", columns)}
        why, found = _unnamed_time(names, columns, counters, [c for c in names if c not in measured], length)
        proposal.reasons += [f"{column!r} {why}: it counts as the time" for column in found]
    if not found:
        proposal.reasons += [f"{c!r} rises and has {len(columns.values[c])} rows, and the gyro {length}" for c in others]
        for column in still:
            values = columns.values[column]
            counts = f"does not rise: {len(np.unique(values))} different values in {len(values)} rows"
            falls = "falls from row to row: sort the rows by it"
            proposal.reasons.append(f"{column!r} is named as a time and {falls if rises(values[::-1]) else counts}")
            proposal.hints += rate_of_rows(column, values, columns.units.get(column, "") or names[column][1])
        _propose_rate(proposal, columns, next(iter(counters), ""), length)
        return
    column = proposal.entries["time"] = found[0]
    if in_batches(columns.values[column]):
        several = len(columns.values[column]) / len(np.unique(columns.values[column]))
        proposal.reasons.append(f"{column!r} has a stamp for {several:.3g} rows each in the mean")
    if own := _accel_time([c for c in named if names[c][1] == names[column][1]], column, spelled, columns, proposal):
        proposal.entries["accel_time"] = own
    elif times := _repeated_times(found, columns, proposal):
        proposal.entries |= times
        column = times["time"]
    _propose_time_unit(proposal, column, names, columns)
    if column in counters and "time_unit" in proposal.open:
        proposal.hints.append(
            f"rate_hz = {RATE_TO_STATE} and counter = {column!r}  # in place of time and time_unit, if it counts samples"
        )


def _accel_time(named: list[str], time: str, spelled: dict[str, tuple[str, str]], columns: Columns, proposal: Proposal) -> str:
    """Time of the accelerometer's own, by its name next to that of the gyro, or by its rows; else empty."""
    accel = proposal.unsigned("accel", columns)
    count = len(columns.values[accel[0]]) if accel else 0
    fits = [c for c in named if c != time and len(columns.values[c]) == count and goes_on(columns.values[c])]
    own = [c for c in fits if re.match(OWN_TIME["accel"], spelled[c][1])]
    if count != len(columns.values[time]):
        own = own or (fits if len(fits) == 1 else [])
    elif not re.match(OWN_TIME["gyro"], spelled[time][1]):
        own = []
    return next(iter(own), "")


def _count_at(proposal: Proposal, columns: Columns, given: Entries, length: int) -> None:
    """Count the samples at a given rate, by the given counter, or by one that shows which samples are lost."""
    if counter := given.get("counter", ""):
        column_named(columns, counter, "mapping")
    elif counter := next(filter(lambda c: _shows_losses(columns.values[c]), counters_of(columns, length)), ""):
        proposal.entries["counter"] = counter
        proposal.reasons.append(f"{counter!r} counts the samples: rate_hz is that of its steps")
    if length:
        proposal.entries |= {"time": count_times(columns, given["rate_hz"], length, counter), "time_unit": "s"}


def _shows_losses(counter: np.ndarray) -> bool:
    """Whether the steps of a counter that are longer than the usual one are lost samples, as far as it shows."""
    return not (len(begun_anew(counter)) or counts_others(counter)) and share_skipped(counter) <= MAX_SKIPPED


def _unnamed_time(
    names: dict[str, tuple[str, str]], columns: Columns, counters: list[str], others: list[str], length: int | None
) -> tuple[str, list[str]]:
    """Why a column counts as the time that no name shows, and that column; none where several may.

    Of each table it is the first column without a count of rows; further columns may rise as a temperature does.
    """
    firsts = {_table_of(c): c for c in reversed(names) if c not in counters}.values()
    fits = [c for c in others if length in (None, len(columns.values[c])) and rises(columns.values[c])]
    stated = [c for c in fits if (unit_named(columns.units.get(c, "")) or names[c][1]) in TIME_NS]
    if len({columns.values[c].tobytes() for c in stated}) == 1:  # one for each signal, as of Delsys
        stated = stated[:1]
    tries = {
        "alone rises in a unit of time": stated,
        "rises and is the first column that holds no count": [c for c in fits if c in firsts],
        "alone rises as a time since 1970 does": [c for c in fits if _is_of_this_century(columns.values[c].astype(float))],
    }
    return next(((why, each) for why, each in tries.items() if len(each) == 1), ("", []))


def _repeated_times(found: list[str], columns: Columns, proposal: Proposal) -> dict[str, str]:
    """Times of gyro and accelerometer where a time of one name stands in front of each: `time, ax, ..., time, gx, ...`.

    A name that repeats was told apart by a number, or by the column in front of it (`distinct_names`).
    """
    order, base, own = [*columns.values], min(found, key=len), dict[str, str]()
    for entry, sensor in (("time", "gyro"), ("accel_time", "accel")):
        place = min(map(order.index, proposal.unsigned(sensor, columns)), default=0)
        before = order[place - 1] if place else ""
        names = {base, f"{order[place - 2]}.{base}"} if place > 1 else {base}
        if not ((before in names or re.fullmatch(rf"{re.escape(base)}[._]\d+", before)) and rises(columns.values[before])):
            return {}
        own[entry] = before
    return {} if np.array_equal(columns.values[own["time"]], columns.values[own["accel_time"]]) else own


def _steadiest_first(found: list[str], spelled: dict[str, tuple[str, str]], columns: Columns, proposal: Proposal) -> list[str]:
    """Times of the samples, a sensor's own before a program's that is less even."""
    named = [c for c in found[1:] if re.match(SENSOR_TIME, spelled[c][1]) or re.search(OF_MAVLINK, c)]
    own = [c for c in named if not _table_of(c)]
    if not own or _unevenness(columns.values[own[0]]) >= _unevenness(columns.values[found[0]]):
        return found
    proposal.reasons.append(f"{own[0]!r} is the sensor's own time and steadier than {found[0]!r}: it counts as the time")
    return [own[0], *(c for c in found if c != own[0])]


def _unevenness(values: np.ndarray) -> float:
    """Standard deviation of the steps over their mean."""
    steps = np.diff(values.astype(float))
    return float(np.nanstd(steps) / np.nanmean(steps))


def _is_of_this_century(values: np.ndarray) -> bool:
    """Whether a column counts from 1970 in a unit of time."""
    return any(1e18 < values[0] * TIME_NS[unit] < 4e18 for unit in units_of_time(values[0], float(np.median(np.diff(values)))))


def _table_of(column: str) -> str:
    """Table of a folder that a column is of; a unit behind its name may hold a slash."""
    return re.sub(r"[\[(][^\])]*[\])]\s*$", "", column).rpartition("/")[0]


def _propose_time_unit(proposal: Proposal, column: str, names: dict[str, tuple[str, str]], columns: Columns) -> None:
    """Unit of the time, as stated or by a plausible rate that no other time contradicts."""
    name, unit_in_name = name_and_unit(column, "")
    if (unit := unit_named(columns.units.get(column, "")) or unit_in_name) in TIME_NS:  # a calendar's is not the header's
        proposal.entries["time_unit"] = unit
        return
    values = columns.values[column].astype(float)
    step = usual_step(values)
    if re.fullmatch(rf"(.*_)?{XSENS_TIME}", name):
        counts = "100us" if step * TIME_NS["100us"] <= 1e9 / PLAUSIBLE_HZ[0] else "us"
        proposal.entries["time_unit"] = counts
        proposal.reasons.append(f"{column!r} counts {counts.replace('00us', '00 us')}, as an Xsens sensor does")
        return
    certain = units_of_time(float(values[0]), step)
    if len(certain) == 1 and (other := _another_pace(columns, column, certain[0], names)):
        proposal.open.append("time_unit")
        proposal.reasons.append(f"{column!r} would count {certain[0]}, but {other}")
        return
    if len(certain) == 1:
        proposal.entries["time_unit"] = certain[0]
        what = "rows" if in_batches(values) else "samples"  # which may repeat one another
        proposal.reasons.append(f"{column!r} counts {certain[0]}: {1e9 / (step * TIME_NS[certain[0]]):.1f} {what} a second")
    else:
        proposal.open.append("time_unit")
        proposal.reasons.append(f"{column!r} states no unit, and a step of {step:.4g} fits {' and '.join(certain) or 'none'}")


def _another_pace(columns: Columns, column: str, unit: str, names: dict[str, tuple[str, str]]) -> str:
    """How another time, whose unit is stated, contradicts the unit of this one; empty if none does."""
    span = float(columns.values[column][-1] - columns.values[column][0]) * TIME_NS[unit]
    for other, (_, unit_in_name) in names.items():
        values, stated = columns.values[other], unit_named(columns.units.get(other, "")) or unit_in_name
        if other != column and stated in TIME_NS and len(values) == len(columns.values[column]) and goes_on(values):
            passed = float(values[-1] - values[0]) * TIME_NS[stated]
            if abs(passed - span) > MAX_APART * passed + WHOLE_NS:
                return f"by {other!r} {passed * 1e-9:.4g} s pass and not {span * 1e-9:.4g} s"
    return ""


def _propose_rate(proposal: Proposal, columns: Columns, counter: str, length: int | None) -> None:
    """Sampling rate of samples that are counted, in place of a time."""
    counted = f"{counter!r} counts the samples" if counter else "no column holds the time: rows are counted"
    rate = stated_rate(columns, (proposal.unsigned("gyro", columns) or [""])[0])
    used = counter
    if counter and counts_others(columns.values[counter]):
        used = ""
        counted = f"{counter!r} counts more than the samples ({said_steps(columns.values[counter])}): rows are counted"
    elif counter and share_skipped(columns.values[counter]) > MAX_SKIPPED:
        proposal.open.append("counter")
        proposal.reasons.append(
            f"{said_steps(columns.values[counter])} in {counter!r}: are samples missing, or does it count packets of other"
            " sensors, too? For the second, leave it out of the map"
        )
    proposal.entries |= {"counter": used} if used else {}
    if rate is None:
        proposal.open += ["rate_hz"] if counter else ["time", "time_unit"]
        what = counted if counter else "no column that rises looks like a time"
        proposal.reasons.append(f"{what}, and no number in the file is named as a sampling rate")
        return
    proposal.rate_hz = rate[1]
    proposal.reasons.append(f"{counted}, at the {rate[0]!r} of {rate[1]:.6g} Hz that the file states")
    if length:
        proposal.entries |= {"time": count_times(columns, rate[1], length, used), "time_unit": "s"}
