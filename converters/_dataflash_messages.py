"""Messages of an ArduPilot DataFlash log, binary or text, with their times.

The log describes its own messages (FMT). Stamps are the time since boot: TimeUS, or the TimeMS of logs before 2015. A message
without a time has that of the one before it.
"""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from imutool.array_types import Bool, Int64
from imutool.recording.message_log import Remarks

HEAD, FMT = b"\xa3\x95", 128
FMT_SIZE = 89
TYPES = {
    **{"b": "i1", "B": "u1", "M": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "q": "<i8", "Q": "<u8", "f": "<f4"},
    "g": "<f2",
    **{"d": "<f8", "L": "<i4", "c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "n": "S4", "N": "S16", "Z": "S64"},
    "a": "(32,)<i2",
}
TEXT_START = b"FMT, 128, 89, FMT"
TEXT_TYPES = {**TYPES, "M": "S16"}  # a mode is written by its name
TEXT_SCALES = {**dict.fromkeys("cCeE", 100.0), "L": 1e7}  # of binary integers that text shows as decimals
CLOCKS_NS = {"TimeUS": 1000, "TimeMS": 1_000_000}
NO_TIME = -1
LONGEST = 200  # letters of a loss: it quotes what a damaged line has in a number's place


class Messages(NamedTuple):
    """Messages of one type as a structured array, with their places in the file and times."""

    rows: np.ndarray
    places: Int64[np.ndarray, " n"]
    t_ns: Int64[np.ndarray, " n"]

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the numbers and texts."""
        return self.rows.dtype.names or ()

    def where(self, kept: Bool[np.ndarray, " n"]) -> Messages:
        """Some of the messages."""
        return Messages(self.rows[kept], self.places[kept], self.t_ns[kept])


class _Format(NamedTuple):
    """A message type: name, length with its head, field types as letters, and labels."""

    name: str
    size: int
    letters: str
    labels: list[str]

    @property
    def dtype(self) -> np.dtype[np.void]:
        """Layout of the payload."""
        return np.dtype([(label, TYPES[letter]) for label, letter in zip(self.labels, self.letters, strict=True)])


def read_messages(raw: bytes, remarks: Remarks) -> dict[str, Messages]:
    """Messages by type; none where no message of the log has a time."""
    found = (_text_messages if raw.startswith(TEXT_START) else _binary_messages)(raw, remarks)
    timed = [messages for messages in found.values() if _clock(messages) is not None]
    if not timed:
        return {}
    places = np.concatenate([messages.places for messages in timed])
    order = np.argsort(places)
    places, t_ns = places[order], np.concatenate([messages.t_ns for messages in timed])[order]
    untimed = sorted(name for name, messages in found.items() if _clock(messages) is None)
    for name in untimed:
        found[name] = found[name]._replace(t_ns=t_ns[np.maximum(np.searchsorted(places, found[name].places) - 1, 0)])
    if untimed:
        remarks.notes.append(f"messages without a time have that of the message before them: {', '.join(untimed)}")
    return found


def text_of(raw: bytes) -> str:
    """Text of a field, which zeros fill up."""
    return bytes(raw).partition(b"\0")[0].decode("ascii", "replace")


def _messages(rows: np.ndarray, places: list[int]) -> Messages:
    found = Messages(rows, np.array(places, np.int64), np.full(len(rows), NO_TIME))
    if (clock := _clock(found)) is None:
        return found
    return found._replace(t_ns=rows[clock[0]].astype(np.int64) * clock[1])


def _clock(messages: Messages) -> tuple[str, int] | None:
    """Field with the time since boot, and its unit in ns.

    A GPS message of logs before 2015 has the time of the week in TimeMS, next to a Week, and the time since boot in T.
    """
    fields = messages.fields
    known = {"T": CLOCKS_NS["TimeMS"]} if "Week" in fields and "TimeUS" not in fields else CLOCKS_NS
    return next(((f, unit) for f, unit in known.items() if f in fields and messages.rows.dtype[f].kind in "iu"), None)


def _binary_messages(raw: bytes, remarks: Remarks) -> dict[str, Messages]:
    """Messages of every type; bytes that are no message are counted."""
    formats: dict[int, _Format] = {FMT: _Format("FMT", FMT_SIZE, "", [])}
    offsets: dict[int, list[int]] = defaultdict(list)
    position = lost = 0
    while position + 3 <= len(raw):
        kind = formats.get(raw[position + 2]) if raw.startswith(HEAD, position) else None
        if kind is None or position + kind.size > len(raw):
            following = raw.find(HEAD, position + 1)
            if kind is not None and following < 0:
                remarks.losses.append(f"the log ends within a message {kind.name}: what came after is lost")
                break
            end = len(raw) if following < 0 else following
            lost, position = lost + end - position, end
            continue
        if raw[position + 2] == FMT:
            _define(formats, raw[position + 3 : position + FMT_SIZE])
        else:
            offsets[raw[position + 2]].append(position)
        position += kind.size
    if lost:
        remarks.losses.append(f"{lost} bytes of the log are no message that it describes")
    data = np.frombuffer(raw, np.uint8)
    found = {}
    for number, places in offsets.items():
        form = formats[number]
        rows = data[np.array(places)[:, None] + np.arange(3, form.size)[None, :]]
        values = np.ascontiguousarray(rows).view(form.dtype)[:, 0] if form.labels else np.zeros(len(places), form.dtype)
        name = form.name if form.name not in found else f"{form.name}_{number}"  # two formats of one name
        found[name] = _messages(values, places)
    return found


def _define(formats: dict[int, _Format], content: bytes) -> None:
    """Take in a FMT message; a type whose fields are not known is passed over."""
    number, size, name, letters, labels = struct.unpack("<BB4s16s64s", content)
    fields = [label for label in text_of(labels).split(",") if label]
    form = _Format(text_of(name), size, text_of(letters), fields)
    known = len(fields) == len(form.letters) and set(form.letters) <= TYPES.keys() and len(set(fields)) == len(fields)
    if known and number != FMT and form.dtype.itemsize == size - 3:
        formats[number] = form


def _text_messages(raw: bytes, remarks: Remarks) -> dict[str, Messages]:
    """Messages of a log in text, as those of the binary one; lines that are no message are counted."""
    formats: dict[str, _Format] = {}
    lines: dict[str, list[list[str]]] = defaultdict(list)
    places: dict[str, list[int]] = defaultdict(list)
    lost = 0
    for place, line in enumerate(raw.decode("latin-1").splitlines()):
        name, _, content = line.partition(",")
        if name == "FMT" and content.count(",") >= 4:
            number, _, label, letters, labels = (part.strip() for part in content.split(",", 4))
            fields = [field.strip() for field in labels.split(",") if field.strip()]
            known = len(fields) == len(letters) == len(set(fields)) and set(letters) <= TYPES.keys() - {"a"}
            if known and number != str(FMT):
                formats[label] = _Format(label, 0, letters, fields)
        elif (form := formats.get(name)) is not None:
            values = [value.strip() for value in content.split(",", len(form.labels) - 1)] if form.labels else []
            if len(values) == len(form.labels) and all(values):
                lines[name].append(values)
                places[name].append(place)
            else:
                lost += 1
        elif line.strip() and name != "FMT":
            lost += 1
    if lost:
        remarks.losses.append(f"{lost} lines of the log are no message that it describes")
    found = {}
    for name, rows in lines.items():
        errors: list[Exception] = []
        parts = list(_sound_parts(formats[name], rows, places[name], errors))
        if errors:
            remarks.losses.append(f"{len(errors)} messages {name} are left out: {errors[0]}"[:LONGEST])
        if parts:
            arrays, kept = zip(*parts, strict=True)
            found[name] = _messages(np.concatenate(arrays), [place for part in kept for place in part])
    return found


def _sound_parts(
    form: _Format, rows: list[list[str]], places: list[int], errors: list[Exception]
) -> Iterator[tuple[np.ndarray, list[int]]]:
    """Messages that the log's description holds, by halves: one number that cannot be read costs its own message alone."""
    try:
        yield _from_text(form, rows), places
    except (ValueError, OverflowError) as error:
        if len(rows) == 1:
            errors.append(error)
            return
        half = len(rows) // 2
        for part in (slice(None, half), slice(half, None)):
            yield from _sound_parts(form, rows[part], places[part], errors)


def _from_text(form: _Format, rows: list[list[str]]) -> np.ndarray:
    """Messages of a type as a structured array, in the units of the binary log."""
    found = np.zeros(len(rows), [(label, TEXT_TYPES[letter]) for label, letter in zip(form.labels, form.letters, strict=True)])
    for label, letter, texts in zip(form.labels, form.letters, zip(*rows, strict=True), strict=True):
        kind = found.dtype[label]
        if letter in TEXT_SCALES:
            scaled, limits = np.rint(np.array(texts, float) * TEXT_SCALES[letter]), np.iinfo(kind)
            if not ((scaled >= limits.min) & (scaled <= limits.max)).all():
                raise ValueError(f"a {label} is beyond what the binary log holds")
            found[label] = scaled.astype(kind)
        elif kind.kind == "S":
            found[label] = [text.encode("latin-1") for text in texts]
        else:
            found[label] = np.array([int(text) for text in texts] if kind.kind in "iu" else texts, kind)
    return found
