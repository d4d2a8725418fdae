"""Map that a table shows by the names of its columns, the units in them, and the values."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from imutool.recording.gyro_steps import COUNTS_A_DPS, unit_by_steps

from ..text.delimited import Columns
from ..text.names import (
    BIAS,
    CORE_MOTION,
    ESTIMATED,
    SI_WORDS,
    WITHOUT_GRAVITY,
    group_of,
    is_compensated,
    leaf_of,
    name_and_unit,
    spaced_name,
    split_name,
    triples,
)
from .clock import propose_time
from .groups import measured
from .headerless import in_an_array, perhaps
from .map import IN_WHOLE, NO_UNIT, Entries, Proposal, column_named
from .motion import doubt_gravity, unit_by_motion
from .times import usual_step
from .units import (
    ACCEL_SI,
    GYRO_SI,
    STANDARD_GRAVITY,
    TIME_NS,
    are_unsigned_counts,
    gravity_units,
    raw_counts,
)

RANGES = 250, 500, 1000, 2000  # deg/s, of InvenSense's gyros
NEAR_FEET = 0.05  # share by which an acceleration may differ from gravity in ft/s^2, as one of 3.3 g in m/s^2 does
MIN_COUNTS = 50.0  # of gravity in whole numbers
LONGEST_STEP_NS = 5e8  # of increments
ROUNDING = 1e-6  # of the span of a column's values, by which a copy of it may differ
MAX_SHOWN = 12  # triples of columns in a message
NOTHING: Entries = {}


def propose(columns: Columns, given: Entries = NOTHING) -> Proposal:
    """Map that names, units and magnitudes of the columns suggest, around what the user states.

    Raises:
        ConfigError: a stated column does not exist.
    """
    proposal = Proposal({}, [], [])
    names = {column: name_and_unit(column, columns.units.get(column, "")) for column in measured(columns)}
    sensors = {sensor: _triples(sensor, names, columns) for sensor in ("gyro", "accel")}
    sensors["accel"] = _beside(sensors["gyro"], sensors["accel"])
    if not any(sensors.values()) and (array := in_an_array(columns)):
        proposal.reasons.append(f"{', '.join(array['accel'])} show gravity and count as the accel")
        given = array | given
    for sensor, units in (("gyro", GYRO_SI), ("accel", ACCEL_SI)):
        _propose_sensor(proposal, sensor, units, sensors[sensor], names, columns, given)
    proposal.state({name: value for name, value in given.items() if name in IN_WHOLE})
    propose_time(proposal, names, columns, given)
    proposal.state(given)
    if "accel" not in given:
        doubt_gravity(proposal, columns)
    _propose_increments(proposal, columns)
    if "gyro" in proposal.entries and "gyro" not in proposal.open:
        _propose_gyro_unit(proposal, columns, given)
    if not proposal.entries.keys() & {"gyro", "accel"}:
        proposal.hints += perhaps(columns)
    time = str(proposal.entries.get("time", ""))
    if any(is_compensated(column, time) for sensor in sensors for column in proposal.entries.get(sensor, [])):
        proposal.reasons.append("the columns are compensated: the filter in the sensor has removed the biases that it knows")
    accel = proposal.entries.get("accel", [""])
    if "accel" not in given and re.match(CORE_MOTION, spaced_name(accel[0])):
        proposal.entries["accel"] = [f"-{column}" for column in accel]
        proposal.reasons.append(
            f"{accel[0]}/y/z are of CoreMotion, whose accelerometer reads -1 g along the axis that points up"
        )
    return proposal


def _propose_sensor(
    proposal: Proposal,
    sensor: str,
    units: dict[str, float],
    found: Sequence[dict[str, str]],
    names: dict[str, tuple[str, str]],
    columns: Columns,
    given: Entries,
) -> None:
    """Columns of the three axes, and their unit."""
    if sensor in given:
        for column in given[sensor]:
            column_named(columns, columns.unsigned(column), "mapping")
        proposal.entries[sensor] = given[sensor]
        if unit := given.get(f"{sensor}_unit", ""):
            proposal.entries[f"{sensor}_unit"] = unit
        else:
            _propose_stated(proposal, sensor, units, names, columns)
        return
    whole = _with_gravity(found, columns) if sensor == "accel" else found
    if len(whole) < len(found):
        proposal.reasons.append(f"of {len(found)} accelerations {whole[0]['x']}/y/z is the one with gravity")
    if len(pair := sorted(whole, key=lambda each: _range_of(each) != "ln")) == 2 and [*map(_range_of, pair)] == ["ln", "wr"]:
        whole = pair[:1]
        note = f"{pair[0]['x']}/y/z is the low-noise accelerometer of two, which has the smaller range"
        proposal.reasons.append(f"{note}: a map can name {pair[1]['x']}/y/z in its place")
    if len(whole) != 1:
        proposal.open += [sensor] if whole else [sensor, f"{sensor}_unit"]
        shown = ", ".join(f"{triple['x']}/y/z" for triple in whole[:MAX_SHOWN])
        how_many = f"{len(whole)} triples of" if whole else "no"
        proposal.reasons.append(f"{how_many} columns look like the {sensor}{': ' * bool(shown)}{shown}")
    if not whole:
        return
    proposal.entries[sensor] = [whole[0][axis] for axis in "xyz"]
    _propose_stated(proposal, sensor, units, names, columns)


def _range_of(triple: dict[str, str]) -> str:
    """Kind of one of the two accelerometers of a Shimmer: `ln` with low noise, `wr` with a wide range; else empty."""
    match = re.search(r"(?:^|_)(?:(ln|low_?noise)|(wr|wide_?range))(?:_|$)", spaced_name(triple["x"]))
    return ("ln" if match[1] else "wr") if match else ""


def _propose_stated(
    proposal: Proposal, sensor: str, units: dict[str, float], names: dict[str, tuple[str, str]], columns: Columns
) -> None:
    """Unit that the names of a sensor's columns state, or their values show."""
    chosen = proposal.unsigned(sensor, columns)
    stated = {names[column][1] for column in chosen} - {""}
    if len(stated) == 1 and stated <= units.keys():
        proposal.entries[f"{sensor}_unit"] = stated.pop()
    elif len(stated) > 1:
        proposal.open += [sensor, f"{sensor}_unit"]
        listed = ", ".join(chosen)
        proposal.reasons.append(f"{listed} state different units: {sensor}_scale = [x, y, z] in a map brings them to one")
    elif re.search(SI_WORDS, names[chosen[0]][0]):
        unit = proposal.entries[f"{sensor}_unit"] = next(iter(units))
        level, near = gravity_units(columns, chosen) if sensor == "accel" else (0.0, [])
        if near and unit not in near:
            proposal.open.append("accel_unit")
            note = f"the median acceleration is {level:.4g}: gravity in {' or '.join(near)}"
            proposal.reasons.append(f"by their names the columns may be in {unit}, and {note}")
    else:
        _propose_unit(proposal, sensor, columns)


