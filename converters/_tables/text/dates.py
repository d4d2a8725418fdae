"""Times in texts: dates of several calendars' notations, and clocks without a date."""

from __future__ import annotations

import re
import time
from array import array
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from imutool.array_types import Int64

HOUR_NS = 3600 * 10**9
HALF_DAY_S = 43_200
LAST_NS = 2**63 - 1  # in the year 2262
WEEK_NS, GPS_EPOCH_NS = 604_800 * 10**9, 315_964_800 * 10**9  # GPS counts weeks since 1980-01-06
OLDEST_NS = 631_152_000 * 10**9  # 1990, before which a date is a time since a start
CENTURY_NS = 946_684_800 * 10**9, 4_102_444_800 * 10**9  # 2000 and 2100
APPLE_NS = 978_307_200 * 10**9  # 2001
SLOWEST_TICKS = 10**6
LEAP_SECONDS = (  # by which GPS is ahead of UTC, since then
    ("2017-01-01", 18),
    ("2015-07-01", 17),
    ("2012-07-01", 16),
    ("2009-01-01", 15),
    ("2006-01-01", 14),
    ("1999-01-01", 13),
)
PARTS_OF_SECOND = 1, 10, 100, 1000, 10**6  # behind hhmmss, without a point
LONGEST_END_NS = 20 * 10**9  # step across the end of a minute that shows it; numbers that only count step by 40 s there
LONGEST_STEP_NS = 2 * 10**9  # in the mean; 0, 50, 100, 150, ... would be 0:00, 0:50, 1:00, 1:50
NO_ZONE = "its times name no zone and count as UTC"
DAYTIME = r"\d\d?:\d\d:\d\d([.,]\d+)?( ?[ap]m)?"
SPANS = "elapsed|duration|relative|since"  # in the name of a column of times that are none of the day
DAY = r"\d{4}([-/.])\d\d?\1\d\d?|\d\d?([./])\d\d?\2\d{4}"
DATE = re.compile(  # 2026-11-21T15:04:05.123Z, also with a blank and an offset; 21.11.2026 15:04:05,123; 11/21/2026 3:04:05 PM
    r"(?:(?P<year>\d{4})(?P<mark>[-/._])(?P<month>\d\d?)(?P=mark)(?P<day>\d\d?)"
    r"|(?P<first>\d\d?)(?P<sign>[./])(?P<second>\d\d?)(?P=sign)(?P<last>\d{4}))(?:[T ]+|_|--?)"
    r"(?P<clock>\d\d?(?P<colon>[:_.-])\d\d(?P=colon)\d\d)(?:(?:[.,]|(?P=colon))(?P<fraction>\d{1,9})\d*)?"
    r" ?(?P<half>[AP]M)? ?(?P<zone>Z|UTC|GMT|[+-]\d\d(:?\d\d)?)?",
    re.IGNORECASE,
)
MONTHS = "jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"
NAMED = re.compile(rf"(\d\d?)[- ]({'|'.join(MONTHS)})[- ](\d{{4}})(?=[ T])", re.IGNORECASE)  # 21-Nov-2026 15:04:05, of MATLAB
COMPACT = re.compile(r"(\d{4})(\d\d)(\d\d)[T_ -](\d\d):?(\d\d):?(\d\d)(?!\d)")  # 20261121T150405.123
CLOCK = re.compile(  # of one day or, as Excel shows times, of one hour; 15:04:05:123 ends with milliseconds
    r"(?:(\d\d?):)?(\d\d?):(\d\d)(?:(?:[.,]|(?<=:\d\d:\d\d):(?=\d{3}$))(\d{1,9})\d*)?"
)


SPAN = re.compile(  # 0 days 00:00:00.010000, of pandas; 0.01 sec, of MATLAB
    r"(?P<days>-?\d+) days?(?: \+?(?P<h>\d\d):(?P<m>\d\d):(?P<s>\d\d(?:\.\d+)?))?"
    r"|(?P<number>-?\d+(?:\.\d+)?) (?P<unit>sec|min|hr)s?"
)
SPAN_S = {"sec": 1.0, "min": 60.0, "hr": 3600.0}


