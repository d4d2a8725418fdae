"""Tables of IMUs and of true poses in folders of their own, and accelerometers of other tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.io
from scipy.spatial.transform import Rotation
from support.tables import write_csv

from imutool.api.logs import convert
from imutool.converters import table
from imutool.errors import ConfigError
from imutool.mcap_io.read import read

COUNT = 500
T_S = 1_600_000_000.0 + np.arange(COUNT) / 100.0
GYRO = np.stack([np.sin(np.arange(COUNT) / k) for k in (30.0, 47.0, 71.0)], axis=1)
IMU_NAMES = ["time_s", *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
POSE_NAMES = ["time_s", *(f"p_{a}" for a in "xyz"), *(f"q{a}" for a in "wxyz")]


def turns() -> Rotation:
    """Attitude that turns as GYRO says."""
    found = [Rotation.identity()]
    for rate in GYRO[:-1]:
        found.append(found[-1] * Rotation.from_rotvec(rate / 100.0))
    return Rotation.concatenate(found)


R_WB = turns()
ACCEL = R_WB.inv().apply([0.0, 0.0, 9.80665])


def write_imu(path: Path, number: int) -> None:
    """An IMU that ends so many samples before the others."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_csv(path, IMU_NAMES, [T_S[: COUNT - number], *GYRO[: COUNT - number].T, *ACCEL[: COUNT - number].T])


def write_poses(path: Path, number: int) -> None:
    """Poses that stay at x = number."""
    path.parent.mkdir(parents=True, exist_ok=True)
    position = np.tile([float(number), 0.0, 0.0], (COUNT, 1))
    write_csv(path, POSE_NAMES, [T_S, *position.T, *R_WB.as_quat()[:, [3, 0, 1, 2]].T])


def found_in(folder: Path) -> dict[str, tuple[int, float | None]]:
    """Samples of each log, and where its true poses stay."""
    logs = (table.read_sequence(each) for each in table.sequences(folder))
    return {log.name: (len(log.imus["/imu0"]), next((p.p_wb[0, 0] for p in log.poses.values()), None)) for log in logs}


@pytest.mark.parametrize(
    ("imu", "poses", "names"),
    [
        ("imu/walk{}.csv", "mocap/walk{}.csv", ["walk1", "walk2", "walk3"]),
        ("imu/{}.csv", "gt/{}.csv", ["1", "2", "3"]),
        ("IMU/rec-0{}.csv", "vicon/track_{}.csv", ["rec-01", "rec-02", "rec-03"]),
        ("imu_data/walk{}_imu.csv", "ground_truth/walk{}_gt.csv", ["walk1", "walk2", "walk3"]),
        ("imu/person/walk{}.csv", "mocap/person/walk{}.csv", ["person_walk1", "person_walk2", "person_walk3"]),
    ],
)
def test_files_of_two_folders_pair_by_name_or_number(tmp_path: Path, imu: str, poses: str, names: list[str]) -> None:
    for number in (1, 2, 3):
        write_imu(tmp_path / "day" / imu.format(number), number)
        write_poses(tmp_path / "day" / poses.format(number), number)
    assert found_in(tmp_path) == {name: (COUNT - number, float(number)) for number, name in enumerate(names, 1)}


def test_a_file_without_poses_is_a_log_beside_those_that_have_some(tmp_path: Path) -> None:
    for number in (1, 2, 3):
        write_imu(tmp_path / "imu" / f"a{number}.csv", number)
    write_poses(tmp_path / "vicon" / "b2.csv", 2)
    write_poses(tmp_path / "vicon" / "b7.csv", 7)
    assert found_in(tmp_path) == {"a1": (COUNT - 1, None), "a2": (COUNT - 2, 2.0), "a3": (COUNT - 3, None)}


