"""Spreadsheets are tables: a sheet each, formulas' values, dates as stamps; too many cells are refused before they are read."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.spreadsheet import Date, Fault, Formula, write_xlsx

from imutool.converters import table
from imutool.errors import ConfigError, DataError
from imutool.recording import Imu
from imutool.sensor.made_up_flight import flight

HEADER = ["Time (s)", "Gyro X (deg/s)", "Gyro Y (deg/s)", "Gyro Z (deg/s)", "Acc X (g)", "Acc Y (g)", "Acc Z (g)"]
SI = ["Time", "gx [rad/s]", "gy [rad/s]", "gz [rad/s]", "ax [m/s^2]", "ay [m/s^2]", "az [m/s^2]"]
G = 9.80665


@pytest.fixture(scope="module")
def imu() -> Imu:
    return flight(3, duration_s=5.0).imu


def rows(imu: Imu, *columns: Any) -> list[list[float]]:
    t_s = (imu.t_ns - imu.t_ns[0]) * 1e-9
    return np.column_stack([t_s, *(columns or (imu.gyro, imu.accel))]).tolist()


def read(path: Path) -> list[Any]:
    return list(table.read(path))


def same(found: Imu, imu: Imu) -> None:
    np.testing.assert_allclose(found.gyro, imu.gyro, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.accel, imu.accel, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found.t_ns, imu.t_ns - imu.t_ns[0])


def test_a_sheet_is_a_table_and_notes_beside_it_are_none(imu: Imu, tmp_path: Path) -> None:
    data = [HEADER, *rows(imu, np.rad2deg(imu.gyro), imu.accel / G)]
    write_xlsx(tmp_path / "walk.xlsx", {"Data": data, "Notes": [["who", "me"], ["when", "today"]]})
    (log,) = read(tmp_path / "walk.xlsx")
    assert log.name == "walk"
    same(log.imus["/imu0"], imu)
    assert "sheets without rows of numbers, or about the recording, are left out: Notes" in log.remarks.notes
    assert log.remarks.losses == []


def test_formulas_have_their_values_and_failed_ones_are_missing(imu: Imu, tmp_path: Path) -> None:
    data: list[list[Any]] = [SI, *([t, gx, gy, gz, Formula(ax), ay, az] for t, gx, gy, gz, ax, ay, az in rows(imu))]
    data[5][2] = Fault("#DIV/0!")
    write_xlsx(tmp_path / "walk.xlsx", {"Data": data})
    (log,) = read(tmp_path / "walk.xlsx")
    kept = np.arange(len(imu)) != 4
    np.testing.assert_array_equal(log.imus["/imu0"].accel, imu.accel[kept])
    assert any("1 samples that are not finite are left out" in note for note in log.remarks.notes)


def test_dates_are_stamps_below_a_title_and_an_empty_row(imu: Imu, tmp_path: Path) -> None:
    noon = 46_000.5  # 2025-12-09, in Excel's days
    data = [[Date(noon + t / 86_400.0), *values] for t, *values in rows(imu)]
    write_xlsx(tmp_path / "walk.xlsx", {"Data": [["Flight 3 of robot A"], [], SI, *data]})
    (log,) = read(tmp_path / "walk.xlsx")
    stamps = int(np.datetime64("2025-12-09T12:00:00", "ns").astype(np.int64)) + imu.t_ns - imu.t_ns[0]
    assert np.abs(log.imus["/imu0"].t_ns - stamps).max() <= 1_000_000  # a day in 53 bits has steps of 0.6 µs


def test_a_sheet_for_each_sensor_is_one_recording_as_phyphox_exports_it(imu: Imu, tmp_path: Path) -> None:
    sheets = {
        "Gyroscope": [["Time (s)", *(f"Gyroscope {a} (rad/s)" for a in "xyz")], *rows(imu, imu.gyro)],
        "Accelerometer": [["Time (s)", *(f"Acceleration {a} (m/s^2)" for a in "xyz")], *rows(imu, imu.accel)],
        "Pressure": [["Time (s)", "Pressure (hPa)"], *([t, 1013.0] for t, *_ in rows(imu)[::10])],
        "Metadata Time": [["event", "experiment time", "system time"], ["START", 0.0, 1.7e9], ["PAUSE", 5.0, 1.7e9]],
    }
    write_xlsx(tmp_path / "phone.xlsx", sheets)
    (log,) = read(tmp_path / "phone.xlsx")
    same(log.imus["/imu0"], imu)
    assert [*log.scalars] == ["/Pressure_Pressure_hPa"]
    assert log.remarks.losses == []


def test_sheets_of_an_imu_and_of_true_poses_are_one_recording(tmp_path: Path) -> None:
    whole = flight(3, duration_s=5.0)
    truth = next(iter(whole.truths.values()))
    poses = np.column_stack([(truth.t_ns - whole.imu.t_ns[0]) * 1e-9, truth.p_wb, truth.q_wb_wxyz])
    names = ["Time", "px", "py", "pz", "qw", "qx", "qy", "qz"]
    write_xlsx(tmp_path / "walk.xlsx", {"IMU": [SI, *rows(whole.imu)], "mocap": [names, *poses.tolist()]})
    (log,) = read(tmp_path / "walk.xlsx")
    assert log.kinds == {"/ground_truth/pose": "truth"}
    np.testing.assert_array_equal(log.poses["/ground_truth/pose"].p_wb, truth.p_wb)


def test_sheets_that_are_an_imu_each_are_recordings_or_the_imus_of_one(imu: Imu, tmp_path: Path) -> None:
    data = [SI, *rows(imu)]
    write_xlsx(tmp_path / "day.xlsx", {"Run 1": data, "Run 2": data[:500]})
    assert {log.name: len(log.imus["/imu0"]) for log in read(tmp_path / "day.xlsx")} == {"day_Run_1": 1001, "day_Run_2": 499}
    write_xlsx(tmp_path / "body.xlsx", {"IMU_left": data, "IMU_right": data})
    (log,) = read(tmp_path / "body.xlsx")
    assert [*log.imus] == ["/imu_left/imu", "/imu_right/imu"]
    assert sorted(sequence.name for sequence in table.sequences(tmp_path)) == ["body", "day_Run_1", "day_Run_2"]


def test_a_cell_far_away_is_refused_before_the_library_makes_room_for_all_between(imu: Imu, tmp_path: Path) -> None:
    write_xlsx(tmp_path / "far.xlsx", {"Data": [SI, *rows(imu)]}, last="XFD1048576")
    with pytest.raises(
        DataError, match=r"sheet1\.xml: has a cell XFD1048576.*at most 33554432 cells.*Delete the rows and columns"
    ):
        read(tmp_path / "far.xlsx")


def test_what_unpacks_beyond_all_proportion_is_refused(imu: Imu, tmp_path: Path) -> None:
    write_xlsx(tmp_path / "bomb.xlsx", {"Data": [SI, *rows(imu)]})
    with zipfile.ZipFile(tmp_path / "bomb.xlsx", "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/sharedStrings.xml", bytes(40 << 20))
    with pytest.raises(DataError, match="expected at most 100 to 1"):
        read(tmp_path / "bomb.xlsx")


def test_a_damaged_file_another_format_and_a_missing_library_are_told(
    imu: Imu, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, cut, old = (tmp_path / name for name in ("whole.xlsx", "cut.xlsx", "old.xls"))
    write_xlsx(whole, {"Data": [SI, *rows(imu)]})
    cut.write_bytes(whole.read_bytes()[:20_000])
    old.write_bytes(b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(5000))
    for path in (cut, old):
        with pytest.raises(DataError, match=rf"{path.name}: cannot be read"):
            read(path)
    with zipfile.ZipFile(tmp_path / "free.ods", "w") as archive:
        archive.writestr("content.xml", "<office:document-content/>")
    with pytest.raises(DataError, match=r"spreadsheet of another format; expected \.xlsx or \.xls\. Save it as \.xlsx or CSV"):
        read(tmp_path / "free.ods")
    monkeypatch.setitem(sys.modules, "python_calamine", None)
    with pytest.raises(ConfigError, match=r"needs python-calamine, which is not installed.*pip install 'imutool\[tables\]'"):
        read(whole)
