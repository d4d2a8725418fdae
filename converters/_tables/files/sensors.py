"""Tables of one sensor each, as files of their own or as rows that name their sensor.

`Gyro.txt` next to `Accel.txt`; `1574572404895 TYPE_GYROSCOPE 0.12 0.35 0.43 3`; `ACCE;0.015;25347.8;0.1;0.2;9.8;3`.
The columns of the gyroscope and of the accelerometer become `gyro/time`, `gyro/x`, ....
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..columns.headerless import name_headerless
from ..columns.times import in_batches, rises
from ..text.delimited import Columns, read_csv
from ..text.header import COMMENTS
from ..text.names import UNITS, is_of_recordings, split_name
from ..text.numbers import is_number

SENSORS = {  # words in the names of files and of sensors
    "gyro": r"gyrm?|gyros?|gyroscopes?|gyroskop|giroscopio|giroscopo|angularvelocity|rotationrate",
    "accel": r"acc[elm]?|accels?|accelerometers?|accelerations?|acelerometro|accelerometre|beschleunigung(ssensor)?",
}
OTHERS = r"bias|biases|calib|calibration|linear|linea[lr]|user|gravity|noise|allan|stride|labels?"
UNCORRECTED = r"uncal|uncalib|uncalibrated|raw|ref|reference"  # taken where nothing else is there: not calibrated, or ideal
WORD = r"[A-Z]?[a-z]+|[A-Z]+"
POSE = ["time", *(f"position_{a}" for a in "xyz"), *(f"quaternion[{k}]" for k in range(4))]
RIGID = ["time", *(name for row in range(3) for name in (*(f"rotation_{row}{k}" for k in range(3)), f"position_{'xyz'[row]}"))]
SPACED = r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])"  # UncalGyroXRadPerSec
ANDROID, ANDROIDS = r"TYPE_[A-Z_]+", {"gyro": "rad/s", "accel": "m/s^2"}  # constants of Android, which states these units
MAX_NAMES, MIN_ROWS = 60, 20
LOOKED_AT = 200_000  # first characters of a text, which show whether its rows name sensors
EPOCH, ELAPSED = r"(?i)epoch?\b", r"(?i)(.*[ _])?elapsed\b"
NEAR_ONE = 0.01
ALWAYS = 0.99  # share of the steps of a time that lead up
PLACES = 3  # first fields of a row, of which one may name its sensor
KIND = r"[@$%/]?[A-Za-z][\w/.:-]*|/[\w/.:-]+"  # a word that names the kind of a row, or the device that it is of
OTHER = "other"  # kind of the rows that name none
FLAGS = r"(?i)true|false|yes|no|on|off|ok|none|nan|[a-z]"  # words that a device writes of its state
DEVICE = r"(?i)(sensor|device|imu|node|unit)([ _]?(id|no|nr|num(ber)?|index|name))?|id|mac|address"  # in a header
BY_TURNS, MIN_SHARE = 0.2, 0.1  # of rows that are of another device than the one before; of the rows, of each device


def sensors_among(names: Iterable[str]) -> dict[str, str]:
    """Names of the gyroscope and of the accelerometer; none of a sensor that has several."""
    found: dict[str, list[tuple[bool, str]]] = {}
    for name in names:
        words = [word.lower() for word in re.findall(WORD, name)]
        words = [*words, *map("".join, pairwise(words))]  # AngularVelocity, of MATLAB Mobile
        for sensor, pattern in SENSORS.items():
            if any(re.fullmatch(pattern, word) for word in words) and not any(re.fullmatch(OTHERS, word) for word in words):
                found.setdefault(sensor, []).append((any(re.fullmatch(UNCORRECTED, word) for word in words), name))
    best = {sensor: [name for is_raw, name in each if is_raw == min(each)[0]] for sensor, each in found.items()}
    return {names[0]: sensor for sensor, names in best.items() if len(names) == 1}


def plain_among(names: Iterable[str]) -> dict[str, str]:
    """The gyroscope and the accelerometer, where their names say nothing else; else none."""
    found = sensors_among(name for name in names if re.fullmatch("|".join(SENSORS.values()), name.lower()))
    return found if {*found.values()} == {*SENSORS} else {}


def pairs_among(names: Iterable[str]) -> dict[str, str]:
    """Groups (`imu0/gyro`) of the names of several IMUs; of one IMU none.

    The two names of an IMU differ by the sensor alone: `gyro-0`, `accel-0`; or also by a number that each name has for itself.
    """
    names = [*names]
    numbered = {name: match[0] for name in names if (match := re.search(r"\d+$", name))}
    is_running = len({*numbered.values()}) == len(numbered)
    return _pairs({n: n for n in names}) or _pairs({n.removesuffix(end): n for n, end in numbered.items() if is_running})


def _pairs(names: Mapping[str, str]) -> dict[str, str]:
    """Groups of names, by their spellings."""
    found: dict[str, dict[str, str]] = {}
    for spelled, name in names.items():
        words = re.findall(rf"{WORD}|\d+", spelled)
        sensors = [s for s, pattern in SENSORS.items() if any(re.fullmatch(pattern, word.lower()) for word in words)]
        rest = [word.lower() for word in words if not re.fullmatch("|".join(SENSORS.values()), word.lower())]
        if len(sensors) == 1 and not any(re.fullmatch(f"{OTHERS}|{UNCORRECTED}", word) for word in rest):
            found.setdefault("_".join(rest), {})[name] = sensors[0]
    whole = {rest: pair for rest, pair in found.items() if sorted(pair.values()) == sorted(SENSORS)}
    if len(whole) < 2:
        return {}
    return {n: f"{re.sub(r'^(?=[0-9]|$)', 'imu', rest)}/{s}" for rest, pair in whole.items() for n, s in pair.items()}


def names_sensors(text: str) -> tuple[str, int, dict[str, str]] | None:
    """Delimiter, place of a row's sensor in it, and names of gyro and accel; None of other text."""
    return _sensor_rows(text[:LOOKED_AT]) or _rows_of_kinds(text[:LOOKED_AT])