def test_a_pair_in_two_folders_has_the_name_of_the_folder_around_them(tmp_path: Path) -> None:
    write_imu(tmp_path / "walk" / "imu" / "data.csv", 1)
    write_poses(tmp_path / "walk" / "gt" / "data.csv", 4)
    write_imu(tmp_path / "run" / "imu" / "data.csv", 2)
    write_poses(tmp_path / "run" / "gt" / "poses.csv", 5)
    assert found_in(tmp_path) == {"run": (COUNT - 2, 5.0), "walk": (COUNT - 1, 4.0)}


def test_numbered_poses_are_of_the_imu_of_their_number(tmp_path: Path) -> None:
    """Also in one folder, where poses without a number are those of all IMUs."""
    write_imu(tmp_path / "two" / "imu_1.csv", 1)
    write_imu(tmp_path / "two" / "imu_2.csv", 2)
    write_poses(tmp_path / "two" / "gt_2.csv", 2)
    assert found_in(tmp_path) == {"imu_1": (COUNT - 1, None), "imu_2": (COUNT - 2, 2.0)}


def test_raw_counts_and_matrices_of_upenn_keep_their_poses_by_one_map(tmp_path: Path) -> None:
    """`imu/imuRaw1.mat` and `vicon/viconRot1.mat`; of the last the poses are not given out."""
    counts = np.concatenate([np.rint(ACCEL.T * 10.4) + 510.0, np.rint(GYRO.T / 0.0171) + 373.0])
    for number in (1, 2, 13):
        for kind, arrays in {
            "imu/imuRaw": {"ts": T_S[None], "vals": counts.astype(np.uint16)},
            "vicon/viconRot": {"ts": T_S[None] + number * 1e-3, "rots": np.moveaxis(R_WB.as_matrix(), 0, 2)},
        }.items():
            path = tmp_path / "trainset" / f"{kind}{number}.mat"
            path.parent.mkdir(parents=True, exist_ok=True)
            scipy.io.savemat(path, arrays)
    (tmp_path / "trainset" / "vicon" / "viconRot13.mat").unlink()
    (tmp_path / "map.toml").write_text(
        """
time = "imu/ts"
time_unit = "s"
accel = ["imu/vals[0]", "imu/vals[1]", "imu/vals[2]"]
accel_unit = "m/s^2"
accel_offset = 510
accel_scale = 0.0961538
gyro = ["imu/vals[3]", "imu/vals[4]", "imu/vals[5]"]
gyro_unit = "rad/s"
gyro_offset = 373
gyro_scale = 0.0171
truth_time = "ground_truth/ts"
truth_time_unit = "s"
rotation_matrix = "ground_truth/rots"
pose_kind = "truth"
"""
    )
    convert(tmp_path / "trainset", tmp_path / "out", mapping=tmp_path / "map.toml")
    logs = {path.stem: read(path) for path in sorted((tmp_path / "out").glob("*.mcap"))}
    assert [*logs] == ["imuRaw1", "imuRaw13", "imuRaw2"]
    assert not logs["imuRaw13"].truths
    for number in (1, 2):
        log = logs[f"imuRaw{number}"]
        (poses,) = log.truths.values()
        assert abs(poses.t_ns[0] - log.imu.t_ns[0] - number * 1_000_000) < 1000
        np.testing.assert_allclose(log.imu.gyro, GYRO, atol=0.0086)


def test_the_accelerometer_of_another_table_is_not_taken_for_that_of_the_imu(tmp_path: Path) -> None:
    """Even if gravity shows in that alone: the IMU's own is in counts."""
    names = ["time_s", *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a}" for a in "xyz")]
    write_csv(tmp_path / "imu.csv", names, [T_S, *GYRO.T, *np.rint(77.0 * ACCEL.T)])
    write_csv(tmp_path / "phone.csv", ["time_s", *(f"acc_{a}" for a in "xyz")], [T_S, *ACCEL.T])
    with pytest.raises(ConfigError, match="the names of the columns state no unit of the accel") as refused:
        found_in(tmp_path)
    assert 'accel = ["imu/acc_x", "imu/acc_y", "imu/acc_z"]' in str(refused.value.fix)
