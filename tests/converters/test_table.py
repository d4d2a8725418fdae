"""Tables of any origin: columns and units from their names, the rest from a map file, in every file format."""

from __future__ import annotations

import re
import shutil
import tracemalloc
import zipfile
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.tables import write_csv

from imutool.converters import table
from imutool.converters._tables.columns.map import read_map
from imutool.converters._tables.files import mat as table_mat
from imutool.errors import ConfigError, DataError
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.sensor.made_up_flight import flight

RNG = np.random.default_rng(5)
COUNT = 600
T_NS = 1_600_000_000_000_000_123 + np.arange(COUNT) * 5_000_000
GYRO = RNG.normal(0, 0.003, (COUNT, 3))
ACCEL = RNG.normal(0, 0.02, (COUNT, 3)) + np.array([0.0, 0.0, 9.81])
G = 9.80665
CERTAIN = ["timestamp [ns]", *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"accel_{a} [m/s^2]" for a in "xyz")]


def arrays(gyro: np.ndarray = GYRO, accel: np.ndarray = ACCEL, t: np.ndarray = T_NS) -> list[np.ndarray]:
    return [t, *gyro.T, *accel.T]


def same(log: Path, tolerance: float = 0.0) -> None:
    imu = read(log).imu
    assert np.array_equal(imu.t_ns, T_NS)
    np.testing.assert_allclose(imu.gyro, GYRO, rtol=tolerance)
    np.testing.assert_allclose(imu.accel, ACCEL, rtol=tolerance)


HEADERS = {
    "units in brackets": (CERTAIN, 1.0, 1.0),
    "degrees and g": (
        ["time (ns)", *(f"Gyroscope {a} (deg/s)" for a in "XYZ"), *(f"Accelerometer {a} (g)" for a in "XYZ")],
        np.pi / 180,
        G,
    ),
    "units at the end": (["t_ns", *(f"w{a}_dps" for a in "xyz"), *(f"acc_{a}_mg" for a in "xyz")], np.pi / 180, G / 1000),
    "units at the end of capitals": (
        ["time_ns", *(f"gyro{a}Dps" for a in "XYZ"), *(f"accel{a}Mg" for a in "XYZ")],
        np.pi / 180,
        G / 1000,
    ),
    "units before the axis": (["t_ns", *(f"gyro_dps_{a}" for a in "xyz"), *(f"accel_g_{a}" for a in "xyz")], np.pi / 180, G),
    "milli g": (["t_ns", *(f"g{a}_dps" for a in "xyz"), *(f"a{a}_milli_g" for a in "xyz")], np.pi / 180, G / 1000),
    "mss": (["t_ns", *(f"gyro_{a}_radps" for a in "xyz"), *(f"accel_{a}_mss" for a in "xyz")], 1.0, 1.0),
    "units of two words": (["t_ns", *(f"gyro_{a}_rad_s" for a in "xyz"), *(f"accel_{a}_m_s2" for a in "xyz")], 1.0, 1.0),
    "fields of ROS": (
        [
            "rosbagTimestamp",
            *(f"field.angular_velocity.{a}" for a in "xyz"),
            *(f"field.linear_acceleration.{a}" for a in "xyz"),
        ],
        1.0,
        1.0,
    ),
    "gravity shows the unit": (["timestamp", *(f"gyro_{a}_rads" for a in "xyz"), "ax", "ay", "az"], 1.0, 1.0),
}


