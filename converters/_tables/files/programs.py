"""Columns that a program states elsewhere than in a header, and multiples of units in one.

Programs for MicroStrain's sensors put the number of MIP's field behind the names (`X Accel [x8004]`); each field has one unit.
A VectorNav sensor writes sentences whose name says what is in them (`$VNIMU,...*66`), by its user manual. A log of Gyroflow
(.gcsv) holds raw numbers, with their scales above the table: of time in s, gyro in rad/s, accel in g. A measurement file of
LabVIEW (.lvm) has two headers above the names, the second with the units and the step of time.
"""

from __future__ import annotations

import re

from ..text.delimited import Columns
from ..text.names import split_name, triples, unit_with_factor

MAG = ["mag_x", "mag_y", "mag_z"]
IMU = [*(f"accel_{axis} [m/s^2]" for axis in "xyz"), *(f"gyro_{axis} [rad/s]" for axis in "xyz")]
SENTENCES = {
    "VNIMU": [*MAG, *IMU, "temperature", "pressure"],
    "VNYMR": ["yaw", "pitch", "roll", *MAG, *IMU],
    "VNQMR": ["qx", "qy", "qz", "qw", *MAG, *IMU],
}
MIP_UNITS = {"[x8004]": "g", "[x8005]": "rad/s"}  # of scaled accelerations and rates, by MicroStrain's protocol
LOOKED_AT = 4096  # first characters of a text
LABVIEW, END_OF_HEADER = "LabVIEW Measurement", "***End_of_Header***"
GYROFLOW = "GYROFLOW IMU LOG"
SCALES = {"tscale": ("t", "s"), "gscale": (r"g[xyz]", "rad/s"), "ascale": (r"a[xyz]", "g")}  # columns, and their unit after it


def of_vectornav(text: str, columns: Columns) -> str:
    """Table of the sentences of a VectorNav sensor; empty for any other text."""
    match = re.search(rf"^\$({'|'.join(SENTENCES)}),", text[:LOOKED_AT], re.MULTILINE)
    if match is None or not text.lstrip().startswith("$VN"):
        return ""
    lines = [line for line in text.splitlines() if line.strip()]
    rows = [line.partition("*")[0].partition(",")[2] for line in lines if line.startswith(match[0])]
    compensated = "" if match[1] == "VNIMU" else ", compensated: the filter in the sensor has removed the biases that it knows"
    columns.remarks.notes.append(f"the sentences {match[1]} of a VectorNav sensor{compensated}")
    if len(rows) < len(lines):
        columns.remarks.losses.append(f"{len(lines) - len(rows)} lines of other sentences are left out")
    return "\n".join([",".join(SENTENCES[match[1]]), *rows]) + "\n"


def of_labview(text: str) -> str:
    """Table of a measurement file of LabVIEW, its units in the names; empty for other texts."""
    if not text.startswith(LABVIEW) or text.count(END_OF_HEADER) < 2:
        return ""
    file, section, table = text.split(END_OF_HEADER, 2)
    separator = "," if re.search(r"^Separator\W+Comma", file, re.MULTILINE) else "\t"
    stated = {line[0]: line[1:] for line in (line.split(separator) for line in section.splitlines())}
    names, *rows = (line.split(separator) for line in table.split("\n", 1)[1].splitlines())
    first = 1 if re.search(r"^X_Columns\W+No", file, re.MULTILINE) else 0  # its field in each row is empty
    width = len(names) - (names[-1] == "Comment")
    units = zip(names, ["s", *stated.get("Y_Unit_Label", [])], strict=False)
    spelled = [f"{name} [{unit}]" if unit and not re.search(r"[\[(]", name) else name for name, unit in units]
    table = "\n".join(separator.join(row[first:width]) for row in [[*spelled, *names[len(spelled) :]], *rows]) + "\n"
    step_s = stated.get("Delta_X", ["nan"])[0].replace(",", ".")
    return f"dt: {float(step_s):.15f} s\n{table}" if first else table


def scale_stated(columns: Columns) -> None:
    """Multiply columns whose header states a multiple of a unit: `gyro x (0.1 deg/s)`."""
    scaled, names = [], {column: split_name(column)[0] for column in columns.values}
    rates = {column for axes in triples("gyro", names).values() for column in axes.values()}
    for column, values in columns.values.items():
        factor, unit = unit_with_factor(column, columns.units.get(column, ""))
        if unit and (factor < 1.0 or column in rates):  # a motor's revolutions stay
            columns.values[column], columns.units[column] = values.astype(float) * factor, unit
            columns.texts.pop(column, None)
            scaled.append(f"{column} by {factor:g} to {unit}")
    if scaled:
        columns.remarks.notes.append(f"multiplied as the header states: {', '.join(scaled)}")


def state_mip(columns: Columns) -> None:
    """Enter the units of MIP's fields, whose numbers stand behind the names of columns."""
    columns.units |= {column: unit for column in columns.values for end, unit in MIP_UNITS.items() if column.endswith(end)}


def scale_gyroflow(columns: Columns) -> None:
    """Bring the numbers of a log of Gyroflow to their units.

    Its orientation, one of both sensors, is not applied.
    """
    for name, (pattern, unit) in SCALES.items():
        scale = columns.numbers.get(name, 1.0)
        for column in [column for column in columns.values if re.fullmatch(pattern, column)]:
            columns.values[column] = columns.values[column].astype(float) * scale
            columns.units[column] = unit
            columns.texts.pop(column, None)
    columns.remarks.notes.append("a log of Gyroflow: its scales are applied, and its orientation is not")