def _triples(sensor: str, names: dict[str, tuple[str, str]], columns: Columns) -> Sequence[dict[str, str]]:
    """Columns x, y and z that are named as a sensor's, measured ones before estimated ones."""
    plain = {column: name for column, (name, _) in names.items()}
    spaced = {column: spaced_name(column) for column in names}
    every = [*triples(sensor, plain, spaced).values()] or _by_units(GYRO_SI if sensor == "gyro" else ACCEL_SI, names)
    return [triple for triple in every if not re.search(ESTIMATED, spaced[triple["x"]])] or every


def _by_units(units: dict[str, float], names: dict[str, tuple[str, str]]) -> list[dict[str, str]]:
    """Columns x, y and z of one name, in a sensor's unit: `X (rad/s)`, `Vitesse X (rad/s)`; none of several."""
    found: dict[str, dict[str, str]] = {}
    for column in [column for column, (_, unit) in names.items() if unit in units]:
        match = re.fullmatch(r"(?P<of>.*?)_?(?P<axis>[xyz])|(?P<first>[xyz])_(?P<rest>.*)", split_name(leaf_of(column))[0])
        if match and not re.search(rf"{BIAS}|{ESTIMATED}|(^|_)b_", spaced_name(column)):
            of, axis = group_of(column) + (match["of"] or match["rest"] or ""), match["axis"] or match["first"]
            found.setdefault(of, {})[axis] = column
    whole = [each for each in found.values() if {*each} == {*"xyz"}]
    return whole if len(whole) == 1 else []


