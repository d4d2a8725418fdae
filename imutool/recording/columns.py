"""Columns of numpy arrays on one clock: immutable, validated, compared bit for bit.

Base class of the array types of `imutool.recording`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from itertools import pairwise
from numbers import Real
from operator import index
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np

from imutool.array_types import Bool, Int64, Shaped
from imutool.errors import DataError

YEAR_S = 365.25 * 86400.0
MAX_GAP_S = 3600.0  # of a pause of the recorder: a longer step of the stamps is a jump of their clock
SET_BACK_NS = 1_000_000_000  # by which stamps go back at a jump; less is a sample that came late
MAX_TOLD = 5  # jumps
MAX_EXACT = {"f": 2**53, "i": 2**63 - 1}  # integers that float64 and int64 hold exactly

Rows = TypeVar("Rows", bound="Columns")


class Columns:
    """Base of frozen dataclasses of arrays with one row per stamp; slices by row or by time."""

    t_ns: Int64[np.ndarray, " n"]

    def check(self, **shapes: tuple[int, ...]) -> None:
        """Convert the columns to int64 and float64, make them read-only, and check them.

        A column that has its type, is contiguous and cannot be written is not copied.

        Raises:
            DataError: a type that does not convert without loss, a wrong length, a number that is not finite, or time that does
                not increase; the message names the row.
        """
        kind = type(self).__name__
        optional = {column.name for column in fields(self) if column.default is None}  # type: ignore[arg-type]
        for name in ("t_ns", *shapes):
            value = getattr(self, name)
            if value is not None or name not in optional:
                object.__setattr__(self, name, _fixed(converted(value, f"{kind}.{name}", times=name == "t_ns")))
        if self.t_ns.ndim != 1:
            raise DataError(f"{kind}.t_ns is {self.t_ns.dtype}{list(self.t_ns.shape)}", expected="int64[n]")
        for name, tail in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            if value.shape != (len(self.t_ns), *tail):
                what = f"{kind}.{name} is {value.dtype}{list(value.shape)}"
                raise DataError(what, expected=f"float64{[len(self.t_ns), *tail]}")
            if not np.isfinite(value).all():
                row = int(np.argmin(np.isfinite(value).reshape(len(value), -1).all(axis=1)))
                what, fix = f"{kind}.{name} row {row} is {value[row].tolist()}", "Leave such rows out"
                raise DataError(what, expected="finite numbers", fix=fix)
        if len(backward := np.flatnonzero(np.diff(self.t_ns) <= 0)):
            row = int(backward[0]) + 1
            raise DataError(
                f"{kind} time goes from {self.t_ns[row - 1]} to {self.t_ns[row]} ns at row {row}",
                expected="strictly increasing stamps",
            )

    def __len__(self) -> int:
        return len(self.t_ns)

    def __repr__(self) -> str:
        """Size, rate and time span: arrays of a recording fill a terminal."""
        rate = f" at {1 / self.period_s:.4g} Hz" if len(self) > 1 else ""
        columns = [f"{c.name} {list(v.shape)}" for c in fields(self)[1:] if isinstance(v := getattr(self, c.name), np.ndarray)]  # type: ignore[arg-type]
        return f"{type(self).__name__}({len(self)} rows{rate}, {self.duration_s:.3f} s; {', '.join(columns)})"

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(_same(getattr(self, c.name), getattr(other, c.name)) for c in fields(self))  # type: ignore[arg-type]

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle through the constructor: it makes the unpickled arrays read-only again."""
        return type(self), tuple(getattr(self, c.name) for c in fields(self))  # type: ignore[arg-type]

    def rows(self: Rows, index: slice | Bool[np.ndarray, " n"]) -> Rows:
        """Columns at some rows."""
        cut = {
            c.name: value[index]
            for c in fields(self)  # type: ignore[arg-type]
            if isinstance(value := getattr(self, c.name), np.ndarray)
        }
        return replace(self, **cut)  # type: ignore[type-var]

    def between(self: Rows, start_ns: int, end_ns: int) -> Rows:
        """Rows with `start_ns <= t_ns <= end_ns`.

        Raises:
            DataError: times that are not integers, such as seconds.
        """
        start, end = whole_ns(start_ns, "start_ns"), whole_ns(end_ns, "end_ns")
        first, last = np.searchsorted(self.t_ns, start), np.searchsorted(self.t_ns, end, side="right")
        return self.rows(slice(int(first), int(last)))

    @property
    def period_s(self) -> float:
        """Median time between rows.

        Raises:
            DataError: fewer than two rows.
        """
        if len(self.t_ns) < 2:
            raise DataError(f"{type(self).__name__} has {len(self.t_ns)} rows", expected="at least 2")
        return float(quantile(np.diff(self.t_ns), 0.5)) * 1e-9

    @property
    def duration_s(self) -> float:
        """Time from the first row to the last."""
        return float(self.t_ns[-1] - self.t_ns[0]) * 1e-9 if len(self.t_ns) else 0.0


