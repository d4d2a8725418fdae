"""Exported folders hold what the log holds: a EuRoC folder to the last bit, a rosbag2 folder to the last byte."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap.writer import Writer
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML
from support.digests import digests
from support.imu_defects import batch_of, late, pick, repeated, with_values, write_log
from support.loaded import loaded_by_command

from imutool.api.logs import convert, export
from imutool.converters import euroc
from imutool.debiasing import debias
from imutool.errors import ConfigError, ImutoolError, LogError
from imutool.exporting import log_parts
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.mcap_io.storage.source import sha256
from imutool.mcap_io.write import write
from imutool.noise import datasheet
from imutool.recording import Frames, Imu, Poses, Recording, Scalars
from imutool.sensor.made_up_flight import flight

Run = Callable[..., subprocess.CompletedProcess[str]]

START_NS = 1_403_636_580_838_555_648
PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0"
IMAGE_BYTES = 400_000
ROWS, MAX_BYTES = 10_000, 60  # bytes a sample at 2 kHz: the evidence of tenths of a second; a sample and a pose have 120
NUMBERS = st.floats(-1e300, 1e300, allow_nan=False)


def images(count: int, size: int = 100, start: bytes = PNG, first_ns: int = START_NS) -> Frames:
    def each() -> Iterator[tuple[int, bytes]]:
        for n in range(count):
            yield first_ns + n * 50_000_000, start + bytes([n % 256]) * size

    return Frames("png" if start == PNG else "jpeg", count, each)


def whole(seconds: float = 2.0) -> Recording:
    """A recording with all that EuRoC has a place for, whose bias is known at some poses only."""
    made = flight(5, duration_s=seconds)
    truth = made.truth
    bias = {f"/ground_truth/bias/{end}": Scalars(truth.t_ns[::3], truth.p_wb[::3] * 0.01, unit) for end, unit in UNITS.items()}
    return Recording(
        "made",
        made.imu,
        truths={"/ground_truth/pose": truth, "/ground_truth_recomputed/pose": truth.rows(slice(5, 80))},
        scalars=bias,
        frames={"/cam0/image_raw/compressed": images(7), "/cam1/image_raw/compressed": images(5)},
        metadata={"imutool": {"sensor": "bmi160"}, "cam0/sensor.yaml": {"text": "sensor_type: camera\n"}},
    )


UNITS = {"gyro": "rad/s", "accel": "m/s^2"}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    write(whole(), tmp_path / "log.mcap")
    return tmp_path / "log.mcap"


def test_the_true_bias_of_a_debiased_imu_is_what_debias_left(log: Path, tmp_path: Path) -> None:
    """An estimator that starts from the truth would subtract the sensor's bias again."""
    out = tmp_path / "debiased.mcap"
    debias(log, out, model="static", init="0.01,0.02,0.03,0.1,0.2,0.3", force=True)
    export(out, tmp_path / "folder", format="euroc")
    (raw,), (left,) = (euroc.read(place) for place in (_exported(log, tmp_path / "raw"), tmp_path / "folder"))
    for end, subtracted in (("gyro", [0.01, 0.02, 0.03]), ("accel", [0.1, 0.2, 0.3])):
        known, remains = (r.scalars[f"/ground_truth/bias/{end}"] for r in (raw, left))
        both = np.isin(known.t_ns, remains.t_ns)  # unknown before the first sample and after the last
        assert both.sum() == len(remains.t_ns) > 50
        np.testing.assert_allclose(known.values[both] - remains.values, np.tile(subtracted, (both.sum(), 1)), atol=1e-12)


def _exported(log: Path, out: Path) -> Path:
    export(log, out, format="euroc")
    return out


def back(folder: Path) -> Recording:
    """What our own converter makes of the folder, through a log."""
    target = folder.parent / f"{folder.name}_back.mcap"
    convert(folder, target)
    return read(target)


# ── EuRoC ──