def calendar_times(texts: Sequence[str]) -> tuple[Int64[np.ndarray, " n"], list[str]] | None:
    """Nanoseconds since 1970 of dates, with notes; None for other texts.

    Clocks without a date count from the first midnight. Of 4/5/2026 the month is the first number, unless one exceeds 12 there.
    """
    spans = [SPAN.fullmatch(text) for text in texts] if texts and SPAN.fullmatch(texts[0]) else []
    if spans and all(spans):
        return np.array([_nanoseconds(match) for match in spans if match], np.int64), ["its durations count from a start"]
    if texts and NAMED.match(texts[0]):
        texts = [NAMED.sub(lambda m: f"{m[3]}-{MONTHS.index(m[2].lower()) + 1}-{m[1]}", text) for text in texts]
    if texts and COMPACT.match(texts[0]):
        texts = [COMPACT.sub(r"\1-\2-\3T\4:\5:\6", text, count=1) for text in texts]
    dates = (match for text in texts if "/" in text and (match := DATE.fullmatch(text)))
    slashes = [int(match["first"]) for match in dates if match["sign"] == "/"]
    day_first = any(first > 12 for first in slashes)
    stamps, has_zone = array("q"), False
    for text in texts:
        if (match := DATE.fullmatch(text)) is None:
            return _clock_times(texts)
        has_zone = bool(match["zone"]) if not stamps else has_zone
        month_first = match["sign"] == "/" and not day_first
        day, month = (match["second"], match["first"]) if month_first else (match["first"], match["second"])
        date = f"{match['year'] or match['last']}-{(match['month'] or month).zfill(2)}-{(match['day'] or day).zfill(2)}"
        try:
            seconds = int(np.datetime64(f"{date}T{match['clock'].zfill(8).replace(match['colon'], ':')}", "s").astype(np.int64))
        except ValueError:
            return None
        if half := match["half"]:
            seconds += HALF_DAY_S * ((half.upper() == "PM") - (match["clock"].startswith("12")))
        if (zone := match["zone"]) and zone[0] in "+-":
            seconds -= int(f"{zone[0]}1") * (3600 * int(zone[1:3]) + 60 * int(zone[3:].strip(":") or 0))
        t_ns = seconds * 10**9 + int((match["fraction"] or "0").ljust(9, "0"))
        if not 0 <= t_ns <= LAST_NS:
            return None
        stamps.append(t_ns)
    notes = [] if has_zone else [NO_ZONE]
    if slashes:
        notes.append(f"its dates count as {'day/month' if day_first else 'month/day'}/year")
    return np.array(stamps, np.int64), notes


def _nanoseconds(span: re.Match[str]) -> int:
    """Nanoseconds of a duration."""
    if span["number"]:
        return round(float(span["number"]) * SPAN_S[span["unit"]] * 1e9)
    hours = 24 * int(span["days"]) + int(span["h"] or 0)
    return (hours * 60 + int(span["m"] or 0)) * 60 * 10**9 + round(float(span["s"] or 0.0) * 1e9)


def clock_of_numbers(values: np.ndarray) -> Int64[np.ndarray, " n"] | None:
    """Nanoseconds since the first midnight of numbers hhmmss; None for others.

    They are written as 150405.12 or 150405120. Such numbers step by 40 s too much where a minute ends, and none of them has
    60 seconds or more.
    """
    if values.dtype.kind not in "iuf" or len(values) < 2 or not np.isfinite(values).all():
        return None
    for parts in PARTS_OF_SECOND:
        seconds, minutes, hours = values % (100 * parts) / parts, values // (100 * parts) % 100, values // (10_000 * parts)
        if values.min() < 0 or hours.max() >= 24 or minutes.max() >= 60 or seconds.max() >= 60.0:
            continue
        t_ns = np.rint((hours * 3600.0 + minutes * 60.0 + seconds) * 1e9).astype(np.int64)
        t_ns += 24 * HOUR_NS * np.concatenate([[0], np.cumsum(np.diff(t_ns) < -12 * HOUR_NS)])
        steps, ends = np.diff(t_ns), np.diff(minutes) != 0
        if ends.any() and steps.min() >= 0 and steps[ends].min() < LONGEST_END_NS and steps.mean() < LONGEST_STEP_NS:
            return t_ns
    return None