@pytest.mark.parametrize("header", HEADERS)
def test_names_and_units_are_recognised(convert, tmp_path, header):
    names, gyro_size, accel_size = HEADERS[header]
    path = write_csv(tmp_path / "log.csv", names, arrays(GYRO / gyro_size, ACCEL / accel_size))
    done = convert(path, tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    assert "columns: " in done.stderr  # what was recognised is shown
    same(tmp_path / "out.mcap", 1e-12)


def rows_of(times: list[str], values: np.ndarray, mark: str = ",") -> str:
    return "".join(f"{mark.join([t, *map(repr, row)])}\n" for t, row in zip(times, values.tolist(), strict=True))


def iso(t_ns: int, form: str) -> str:
    moment = datetime.fromtimestamp(t_ns // 10**9, UTC)
    return moment.strftime(form).replace("FRACTION", f"{t_ns % 10**9:09d}")


VALUES = np.column_stack([GYRO, ACCEL])
PLAIN = ["t_ns", *(f"gyro_{a}_rads" for a in "xyz"), *(f"acc_{a}_ms2" for a in "xyz")]
GERMAN = ["Zeit [ns]", *(f"Drehrate {a} [rad/s]" for a in "XYZ"), *(f"Beschleunigung {a} [m/s²]" for a in "XYZ")]
STAMPS = list(map(str, T_NS.tolist()))
SHAPES = {
    "comments above the header": ("# made by a logger\n# v2\n" + ",".join(PLAIN) + "\n" + rows_of(STAMPS, VALUES)).encode(),
    "a percent sign": ("% exported\n%\n" + ",".join(PLAIN) + "\n" + rows_of(STAMPS, VALUES)).encode(),
    "units in a row of their own": (
        "t,wx,wy,wz,ax,ay,az\nns,rad/s,rad/s,rad/s,m/s^2,m/s^2,m/s^2\n" + rows_of(STAMPS, VALUES)
    ).encode(),
    "commas in quoted names": (
        ",".join(['"time [ns]"', *(f'"rate, {a} [rad/s]"' for a in "xyz"), *(f'"acceleration, {a} [m/s^2]"' for a in "xyz")])
        + "\n"
        + rows_of(STAMPS, VALUES)
    ).encode(),
    "calendar times in UTC": (
        ",".join(["Timestamp", *PLAIN[1:]])
        + "\n"
        + rows_of([iso(t, "%Y-%m-%dT%H:%M:%S.FRACTIONZ") for t in T_NS.tolist()], VALUES)
    ).encode(),
    "calendar times with an offset": (
        ",".join(["time", *PLAIN[1:]])
        + "\n"
        + rows_of([iso(t + 7200 * 10**9, "%Y-%m-%d %H:%M:%S.FRACTION+02:00") for t in T_NS.tolist()], VALUES)
    ).encode(),
    "German Excel in Windows' code page": (";".join(GERMAN) + "\n" + rows_of(STAMPS, VALUES, ";").replace(".", ",")).encode(
        "cp1252"
    ),
    "German dates": (
        ";".join(["Zeitstempel", *GERMAN[1:]])
        + "\n"
        + rows_of([iso(t, "%d.%m.%Y %H:%M:%S,FRACTION") for t in T_NS.tolist()], VALUES, ";")
    ).encode(),
    "every field in quotes, a comma behind the last": "".join(
        ",".join(f'"{field}"' for field in line.split(",")) + ",\n"
        for line in [",".join(PLAIN), *rows_of(STAMPS, VALUES).splitlines()]
    ).encode("utf-8-sig"),
    "German in quotes": "".join(
        ";".join(f'"{field}"' for field in line.split(";")) + "\n"
        for line in [";".join(GERMAN), *rows_of(STAMPS, VALUES, ";").replace(".", ",").splitlines()]
    ).encode(),
    "a header that repeats": (
        ",".join(PLAIN) + "\n" + rows_of(STAMPS[:50], VALUES[:50]) + ",".join(PLAIN) + "\n" + rows_of(STAMPS[50:], VALUES[50:])
    ).encode(),
    "bars": ("|".join(PLAIN) + "\n" + rows_of(STAMPS, VALUES, "|")).encode(),
    "UTF-16": ("\t".join(PLAIN) + "\n" + rows_of(STAMPS, VALUES, "\t")).encode("utf-16"),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_tables_of_text_come_in_many_shapes(tmp_path, shape):
    (tmp_path / "log.csv").write_bytes(SHAPES[shape])
    (sequence,) = table.sequences(tmp_path / "log.csv")
    imu = table.read_sequence(sequence).imus["/imu0"]
    assert imu.t_ns.tolist() == T_NS.tolist()
    assert np.array_equal(imu.gyro, GYRO)
    assert np.array_equal(imu.accel, ACCEL)


def test_the_unit_beside_an_array_in_hdf5_counts(tmp_path):
    import h5py

    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["imu/t_ns"] = T_NS
        file.create_dataset("imu/gyro", data=GYRO).attrs["units"] = "deg/s"
        file.create_dataset("imu/accel", data=ACCEL).attrs["units"] = "g"
    (sequence,) = table.sequences(tmp_path / "log.h5")
    imu = table.read_sequence(sequence).imus["/imu0"]
    np.testing.assert_allclose(imu.gyro, np.deg2rad(GYRO))
    np.testing.assert_allclose(imu.accel, ACCEL * G)


@pytest.mark.parametrize(
    ("unit", "size"),
    [
        ("seconds since 2020-09-13 12:26:40", 1.0),
        ("milliseconds since 2020-09-13T12:26:40.0Z", 1e3),
        ("days since 2020-09-13 12:26:40 UTC", 1 / 86_400),
        ("seconds since 1970-01-01 00:00:00 +00:00", 1.0),
    ],
)
def test_times_of_netcdf_count_from_the_day_that_their_unit_names(tmp_path, unit, size):
    import h5py

    t_s = np.arange(300) / 100.0
    with h5py.File(tmp_path / "glider.nc", "w") as file:
        file["time"] = size * (t_s + (1_600_000_000.0 if "1970" in unit else 0.0))
        file["time"].attrs["units"] = unit
        for name in ("gyro", "accel"):
            file[name] = np.random.default_rng(1).normal([0.0, 0.0, 9.8], 0.1, (300, 3))
            file[name].attrs["units"] = "rad/s" if name == "gyro" else "m/s^2"
    log = table.read_sequence(table.sequences(tmp_path / "glider.nc")[0])
    np.testing.assert_allclose(log.imus["/imu0"].t_ns - 1_600_000_000 * 10**9, 1e9 * t_s, atol=300)


@pytest.mark.parametrize("unit", ["rad/s", [b"rad/s"]])
def test_numbers_that_netcdf_packs_are_scaled_and_its_fill_values_are_missing(tmp_path, unit):
    import h5py

    scale, packed = 2.0**-10, np.rint(GYRO * 2**10).astype(np.int32)
    packed[3, 1] = -32768
    with h5py.File(tmp_path / "log.nc", "w") as file:
        file["time_ns"], gyro = T_NS, file.create_dataset("gyro", data=packed)
        gyro.attrs.update({"units": unit, "scale_factor": [scale], "add_offset": 0.5, "_FillValue": np.int32([-32768])})
        file.create_dataset("accel", data=ACCEL).attrs["units"] = "m/s^2"
    (sequence,) = table.sequences(tmp_path / "log.nc")
    imu = table.read_sequence(sequence).imus["/imu0"]
    assert imu.t_ns.tolist() == [t for n, t in enumerate(T_NS.tolist()) if n != 3]
    np.testing.assert_allclose(imu.gyro, np.delete(packed, 3, axis=0) * scale + 0.5)


def test_a_spreadsheet_of_another_format_is_refused_with_what_to_do(convert, tmp_path):
    with zipfile.ZipFile(tmp_path / "log.xlsb", "w") as archive:
        archive.writestr("[Content_Types].xml", "<Types/>")
        archive.writestr("xl/workbook.bin", "")
    done = convert(tmp_path / "log.xlsb", tmp_path / "out.mcap")
    assert done.returncode == 4
    assert "is a spreadsheet" in done.stderr
    assert "as .xlsx or CSV" in done.stderr


def test_seconds_in_decimals_are_exact_and_further_columns_become_topics(convert, tmp_path):
    names = ["time [s]", *CERTAIN[1:], "temperature [degC]"]
    path = write_csv(tmp_path / "log.tsv", names, [*arrays(), np.full(COUNT, 25.5)], "\t")
    for exact, rounded in ((f"{t // 10**9}.{t % 10**9:09d}", str(t)) for t in T_NS.tolist()):
        path.write_text(path.read_text().replace(rounded, exact, 1))
    assert convert(path, tmp_path / "out.mcap").returncode == 0
    same(tmp_path / "out.mcap")
    temperature = read(tmp_path / "out.mcap").scalars["/temperature_degC"]
    assert (temperature.unit, temperature.values[9, 0]) == ("degC", 25.5)


def test_what_is_in_doubt_is_asked_for_and_the_answer_settles_it(convert, imutool, tmp_path):
    names = ["t", "gx", "gy", "gz", "ax", "ay", "az"]
    path = write_csv(tmp_path / "log.csv", names, arrays(GYRO * 180 / np.pi))
    done = convert(path, tmp_path / "out.mcap")
    assert done.returncode == 3
    assert "state no unit of the gyro" in done.stderr
    assert "--map" in done.stderr
    proposed = done.stderr.partition("\n\n")[2]
    assert re.search(r'gyro_unit = "\?"  # please state: rad/s or deg/s', proposed)
    (tmp_path / "map.toml").write_text(proposed.replace('gyro_unit = "?"', 'gyro_unit = "deg/s"'))
    assert convert(path, tmp_path / "out.mcap", "--map", tmp_path / "map.toml").returncode == 0
    same(tmp_path / "out.mcap", 1e-12)
    assert convert(path, tmp_path / "word.mcap", "--map", "gyro_unit=deg/s", "--map", "time_unit=ns").returncode == 0
    same(tmp_path / "word.mcap", 1e-12)
    assert imutool("debias", "out.mcap", "d.mcap", cwd=tmp_path).returncode == 0  # three commands, no Python


def test_raw_counts_get_their_scale_from_the_map(convert, tmp_path):
    counts = np.rint(np.column_stack([GYRO * 10_000 + 512, ACCEL * 20 + 300])).astype(np.int64)
    np.savez(tmp_path / "raw.npz", ts=T_NS / 1e9 - 1.6e9, vals=counts.T.astype(np.uint16))
    (tmp_path / "map.toml").write_text(
        'time = "ts"\ntime_unit = "s"\ngyro = ["vals[0]", "-vals[1]", "vals[2]"]\ngyro_unit = "rad/s"\ngyro_offset = 512\n'
        'gyro_scale = 0.0001\naccel = ["vals[3]", "vals[4]", "vals[5]"]\naccel_unit = "m/s^2"\naccel_scale = 0.05\n'
        "accel_offset = [300.0, 300.0, 300.0]\n"
    )
    assert convert(tmp_path / "raw.npz", tmp_path / "out.mcap", "--map", tmp_path / "map.toml").returncode == 0
    imu = read(tmp_path / "out.mcap").imu
    np.testing.assert_allclose(imu.gyro, GYRO * [1, -1, 1], atol=0.00006)
    np.testing.assert_allclose(imu.accel, ACCEL, atol=0.03)


def as_npz(path: Path) -> None:
    np.savez(path, **dict(zip(CERTAIN, arrays(), strict=True)))


def as_parquet(path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table(dict(zip(CERTAIN, arrays(), strict=True))), path)


def as_mat(path: Path) -> None:
    from scipy.io import savemat

    with path.open("wb") as file:
        savemat(file, {"time_ns": T_NS, "angular_velocity": GYRO, "linear_acceleration": ACCEL.T})


def as_hdf5(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file["imu/time_ns"], file["imu/angular_velocity"], file["imu/linear_acceleration"] = T_NS, GYRO, ACCEL


@pytest.mark.parametrize("kind", ["M8[ns]", "m8[ns]"])
@pytest.mark.parametrize("ending", ["npz", "npy", "parquet"])
def test_dates_and_times_of_numpy_are_times(tmp_path, kind, ending):
    names = ("time", *CERTAIN[1:])
    values = dict(zip(names, (T_NS.astype(kind), *arrays()[1:]), strict=True))
    path = tmp_path / f"log.{ending}"
    if ending == "npz":
        np.savez(path, **values)
    elif ending == "npy":
        np.save(path, np.rec.fromarrays([*values.values()], names=[*values]))
    else:
        import pyarrow as pa
        import pyarrow.parquet as pq

        pq.write_table(pa.table(values), path)
    (sequence,) = table.sequences(path)
    imu = table.read_sequence(sequence).imus["/imu0"]
    assert imu.t_ns.tolist() == T_NS.tolist()
    assert np.array_equal(imu.gyro, GYRO)


@pytest.mark.parametrize("write", [as_npz, as_parquet, as_mat, as_hdf5])
def test_every_file_format_gives_the_same_imu(convert, tmp_path, write):
    with (tmp_path / "recording").open("wb"):
        pass
    write(tmp_path / ("recording.npz" if write is as_npz else "recording"))
    source = tmp_path / ("recording.npz" if write is as_npz else "recording")
    done = convert(source, tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    same(tmp_path / "out.mcap")


def test_decimal_commas_are_read_and_named(convert, tmp_path):
    path = write_csv(tmp_path / "log.csv", CERTAIN, arrays(), ";")
    path.write_text(path.read_text().replace(".", ","))
    done = convert(path, tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    assert "decimal commas are read as points" in done.stderr
    same(tmp_path / "out.mcap")


def test_an_hdf5_file_that_leads_to_another_file_is_refused(convert, tmp_path):
    import h5py

    as_hdf5(tmp_path / "other.h5")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time_ns"] = T_NS
        file.create_dataset("gyro", (COUNT, 3), "f8", external=[("/etc/hostname", 0, COUNT * 24)])
        file["accel"] = h5py.ExternalLink("other.h5", "imu/linear_acceleration")
    done = convert(tmp_path / "a.h5", tmp_path / "out.mcap")
    assert done.returncode == 4
    assert "gyro lies in another file" in done.stderr


def test_what_a_table_file_cannot_give_is_said_with_what_to_do(convert, tmp_path):
    import h5py

    with h5py.File(tmp_path / "object.mat", "w") as file:
        file["T"] = np.arange(3)
        file["T"].attrs.update(MATLAB_class=np.bytes_("timetable"), MATLAB_object_decode=3)
    with h5py.File(tmp_path / "text.mat", "w") as file:
        file["names"] = np.arange(6)
        file["names"].attrs.update(MATLAB_class=np.bytes_("string"), MATLAB_object_decode=3)
        file["t"], file["gyro"], file["accel"] = 0.01 * np.arange(COUNT), GYRO.T, ACCEL.T
    done = convert(tmp_path / "text.mat", tmp_path / "text.mcap", "--map", "gyro_unit=rad/s")
    assert "names is a MATLAB object (string), not an array" in done.stderr
    assert done.returncode == 3
    assert (tmp_path / "text.mcap").exists(), "the arrays beside it are read"
    with h5py.File(tmp_path / "links.h5", "w") as file:
        file["gyro"] = h5py.ExternalLink("other.h5", "gyro")
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w") as archive, archive.open("gyro.npy", "w") as member:
        np.lib.format.write_array_header_1_0(member, {"descr": "<f8", "fortran_order": False, "shape": (10**9, 3)})
    expected = {
        "object.mat": ("T is a MATLAB object (timetable)", "with writetable as CSV"),
        "links.h5": ("gyro: links to other files", "Copy the arrays into this file"),
        "bomb.npz": ("unpacks to 24000000000 bytes", "at most"),
    }
    for name, sentences in expected.items():
        done = convert(tmp_path / name, tmp_path / "out.mcap")
        assert done.returncode == 4, done.stderr
        assert all(sentence in done.stderr for sentence in sentences), done.stderr


def test_a_parquet_file_of_a_few_bytes_is_refused_before_it_unpacks(tmp_path, monkeypatch):
    """Its times were read whole, to see whether they go back: 4 MB took gigabytes, and ended in a traceback."""
    import pyarrow
    import pyarrow.parquet

    alike = {name: np.full(1 << 20, 9.81) for name in ("t", "gx", "gy", "gz", "ax", "ay", "az")}
    pyarrow.parquet.write_table(pyarrow.table(alike), tmp_path / "bomb.parquet")
    monkeypatch.setattr(table_mat, "LIMIT", 8 << 20)
    tracemalloc.start()
    with pytest.raises(DataError, match=f"unpacks to {7 * 8 << 20} bytes"):
        list(table.read(tmp_path / "bomb.parquet"))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 << 20


@pytest.mark.parametrize("start", [b"PAR1", b"\x89HDF\r\n\x1a\n", b"MATLAB 5.0 MAT-file, made up"])
def test_damaged_files_are_refused_in_one_sentence(convert, tmp_path, start):
    (tmp_path / "a").write_bytes(start + bytes(600))
    done = convert(tmp_path / "a", tmp_path / "out.mcap")
    assert done.returncode == 4
    assert "Traceback" not in done.stderr


def test_a_map_with_an_unknown_column_or_unit_says_which_exist(convert, tmp_path):
    path = write_csv(tmp_path / "log.csv", CERTAIN, arrays())
    text = (
        'time = "t"\ntime_unit = "ns"\ngyro = ["a", "b", "c"]\ngyro_unit = "rad/s"\naccel = ["a", "b", "c"]\naccel_unit = "g"\n'
    )
    for broken, said in ((text, "no column 't'"), (text.replace('"ns"', '"hours"'), "expected one of s, ms, us, ns")):
        (tmp_path / "map.toml").write_text(broken)
        done = convert(path, tmp_path / "out.mcap", "--map", tmp_path / "map.toml")
        assert done.returncode == 3
        assert said in done.stderr


def test_two_sensors_at_two_rates_become_one_imu(convert, tmp_path):
    t_a = T_NS[0] + np.arange(200) * 17_000_000
    slow = np.column_stack([np.zeros(200), np.zeros(200), 9.81 + (t_a - T_NS[0]) * 1e-9])
    np.savez(tmp_path / "a.npz", t=T_NS, g=GYRO, ta=t_a, a=slow)
    (tmp_path / "map.toml").write_text(
        'time = "t"\ntime_unit = "ns"\naccel_time = "ta"\ngyro = ["g[0]", "g[1]", "g[2]"]\ngyro_unit = "rad/s"\n'
        'accel = ["a[0]", "a[1]", "a[2]"]\naccel_unit = "m/s^2"\n'
    )
    done = convert(tmp_path / "a.npz", tmp_path / "out.mcap", "--map", tmp_path / "map.toml")
    assert done.returncode == 0, done.stderr
    assert "gyro at 200.0 Hz and accelerometer at 58.8 Hz became one IMU" in done.stderr
    imu = read(tmp_path / "out.mcap").imu
    np.testing.assert_allclose(imu.accel[:, 2], 9.81 + (imu.t_ns - T_NS[0]) * 1e-9, atol=1e-9)


def test_text_without_numbers_is_no_table(tmp_path):
    (tmp_path / "notes.txt").write_text("a, b, c, d\nthis, is, no, table\n")
    assert table.sequences(tmp_path / "notes.txt") == []
    assert table.sequences(tmp_path) == []


def test_the_public_raw_counts_with_motion_capture(convert, tmp_path, data):
    folder = data / "outside" / "upenn_vicon"
    assert convert(folder / "imuRaw1.mat", tmp_path / "out.mcap").returncode == 3  # counts: asked for
    (tmp_path / "map.toml").write_text(
        'time = "ts"\ntime_unit = "s"\ngyro = ["vals[4]", "vals[5]", "vals[3]"]\ngyro_unit = "rad/s"\n'
        "gyro_offset = [373.6, 375.2, 369.7]\ngyro_scale = 0.01745\n"
        'accel = ["-vals[0]", "-vals[1]", "vals[2]"]\naccel_unit = "g"\n'
        "accel_offset = [511.0, 501.0, 503.0]\naccel_scale = 0.0097\n"
        f'truth_file = "{folder / "viconRot1.mat"}"\ntruth_time = "ts"\nrotation_matrix = "rots"\n'
    )
    assert convert(folder / "imuRaw1.mat", tmp_path / "out.mcap", "--map", tmp_path / "map.toml").returncode == 0
    recording = read(tmp_path / "out.mcap")
    assert len(recording.imu) == 5645
    assert list(recording.truths) == ["/ground_truth/pose"]


def test_tables_that_a_number_pairs_are_a_recording_each_and_one_map_holds_for_all(convert, tmp_path, data):
    """imuRaw1 and viconRot1; the map's names need no group, and its poses are found by the motion."""
    folder = data / "outside" / "upenn_vicon"
    asked = convert(folder, tmp_path / "out/")
    assert asked.returncode == 4
    assert "upenn_vicon/imuRaw2: the meaning of its columns is not certain" in asked.stderr
    assert "the accel holds whole numbers, none below zero: raw counts, with a zero of their own?" in asked.stderr
    assert "gravity in mg" not in asked.stderr
    (tmp_path / "map.toml").write_text(
        'gyro = ["vals[4]", "vals[5]", "vals[3]"]\ngyro_unit = "deg/s"\ngyro_offset = [373.6, 375.2, 369.7]\n'
        'gyro_scale = 1.0\naccel = ["-vals[0]", "-vals[1]", "vals[2]"]\naccel_unit = "g"\n'
        "accel_offset = [511.0, 501.0, 503.0]\naccel_scale = 0.0097\n"
    )
    done = convert(folder, tmp_path / "out/", "--map", tmp_path / "map.toml")
    assert done.returncode == 0, done.stderr
    assert "gravity in mg" not in done.stderr, "the map states the unit"
    (tmp_path / "whole.toml").write_text('time = "ts"\ntime_unit = "s"\n' + (tmp_path / "map.toml").read_text())
    done = convert(folder, tmp_path / "whole/", "--map", tmp_path / "whole.toml")
    assert done.returncode == 0, done.stderr
    with Log(tmp_path / "whole" / "imuRaw2.mcap") as log:
        assert {*log.topics} == {"/imu0", "/ground_truth/pose"}
    recordings = [read(tmp_path / "out" / f"imuRaw{number}.mcap") for number in (1, 2, 3)]
    assert [len(each.imu) for each in recordings] == [5645, 4698, 3404]
    assert [len(each.truth.t_ns) for each in recordings] == [5561, 4601, 3433]


def test_nine_columns_of_a_motion_capture_are_its_rotations_row_by_row(convert, tmp_path):
    """As Qualisys writes them: column by column, and zeros where the body was not seen."""
    poses = flight(3, duration_s=4.0).truth
    turned = Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True).as_matrix()
    rows = np.column_stack([poses.t_ns * 1e-9, 1e3 * poses.p_wb, turned.transpose(0, 2, 1).reshape(-1, 9)])
    rows[7, 1:] = 0.0
    names = "\t".join(["Time", "X", "Y", "Z", *(f"Rot[{k}]" for k in range(9))])
    np.savetxt(tmp_path / "gt.tsv", rows, "%.9f", "\t", header=names, comments="")
    write_csv(tmp_path / "imu.csv", CERTAIN, arrays(t=poses.t_ns[0] + 5_000_000 * np.arange(COUNT)))
    nine = [f"Rot[{k}]" for k in (0, 3, 6, 1, 4, 7, 2, 5, 8)]
    (tmp_path / "map.toml").write_text(
        f'time = "{CERTAIN[0]}"\ntime_unit = "ns"\ngyro = {CERTAIN[1:4]}\ngyro_unit = "rad/s"\n'
        f'accel = {CERTAIN[4:]}\naccel_unit = "m/s^2"\n'
        'truth_file = "gt.tsv"\ntruth_time = "Time"\ntruth_time_unit = "s"\nposition = ["X", "Y", "Z"]\nposition_unit = "mm"\n'
        f"rotation_matrix = {nine}\n"
    )
    assert convert(tmp_path / "imu.csv", tmp_path / "out.mcap", "--map", tmp_path / "map.toml").returncode == 0
    kept, truth = np.delete(np.arange(len(poses)), 7), read(tmp_path / "out.mcap").truth
    assert len(truth) == len(kept)
    np.testing.assert_allclose(np.abs((truth.q_wb_wxyz * poses.q_wb_wxyz[kept]).sum(axis=1)), 1.0, atol=1e-9)
    np.testing.assert_allclose(truth.p_wb, poses.p_wb[kept], atol=1e-9)
    text = (tmp_path / "map.toml").read_text()
    for other in ("'X'", "'Rot[5]'"):  # a column that is none of it, and one twice
        (tmp_path / "map.toml").write_text(text.replace("'Rot[0]'", other))
        done = convert(tmp_path / "imu.csv", tmp_path / "wrong.mcap", "--map", tmp_path / "map.toml")
        assert done.returncode == 4
        assert "matrix 1 of rotation_matrix is no rotation" in done.stderr
        assert not (tmp_path / "wrong.mcap").exists()


def test_structures_of_mat_with_their_own_times_come_in_on_these(convert, tmp_path):
    from scipy.io import savemat

    t_ns = T_NS[0] + 30_000_000 + 8_000_000 * np.arange(40)
    p, q_wxyz = RNG.normal(size=(40, 3)), np.tile([0.5, 0.1, 0.7, 0.5], (40, 1))
    imu = {"time_ns": T_NS, "angular_velocity": GYRO, "linear_acceleration": ACCEL}
    vicon = {"time": t_ns, "position": p, "q_wxyz": q_wxyz, "quality": np.arange(40.0)}
    savemat(tmp_path / "log.mat", {"imu": imu, "vicon": vicon})
    done = convert(tmp_path / "log.mat", tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    same(tmp_path / "out.mcap")
    recording = read(tmp_path / "out.mcap")
    assert np.array_equal(recording.truth.t_ns, t_ns)
    assert np.array_equal(recording.truth.p_wb, p)
    np.testing.assert_allclose(recording.truth.q_wb_wxyz, q_wxyz, atol=1e-12)
    assert np.array_equal(recording.scalars["/vicon_quality"].t_ns, t_ns)


@pytest.mark.parametrize("poses", ["xyzw in ns", "single columns in mm", "unknown order"])
def test_groups_of_hdf5_with_their_own_times_come_in_on_these(convert, tmp_path, poses):
    """An IMU, poses and GPS of three lengths; only what has no time of its own is left out, and named."""
    import h5py

    rng = np.random.default_rng(5)
    t_ns, gps_ns = T_NS[0] + 30_000_000 + 8_000_000 * np.arange(40), T_NS[0] + 200_000_000 * np.arange(7)
    p, latitude = rng.normal(size=(40, 3)), rng.normal(size=7)
    q_wxyz = rng.normal(size=(40, 4))
    q_wxyz /= np.linalg.norm(q_wxyz, axis=1, keepdims=True)
    in_mm = poses == "single columns in mm"
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for name, values, unit in (("time", T_NS, "ns"), ("gyro", GYRO, "rad/s"), ("accel", ACCEL, "m/s^2")):
            file[f"imu/{name}"] = values
            file[f"imu/{name}"].attrs["units"] = unit
        file["mocap/time"], file["mocap/position"] = t_ns if not in_mm else t_ns * 1e-9, p * 1000.0 if in_mm else p
        file["mocap/position"].attrs["units"] = "mm" if in_mm else "m"
        if in_mm:
            for axis, column in zip("wxyz", q_wxyz.T, strict=True):
                file[f"mocap/q{axis}"] = column
        else:
            file["mocap/quaternion_xyzw" if "xyzw" in poses else "mocap/orientation"] = q_wxyz[:, [1, 2, 3, 0]]
        file["gps/time"], file["gps/latitude"] = gps_ns, latitude
        file["levels"] = np.arange(17.0)
    done = convert(tmp_path / "log.h5", tmp_path / "out.mcap")
    assert done.returncode == 3
    (loss,) = [line for line in done.stderr.splitlines() if "left out" in line]
    assert loss.endswith("left out: levels")
    same(tmp_path / "out.mcap")
    recording = read(tmp_path / "out.mcap")
    assert np.array_equal(recording.scalars["/gps_latitude"].t_ns, gps_ns)
    assert np.array_equal(recording.scalars["/gps_latitude"].values[:, 0], latitude)
    if poses == "unknown order":
        assert "mocap/orientation has four columns of no certain order" in done.stderr
        assert not recording.truths
        assert np.array_equal(recording.scalars["/mocap_orientation_3"].values[:, 0], q_wxyz[:, 0])
        return
    truth = recording.truth
    np.testing.assert_allclose(truth.t_ns, t_ns, atol=500 if in_mm else 0)  # a double of this epoch keeps 240 ns
    np.testing.assert_allclose(truth.p_wb, p, atol=1e-12)
    np.testing.assert_allclose(np.abs((truth.q_wb_wxyz * q_wxyz).sum(axis=1)), 1.0, atol=1e-12)


@pytest.mark.parametrize("rates", ["gyro_uncalib", "gyro"])
def test_a_folder_of_ronin_gives_the_least_corrected_rates_and_an_estimate(convert, tmp_path, rates):
    import h5py

    seconds = 1000.0 + np.arange(COUNT) * 0.005
    q_wxyz = np.tile([0.5, 0.1, 0.7, 0.5], (COUNT, 1))
    (tmp_path / "a000_1").mkdir()
    (tmp_path / "a000_1" / "info.json").write_text("{}")
    with h5py.File(tmp_path / "a000_1" / "data.hdf5", "w") as file:
        arrays = {"time": seconds, "gyro": GYRO + 1.0, rates: GYRO, "acce": ACCEL, "linacce": ACCEL, "grav": ACCEL}
        for name, values in arrays.items():
            file[f"synced/{name}"] = values
        file["pose/tango_pos"] = GYRO * 100.0
        file["pose/tango_ori"] = q_wxyz
    done = convert(tmp_path / "a000_1", tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    assert ("Android has corrected" in done.stderr) == (rates == "gyro")
    recording = read(tmp_path / "out.mcap", truth="/estimate/pose")
    assert np.array_equal(recording.imu.gyro, GYRO)
    assert np.array_equal(recording.imu.accel, ACCEL)
    assert np.array_equal(recording.truths["/estimate/pose"].p_wb, GYRO * 100.0)
    np.testing.assert_allclose(recording.truths["/estimate/pose"].q_wb_wxyz, q_wxyz, atol=1e-12)
    assert not read(tmp_path / "out.mcap").truths


def test_hdf5_of_blackbird_gives_the_raw_rates_the_motion_capture_and_its_constants(convert, tmp_path):
    import h5py

    p, q_xyzw = GYRO * 100.0, np.tile([0.1, 0.7, 0.5, 0.5], (COUNT, 1))
    (tmp_path / "train").mkdir()
    with h5py.File(tmp_path / "train" / "data.hdf5", "w") as file:
        file["ts"] = 1000.0 + np.arange(COUNT) * 0.01
        for kind, bias in (("raw", 0.0), ("calib", 1.0)):
            file[f"gyro_{kind}"], file[f"accel_{kind}"] = GYRO - bias, ACCEL - bias
        file["traj_target"] = np.concatenate([p, q_xyzw, p], axis=1)
        file["gyro_bias"] = file["accel_bias"] = np.array([0.25, 0.5, 1.0])
    shutil.copytree(tmp_path / "train", tmp_path / "val")
    done = convert(tmp_path, tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "val.mcap").is_file()
    recording = read(tmp_path / "out" / "train.mcap")
    assert np.array_equal(recording.imu.gyro, GYRO)
    assert np.array_equal(recording.imu.accel, ACCEL)
    assert np.array_equal(recording.truth.p_wb, p)
    np.testing.assert_allclose(recording.truth.q_wb_wxyz, q_xyzw[:, [3, 0, 1, 2]], atol=1e-12)
    assert recording.metadata["imutool/constants"]["gyro_bias"] == "[0.25, 0.5, 1.0]"


def test_messages_written_as_a_table_keep_the_names_of_their_fields(convert, tmp_path):
    """Blackbird's layout: x, y, z repeat below angular_velocity and linear_acceleration."""
    names = "rosbagTimestamp,header,seq,stamp,secs,nsecs,frame_id,orientation,x,y,z,w,orientation_covariance,"
    names += "angular_velocity,x,y,z,angular_velocity_covariance,linear_acceleration,x,y,z,linear_acceleration_covariance"
    rows = []
    for n, (t, w, a) in enumerate(zip(T_NS.tolist(), GYRO.tolist(), ACCEL.tolist(), strict=True)):
        vectors = [f'"[0, 0]",,{v[0]!r},{v[1]!r},{v[2]!r}' for v in (w, a)]
        rows.append(f'{t},,{n},,{t // 10**9},{t % 10**9},body,,0.0,0.0,0.0,1.0,{",".join(vectors)},"[0, 0]"')
    (tmp_path / "imu.csv").write_text("\n".join([names, *rows]) + "\n")
    done = convert(tmp_path / "imu.csv", tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    same(tmp_path / "out.mcap")


@pytest.mark.parametrize("row", ["1,2,3", "1,2,3,4,5,6,7,8,9"])
def test_rows_of_another_width_are_losses(convert, tmp_path, row):
    """A longer one, as of two lines that a board wrote at once, says nothing of the others."""
    path = write_csv(tmp_path / "log.csv", CERTAIN, arrays())
    path.write_text(path.read_text() + f"{row}\n")
    done = convert(path, tmp_path / "out.mcap")
    assert done.returncode == 3
    assert "1 rows do not have 7 fields and are left out" in done.stderr
    same(tmp_path / "out.mcap")


def test_points_beside_decimal_commas_mark_thousands(tmp_path):
    counts = np.rint(ACCEL / 9.80665 * 1000.0).astype(int)
    rows = zip(*(np.rint(T_NS / 1e6).astype(int), *counts.T), GYRO, strict=True)
    lines = [
        ";".join([*(f"{each:,}".replace(",", ".") for each in whole), *(f"{w:.9f}".replace(".", ",") for w in gyro)])
        for *whole, gyro in rows
    ]
    header = "time (ms);acc_x (mg);acc_y (mg);acc_z (mg);gyro_x (rad/s);gyro_y (rad/s);gyro_z (rad/s)"
    (tmp_path / "log.csv").write_text("\n".join([header, *lines]) + "\n")
    (sequence,) = table.sequences(tmp_path / "log.csv")
    imu = table.read_sequence(sequence).imus["/imu0"]
    np.testing.assert_array_equal(imu.t_ns, np.rint(T_NS / 1e6).astype(int) * 1_000_000)
    np.testing.assert_allclose(imu.accel, counts * 9.80665e-3, rtol=1e-12)
    np.testing.assert_allclose(imu.gyro, GYRO, atol=1e-9)


def test_arrays_of_structures_are_groups_of_columns(tmp_path):
    kinds = [("t_ns", "i8"), ("gyro", "f8", 3), ("accel", [(axis, "f8") for axis in "xyz"])]
    array = np.zeros(COUNT, kinds)
    array["t_ns"], array["gyro"] = T_NS, GYRO
    for axis, values in zip("xyz", ACCEL.T, strict=True):
        array["accel"][axis] = values
    np.savez(tmp_path / "log.npz", imu=array, temperature=np.full(COUNT, 20.0))
    np.save(tmp_path / "log.npy", array)
    for name in ("log.npz", "log.npy"):
        (sequence,) = table.sequences(tmp_path / name)
        imu = table.read_sequence(sequence, mapping={"gyro_unit": "rad/s"}).imus["/imu0"]
        np.testing.assert_array_equal(imu.t_ns, T_NS)
        np.testing.assert_array_equal(np.hstack([imu.gyro, imu.accel]), np.hstack([GYRO, ACCEL]))


def test_counts_of_hdf5_are_scaled_by_the_scale_that_stands_beside_their_unit(tmp_path):
    import h5py

    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["time_ns"], gyro = T_NS, file.create_dataset("gyro", data=np.rint(GYRO * 2**10).astype(np.int16))
        gyro.attrs.update({"units": "rad/s", "scale": 2.0**-10})
        file.create_dataset("accel", data=ACCEL).attrs["units"] = "m/s^2"
    (sequence,) = table.sequences(tmp_path / "log.h5")
    np.testing.assert_array_equal(table.read_sequence(sequence).imus["/imu0"].gyro, np.rint(GYRO * 2**10) * 2.0**-10)


@pytest.mark.parametrize("kind", ["texts", "times of the day"])
def test_times_of_parquet_may_be_texts_or_times_of_the_day(tmp_path, kind):
    import pyarrow as pa
    import pyarrow.parquet as pq

    t_us = T_NS % (86_400 * 10**9) // 1000
    day = T_NS // (86_400 * 10**9) * 86_400 * 10**6 if kind == "texts" else 0
    texts = [f"{each}Z" for each in (t_us + day).astype("M8[us]").astype(str).tolist()]
    time = texts if kind == "texts" else pa.array(t_us, pa.time64("us"))
    names = [f"{sensor}_{axis}" for sensor in ("gyro", "accel") for axis in "xyz"]
    pq.write_table(
        pa.table({"time": time, **dict(zip(names, np.hstack([GYRO, ACCEL]).T, strict=True))}), tmp_path / "log.parquet"
    )
    (sequence,) = table.sequences(tmp_path / "log.parquet")
    imu = table.read_sequence(sequence, mapping={"gyro_unit": "rad/s"}).imus["/imu0"]
    np.testing.assert_array_equal(imu.t_ns, (t_us + day) * 1000)


def test_numbers_of_a_map_may_be_a_text_as_names_may() -> None:
    units = {"gyro_unit": "rad/s", "accel_unit": "g"}
    assert read_map({**units, "accel_offset": "510, -1,2.5"})["accel_offset"] == [510.0, -1.0, 2.5]
    for name, value, expected in (("accel_offset", "a,b,c", "numbers"), ("gyro", 3, "names of columns"), ("time", 1.5, "text")):
        with pytest.raises(ConfigError, match=f"mapping: {name} is .*; expected {expected}"):
            read_map({**units, name: value})
