"""Times of a table; samples are counted where it states only a sampling rate."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from imutool.errors import ConfigError
from imutool.recording.message_log import MessageLog

from ..text.dates import NUMBERED, WEEK_NS, gps_times
from ..text.delimited import Columns
from ..text.names import OWN_TIME, TIME_WORDS, name_and_unit, spaced_name, split_name, unit_named
from .units import TIME_NS, USUAL_TIME_NS
from .wraps import begun_anew, unwrapped

NS = 10**9
COUNTED = "#counted "  # begins the name of a column of times that are counted
PLAUSIBLE_HZ = 5.0, 10_000.0
SLOWEST_HZ = 0.01, 0.9  # of samples with a time since 1970, and of others
OF = r"imu|gyr(o(scope)?)?|acce?(l(erometer)?)?|sensors?|data|log(ging)?|record(ing)?|acquisition|sampl(e|ing)|update|output"
RATE = rf"(({OF})_?)*(fs|f_?samp|srate|odr|hz|rate|freq|frequency)(_({OF}))*"  # no baud rate, no rate of frames
PERIOD = rf"(({OF})_?)*(dt|delta_?t|period|interval)|sampl(e|ing)_?time"
PERIOD_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
COUNTER = r"packet|count|index|seq|frame|sample(?![ _]?time)"  # in the name of a column that counts
FEWEST_STAMPS = 3  # that change, for the rate of the rows that share them
FEWEST_BATCHES = 8  # that show how many rows have one stamp
ROWS_APART, ROWS_ALIKE = 0.5, 0.8  # most by which the rows of a stamp differ from the usual number, and the share that does not
MAX_STEP = 4.0  # of a counter; a column of larger steps may be a clock
MAX_SKIPPED = 0.1  # share of a counter's steps that lost samples make longer; more may be packets of other sensors
MAX_ODD = 0.01  # share of its steps that are no multiple of the usual one
GPS_TIME = "gps_time [ns]"
GPS_WEEK = r"(.*_)?(gps_?)?(week|wk|gwk|wn)(_?(no?|num(ber)?))?"
TIME_OF_WEEK = r"(.*_)?((gps_?)?(tow|sow|time_?of_?week|sec(onds)?_?of_?week)|gps_?(time|sec(onds)?))"
MIN_WEEK, MAX_WEEK = 990, 5000  # of 1999, before which receivers counted again from 0, and of 2075
DAY_NS = 86_400 * NS
SERIAL_DAYS = {"Excel": 25_569, "MATLAB": 719_529}  # days of their calendars at the start of 1970
FIRST_DAY, LAST_DAY = 10_957, 47_482  # of 2000 and of 2100, since 1970


def join_gps_weeks(columns: Columns) -> None:
    """Make one column of the GPS week and the time in it, which begins again each week."""
    spelled = {column: split_name(column) for column in columns.values}
    weeks = [c for c, (name, _) in spelled.items() if re.fullmatch(GPS_WEEK, name) and columns.values[c].dtype.kind in "iu"]
    times = [c for c, (name, _) in spelled.items() if re.fullmatch(TIME_OF_WEEK, name)]
    if len(weeks) != 1 or len(times) != 1:
        return
    week, time = columns.values[weeks[0]].astype(np.int64), columns.values[times[0]].astype(float)
    unit = unit_named(columns.units.get(times[0], "")) or spelled[times[0]][1]
    fits = [unit] if unit in USUAL_TIME_NS else units_of_time(float(time[0]), float(np.median(np.diff(time))))
    if len(week) != len(time) or len(fits) != 1 or not np.isfinite(time).all() or not MIN_WEEK <= week.min() <= week.max():
        return
    ns = np.rint(time * USUAL_TIME_NS[fits[0]]).astype(np.int64)
    if not 0 <= ns.min() <= ns.max() < WEEK_NS or week.max() > MAX_WEEK:
        return
    t_ns, leap_s = gps_times(week, ns)
    for column in (weeks[0], times[0]):
        del columns.values[column]
        columns.texts.pop(column, None)
    columns.values, columns.units[GPS_TIME] = {GPS_TIME: t_ns, **columns.values}, "ns"
    columns.remarks.notes.append(f"{weeks[0]!r} and {times[0]!r} are UTC in the log, {leap_s} leap seconds behind GPS")


def read_clocks_and_days(columns: Columns) -> None:
    """Make nanoseconds of numbers hhmmss, of Windows' ticks, and of days of Excel and MATLAB.

    Days begin in 1899 and in the year 0. Steps of a sensor are so small in days that they fit no other unit.
    """
    for column, values in columns.values.items():
        name, unit = name_and_unit(column, columns.units.get(column, ""))
        is_named = re.search(r"time|date|day|stamp|utc|tick", name) or re.fullmatch(TIME_WORDS, name)
        found = ((t_ns, note) for read, note in NUMBERED if is_named and (t_ns := read(values)) is not None)
        if numbered := next(found, None):
            columns.values[column], columns.units[column] = numbered[0], "ns"
            columns.texts.pop(column, None)
            columns.remarks.notes.append(f"{column!r} holds {numbered[1]}")
            continue
        if values.dtype.kind != "f" or unit not in ("", "day") or not is_named or not np.isfinite(values).all():
            continue
        for program, start in SERIAL_DAYS.items():
            days = values.astype(np.float64) - start
            if not (FIRST_DAY <= days.min(initial=np.inf) <= days.max(initial=0.0) <= LAST_DAY and goes_on(values)):
                continue
            step_ns = float(np.median(np.diff(days))) * DAY_NS
            if step_ns > 0.0 and SLOWEST_HZ[1] <= NS / step_ns <= PLAUSIBLE_HZ[1]:
                columns.values[column], columns.units[column] = np.rint(days * DAY_NS).astype(np.int64), "ns"
                columns.texts.pop(column, None)
                columns.local_times.append(column)
                columns.remarks.notes.append(f"{column!r} counts days as {program} does; it names no zone and counts as UTC")


def fill_own_times(columns: Columns) -> None:
    """Interpolate a sensor's own time in rows that lack its samples, as before a gyro starts."""
    spelled = {column: spaced_name(column) for column in columns.values}
    for column, values in [*columns.values.items()]:
        own = next(filter(None, (re.match(form, spelled[column]) for form in OWN_TIME.values())), None)
        own = own if own and own[0].endswith("_t") else None
        missing = ~np.isfinite(values.astype(float)) if own else np.zeros(0, bool)
        beside = [c for c in spelled if own and c != column and spelled[c].startswith(own[0][:-1])]
        beside = [c for c in beside if len(columns.values[c]) == len(values)]
        if not 0 < missing.sum() < len(values) or not beside:
            continue
        if not any(np.isfinite(columns.values[c][missing].astype(float)).any() for c in beside):
            rows, filled = np.arange(len(values)), values.astype(float)
            filled[missing] = np.interp(rows[missing], rows[~missing], filled[~missing])
            columns.values[column], texts = filled, [*columns.texts.get(column, [])]
            for row in np.flatnonzero(missing).tolist() if texts else ():
                texts[row] = str(filled[row])
            columns.texts |= {column: texts} if texts else {}


