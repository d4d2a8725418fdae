"""Several recordings, or several sensors, in one .mat, .npz, HDF5, JSON or spreadsheet."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from support.spreadsheet import write_xlsx
from support.tables import write_csv

from imutool.converters import table
from imutool.converters._tables.recordings import parts as table_parts

COUNT, PARTS, RATE_HZ = 200, 3, 50.0
RNG = np.random.default_rng(7)
GYRO = np.round(RNG.normal(0.0, 0.1, (PARTS * COUNT, 3)), 5)
ACCEL = np.round(RNG.normal([0.0, 0.0, 9.81], 0.1, (PARTS * COUNT, 3)), 5)
PART = np.repeat(np.arange(1, PARTS + 1), COUNT)
T_S = np.tile(np.arange(COUNT) / RATE_HZ, PARTS)
LETTERS = np.array(["A", "B", "C"])[PART - 1]
PLACES = np.array(["wrist", "hip", "ankle"])[PART - 1]
NAMES = {"gyro_rads": GYRO, "accel_ms2": ACCEL}
Arrays = dict[str, Any]


def as_npz(path: Path, arrays: Arrays) -> None:
    with path.open("wb") as file:
        np.savez(file, **arrays)


def as_mat(path: Path, arrays: Arrays) -> None:
    """Texts as a cell array."""
    cells = {name: each.astype(object) if each.dtype.kind == "U" else each for name, each in arrays.items()}
    with path.open("wb") as file:
        scipy.io.savemat(file, cells)


def as_structure(path: Path, arrays: Arrays) -> None:
    """Texts as a matrix of characters."""
    with path.open("wb") as file:
        scipy.io.savemat(file, {"log": arrays})


def as_hdf5(path: Path, arrays: Arrays) -> None:
    with h5py.File(path, "w") as file:
        for name, each in arrays.items():
            file[f"log/{name}"] = each.astype("S") if each.dtype.kind == "U" else each


def as_records(path: Path, arrays: Arrays) -> None:
    """One array of records, whose fields may be vectors."""
    kinds = [(name, "S8" if each.dtype.kind == "U" else each.dtype, each.shape[1:]) for name, each in arrays.items()]
    records = np.zeros(PARTS * COUNT, kinds)
    for name, each in arrays.items():
        records[name] = each
    with h5py.File(path, "w") as file:
        file["log"] = records


def as_matlab_73(path: Path, arrays: Arrays) -> None:
    """Arrays lie the other way, and texts are cells that lead to codes of characters."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, each in arrays.items():
            if each.dtype.kind != "U":
                file[name] = np.atleast_2d(each).T
                continue
            cells = file.create_dataset(name, (1, len(each)), h5py.ref_dtype)
            for number, text in enumerate(each.tolist()):
                word = file.create_dataset(f"#refs#/{name}{number}", data=np.array([[ord(c)] for c in text], np.uint16))
                word.attrs["MATLAB_class"] = np.bytes_("char")
                cells[0, number] = word.ref


def as_json(path: Path, arrays: Arrays) -> None:
    path.write_text(json.dumps({name: each.tolist() for name, each in arrays.items()}))


def as_json_rows(path: Path, arrays: Arrays) -> None:
    rows = zip(*(each.tolist() for each in arrays.values()), strict=True)
    path.write_text(json.dumps([dict(zip(arrays, row, strict=True)) for row in rows]))


def spread(arrays: Arrays) -> Arrays:
    """Columns of one number each."""
    flat = {name: each for name, each in arrays.items() if each.ndim == 1}
    return flat | {f"{n}_{a}": each[:, k] for n, each in arrays.items() if each.ndim == 2 for k, a in enumerate("xyz")}


def as_xlsx(path: Path, arrays: Arrays) -> None:
    columns = spread(arrays)
    write_xlsx(path, {"Data": [[*columns], *zip(*(each.tolist() for each in columns.values()), strict=True)]})


WRITERS = [as_npz, as_mat, as_structure, as_hdf5, as_records, as_matlab_73, as_json, as_json_rows, as_xlsx]
ENDINGS = {as_npz: "npz", as_xlsx: "xlsx", as_json: "json", as_json_rows: "json", as_hdf5: "h5", as_records: "h5"}


