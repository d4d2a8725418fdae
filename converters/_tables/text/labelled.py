"""Text whose rows name their numbers, as boards print them.

`Acc X:-0.22, Acc Y:-0.11`; `ax=0.1 g ay=0.2 g`; `{'acc': {'x': 0.1, 'y': 0.2}, 't': 1}`; `Gyro: (0.1, 0.2, 0.3)`.
The numbers of a sample may stand in several lines, as Adafruit's examples print them.
"""

from __future__ import annotations

import re
from collections import Counter
from itertools import pairwise

from .delimited import LOOKED_AT
from .names import unit_named

MIN_ROWS, MIN_SHARE = 5, 0.3  # of the lines looked at that have the same words; status lines may stand between
MIN_NUMBERS, MIN_LABELS, OF_AN_IMU = 4, 2, 6  # in a row
LONGEST_LINE, LONGEST_LABEL = 2_000, 80  # characters; the search for labels costs the square of their length
NUMBER = re.compile(
    r"(?<![\w.^/])(\d{4}-\d\d-\d\d[T ]\d\d?:\d\d:\d\d(?:[.,]\d+)?Z?|\d\d?:\d\d:\d\d(?:[.,]\d+)?"
    r"|[-+]?(?:\d++\.?+\d*+|\.\d++)(?:[eE][-+]?\d++)?+)"
    r"(?=(?i:[mun]?s|[cm]?m|m?g|deg|dps|k?hz|m?v|c)(?!\w)|(?![\w.^]))"  # a unit may follow without a blank
)
LABEL = re.compile(r"[A-Za-zµ°][^:=]*([:=]\s*[\[({'\"]*|\[)\s*$")
SIGN = re.compile(r"[-+]\s*$")  # apart from its number
BETWEEN = re.compile(r"[:=,;|{}\[\]()<>'\"\t]+")
STATE = re.compile(
    r"(?<=[:=])\s*([A-Z\d][A-Z\d_]+|(?i:true|false|yes|no|ok))(?=\s*[,;|])"
)  # in place of a number: `GPS: NO_FIX,`
AXIS = re.compile(r"[xyzw]", re.IGNORECASE)
STAMP = re.compile(r"^(\d\d:\d\d:\d\d[.,]\d+|arrival)([;\t, ]|$)")  # that a serial monitor puts before a line
TIME = re.compile(r"\d:\d\d|\b(time|timestamp|stamp|millis|t)\b", re.IGNORECASE)
MAX_LINES = 12  # of a sample


def as_table(text: str) -> tuple[str, int, int]:
    """The text as a table, and how many lines are left out: damaged rows, and others.

    Without such rows the table is empty. The lines of a sample may stand below one another.
    """
    lines = [line for line in text.splitlines() if line.strip()]
    found = _as_table(lines)
    if found[0].partition("\n")[0].count("\t") >= OF_AN_IMU - 1:
        return found
    return max(found, _as_table(_samples(text)), key=lambda each: each[0].partition("\n")[0].count("\t"))


def _samples(text: str) -> list[str]:
    """Samples whose lines stand below one another, as a line each; none of any other text.

    A sample begins behind a line without words, else at a line with a time, else at the first line that comes again.
    """
    lines = text.splitlines()
    known: dict[str, list[str]] = {}
    for line in lines[:LOOKED_AT]:
        known.setdefault(_kind(line), []).append(STAMP.sub("", line))
    often = [kind for kind, alike in known.items() if len(alike) >= MIN_ROWS]
    begins = next((kind for kind in often if not kind or TIME.search(known[kind][0])), next(iter(often), None))
    begins = "" if "" in often else begins
    first = _blocks(lines[:LOOKED_AT], begins) if begins is not None else []
    if sum(1 < len(block) <= MAX_LINES for block in first) < MIN_ROWS:
        return []
    return ["; ".join([block[0], *(STAMP.sub("", line) for line in block[1:])]) for block in _blocks(lines, begins)]