def read_rows(text: str, columns: Columns, path: Path) -> bool:
    """Add the columns of each sensor of a text whose rows name theirs; False for any other text."""
    if (found := names_sensors(text)) is None:
        return False
    mark, place, sensors = found
    lines = [line for line in text.splitlines() if line.strip()]
    rows = [line.split(mark) for line in lines if not line.startswith(COMMENTS)]
    tables: dict[str, list[str]] = {}
    for row in rows:
        if len(row) > place:
            tables.setdefault(row[place].strip() or OTHER, []).append(mark.join(row[:place] + row[place + 1 :]))
    header = (
        tables.pop(rows[0][place].strip() or OTHER)
        if not any(re.fullmatch(r"[-+.\deE]+", field.strip()) for field in rows[0])
        else []
    )
    for name, table in tables.items():
        stated = (match for line in lines if (match := re.search(rf"\b{re.escape(name + mark)}(.*[a-zA-Z].*)", line)))
        above = next((match[1].rstrip("'\" ") for match in stated if match.string.startswith(COMMENTS)), None)
        part = Columns()
        read_csv("\n".join([*(header if above is None else [above]), *table]), part, path, minimum=2)
        group = sensors.get(name, name)
        if name in sensors:
            part.remarks.notes.append(f"its rows are the {group}")
        if not sensors:
            name_headerless(part)
        if part.values:
            android = ANDROIDS.get(group, "") if re.fullmatch(ANDROID, name) else ""
            name_columns(part, sensors.get(name, ""), split_name(name)[1] or android)
        columns.take(group, part, name)
    return True


def _split_rows(start: str) -> tuple[str, list[list[str]]]:
    """Delimiter of the first whole lines of a text, and their fields; a spreadsheet adds empty ones at the end."""
    lines = [line for line in start.splitlines()[:-1] if line.strip() and not line.startswith(COMMENTS)]
    marks = Counter(mark for line in lines for mark in ";\t, " if line.count(mark) >= PLACES)  # of equals the first
    mark = marks.most_common(1)[0][0] if marks else ""
    return mark, [line.rstrip(f"{mark}\r\n").split(mark) for line in lines] if mark else []


def _rows_of_kinds(start: str) -> tuple[str, int, dict[str, str]] | None:
    """Delimiter and place of a word by which rows are of several kinds; None for any other text.

    Rows of kinds have different numbers of fields (`IMU 0.1 ...`, `LANDMARK 0.1 3 ...`), or come by turns, as those of
    several devices do. Labels of what a person does come in long runs.
    """
    mark, rows = _split_rows(start)
    header = rows.pop(0) if rows and not any(map(is_number, rows[0])) else []
    if any(is_of_recordings(name) and not re.fullmatch(DEVICE, name.strip()) for name in header):
        return None  # whose devices are told apart in each recording
    behind = [place for place, name in enumerate(header) if place >= PLACES and re.fullmatch(DEVICE, name.strip())]
    for place in [*range(PLACES), *behind]:
        long = [row for row in rows if len(row) > place]
        kinds = [row[place].strip().strip('"') for row in long]
        counts = Counter(kinds)
        by_name = place < len(header) and re.fullmatch(DEVICE, header[place].strip())
        if not 2 <= len(counts) <= MAX_NAMES or len(kinds) < MIN_ROWS * len(counts):
            continue
        are_words = all(re.fullmatch(KIND, kind) for kind in counts)
        widths: dict[str, set[int]] = {}
        for row, kind in zip(long, kinds, strict=True):
            widths.setdefault(kind, set()).add(len(row))
        are_separate = len(set.union(*widths.values())) > 1 and (are_words or all(len(each) == 1 for each in widths.values()))
        turns = sum(first != other for first, other in pairwise(kinds)) / len(kinds)
        by_turns = turns > BY_TURNS and min(counts.values()) > MIN_SHARE * len(kinds) / len(counts)
        if not header and are_separate:
            return mark, place, {}
        if by_turns and (by_name or (are_words and not any(re.fullmatch(FLAGS, kind) for kind in counts))):
            return mark, place, {}
    return None