def _beside(gyros: Sequence[dict[str, str]], accels: Sequence[dict[str, str]]) -> Sequence[dict[str, str]]:
    """Accelerations of the gyro's own table or group; all where it has none, or where there are several gyros."""
    own = {group_of(gyro["x"]).split("/")[0] for gyro in gyros}
    return [accel for accel in accels if {group_of(accel["x"]).split("/")[0]} == own] or accels


def _with_gravity(found: Sequence[dict[str, str]], columns: Columns) -> Sequence[dict[str, str]]:
    """The one of several accelerations that has gravity, by its name or by its size; all where none stands out."""
    named = [triple for triple in found if not re.search(WITHOUT_GRAVITY, spaced_name(triple["x"]))]
    sized = [triple for triple in named if gravity_units(columns, list(triple.values()))[1]]
    return next((each for each in (named, sized) if len(each) == 1), found)


def _propose_gyro_unit(proposal: Proposal, columns: Columns, given: Entries) -> None:
    """Unit of the gyro from the steps in which it counts, and from how gravity turns in the accelerometer."""
    steps = unit_by_steps(columns.side_by_side(proposal.entries["gyro"]))
    note = f"the gyro counts in steps of {steps[1]:.6g} {steps[0]}, as a common sensor does" if steps else ""
    stated = proposal.entries.get("gyro_unit", "")
    if stated and steps and steps[0] != stated and "gyro_unit" not in given:
        proposal.open.append("gyro_unit")
        proposal.reasons.append(f"the names of the columns say {stated}, and {note}")
    elif stated and not {*proposal.open} | ({"gyro", "gyro_unit"} & given.keys()) and not _states_unit(proposal, columns):
        motion = unit_by_motion(proposal, columns)
        if motion and motion[0] != stated:
            proposal.open.append("gyro_unit")
            proposal.reasons.append(f"by their names the columns may be in {stated}, and {motion[1]}")
    if "gyro_unit" not in proposal.open or stated:
        return
    motion = unit_by_motion(proposal, columns) if {*proposal.open} <= {"gyro_unit", "accel_unit"} else None
    found = {unit: reason for unit, reason in ((steps[0] if steps else "", note), motion or ("", "")) if unit}
    if len(found) == 1:
        proposal.settle_unit("gyro", *found.popitem())
    else:
        proposal.reasons.extend(found.values())


def _states_unit(proposal: Proposal, columns: Columns) -> bool:
    """Whether a column of the gyro states its unit, and not only a name that ROS uses."""
    return any(name_and_unit(c, columns.units.get(c, ""))[1] for c in proposal.unsigned("gyro", columns))