def logs(path: Path, mapping: dict[str, Any] | None = None) -> dict[str, dict[str, tuple[list, list, list]]]:
    """Times and samples of every IMU of the logs of a file."""
    read = (table.read_sequence(each, mapping=mapping) for each in table.sequences(path))
    return {
        log.name: {topic: (imu.t_ns.tolist(), imu.gyro.tolist(), imu.accel.tolist()) for topic, imu in log.imus.items()}
        for log in read
    }


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize(
    ("labels", "mapping"),
    [
        ({"trial": PART, "time_s": T_S}, None),
        ({"session": LETTERS, "time_s": T_S}, None),
        ({"subject": LETTERS, "trial": PART}, {"rate_hz": RATE_HZ}),
        ({"placement": PLACES, "time_s": T_S}, None),
        ({"trial": PART, "sensor": np.arange(PARTS * COUNT) % 2, "time_s": T_S}, None),
    ],
)
def test_labels_beside_the_samples_give_the_logs_that_a_csv_gives(
    tmp_path: Path, write: Callable[[Path, Arrays], None], labels: Arrays, mapping: dict[str, Any] | None
) -> None:
    write(tmp_path / f"all.{ENDINGS.get(write, 'mat')}", labels | NAMES)
    (tmp_path / "csv").mkdir()
    columns = spread(labels | NAMES)
    expected = logs(write_csv(tmp_path / "csv" / "all.csv", [*columns], [*columns.values()]), mapping)
    assert len(expected) == (1 if "placement" in labels else PARTS)
    (source,) = tmp_path.glob("all.*")
    assert logs(source, mapping) == expected
    assert not table.read_sequence(table.sequences(source)[0], mapping=mapping).remarks.losses


def part(number: int, *, rows: int = COUNT, at: float = 0.0) -> Arrays:
    """Arrays of one recording."""
    chosen = np.flatnonzero(number == PART)[:rows]
    return {"time_s": T_S[chosen] + at} | {name: each[chosen] for name, each in NAMES.items()}


def assert_parts(path: Path, names: list[str], count: int = COUNT) -> None:
    """The recordings of a file are the parts, in order."""
    found = logs(path)
    assert [*found] == [f"{path.stem}_{name}" for name in names]
    for number, imus in enumerate(found.values(), 1):
        (t_ns, gyro, accel) = imus["/imu0"]
        rows = np.flatnonzero(number == PART)[: len(t_ns)]
        assert len(t_ns) > count / 2
        assert (gyro, accel) == (GYRO[rows].tolist(), ACCEL[rows].tolist())


@pytest.mark.parametrize("inner", ["", "imu/"])
@pytest.mark.parametrize("names", [["trial1", "trial2", "trial3"], ["stairs", "walk", "yoga"]])
def test_groups_of_hdf5_that_hold_a_recording_each_become_a_log_each(tmp_path: Path, names: list[str], inner: str) -> None:
    with h5py.File(tmp_path / "all.h5", "w") as file:
        file["about/mass_kg"] = 70.0
        for number, name in enumerate(names, 1):
            for array, values in part(number, rows=COUNT - 10 * number).items():
                file[f"{name}/{inner}{array}"] = values
    assert_parts(tmp_path / "all.h5", names)


def test_groups_in_groups_are_recordings_with_both_names(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "all.h5", "w") as file:
        for number, name in enumerate(["S1/run_1", "S1/run_2", "S2/run_1"], 1):
            for array, values in part(number, rows=COUNT - 10 * number).items():
                file[f"{name}/{array}"] = values
    found = logs(tmp_path / "all.h5")
    assert [*found] == ["all_S1_run_1", "all_S1_run_2", "all_S2"] or [*found] == [
        "all_S1_run_1",
        "all_S1_run_2",
        "all_S2_run_1",
    ]


def test_what_lies_beside_the_groups_of_recordings_is_in_every_one(tmp_path: Path) -> None:
    """As a time that all have, and numbers of the sensor."""
    with h5py.File(tmp_path / "all.h5", "w") as file:
        file["data/time_s"] = T_S[:COUNT]
        file["data/sensor/range"] = np.arange(3.0)
        for number, name in enumerate(["trial_1", "trial_2"], 1):
            for array, values in part(number).items():
                if array != "time_s":
                    file[f"data/{name}/{array}"] = values
    read = [table.read_sequence(each) for each in table.sequences(tmp_path / "all.h5")]
    assert [log.name for log in read] == ["all_trial_1", "all_trial_2"]
    for number, log in enumerate(read, 1):
        np.testing.assert_array_equal(log.imus["/imu0"].gyro, GYRO[number == PART])
        np.testing.assert_allclose(log.imus["/imu0"].t_ns, T_S[:COUNT] * 1e9)
        assert log.metadata["imutool/constants"] == {"data/sensor/range": "[0.0, 1.0, 2.0]"}