def _same(a: object, b: object) -> bool:
    """Whether two values are equal bit for bit (-0.0 and 0.0 differ, as they do in a file)."""
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    return not isinstance(a, np.ndarray) and not isinstance(b, np.ndarray) and bool(a == b)


def converted(value: Any, where: str, *, times: bool = False) -> Shaped[np.ndarray, "..."]:
    """Array of float64, or of int64 nanoseconds for `times`, if the value converts without loss.

    A list, a column, objects, float32, another byte order, smaller integers; times also as `datetime64` and `timedelta64`.

    Raises:
        DataError: it does not: seconds as float, masked values, text, larger integers, or nothing.
    """
    wanted, fix = np.dtype(np.int64 if times else np.float64), ""
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    except (TypeError, RuntimeError) as error:  # a tensor on a GPU, or with a gradient
        array, fix = np.asarray(None), str(error).rstrip(".")
    if array.dtype == object and all(isinstance(item, Real) for item in array.flat):
        array = np.asarray(array.tolist())
    masked = isinstance(mask := getattr(value, "mask", None), np.ndarray | np.bool_) and bool(mask.any())
    if not masked and not (times and array.ndim > 1) and (found := _exactly(array, wanted)) is not None:
        return found
    kind = f"{array.dtype}{list(array.shape)}" if isinstance(value, np.ndarray) else f"of type {type(value).__name__}"
    if times and array.dtype.kind == "f":
        fix = "Convert seconds with np.round(1e9 * seconds).astype(np.int64)"
    elif times and array.dtype == object and getattr(array.flat[0], "tzinfo", None) is not None:
        fix = "Take the time zone off: `column.dt.tz_convert(None)`"
    elif times and array.ndim == 1 and array.dtype.kind in "OU":
        fix = "Convert texts and datetimes with np.asarray(times, 'datetime64[ns]')"
    what, expected = f"{where} is {kind}{' with masked values' * masked}", f"{wanted}[n{'' if times else ', ...'}]"
    raise DataError(what, expected=expected, fix=fix)


def _exactly(array: Shaped[np.ndarray, "..."], wanted: np.dtype[Any]) -> Shaped[np.ndarray, "..."] | None:
    """The array in another type; None where this loses something."""
    kind, times = array.dtype.kind, wanted.kind == "i"
    if times and kind in "Mm":
        with suppress(OverflowError):  # of numpy from 2.5 on; before, other numbers stand there
            ns = array.astype(f"{kind}8[ns]")
            return ns.astype(wanted) if not np.isnat(array).any() and np.array_equal(ns.astype(array.dtype), array) else None
        return None
    if array.size and kind in "iu" and kind != wanted.kind:
        maximum = MAX_EXACT[wanted.kind]
        return array.astype(wanted) if -maximum <= array.min() and array.max() <= maximum else None
    return array.astype(wanted, copy=False) if not array.size or np.can_cast(array.dtype, wanted, "safe") else None


def whole_ns(value: Any, where: str) -> int:
    """Nanoseconds as an integer; DataError of another number, such as seconds."""
    try:
        return index(value)
    except TypeError:
        raise DataError(f"{where} is {value!r}"[:200], expected="integer nanoseconds") from None


def checked_mapping(value: object, of: type, where: str) -> Mapping[str, Any]:
    """Read-only copy of a mapping, and of the mappings in it.

    Raises:
        DataError: it is none, or holds a value of another type.
    """
    if not isinstance(value, Mapping):
        raise DataError(f"{where} is of type {type(value).__name__}", expected=f"a mapping from names to {of.__name__}")
    if wrong := [type(k).__name__ for k in value if not isinstance(k, str)]:
        raise DataError(f"{where} holds a name of type {wrong[0]}", expected="str")
    if wrong := [type(v).__name__ for v in value.values() if not isinstance(v, of)]:
        raise DataError(f"{where} holds a value of type {wrong[0]}", expected=of.__name__)
    return MappingProxyType({k: checked_mapping(v, str, where) if of is Mapping else v for k, v in value.items()})


def _fixed(array: Shaped[np.ndarray, "..."]) -> Shaped[np.ndarray, "..."]:
    """The array, contiguous and read-only; a copy only where it is not already."""
    if not (array.flags.c_contiguous and _is_immutable(array)):
        array = np.array(array, order="C")
        array.flags.writeable = False
    return array


