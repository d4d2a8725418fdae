"""Tables without a time, which state a sampling rate, and quaternions and rates whose order and unit the motion shows."""

from __future__ import annotations

from datetime import datetime, timedelta
from decimal import Decimal
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from scipy.spatial.transform import Rotation
from support.tables import write_csv

from imutool.converters import sensor_tables, table
from imutool.converters._tables.text.numbers import plain_columns
from imutool.errors import ConfigError, DataError

RATE_HZ = 250.0
COUNT = 5000
T_S = np.arange(COUNT) / RATE_HZ
RNG = np.random.default_rng(11)
ANGLES = np.stack([0.8 * np.sin(2 * np.pi * f * T_S + k) for k, f in enumerate((0.35, 0.55, 0.2))], axis=1)
TURNED = Rotation.from_euler("ZYX", ANGLES)
Q_WXYZ = TURNED.as_quat()[:, [3, 0, 1, 2]]
GYRO = (TURNED[:-1].inv() * TURNED[1:]).as_rotvec() * RATE_HZ
GYRO = np.concatenate([GYRO, GYRO[-1:]]) + RNG.normal(0.0, 0.002, (COUNT, 3))
ACCEL = TURNED.inv().apply([0.0, 0.0, 9.81]) + RNG.normal(0.0, 0.02, (COUNT, 3))
P = 0.3 * np.sin(T_S)[:, None] * np.ones(3)
NEXT_NS = round(1e9 / RATE_HZ)


def read(path: Path, mapping: Path | None = None) -> Any:
    return table.read_sequence(table.sequences(path)[0], mapping=mapping)


