"""The log's other topics are in the same recording, at the same nanoseconds; what is missing is said."""

from __future__ import annotations

import io
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.writer import Writer
from PIL import Image
from support import saved_rrd

from imutool.mcap_io.write import write
from imutool.recording import Frames, Recording, Scalars
from imutool.viewing.model.load_view import load
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import layout, other_topics

CAMERA = "/cam0/image_raw/compressed"
BLOB = "EncodedImage:blob"
TENTH = 100_000_000


def frame(shade: int) -> bytes:
    content = io.BytesIO()
    Image.fromarray(np.full((12, 16), shade, dtype=np.uint8)).save(content, "png")
    return content.getvalue()


@pytest.fixture(scope="module")
def frames(recording: Recording) -> list[tuple[int, bytes]]:
    start = int(recording.imu.t_ns[0])
    return [(start + k * TENTH + 7, frame(10 * k)) for k in range(20)]


@pytest.fixture(scope="module")
def log(recording: Recording, frames: list[tuple[int, bytes]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("source") / "flight.mcap"
    t_ns = recording.imu.t_ns[::10]
    scalars = {
        "/imu/temperature": Scalars(t_ns, np.arange(3.0 * len(t_ns)).reshape(-1, 3), "K"),
        "/wind": Scalars(t_ns, np.arange(3.0 * len(t_ns)).reshape(-1, 3), "m/s"),
    }
    write(replace(recording, frames={CAMERA: Frames("png", len(frames), lambda: iter(frames))}, scalars=scalars), path)
    return path


@pytest.fixture(scope="module")
def data(log: Path) -> RunData:
    return load(log)


@pytest.fixture(scope="module")
def entities(data: RunData, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    path = saved_rrd.written([data], tmp_path_factory.mktemp("rrd") / "a.rrd")
    return SimpleNamespace(all=saved_rrd.read(path))


def report(entities: dict) -> str:
    (text,) = entities["/report"].static["TextDocument:text"]
    return str(text)


def test_camera_frames_are_the_logs_own_bytes_at_their_nanoseconds(
    data: RunData, entities: SimpleNamespace, frames: list[tuple[int, bytes]]
) -> None:
    camera = entities.all[CAMERA]
    assert [bytes(row[0]) for row in camera.rows(BLOB).to_pylist()] == [image for _, image in frames]
    stamps = [t_ns for t_ns, _ in frames]
    assert camera.times(BLOB, "ros2_timestamp").tolist() == stamps
    assert camera.times(BLOB, "message_log_time").tolist() == stamps
    assert camera.times(BLOB, "elapsed").tolist() == [t_ns - data.start_ns for t_ns in stamps]


def test_nothing_is_on_any_other_timeline(entities: SimpleNamespace) -> None:
    found = {line for entity in entities.all.values() for stamps in entity.stamps.values() for line in stamps}
    assert found == set(saved_rrd.TIMELINES)


def test_what_is_drawn_already_is_left_out_and_all_else_is_there(entities: SimpleNamespace) -> None:
    assert not {"/imu0", "/ground_truth/pose"} & set(entities.all)
    assert {"/ground_truth/velocity", "/tf", "/wind"} <= set(entities.all)
    assert not [path for path in entities.all if path.startswith("/__mcap")]


def test_a_log_without_truth_has_its_other_topics_too(
    recording: Recording, frames: list[tuple[int, bytes]], tmp_path: Path
) -> None:
    images = {CAMERA: Frames("png", len(frames), lambda: iter(frames))}
    write(replace(recording, truths={}, scalars={}, frames=images), tmp_path / "bare.mcap")
    found = saved_rrd.read(saved_rrd.written([load(tmp_path / "bare.mcap")], tmp_path / "bare.rrd"))
    assert CAMERA in found
    assert "/imu0" not in found


def test_a_topic_that_is_called_like_something_of_ours_lies_below_source(entities: SimpleNamespace) -> None:
    assert "/source/imu/temperature" in entities.all
    assert "/imu/temperature" not in entities.all


def test_transforms_that_have_no_header_of_their_own_are_placed_by_their_log_time(
    data: RunData, entities: SimpleNamespace
) -> None:
    frames, column = entities.all["/tf"], "Transform3D:translation"
    assert set(frames.stamps[column]) == {"elapsed", "message_log_time"}
    np.testing.assert_array_equal(frames.times(column, "elapsed"), frames.times(column, "message_log_time") - data.start_ns)


def test_cameras_have_a_tab_only_where_the_source_is_shown(data: RunData) -> None:
    def tabs(source: bool) -> list[str]:
        found: list[str] = saved_rrd.names(layout.blueprint([data], source=source).root_container.contents[1])
        return found

    assert tabs(True) == [*tabs(False), "Cameras"]
    (camera,) = [
        view for view in saved_rrd.views(layout.blueprint([data])) if view.class_identifier == "2D" and "cam" in view.name
    ]
    assert camera.origin == CAMERA


def test_without_the_source_nothing_of_it_is_there(data: RunData, tmp_path: Path) -> None:
    found = saved_rrd.read(saved_rrd.written([data], tmp_path / "bare.rrd", source=False))
    assert not {CAMERA, "/tf", "/wind"} & set(found)


def test_a_log_too_large_for_a_viewer_is_left_out_and_said(
    data: RunData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(other_topics, "SOURCE_LIMIT", 1000)
    found = saved_rrd.read(saved_rrd.written([data], tmp_path / "large.rrd"))
    assert CAMERA not in found
    assert "The log's other topics are not shown" in report(found)
    assert "Cameras" not in saved_rrd.names(layout.blueprint([data]).root_container.contents[1])


def test_a_definition_that_doubles_with_each_message_is_not_given_to_rerun(data: RunData, tmp_path: Path) -> None:
    parts = ["M1 a\nM1 b\n", *(f"MSG: p/M{k}\nM{k + 1} a\nM{k + 1} b\n" for k in range(1, 20)), "MSG: p/M20\nfloat64 x\n"]
    with (path := tmp_path / "endless.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        for topic, text in (("/endless", f"{'=' * 80}\n".join(parts)), ("/sound", "float64 x\n")):
            schema = writer.register_schema("p/msg/M0", "ros2msg", text.encode())
            writer.add_message(writer.register_channel(topic, "cdr", schema), 0, b"\0\1\0\0" + bytes(8), 0)
        writer.finish()
    plan = other_topics.plan_import(replace(data, source=path), ())
    assert "/endless" in plan.left_out
    assert "/sound" not in plan.left_out
    assert "/endless not shown" in plan.sentence


@pytest.mark.parametrize("content", [b"", b"no log at all", b"\x89MCAP0\r\n" + bytes(100)])
def test_a_log_that_cannot_be_read_any_more_is_said_and_the_rest_is_drawn(
    data: RunData, tmp_path: Path, content: bytes
) -> None:
    path = tmp_path / "gone.mcap"
    path.write_bytes(content)
    found = saved_rrd.read(saved_rrd.written([replace(data, source=path)], tmp_path / "a.rrd"))
    assert "The log's other topics are not shown" in report(found)
    assert "/imu/gyro/raw" in found
    path.unlink()
    assert "not shown" in report(saved_rrd.read(saved_rrd.written([replace(data, source=path)], tmp_path / "b.rrd")))


def test_of_a_damaged_log_what_lies_before_the_damage_is_shown(data: RunData, recording: Recording, tmp_path: Path) -> None:
    start = int(recording.imu.t_ns[0])
    large = [(start + k * TENTH, os.urandom(300_000)) for k in range(20)]  # several chunks
    write(replace(recording, frames={CAMERA: Frames("png", 20, lambda: iter(large))}), tmp_path / "whole.mcap")
    content = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(content[: len(content) * 2 // 3])
    found = saved_rrd.read(saved_rrd.written([replace(data, source=tmp_path / "cut.mcap")], tmp_path / "a.rrd"))
    shown = [bytes(row[0]) for row in found[CAMERA].rows(BLOB).to_pylist()]
    assert 5 < len(shown) < 20
    assert shown == [image for _, image in large[: len(shown)]]


def test_another_clock_in_the_headers_is_not_taken_for_the_imus(data: RunData, monkeypatch: pytest.MonkeyPatch) -> None:
    log_ns = np.arange(data.start_ns, data.start_ns + 10 * TENTH, TENTH, dtype=np.int64)
    shifted = np.arange(10, dtype=np.int64) * TENTH  # since boot, say
    np.testing.assert_array_equal(other_topics.elapsed_ns(shifted, log_ns, data), log_ns - data.start_ns)
    np.testing.assert_array_equal(other_topics.elapsed_ns(log_ns + 3, log_ns, data), log_ns + 3 - data.start_ns)
    np.testing.assert_array_equal(other_topics.elapsed_ns(None, log_ns, data), log_ns - data.start_ns)
    one_shifted = np.append(log_ns[:-1] + 3, shifted[-1])  # no part of a chunk on one clock, the rest on another
    np.testing.assert_array_equal(other_topics.elapsed_ns(one_shifted, log_ns, data), log_ns - data.start_ns)
    monkeypatch.setattr(RunData, "log_ns", lambda data, t_ns: t_ns + 5_000_000)  # of a recorder that is late
    np.testing.assert_array_equal(other_topics.elapsed_ns(None, log_ns, data), log_ns - 5_000_000 - data.start_ns)


def test_several_logs_keep_their_topics_apart_and_their_transforms_out(data: RunData, tmp_path: Path) -> None:
    found = saved_rrd.read(saved_rrd.written([data, replace(data, name="other")], tmp_path / "two.rrd"))
    for name in (data.name, "other"):
        assert {f"/run/{name}{CAMERA}", f"/run/{name}/source/imu/temperature"} <= set(found)
        assert f"/run/{name}/tf" not in found  # a viewer has one set of frames
        assert "transforms (/tf)" in found[f"/run/{name}/report"].static["TextDocument:text"][0]
    cameras = [
        view.origin for view in saved_rrd.views(layout.blueprint([data, replace(data, name="other")])) if "cam0" in view.name
    ]
    assert cameras == [f"/run/{data.name}{CAMERA}", f"/run/other{CAMERA}"]
