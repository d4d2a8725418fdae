"""A debiasing that is watched shows what is shown afterwards, and whatever becomes of the watching, the log is the same."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import saved_rrd

from imutool.cleaning import rows
from imutool.debiasing import BlockCallback, DebiasedBlock, debias
from imutool.errors import ConfigError
from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight
from imutool.viewing.model.load_view import load
from imutool.viewing.rerun import live, scene, viewer

SECONDS, BLOCK = 12.0, 250  # samples at 200 Hz, as from a log with images
PATH_M = 1e-4  # single precision, in which Rerun keeps positions, over some hundred metres
SERVER_STARTS_S = 10.0
DIES_S = 60.0  # for a viewer that finds no window, on a machine however busy


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log without truth."""
    path = tmp_path_factory.mktemp("live") / "log.mcap"
    write(replace(flight(5, duration_s=SECONDS), truths={}, scalars={}), path)
    return path


@pytest.fixture(scope="module")
def unwatched(log: Path) -> Path:
    """The same log debiased while nobody looks."""
    path = log.with_name("unwatched.mcap")
    debias(log, path)
    return path


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """One that takes what a viewer takes."""
    port = viewer.free_port()
    process = viewer.run("--save", str(tmp_path / "received.rrd"), "--port", str(port))
    assert viewer.listens(process, port, SERVER_STARTS_S)
    yield str(port), process
    process.kill()
    process.wait()


def in_blocks(watch: BlockCallback) -> BlockCallback:
    """What a log whose chunks hold few IMU messages would tell."""

    def cut(block: DebiasedBlock) -> None:
        for first in range(0, len(block.bias), BLOCK):
            part = slice(first, first + BLOCK)
            watch(DebiasedBlock(block.topic, rows(block.batch, part), block.bias[part], block.std[part]))

    return cut


def watched(log: Path, folder: Path, **options: Any) -> tuple[Path, live.Live]:
    """The debiased log, and who watched it."""
    out = folder / "out.mcap"
    with live.live_view("log", instead=folder / "instead.rrd", **options) as watch:
        debias(log, out, watch=in_blocks(watch))
    return out, watch


def test_what_is_watched_is_what_is_shown_afterwards(log: Path, unwatched: Path, tmp_path: Path) -> None:
    watched(log, tmp_path, save=tmp_path / "live.rrd")
    data = load(unwatched)
    (tmp_path / "after.rrd").write_bytes(scene.rrd([data], source=False))
    seen, after = saved_rrd.read(tmp_path / "live.rrd"), saved_rrd.read(tmp_path / "after.rrd")
    curves = [f"/imu/{kind}/{role}" for kind in ("gyro", "accel") for role in ("raw", "debiased")]
    curves += [f"/bias/{kind}/{name}" for kind in ("gyro", "accel") for name in ("estimated", "sigma")]
    for path in curves:
        name = "Scalars:scalars"
        np.testing.assert_allclose(seen[path].numbers(name), after[path].numbers(name), rtol=1e-12, atol=1e-12, err_msg=path)
        for timeline in saved_rrd.TIMELINES:
            np.testing.assert_array_equal(seen[path].times(name, timeline), after[path].times(name, timeline), err_msg=path)
        for style in ("SeriesLines:names", "SeriesLines:colors", "SeriesLines:widths"):
            assert seen[path].static[style] == after[path].static[style], (path, style)
    for trace, role in zip(data.traces, ("raw", "debiased"), strict=True):
        body = seen[f"/world/{role}/body"]
        at = np.searchsorted(trace.path.t_ns, body.times("Transform3D:translation", "ros2_timestamp"))
        assert len(at) > SECONDS / 0.06
        assert at[-1] == len(trace.path) - 1
        np.testing.assert_allclose(body.numbers("Transform3D:translation"), trace.path.p_wb[at], atol=PATH_M, rtol=0.0)
        strips = [
            np.array(strip) for row in seen[f"/world/{role}/path"].rows("LineStrips3D:strips").to_pylist() for strip in row
        ]
        ends = np.array([strip[-1] for strip in strips])
        np.testing.assert_array_equal(np.array([strip[0] for strip in strips])[1:], ends[:-1])  # blocks join
        np.testing.assert_array_equal(ends[-1], body.numbers("Transform3D:translation")[-1])


def test_the_log_is_the_same_whether_somebody_watches_or_not(log: Path, unwatched: Path, tmp_path: Path) -> None:
    out, _ = watched(log, tmp_path, save=tmp_path / "live.rrd")
    assert out.read_bytes() == unwatched.read_bytes()