def _blocks(lines: list[str], begins: str | None) -> list[list[str]]:
    """Lines from each of a kind to the next; a line without words is in none."""
    blocks: list[list[str]] = [[]]
    for line in lines:
        kind = _kind(line)
        if kind == begins:
            blocks.append([])
        if kind:
            blocks[-1].append(line)
    return [block for block in blocks if block]


def _kind(line: str) -> str:
    """What stands between the numbers of a line, without the stamp of a serial monitor; empty without words and numbers."""
    text = STAMP.sub("", line)[:LONGEST_LINE]
    return " ".join(NUMBER.sub("#", text).split()) if re.search(r"\w", text) else ""


def _as_table(lines: list[str]) -> tuple[str, int, int]:
    """What `as_table` gives of text whose samples have a line each."""
    counts = Counter(words for line in lines[:LOOKED_AT] if (words := _words(line)))
    words, count = max(counts.items(), key=lambda each: each[1], default=((), 0))
    if count < max(MIN_ROWS, MIN_SHARE * len(lines[:LOOKED_AT])):
        return "", 0, 0
    rows = ["\t".join(match[1] for match in NUMBER.finditer(line)) for line in lines if _words(line) == words]
    labels = {match[0].strip() for text in words if (match := LABEL.search(text[-LONGEST_LABEL:]))}
    row = re.compile("|".join(rf"(?<!\w){re.escape(label)}" for label in labels))
    damaged = sum(_words(line) != words and row.search(line) is not None for line in lines)
    return "\n".join(["\t".join(_names(words)), *rows]) + "\n", damaged, len(lines) - len(rows) - damaged


def _words(line: str) -> tuple[str, ...]:
    """What stands before each number and behind the last; empty where fewer than two numbers have a label."""
    if len(line) > LONGEST_LINE:
        return ()
    words = tuple(
        " ".join(STATE.sub(" *", text).split()) for text in NUMBER.split(line)[::2]
    )  # numbers may be padded to a width
    named = sum(bool(LABEL.search(text[-LONGEST_LABEL:])) for text in words[:-1])
    return words if len(words) > MIN_NUMBERS and named >= MIN_LABELS and not any(map(SIGN.search, words)) else ()


def _names(words: tuple[str, ...]) -> list[str]:
    """Names of the numbers: an axis alone is of the group before it, and numbers that follow without a label are counted."""
    group, label, place, names = "", "", 0, list[str]()
    for (own, _), (following, unit) in pairwise(map(_label, words)):
        if own:
            is_axis = AXIS.fullmatch(own[-1])
            group = " ".join(own[:-1] if is_axis else own) or group
            label, place = f"{group} {own[-1]}".strip() if is_axis else group, 0
        counted = label and (place or (not following and len(names) + 2 < len(words)))
        name = f"{label}_{place}" if counted else label or f"number {len(names) + 1}"
        names.append(f"{name} [{unit}]" if unit else name)
        place += 1
    for n, name in enumerate(names[2:], 2):  # a unit behind the last axis is that of all three
        last = re.fullmatch(r"(.*)(z|Z)( \[.+\])", name)
        if last and names[n - 2 : n] == [f"{last[1]}{axis}" for axis in ("xy" if last[2] == "z" else "XY")]:
            names[n - 2 : n] = [f"{each}{last[3]}" for each in names[n - 2 : n]]
    return names


def _label(text: str) -> tuple[list[str], str]:
    """Words of a number's label, and the unit of the number before it, which may stand before any mark but that of a label."""
    first, *words = text.split(maxsplit=1)[:2] or [""]
    mark = BETWEEN.search(text)
    own = text[: mark.start()] if mark else text
    if mark and mark[0][:1] in ":=" and own.strip() == first.rstrip(":="):
        unit = ""
    elif unit := unit_named(own.strip()):
        text = text[len(own) :]
    elif unit := unit_named(first) if words else "":
        text = words[0]
    parts = [part.strip() for part in BETWEEN.split(text)]
    return [word for part in parts if part and part[-1].isalnum() for word in part.split()], unit
