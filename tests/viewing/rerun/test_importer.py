"""Rerun's importer of logs with an IMU: silent for every other file, and found and run by the real viewer."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
from support import saved_rrd, viewers

from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight
from imutool.viewing.rerun.importer import INCOMPATIBLE, rrd

ROOT = Path(__file__).parents[3]
COMMAND = [sys.executable, "-m", "imutool.viewing.rerun.importer"]
IMPORTED_S = 60.0


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with truth under a name that Rerun does not read itself."""
    path = tmp_path_factory.mktemp("importer") / "flight.imu"
    write(flight(3, duration_s=8.0), path)
    return path


def test_the_wheel_installs_it_under_the_name_that_rerun_looks_for() -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts["rerun-importer-imutool"] == "imutool.viewing.rerun.importer:main"


@pytest.mark.parametrize("content", [None, b"", b"\x89PNG\r\n\x1a\n", "no IMU"], ids=["missing", "empty", "png", "no IMU"])
def test_other_files_are_left_to_rerun_without_a_word(tmp_path: Path, content: bytes | str | None) -> None:
    path = tmp_path / "file.imu"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        from mcap.writer import Writer

        with path.open("wb") as file:
            writer = Writer(file)
            writer.start()
            writer.finish()
    done = subprocess.run([*COMMAND, path, "--recording-id", "r", "--unknown-option"], capture_output=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (INCOMPATIBLE, b"", b"")


def test_a_foreign_file_costs_no_heavy_import(tmp_path: Path) -> None:
    (tmp_path / "x.png").write_bytes(b"png")
    spy = "import sys\nfrom imutool.viewing.rerun.importer import main\ntry: main()\nexcept SystemExit: print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", spy, tmp_path / "x.png"], capture_output=True, text=True, check=True)
    assert not {"numpy", "rerun", "torch"} & set(done.stdout.split())


def test_it_logs_to_the_recording_that_rerun_proposes(log: Path, tmp_path: Path) -> None:
    content = rrd(log, "flight", "rec_7", "/below")
    assert content is not None
    (tmp_path / "out.rrd").write_bytes(content)
    entities = set(saved_rrd.read(tmp_path / "out.rrd"))
    assert {"/below/world/gt/path", "/below/error/orientation/raw", "/below/report"} <= entities
    assert b"rec_7" in content


def test_a_log_without_true_poses_is_shown_too(tmp_path: Path) -> None:
    made = flight(3, duration_s=4.0)
    write(replace(made, truths={}, scalars={}), tmp_path / "bare.imu")
    content = rrd(tmp_path / "bare.imu")
    assert content is not None
    (tmp_path / "out.rrd").write_bytes(content)
    entities = set(saved_rrd.read(tmp_path / "out.rrd"))
    assert "/world/raw/path" in entities
    assert not any(entity.startswith("/error") for entity in entities)


def test_the_real_viewer_finds_it_on_path_and_shows_what_it_adds(log: Path, tmp_path: Path) -> None:
    program = tmp_path / "rerun-importer-imutool"
    program.write_text(f'#!/bin/sh\nPYTHONPATH={os.environ.get("PYTHONPATH", ROOT)} exec {" ".join(COMMAND)} "$@"\n')
    program.chmod(0o755)
    with viewers.native(files=[log], path=f"{tmp_path}{os.pathsep}{os.defpath}") as viewer:
        end = time.monotonic() + IMPORTED_S
        while "Paths" not in viewer.views() and time.monotonic() < end:
            time.sleep(0.2)
        assert {"Paths", "Orientation error (deg)"} <= {name.partition(",")[0] for name in viewer.views()}
        (recording,) = viewer.client.get_state().recordings
        assert ":flight:" in recording.store_id
        assert viewers.saturated(viewer.picture(viewer.views()["Paths"])) > 200
