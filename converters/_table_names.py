"""Columns of the three axes of a sensor, by their names."""

from __future__ import annotations

import re

WORDS = {
    "gyro": r"gyro(scope)?|gyroskop|gyr|gyros|gy|omega|w|g|angular_?velocity|ang_?vel|(rotation_?)?rate|w_rs_s"
    r"|dreh(rate|geschwindigkeit)",
    "accel": r"accel(eration|erometer)?|acce?|ac|a|linear_?acceleration|specific_?force|sp_?force|(linear)?beschleunigung"
    r"|a_rs_s",
}
STATE = r"(_(raw|adc|counts?|(un)?cal(ibrated)?))?"  # of the numbers in a column
FORMS = (  # names of an axis, by falling preference; one of roll, pitch and yaw may also be that of a command
    rf"(?P<sensor>(?:.*_)?(WORDS)(_(ln|wr))?)_?(?P<axis>[xyz012]){STATE}",  # Shimmer has two: low noise and wide range
    rf"(?P<axis>[xyz])_(?=[a-z]{{3}})(?P<sensor>(WORDS)){STATE}",
    rf"(?P<sensor>(?:.*_)?(WORDS))_(?P<axis>roll|pitch|yaw){STATE}",
    rf"(?P<axis>roll|pitch|yaw)_?(?=[a-z]{{3}})(?P<sensor>(WORDS)){STATE}",
)
AXES = {"0": "x", "1": "y", "2": "z"}
TURNS = AXES | {"roll": "x", "pitch": "y", "yaw": "z"}


def triples(sensor: str, *names: dict[str, str]) -> list[dict[str, str]]:
    """Columns of three axes, in the first form of names that has all three.

    `names` are spellings of the columns' names.
    """
    tries = (_triples(sensor, spelled, form) for form in FORMS for spelled in names)
    return next(filter(None, tries), [])


def _triples(sensor: str, names: dict[str, str], form: str) -> list[dict[str, str]]:
    groups: dict[str, dict[str, str]] = {}
    axes = TURNS if sensor == "gyro" else AXES
    for column, name in names.items():
        if match := re.fullmatch(form.replace("WORDS", WORDS[sensor]), name):
            groups.setdefault(match["sensor"], {})[axes.get(match["axis"], match["axis"])] = column
    return [group for group in groups.values() if set(group) == set("xyz")]