def _is_immutable(array: np.ndarray) -> bool:
    """Whether an array and the arrays it is a view of are read-only."""
    owner: object = array
    while isinstance(owner, np.ndarray):
        if owner.flags.writeable:
            return False
        owner = owner.base
    return owner is None or isinstance(owner, bytes)


def true_ranges(mask: Bool[np.ndarray, " n"]) -> list[tuple[int, int]]:
    """Index ranges `[first, end)` in which a mask holds."""
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def quantile(values: Shaped[np.ndarray, "n ..."], share: float) -> Any:
    """Quantile of each column, between the two nearest values in proportion.

    As `np.quantile`, which takes several times as long and imports masked arrays (25 ms).
    """
    ordered = np.sort(values, axis=0)
    place = share * (len(ordered) - 1)
    below, above = ordered[int(place)], ordered[min(int(place) + 1, len(ordered) - 1)]
    return below + (place - int(place)) * (above - below)


def median(values: Shaped[np.ndarray, "..."], axis: int = 0) -> Any:
    """Median along an axis of finite values; `np.median` would import masked arrays."""
    below, above = (values.shape[axis] - 1) // 2, values.shape[axis] // 2
    ordered = np.partition(values, (below, above), axis=axis)
    return 0.5 * (ordered.take(below, axis) + ordered.take(above, axis))


def clock_jumps(t_ns: Int64[np.ndarray, " n"]) -> list[tuple[int, float]]:
    """Jumps of a clock: the first stamp behind each, and the step to it (s); stamps may go back."""
    if len(t_ns) < 2 or ((step := np.diff(t_ns)).min() > -SET_BACK_NS and step.max() <= MAX_GAP_S * 1e9):
        return []
    stays_back = np.append(t_ns[2:], t_ns[-1:]) < t_ns[:-1]
    rows = np.flatnonzero((step > MAX_GAP_S * 1e9) | ((step <= -SET_BACK_NS) & stays_back))
    return [(int(t_ns[row + 1]), float(step[row]) * 1e-9) for row in rows]


def longest_run(t_ns: Int64[np.ndarray, " n"]) -> slice:
    """Rows of the longest stretch on one setting of the clock, of stamps that increase."""
    starts = np.searchsorted(t_ns, [start_ns for start_ns, _ in clock_jumps(t_ns)])
    return max(_between(starts, len(t_ns)), key=lambda run: run.stop - run.start)


class ClockRun(NamedTuple):
    """Rows of an IMU between two set-backs of its clock, and their first and last stamp."""

    rows: slice
    first_ns: int
    last_ns: int
    alone: bool  # the clock was never set back

    def rows_of(self, t_ns: Int64[np.ndarray, " m"]) -> slice:
        """Rows of another topic: of several settings of its clock, the one that shares most with this one."""
        inside = (t_ns >= self.first_ns) & (t_ns <= self.last_ns)
        return max(_set_back(t_ns), key=lambda run: (int(inside[run].sum()), run.stop - run.start))


def clock_runs(t_ns: Int64[np.ndarray, " n"]) -> list[ClockRun]:
    """Runs between the set-backs of an IMU's clock; one for an IMU without samples."""
    runs = _set_back(t_ns)
    if not len(t_ns):
        return [ClockRun(runs[0], 0, 0, alone=True)]
    return [ClockRun(run, int(t_ns[run.start]), int(t_ns[run.stop - 1]), alone=len(runs) == 1) for run in runs]


def _set_back(t_ns: Int64[np.ndarray, " n"]) -> list[slice]:
    """Rows between the places where a clock was set back; one stamp that is ahead or late is none of them."""
    if len(t_ns) < 2 or (step := np.diff(t_ns)).min() > -SET_BACK_NS:
        return [slice(0, len(t_ns))]
    stays_back = np.append(t_ns[2:], t_ns[-1:]) < t_ns[:-1]
    was_right = t_ns[1:] <= np.append(t_ns[1:2], t_ns[:-2])
    return _between(np.flatnonzero((step <= -SET_BACK_NS) & stays_back & was_right) + 1, len(t_ns))


def _between(starts: Int64[np.ndarray, " k"], count: int) -> list[slice]:
    return [slice(a, b) for a, b in pairwise([0, *starts.tolist(), count])]


def jump_warnings(jumps: Sequence[tuple[int, float]]) -> Iterator[str]:
    """Jumps of a clock in words."""
    for start_ns, step_s in jumps[:MAX_TOLD]:
        years = f" ({abs(step_s) / YEAR_S:.1f} years)" if abs(step_s) > YEAR_S else ""
        yield f"the clock jumps by {step_s:+.6g} s{years} to {start_ns} ns; a new stretch begins there"
    if len(jumps) > MAX_TOLD:
        yield f"the clock jumps {len(jumps) - MAX_TOLD} times more"