def _propose_unit(proposal: Proposal, sensor: str, columns: Columns) -> None:
    """Unit from the magnitude: gravity shows that of an accelerometer; no magnitude shows that of a gyro."""
    if sensor == "accel":
        level, near = gravity_units(columns, proposal.unsigned(sensor, columns))
        is_coarse = level < MIN_COUNTS and _are_whole(columns.side_by_side(proposal.unsigned(sensor, columns)))
        near = [] if is_coarse else near  # whole m/s^2 are counts of something else
        if len(near) == 1:
            proposal.reasons.append(f"the median acceleration is {level:.4g}: gravity in {near[0]}")
            proposal.entries["accel_unit"] = near[0]
            return
        if are_unsigned_counts(columns.side_by_side(proposal.unsigned(sensor, columns))):
            near = []
            proposal.reasons.append("the accel holds whole numbers, none below zero: raw counts, with a zero of their own?")
            proposal.hints += [
                'accel_offset = [x, y, z]  # counts without force, and accel_scale the g of a count with accel_unit = "g"',
                'gyro_offset = [x, y, z]  # counts at rest, and gyro_scale the deg/s of a count with gyro_unit = "deg/s"',
            ]
        if near:
            proposal.reasons.append(f"the median acceleration is {level:.4g}: gravity in {' or '.join(near)}")
        elif abs(level * ACCEL_SI["ft/s^2"] / STANDARD_GRAVITY - 1.0) < NEAR_FEET:
            proposal.reasons.append(f"the median acceleration is {level:.4g}: gravity in ft/s^2?")
        if raw := raw_counts(columns.side_by_side(proposal.entries[sensor])):
            note = f"±{raw[0]} g ({raw[1]} counts a g)"
            proposal.reasons.append(
                f"the accel holds whole numbers of a median length of {level:.4g}: raw counts of a range of {note}?"
            )
            first, *others = (f"{1.0 / counts:.8g}" for counts in COUNTS_A_DPS[: len(RANGES)])
            proposal.hints += [
                f'accel_scale = {1.0 / raw[1]!r}  # with accel_unit = "g", if these are raw counts of {note}',
                f'gyro_scale = {first}  # with gyro_unit = "deg/s", for raw counts of ±{RANGES[0]} deg/s;'
                f" of ±{', ±'.join(map(str, RANGES[1:]))}: {', '.join(others)}",
            ]
    proposal.open.append(f"{sensor}_unit")
    proposal.reasons.append(NO_UNIT.format(sensor))


def _are_whole(values: np.ndarray) -> bool:
    """Whether all numbers are whole."""
    return not (values[np.isfinite(values)] % 1.0).any()


def _propose_increments(proposal: Proposal, columns: Columns) -> None:
    """Ask whether the columns hold the velocity and the angle of each sample, where a rate makes gravity of the first."""
    known = {"time", "time_unit", "accel"} <= proposal.entries.keys() and "time_unit" not in proposal.open
    if not known or "accel_unit" not in proposal.open:
        return
    t, unit = columns.values[str(proposal.entries["time"])].astype(float), str(proposal.entries["time_unit"])
    step_ns = usual_step(t) * TIME_NS[unit]
    if not 0.0 < step_ns < LONGEST_STEP_NS:  # of a second, an increment of velocity is as large as the acceleration
        return
    rate_hz = float(f"{1e9 / step_ns:.5g}")
    if "m/s^2" in gravity_units(columns, proposal.unsigned("accel", columns), rate_hz)[1]:
        proposal.reasons.append(f"times the {rate_hz:g} samples a second, the accel is gravity: it seems to hold increments")
        proposal.hints += [
            f'accel_scale = {rate_hz}  # with accel_unit = "m/s^2", if it holds increments of velocity (m/s)',
            f'gyro_scale = {rate_hz}  # with gyro_unit = "rad/s", if it holds increments of angle (rad)',
        ]


def without_copies(proposals: dict[str, Proposal], columns: Columns) -> dict[str, Proposal]:
    """IMUs without the copy in a table that joins those of a gyro and an accelerometer."""
    kept: dict[str, list[str]] = {}
    axes = {topic: [*each.unsigned("gyro", columns), *each.unsigned("accel", columns)] for topic, each in proposals.items()}
    tables = {topic: {group_of(name).split("/")[0] for name in names} for topic, names in axes.items()}
    for topic in sorted(axes, key=lambda topic: -len(tables[topic])):
        for other, names in kept.items():
            is_joined = len(tables[topic]) == 1 < len(tables[other]) and not tables[topic] & tables[other]
            if is_joined and len(names) == len(axes[topic]) == 6 and _equal(columns, axes[topic], names):
                columns.remarks.notes.append(f"{topic} is left out: it holds the samples of {other}")
                break
        else:
            kept[topic] = axes[topic]
    return {topic: each for topic, each in proposals.items() if topic in kept}


def _equal(columns: Columns, names: list[str], others: list[str]) -> bool:
    """Whether columns that vary are others, but for the rounding of their texts."""
    pairs = [(columns.values[a].astype(float), columns.values[b].astype(float)) for a, b in zip(names, others, strict=True)]
    return all(len(a) == len(b) and np.abs(a - b).max() < ROUNDING * np.ptp(a) for a, b in pairs)
