"""Times in nanoseconds, and those that begin again, at an end or with a recording."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from decimal import Decimal, InvalidOperation

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.errors import DataError

from ..text.dates import LAST_NS

WORD_SIZES = 2**8, 2**16, 2**32  # at which a counter begins again
MAX_OF_WORD = 0.9  # of its size, by which a counter falls where it begins again
MAX_SKIPPED = 0.1  # share of its size by which the last of a counter may miss it
PARTS_OF_TIME = 60, 3600, 86_400, 604_800  # seconds of a minute, an hour, a day, a GPS week
ENDS_S = 1, *PARTS_OF_TIME  # at which a time begins again
ENDS = 2**16, 2**24, 2**31, 2**32  # counts, at which it does, too
MAX_STEPS = 10.0  # usual steps across an end
PARTS_IN_UNITS = *(part * 1000**k for part in PARTS_OF_TIME for k in range(4)), 24  # s, ms, us, ns; hours
SIZES = *(2**k for k in range(4, 33)), *(10**k for k in range(10)), *PARTS_IN_UNITS  # at which a time or a counter begins again
MIN_ROWS = 20  # of a recording, in the mean


def stamps(values: np.ndarray, texts: Sequence[str] | None, unit_ns: int, where: str) -> Int64[np.ndarray, " n"]:
    """Times in nanoseconds; decimals of a text file are exact.

    Raises:
        DataError: no numbers, or beyond the year 2262.
    """
    if values.dtype.kind in "iu" and (not len(values) or int(values.max()) <= LAST_NS // unit_ns):
        return values.astype(np.int64) * unit_ns
    if texts is not None:
        with suppress(InvalidOperation, OverflowError, ValueError):
            ns = (int((Decimal(text) * unit_ns).to_integral_value()) for text in texts)
            return np.fromiter(ns, np.int64, len(texts))
    odd = ~(np.abs(values.astype(np.float64)) * unit_ns < LAST_NS)
    if odd.any():
        first = f"the first in row {int(odd.argmax()) + 1}: {values[odd.argmax()]}"
        what = f"holds {int(odd.sum())} times that are no numbers, or beyond the year 2262 ({first})"
        raise DataError(what, where=where, expected="a time in each row", fix="Take such rows out, or map another `time`")
    return np.rint(values.astype(np.float64) * unit_ns).astype(np.int64)


def begun_anew(values: np.ndarray) -> Int64[np.ndarray, " k"]:
    """Rows in which a time or a counter begins anew, as in a table of several recordings.

    None where it begins anew at a power of two, or as the seconds of a minute and the fractions of a second do.
    """
    steps = np.diff(values.astype(np.float64))
    rows = np.flatnonzero(steps < 0.0) + 1
    if not len(rows) or len(values) < MIN_ROWS * (len(rows) + 1) or np.mean(steps > 0.0) < 0.5:
        return np.zeros(0, np.int64)
    step, last = float(np.median(steps[steps > 0.0])), values[rows - 1].astype(np.float64)
    size = min(SIZES, key=lambda each: abs(float(last.max()) + step - each))
    passed = last - values[np.concatenate([[0], rows[:-1]])]
    is_wrap = abs(float(last.max()) + step - size) <= step and (last > size - MAX_SKIPPED * size).all()
    return rows if not is_wrap and (-steps[rows - 1] > passed / 2.0).all() else np.zeros(0, np.int64)


def unwrapped(counts: np.ndarray) -> Float64[np.ndarray, " n"]:
    """Counts since the first one, of a counter that begins again at a power of two."""
    values = counts.astype(np.float64)
    size = next((size for size in WORD_SIZES if values.max(initial=0.0) < size), 2**53)
    return np.concatenate([[0.0], np.cumsum(np.diff(values) % size)])


def without_ends(t_ns: Int64[np.ndarray, " n"], unit_ns: int, name: str, notes: list[str]) -> Int64[np.ndarray, " n"]:
    """Times that go on where they begin again.

    That is at a power of two of their unit, each second, minute, hour, day or GPS week. There the time falls by about the whole
    range, and goes on with a usual step. At 2^32 samples may be missing.
    """
    steps = np.diff(t_ns)
    words = {f"2^{size.bit_length() - 1}": size * unit_ns for size in ENDS if size * unit_ns <= LAST_NS}
    ends = words | {f"{s} s": s * 10**9 for s in ENDS_S}
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    for end, size in ends.items() if (steps < 0).any() else ():
        falls = steps < -MAX_OF_WORD * size
        gaps = steps[falls] + size
        is_word = end == "2^32" and t_ns.min() >= 0 and t_ns.max() < size
        fits = int(t_ns.max()) + size * int(falls.sum()) <= LAST_NS
        if falls.any() and fits and np.ptp(t_ns) < size and (is_word or (gaps.min() > 0 and gaps.max() <= MAX_STEPS * usual)):
            note = f"{name!r} begins again at {end} ({int(falls.sum())} times): its times go on there"
            notes += [note] if note not in notes else []
            t_ns[1:] += size * np.cumsum(falls)
            return t_ns
    return t_ns
