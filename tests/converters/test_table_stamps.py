"""Times that several rows of a table share: the rows are kept, in files of one sensor and in rows that name theirs, too."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from imutool.converters import table
from imutool.errors import ConfigError

COUNT, LATE_MS = 1000, 3
GYRO = np.random.default_rng(8).normal(0.0, 0.1, (COUNT, 3))
ACCEL = np.random.default_rng(9).normal([0.0, 0.0, 9.81], 0.1, (COUNT, 3))
T_NS = 10_000_000 * np.arange(COUNT)
STAMPS_MS = np.repeat(T_NS[::5], 5) // 1_000_000
UNITS = {"gyro_unit": "rad/s", "time_unit": "ms"}


def lines(stamps_ms: np.ndarray, *values: np.ndarray, word: str = "") -> list[str]:
    rows = zip(stamps_ms.tolist(), np.hstack(values).tolist(), strict=True)
    return [",".join([str(stamp), *filter(None, [word]), *map(repr, row)]) for stamp, row in rows]


def wrote(folder: Path, form: str) -> Path:
    if form == "one table":
        text = {"log.csv": ["t,gx,gy,gz,ax,ay,az", *lines(STAMPS_MS, GYRO, ACCEL)]}
    elif form == "a table a sensor":
        header = "timestamp_ms,x,y,z"
        text = {"gyro.csv": [header, *lines(STAMPS_MS, GYRO)], "accel.csv": [header, *lines(STAMPS_MS + LATE_MS, ACCEL)]}
    else:
        both = zip(lines(STAMPS_MS, GYRO, word="GYRO"), lines(STAMPS_MS, ACCEL, word="ACCEL"), strict=True)
        text = {"log.txt": [line for pair in both for line in pair]}
    for name, rows in text.items():
        (folder / name).write_text("\n".join(rows) + "\n")
    return folder


@pytest.mark.parametrize("form", ["one table", "a table a sensor", "rows that name their sensor"])
def test_rows_of_one_stamp_are_spread_over_the_time_to_the_next(tmp_path: Path, form: str) -> None:
    (sequence,) = table.sequences(wrote(tmp_path, form))
    log = table.read_sequence(sequence, mapping=UNITS)
    imu = log.imus["/imu0"]
    first = COUNT - len(imu)  # a gyro sample ahead of the accelerometer's
    assert first == (1 if form == "a table a sensor" else 0)
    assert np.array_equal(imu.t_ns, T_NS[first:])
    np.testing.assert_allclose(imu.gyro, GYRO[first:], rtol=1e-12)
    assert any("has a stamp for 5 rows each in the mean" in note for note in log.remarks.notes)
    assert any("800 of 1000 samples share the stamp of another one" in note for note in log.remarks.notes)


def test_a_time_that_stands_still_is_none_where_another_rises(tmp_path: Path) -> None:
    rows = lines(STAMPS_MS, T_NS[:, None] / 1e9, GYRO, ACCEL)
    (tmp_path / "log.csv").write_text("\n".join(["host_time,sensor_time,gx,gy,gz,ax,ay,az", *rows]) + "\n")
    log = table.read_sequence(table.sequences(tmp_path)[0], mapping={"gyro_unit": "rad/s"})
    assert np.array_equal(log.imus["/imu0"].t_ns, T_NS)
    assert not any("share the stamp" in note for note in log.remarks.notes)


def test_a_clock_of_batches_that_is_set_back_loses_what_it_repeats(tmp_path: Path) -> None:
    back = STAMPS_MS - 2000 * (np.arange(COUNT) >= 600) + 4000
    (tmp_path / "log.csv").write_text("\n".join(["t,gx,gy,gz,ax,ay,az", *lines(back, GYRO, ACCEL)]) + "\n")
    log = table.read_sequence(table.sequences(tmp_path)[0], mapping=UNITS)
    imu = log.imus["/imu0"]
    assert len(imu) == COUNT - 200
    assert np.diff(imu.t_ns).min() > 0
    assert "/imu0: 200 samples whose stamp goes back are left out" in log.remarks.notes


@pytest.mark.parametrize("form", ["150405.12", "150405120", "150405"])
def test_numbers_of_hours_minutes_and_seconds_are_a_time_of_the_day(tmp_path: Path, form: str) -> None:
    """As milliseconds or seconds they jump by 40 s where a minute ends, and by 40 minutes where an hour ends."""
    rate_hz = 5 if form == "150405" else 100
    t_s = 15 * 3600 + 59 * 60 + 55 + np.arange(COUNT) / rate_hz
    hhmmss = t_s // 3600 * 10_000 + t_s // 60 % 60 * 100 + t_s % 60
    stamps = {"150405": np.floor(hhmmss + 1e-9), "150405120": np.rint(hhmmss * 1000)}.get(form, np.round(hhmmss, 2))
    stamps = stamps if "." in form else stamps.astype(np.int64)
    (tmp_path / "log.csv").write_text("\n".join(["utc_time,gx,gy,gz,ax,ay,az", *lines(stamps, GYRO, ACCEL)]) + "\n")
    log = table.read_sequence(table.sequences(tmp_path)[0], mapping={"gyro_unit": "rad/s"})
    np.testing.assert_allclose(log.imus["/imu0"].t_ns, np.rint(t_s * 1e9), atol=1e3)
    assert "'utc_time' holds hours, minutes and seconds (hhmmss), from the start of the day" in log.remarks.notes


@pytest.mark.parametrize(("step", "rows"), [(50, 100), (50, 101), (20, 1000), (1000, 300)])
def test_milliseconds_are_no_hours_minutes_and_seconds(tmp_path: Path, step: int, rows: int) -> None:
    stamps = step * np.arange(rows)
    (tmp_path / "log.csv").write_text("\n".join(["time,gx,gy,gz,ax,ay,az", *lines(stamps, GYRO[:rows], ACCEL[:rows])]) + "\n")
    log = table.read_sequence(table.sequences(tmp_path)[0], mapping={"gyro_unit": "rad/s", "time_unit": "ms"})
    assert np.array_equal(log.imus["/imu0"].t_ns, stamps * 1_000_000)


def test_a_time_that_only_rises_has_a_stamp_for_each_row(tmp_path: Path) -> None:
    """Next to the time of a program that stands still for batches it is taken, and nothing is said of batches."""
    rows = lines(STAMPS_MS + 10**12, T_NS[:, None] // 1_000_000 + 1_700_000_000_000, GYRO, ACCEL)
    (tmp_path / "log.csv").write_text("\n".join(["time,millis,gx,gy,gz,ax,ay,az", *rows]) + "\n")
    log = table.read_sequence(table.sequences(tmp_path)[0], mapping={"gyro_unit": "rad/s"})
    assert np.array_equal(log.imus["/imu0"].t_ns, T_NS + 1_700_000_000_000_000_000)
    assert not any("has a stamp for" in note for note in log.remarks.notes)


@pytest.mark.parametrize("form", ["%Y%m%d%H%M%S%f", "%Y%m%dT%H%M%S.%f", "%Y%m%d_%H%M%S.%f"])
def test_dates_without_marks_are_times_in_utc_also_across_midnight(tmp_path: Path, form: str) -> None:
    start_ms = 1_764_460_798_500  # 2025-11-29 23:59:58.5
    moments = [datetime.fromtimestamp((start_ms + 10 * n) / 1000, UTC).strftime(form)[:-3] for n in range(COUNT)]
    rows = lines(np.array(moments), GYRO, ACCEL)
    (tmp_path / "imu.csv").write_text("\n".join(["timestamp,gx,gy,gz,ax,ay,az", *rows]) + "\n")
    log = table.read_sequence(table.sequences(tmp_path / "imu.csv")[0], mapping={"gyro_unit": "rad/s"})
    assert log.imus["/imu0"].t_ns.tolist() == [(start_ms + 10 * n) * 10**6 for n in range(COUNT)]


@pytest.mark.parametrize("form", ["{s:.2f} sec", "{s:.2f} secs", "{m} min", "0 days 00:00:{s:09.6f}"])
def test_durations_of_matlab_and_pandas_are_times(tmp_path: Path, form: str) -> None:
    moments = [form.format(s=n / 100, m=n / 6000) for n in range(COUNT)]
    (tmp_path / "imu.csv").write_text("\n".join(["Time,gx,gy,gz,ax,ay,az", *lines(np.array(moments), GYRO, ACCEL)]) + "\n")
    log = table.read_sequence(table.sequences(tmp_path / "imu.csv")[0], mapping={"gyro_unit": "rad/s"})
    np.testing.assert_allclose(log.imus["/imu0"].t_ns, T_NS, atol=1.0)


@pytest.mark.parametrize("first", ["0,1,2,3,4,5,6", ",0,1,2,3,4,5,6"])
def test_numbers_of_columns_above_a_table_are_no_sample(tmp_path: Path, first: str) -> None:
    """As pandas writes them: they were the first sample."""
    rows = [f"{n},{row}" if first.startswith(",") else row for n, row in enumerate(lines(T_NS / 1e9, GYRO, ACCEL))]
    (tmp_path / "imu.csv").write_text("\n".join([first, *rows]) + "\n")
    log = table.read_sequence(table.sequences(tmp_path / "imu.csv")[0], mapping={"gyro_unit": "rad/s", "time_unit": "s"})
    assert np.array_equal(log.imus["/imu0"].t_ns, T_NS)
    assert np.array_equal(log.imus["/imu0"].gyro, GYRO)


@pytest.mark.parametrize("epoch", [116_444_736 * 10**9, 621_355_968 * 10**9])
def test_ticks_of_windows_are_dates(tmp_path: Path, epoch: int) -> None:
    t_ns = 1_714_564_800 * 10**9 + T_NS
    rows = lines(t_ns // 100 + epoch, GYRO, ACCEL)
    (tmp_path / "log.csv").write_text("\n".join(["timestamp,gx,gy,gz,ax,ay,az", *rows]) + "\n")
    log = table.read_sequence(table.sequences(tmp_path)[0], mapping={"gyro_unit": "rad/s"})
    np.testing.assert_array_equal(log.imus["/imu0"].t_ns, t_ns // 100 * 100)


@pytest.mark.parametrize(
    ("name", "first_s", "kept", "said"),
    [
        ("timestamp", 767_880_000, "1994-05-02", "2024-05-01 if it counts since 2000"),
        ("gps_time", 1_398_600_018, "2014-04-27", "2024-05-01 if it counts since 1980"),
        ("timestamp", 1_714_564_800, "", ""),
        ("gps_time", 1_714_564_800, "", ""),
        ("timestamp", 0, "", ""),
    ],
)
def test_a_date_that_may_count_from_another_day_than_1970_began_is_noted(tmp_path, name, first_s, kept, said) -> None:
    rows = lines(first_s * 10**9 + T_NS, GYRO, ACCEL)
    (tmp_path / "log.csv").write_text("\n".join([f"{name} [ns],gx,gy,gz,ax,ay,az", *rows]) + "\n")
    log = table.read_sequence(table.sequences(tmp_path)[0], mapping={"gyro_unit": "rad/s"})
    notes = [note for note in log.remarks.notes if "if it counts since" in note]
    assert [f"begins on {kept} if" in note and f"; on {said}" in note for note in notes] == [True] * bool(said)


@pytest.mark.parametrize("name", ["TimeIntervalSince1970", "utc_time [ms]"])
def test_a_time_since_1970_shows_the_zone_of_dates_that_name_none(tmp_path: Path, name: str) -> None:
    t_ns = 1_698_537_597_000_000_000 + T_NS  # summer time ends in Europe after 3 s
    hours = np.where(T_NS < 3 * 10**9, 2, 1)
    moments = (t_ns // 1000 + 3_600_000_000 * hours).astype("M8[us]").astype(str)
    stated = t_ns // 1_000_000 if "ms" in name else t_ns / 1e9
    rows = lines(np.array([f"{moment},{each}" for moment, each in zip(moments, stated.tolist(), strict=True)]), GYRO, ACCEL)
    (tmp_path / "log.csv").write_text("\n".join([f"Timestamp,{name},gx,gy,gz,ax,ay,az", *rows]) + "\n")
    log = table.read_sequence(table.sequences(tmp_path)[0], mapping={"gyro_unit": "rad/s"})
    np.testing.assert_array_equal(log.imus["/imu0"].t_ns, t_ns)
    assert any(f"Timestamp is in a zone of +1 h and +2 h by '{name}'" in note for note in log.remarks.notes)


@pytest.mark.parametrize("names", ["Acceleration {} (m/s^2) Gyroscope {} (rad/s)", "{} (m/s^2) {} (rad/s)"])
@pytest.mark.parametrize("short", ["gyro", "accel"])
def test_sensors_side_by_side_have_the_rows_of_their_own_times(tmp_path: Path, names: str, short: str) -> None:
    units = names.replace(") ", ")|").split("|")
    header = ",".join(",".join(["Time (s)", *(each.format(axis) for axis in "xyz")]) for each in units)
    t_s = T_NS[:, None] / 1e9
    whole = [lines(t_s[:, 0], values) for values in (ACCEL, GYRO)]
    place = ["accel", "gyro"].index(short)
    whole[place] = whole[place][::2] + [",,,"] * (COUNT // 2)
    (tmp_path / "log.csv").write_text("\n".join([header, *map(",".join, zip(*whole, strict=True))]) + "\n")
    imu = table.read_sequence(table.sequences(tmp_path)[0]).imus["/imu0"]
    step = 2 if short == "gyro" else 1
    np.testing.assert_array_equal(imu.t_ns, T_NS[::step][: len(imu)])
    np.testing.assert_array_equal(imu.gyro, GYRO[::step][: len(imu)])
    np.testing.assert_allclose(imu.accel[::2], ACCEL[:: 2 * step][: len(imu.accel[::2])], rtol=1e-12)


PARTS = {  # of a time, and what they are where they are one
    "seconds and milliseconds": ("{s},{ms}", "seconds,milliseconds", 0),
    "two times": ("{s},{ms}", "time_s,time_ms", 0),
    "a date and milliseconds": ("{date},{ms}", "Timestamp,Milliseconds", 0),
    "a date and milliseconds since the start": ("{date},{all}", "Timestamp,Milliseconds", 0),
    "a clock and a date": ("{y},{m},{d},{H},{M},{S},{ms}", "year,month,day,hour,minute,second,millisecond", 0),
    "a clock": ("{H},{M},{S},{ms}", "hour,min,sec,msec", 20_405 * 86_400 * 10**9),
}


@pytest.mark.parametrize("form", PARTS)
def test_a_time_in_parts_keeps_its_milliseconds_and_its_gaps(tmp_path: Path, form: str) -> None:
    row, header, day_ns = PARTS[form]
    kept = np.setdiff1d(np.arange(COUNT), np.arange(130, 170))
    t_ns = (1_763_078_399_600_000_000 + T_NS)[kept]  # midnight is 400 ms later
    fields = []
    for t in t_ns.tolist():
        at = datetime.fromtimestamp(t // 10**9, UTC)
        clock = {"y": at.year, "m": at.month, "d": at.day, "H": at.hour, "M": at.minute, "S": at.second}
        ms = {"ms": t // 10**6 % 1000, "all": (t - t_ns[0]) // 10**6}
        fields.append(row.format(s=t // 10**9, date=at.strftime("%Y-%m-%d %H:%M:%S"), **clock, **ms))
    rows = lines(np.array(fields), GYRO[kept], ACCEL[kept])
    (tmp_path / "log.csv").write_text("\n".join([f"{header},gx,gy,gz,ax,ay,az", *rows]) + "\n")
    log = table.read_sequence(table.sequences(tmp_path / "log.csv")[0], mapping={"gyro_unit": "rad/s"})
    np.testing.assert_array_equal(log.imus["/imu0"].t_ns, t_ns - day_ns)
    assert not any("share the stamp" in note for note in log.remarks.notes)


def test_a_time_since_a_start_is_no_zone_of_a_clock(tmp_path: Path) -> None:
    rows = lines(np.array([f"10,0,{t // 10**9},{t / 1e9}" for t in T_NS.tolist()]), GYRO, ACCEL)
    (tmp_path / "log.csv").write_text("\n".join(["hour,minute,second,elapsed_time (s),gx,gy,gz,ax,ay,az", *rows]) + "\n")
    log = table.read_sequence(table.sequences(tmp_path)[0], mapping={"gyro_unit": "rad/s"})
    np.testing.assert_array_equal(log.imus["/imu0"].t_ns, T_NS)
    assert not any("zone of" in note for note in log.remarks.notes)


def test_rows_with_the_newest_first_are_to_be_sorted(tmp_path: Path) -> None:
    rows = lines(T_NS // 1_000_000, GYRO, ACCEL)[::-1]
    (tmp_path / "log.csv").write_text("\n".join(["time_ms,gx,gy,gz,ax,ay,az", *rows]) + "\n")
    with pytest.raises(ConfigError, match="'time_ms' is named as a time and falls from row to row: sort the rows by it"):
        table.read_sequence(table.sequences(tmp_path / "log.csv")[0], mapping={"gyro_unit": "rad/s"})