def rises(values: np.ndarray) -> bool:
    """Whether nearly every value exceeds the one before it, and the one half a table before.

    The second tells a time from the nanoseconds of a stamp, which begin again each second.
    """
    later = values[len(values) // 2 :].astype(float) - values[: len(values) - len(values) // 2].astype(float)
    return len(values) > 1 and float(min(np.mean(np.diff(values.astype(float)) > 0), np.mean(later > 0))) > 0.9


def goes_on(values: np.ndarray) -> bool:
    """Whether a column named as a time is one: it may stand still, but not go back."""
    steps = np.diff(values.astype(float))
    is_rounded = len(steps) > 0 and float(np.mean(steps > 0)) > 0.5 and float(np.mean(steps >= 0)) > 0.99
    return rises(values) or is_rounded or in_batches(values)


def in_batches(values: np.ndarray) -> bool:
    """Whether a time stands still and rises by turns, with about as many rows for each stamp."""
    steps = np.diff(values.astype(float))
    rows = np.diff(np.flatnonzero(steps != 0))
    if len(rows) < FEWEST_BATCHES or float(np.mean(steps >= 0)) <= 0.99 or np.median(rows) <= 1.0:
        return False  # with one row for each stamp it only rises
    return float(np.mean(np.abs(rows / np.median(rows) - 1.0) <= ROWS_APART)) >= ROWS_ALIKE


def usual_step(values: np.ndarray) -> float:
    """Usual step of a time from row to row, also where several rows have one stamp."""
    values = values.astype(float)
    median = float(np.nanmedian(np.diff(values)))
    if median != 0.0 or not in_batches(values):
        return median
    starts = np.flatnonzero(np.diff(values)) + 1
    return float(np.median(np.diff(values[starts])) / np.median(np.diff(starts)))


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


def units_of_time(first: float, step: float) -> list[str]:
    """Units in which a time begins in this century, or else steps as an IMU does.

    A board that prints may be as slow as once a second, so a step of 1 may be a second or a millisecond.
    """
    rates = {unit: 1e9 / (step * size) for unit, size in USUAL_TIME_NS.items() if step > 0.0}
    epochs = [u for u, hz in rates.items() if SLOWEST_HZ[0] <= hz <= PLAUSIBLE_HZ[1] and 1e18 < first * TIME_NS[u] < 4e18]
    whole_s = epochs == ["s"] and float(first).is_integer() and float(step).is_integer()  # or ms since a boot weeks ago
    fast = [unit for unit, hz in rates.items() if PLAUSIBLE_HZ[0] <= hz < PLAUSIBLE_HZ[1]] if whole_s else []
    return epochs + fast or [unit for unit, hz in rates.items() if SLOWEST_HZ[1] <= hz < PLAUSIBLE_HZ[1]]


def rate_of_rows(column: str, values: np.ndarray, unit: str) -> list[str]:
    """Line of a map that counts rows, where several have one stamp."""
    first = float(values[0])
    changed = np.flatnonzero(np.diff(values) > 0) + 1  # the first and the last stamp may hold part of their rows
    if len(changed) < FEWEST_STAMPS:
        return []
    step = float(np.polyfit(changed - changed[0], values[changed].astype(float) - first, 1)[0])
    units = [unit] if unit in TIME_NS else units_of_time(first, step)
    if not step > 0.0 or len(units) != 1:
        return []
    rate = 1e9 / (step * TIME_NS[units[0]])
    return [
        f"rate_hz = {rate:.6g}  # in place of time and time_unit, if the rows are evenly spaced over the span of {column!r}"
    ]


def counters_of(columns: Columns, length: int) -> list[str]:
    """Columns of this length that count, row numbers without a name last."""
    found = []
    for column, values in columns.values.items():
        if values.dtype.kind in "iu" and len(values) == length > 1:
            steps = np.diff(unwrapped(values))
            regular = np.mean(steps == np.median(steps)) > 0.5 or re.search(COUNTER, column, re.IGNORECASE)
            if 1.0 <= np.median(steps) <= MAX_STEP and regular:
                found.append(column)
    return sorted(found, key=lambda column: re.fullmatch(r"column \d+", column) is not None)


def counts_others(values: np.ndarray) -> bool:
    """Whether a counter numbers other packets, too: steps are no multiples of the usual."""
    steps = np.diff(unwrapped(values))
    return float(np.mean(steps % max(float(np.median(steps)), 1.0) != 0.0)) > MAX_ODD


def is_counter(name: str) -> bool:
    """Whether a column is named as one that counts samples."""
    return re.search(COUNTER, name, re.IGNORECASE) is not None


def said_steps(values: np.ndarray) -> str:
    """Shares of the most frequent steps of a counter, in words."""
    steps, counts = np.unique(np.diff(unwrapped(values)), return_counts=True)
    maximum = np.argsort(-counts, kind="stable")[:3]
    return ", ".join(f"{100.0 * counts[n] / counts.sum():.0f} % of its steps are {steps[n]:g}" for n in maximum)


def share_skipped(values: np.ndarray) -> float:
    """Share of the steps of a counter that are longer than the usual one."""
    steps = np.diff(unwrapped(values))
    return float(np.mean(steps > np.median(steps)))


def count_times(columns: Columns, rate_hz: float, length: int, counter: str) -> str:
    """Add a column of seconds since the first sample, by a counter or by rows; its name.

    Raises:
        ConfigError: the counter has another length than the samples, does not count, or counts other packets, too.
    """
    if not counter:
        counts = np.arange(length, dtype=np.float64)
    elif len(values := columns.values.get(counter, np.zeros(0))) != length:
        raise ConfigError(f"{counter!r} has {len(values)} rows and the gyro {length}", where="counter", expected="as many")
    elif counts_others(values):
        raise ConfigError(
            f"{counter!r} counts more than the samples: {said_steps(values)}",
            where="counter",
            expected="steps that are multiples of one step",
            fix="Leave the counter out: the rows are counted then",
        )
    else:
        counts = unwrapped(values)
        if len(rows := begun_anew(values)):
            what = f"{counter!r} begins anew in row {rows[0] + 1}, and at no power of two"
            raise ConfigError(what, where="counter", expected="the samples of one recording")
        counts /= max(float(np.median(np.diff(counts))), 1.0)  # a packet's number also counts those of other sensors
    name = f"{COUNTED}{counter or length}"
    columns.values[name], columns.units[name] = counts / rate_hz, "s"
    return name


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