def structures(kind: str) -> Arrays:
    each = [part(number, rows=COUNT - 10 * number) for number in range(1, PARTS + 1)]
    match kind:
        case "nested structures":
            return {"data": {f"trial{number}": one for number, one in enumerate(each, 1)}}
        case "a structure's elements":
            array = np.zeros(PARTS, [(name, object) for name in each[0]])
            for number, one in enumerate(each):
                array[number] = tuple(one.values())
            return {"data": array}
        case "cells of structures":
            cells = np.empty(PARTS, object)
            cells[:] = each
            return {"data": cells}
        case _:
            arrays = {name: np.empty(PARTS, object) for name in each[0]}
            for number, one in enumerate(each):
                for name, values in one.items():
                    arrays[name][number] = values
            return arrays


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        ("nested structures", ["trial1", "trial2", "trial3"]),
        ("a structure's elements", ["data_1", "data_2", "data_3"]),
        ("cells of structures", ["data_1", "data_2", "data_3"]),
        ("cells of arrays", ["part_1", "part_2", "part_3"]),
    ],
)
def test_structures_and_cells_of_mat_become_a_log_each(tmp_path: Path, kind: str, names: list[str]) -> None:
    scipy.io.savemat(tmp_path / "all.mat", structures(kind))
    assert_parts(tmp_path / "all.mat", names)


def test_elements_of_a_structure_in_a_mat_of_73_become_a_log_each(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "all.mat", "w", userblock_size=512) as file:
        for name in part(1):
            cells = file.create_dataset(f"data/{name}", (PARTS, 1), h5py.ref_dtype)
            for number in range(PARTS):
                values = np.atleast_2d(part(number + 1, rows=COUNT - 10 * number)[name])
                cells[number, 0] = file.create_dataset(f"#refs#/{name}{number}", data=values.T).ref
    assert_parts(tmp_path / "all.mat", ["data_1", "data_2", "data_3"])


@pytest.mark.parametrize("kind", ["columns", "rows", "list"])
def test_json_objects_that_hold_a_recording_each_become_a_log_each(tmp_path: Path, kind: str) -> None:
    each = [{n: v.tolist() for n, v in part(k, rows=COUNT - 10 * k).items()} for k in range(1, PARTS + 1)]
    if kind == "rows":
        each = [[dict(zip(one, row, strict=True)) for row in zip(*one.values(), strict=True)] for one in each]
    names = [f"trial{number}" for number in range(1, PARTS + 1)]
    document = {"trials": each} if kind == "list" else dict(zip(names, each, strict=True))
    (tmp_path / "all.json").write_text(json.dumps(document))
    assert_parts(tmp_path / "all.json", ["trials_0", "trials_1", "trials_2"] if kind == "list" else names)


def test_sheets_of_a_spreadsheet_with_a_time_of_their_own_become_a_log_each(tmp_path: Path) -> None:
    sheets = {}
    for number, name in enumerate(["Run 1", "Run 2", "Run 3"], 1):
        columns = spread(part(number))
        sheets[name] = [[*columns], *zip(*(each.tolist() for each in columns.values()), strict=True)]
    write_xlsx(tmp_path / "all.xlsx", sheets)
    assert_parts(tmp_path / "all.xlsx", ["Run_1", "Run_2", "Run_3"])


@pytest.mark.parametrize("names", [["imu1", "imu2", "imu3"], ["wrist", "hip", "left_foot"], ["d422", "d423", "xa01"]])
def test_groups_of_sensors_that_share_a_time_are_imus_of_one_log(tmp_path: Path, names: list[str]) -> None:
    with h5py.File(tmp_path / "all.h5", "w") as file:
        for number, name in enumerate(names, 1):
            for array, values in part(number, rows=COUNT - number).items():
                file[f"{name}/{array}"] = values
    (imus,) = logs(tmp_path / "all.h5").values()
    assert {*imus} == {f"/{name}/imu" for name in names}