def test_a_viewer_that_goes_away_is_said_once_and_neither_log_nor_file_suffer(
    log: Path,
    unwatched: Path,
    tmp_path: Path,
    server: tuple[str, subprocess.Popen[bytes]],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    port, process = server
    seen = live.Live.__call__
    blocks = []

    def until_the_third(self: live.Live, block: DebiasedBlock) -> None:
        blocks.append(block)
        if len(blocks) == 3:
            process.kill()
            process.wait()
        seen(self, block)

    monkeypatch.setattr(live.Live, "__call__", until_the_third)
    with caplog.at_level(logging.WARNING, "imutool"):
        out, watch = watched(log, tmp_path, connect_to=port, save=tmp_path / "live.rrd")
    assert [record.getMessage() for record in caplog.records] == ["The viewer is gone; debiasing goes on without it"]
    assert [one.how for one in watch.shown] == ["rrd"]
    assert out.read_bytes() == unwatched.read_bytes()
    assert len(saved_rrd.read(tmp_path / "live.rrd")["/imu/gyro/raw"].numbers("Scalars:scalars")) == sum(
        len(b.bias) for b in blocks
    )


def test_what_cannot_be_shown_does_not_stop_the_debiasing(
    log: Path, unwatched: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(_: object) -> None:
        raise ValueError("no path")

    monkeypatch.setattr(live.paths, "path_pieces", fail)
    with caplog.at_level(logging.WARNING, "imutool"):
        out, watch = watched(log, tmp_path, save=tmp_path / "live.rrd")
    assert len(caplog.records) == 1
    assert "no path" in caplog.text
    assert out.read_bytes() == unwatched.read_bytes()
    assert watch.shown == []
    assert not (tmp_path / "live.rrd").exists()


@pytest.fixture
def lost_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the .rrd file is lost, as on a full disk."""
    finish = live.Live.finish

    def and_lose_the_end(self: live.Live) -> None:
        finish(self)
        (partial,) = tmp_path.glob(".live.rrd.*.partial")
        os.truncate(partial, partial.stat().st_size // 2)

    monkeypatch.setattr(live.Live, "finish", and_lose_the_end)


@pytest.mark.usefixtures("lost_end")
def test_a_file_that_lost_its_end_is_no_file(
    log: Path, unwatched: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "imutool"):
        out, watch = watched(log, tmp_path, save=tmp_path / "live.rrd")
    assert len(caplog.records) == 1
    assert "could not be written completely" in caplog.text
    assert (watch.shown, [path.name for path in tmp_path.iterdir()]) == ([], ["out.mcap"])
    assert out.read_bytes() == unwatched.read_bytes()


@pytest.mark.usefixtures("lost_end")
@pytest.mark.parametrize(
    "words", [["debias", "{}", "out.mcap", "--save-view", "live.rrd"], ["live", "{}", "--speed", "100", "--save", "live.rrd"]]
)
def test_a_command_without_its_file_ends_with_a_code(
    log: Path, tmp_path: Path, imutool: Callable[..., subprocess.CompletedProcess[str]], words: list[str]
) -> None:
    done = imutool(*(word.format(log) for word in words), cwd=tmp_path)
    assert (done.returncode, "written completely" in done.stderr) == (3, True), done.stderr
    assert not (tmp_path / "live.rrd").exists()


def test_a_path_that_rerun_does_not_take_is_told(log: Path, tmp_path: Path) -> None:
    odd = tmp_path / os.fsdecode(b"\xff")
    odd.mkdir()
    with pytest.raises(ConfigError, match="which Rerun does not take"):
        watched(log, tmp_path, save=odd / "live.rrd")
    assert list(odd.iterdir()) == []


def test_nothing_to_show_and_a_file_to_save_contradict(
    log: Path, tmp_path: Path, imutool: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    done = imutool("live", log, "--no-view", "--save", "live.rrd", cwd=tmp_path)
    assert (done.returncode, "--no-view shows nothing" in done.stderr) == (3, True), done.stderr


def test_samples_that_come_again_from_a_repaired_log_are_shown_once(log: Path, tmp_path: Path) -> None:
    blocks: list[DebiasedBlock] = []
    debias(log, tmp_path / "out.mcap", watch=in_blocks(blocks.append))
    with live.live_view("log", save=tmp_path / "live.rrd", instead=tmp_path) as watch:
        for block in (*blocks[:4], *blocks):
            watch(block)
    stamps = saved_rrd.read(tmp_path / "live.rrd")["/imu/gyro/raw"].times("Scalars:scalars", "ros2_timestamp")
    np.testing.assert_array_equal(stamps, np.concatenate([block.batch.stamp_ns for block in blocks]))


def test_a_second_imu_has_a_tree_of_its_own(log: Path, tmp_path: Path) -> None:
    blocks: list[DebiasedBlock] = []
    debias(log, tmp_path / "out.mcap", watch=in_blocks(blocks.append))
    with live.live_view("log", save=tmp_path / "live.rrd", instead=tmp_path) as watch:
        for block in blocks:
            watch(block)
            watch(block._replace(topic="/imu 1"))
    found = saved_rrd.read(tmp_path / "live.rrd")
    for path in ("imu/gyro/debiased", "world/debiased/body", "bias/accel/sigma"):
        assert {f"/{path}", rf"/run/\/imu\ 1/{path}"} <= set(found)


@pytest.mark.parametrize(("display", "why"), [(None, "There is no display here"), (":987", "The viewer stopped at once")])
def test_where_no_viewer_opens_a_file_is_written_instead_and_said(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, display: str | None, why: str
) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if display is not None:
        monkeypatch.setenv("DISPLAY", display)  # which nobody serves
        monkeypatch.setattr(viewer, "DIES_WITHIN_S", DIES_S)
    _, watch = watched(log, tmp_path)
    (shown,) = watch.shown
    assert shown.said.startswith(why)
    assert f". Saved {tmp_path / 'instead.rrd'}. Open with: rerun" in shown.said
    assert "/imu/gyro/raw" in saved_rrd.read(tmp_path / "instead.rrd")


def test_a_debiasing_that_fails_leaves_no_file_and_an_existing_one_is_kept(log: Path, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), live.live_view("log", save=tmp_path / "a.rrd", instead=tmp_path):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "a.rrd").write_bytes(b"mine")
    with pytest.raises(ConfigError, match="exists"), live.live_view("log", save=tmp_path / "a.rrd", instead=tmp_path):
        pass
    assert (tmp_path / "a.rrd").read_bytes() == b"mine"


def test_the_command_says_what_it_kept(
    log: Path, tmp_path: Path, imutool: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    done = imutool("debias", log, "out.mcap", "--save-view", "v.rrd", "--json", "-", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (shown,) = json.loads(done.stdout)["shown"]
    assert (shown["how"], shown["place"]) == ("rrd", "v.rrd")
    assert "/world/debiased/path" in saved_rrd.read(tmp_path / "v.rrd")
