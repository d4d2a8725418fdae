"""Times of a table; samples are counted where it states only a sampling rate."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from imutool.array_types import Float64
from imutool.errors import ConfigError
from imutool.recording.message_log import MessageLog

from ._table_text import Columns

NS = 10**9
COUNTED = "#counted "  # begins the name of a column of times that are counted
PLAUSIBLE_HZ = 5.0, 10_000.0
OF = r"imu|gyr(o(scope)?)?|acce?(l(erometer)?)?|sensors?|data|log(ging)?|record(ing)?|acquisition|sampl(e|ing)|update|output"
RATE = rf"(({OF})_?)*(fs|f_?samp|srate|odr|hz|rate|freq|frequency)(_({OF}))*"  # no baud rate, no rate of frames
PERIOD = rf"(({OF})_?)*(dt|delta_?t|period|interval)|sampl(e|ing)_?time"
PERIOD_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
MOST_STEP = 4.0  # of a counter; a column of larger steps may be a clock
WORD_SIZES = 2**8, 2**16, 2**32  # at which a counter begins again


def rises(values: np.ndarray) -> bool:
    """Whether nearly every value exceeds the one before it, and the one half a table before.

    The second tells a time from the nanoseconds of a stamp, which begin again each second.
    """
    later = values[len(values) // 2 :].astype(float) - values[: len(values) - len(values) // 2].astype(float)
    return len(values) > 1 and float(min(np.mean(np.diff(values.astype(float)) > 0), np.mean(later > 0))) > 0.9


def goes_on(values: np.ndarray) -> bool:
    """Whether a column named as a time is one: rounded, it may stand still, but not go back."""
    steps = np.diff(values.astype(float))
    return rises(values) or (len(steps) > 0 and float(np.mean(steps > 0)) > 0.5 and float(np.mean(steps >= 0)) > 0.99)


def stated_rate(columns: Columns, gyro: str) -> tuple[str, float] | None:
    """Name and value (Hz) of the sampling rate that the file states; None without a sole one.

    One in a group counts for the column `gyro` of that group only: a camera has a rate, too.
    """
    found: dict[str, float] = {}
    for name, value in columns.numbers.items():
        group = re.sub(r"[^/.]*$", "", name)
        if not gyro.startswith(group.strip("/.")):
            continue
        leaf = re.sub(r"[^a-z0-9]+", "_", name[len(group) :].lower()).strip("_")
        size = 1e3 if leaf.endswith("khz") else 1.0
        if re.fullmatch(RATE, re.sub(r"(?<=.)_?k?hz$", "", leaf)):
            found[name] = value * size
        elif match := re.fullmatch(rf"({PERIOD})(_(?P<unit>s|ms|us|ns))?", leaf):
            rates = [1.0 / (value * PERIOD_S[u]) for u in ([match["unit"]] if match["unit"] else PERIOD_S) if value > 0.0]
            plausible = [rate for rate in rates if PLAUSIBLE_HZ[0] <= rate <= PLAUSIBLE_HZ[1]]
            if len(plausible) == 1:
                found[name] = plausible[0]
    found = {name: rate for name, rate in found.items() if PLAUSIBLE_HZ[0] <= rate <= PLAUSIBLE_HZ[1]}
    if not found or not np.allclose([*found.values()], next(iter(found.values())), rtol=1e-3):
        return None
    return next(iter(found.items()))


def counter_of(columns: Columns, length: int) -> str:
    """Column of this length that counts samples, missing ones too; empty without one."""
    for column, values in columns.values.items():
        if values.dtype.kind in "iu" and len(values) == length > 1:
            steps = np.diff(_unwrapped(values))
            if 1.0 <= np.median(steps) <= MOST_STEP and np.mean(steps == np.median(steps)) > 0.5:
                return column
    return ""


def count_times(columns: Columns, rate_hz: float, length: int, counter: str) -> str:
    """Add a column of seconds since the first sample, by a counter or by rows; its name.

    Raises:
        ConfigError: the counter has another length than the samples, or does not count.
    """
    if not counter:
        counts = np.arange(length, dtype=np.float64)
    elif len(values := columns.values.get(counter, np.zeros(0))) == length:
        counts = _unwrapped(values)
        counts /= max(float(np.median(np.diff(counts))), 1.0)  # a packet's number also counts those of other sensors
    else:
        raise ConfigError(f"{counter!r} has {len(values)} rows and the gyro {length}", where="counter", expected="as many")
    name = f"{COUNTED}{counter or length}"
    columns.values[name], columns.units[name] = counts / rate_hz, "s"
    return name


def _unwrapped(counts: np.ndarray) -> Float64[np.ndarray, " n"]:
    """Counts since the first one, of a counter that begins again at a power of two."""
    values = counts.astype(np.float64)
    size = next((size for size in WORD_SIZES if values.max(initial=0.0) < size), 2**53)
    return np.concatenate([[0.0], np.cumsum(np.diff(values) % size)])


def begun_at_zero(log: MessageLog) -> MessageLog:
    """Log without negative times, which a clock that counts from a launch or another start has."""
    parts = [*log.imus.values(), *log.poses.values(), *log.scalars.values()]
    first = min((int(part.t_ns[0]) for part in parts if len(part.t_ns)), default=0)
    if first >= 0:
        return log
    later = -(first // NS) * NS
    log.remarks.notes.append(f"the times begin at {first / NS:.3f} s: all are {later // NS} s later in the log")
    imus = {topic: replace(imu, t_ns=imu.t_ns + later) for topic, imu in log.imus.items()}
    poses = {topic: replace(part, t_ns=part.t_ns + later) for topic, part in log.poses.items()}
    scalars = {topic: replace(part, t_ns=part.t_ns + later) for topic, part in log.scalars.items()}
    return replace(log, imus=imus, poses=poses, scalars=scalars)
