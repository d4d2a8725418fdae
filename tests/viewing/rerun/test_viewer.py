"""A viewer opens, or the next best thing is done at once and said; nothing half-written is left behind."""

from __future__ import annotations

import errno
import os
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from rerun.chunk import RrdReader
from support.saved_rrd import entities

from imutool.errors import ConfigError
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import connect, scene, viewer

LONG_S, NO_WAIT_S = 60.0, 30.0  # for a viewer that does not listen yet; no wait for it, on a machine however busy
SETTLED_S = 0.5


@pytest.fixture
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("DISPLAY", ":99")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(logs: list[RunData]) -> float:
    """How long it takes until it is known that no viewer opens; nothing is sent to one that is about to die."""

    def never(*_: object, **__: object) -> None:
        raise AssertionError("sent to a viewer that does not live")

    start = time.monotonic()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(connect, "send", never)
        patch.setattr(viewer, "START_TIMEOUT_S", LONG_S)
        with pytest.raises(ConfigError):
            viewer.open_viewer(logs)
    return time.monotonic() - start


def test_without_a_display_it_saves_at_once_and_says_how_to_open(data: RunData, here: Path, no_display: None) -> None:
    said = viewer.show([data]).said
    assert said == (
        "There is no display here. Saved flight_3.rrd. Open with: rerun flight_3.rrd, or use a browser: imutool view LOG --web"
    )
    assert entities(here / "flight_3.rrd") >= {"/world/raw/path"}


def test_a_viewer_without_a_display_is_refused_at_once(data: RunData, no_display: None) -> None:
    assert refused([data]) < NO_WAIT_S
    with pytest.raises(ConfigError, match="no display"):
        viewer.open_viewer([data])


@pytest.mark.parametrize("binary", ["/bin/false", "/nowhere/rerun"])
def test_a_viewer_that_does_not_start_is_given_up_at_once_and_the_log_saved(
    data: RunData, here: Path, display: None, monkeypatch: pytest.MonkeyPatch, binary: str
) -> None:
    monkeypatch.setattr(viewer, "binary", lambda: Path(binary))
    assert refused([data]) < NO_WAIT_S
    said = viewer.show([data]).said
    assert said.startswith("The viewer ")
    assert "Saved flight_3.rrd" in said
    with pytest.raises(ConfigError, match="the viewer"):
        viewer.open_viewer([data])


def test_the_real_viewer_that_finds_no_window_is_noticed_though_it_listened(
    data: RunData, here: Path, display: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DISPLAY", ":987")  # which nobody serves
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(viewer, "DIES_WITHIN_S", LONG_S)
    assert refused([data]) < NO_WAIT_S
    said = viewer.show([data]).said
    assert said.startswith("The viewer stopped at once")
    assert "Saved flight_3.rrd" in said


def test_no_wait_for_what_dies_is_longer_than_two_seconds() -> None:
    assert viewer.DIES_WITHIN_S < 2.0


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, display: None) -> Iterator[Callable[[], Path]]:
    """A viewer without a window: Rerun's own server, which writes all it receives to a file; call it to end it."""
    script, received = tmp_path / "viewer", tmp_path / "received.rrd"
    script.write_text(
        f"#!/bin/sh\n"
        f'while [ $# -gt 0 ]; do [ "$1" = --port ] && port=$2; [ "$1" = --bind ] && bind=$2; shift; done\n'
        f'exec {viewer.binary()} --save {received} --bind "$bind" --port "$port"\n'
    )
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(viewer, "binary", lambda: script)
    monkeypatch.setattr(viewer, "START_TIMEOUT_S", LONG_S)  # on a busy machine

    def end() -> Path:
        process, size, still_s = viewer.VIEWERS[-1], -1, 0.0
        while still_s < SETTLED_S and process.poll() is None:  # it writes behind what it has received
            time.sleep(0.1)
            now = received.stat().st_size if received.exists() else 0
            size, still_s = now, still_s + 0.1 if now == size and now else 0.0
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.wait(10.0)
        return received

    yield end
    end()


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # the stand-in is interrupted, which leaves none
def test_an_opened_viewer_receives_everything_with_the_layout(
    data: RunData, stand_in: Callable[[], Path], tmp_path: Path
) -> None:
    shown = viewer.show([data])
    assert (shown.how, shown.said) == ("viewer", "The viewer is open.")
    received = stand_in()
    scene.save([data], tmp_path / "saved.rrd")
    assert entities(received) == entities(tmp_path / "saved.rrd")
    assert len(RrdReader(received).blueprints()) == 1


def test_a_viewer_listens_on_this_machine_only(stand_in: Callable[[], Path]) -> None:
    started = viewer.start()
    lines = Path("/proc/net/tcp").read_text(encoding="ascii").splitlines()[1:]
    port = int(started.peer.url.rsplit(":", 1)[1].partition("/")[0])
    listening = [words[1] for words in map(str.split, lines) if words[3] == "0A" and words[1].endswith(f":{port:04X}")]
    assert listening == [f"0100007F:{port:04X}"]
    started.process.terminate()


def test_several_logs_are_one_file(data: RunData, tmp_path: Path) -> None:
    other = replace(data, name="other log")
    shown = scene.save([data, other], tmp_path)
    assert shown.place == str(tmp_path / "flight_3_and_1_more.rrd")
    found = entities(Path(shown.place))
    assert found >= {"/run/flight_3/imu/gyro/raw", r"/run/other\ log/imu/gyro/raw"}


def test_an_existing_file_is_kept_unless_told_otherwise(data: RunData, tmp_path: Path) -> None:
    target = tmp_path / "a.rrd"
    target.write_bytes(b"mine")
    with pytest.raises(ConfigError, match="exists"):
        scene.save([data], target)
    assert target.read_bytes() == b"mine"
    scene.save([data], target, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["a.rrd"]
    assert entities(target)


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")])
def test_a_failure_on_the_way_leaves_the_old_file_and_no_other(
    data: RunData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: BaseException
) -> None:
    target = tmp_path / "a.rrd"
    target.write_bytes(b"mine")

    def fail(_: int) -> None:
        raise failure

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises((KeyboardInterrupt, ConfigError)):
        scene.save([data], target, overwrite=True)
    assert target.read_bytes() == b"mine"
    assert [p.name for p in tmp_path.iterdir()] == ["a.rrd"]


def test_a_name_that_leads_elsewhere_stays_here(data: RunData, here: Path, no_display: None) -> None:
    shown = viewer.show([replace(data, name="../../etc/x y<b>")])
    assert shown.place == "______etc_x_y_b_.rrd"
    assert [path.name for path in here.iterdir()] == [shown.place]


def test_reruns_own_verifier_accepts_the_file(data: RunData, tmp_path: Path) -> None:
    saved = scene.save([data], tmp_path / "a.rrd").place
    run = subprocess.run([str(viewer.binary()), "rrd", "verify", saved], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def test_a_missing_rerun_says_how_to_get_it(data: RunData, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ConfigError, match=r"pip install 'imutool\[view\]'"):
        viewer.show([data])


def test_no_log_is_refused() -> None:
    with pytest.raises(ConfigError, match="no log"):
        viewer.show([])