def test_a_euroc_folder_converts_back_to_the_same_numbers(log: Path, tmp_path: Path) -> None:
    report = export(log, tmp_path / "out", format="euroc")
    first, again = read(log), back(tmp_path / "out")
    assert again.imu == first.imu
    assert dict(again.truths) == dict(first.truths)
    assert dict(again.scalars) == dict(first.scalars)
    assert list(again.frames) == list(first.frames)
    for topic, frames in first.frames.items():
        assert list(again.frames[topic].each()) == list(frames.each())
    assert again.metadata["cam0/sensor.yaml"]["text"] == "sensor_type: camera\n"
    assert report.written["imu0/data.csv"] == len(first.imu)
    assert report.written["cam1/data.csv"] == 5
    assert report.left_out == ["/tf"]  # the same poses once more


@settings(max_examples=25, deadline=None)
@given(values=arrays(np.float64, (6, 6), elements=NUMBERS), steps=st.lists(st.integers(1, 2**40), min_size=6, max_size=6))
def test_any_number_and_any_stamp_come_back(
    tmp_path_factory: pytest.TempPathFactory, values: np.ndarray, steps: list[int]
) -> None:
    """Of rows among those of a sensor at rest: samples in another unit as a whole are refused."""
    folder = tmp_path_factory.mktemp("any")
    t_ns = np.concatenate([np.arange(-1_000_000_000, 0, 5_000_000), np.cumsum(np.array(steps, np.int64))]) + 1_000_000_000
    values = np.concatenate([np.random.default_rng(0).normal([0, 0, 0, 0, 0, 9.81], 0.01, (200, 6)), values])
    imu = Imu(t_ns, np.ascontiguousarray(values[:, :3]), np.ascontiguousarray(values[:, 3:]))
    write(Recording("any", imu), folder / "any.mcap")
    export(folder / "any.mcap", folder / "out", format="euroc")
    (again,) = euroc.read(folder / "out")
    assert again.imu == imu  # bit for bit, -0.0 and denormals too


def test_the_real_table_comes_back_to_the_bit(data: Path, tmp_path: Path) -> None:
    (recording,) = euroc.read(data / "euroc" / "MH_05_difficult.zip")
    write(recording, tmp_path / "log.mcap")
    export(tmp_path / "log.mcap", tmp_path / "MH_05_difficult", format="euroc")
    (again,) = euroc.read(tmp_path / "MH_05_difficult")
    assert again.imu == recording.imu
    assert dict(again.truths) == dict(recording.truths)
    assert dict(again.scalars) == dict(recording.scalars)
    kept = (tmp_path / "MH_05_difficult/mav0/imu0/sensor.yaml").read_text()
    assert "gyroscope_noise_density: 1.6968e-04" in kept  # the data set's own words
    table = (tmp_path / "MH_05_difficult/mav0/state_groundtruth_estimate0/data.csv").read_text().splitlines()
    assert all(line.count(",") == 16 for line in table)  # the seventeen columns that readers of EuRoC count on


def test_the_debiased_channel_goes_first_and_imu_chooses(log: Path, tmp_path: Path) -> None:
    debias(log, tmp_path / "debiased.mcap", init="1e-3,0,0,0,0,0.1")
    chosen = export(tmp_path / "debiased.mcap", tmp_path / "out", format="euroc")
    assert chosen.imu == "/imu0/debiased"
    assert back(tmp_path / "out").imu == read(tmp_path / "debiased.mcap", imu="/imu0/debiased").imu
    raw = export(tmp_path / "debiased.mcap", tmp_path / "raw", format="euroc", imu="/imu0")
    assert raw.imu == "/imu0"
    assert back(tmp_path / "raw").imu == read(log).imu
    assert "/imu0/debiased" in raw.left_out
    with pytest.raises(LogError, match="no topic /imu7"):
        export(tmp_path / "debiased.mcap", tmp_path / "none", format="euroc", imu="/imu7")
    assert not (tmp_path / "none").exists()


def yaml_of(folder: Path) -> dict[str, object]:
    return dict(YAML(typ="safe").load((folder / "mav0/imu0/sensor.yaml").read_text(encoding="utf-8")))


