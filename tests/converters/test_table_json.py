"""JSON documents, as sensors' programs and web pages write them: made-up values."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imutool.converters import table
from imutool.converters._tables.files.json_documents import load_json
from imutool.converters._tables.text.delimited import Columns
from imutool.converters._tables.text.names import topic_of
from imutool.errors import ConfigError, DataError
from imutool.recording.message_log import MessageLog

COUNT = 80
GYRO = np.random.default_rng(17).normal(0.0, 0.1, (COUNT, 3))
ACCEL = np.tile([0.1, 0.2, 9.8], (COUNT, 1))
SAMPLES = list(zip(range(0, 10 * COUNT, 10), GYRO.tolist(), ACCEL.tolist(), strict=True))


def axes(values: list[float]) -> dict[str, float]:
    return dict(zip("xyz", values, strict=True))


def numbered(sensor: str, unit: str, values: list[float]) -> dict[str, float]:
    return {f"{sensor}_{axis} [{unit}]": value for axis, value in zip("xyz", values, strict=True)}


FLAT = [{"t_ms": t, **numbered("gyro", "rad/s", g), **numbered("acc", "m/s^2", a)} for t, g, a in SAMPLES]
DOCUMENTS: dict[str, Any] = {
    "samples": FLAT,
    "below": {"meta": {"name": "walk"}, "data": {"samples": FLAT}},
    "arrays": {name: [row[name] for row in FLAT] for name in FLAT[0]},
    "arrays of texts": {
        name: [f"1970-01-01T00:00:{row[name] / 1000:06.3f}Z" if name == "t_ms" else str(row[name]) for row in FLAT]
        for name in FLAT[0]
    },
    "objects by row, of pandas": {name: {str(n): row[name] for n, row in enumerate(FLAT)} for name in FLAT[0]},
    "rows by number, of pandas": {str(n): row for n, row in enumerate(FLAT)},
    "columns": {"columns": list(FLAT[0]), "data": [list(row.values()) for row in FLAT]},
    "payload": {
        "payload": {
            "interval_ms": 10,
            "sensors": [{"name": f"{s}{a}", "units": u} for s, u in (("gyr", "rad/s"), ("acc", "m/s2")) for a in "XYZ"],
            "values": [g + a for _, g, a in SAMPLES],
        }
    },
    "nested": [{"time [ms]": t, "gyro": g, "accel": axes(a)} for t, g, a in SAMPLES],
    "sensors": [
        row
        for t, g, a in SAMPLES
        for row in ({"sensor": "Gyroscope", "time [ms]": t, **axes(g)}, {"sensor": "Accelerometer", "time [ms]": t, **axes(a)})
    ],
    "streams": {
        "1": {
            name: {"samples": [{"value": sample[place], "cts": sample[0]} for sample in SAMPLES]}
            for name, place in (("ACCL", 2), ("GYRO", 1))
        }
    },
}


def read(path: Path, text: str, unit: str = "rad/s") -> MessageLog:
    """Log of a document; what it asks about is the unit of the gyro, or the time, which are given."""
    path.write_text(text)
    (sequence,) = table.sequences(path)
    try:
        return table.read_sequence(sequence)
    except ConfigError as refused:
        mapping = path.with_suffix(".toml")
        answered = refused.fix.split("\n\n", 1)[1].replace('gyro_unit = "?"', f'gyro_unit = "{unit}"')
        mapping.write_text(answered)
        return table.read_sequence(sequence, mapping=mapping)


@pytest.mark.parametrize("name", DOCUMENTS)
@pytest.mark.parametrize("indent", [None, 2])
def test_a_json_document_of_samples_is_a_table(tmp_path, name, indent):
    imu = read(tmp_path / "log.json", json.dumps(DOCUMENTS[name], indent=indent)).imus["/imu0"]
    np.testing.assert_allclose(np.hstack([imu.gyro, imu.accel]), np.hstack([GYRO, ACCEL]))
    assert np.array_equal(imu.t_ns - imu.t_ns[0], 10_000_000 * np.arange(COUNT))


def test_batches_of_samples_are_rows_spread_over_the_time_of_each(tmp_path):
    """A Movesense has a time for each batch alone."""
    sensors = {"ArrayAcc": ACCEL, "ArrayGyro": np.rad2deg(GYRO)}
    batches = [
        {
            "Timestamp": 500 + 75 * n,
            **{key: [axes(v) for v in each[8 * n : 8 * n + 8].tolist()] for key, each in sensors.items()},
        }
        for n in range(COUNT // 8)
    ]
    (tmp_path / "log.json").write_text(json.dumps({"Meas": {"IMU6": batches}}))
    (sequence,) = table.sequences(tmp_path / "log.json")
    log = table.read_sequence(sequence, mapping={"gyro_unit": "deg/s"})
    assert "'Timestamp' has a stamp for 8 rows each in the mean" in log.remarks.notes
    imu = log.imus["/imu0"]
    np.testing.assert_allclose(np.hstack([imu.gyro, imu.accel]), np.hstack([GYRO, ACCEL]))
    assert np.array_equal(np.diff(imu.t_ns), np.full(COUNT - 1, 9_375_000))


def test_lists_a_line_are_a_table_without_a_header(tmp_path):
    """As Python prints them."""
    text = "".join(f"{[t / 1000, *g, *(np.array(a) + 0.01 * n % 2)]}\n" for n, (t, g, a) in enumerate(SAMPLES))
    imu = read(tmp_path / "log.txt", text.replace("np.float64(", "").replace(")", "")).imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, GYRO)
    assert np.array_equal(imu.t_ns, 10_000_000 * np.arange(COUNT))


def test_other_json_is_refused_in_one_sentence(tmp_path):
    (tmp_path / "cut.json").write_text(json.dumps(FLAT)[:-40])
    with pytest.raises(DataError, match="begins as JSON and cannot be read"):
        table.read_sequence(table.sequences(tmp_path / "cut.json")[0])
    (tmp_path / "package.json").write_text(json.dumps({"name": "page", "version": "1.0.0", "files": ["a", "b"]}))
    with pytest.raises(DataError, match="holds no columns of numbers"):
        table.read_sequence(table.sequences(tmp_path / "package.json")[0])


def test_integers_beyond_every_number_harm_nothing_else(tmp_path):
    document = {"serial": 10**400, **DOCUMENTS["arrays"], "flags": [10**400] * COUNT}
    imu = read(tmp_path / "log.json", json.dumps(document)).imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, GYRO)


def test_rows_of_two_kinds_below_one_name_are_both_kept_and_so_is_a_rare_third(tmp_path):
    rows = [row for t, g, a in SAMPLES for row in ({"t_ms": t, "data": {"gyro": g}}, {"t_ms": t, "data": {"acc": a}})]
    rare = [{"t_ms": 5, "battery_V": 3.9}, {"t_ms": 15, "battery_V": 3.8}]
    found = read(tmp_path / "log.json", json.dumps([*rows, *rare]))
    np.testing.assert_allclose(found.imus["/imu0"].gyro, GYRO)
    assert any("battery" in topic for topic in found.scalars)


def test_words_of_a_sample_make_no_rows(tmp_path):
    tagged = [{**row, "tags": ["walk", "fast"]} for row in FLAT]
    assert np.array_equal(read(tmp_path / "log.json", json.dumps(tagged)).imus["/imu0"].t_ns, 10_000_000 * np.arange(COUNT))


@pytest.mark.parametrize("form", ["lines", "document", "csv"])
@pytest.mark.parametrize("printed", [lambda vector: str(np.array(vector)), str, lambda vector: str((*vector,))])
def test_vectors_in_texts_are_vectors(tmp_path, form, printed):
    """As Python prints them and NumPy, which pads them to a width."""
    rows = [{"t_ms": t, "gyro": printed(g), "accel": printed(a)} for t, g, a in SAMPLES]
    lines = [json.dumps(row) for row in rows]
    text = {
        "lines": "\n".join(lines),
        "document": f"[{','.join(lines)}]",
        "csv": "\n".join(["t_ms,gyro,accel", *(f'{row["t_ms"]},"{row["gyro"]}","{row["accel"]}"' for row in rows)]),
    }[form]
    imu = read(tmp_path / "log.json", text).imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, GYRO, atol=1e-8)
    np.testing.assert_allclose(imu.accel, ACCEL)


@pytest.mark.parametrize("devices", [(1, 2), ("C4:01", "C4:02")])
def test_lines_of_several_devices_are_several_imus(tmp_path, devices):
    """A line that the logger cut off hides none."""
    lines = [json.dumps({"device_id": device, **row}) for row in FLAT for device in devices]
    log = read(tmp_path / "walk.jsonl", "\n".join([*lines, '{"device_id": 1, "t_']))
    assert [len(imu) for imu in log.imus.values()] == [COUNT, COUNT]
    assert all(re.fullmatch(r"(/[a-z]\w*)+", topic) for topic in log.imus), "names that ROS allows"
    assert all(np.array_equal(imu.gyro, GYRO) for imu in log.imus.values())
    assert log.remarks.losses == [f"1 of {len(lines) + 1} lines are no JSON and are left out"]


@pytest.mark.parametrize("indent", [None, 2])
def test_objects_behind_one_another_are_rows(tmp_path, indent):
    imu = read(tmp_path / "stream.txt", "".join(json.dumps(row, indent=indent) for row in FLAT)).imus["/imu0"]
    assert np.array_equal(imu.gyro, GYRO)


def test_a_rate_beside_the_samples_of_one_sensor_is_theirs(tmp_path):
    """Another sensor has its own."""
    samples = [{"gyroscope": g, "acceleration": a} for _, g, a in SAMPLES]
    document = {"emg": {"frequency": 200, "data": [[1, 2]] * COUNT}, "imu": {"frequency": 50, "data": samples}}
    (tmp_path / "log.json").write_text(json.dumps(document))
    log = table.read_sequence(table.sequences(tmp_path / "log.json")[0], mapping={"gyro_unit": "rad/s"})
    assert log.imus["/imu0"].t_ns.tolist() == [n * 20_000_000 for n in range(COUNT)]


@pytest.mark.parametrize("lines", [False, True])
def test_not_a_number_as_python_writes_it_is_a_missing_value(tmp_path, lines):
    rows = [row | {"temperature": float("nan") if n % 3 else 20.0} for n, row in enumerate(FLAT)]
    log = read(tmp_path / "log.json", "\n".join(map(json.dumps, rows)) if lines else json.dumps(rows))
    assert np.array_equal(log.imus["/imu0"].gyro, GYRO)
    assert len(log.scalars["/temperature"]) == len(rows[::3])
    with pytest.raises(DataError, match="begins as JSON and cannot be read"):
        read(tmp_path / "cut.json", json.dumps(rows)[:-20].replace("},", ","))


def test_lines_of_json_in_a_folder_are_a_table_and_have_true_poses_beside_them(tmp_path):
    folder = tmp_path / "walk"
    folder.mkdir()
    readings = [
        {"time": t / 1000 + late, "sensor": {"type": name, "values": values}}
        for t, g, a in SAMPLES
        for name, values, late in (("gyroscope", g, 0.0), ("accelerometer", a, 0.001))
    ]
    poses = [
        {"time": t / 1000, "position": axes([0.0, 0.0, t / 500]), "orientation": {"w": 1.0, **axes([0.0] * 3)}}
        for t, *_ in SAMPLES
    ]
    (folder / "data.jsonl").write_text("".join(json.dumps(row) + "\n" for row in readings))
    (folder / "calibration.json").write_text(json.dumps({"cameras": [{"focalLengthX": 1000.0}]}))
    (alone,) = table.sequences(folder)
    assert alone.path == folder / "data.jsonl"
    (folder / "groundtruth.jsonl").write_text("".join(json.dumps(row) + "\n" for row in poses))
    (found,) = table.sequences(folder)
    log = table.read_sequence(found, mapping={"gyro_unit": "rad/s"})
    assert log.kinds == {"/ground_truth/pose": "truth"}
    assert len(log.imus["/imu0"]) >= COUNT - 1


@pytest.mark.parametrize("late", [0, 3000])
def test_signals_of_a_bus_have_their_own_times(tmp_path, late):
    """A2D2 has a list of times and values for each signal of a car, with units as data bases of Vector write them."""
    t_us = 1_554_121_595_035_037 + 10_000 * np.arange(COUNT)
    rates, unit = np.degrees(GYRO), "Unit_DegreOfArcPerSecon"
    signals = {f"angular_velocity_omega_{a}": (late, unit, rates[:, n]) for n, a in enumerate("xyz")}
    signals |= {f"acceleration_{a}": (0, "Unit_MeterPerSeconSquar", ACCEL[:, n]) for n, a in enumerate("xyz")}
    signals["vehicle_speed"] = 777, None, np.arange(float(COUNT))
    document = {
        name: {"unit": unit, "values": [[t + later, value] for t, value in zip(t_us.tolist(), values.tolist(), strict=True)]}
        for name, (later, unit, values) in signals.items()
    }
    (tmp_path / "bus_signals.json").write_text(json.dumps(document))
    log = table.read_sequence(table.sequences(tmp_path / "bus_signals.json")[0])
    count = COUNT - bool(late)  # behind the last force there is none to interpolate
    assert np.array_equal(log.imus["/imu0"].t_ns, 1000 * (t_us + late)[:count])
    np.testing.assert_allclose(log.imus["/imu0"].gyro, GYRO[:count])
    np.testing.assert_allclose(log.imus["/imu0"].accel, ACCEL[:count])
    assert np.array_equal(log.scalars["/vehicle_speed"].t_ns, 1000 * (t_us + 777))
    gyro, accel = ("angular_velocity_omega", "acceleration") if late else ("signals", "signals")  # not another sensor's name
    assert any(f"gyro = {gyro}/angular_velocity_omega_x, " in note for note in log.remarks.notes)
    assert any(f"accel = {accel}/acceleration_x, " in note for note in log.remarks.notes)


def test_a_topic_does_not_repeat_its_group():
    columns = "speed/speed", "speed/speed_left", "a/accel_x", "mocap/v [m/s]"
    assert [topic_of(column, {}, []) for column in columns] == ["/speed", "/speed_left", "/a_accel_x", "/mocap_v_m_s"]


@pytest.mark.parametrize(("unit", "more"), [({"per": "s"}, []), (7, []), ("rad/s", [0.5])])
def test_what_only_looks_like_a_signal_keeps_all_its_columns(tmp_path, unit, more):
    """A unit that is no text, and rows of more than a time and a value."""
    document = {"angular_velocity_x": {"unit": unit, "values": [[0.01 * n, 0.1, *more] for n in range(COUNT)]}}
    (tmp_path / "a.json").write_text(json.dumps(document))
    columns = Columns()
    load_json(tmp_path / "a.json", columns)
    assert sum(name.startswith("angular_velocity_x") for name in columns.values) == 2 + len(more)
