"""Text whose rows hold one number each: what `rostopic echo` prints, and long tables.

Of a message the fields stand below one another, with `---` between messages. A long table has columns for the time, the
name of the signal (in one or several) and its value.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path

from imutool.errors import DataError

from ..text.names import TIME_WORDS, split_name
from ..text.numbers import is_number

BETWEEN = "---"
FIELD = re.compile(r"(?P<indent> *)(?P<item>- )?((?P<name>[A-Za-z_]\w*):(?!\S))?[ ]*(?P<value>.*)")
MIN_MESSAGES, MIN_NUMBERS = 3, 4  # in a text, and in a message
LOOKED_AT = 1 << 14  # characters of a text, whose first rows show a long table
MAX_COMMENTS = 20  # lines above the header of a long table
MIN_SIGNALS, MAX_SIGNALS = 6, 60  # of a long table, which is an IMU's
MIN_WHOLE = 0.9  # share of its times that have a value of every signal


def of_echo(text: str) -> tuple[str, int]:
    """The messages as a table of text, and how many are left out; empty for any other text."""
    if text.count(f"\n{BETWEEN}") < MIN_MESSAGES:
        return "", 0
    messages = [dict(_fields(part)) for part in re.split(rf"^{BETWEEN}\s*$", text, flags=re.MULTILINE)]
    messages = [message for message in messages if message]
    names = list(messages[0]) if messages else []
    rows = [[message[name] for name in names] for message in messages if {*message} >= {*names}]
    if len(names) < MIN_NUMBERS or len(rows) < MIN_MESSAGES:
        return "", 0
    return "\n".join("\t".join(row) for row in [names, *rows]) + "\n", len(messages) - len(rows)


def long_table(text: str, path: Path) -> tuple[str, int]:
    """What `of_long` gives.

    Raises:
        DataError: the first rows are those of a long table, and all of them make none.
    """
    found = of_long(text)
    if not found[0] and of_long(text[:LOOKED_AT].rpartition("\n")[0] + "\n")[0]:
        what = "is a long table whose signals lack values at more than a tenth of the times, or have two at one"
        raise DataError(what, where=path, fix="Pivot it to a row for each time and a column for each axis of one IMU")
    return found


def has_signals(text: str) -> bool:
    """Whether a text has the header of a long table."""
    return None not in _long_header(text)


def _long_header(text: str) -> tuple[str, list[str], int | None, int | None]:
    """Delimiter and fields of the header, and the places of a time and of the value."""
    first = next((line for line in text.split("\n", MAX_COMMENTS)[:MAX_COMMENTS] if line.strip() and line[0] != "#"), "")
    mark = next((mark for mark in ";\t," if mark in first), "")
    header = next(csv.reader([first], delimiter=mark)) if mark else []
    names = [split_name(name)[0] for name in header]
    time = next((n for n, name in enumerate(names) if re.fullmatch(TIME_WORDS, name)), None)
    return mark, header, time, next((n for n, name in enumerate(names) if name == "value"), None)


def of_long(text: str) -> tuple[str, int]:
    """A long table as a row for each time, and how many are left out; nothing of other text.

    Its signals share their times, and none has two values at one time.
    """
    mark, header, time, value = _long_header(text)
    if time is None or value is None:
        return "", 0
    lines = text.splitlines()[: None if text.endswith("\n") else -1]
    rows = [row for row in csv.reader(lines, delimiter=mark) if len(row) == len(header) and row != header and row[0][:1] != "#"]
    if not all(is_number(row[value]) for row in rows):
        return "", 0
    every = {n: {row[n] for row in rows} for n in range(len(header)) if n not in (time, value)}
    signal = [n for n, texts in every.items() if 1 < len(texts) <= MAX_SIGNALS and not any(map(is_number, texts))]
    found: dict[str, dict[str, str]] = {}
    for row in rows:
        values, name = found.setdefault(row[time], {}), "_".join(row[n].strip() for n in signal)
        if name in values:
            return "", 0
        values[name] = row[value]
    signals = list(dict.fromkeys(name for values in found.values() for name in values))
    whole = {t: values for t, values in found.items() if len(values) == len(signals)}
    if not MIN_SIGNALS <= len(signals) <= MAX_SIGNALS or len(whole) < max(MIN_MESSAGES, MIN_WHOLE * len(found)):
        return "", 0
    table = [[header[time], *signals], *([t, *(values[name] for name in signals)] for t, values in whole.items())]
    return "\n".join("\t".join(row) for row in table) + "\n", len(found) - len(whole)


def _fields(message: str) -> Iterator[tuple[str, str]]:
    """Names and numbers of a message's fields, with dots between the names of nested ones."""
    above: list[tuple[int, str]] = []
    count = 0
    for line in message.splitlines():
        match = FIELD.fullmatch(line.rstrip())
        if match is None or not (match["name"] or match["item"] or match["value"]):
            continue
        indent, value = len(match["indent"]), match["value"].strip("'\"")
        if match["item"]:  # of a list, which may stand as far left as its name
            if above and is_number(value):
                yield f"{'.'.join(name for _, name in above)}[{count}]", value
            count += 1
            continue
        above, count = [each for each in above if each[0] < indent], 0
        if match["name"] is None:
            continue
        name = ".".join([*(each for _, each in above), match["name"]])
        numbers = re.split(r",\s*", value[1:-1]) if value.startswith("[") and value.endswith("]") else []
        if not value:
            above.append((indent, match["name"]))
        elif is_number(value):
            yield name, value
        elif numbers and all(map(is_number, numbers)):
            yield from ((f"{name}[{place}]", number) for place, number in enumerate(numbers))
