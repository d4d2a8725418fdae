"""Folders of tables that ulog2csv wrote of made-up ULogs are read as the ULogs are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyulog.ulog2csv import convert_ulog2csv
from support.flight_logs import ulog_flight

from imutool.api.logs import convert
from imutool.converters import px4_csv, table, ulog
from imutool.errors import DataError
from imutool.mcap_io.log import Log


@pytest.fixture
def tables(tmp_path: Path) -> Path:
    folder = tmp_path / "csv"
    folder.mkdir()
    convert_ulog2csv(str(ulog_flight().write(tmp_path / "flight_7.ulg")), "", str(folder), ",", 0, 0)
    return folder


def test_a_log_is_that_of_its_ulog(tables: Path) -> None:
    (sequence,) = px4_csv.sequences(tables)
    assert (sequence.name, table.sequences(tables)) == ("flight_7", [])
    log, whole = px4_csv.read_sequence(sequence), ulog.read_sequence(ulog.sequences(tables.parent / "flight_7.ulg")[0])
    assert (log.imus.keys(), log.poses.keys(), log.kinds) == (whole.imus.keys(), whole.poses.keys(), whole.kinds)
    for topic, imu in whole.imus.items():
        assert np.array_equal(log.imus[topic].t_ns, imu.t_ns)
        np.testing.assert_allclose(log.imus[topic].gyro, imu.gyro, rtol=1e-6)
        np.testing.assert_allclose(log.imus[topic].accel, imu.accel, rtol=1e-6)
    for topic, poses in whole.poses.items():
        assert np.array_equal(log.poses[topic].t_ns, poses.t_ns)
        np.testing.assert_allclose(log.poses[topic].q_wb_wxyz, poses.q_wb_wxyz, atol=1e-6)
        np.testing.assert_allclose(log.poses[topic].p_wb, poses.p_wb, rtol=1e-6)
    for topic, found in whole.tables.items():
        assert log.tables[topic].columns.dtype.names == found.columns.dtype.names
        assert log.tables[topic].schema_name == found.schema_name
        if topic != "/parameter_update":  # whose one message has no stamp
            assert np.array_equal(log.tables[topic].t_ns, found.t_ns)


def test_a_folder_of_it_and_of_several_is_converted(tables: Path, tmp_path: Path) -> None:
    report = convert(tables, tmp_path / "out.mcap")
    assert report.losses == []
    with Log(tmp_path / "out.mcap") as log:
        assert log.imu_topics == ["/imu", "/imu/sensor0", "/imu/sensor1"]
        assert log.topics["/ekf/pose"].pose_kind == "estimate"
        assert log.truth_topics == ["/ground_truth/pose"]
    for path in list(tables.iterdir()):
        path.with_name(path.name.replace("flight_7", "flight_8")).write_bytes(path.read_bytes())
    assert [path.name for path in convert(tables, tmp_path / "both", workers=1).written] == ["flight_7.mcap", "flight_8.mcap"]


def test_tables_of_others_beside_them_are_left_to_the_tables(tables: Path) -> None:
    (tables / "mocap.csv").write_text("time,x,y,z\n0.0,1.0,2.0,3.0\n")
    assert px4_csv.sequences(tables) == []


def test_a_table_that_cannot_be_read_and_texts_are_named_as_lost(tables: Path) -> None:
    (tables / "flight_7_battery_status_0.csv").write_text("timestamp,voltage\n1,2\n3\n")
    (tables / "flight_7_mavlink_log_0.csv").write_text("timestamp,severity,text\n9000000,6,hello\n")
    log = px4_csv.read_sequence(px4_csv.sequences(tables)[0])
    assert log.remarks.losses == [
        "flight_7_battery_status_0.csv is left out: it has rows that are not of 2 numbers",
        "flight_7_mavlink_log_0.csv: fields of text are left out: text",
    ]
    assert "/mavlink_log" in log.tables
    for path in tables.iterdir():
        path.write_text("timestamp,x\n")
    with pytest.raises(DataError, match="holds no data"):
        px4_csv.read_sequence(px4_csv.sequences(tables)[0])
