"""Map that a table shows by the names of its columns, the units in them, and the values."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from ._table_groups import is_true, shared_group
from ._table_headerless import perhaps
from ._table_map import NO_UNIT, Proposal
from ._table_motion import doubt_gravity, side_by_side, unit_by_motion
from ._table_names import (
    CORE_MOTION,
    ESTIMATED,
    ROS_WORDS,
    TIME_WORDS,
    WITHOUT_GRAVITY,
    XSENS_TIME,
    name_and_unit,
    spaced_name,
    triples,
    unit_named,
)
from ._table_text import Columns
from ._table_times import (
    MOST_SKIPPED,
    PLAUSIBLE_HZ,
    count_times,
    counters_of,
    counts_others,
    goes_on,
    rate_of_rows,
    rises,
    said_steps,
    share_skipped,
    stated_rate,
    units_of_time,
)
from ._table_units import (
    ACCEL_SI,
    COUNTS_A_DPS,
    GYRO_SI,
    TIME_NS,
    gravity_units,
    raw_counts,
    unit_by_steps,
)

MOST_APART, WHOLE_NS = 0.1, 2e9  # between the spans of two times of a table, of which one may count whole seconds
RANGES = 250, 500, 1000, 2000  # deg/s, of InvenSense's gyros
NO_IMU = ", and a recording of an IMU needs one"
MOST_SHOWN = 12  # triples of columns in a message
OWN_TIME = {"gyro": r"gyro(scope)?_t", "accel": r"accel(erometer)?_t"}  # names of a sensor's own stamps begin so


def propose(columns: Columns) -> Proposal:
    """Map that names, units and magnitudes of the columns suggest."""
    proposal = Proposal({}, [], [])
    names = {column: name_and_unit(column, columns.units.get(column, "")) for column in columns.values if not is_true(column)}
    for sensor, units in (("gyro", GYRO_SI), ("accel", ACCEL_SI)):
        _propose_sensor(proposal, sensor, units, names, columns)
    _propose_time(proposal, names, columns)
    doubt_gravity(proposal, columns)
    _propose_increments(proposal, columns)
    if "gyro" in proposal.entries and "gyro" not in proposal.open:
        _propose_gyro_unit(proposal, columns)
    if not proposal.entries.keys() & {"gyro", "accel"}:
        proposal.hints += perhaps(columns)
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
    every = [*triples(sensor, plain, spaced).values()]
    found = [triple for triple in every if not re.search(ESTIMATED, spaced[triple["x"]])] or every
    whole = _with_gravity(found, spaced, columns) if sensor == "accel" else found
    if len(whole) < len(found):
        proposal.reasons.append(f"of {len(found)} accelerations {whole[0]['x']}/y/z is the one with gravity")
    if len(whole) != 1:
        proposal.open += [sensor] if whole else [sensor, f"{sensor}_unit"]
        shown = "".join(f"{': ' if n == 0 else ', '}{triple['x']}/y/z" for n, triple in enumerate(whole[:MOST_SHOWN]))
        proposal.reasons.append(f"{len(whole)} triples of columns look like the {sensor}{shown or NO_IMU}")
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


def _with_gravity(found: Sequence[dict[str, str]], spaced: dict[str, str], columns: Columns) -> Sequence[dict[str, str]]:
    """The one of several accelerations that has gravity, by its name or by its size; all where none stands out."""
    named = [triple for triple in found if not re.search(WITHOUT_GRAVITY, spaced[triple["x"]])]
    sized = [triple for triple in named if gravity_units(columns, list(triple.values()))[1]]
    return next((each for each in (named, sized) if len(each) == 1), found)


def _propose_gyro_unit(proposal: Proposal, columns: Columns) -> None:
    """Unit of the gyro from the steps in which it counts, and from how gravity turns in the accelerometer."""
    steps = unit_by_steps(side_by_side(columns, proposal.entries["gyro"]))
    said = f"the gyro counts in steps of {steps[1]:.6g} {steps[0]}, as a common sensor does" if steps else ""
    stated = proposal.entries.get("gyro_unit", "")
    if stated and steps and steps[0] != stated:
        proposal.open.append("gyro_unit")
        proposal.reasons.append(f"the names of the columns say {stated}, and {said}")
    if "gyro_unit" not in proposal.open or stated:
        return
    motion = unit_by_motion(proposal, columns) if {*proposal.open} <= {"gyro_unit", "accel_unit"} else None
    found = {unit: reason for unit, reason in ((steps[0] if steps else "", said), motion or ("", "")) if unit}
    if len(found) == 1:
        proposal.settle_unit("gyro", *found.popitem())
    else:
        proposal.reasons.extend(found.values())


def _propose_unit(proposal: Proposal, sensor: str, columns: Columns) -> None:
    """Unit from the magnitude: gravity shows that of an accelerometer; no magnitude shows that of a gyro."""
    if sensor == "accel":
        level, near = gravity_units(columns, proposal.entries[sensor])
        if near:
            proposal.reasons.append(f"the median acceleration is {level:.4g}: gravity in {' or '.join(near)}")
        if len(near) == 1:
            proposal.entries["accel_unit"] = near[0]
            return
        if raw := raw_counts(side_by_side(columns, proposal.entries[sensor])):
            said = f"±{raw[0]} g ({raw[1]} counts a g)"
            proposal.reasons.append(
                f"the accel holds whole numbers of a median length of {level:.4g}: raw counts of a range of {said}?"
            )
            first, *others = (f"{1.0 / counts:.8g}" for counts in COUNTS_A_DPS[: len(RANGES)])
            proposal.hints += [
                f'accel_scale = {1.0 / raw[1]!r}  # with accel_unit = "g", if these are raw counts of {said}',
                f'gyro_scale = {first}  # with gyro_unit = "deg/s", for raw counts of ±{RANGES[0]} deg/s;'
                f" of ±{', ±'.join(map(str, RANGES[1:]))}: {', '.join(others)}",
            ]
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
        gyro = proposal.entries["gyro"][0]
        found.sort(key=lambda c: (_table_of(c) != _table_of(gyro), -shared_group(c, gyro)))
        found.sort(key=lambda c: not re.match(OWN_TIME["gyro"], spelled[c][1]))
    found.sort(key=lambda c: not (names[c][0].endswith("header_stamp") and columns.values[c].dtype.kind in "iu"))
    shown = proposal.entries.get("accel", [*names])[:1]
    counters = counters_of(columns, length or len(columns.values[shown[0]]) if shown else 0)
    measured = {*counters, *proposal.entries.get("gyro", ()), *proposal.entries.get("accel", ())}
    if not found:
        # of each table, without a count of rows; further columns may rise as a temperature does
        firsts = {_table_of(c): c for c in reversed(names) if c not in counters}.values()
        fits = [c for c in names if c not in measured and length in (None, len(columns.values[c])) and rises(columns.values[c])]
        clocks = [c for c in fits if (unit_named(columns.units.get(c, "")) or names[c][1]) in TIME_NS]
        rising = [c for c in fits if c in firsts]
        found = clocks if len(clocks) == 1 else rising if len(rising) == 1 else []
        why = "alone rises in a unit of time" if len(clocks) == 1 else "is the first column and rises"
        proposal.reasons += [f"{column!r} {why}: it counts as the time" for column in found]
    if not found:
        for column in still:
            values = columns.values[column]
            counts = f"{len(np.unique(values))} different values in {len(values)} rows"
            proposal.reasons.append(f"{column!r} is named as a time and does not rise: {counts}")
            proposal.hints += rate_of_rows(column, values, columns.units.get(column, "") or names[column][1])
        _propose_rate(proposal, columns, next(iter(counters), ""), length)
        return
    column = proposal.entries["time"] = found[0]
    if re.match(OWN_TIME["gyro"], spelled[column][1]):
        own = [c for c in found if re.match(OWN_TIME["accel"], spelled[c][1]) and names[c][1] == names[column][1]]
        proposal.entries |= {"accel_time": own[0]} if own else {}
    _propose_time_unit(proposal, column, names, columns)
    if column in counters and "time_unit" in proposal.open:
        proposal.hints.append(
            f"rate_hz = 100.0 and counter = {column!r}  # in place of time and time_unit, if it counts samples"
        )


def _table_of(column: str) -> str:
    """Table of a folder that a column is of; a unit behind its name may hold a slash."""
    return re.sub(r"[\[(][^\])]*[\])]\s*$", "", column).rpartition("/")[0]


def _propose_time_unit(proposal: Proposal, column: str, names: dict[str, tuple[str, str]], columns: Columns) -> None:
    """Unit of the time, as stated or by a plausible rate that no other time contradicts."""
    if (unit := unit_named(columns.units.get(column, "")) or names[column][1]) in TIME_NS:  # a calendar's is not the header's
        proposal.entries["time_unit"] = unit
        return
    values = columns.values[column].astype(float)
    step = float(np.nanmedian(np.diff(values)))
    if re.fullmatch(rf"(.*_)?{XSENS_TIME}", names[column][0]):
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
        proposal.reasons.append(f"{column!r} counts {certain[0]}: {1e9 / (step * TIME_NS[certain[0]]):.1f} samples a second")
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
            if abs(passed - span) > MOST_APART * passed + WHOLE_NS:
                return f"by {other!r} {passed * 1e-9:.4g} s pass and not {span * 1e-9:.4g} s"
    return ""


def _propose_increments(proposal: Proposal, columns: Columns) -> None:
    """Ask whether the columns hold the velocity and the angle of each sample, where a rate makes gravity of the first."""
    known = {"time", "time_unit", "accel"} <= proposal.entries.keys() and "time_unit" not in proposal.open
    if not known or "accel_unit" not in proposal.open:
        return
    t, unit = columns.values[str(proposal.entries["time"])].astype(float), str(proposal.entries["time_unit"])
    rate_hz = float(f"{1e9 / (np.nanmedian(np.diff(t)) * TIME_NS[unit]):.5g}")
    if "m/s^2" in gravity_units(columns, [*proposal.entries["accel"]], rate_hz)[1]:
        proposal.reasons.append(f"times the {rate_hz:g} samples a second, the accel is gravity: it seems to hold increments")
        proposal.hints += [
            f'accel_scale = {rate_hz}  # with accel_unit = "m/s^2", if it holds increments of velocity (m/s)',
            f'gyro_scale = {rate_hz}  # with gyro_unit = "rad/s", if it holds increments of angle (rad)',
        ]


def _propose_rate(proposal: Proposal, columns: Columns, counter: str, length: int | None) -> None:
    """Sampling rate of samples that are counted, in place of a time."""
    counted = f"{counter!r} counts the samples" if counter else "no column holds the time: rows are counted"
    rate = stated_rate(columns, proposal.entries.get("gyro", [""])[0])
    used = counter
    if counter and counts_others(columns.values[counter]):
        used = ""
        counted = f"{counter!r} counts more than the samples ({said_steps(columns.values[counter])}): rows are counted"
    elif counter and share_skipped(columns.values[counter]) > MOST_SKIPPED:
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