@pytest.mark.parametrize(("unit", "size_s"), [("min", 60.0), ("minutes", 60.0), ("h", 3600.0), ("hours", 3600.0)])
def test_a_time_in_minutes_or_hours_is_no_time_in_seconds(tmp_path, unit, size_s):
    """A step of 1/15 ms would be plausible in seconds, too."""
    names = [f"time [{unit}]", *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
    path = write_csv(tmp_path / "log.csv", names, [T_S / size_s, *GYRO.T, *ACCEL.T])
    assert np.abs(read(path).imus["/imu0"].t_ns - NEXT_NS * np.arange(COUNT)).max() <= 1
    (tmp_path / "map.toml").write_text(
        f'time = "{names[0]}"\ntime_unit = "{unit[0] if size_s > 60 else "min"}"\n'
        f'gyro = {names[1:4]}\ngyro_unit = "rad/s"\naccel = {names[4:]}\naccel_unit = "m/s^2"\n'
    )
    assert np.abs(read(path, tmp_path / "map.toml").imus["/imu0"].t_ns - NEXT_NS * np.arange(COUNT)).max() <= 1


@pytest.mark.parametrize(
    ("unit", "size", "said"),
    [
        (" (rad/s)", 1.0, "gyro from"),
        (" (deg/s)", np.degrees(1.0), "the gyro is in deg/s, as its header says"),
        ("", np.degrees(1.0), "the gyro is in deg/s, as gravity turns"),
        (" (deg/s)", 1.0, "gravity turns in the accelerometer as a gyro in rad/s says"),
    ],
)
def test_the_gyro_of_a_phones_folder_is_in_the_unit_of_its_header_or_by_which_gravity_turns(tmp_path, unit, size, said):
    write_csv(tmp_path / "Gyroscope.csv", ["Time (s)", *(f"{a}{unit}" for a in "XYZ")], [T_S, *(GYRO.T * size)])
    write_csv(tmp_path / "Accelerometer.csv", ["Time (s)", *(f"{a} (m/s^2)" for a in "XYZ")], [T_S, *ACCEL.T])
    log = sensor_tables.read_sequence(sensor_tables.sequences(tmp_path)[0])
    assert said in " ".join(log.remarks.notes)
    right = GYRO if "gravity turns in" not in said else np.radians(GYRO)
    np.testing.assert_allclose(log.imus["/imu0"].gyro, right, rtol=1e-9)


def test_quotes_that_hold_a_delimiter_leave_the_row_to_the_reader_of_quotes():
    """Behind the first rows, in a row that lacks a field, too."""
    rows = [f'{t},"ok",{value}' for t, value in enumerate(GYRO[:300, 0].tolist())]
    assert plain_columns(lambda: [rows], ",") is not None
    assert plain_columns(lambda: [[*rows[:250], '250,"lost, again"', *rows[251:]]], ",") is None


@pytest.mark.parametrize(("back_s", "is_lost"), [(T_S[COUNT // 2], True), (2.0, False)])
def test_recordings_one_behind_another_are_a_loss_and_a_clock_that_was_set_a_little_a_note(tmp_path, back_s, is_lost):
    times = T_S.copy()
    times[COUNT // 2 if is_lost else -20 :] -= back_s
    names = ["time [s]", *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
    remarks = read(write_csv(tmp_path / "log.csv", names, [times, *GYRO.T, *ACCEL.T])).remarks
    assert any("the clock was set back" in note for note in remarks.notes)
    assert any("give each a table of its own" in loss for loss in remarks.losses) == is_lost


@pytest.mark.parametrize(
    ("start", "step"),
    [("0", "0.0040000000"), ("1700000000.123456789", "0.004"), ("1700000000123456789", "4000000"), ("7", "4")],
)
def test_a_table_of_plain_numbers_and_one_with_quotes_give_the_same(tmp_path, start, step):
    """The first is read by NumPy; nanoseconds since 1970 stay exact, and columns of whole numbers whole."""
    header = "time,gx (rad/s),gy (rad/s),gz (rad/s),ax (m/s^2),ay (m/s^2),az (m/s^2),count,pressure"
    times = [Decimal(start) + n * Decimal(step) for n in range(400)]
    columns = [GYRO[:400].T, ACCEL[:400].T]
    numbers = [",".join(f"{value:.9f}" for value in row) for row in np.concatenate(columns).T]
    rows = [f"{t},{row},{n},{101_325.25 + n}" for n, (t, row) in enumerate(zip(times, numbers, strict=True))]
    logs = []
    for quote in ("", '"'):
        path = tmp_path / f"log{len(logs)}.csv"
        path.write_text("\n".join([header, *(row.replace(f",{n},", f",{quote}{n}{quote},") for n, row in enumerate(rows))]))
        logs.append(read(path))
    plain, quoted = logs
    assert plain.imus == quoted.imus
    assert plain.scalars == quoted.scalars
    assert plain.remarks.notes == quoted.remarks.notes
    unit = {"7": 1_000_000, "1700000000123456789": 1}.get(start, 10**9)
    assert plain.imus["/imu0"].t_ns.tolist()[-1] == int(times[-1] * unit)


@pytest.mark.parametrize(("program", "start"), [("Excel", 25_569), ("MATLAB", 719_529)])
@pytest.mark.parametrize("name", ["time", "Date", "datetime [days]"])
def test_days_as_spreadsheets_count_them_are_utc(tmp_path, program, start, name):
    days = start + 20_000.25 + T_S / 86_400
    names = [name, *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
    log = read(write_csv(tmp_path / "log.csv", names, [days, *GYRO.T, *ACCEL.T]))
    expected = round(20_000.25 * 86_400e9) + NEXT_NS * np.arange(COUNT)
    assert np.abs(log.imus["/imu0"].t_ns - expected).max() < 12_000  # a double of MATLAB's days keeps 10 us
    assert f"{name!r} counts days as {program} does; it names no zone and counts as UTC" in log.remarks.notes
    since = read(write_csv(tmp_path / "since.csv", ["time [days]", *names[1:]], [T_S / 86_400, *GYRO.T, *ACCEL.T]))
    assert np.abs(since.imus["/imu0"].t_ns - NEXT_NS * np.arange(COUNT)).max() <= 1


@pytest.mark.parametrize("first", [100.0, 45_000.25, 738_000.5])
def test_seconds_of_the_size_of_days_are_seconds(tmp_path, first):
    names = ["time", *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
    log = read(write_csv(tmp_path / "log.csv", names, [first + T_S, *GYRO.T, *ACCEL.T]))
    assert np.abs(log.imus["/imu0"].t_ns - first * 1e9 - NEXT_NS * np.arange(COUNT)).max() < 1000


def test_gps_weeks_and_the_time_in_them_are_utc_across_the_end_of_a_week(tmp_path):
    names = ["GPS Week", "TOW (s)", *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
    since_ms = (2394 * 604_800 + 604_800 - 10) * 1000 + 4 * np.arange(COUNT)
    week, ms = np.divmod(since_ms, 604_800_000)
    log = read(write_csv(tmp_path / "log.csv", names, [week, ms / 1000, *GYRO.T, *ACCEL.T]))
    t_ns = log.imus["/imu0"].t_ns
    assert np.array_equal(np.diff(t_ns), np.full(COUNT - 1, NEXT_NS))
    assert np.datetime64(int(t_ns[0]), "ns") == np.datetime64("2025-11-29T23:59:32")  # 18 leap seconds before that of GPS


@pytest.mark.parametrize(
    ("date", "clock"), [("29.11.2025", "%H:%M:%S,%f"), ("2025-11-29", "%H:%M:%S.%f"), ("11/29/2025", "%I:%M:%S.%f %p")]
)
def test_a_date_and_a_clock_in_two_columns_are_one_time(tmp_path, date, clock):
    start = datetime(2025, 11, 29, 23, 59, 50)
    dated = {"29.11.2025": "%d.%m.%Y", "2025-11-29": "%Y-%m-%d", "11/29/2025": "%m/%d/%Y"}[date]
    times = [start + timedelta(milliseconds=4 * n) for n in range(COUNT)]
    lines = ["Date;Time;wx [rad/s];wy [rad/s];wz [rad/s];ax [m/s^2];ay [m/s^2];az [m/s^2]"]
    for t, row in zip(times, np.column_stack([GYRO, ACCEL]).tolist(), strict=True):
        lines.append(";".join([t.strftime(dated), t.strftime(clock), *map(repr, row)]))
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    t_ns = read(tmp_path / "log.csv").imus["/imu0"].t_ns
    assert np.array_equal(t_ns, np.datetime64(start, "ns").astype(np.int64) + NEXT_NS * np.arange(COUNT))


def test_rows_that_hold_one_sensor_each_are_one_imu_whose_unit_the_motion_shows(tmp_path):
    lines = ["timestamp_ns,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z"]
    for n, (gyro, accel) in enumerate(zip(GYRO.tolist(), ACCEL.tolist(), strict=True)):
        lines.append(f"{NEXT_NS * n},{','.join(map(repr, gyro))},,,")
        lines += [f"{NEXT_NS * n + 700_000},,,,{','.join(map(repr, accel))}"] if n % 2 == 0 else []
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    imu = read(tmp_path / "log.csv").imus["/imu0"]
    assert np.array_equal(imu.t_ns, NEXT_NS * np.arange(1, COUNT - 1))
    np.testing.assert_array_equal(imu.gyro, GYRO[1:-1])


def test_decimal_commas_in_quotes_are_read_and_what_is_no_number_is_said(tmp_path):
    names = ["time [s]", *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
    rows = [",".join(f'"{value:.6f}"'.replace(".", ",") for value in row) for row in np.column_stack([T_S, GYRO, ACCEL])]
    (tmp_path / "log.csv").write_text("\n".join([",".join(names), *rows]) + "\n")
    np.testing.assert_allclose(read(tmp_path / "log.csv").imus["/imu0"].gyro, GYRO, atol=1e-6)
    lines = [
        ",".join([*names, "n"]),
        *(",".join([*[f'"{n},{100 + k}"' for k in range(7)], "a b"[:: n % 2 + 1]]) for n in range(1, 99)),
    ]
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")  # thousands, or decimals
    with pytest.raises(
        DataError, match=r"no columns of numbers; time \[s\] is left out: its fields, as '1,100', are no numbers"
    ):
        read(tmp_path / "log.csv")


@pytest.mark.parametrize("stated", ["fs", "sampling_rate", "dt", "sample_period_ms", "Fs_imu", "gyro_rate_hz"])
def test_a_mat_file_with_a_sampling_rate_has_times(tmp_path, stated):
    number = {"dt": 1.0 / RATE_HZ, "sample_period_ms": 1e3 / RATE_HZ}.get(stated, RATE_HZ)
    scipy.io.savemat(tmp_path / "trial.mat", {"imu_gyr": GYRO, "imu_acc": ACCEL, stated: number})
    log = read(tmp_path / "trial.mat")
    imu = log.imus["/imu0"]
    assert np.array_equal(imu.t_ns, NEXT_NS * np.arange(COUNT))
    np.testing.assert_allclose(imu.gyro, GYRO)
    assert any(f"at the '{stated}' of 250 Hz that the file states" in note for note in log.remarks.notes)


def test_the_rate_may_be_an_attribute_of_an_hdf5_file(tmp_path):
    with h5py.File(tmp_path / "trial.h5", "w") as file:
        file["imu_gyr"], file["imu_acc"] = GYRO, ACCEL
        file.attrs["sampling_rate"] = RATE_HZ
    assert np.array_equal(read(tmp_path / "trial.h5").imus["/imu0"].t_ns, NEXT_NS * np.arange(COUNT))


def test_a_rate_in_a_group_is_that_of_its_own_sensor(tmp_path):
    with h5py.File(tmp_path / "trial.h5", "w") as file:
        file["imu/gyr"], file["imu/acc"], file["camera/exposure"] = GYRO, ACCEL, np.ones(90)
        file["camera"].attrs["fs"] = 30.0
    with pytest.raises(ConfigError, match="no number in the file is named as a sampling rate"):
        read(tmp_path / "trial.h5")
    with h5py.File(tmp_path / "trial.h5", "a") as file:
        file["imu/gyr"].attrs["fs"] = RATE_HZ
    assert np.array_equal(read(tmp_path / "trial.h5").imus["/imu0"].t_ns, NEXT_NS * np.arange(COUNT))


def test_a_rate_is_kept_where_the_gyro_is_not_recognised(tmp_path):
    scipy.io.savemat(tmp_path / "trial.mat", {"turning": GYRO, "imu_acc": ACCEL, "fs": RATE_HZ})
    with pytest.raises(ConfigError, match="no columns look like the gyro") as refused:
        read(tmp_path / "trial.mat")
    assert "rate_hz = 250.0" in refused.value.fix


@pytest.mark.parametrize(
    "above",
    ["// Start Time: Unknown\n// Update Rate: 250.0Hz\n", "# Config: data_rate = 250.0 Hz, filter = 488 Hz, range = 4 g\n"],
)
def test_a_counter_that_begins_again_tells_missing_samples_at_the_rate_above_the_table(tmp_path, above):
    names = ["PacketCounter", *(f"Acc_{a}" for a in "XYZ"), *(f"Gyr_{a} [rad/s]" for a in "XYZ")]
    received = np.delete(np.arange(COUNT), slice(2000, 2010))
    columns = [(65_000 + received) % 65_536, *ACCEL[received].T, *GYRO[received].T]
    log = read(write_csv(tmp_path / "mtw.txt", names, columns, above=above))
    assert np.array_equal(log.imus["/imu0"].t_ns, NEXT_NS * received)
    assert log.scalars == {}


def test_a_counter_is_no_time_and_the_map_that_is_proposed_asks_for_the_rate(tmp_path):
    names = ["sample", *(f"acc_{a}" for a in "xyz"), *(f"gyr_{a} [rad/s]" for a in "xyz")]
    path = write_csv(tmp_path / "count.csv", names, [np.arange(COUNT), *ACCEL.T, *GYRO.T])
    with pytest.raises(ConfigError, match="'sample' counts the samples, and no number in the file is named") as refused:
        read(path)
    proposed = refused.value.fix.split("\n\n", 1)[1]
    assert 'rate_hz = "?"' in proposed
    (tmp_path / "map.toml").write_text(proposed.replace('rate_hz = "?"', "rate_hz = 250"))
    assert np.array_equal(read(path, tmp_path / "map.toml").imus["/imu0"].t_ns, NEXT_NS * np.arange(COUNT))


def test_a_counter_of_all_packets_is_no_clock_of_the_samples(tmp_path):
    """An x-IMU numbers the packets of all sensors: by its numbers 60 s of samples would be 50 s."""
    names = ["Packet number", *(f"acc_{a}" for a in "xyz"), *(f"gyr_{a} [rad/s]" for a in "xyz")]
    counts = np.cumsum(np.where(np.arange(COUNT) % 3, 2, 1))
    path = write_csv(tmp_path / "count.csv", names, [counts, *ACCEL.T, *GYRO.T])
    with pytest.raises(ConfigError, match="'Packet number' counts more than the samples") as refused:
        read(path)
    proposed = refused.value.fix.split("\n\n", 1)[1].replace('rate_hz = "?"', "rate_hz = 250")
    (tmp_path / "map.toml").write_text(proposed)
    assert np.array_equal(read(path, tmp_path / "map.toml").imus["/imu0"].t_ns, NEXT_NS * np.arange(COUNT))
    (tmp_path / "map.toml").write_text(f'counter = "Packet number"\n{proposed}')
    with pytest.raises(ConfigError, match="counts more than the samples"):
        read(path, tmp_path / "map.toml")


def test_a_counter_that_often_skips_is_asked_about(tmp_path):
    names = ["PacketCounter", *(f"acc_{a}" for a in "xyz"), *(f"gyr_{a} [rad/s]" for a in "xyz")]
    counts = np.cumsum(np.where(np.arange(COUNT) % 4, 1, 2))
    path = write_csv(tmp_path / "log.txt", names, [counts, *ACCEL.T, *GYRO.T], above="// Update Rate: 250.0Hz\n")
    with pytest.raises(ConfigError, match="25 % of its steps are 2 in 'PacketCounter': are samples missing") as refused:
        read(path)
    assert 'counter = "PacketCounter"  # please confirm: this column?' in refused.value.fix


def test_row_numbers_beside_a_count_of_samples_are_no_time(tmp_path):
    names = ["", "index", *(f"acc_{a}" for a in "xyz"), *(f"gyr_{a} [rad/s]" for a in "xyz")]
    path = write_csv(tmp_path / "pandas.csv", names, [np.arange(COUNT), 23_000 + np.arange(COUNT), *ACCEL.T, *GYRO.T])
    with pytest.raises(ConfigError, match="'index' counts the samples") as refused:
        read(path)
    assert 'rate_hz = "?"' in refused.value.fix


def test_a_clock_behind_other_columns_is_the_time(tmp_path):
    clock = [f"16:24:{4 + n // 250:02d}.{n % 250 * 4:03d}" for n in range(1000)]
    rows = [
        f"@ LOG {7} {t} {' '.join(map(repr, row))}"
        for t, row in zip(clock, np.hstack([GYRO, ACCEL])[:1000].tolist(), strict=True)
    ]
    (tmp_path / "raven.txt").write_text("\n".join(rows) + "\n")
    with pytest.raises(ConfigError, match="'column 4' alone rises in a unit of time: it counts as the time") as refused:
        read(tmp_path / "raven.txt")
    assert 'time = "column 4"\ntime_unit = "ns"\n' in refused.value.fix


def test_recordings_in_one_structure_become_logs_with_their_own_times(tmp_path):
    """Also those with as many samples, and the columns next to an IMU."""
    trial = {"t": T_S, "acc": ACCEL, "gyr": GYRO, "mag": ACCEL}
    for later, rows in ((500.0, COUNT), (90.0, COUNT - 700)):
        second = {name: values[:rows] + (later if name == "t" else 0.0) for name, values in trial.items()}
        scipy.io.savemat(tmp_path / "two.mat", {"data": {"first": trial, "second": second}})
        logs = {each.name: table.read_sequence(each) for each in table.sequences(tmp_path / "two.mat")}
        assert [*logs] == ["two_first", "two_second"]
        for log, start in zip(logs.values(), (0.0, later), strict=True):
            assert log.imus["/imu0"].t_ns[0] == log.scalars["/mag_0"].t_ns[0] == start * 1e9
        assert len(log.imus["/imu0"]) == rows


def test_one_map_holds_for_all_recordings_of_a_structure(tmp_path):
    rest = {"acc": np.tile([0.0, 0.0, 9.81], (COUNT, 1)) + RNG.normal(0.0, 0.02, (COUNT, 3)), "gyr": GYRO * 1e-3}
    two = {"first": {"t": T_S, **rest}, "second": {"t": T_S[:-9] + 40.0, **{k: v[:-9] for k, v in rest.items()}}}
    scipy.io.savemat(tmp_path / "two.mat", {"data": two})
    with pytest.raises(ConfigError, match="no unit of the gyro") as refused:
        table.read_sequence(table.sequences(tmp_path / "two.mat")[0])
    proposed = refused.value.fix.split("\n\n", 1)[1]
    (tmp_path / "map.toml").write_text(proposed.replace('gyro_unit = "?"', 'gyro_unit = "deg/s"'))
    found = table.sequences(tmp_path / "two.mat")
    first, second = (table.read_sequence(each, mapping=tmp_path / "map.toml").imus["/imu0"] for each in found)
    assert second.t_ns[0] == 40 * 10**9
    assert [len(first), len(second)] == [COUNT, COUNT - 9]


def test_a_table_without_any_time_is_read_by_a_map_with_a_rate(tmp_path):
    names = [*(f"acc_{a}" for a in "xyz"), *(f"gyr_{a} [rad/s]" for a in "xyz")]
    path = write_csv(tmp_path / "bare.csv", names, [*ACCEL.T, *GYRO.T])
    with pytest.raises(ConfigError, match="no column that rises looks like a time") as refused:
        read(path)
    assert "# without a column of times: rate_hz = SAMPLES_A_SECOND" in refused.value.fix
    entries = refused.value.fix.split("\n\n", 1)[1].splitlines()
    kept = [line for line in entries if not line.startswith("time")]
    (tmp_path / "map.toml").write_text("\n".join([*kept, "rate_hz = 250"]))
    assert np.array_equal(read(path, tmp_path / "map.toml").imus["/imu0"].t_ns, NEXT_NS * np.arange(COUNT))


@pytest.mark.parametrize("every", [1, 3, 0])
def test_a_rate_alone_keeps_the_gaps_that_a_counter_shows(tmp_path, every):
    """The message that asks for the rate proposes the counter, and `--map rate_hz=250` does not undo that.

    Numbers that jump by one and two count no samples.
    """
    names = ["n_samples", *(f"acc_{a}" for a in "xyz"), *(f"gyr_{a} [rad/s]" for a in "xyz")]
    rows = np.delete(np.arange(COUNT), [70, 71, 72]) if every else np.arange(COUNT)
    counter = every * np.arange(COUNT) if every else np.cumsum(1 + np.arange(COUNT) % 2)
    path = write_csv(tmp_path / "counted.csv", names, [counter[rows], *ACCEL[rows].T, *GYRO[rows].T])
    log = read(path, {"rate_hz": 250.0})
    assert np.array_equal(log.imus["/imu0"].t_ns, NEXT_NS * rows)
    assert ("'n_samples' counts the samples: rate_hz is that of its steps" in log.remarks.notes) == bool(every)


@pytest.mark.parametrize("wrong", ["rate_hz = -5\n", 'rate_hz = 100\ntime = "t"\ntime_unit = "s"\n'])
def test_a_map_has_a_time_or_a_positive_rate(tmp_path, wrong):
    names = ["t", *(f"acc_{a}" for a in "xyz"), *(f"gyr_{a}" for a in "xyz")]
    path = write_csv(tmp_path / "bare.csv", names, [T_S, *ACCEL.T, *GYRO.T])
    columns = (
        'gyro = ["gyr_x", "gyr_y", "gyr_z"]\ngyro_unit = "rad/s"\naccel = ["acc_x", "acc_y", "acc_z"]\naccel_unit = "m/s^2"\n'
    )
    (tmp_path / "map.toml").write_text(wrong + columns)
    with pytest.raises(ConfigError, match="has to name a time or a positive rate_hz"):
        read(path, tmp_path / "map.toml")


@pytest.mark.parametrize("others", [{"fs": RATE_HZ, "accel_fs": 30.0}, {"baud_rate": 9600}, {"frame_rate": 30.0}])
def test_rates_that_differ_or_are_of_something_else_are_not_believed(tmp_path, others):
    scipy.io.savemat(tmp_path / "trial.mat", {"imu_gyr": GYRO, "imu_acc": ACCEL} | others)
    with pytest.raises(ConfigError, match="no number in the file is named as a sampling rate"):
        read(tmp_path / "trial.mat")


@pytest.mark.parametrize("order", ["wxyz", "xyzw"])
@pytest.mark.parametrize("unit", ["rad/s", "deg/s"])
def test_quaternions_of_no_stated_order_are_poses_where_they_turn_as_the_gyro_does(tmp_path, order, unit):
    mount = Rotation.from_rotvec([0.5, -1.0, 0.3])
    gyro, accel = mount.apply(GYRO), mount.apply(ACCEL) + 3.0 * np.sin(5.0 * T_S)[:, None]  # gravity does not show the unit
    arrays = {"gyr": gyro if unit == "rad/s" else np.rad2deg(gyro), "acc": accel, "fs": RATE_HZ, "opt_pos": P}
    scipy.io.savemat(tmp_path / "trial.mat", arrays | {"opt_quat": Q_WXYZ if order == "wxyz" else Q_WXYZ[:, [1, 2, 3, 0]]})
    log = read(tmp_path / "trial.mat")
    assert f"the poses turn as far as a gyro in {unit} says" in log.remarks.notes
    poses = log.poses["/ground_truth/pose"]
    np.testing.assert_allclose(poses.q_wb_wxyz, Q_WXYZ, atol=1e-12)
    assert np.array_equal(poses.p_wb, P)
    np.testing.assert_allclose(log.imus["/imu0"].gyro, gyro)


@pytest.mark.parametrize("name", ["quat_vicon", "q_gt", "qViconReference"])
def test_an_array_with_a_word_for_the_truth_behind_its_name_is_the_truth(tmp_path, name):
    scipy.io.savemat(tmp_path / "trial.mat", {"t": T_S, "gyr": GYRO, "acc": ACCEL, name: Q_WXYZ})
    log = read(tmp_path / "trial.mat")
    assert log.kinds == {"/ground_truth/pose": "truth"}
    np.testing.assert_allclose(log.poses["/ground_truth/pose"].q_wb_wxyz, Q_WXYZ, atol=1e-12)


def test_quaternions_that_turn_otherwise_stay_numbers(tmp_path):
    angles = np.stack([0.8 * np.sin(2 * np.pi * f * T_S + k) for k, f in enumerate((0.9, 0.27, 0.71))], axis=1)
    other = Rotation.from_euler("ZYX", angles).as_quat()
    arrays = {"gyr": GYRO, "acc": ACCEL, "fs": RATE_HZ, "opt_pos": P, "opt_quat": other}
    scipy.io.savemat(tmp_path / "trial.mat", arrays)
    log = read(tmp_path / "trial.mat")
    assert log.poses == {}
    assert "/opt_quat_3" in log.scalars


@pytest.mark.parametrize(("unit", "size"), [("rad/s", 1.0), ("deg/s", 180.0 / np.pi)])
@pytest.mark.parametrize("names", [[f"Quat_{a}" for a in "wxyz"], [f"q{n}" for n in range(4)]])
def test_the_orientation_beside_the_rates_shows_their_unit(tmp_path, unit, size, names):
    """Of a body that walks, gravity does not show it."""
    header = ["time [s]", *(f"Acc_{a} [m/s^2]" for a in "XYZ"), *(f"Gyr_{a}" for a in "XYZ"), *names]
    walking = np.array([0.0, 0.0, 9.81]) + RNG.normal(0.0, 3.0, (COUNT, 3))
    log = read(write_csv(tmp_path / "xsens.csv", header, [T_S, *walking.T, *(size * GYRO).T, *Q_WXYZ.T]))
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO, atol=1e-12)
    assert f"the orientations turn as far as a gyro in {unit} says" in log.remarks.notes
    assert log.poses == {}


@pytest.mark.parametrize(("unit", "size"), [("rad/s", 1.0), ("deg/s", 180.0 / np.pi)])
def test_poses_that_jump_at_times_still_show_the_unit(tmp_path, unit, size):
    """A motion capture that exchanges markers turns by itself in a tenth of its steps."""
    jumps = Rotation.from_rotvec(np.where(RNG.random(COUNT)[:, None] < 0.004, RNG.normal(0.0, 0.25, (COUNT, 3)), 0.0))
    q = (TURNED * jumps * Rotation.from_rotvec(RNG.normal(0.0, 0.02, (COUNT, 3)))).as_quat()[:, [3, 0, 1, 2]]
    names = [
        "time [s]",
        *(f"Acc_{a} [m/s^2]" for a in "XYZ"),
        *(f"Gyr_{a}" for a in "XYZ"),
        *(f"vicon_orientation_{a}" for a in "wxyz"),
    ]
    walking = np.array([0.0, 0.0, 9.81]) + RNG.normal(0.0, 3.0, (COUNT, 3))
    log = read(write_csv(tmp_path / "wand.csv", names, [T_S, *walking.T, *(size * GYRO).T, *q.T]))
    assert f"the poses turn as far as a gyro in {unit} says" in log.remarks.notes


@pytest.mark.parametrize(("unit", "size"), [("m/s^2", 1.0), ("g", 1.0 / 9.80665)])
@pytest.mark.parametrize("gyro_unit", [" [rad/s]", ""])
def test_the_accelerometer_of_a_body_that_swings_shows_its_unit_by_its_steady_part(tmp_path, unit, size, gyro_unit):
    """Its median length is far from gravity, and its directions cancel out."""
    angle = 6.0 * T_S
    turned = Rotation.from_rotvec(angle[:, None] * [1.0, 0.0, 0.0])
    gyro = np.tile([6.0, 0.0, 0.0], (COUNT, 1)) + RNG.normal(0.0, 0.002, (COUNT, 3))
    push = 9.0 * np.stack([np.zeros(COUNT), np.cos(1.3 * angle), np.sin(1.3 * angle)], axis=1)
    accel = turned.inv().apply(push + np.array([0.0, 0.0, 9.81])) + RNG.normal(0.0, 0.02, (COUNT, 3))
    names = ["time [s]", *(f"acc_{a}" for a in "xyz"), *(f"gyr_{a}{gyro_unit}" for a in "xyz")]
    log = read(write_csv(tmp_path / "wand.csv", names, [T_S, *(size * accel).T, *gyro.T]))
    np.testing.assert_allclose(log.imus["/imu0"].accel, accel, rtol=1e-9)
    assert any(note.endswith(f"gravity in {unit}") and "steady part" in note for note in log.remarks.notes)


EPOCH_NS = 1_700_000_000_123_456_789  # no float64 holds it exactly


@pytest.mark.parametrize("stamp", ["seconds", "two columns"])
def test_a_table_of_several_sensors_with_a_time_each_keeps_every_row(tmp_path, stamp):
    """As pandas writes an outer join: a row holds one sensor, and the columns of the others are blank."""
    imu = [f"angular_velocity_{a}" for a in "xyz"] + [f"linear_acceleration_{a}" for a in "xyz"]
    poses = [*(f"p{a}" for a in "xyz"), *(f"q{a}" for a in "wxyz")]
    names = {"imu": imu, "gps": ["lat", "lon"], "vicon": poses}
    values = {"imu": np.hstack([GYRO, ACCEL]), "gps": P[:, :2], "vicon": np.hstack([P, Q_WXYZ])}
    stamps = {of: EPOCH_NS + NEXT_NS * np.arange(0, COUNT, step) for of, step in (("imu", 1), ("gps", 50), ("vicon", 4))}
    header, rows = ["row"], []
    for of, columns in names.items():
        header += ([f"time_{of}"] if stamp == "seconds" else [f"sec_{of}", f"nanosec_{of}"]) + columns
    for of, step in (("imu", 1), ("gps", 50), ("vicon", 4)):
        for t, row in zip(stamps[of].tolist(), values[of][::step].tolist(), strict=True):
            at = f"{t // 10**9}.{t % 10**9:09}" if stamp == "seconds" else f"{t // 10**9}.0,{t % 10**9}.0"
            blank = {o: "," * (len(names[o]) + (stamp != "seconds")) for o in names}
            rows.append((t, ",".join(blank[o] if o != of else ",".join([at, *map(repr, row)]) for o in names)))
    text = "".join(f"{number},{row}\n" for number, (_, row) in enumerate(sorted(rows)))
    (tmp_path / "all.csv").write_text(",".join(header) + "\n" + text)
    log = read(tmp_path / "all.csv")
    assert np.array_equal(log.imus["/imu0"].t_ns, stamps["imu"])
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO)
    assert np.array_equal(log.scalars["/gps_lat"].t_ns, stamps["gps"])
    assert log.kinds == {"/ground_truth/pose": "truth"}
    assert np.array_equal(log.poses["/ground_truth/pose"].t_ns, stamps["vicon"])
    assert log.remarks.losses == []


def test_an_imu_that_the_rows_of_faster_samples_repeat_has_its_own_times_once(tmp_path):
    """As `pandas.merge_asof` joins an EMG and an IMU: all samples of the IMU were said to be those of the EMG's rows."""
    rows_s = T_S[0] + 0.4 * (T_S[1] - T_S[0]) * np.arange(2 * COUNT)
    of = np.searchsorted(T_S, rows_s, "right") - 1
    names = ["t", "emg", "imu_t", *(f"imu_gyro_{a} [rad/s]" for a in "xyz"), *(f"imu_acc_{a} [m/s^2]" for a in "xyz")]
    log = read(write_csv(tmp_path / "log.csv", names, [rows_s, rows_s**2, T_S[of], *GYRO[of].T, *ACCEL[of].T]))
    imu = log.imus["/imu0"]
    np.testing.assert_allclose(imu.t_ns * 1e-9, T_S[: len(imu.t_ns)])
    np.testing.assert_allclose(imu.gyro, GYRO[: of[-1] + 1])
    np.testing.assert_allclose(log.scalars["/t_emg"].t_ns * 1e-9, rows_s)


@pytest.mark.parametrize("form", ["rows", "arrays"])
@pytest.mark.parametrize("named", [("t_gyro", "t_acc"), ("timeGyro", "timeAcc"), ("gyro_time", "acc_time")])
def test_times_named_for_their_sensors_are_theirs(tmp_path, named, form):
    """The accelerometer had those of the gyro in rows, and arrays of other lengths were refused."""
    accel_s = (T_S + 0.0013)[:: 1 if form == "rows" else 2]
    if form == "rows":
        names = [named[0], *(f"gyro_{a} [rad/s]" for a in "xyz"), named[1], *(f"acc_{a} [m/s^2]" for a in "xyz")]
        path = write_csv(tmp_path / "log.csv", names, [T_S, *GYRO.T, accel_s, *ACCEL.T])
    else:
        path = tmp_path / "log.mat"
        scipy.io.savemat(path, {named[0]: T_S, "gyro_rad_s": GYRO, named[1]: accel_s, "acc": ACCEL[::2]})
    assert read(path).metadata["imutool/map"]["time"] == named[0]
    assert read(path).metadata["imutool/map"]["accel_time"] == named[1]


def test_a_gyro_that_skips_rows_keeps_its_own_times(tmp_path):
    """As SensorLog of iOS writes it: the program's uneven times took their place."""
    own = T_S + 0.002
    logged = T_S + 0.1 + 0.01 * np.sin(np.arange(COUNT))
    gyro, skipped = np.concatenate([own[:, None], GYRO], axis=1), np.arange(COUNT) % 7 < 2
    gyro[skipped] = np.nan
    names = ["loggingTime [s]", "accelerometerTimestamp_sinceReboot", *(f"accelerometerAcceleration{a} [m/s^2]" for a in "XYZ")]
    names += ["gyroTimestamp_sinceReboot", *(f"gyroRotation{a}" for a in "XYZ")]
    log = read(write_csv(tmp_path / "phone.csv", names, [logged, T_S, *ACCEL.T, *gyro.T]))
    np.testing.assert_allclose(log.imus["/imu0"].t_ns * 1e-9, own[~skipped & (own <= T_S[-1])], atol=1e-6)


def test_a_time_that_stands_in_some_rows_of_an_imu_loses_none_of_them(tmp_path):
    """The rows of the IMU have no time; those of the receiver in between have one."""
    names = ["time_gps", *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
    rows = [f"{n if n % 5 == 0 else ''},{','.join(map(repr, row))}" for n, row in enumerate(np.hstack([GYRO, ACCEL]).tolist())]
    (tmp_path / "log.csv").write_text("\n".join([",".join(names), *rows]) + "\n")
    with pytest.raises(ConfigError, match="no column that rises looks like a time"):
        read(tmp_path / "log.csv")


@pytest.mark.parametrize("start_s", [2.0, 1000.0, 1.6e9])
def test_a_structure_of_as_many_rows_as_the_imus_has_its_own_time(tmp_path, start_s):
    """Also one on a clock apart from the IMU's, which is said."""
    own_s = np.linspace(start_s, start_s + 15.0, COUNT)
    gps = {"t": own_s, "lat": 52.0 + 1e-4 * T_S}
    scipy.io.savemat(tmp_path / "log.mat", {"t": T_S, "gyro_rad_s": GYRO, "accel": ACCEL, "gps": gps})
    log = read(tmp_path / "log.mat")
    np.testing.assert_allclose(log.scalars["/gps_lat"].t_ns * 1e-9, own_s)
    is_apart = "gps.t (in s) stays apart from the IMU's clock: gps.lat" in log.remarks.notes
    assert is_apart == (start_s > 2.0)
    assert log.remarks.losses == []
    names = ["t", *(f"gyro.{a} [rad/s]" for a in "xyz"), *(f"accel.{a}" for a in "xyz"), "gps.t", "gps.lat"]
    rows = read(write_csv(tmp_path / "log.csv", names, [T_S, *GYRO.T, *ACCEL.T, *gps.values()]))
    assert np.array_equal(rows.scalars["/gps_lat"].t_ns, rows.imus["/imu0"].t_ns)  # of a row of text all columns are


@pytest.mark.parametrize("damaged", ["34:22.9", "", "2026-03-01 12:3x:20"])
@pytest.mark.parametrize("form", ["%Y-%m-%d %H:%M:%S.%f", "%H:%M:%S.%f"])
@pytest.mark.parametrize("row", [0, 100])
def test_the_damaged_field_of_a_column_of_times_is_named(tmp_path, form, damaged, row):
    texts = [(datetime(2026, 3, 1, 12) + timedelta(seconds=t)).strftime(form) for t in T_S[:200].tolist()]
    texts[row] = damaged if form.startswith("%Y") or damaged != "34:22.9" else "Excel"
    lines = [
        ",".join([text, *map(repr, values)]) for text, values in zip(texts, np.hstack([GYRO, ACCEL]).tolist(), strict=False)
    ]
    (tmp_path / "log.csv").write_text("\n".join(["time,gx,gy,gz,ax,ay,az", *lines]) + "\n")
    with pytest.raises(ConfigError, match=rf"time is left out: 1 of its fields are no .* in row {row + 1}: {texts[row]!r}"):
        read(tmp_path / "log.csv")


@pytest.mark.parametrize(
    "names",
    [("system_time_ms", "sensor_timestamp_ns"), ("timestamp", "event_timestamp"), ("host_time_ms", "my_device_time_ns")],
)
def test_a_sensors_own_time_counts_and_not_the_uneven_one_of_the_program(tmp_path, names):
    program = 1_700_000_000_000 + np.rint(1e3 * T_S).astype(int) + np.abs(np.rint(RNG.normal(0.0, 1.5, COUNT))).astype(int)
    own = 50_000_000_000_000 + NEXT_NS * np.arange(COUNT)
    axes = [*(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
    log = read(write_csv(tmp_path / "phone.csv", [*names, *axes], [program, own, *GYRO.T, *ACCEL.T]))
    assert np.array_equal(log.imus["/imu0"].t_ns, own)
    assert any(f"{names[1]!r} is the sensor's own time and steadier" in note for note in log.remarks.notes)


@pytest.mark.parametrize(("name", "per_s"), [("time_usec", 1e6), ("HIGHRES_IMU.time_usec", 1e6), ("time_boot_ms", 1e3)])
def test_the_device_s_time_counts_in_what_mavlogdump_writes_and_not_that_of_the_receiver(tmp_path, name, per_s):
    """The stamps of the receiver jitter by the link's delay."""
    arrived = 1_700_000_000.0 + T_S + np.abs(RNG.normal(0.0, 0.0015, COUNT))
    axes = [*(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
    own = np.rint((50.0 + T_S) * per_s).astype(int)
    log = read(write_csv(tmp_path / "imu.csv", ["timestamp", name, *axes], [arrived, own, *GYRO.T, *ACCEL.T]))
    assert np.array_equal(log.imus["/imu0"].t_ns, own * round(1e9 / per_s))


def test_poses_show_no_unit_of_counts_with_a_zero_of_their_own(tmp_path):
    """The gyro of a converter from 0 to 1023, whose count is 0.95 deg/s, was said to be in deg/s."""
    counts = [np.rint(370.0 + values).astype(int) for values in (np.rad2deg(GYRO / 0.95).T, 100.0 * ACCEL.T / 9.81 + 140.0)]
    scipy.io.savemat(tmp_path / "trial.mat", {"t": T_S, "gyr": counts[0].T, "acc": counts[1].T, "q_gt": Q_WXYZ})
    with pytest.raises(ConfigError, match=r'gyro_unit = "\?"'):
        read(tmp_path / "trial.mat")


def test_a_time_in_the_last_column_is_one_by_its_century(tmp_path):
    path = write_csv(
        tmp_path / "imu.txt", ["1"] * 9, [GYRO[:, 0] * 0.0, GYRO[:, 0] * 0.0, *GYRO.T, *ACCEL.T, 1_700_000_000.0 + T_S]
    )
    path.write_text(path.read_text().split("\n", 1)[1])
    with pytest.raises(ConfigError, match="'column 9' alone rises as a time since 1970 does: it counts as the time"):
        read(path)


def test_texts_of_large_numbers_are_kept_for_what_may_be_a_time_alone():
    """Texts of every column took most of the time and memory of wide tables."""
    t = [f"17000000{row // 10}.{row % 10}00000001" for row in range(100, 400)]
    forces = np.random.default_rng(3).normal(0.0, 1e5, 300)
    columns = plain_columns(lambda: [[f"{a},{b:.4f}" for a, b in zip(t, forces, strict=True)]], ",")
    assert columns is not None
    assert [[*texts] for texts in columns[1]] == [t, []]
