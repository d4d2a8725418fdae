"""Several recordings, or several sensors, in one table: by a column that tells them apart, or by a time that begins anew."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from support.tables import write_csv

from imutool.converters import table
from imutool.converters._tables.recordings.several import LONGEST_LABEL
from imutool.errors import ConfigError, DataError

NAMES = [*(f"gyro_{a} (rad/s)" for a in "xyz"), *(f"acc_{a} (m/s^2)" for a in "xyz")]
COUNT, PARTS, RATE_HZ = 200, 3, 50.0
RNG = np.random.default_rng(5)
VALUES = np.round(RNG.normal([0.0, 0.0, 0.0, 0.0, 0.0, 9.81], 0.1, (PARTS * COUNT, 6)), 5)
PART = np.repeat(np.arange(1, PARTS + 1), COUNT)
T_S = np.tile(np.arange(COUNT) / RATE_HZ, PARTS)
PARTED = [f"all_part_{part}" for part in range(1, PARTS + 1)]
LETTERS = np.array(["A", "B", "C"])[PART - 1]
TURNS = np.arange(PARTS * COUNT).reshape(PARTS, COUNT).T.reshape(-1)  # rows of each part by turns


def csv(path: Path, columns: dict[str, np.ndarray], rows: np.ndarray | None = None) -> Path:
    values = [*columns.values(), *VALUES.T]
    return write_csv(path, [*columns, *NAMES], values if rows is None else [each[rows] for each in values])


def logs(path: Path, mapping: dict[str, float] | None = None) -> dict[str, np.ndarray]:
    """Gyros of the recordings of a table, by name."""
    read = (table.read_sequence(each, mapping=mapping) for each in table.sequences(path))
    return {log.name: log.imus["/imu0"].gyro for log in read}


def assert_parts(found: dict[str, np.ndarray], names: list[str]) -> None:
    assert [*found] == names
    for part, gyro in enumerate(found.values(), 1):
        np.testing.assert_array_equal(gyro, VALUES[part == PART, :3])


TIMED = {"time_s": T_S}


@pytest.mark.parametrize("beside", [{}, TIMED])
@pytest.mark.parametrize(
    ("column", "labels", "names"),
    [
        ("trial", PART, ["all_trial_1", "all_trial_2", "all_trial_3"]),
        ("Run No", PART, ["all_run_no_1", "all_run_no_2", "all_run_no_3"]),
        ("session", LETTERS, ["all_A", "all_B", "all_C"]),
    ],
)
def test_a_column_that_tells_recordings_apart_gives_a_log_for_each(tmp_path, column, labels, names, beside):
    path = csv(tmp_path / "all.csv", {column: labels, **beside})
    assert_parts(logs(path, {} if beside else {"rate_hz": RATE_HZ}), names)
    remarks = table.read_sequence(table.sequences(path)[0], mapping={} if beside else {"rate_hz": RATE_HZ}).remarks
    assert not remarks.losses  # the label is in the name


def test_labels_that_are_no_names_of_files_become_some(tmp_path):
    labels = np.array(["../../a", "x" * 300, "å b"])[PART - 1]
    assert_parts(
        logs(csv(tmp_path / "all.csv", {"trial": labels, **TIMED})), ["all_a", f"all_{'x' * LONGEST_LABEL}", "all_å_b"]
    )


def test_recordings_whose_rows_come_by_turns_are_told_apart(tmp_path):
    assert_parts(logs(csv(tmp_path / "all.csv", {"user": LETTERS, **TIMED}, TURNS)), ["all_A", "all_B", "all_C"])


def test_a_label_that_comes_again_is_another_recording(tmp_path):
    labels = np.array(["A", "B", "A"])[PART - 1]
    assert_parts(logs(csv(tmp_path / "all.csv", {"session": labels, **TIMED})), ["all_A", "all_B", "all_A 2"])


def test_parquet_holds_several_recordings_too(tmp_path):
    columns = {"subject": LETTERS.tolist(), "take": PART, **TIMED, **dict(zip(NAMES, VALUES.T, strict=True))}
    pyarrow.parquet.write_table(pyarrow.table(columns), tmp_path / "all.parquet")
    assert_parts(logs(tmp_path / "all.parquet"), ["all_take_1_A", "all_take_2_B", "all_take_3_C"])


def test_trials_of_one_time_are_one_recording(tmp_path):
    path = csv(tmp_path / "all.csv", {"trial": PART, "time_s": T_S + 10.0 * PART})
    (gyro,) = logs(path).values()
    np.testing.assert_array_equal(gyro, VALUES[:, :3])
    with pytest.raises(ConfigError, match="'trial' has 3 values") as refused:  # their gaps would be closed
        logs(path, {"rate_hz": RATE_HZ})
    assert "Leave `rate_hz` out" in str(refused.value.fix)


def test_a_counter_tells_no_recordings_apart(tmp_path):
    counts = np.arange(PARTS * COUNT)
    for labels in (counts // 10, counts // 5 % 64):
        found = table.sequences(csv(tmp_path / "all.csv", {"series": labels, **TIMED}))
        assert [each.name for each in found] == PARTED  # by the time


@pytest.mark.parametrize("rows", [None, TURNS])
@pytest.mark.parametrize(
    ("column", "labels", "topics"),
    [
        ("sensor", PART, ["/imu_1/imu", "/imu_2/imu", "/imu_3/imu"]),
        ("placement", np.array(["wrist", "hip", "ankle"])[PART - 1], ["/wrist/imu", "/hip/imu", "/ankle/imu"]),
    ],
)
def test_sensors_of_one_time_are_imus_of_one_log(tmp_path, column, labels, topics, rows):
    (found,) = table.sequences(csv(tmp_path / "all.csv", {column: labels, **TIMED}, rows))
    log = table.read_sequence(found)
    assert [*log.imus] == topics
    assert not log.remarks.losses
    for part, imu in enumerate(log.imus.values(), 1):
        np.testing.assert_array_equal(imu.gyro, VALUES[part == PART, :3])


def test_sensors_of_each_trial_are_imus_of_its_log(tmp_path):
    sensor = np.array(["left", "right"])[np.arange(PARTS * COUNT) % 2]
    path = csv(tmp_path / "all.csv", {"trial": PART, "sensor": sensor, **TIMED})
    read = [table.read_sequence(each) for each in table.sequences(path)]
    assert [[*log.imus] for log in read] == [["/left/imu", "/right/imu"]] * PARTS
    np.testing.assert_array_equal(read[1].imus["/right/imu"].gyro, VALUES[PART == 2][1::2, :3])


def test_a_trial_of_one_row_has_no_time_that_goes_on(tmp_path):
    trial = np.where(np.arange(PARTS * COUNT) == PARTS * COUNT - 1, 4, PART)
    sensor = np.array(["left", "right"])[np.arange(PARTS * COUNT) % 2]
    path = csv(tmp_path / "all.csv", {"trial": trial, "sensor": sensor, **TIMED})
    assert [each.name for each in table.sequences(path)] == ["all_trial_1", "all_trial_2", "all_trial_3", "all_trial_4"]


@pytest.mark.parametrize("beside", [{}, {"time_s": T_S + 10.0 * PART}])
def test_sensors_that_share_no_time_are_logs_of_their_own(tmp_path, beside):
    path = csv(tmp_path / "all.csv", {"sensor": PART, **beside})
    found = logs(path, {} if beside else {"rate_hz": RATE_HZ})
    assert_parts(found, ["all_sensor_1", "all_sensor_2", "all_sensor_3"])


def test_rows_are_not_counted_across_a_counter_that_begins_anew(tmp_path):
    path = csv(tmp_path / "all.csv", {"sample": np.tile(np.arange(COUNT), PARTS)})
    with pytest.raises(ConfigError, match="'sample' begins anew in row 201, as of 3 recordings"):
        logs(path, {"rate_hz": RATE_HZ})
    with pytest.raises(ConfigError, match="begins anew in row 201"):
        logs(path, {"rate_hz": RATE_HZ, "counter": "sample"})


@pytest.mark.parametrize("mapping", [{}, {"rate_hz": RATE_HZ}])
@pytest.mark.parametrize("header_again", [False, True])
def test_recordings_are_apart_where_the_time_begins_anew(tmp_path, header_again, mapping):
    path = csv(tmp_path / "all.csv", TIMED)
    if header_again:
        header, *rows = path.read_text().splitlines()
        path.write_text("\n".join(line for n, row in enumerate(rows) for line in ([header] if n % COUNT == 0 else []) + [row]))
    assert_parts(logs(path, mapping), PARTED)
    assert "'time_s' begins anew in row 201, 401: 3 recordings" in table.read_sequence(table.sequences(path)[0]).remarks.notes


@pytest.mark.parametrize("form", ["utf-16", "gz", "parquet"])
def test_the_time_of_a_packed_table_and_of_parquet_may_begin_anew(tmp_path, form):
    plain, path = csv(tmp_path / "plain.csv", TIMED), tmp_path / f"all.{'parquet' if form == 'parquet' else 'csv'}"
    if form == "parquet":
        pyarrow.parquet.write_table(pyarrow.table(TIMED | dict(zip(NAMES, VALUES.T, strict=True))), path)
    elif form == "gz":
        (path := tmp_path / "all.csv.gz").write_bytes(gzip.compress(plain.read_bytes()))
    else:
        path.write_text(plain.read_text(), encoding=form)
    assert_parts(logs(path), PARTED)


@pytest.mark.parametrize("start", [3, PARTS * COUNT - 3])
def test_a_time_that_is_set_back_beside_a_few_samples_begins_no_recording(tmp_path, start):
    t_s = np.arange(PARTS * COUNT) / RATE_HZ
    t_s[start:] -= t_s[start]
    assert len(table.sequences(csv(tmp_path / "all.csv", {"time_s": t_s}))) == 1


@pytest.mark.parametrize("size", [64, 100])
def test_a_counter_of_a_few_bits_or_digits_is_counted_through(tmp_path, size):
    (gyro,) = logs(csv(tmp_path / "all.csv", {"packet": np.arange(PARTS * COUNT) % size}), {"rate_hz": RATE_HZ}).values()
    np.testing.assert_array_equal(gyro, VALUES[:, :3])


def test_a_table_whose_columns_have_several_lengths_is_one_recording(tmp_path):
    """As of cells with arrays in them; the same table is read twice."""
    array, few = '"' + str([0.5] * 60) + '"', 50  # more numbers in a cell than rows
    rows = [f"{n // 25},{array},{n / 100}," + ",".join(map(str, VALUES[n])) for n in range(few)]
    (tmp_path / "all.csv").write_text(",".join(["id", "array", "time_s", *NAMES]) + "\n" + "\n".join(rows) + "\n")
    (found,) = table.sequences(tmp_path / "all.csv")
    for _ in range(2):
        log = table.read_sequence(found)
        np.testing.assert_array_equal(log.imus["/imu0"].gyro, VALUES[:few, :3])
        assert len(log.remarks.notes) == len(set(log.remarks.notes))


def test_a_damaged_table_is_refused_when_it_is_read(tmp_path):
    """The others of its folder are converted."""
    columns = {"trial": PART, **TIMED, **dict(zip(NAMES, VALUES.T, strict=True))}
    pyarrow.parquet.write_table(pyarrow.table(columns), path := tmp_path / "all.parquet")
    path.write_bytes(path.read_bytes()[:-100])
    (found,) = table.sequences(path)
    with pytest.raises(DataError, match="cannot be read"):
        table.read_sequence(found)
