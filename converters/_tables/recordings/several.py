"""Recordings in groups of their own: `trial1/gyro`, a sheet, an element of a structure.

Groups are recordings by their names (`trial1`), or where they have no times in common, as sensors of one body have.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from itertools import count

import numpy as np

from imutool.recording.message_log import Remarks

from ..columns.groups import is_time, is_true, measured
from ..columns.headerless import in_an_array
from ..columns.times import goes_on
from ..files.layouts import known_layout
from ..text.delimited import Columns
from ..text.names import group_of, is_recording, is_sensor, leaf_of, spaced_name, split_name, triples

LONGEST_LABEL = 40  # characters, of a file's name
LOOKED_AT = 1000  # first values of an array, which show whether it holds an IMU
FROM_ZERO = 0.1  # share of its length after which a time that counts from the start of a recording has begun
SAME_END = 0.02  # share of their length by which the times of sensors differ that were started and stopped together


def groups_apart(columns: Columns) -> dict[str, Columns]:
    """Columns of each recording that groups tell apart; all without a name where groups do not.

    What is in no recording's group is in every one.
    """
    for parent in [] if known_layout(columns) else _parents(columns):
        names = _names_by_group(columns, parent)
        shared = names.pop("", {})
        groups = {group: renamed(columns, inside) for group, inside in names.items() if not is_true(f"{group}/")}
        imus = {group: part for group, part in groups.items() if _has_imu(part)}
        if len(imus) > 1 and _are_recordings(parent, imus):
            shared |= {name: name for group in names.keys() - imus.keys() for name in names[group]}
            labels = {own: columns.sources[own] for group in imus if (own := f"{parent}{group}") in columns.sources}
            found: dict[str, Columns] = {}
            for group in imus:
                name, part = part_name(leaf_of(parent[:-1]), group), renamed(columns, shared | names[group])
                part.remarks = _without(columns.remarks, [label for own, label in labels.items() if own != f"{parent}{group}"])
                for inner, each in groups_apart(part).items():
                    found[distinct("_".join(filter(None, (name, inner))), found)] = each
            return found
    return {"": columns}


def part_name(column: str, text: str) -> str:
    """Name of a recording by its label: `trial_3`, and `S01` for a label that is no number."""
    plain = re.sub(r"[^\w.+-]+", "_", text).strip("_.")[:LONGEST_LABEL] or "blank"
    return f"{split_name(column)[0] or 'part'}_{plain}" if plain.isdigit() else plain


def distinct(name: str, others: Mapping[str, object]) -> str:
    """The name, or `name 2` for one that others have."""
    if name not in others:
        return name
    return next(unused for number in count(2) if (unused := f"{name} {number}") not in others)


def _parents(columns: Columns) -> list[str]:
    """Groups that have groups in them, the outermost first, each with the mark behind it; the empty one is the file."""
    groups = {group for name in columns.values if (group := group_of(name))}
    ends = {group[: match.end()] for group in groups for match in re.finditer(r"[/.]", group)}
    return ["", *sorted(ends, key=lambda end: (len(re.findall(r"[/.]", end)), end))]


def _names_by_group(columns: Columns, parent: str) -> dict[str, dict[str, str]]:
    """Names without those of their groups, by the groups directly below another; under no name those in none of them."""
    found: dict[str, dict[str, str]] = {}
    for name in [*columns.values, *columns.labels, *columns.numbers, *columns.sources]:
        around = name if name in columns.sources else group_of(name)
        group = re.split(r"[/.]", around[len(parent) :], maxsplit=1)[0] if around.startswith(parent) else ""
        found.setdefault(group, {})[name] = name[len(parent) + len(group) + 1 :] if group else name
    return found


def renamed(columns: Columns, names: Mapping[str, str]) -> Columns:
    """Some columns under other names, without remarks."""
    part = Columns(has_structures=columns.has_structures, is_mocap=columns.is_mocap)
    for field in ("values", "units", "numbers", "texts", "labels", "sources"):
        setattr(part, field, {new: each[old] for old, new in names.items() if new and old in (each := getattr(columns, field))})
    return part


def _without(remarks: Remarks, labels: list[str]) -> Remarks:
    """Remarks but for those on other tables, which begin with their labels."""
    prefixes = tuple(f"{label}: " for label in labels)
    notes, losses = ([each for each in texts if not each.startswith(prefixes)] for texts in (remarks.notes, remarks.losses))
    return replace(remarks, notes=notes, losses=losses)


def _has_imu(columns: Columns) -> bool:
    """Whether columns, or groups of them, have a gyro and an accelerometer."""
    names = {column: split_name(column)[0] for column in measured(columns)}
    spaced = {column: spaced_name(column) for column in names}
    if all(triples(sensor, names, spaced) for sensor in ("gyro", "accel")):
        return True
    return bool(in_an_array(replace(columns, values={name: values[:LOOKED_AT] for name, values in columns.values.items()})))


def _are_recordings(parent: str, parts: Mapping[str, Columns]) -> bool:
    """Whether groups with an IMU each are recordings, and not sensors of one.

    Without a word for either in their names they are where each has true poses of its own, and where their times begin at
    zero and end apart.
    """
    names = [f"{leaf_of(parent[:-1])}_{name}" if name.isdigit() else name for name in parts]
    if all(map(is_recording, names)):
        return True
    every = [_clock(part) for part in parts.values()]
    clocks = [clock for clock in every if len(clock)]
    if len(clocks) < len(every):
        return not all(map(is_sensor, names)) and len({max(map(len, part.values.values())) for part in parts.values()}) > 1
    first, last = (np.array([clock[end] for clock in clocks], dtype=float) for end in (0, -1))
    if all(map(is_sensor, names)) or first.max() >= last.min():
        return bool(first.max() >= last.min())
    if all(any(map(is_true, part.values)) for part in parts.values()):
        return True
    spans = last - first
    return bool((first < FROM_ZERO * spans).all() and np.ptp(last) > SAME_END * spans.max())


def _clock(columns: Columns) -> np.ndarray:
    """Time of a group's longest columns; empty without one."""
    times = [values for name, values in columns.values.items() if is_time(name) and goes_on(values)]
    return max(times, key=len, default=np.zeros(0))