def dates_of_numbers(values: np.ndarray) -> Int64[np.ndarray, " n"] | None:
    """Nanoseconds since 1970 of whole numbers yyyymmddhhmmss; None for others.

    Parts of the second may stand behind.
    """
    for parts in PARTS_OF_SECOND if values.dtype.kind in "iu" and len(values) else ():
        days, clocks = np.divmod(values, 10**6 * parts)
        seconds, minutes, hours = clocks % (100 * parts), clocks // (100 * parts) % 100, clocks // (10_000 * parts)
        fits = (days >= 1970_01_01) & (days < 2262_01_01) & (hours < 24) & (minutes < 60) & (seconds < 60 * parts)
        if not fits.all():
            continue
        named, place = np.unique(days, return_inverse=True)
        try:
            dates = [np.datetime64(f"{day // 10_000}-{day // 100 % 100:02d}-{day % 100:02d}", "ns") for day in named.tolist()]
        except ValueError:  # 20261340
            continue
        of_day = (hours * 3600 + minutes * 60) * 10**9 + seconds * (10**9 // parts)
        t_ns: Int64[np.ndarray, " n"] = np.array(dates).astype(np.int64)[place] + of_day
        return t_ns
    return None


def ticks_of_windows(values: np.ndarray, epoch: int) -> Int64[np.ndarray, " n"] | None:
    """Nanoseconds since 1970 of ticks of 100 ns; None for other numbers.

    Ticks are of this century, and of at least ten samples a second. `epoch` is the tick of 1970.
    """
    if values.dtype.kind not in "iu" or len(values) < 2 or values.max() > LAST_NS:
        return None
    ticks: Int64[np.ndarray, " n"] = values.astype(np.int64) - epoch
    is_fast = 0 < ticks[-1] - ticks[0] <= SLOWEST_TICKS * (len(ticks) - 1)  # nanoseconds of as small a step are of no IMU
    return ticks * 100 if is_fast and CENTURY_NS[0] // 100 <= ticks.min() <= ticks.max() <= CENTURY_NS[1] // 100 else None


def said_epoch(t_ns: int, name: str) -> list[str]:
    """Note on a date of a time that may count from another day than that of 1970; else none."""
    first_ns = {"2000 (as Polar does)": CENTURY_NS[0], "2001 (as Apple does)": APPLE_NS}
    if "gps" in name.lower() and t_ns + GPS_EPOCH_NS < time.time_ns():
        first_ns = {"1980 (as GPS does)": GPS_EPOCH_NS}
    elif t_ns >= CENTURY_NS[0]:
        return []
    if t_ns < OLDEST_NS:
        return []
    date, *others = (str(np.datetime64(t_ns + first, "ns"))[:10] for first in (0, *first_ns.values()))
    readings = " and ".join(f"{other} if it counts since {what}" for other, what in zip(others, first_ns, strict=True))
    return [f"{name!r} begins on {date} if it counts since 1970, as the log has it; on {readings}"]


NUMBERED: tuple[tuple[Callable[[np.ndarray], Int64[np.ndarray, " n"] | None], str], ...] = (  # readers, and what they read
    (dates_of_numbers, "dates and times (yyyymmddhhmmss), which name no zone and count as UTC"),
    (clock_of_numbers, "hours, minutes and seconds (hhmmss), from the start of the day"),
    (partial(ticks_of_windows, epoch=116_444_736 * 10**9), "ticks of 100 ns since 1601, as Windows counts them"),
    (partial(ticks_of_windows, epoch=621_355_968 * 10**9), "ticks of 100 ns since the year 1, as .NET counts them"),
)


def damaged_times(texts: Sequence[str]) -> list[tuple[int, str]]:
    """Rows and fields of another form than most, which are dates or clocks."""
    odd = ([(row, text) for row, text in enumerate(texts, 1) if not form.fullmatch(text)] for form in (DATE, CLOCK))
    return next((fields for fields in odd if len(fields) < len(texts) / 2), [])


def join_dates(names: list[str], fields: list[Sequence[str]]) -> int | None:
    """Make one column of dates and their clocks; return the place of the one that is gone."""
    dates = [n for n, texts in enumerate(fields) if re.fullmatch(DAY, next(iter(texts), ""))]
    times = [n for n, texts in enumerate(fields) if re.fullmatch(DAYTIME, next(iter(texts), ""), re.IGNORECASE)]
    clocks = [n for n in times if not re.search(SPANS, names[n], re.IGNORECASE)]
    if len(dates) != 1 or len(clocks) != 1:
        return None
    (date,), (clock,) = dates, clocks
    both = [" ".join(each) for each in zip(fields[date], fields[clock], strict=True)]
    if calendar_times(both) is None:
        return None
    names[clock], fields[clock] = f"{names[date]} {names[clock]}", both
    del names[date], fields[date]
    return date


def gps_times(week: Int64[np.ndarray, " n"], ns: Int64[np.ndarray, " n"]) -> tuple[Int64[np.ndarray, " n"], int]:
    """Nanoseconds since 1970 (UTC) of GPS weeks and the time in them, and the leap seconds."""
    since_1970 = GPS_EPOCH_NS + week * WEEK_NS + ns
    leap_s = next((count for start, count in LEAP_SECONDS if since_1970[0] >= np.datetime64(start, "ns").astype(np.int64)), 0)
    return since_1970 - leap_s * 10**9, leap_s


def _clock_times(texts: Sequence[str]) -> tuple[Int64[np.ndarray, " n"], list[str]] | None:
    """Times of the day, or of the hour, in nanoseconds since the first midnight; a step back of half of it begins the next."""
    if not all(map(CLOCK.fullmatch, texts)):
        return None
    parts = (match.groups(default="0") for match in map(CLOCK.fullmatch, texts) if match)
    ns = ((int(h) * 3600 + int(m) * 60 + int(s)) * 10**9 + int(f.ljust(9, "0")) for h, m, s, f in parts)
    t_ns = np.fromiter(ns, np.int64, len(texts))
    first = CLOCK.fullmatch(texts[0])
    whole = (24 if first and first[1] else 1) * HOUR_NS
    t_ns += whole * np.concatenate([[0], np.cumsum(np.diff(t_ns) < -whole // 2)])
    return t_ns, [f"its times name no date and count from the start of the {'day' if whole > HOUR_NS else 'hour'}"]
