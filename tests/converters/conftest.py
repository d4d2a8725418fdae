"""Small made-up sequences in the layouts of the three data sets, as text, so that a test can spoil one line of one file."""

from __future__ import annotations

import io
import tarfile
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

Files = dict[str, bytes]  # by name below the sequence: "mav0/imu0/data.csv"

START_NS = 1403636579758560000  # no float64 holds it exactly
STEP_NS = 5_000_000
ROWS = 40
IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1]"
    ",a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
POSE_HEADER = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
STATE_HEADER = (
    POSE_HEADER + ", v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]"
    ", b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1]"
    ", b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
)
PNG = b"\x89PNG\r\n\x1a\n"


def table(header: str, rows: list[str]) -> bytes:
    return ("\n".join([header, *rows]) + "\n").encode()


def imu_rows(stamps: list[str]) -> list[str]:
    return [f"{stamp},0.1,-0.2,0.{n:03d},9.{n:03d},0.5,-0.25" for n, stamp in enumerate(stamps)]


def pose_rows(stamps: list[str]) -> list[str]:
    return [f"{stamp},{n}.5,-1.5,0.25,0.6,0.8,0.0,0.0" for n, stamp in enumerate(stamps)]


def stamps(count: int = ROWS) -> list[str]:
    return [str(START_NS + n * STEP_NS) for n in range(count)]


def euroc_files() -> Files:
    state = [row + ",1.0,2.0,3.0,0.01,0.02,0.03,0.1,0.2,0.3" for row in pose_rows(stamps())]
    images = [(int(stamp), PNG + bytes([n, 0, 255]) * (n + 1)) for n, stamp in enumerate(stamps(5))]
    listed = table("#timestamp [ns],filename", [f"{t},{t}.png" for t, _ in images])
    return {
        "mav0/body.yaml": b"comment: made up\n",
        "mav0/imu0/data.csv": table(IMU_HEADER, imu_rows(stamps())),
        "mav0/imu0/sensor.yaml": b"sensor_type: imu\ngyroscope_noise_density: 1.6968e-04\n",
        "mav0/state_groundtruth_estimate0/data.csv": table(STATE_HEADER, state),
        "mav0/leica0/data.csv": table("#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]", ["1,2,3,4"]),
        "mav0/cam0/data.csv": listed,
        **{f"mav0/cam0/data/{t}.png": image for t, image in images},
    }


def tum_vi_files() -> Files:
    return {
        "mav0/imu0/data.csv": table(IMU_HEADER, imu_rows(stamps())),
        "mav0/mocap0/data.csv": table(POSE_HEADER, pose_rows(stamps())),
    }


def fetch_files() -> Files:
    exact = [f"1.{str(START_NS + n * STEP_NS)[1:]}e+18" for n in range(ROWS)]
    return {
        "mav0/imu0/data.csv": table("# timestamp, wx, wy, wz, ax, ay, az", imu_rows(exact)),
        "mav0/mocap0/data.csv": table("# timestamp, x, y, z, qw, qx, qy, qz", pose_rows(exact)),
    }


MADE: dict[str, Callable[[], Files]] = {"euroc": euroc_files, "tum_vi": tum_vi_files, "fetch": fetch_files}


class Maker:
    """Writes sequences as folders and archives."""

    def __init__(self, folder: Path) -> None:
        self.tmp = folder

    def files(self, dataset: str) -> Files:
        return MADE[dataset]()

    def folder(self, name: str, files: Mapping[str, bytes]) -> Path:
        for member, content in files.items():
            path = self.tmp / name / member
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        return self.tmp / name

    def zip(self, name: str, files: Mapping[str, bytes]) -> Path:
        with zipfile.ZipFile(self.tmp / name, "w", zipfile.ZIP_DEFLATED) as archive:
            for member, content in files.items():
                archive.writestr(member, content)
        return self.tmp / name

    def tar(self, name: str, files: Mapping[str, bytes], *, extra: tuple[tarfile.TarInfo, ...] = ()) -> Path:
        with tarfile.open(self.tmp / name, "w:gz" if name.endswith("gz") else "w") as archive:
            for member in extra:
                archive.addfile(member)
            for member_name, content in files.items():
                member = tarfile.TarInfo(member_name)
                member.size = len(content)
                archive.addfile(member, io.BytesIO(content))
        return self.tmp / name


@pytest.fixture
def make(tmp_path: Path) -> Maker:
    folder = tmp_path / "source"
    folder.mkdir()
    return Maker(folder)


@pytest.fixture
def convert(imutool, tmp_path: Path) -> Callable[..., Any]:
    """Runs `imutool convert` with some arguments."""
    return lambda *words: imutool("convert", *words, cwd=tmp_path)