def test_the_rate_of_sensor_yaml_is_that_of_stamps_in_steps_of_a_coarse_clock(tmp_path: Path) -> None:
    made = flight(5, duration_s=2.0)  # EuRoC's clock has ticks of 256 ns: the median alone gave 200.003 Hz
    imu = replace(made.imu, t_ns=made.imu.t_ns // 256 * 256)
    write(replace(made, imu=imu, metadata={}), tmp_path / "log.mcap")
    export(tmp_path / "log.mcap", tmp_path / "out", format="euroc")
    assert yaml_of(tmp_path / "out")["rate_hz"] == 200


def test_sensor_yaml_says_where_its_noise_is_from(log: Path, tmp_path: Path) -> None:
    export(log, tmp_path / "named", format="euroc")  # the log names its sensor
    held = yaml_of(tmp_path / "named")
    assert held["sensor_type"] == "imu"
    assert held["rate_hz"] == pytest.approx(200.0)
    assert held["T_BS"]["data"] == np.eye(4).ravel().tolist()  # type: ignore[index]
    assert held["gyroscope_noise_density"] == datasheet.SHEETS["bmi160"].gyro_density[0]
    assert held["accelerometer_random_walk"] == datasheet.SHEETS["bmi160"].accel_walk[0]
    assert "defaults of a data sheet (the sensor's, bmi160), not measured" in (
        tmp_path / "named/mav0/imu0/sensor.yaml"
    ).read_text(encoding="utf-8")

    for name, own, why in (
        ("nameless", {}, "the log does not name its sensor"),
        ("other", {"imutool": {"sensor": "fetch"}}, "there is none of fetch"),
    ):
        write(replace(whole(), metadata=own), tmp_path / f"{name}.mcap")
        export(tmp_path / f"{name}.mcap", tmp_path / name, format="euroc")
        assert f"adis16448's, as {why}), not" in (tmp_path / name / "mav0/imu0/sensor.yaml").read_text(encoding="utf-8")

    measured = datasheet.Noise(gyro_density=(3e-4, None, 4e-4), sources={"gyro_density": "4.2 h at rest"})
    datasheet.write(measured, tmp_path / "imu.toml")
    export(log, tmp_path / "measured", format="euroc", noise=tmp_path / "imu.toml")
    held = yaml_of(tmp_path / "measured")
    assert held["gyroscope_noise_density"] == pytest.approx(np.sqrt((9 + 16) / 2) * 1e-4)
    assert "gyroscope_random_walk" not in held
    text = (tmp_path / "measured/mav0/imu0/sensor.yaml").read_text(encoding="utf-8")
    assert "4.2 h at rest" in text
    assert "# gyroscope_random_walk is not known" in text
    write(replace(whole(), metadata={"imu0/sensor.yaml": {"text": "rate_hz: 1\n"}}), tmp_path / "kept.mcap")
    export(tmp_path / "kept.mcap", tmp_path / "instead", format="euroc", noise=tmp_path / "imu.toml")
    given = (tmp_path / "instead/mav0/imu0/sensor.yaml").read_text(encoding="utf-8")
    assert given == text.replace('"bmi160"', '"unknown"'), "a given noise takes the place of the source's file"


def test_a_truth_without_velocity_comes_back_without(tmp_path: Path) -> None:
    made = whole()
    bare = Poses(made.truth.t_ns, made.truth.p_wb, made.truth.q_wb_wxyz)
    write(Recording("bare", made.imu, truths={"/mocap/pose": bare}), tmp_path / "bare.mcap")
    export(tmp_path / "bare.mcap", tmp_path / "bare", format="euroc")
    again = back(tmp_path / "bare")
    assert dict(again.truths) == {"/ground_truth/pose": bare}
    assert dict(again.scalars) == {}


def alike_in_parts(log: Path, monkeypatch: pytest.MonkeyPatch, parts: int) -> bool:
    """Whether a log exported in parts gives the same files and report; it takes at least so many parts."""
    whole = export(log, log.parent / "whole", format="euroc")
    read, taken = log_parts.read_recordings, list[int]()

    def counted(*args: Any, **settings: Any) -> list[Recording]:
        found = read(*args, **settings)
        taken.append(len(found))
        return found

    monkeypatch.setattr(log_parts, "PART_ROWS", 64)
    monkeypatch.setattr(log_parts, "read_recordings", counted)
    found = export(log, log.parent / "parts", format="euroc")
    assert len(taken) >= parts
    same = found.written == whole.written and set(found.left_out) == set(whole.left_out)
    return same and digests(log.parent / "parts") == digests(log.parent / "whole")


def test_a_log_in_parts_gives_the_same_folder(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert alike_in_parts(log, monkeypatch, 6)


def test_a_bias_that_leaves_the_stamps_of_the_poses_late_gives_the_same_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = whole()
    name = "/ground_truth/bias/gyro"
    t_ns = recording.scalars[name].t_ns.copy()
    t_ns[-1] += 1
    late = {**recording.scalars, name: replace(recording.scalars[name], t_ns=t_ns)}
    write(replace(recording, scalars=late), tmp_path / "log.mcap")
    assert alike_in_parts(tmp_path / "log.mcap", monkeypatch, 6)


def test_a_debiased_log_in_parts_gives_the_same_folder(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was subtracted between the last sample of a part and the first of the next is known to the whole alone."""
    debias(log, tmp_path / "debiased.mcap", model="static", force=True)
    assert alike_in_parts(tmp_path / "debiased.mcap", monkeypatch, 1)


def test_a_clock_that_is_set_back_gives_the_same_folder_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sound = batch_of(whole().imu)
    write_log(pick(sound, np.roll(np.arange(len(sound.stamp_ns)), 200)), tmp_path / "log.mcap")
    assert alike_in_parts(tmp_path / "log.mcap", monkeypatch, 0)


@pytest.mark.parametrize("defect", ["late", "repeated", "not finite"])
def test_what_is_wrong_with_samples_is_said_of_the_whole_log(
    defect: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sound = batch_of(whole().imu)
    batches = {
        "late": late(sound, [70, 200], 9),
        "repeated": repeated(sound, [64, 128], 2),
        "not finite": with_values(sound, [70, 128], 2, np.nan),
    }
    write_log(batches[defect], tmp_path / "log.mcap")
    said = list[str]()
    for rows in (log_parts.PART_ROWS, 64):
        monkeypatch.setattr(log_parts, "PART_ROWS", rows)
        with pytest.raises(LogError, match="/imu0") as refused:
            export(tmp_path / "log.mcap", tmp_path / "out", format="euroc")
        said.append(str(refused.value))
    assert said[0] == said[1]


def test_memory_does_not_grow_with_the_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_parts, "PART_ROWS", 1 << 12)
    peaks = []
    for count in (ROWS, 5 * ROWS):
        t_ns, rng = START_NS + 500_000 * np.arange(count), np.random.default_rng(1)
        imu = Imu(t_ns, rng.normal(size=(count, 3)), rng.normal([0.0, 0.0, 9.8], size=(count, 3)))
        still = Poses(t_ns, np.zeros((count, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)))
        write(Recording("log", imu, truths={"/ground_truth/pose": still}), tmp_path / f"{count}.mcap")
        tracemalloc.start()
        export(tmp_path / f"{count}.mcap", tmp_path / str(count), format="euroc")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] < MAX_BYTES * 4 * ROWS


def test_jpeg_keeps_its_ending_and_what_is_no_image_is_refused(tmp_path: Path) -> None:
    imu = whole().imu
    write(Recording("j", imu, frames={"/left/compressed": images(3, start=JPEG)}), tmp_path / "j.mcap")
    export(tmp_path / "j.mcap", tmp_path / "j", format="euroc")
    assert sorted(p.suffix for p in (tmp_path / "j/mav0/cam0/data").iterdir()) == [".jpg"] * 3
    write(Recording("x", imu, frames={"/cam0/compressed": images(3, start=b"raw ")}), tmp_path / "x.mcap")
    with pytest.raises(LogError, match="neither PNG nor JPEG"):
        export(tmp_path / "x.mcap", tmp_path / "x", format="euroc")
    assert not (tmp_path / "x").exists()
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_samples_in_g_and_two_images_of_one_time_are_refused(tmp_path: Path) -> None:
    """The headers of the tables state units, and an image is named by its time."""
    recording = whole()
    imu = Imu(recording.imu.t_ns, recording.imu.gyro, recording.imu.accel / 9.81)
    write(replace(recording, imu=imu), tmp_path / "g.mcap")
    twice = Frames("png", 2, lambda: iter([(START_NS, PNG), (START_NS, PNG)]))
    write(replace(recording, frames={"/cam0/image_raw/compressed": twice}), tmp_path / "twice.mcap")
    for name, what in (("g", "accel looks like g, not m/s"), ("twice", f"two images have the stamp {START_NS} ns")):
        with pytest.raises(ImutoolError, match=what):
            export(tmp_path / f"{name}.mcap", tmp_path / name, format="euroc")
        assert not (tmp_path / name).exists()


def test_images_pass_through_one_at_a_time(tmp_path: Path) -> None:
    frames = {"/cam0/image_raw/compressed": images(60, size=IMAGE_BYTES)}
    write(Recording("big", whole().imu, frames=frames), tmp_path / "big.mcap", compression="none")
    export(tmp_path / "big.mcap", tmp_path / "warm", format="euroc")  # what is imported on the way is no image
    tracemalloc.start()
    export(tmp_path / "big.mcap", tmp_path / "big", format="euroc")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(list((tmp_path / "big/mav0/cam0/data").iterdir())) == 60
    assert peak < 20 * IMAGE_BYTES  # of 60; a chunk holds several


def test_a_camera_without_a_number_takes_no_other_s_folder(tmp_path: Path) -> None:
    """A camera of another name was written as cam0, with the sensor.yaml of that, which was left out."""
    frames = {f"/{name}/image_raw/compressed": images(count) for name, count in (("cam1", 2), ("front", 3), ("cam0", 4))}
    write(Recording("made", whole().imu, frames=frames), tmp_path / "log.mcap")
    report = export(tmp_path / "log.mcap", tmp_path / "out", format="euroc")
    assert {name: report.written[f"cam{n}/data.csv"] for n, name in enumerate(("cam0", "cam1", "front"))} == {
        "cam0": 4,
        "cam1": 2,
        "front": 3,
    }


# ── rosbag2 ──


def test_a_rosbag2_folder_holds_the_log_byte_for_byte(log: Path, tmp_path: Path) -> None:
    before = sha256(log)
    export(log, tmp_path / "bag", format="rosbag2")
    assert sorted(p.name for p in (tmp_path / "bag").iterdir()) == ["bag_0.mcap", "metadata.yaml"]
    assert sha256(tmp_path / "bag/bag_0.mcap") == sha256(log) == before
    assert (tmp_path / "bag/bag_0.mcap").stat().st_ino != log.stat().st_ino  # a copy, no link


def test_rosbags_reads_the_folder_with_its_counts_times_and_types(log: Path, tmp_path: Path) -> None:
    export(log, tmp_path / "bag", format="rosbag2")
    recording = read(log)
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Log(log) as opened, Reader(tmp_path / "bag") as bag:
        expected = {t.name: (t.schema_name, t.count) for t in opened.topics.values()}
        assert {c.topic: (c.msgtype, c.msgcount) for c in bag.connections} == expected
        assert bag.message_count == sum(count for _, count in expected.values())
        stamps = np.concatenate([times for topic in opened.topics for times in opened.stamps(topic)])
        assert bag.start_time == stamps.min()
        assert bag.end_time == stamps.max() + 1  # rosbags counts the last nanosecond in
        imus = [c for c in bag.connections if c.topic == "/imu0"]
        read_back = [(t, store.deserialize_cdr(raw, c.msgtype)) for c, t, raw in bag.messages(imus)]
    assert [t for t, _ in read_back] == recording.imu.t_ns.tolist()
    gyro = np.array([[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z] for _, m in read_back])
    np.testing.assert_array_equal(gyro, recording.imu.gyro)


def test_the_metadata_follows_version_5_with_numbers_for_qualities(log: Path, tmp_path: Path) -> None:
    """Humble reads numbers there and Jazzy goes by the version; names came with version 9 (ros2/rosbag2 pull request 1476)."""
    export(log, tmp_path / "bag", format="rosbag2")
    text = (tmp_path / "bag/metadata.yaml").read_text(encoding="utf-8")
    held = YAML(typ="safe").load(text)["rosbag2_bagfile_information"]
    assert held["version"] == 5
    assert held["storage_identifier"] == "mcap"
    assert held["relative_file_paths"] == ["bag_0.mcap"]
    assert held["compression_format"] == held["compression_mode"] == ""
    (file,) = held["files"]
    assert file["path"] == "bag_0.mcap"
    assert {key: file[key] for key in ("starting_time", "duration", "message_count")} == {
        key: held[key] for key in ("starting_time", "duration", "message_count")
    }
    assert sum(t["message_count"] for t in held["topics_with_message_count"]) == held["message_count"]
    for topic in held["topics_with_message_count"]:
        assert topic["topic_metadata"]["serialization_format"] == "cdr"
        (quality,) = YAML(typ="safe").load(topic["topic_metadata"]["offered_qos_profiles"])
        numbers = (quality["history"], quality["reliability"], quality["durability"], quality["liveliness"])
        assert numbers == (1, 1, 2, 1)  # keep last, reliable, volatile, automatic
        assert quality["deadline"] == {"sec": 9223372036, "nsec": 854775807}


def test_an_imu_in_a_type_of_its_own_keeps_that_type(tmp_path: Path) -> None:
    """The metadata said sensor_msgs/msg/Imu, and rosbags read no message."""
    definition = "".join(f"float64 {sensor}_{axis}\n" for sensor in ("gyro", "accel") for axis in "xyz")
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema("my_driver/msg/Imu", "ros2msg", definition.encode())
        writer.add_message(writer.register_channel("/imu", "cdr", schema), START_NS, b"\0\1\0\0" + bytes(48), START_NS)
        writer.finish()
    export(tmp_path / "log.mcap", tmp_path / "bag", format="rosbag2")
    with Reader(tmp_path / "bag") as reader:
        assert [connection.msgtype for connection, *_ in reader.messages()] == ["my_driver/msg/Imu"]


def test_a_log_that_is_no_ros2_log_cannot_be_copied_into_a_bag(log: Path, tmp_path: Path) -> None:
    from mcap.writer import Writer

    with (tmp_path / "json.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="")
        channel = writer.register_channel("/imu0", "json", writer.register_schema("sensor_msgs/msg/Imu", "jsonschema", b"{}"))
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(LogError, match=r"profile is ''.*Use `format=euroc`"):
        export(tmp_path / "json.mcap", tmp_path / "bag", format="rosbag2")
    assert not (tmp_path / "bag").exists()
    with pytest.raises(ConfigError, match="whole log"):
        export(log, tmp_path / "bag", format="rosbag2", imu="/imu0")


# ── targets ──


@pytest.mark.parametrize("format", ["euroc", "rosbag2"])
def test_what_is_there_is_replaced_only_when_asked(log: Path, tmp_path: Path, format: str) -> None:
    out = tmp_path / "out"
    export(log, out, format=format)
    first = digests(out)
    with pytest.raises(ConfigError, match="`overwrite=True`"):
        export(log, out, format=format)
    assert digests(out) == first
    write(whole(3.0), tmp_path / "longer.mcap")
    export(tmp_path / "longer.mcap", out, format=format, overwrite=True)
    assert digests(out) != first
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


@pytest.mark.parametrize("format", ["euroc", "rosbag2"])
def test_a_folder_that_was_not_made_here_is_never_removed(log: Path, tmp_path: Path, format: str) -> None:
    """An original data set looks just like an export; a folder with a stranger's file in it might be anything."""
    original = tmp_path / "V1_01"
    export(log, original, format=format)
    signed = original / ("metadata.yaml" if format == "rosbag2" else "mav0/imu0/sensor.yaml")
    made = signed.read_text(encoding="utf-8")
    signed.write_text("sensor_type: imu\n", encoding="utf-8")
    held = digests(original)
    with pytest.raises(ConfigError, match="not made by imutool"):
        export(log, original, format=format, overwrite=True)
    assert digests(original) == held
    signed.write_text(made, encoding="utf-8")
    added = ("mav0/imu0/notes.txt", "mav0/cam7/data.csv") if format == "euroc" else ("walk_1.mcap",)
    for name in ("thesis.tex", *added):
        (original / name).parent.mkdir(exist_ok=True)
        (original / name).write_text("years of work")
        with pytest.raises(ConfigError, match=rf"holds {Path(name) if '7' not in name else 'mav0/cam7'}, which this export"):
            export(log, original, format=format, overwrite=True)
        (original / name).unlink()
    (link := tmp_path / "link").symlink_to(original, target_is_directory=True)
    for target in (log, link):
        with pytest.raises(ConfigError, match="not a folder"):
            export(log, target, format=format, overwrite=True)


def test_the_log_is_never_in_the_folder_that_is_replaced(log: Path, tmp_path: Path) -> None:
    export(log, tmp_path / "bag", format="rosbag2")
    with pytest.raises(ConfigError, match="would replace the source"):
        export(tmp_path / "bag/bag_0.mcap", tmp_path / "bag", format="rosbag2", overwrite=True)
    assert sha256(tmp_path / "bag/bag_0.mcap") == sha256(log)


@pytest.mark.parametrize("format", ["euroc", "rosbag2"])
@pytest.mark.parametrize("failure", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_nothing_is_left_after_a_failure(log: Path, tmp_path: Path, format: str, failure: BaseException) -> None:
    def fail(done: int, total: int, word: str) -> None:
        raise failure

    expected = KeyboardInterrupt if failure is KeyboardInterrupt else ConfigError
    held = digests(tmp_path)
    with pytest.raises(expected):
        export(log, tmp_path / "out", format=format, progress=fail)
    assert digests(tmp_path) == held
    assert sorted(p.name for p in tmp_path.iterdir()) == ["log.mcap"]


def test_an_unknown_format_suggests_the_nearest(log: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="Did you mean rosbag2"):
        export(log, tmp_path / "out", format="rosbag")


def test_a_damaged_log_leaves_no_folder(log: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    for format in ("euroc", "rosbag2"):
        with pytest.raises(ImutoolError):
            export(tmp_path / "cut.mcap", tmp_path / "out", format=format)
    assert not (tmp_path / "out").exists()


# ── the command ──


def test_the_command_reports_in_words_and_json(imutool: Run, log: Path, tmp_path: Path) -> None:
    done = imutool("export", "log.mcap", "out", "--format", "euroc", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "imu0/data.csv" in done.stdout
    assert "IMU from /imu0" in done.stdout
    told = json.loads(imutool("export", "log.mcap", "bag", "--format", "rosbag2", "--json", "-", cwd=tmp_path).stdout)
    assert told["schema"] == "imutool.export/1"
    assert told["written"]["/imu0"] == len(read(log).imu)
    again = imutool("export", "log.mcap", "bag", "--format", "rosbag2", cwd=tmp_path)
    assert again.returncode == 3
    assert "--overwrite" in again.stderr
    assert "Example" in imutool("export", "--help", cwd=tmp_path).stdout


def test_an_interrupt_of_the_command_leaves_nothing(tmp_path: Path, command: str) -> None:
    frames = {"/cam0/image_raw/compressed": images(4000, size=20_000)}
    write(Recording("big", whole().imu, frames=frames), tmp_path / "big.mcap", compression="none")
    line = [command, "export", "big.mcap", "out", "--format", "euroc"]
    with subprocess.Popen(line, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as running:
        deadline = time.monotonic() + 60
        while not list(tmp_path.glob(".out.*/mav0/cam0/data/*.png")):
            assert running.poll() is None, "it ended before it could be interrupted"
            assert time.monotonic() < deadline
            time.sleep(0.005)
        os.kill(running.pid, signal.SIGINT)
        _, said = running.communicate(timeout=60)
    assert running.returncode == 130
    assert "interrupted" in said
    assert sorted(p.name for p in tmp_path.iterdir()) == ["big.mcap"]


def test_export_imports_nothing_heavy(log: Path, tmp_path: Path) -> None:
    words = ("export", "log.mcap", "out", "--format", "euroc", "-q")
    assert loaded_by_command(words, {"torch", "rosbags", "matplotlib", "rerun", "allantools"}, cwd=tmp_path) == []
    assert (tmp_path / "out").exists()


def test_a_log_of_one_sample_has_no_rate_and_is_named(tmp_path: Path) -> None:
    made = flight(5, duration_s=2.0)
    write(Recording("one", made.imu.rows(slice(1))), tmp_path / "one.mcap")
    with pytest.raises(LogError, match=r"one\.mcap: /imu0 has 1 samples"):
        export(tmp_path / "one.mcap", tmp_path / "out", format="euroc")
    assert not (tmp_path / "out").exists()
