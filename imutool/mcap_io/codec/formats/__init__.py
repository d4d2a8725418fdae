"""Messages of any encoding as nested fields: access by path, the stamp and units among them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice, pairwise
from typing import Any, Protocol, runtime_checkable

import numpy as np

from imutool.mcap_io.codec.schemas import NS_PER_S

STAMP = r"timestamp|stamp|time|sensor_?time"
CLOCK = r"((hw|hardware|device|sensor|sample|imu|host|header|capture|ts)_?)?(time|time_?stamp|stamp|t|ts)"
COUNTED = {rf"{CLOCK}_?ns(ec)?": 1, rf"{CLOCK}_?us(ec)?|utime": 1000}  # stamps of one number
DATED = rf"{CLOCK}|(.*_)?(date_?time|utc(_?time)?)"
COUNT = rf"ticks?|{CLOCK}(_?(s(ec(ond)?s?)?|m(illi)?s(ec(ond)?s?)?))?"  # without a unit, or in one that is coarse
UNITS_NS = {1: "ns", 1000: "us", 10**6: "ms", NS_PER_S: "s"}
FEW, MIN_PASSED_NS, MAX_PASSED_NS = 2000, NS_PER_S // 4, 10 * NS_PER_S  # messages that show the unit, and their time
CLOCK_ERROR, LATENCY_NS = 0.02, NS_PER_S // 10  # by which a clock and its recorder differ; units do by a factor of a thousand
MAX_SAME = 0.01  # share of the messages with a time that others have, too
SECONDS = dict.fromkeys(("sec", "seconds", "secs", "tv_sec"), NS_PER_S)  # in the parts of a stamp
FRACTIONS = dict.fromkeys(("nsec", "nanos", "nanosec", "nsecs", "nanoseconds", "tv_nsec"), 1) | {"usec": 1000, "tv_usec": 1000}
WORDS = {  # in the names of fields
    "gyro": r"(angular_?velocity|gyro(scope)?|ang_?vel|rotation_?rate|angular_?rate|omega)",
    "accel": r"(linear_?acceleration|accel(eration|erometer)?|acc|specific_?force)",
}
MDEG, DEG, RAD = ("mdeg/s", np.pi / 180e3), ("deg/s", np.pi / 180.0), ("rad/s", 1.0)
MILLI_G, G, M_S2 = ("mg", 9.80665e-3), ("g", 9.80665), ("m/s^2", 1.0)
NAMED = {  # units behind these words, with their size in SI
    "gyro": {
        r"_?m(illi)?_?(dps|deg(ree)?s?_?(p|per)?_?s(ec)?)": MDEG,
        r"_?(dps|deg(ree)?s?_?(p|per)?_?s(ec)?)": DEG,
        r"_?(rad(_?p?_?s)?|rads|si)": RAD,
    },
    "accel": {r"_mg|_?milli_?gs?": MILLI_G, r"_gs?": G, r"_?(m_?s_?2|mps2|si)": M_S2},
}
GYRO, ACCEL = (f"{WORDS[sensor]}({'|'.join(NAMED[sensor])})?" for sensor in WORDS)
UN = r"un_?comp(ensated)?"
UNCOMPENSATED = [  # by the filter in the sensor, which removes the biases that it knows; `imu_rate` is of VectorNav
    rf"{UN}_?{WORDS[sensor]}|{WORDS[sensor]}_?{UN}|{own}" for sensor, own in (("gyro", "imu_rate"), ("accel", "imu_accel"))
]
PER_S = r"[ _]?(/|\bper\b) ?s(ec(ond)?s?)?\b"
STATED = {  # units in the comments of a definition
    "gyro": {
        rf"\b(m|milli)(dps\b|deg(ree)?s?{PER_S})": MDEG,
        rf"(?<![a-z])(dps\b|deg(ree)?s?{PER_S})|°/s": DEG,
        rf"\brad(ian)?s?{PER_S}|\brps\b": RAD,
    },
    "accel": {
        r"m/s(\^|\*\*)?2|m/s²|m/s/s|\bmet(er|re)s? per sec(ond)?s?( squared|\^2|²)|\bmps2\b": M_S2,
        r"\b(mg|milli-?g'?s?)\b": MILLI_G,
        r"[\[(](in )?g'?s?[\])]|\bin g'?s?\b|^g'?s?$|\bunits?:? g\b": G,
    },
}
DEPTH = 4  # messages within messages that are searched
MAX_ROW = 64  # numbers of a list that are fields of their own
DEEPEST, MAX_FIELDS = 24, 5000  # of a message's numbers: messages within messages, and fields; one can nest without end
MAX_BYTES = 1 << 23  # of a message or schema that becomes objects: JSON of 180 MB, 6 kB when packed, took 4.6 GB and a minute
NUMBER, VECTOR, MATRIX, TEXT = "number", "vector", "matrix", "text"
TIME = "time"  # a text with a date and time, whose value is ns since 1970
Path = tuple[str | int, ...]  # of a field; a number of a list has its place at the end
Tree = Mapping[str, Any]  # of fields: NUMBER, VECTOR, MATRIX, TEXT or a tree
LACKS = (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError)  # raised where a message lacks a field


@runtime_checkable
class Format(Protocol):
    """Encoding of messages, with access to their fields by path."""

    def parse(self, raw: bytes) -> Any:
        """Message from its bytes; ValueError where they are none."""

    def at(self, message: Any, path: Path) -> Any:
        """Value of a field; KeyError, IndexError or ValueError where the message lacks it."""

    def new(self, values: Sequence[tuple[Path, Any]]) -> bytes:
        """Bytes of a message with these fields; of numbers in a list the path ends with their place."""


@runtime_checkable
class NumberFormat(Format, Protocol):
    """Encoding of messages whose numbers can be listed."""

    def numbers(self, message: Any) -> Iterator[Path]:
        """Paths of numbers, no truth values and enumerations; of a list `MAX_ROW` and one more."""


def fields_of(tree: Tree, above: Path = ()) -> Iterator[tuple[Path, str, Any]]:
    """Path, name in lower case with underscores, and node of every field."""
    for name, node in tree.items():
        yield (*above, name), _snake(name), node
        if isinstance(node, Mapping):
            yield from fields_of(node, (*above, name))


def _snake(name: str) -> str:
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()


def without_axis(name: str, axis: str) -> str:
    """Name of the vector of a field for one axis: `gyro_dps` for `gyro_x_dps`; else empty."""
    found = re.fullmatch(rf"(.+?)_?{axis}|(.+)_{axis}(_.+)", name)
    return "" if found is None else found[1] or found[2] + found[3]


def unit_in_name(sensor: str, path: Path) -> tuple[str, float] | None:
    """Unit in the names of a field and those around it, and its size."""
    names = [_snake(key) for key in path if isinstance(key, str)]
    every = [*names, *(without_axis(name, axis) for name in names for axis in "xyz")]
    stated = (unit for pattern, unit in NAMED[sensor].items() for n in every if re.fullmatch(f"{WORDS[sensor]}({pattern})", n))
    return next(stated, None)


def unit_in(comments: Iterable[str], units: Mapping[str, tuple[str, float]]) -> tuple[str, float]:
    """Unit that the nearest comment states, and its size; none and 1 where it states several."""
    named = ([unit for pattern, unit in units.items() if re.search(pattern, text.lower())] for text in comments)
    nearest = next(filter(None, named), [])
    return nearest[0] if len(nearest) == 1 else ("", 1.0)


def stamps_of(fields: Iterable[tuple[Path, str, Any]]) -> Iterator[tuple[tuple[Path, int], ...]]:
    """Fields that make up each stamp of a known unit; the first counts."""
    for path, name, node in fields:
        if isinstance(node, Mapping) and re.fullmatch(STAMP, name):
            named = [[(key, size) for key, size in part.items() if node.get(key) == NUMBER] for part in (SECONDS, FRACTIONS)]
            if all(named):
                yield tuple(((*path, key), size) for (key, size), *_ in named)
        if node == TIME and re.fullmatch(DATED, name):
            yield ((path, 1),)
        for pattern, size in COUNTED.items():
            if node == NUMBER and re.fullmatch(pattern, name):
                yield ((path, size),)


def stamp_parts(stamp_ns: int, places: Sequence[tuple[Path, int | float]]) -> Iterator[tuple[Path, float]]:
    """Stamp as the numbers of its fields, the largest unit first."""
    for path, size in places:
        if isinstance(size, float):
            yield path, stamp_ns / size
        else:
            count, stamp_ns = divmod(stamp_ns, size)
            yield path, count


def counts_in(fields: Iterable[tuple[Path, str, Any]]) -> tuple[Path, ...]:
    """Numbers that are named as a time, in a unit that the log times may show."""
    return tuple(path for path, name, node in fields if node == NUMBER and re.fullmatch(COUNT, name))


def beginning(messages: Iterable[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    """First messages, with their log times: a slow topic may lie in every chunk of a long log."""
    found = list[tuple[int, bytes]]()
    for message in islice(messages, FEW):
        found.append(message)
        if message[0] - found[0][0] > MAX_PASSED_NS:
            break
    return found


def unit_ns(counts: Sequence[float], log_ns: Sequence[int]) -> int:
    """Nanoseconds of the unit in which a clock runs as fast as the log times; else 0.

    That is also the answer of a clock that shows one time for several messages.
    """
    passed = log_ns[-1] - log_ns[0] if log_ns else 0
    if passed < MIN_PASSED_NS or not np.isfinite(counts).all() or len({*counts}) < (1.0 - MAX_SAME) * len(counts):
        return 0
    allowed = CLOCK_ERROR * passed + LATENCY_NS
    return next((unit for unit in UNITS_NS if abs((counts[-1] - counts[0]) * unit - passed) < allowed), 0)


def vector_in(fields: Sequence[tuple[Path, str, Any]], pattern: str) -> tuple[Path, Path, Path] | None:
    """Paths of three numbers: an object with x, y and z, a list, or three fields."""
    for path, name, node in fields:
        if re.fullmatch(pattern, name):
            for axes in ("xyz", "XYZ") if isinstance(node, Mapping) else ():
                if all(node.get(axis) == NUMBER for axis in axes):
                    return (*path, axes[0]), (*path, axes[1]), (*path, axes[2])
            if node == VECTOR:
                return (*path, 0), (*path, 1), (*path, 2)
    x, y, z = (
        next((path for path, name, node in fields if node == NUMBER and re.fullmatch(pattern, without_axis(name, axis))), None)
        for axis in "xyz"
    )
    return None if x is None or y is None or z is None else (x, y, z)


def imu_in(
    fields: Sequence[tuple[Path, str, Any]], gyro: str, accel: str, *, whole: bool = True
) -> tuple[Sequence[tuple[Path, str, Any]], tuple[Path, ...]] | None:
    """Fields next to an IMU's rates and accelerations, and the paths of those six numbers.

    With `whole` the two may also lie in different parts of the message.
    """
    parts: dict[Path, list[tuple[Path, str, Any]]] = {}
    for field in fields:
        parts.setdefault(field[0][:-1], []).append(field)
    for part in (*parts.values(), *((fields,) if whole else ())):
        rates, forces = vector_in(part, gyro), vector_in(part, accel)
        if rates and forces:
            return part, (*rates, *forces)
    return None


def refuse_long(raw: bytes) -> None:
    """Refuse bytes whose objects would fill the memory.

    Raises:
        ValueError: more than `MAX_BYTES`.
    """
    if len(raw) > MAX_BYTES:
        raise ValueError(f"more than {MAX_BYTES} bytes")


def nested(values: Sequence[tuple[Sequence[str | int], Any]]) -> dict[str, Any]:
    """Fields by their paths as nested objects and lists."""
    tree: dict[str, Any] = {}
    for path, value in values:
        inner: Any = tree
        for key, following in pairwise(path):
            inner = inner.setdefault(key, [] if isinstance(following, int) else {})
        if isinstance(path[-1], int):
            inner.append(value)
        else:
            inner[path[-1]] = value
    return tree
