"""Times that several rows of a table share: the rows are kept, in files of one sensor and in rows that name theirs, too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from imutool.converters import table

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