def _sensor_rows(start: str) -> tuple[str, int, dict[str, str]] | None:
    """Delimiter, place of the sensor's name in a row, and names of gyro and accel; None for any other text."""
    mark, rows = _split_rows(start)
    for place in range(PLACES if rows else 0):
        counts = Counter(row[place].strip() for row in rows if len(row) > place)
        sensors = sensors_among(name for name, count in counts.items() if count >= MIN_ROWS)
        if len(counts) <= MAX_NAMES and {*sensors.values()} == {*SENSORS}:
            return mark, place, sensors
    return None


def name_columns(table: Columns, sensor: str, unit: str = "") -> None:
    """Name the time and the axes of a sensor, and the columns of a pose without a header.

    The time is the last column that rises before the axes: the sensor's own stands behind that of the program. One that counts
    from the first row of its file is not that of another sensor's file: MetaWear writes `epoc (ms)` and `elapsed (s)`.
    """
    names = [*table.values]
    if not names:
        return
    has_header = not all(re.fullmatch(r"column \d+|time", name) for name in names)  # the time may be that of a clock next to it
    if has_header and not sensor:
        return
    if not sensor:
        pose = next((p for p, turns in HEADERLESS if len(names) == len(p) and turns(table, names)), POSE[:1])
        new = dict(zip(names, pose, strict=False)) if rises(table.values[names[0]]) else {}
    else:
        first = next((n for n, name in enumerate(names) if not _ascends(table.values[name])), len(names))
        first = min(first, len(names) - 3)  # in place of a header: where the axes begin
        axes = _axes(names) if has_header else dict(zip(names[first:], "xyz", strict=False))
        if len(axes) < 3:
            return
        clocks = [name for name in names[: names.index(next(iter(axes)))] if _ascends(table.values[name])]
        clocks = [c for c in clocks if re.match(EPOCH, c)] or [c for c in clocks if not re.match(ELAPSED, c)] or clocks
        for clock in clocks[-1:]:
            table.units[clock] = table.units.get(clock) or split_name(clock)[1]
        new = {**axes, **dict.fromkeys(clocks[-1:], "time")}
        for name in axes:
            table.units[name] = table.units.get(name) or _unit(name) or unit
    order = {name: new.get(name, name) for name in sorted(names, key=lambda name: new.get(name) != "time")}
    table.values = {name: table.values[name] for name in order}
    table.values = {order[name]: values for name, values in table.values.items()}
    table.texts = {order[name]: texts for name, texts in table.texts.items()}
    table.units = {order[name]: each for name, each in table.units.items() if name in order}


def _ascends(values: np.ndarray) -> bool:
    """Whether a column is a time, even one that was set back once, and not a component of a vector."""
    is_set_back = len(values) > 1 and float(np.mean(np.diff(values.astype(float)) > 0)) > ALWAYS
    return rises(values) or is_set_back or in_batches(values)


def _turns(table: Columns, names: list[str]) -> bool:
    """Whether the last four columns are quaternions."""
    size = np.linalg.norm([table.values[name].astype(float) for name in names[-4:]], axis=0)
    return bool(abs(np.median(size) - 1.0) < NEAR_ONE)


def _is_rigid(table: Columns, names: list[str]) -> bool:
    """Whether the columns behind the first are a rotation with a position, row by row."""
    rows = table.side_by_side(names[1:]).reshape(-1, 3, 4)[:, :, :3]
    off = np.abs(rows @ rows.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    return bool(np.median(off) < NEAR_ONE and np.median(np.linalg.det(rows)) > 0.0)


HEADERLESS = (POSE, _turns), (RIGID, _is_rigid)  # names of the columns of a trajectory: TUM's, and that of MulRan


def _words(name: str) -> list[str]:
    return re.findall(r"[a-z0-9]+", re.sub(SPACED, "_", name).lower())


def _axes(names: list[str]) -> dict[str, str]:
    """Columns x, y, z, or the first three that differ by these alone, or by their place in an array."""
    if {*"xyz"} <= {*names}:
        return {axis: axis for axis in "xyz"}
    places = {name: "xyz"[int(match[1])] for name in names if (match := re.search(r"\[([0-2])\]$", name))}
    if len(places) == 3 and len({name[:-3] for name in places}) == 1:
        return places
    found: dict[tuple[str, ...], dict[str, str]] = {}
    for name in names:
        words = _words(name)
        axis = next((word for word in words if word in ("x", "y", "z")), "")
        found.setdefault(tuple(word for word in words if word != axis), {})[name] = axis
    return next((axes for axes in found.values() if sorted(axes.values()) == ["x", "y", "z"]), {})


def _unit(name: str) -> str:
    """Unit in brackets, at the end of a name, or in words behind the axis."""
    behind = re.sub(r".*\b[xyz]\b ?", "", " ".join(_words(name)))
    return split_name(name)[1] or next((unit for unit, pattern in UNITS.items() if re.fullmatch(pattern, behind)), "")