def test_sensors_of_a_clock_in_common_that_start_late_are_imus_of_one_log(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "all.h5", "w") as file:
        for number, name in enumerate(["D422", "XA01"], 1):
            for array, values in part(number, rows=COUNT // number, at=1.7e9 + number).items():
                file[f"{name}/{array}"] = values
    (imus,) = logs(tmp_path / "all.h5").values()
    assert {*imus} == {"/d422/imu", "/xa01/imu"}


def test_each_recording_keeps_its_own_poses(tmp_path: Path) -> None:
    """Also those of one length and one time, whose names say nothing."""
    with h5py.File(tmp_path / "all.h5", "w") as file:
        for number, name in enumerate(["a", "b"], 1):
            for array, values in part(number).items():
                file[f"{name}/imu/{array}"] = values
            turns = np.linspace(0.0, number, COUNT // 2)
            file[f"{name}/vicon/time_s"] = T_S[:COUNT:2]
            file[f"{name}/vicon/position"] = np.full((COUNT // 2, 3), float(number))
            zeros = np.zeros(COUNT // 2)
            file[f"{name}/vicon/quat_wxyz"] = np.stack([np.cos(turns), zeros, zeros, np.sin(turns)], axis=1)
    read = {each.name: table.read_sequence(each) for each in table.sequences(tmp_path / "all.h5")}
    assert [*read] == ["all_a", "all_b"]
    for number, log in enumerate(read.values(), 1):
        assert log.kinds == {"/ground_truth/pose": "truth"}
        np.testing.assert_array_equal(log.poses["/ground_truth/pose"].p_wb, np.full((COUNT // 2, 3), float(number)))


def test_poses_of_another_rate_with_a_trial_of_their_own_go_to_its_log(tmp_path: Path) -> None:
    of_poses = np.repeat(np.arange(1, PARTS + 1), COUNT // 2)
    turns = np.linspace(0.0, 3.0, len(of_poses))
    zeros = np.zeros(len(of_poses))
    with h5py.File(tmp_path / "all.h5", "w") as file:
        for name, values in ({"trial": PART, "time_s": T_S} | NAMES).items():
            file[f"imu/{name}"] = values
        file["mocap/trial"] = of_poses
        file["mocap/time_s"] = np.tile(T_S[:COUNT:2], PARTS)
        file["mocap/position"] = np.tile(of_poses[:, None], (1, 3)).astype(float)
        file["mocap/quat_wxyz"] = np.stack([np.cos(turns), zeros, zeros, np.sin(turns)], axis=1)
    read = {each.name: table.read_sequence(each) for each in table.sequences(tmp_path / "all.h5")}
    assert [*read] == ["all_trial_1", "all_trial_2", "all_trial_3"]
    for number, log in enumerate(read.values(), 1):
        np.testing.assert_array_equal(log.poses["/ground_truth/pose"].p_wb, np.full((COUNT // 2, 3), float(number)))


def test_a_folder_finds_files_that_hold_several_recordings(tmp_path: Path) -> None:
    as_npz(tmp_path / "one.npz", {"trial": PART, "time_s": T_S} | NAMES)
    scipy.io.savemat(tmp_path / "two.mat", structures("nested structures"))
    assert sorted(each.name for each in table.sequences(tmp_path)) == [
        *(f"one_trial_{n}" for n in (1, 2, 3)),
        *(f"two_trial{n}" for n in (1, 2, 3)),
    ]


@pytest.mark.parametrize("write", [as_npz, as_mat, as_hdf5])
def test_arrays_that_can_be_of_one_recording_alone_are_not_read_to_list_it(
    tmp_path: Path, write: Callable[[Path, Arrays], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"one.{ENDINGS.get(write, 'mat')}"
    write(path, {"time_s": T_S[:COUNT]} | {name: each[:COUNT] for name, each in NAMES.items()})
    monkeypatch.setattr(table_parts, "load", lambda *_: pytest.fail("read"))
    assert [each.name for each in table.sequences(path)] == ["one"]
    write(path, {"trial": PART} | NAMES)
    with pytest.raises(pytest.fail.Exception, match="read"):
        table.sequences(path)
