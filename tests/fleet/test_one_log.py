"""One log, without any cluster: whole or not at all, the same every time, and an error is a result."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from rosbags.rosbag1 import Reader, Writer
from rosbags.typesys import Stores, get_typestore
from support.two_imus import write_two_imus

from fuzz.numbers import put_log
from imutool.bag.repair import repair_bag
from imutool.cleaning import CleaningSettings
from imutool.debiasing import debias
from imutool.errors import ConfigError, LogError
from imutool.fleet import targets
from imutool.fleet.one_log import COMMANDS, work
from imutool.fleet.robots import robot_of, robot_pattern
from imutool.fleet.sources import find
from imutool.fleet.targets import is_current, page_name, target_name
from imutool.fleet.task import Result, Settings, Source, Task, with_model_hash
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.mcap_io.storage.source import sha256
from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight


def task(source: Path, out: Path, settings: Settings, name: str = "a/log.mcap", **changes: Any) -> Task:
    (one,) = find(str(source), Path("/nowhere")).logs
    return Task(key="k", source=one, out=str(out), target=name, settings=settings, **changes)


@pytest.fixture
def settings(logs: Path) -> Settings:
    return Settings(command="debias", model=str(logs / "linear.safetensors"))


@pytest.fixture
def done(logs: Path, tmp_path: Path, settings: Settings) -> Result:
    return work(task(logs / "flight_1.mcap", tmp_path / "out", settings))


def test_a_debiased_log_is_what_debias_makes_of_it(done: Result, logs: Path, tmp_path: Path, settings: Settings) -> None:
    debias(logs / "flight_1.mcap", tmp_path / "alone.mcap", model=settings.model, clean=CleaningSettings())
    target = tmp_path / "out" / "a" / "log.mcap"
    assert target.read_bytes() == (tmp_path / "alone.mcap").read_bytes()
    assert (done.status, done.error, done.exit_code) == ("ok", "", 0)
    assert (done.target_bytes, done.target_sha256) == (target.stat().st_size, sha256(target))
    assert done.messages > 4000
    (imu,) = done.imus
    assert (imu.topic, imu.model) == ("/imu0", "linear")


@pytest.mark.parametrize("kind", ["debias", "repair"])
def test_a_log_without_crcs_is_said_to_be_unchecked(tmp_path: Path, kind: Any) -> None:
    imu = flight(1, duration_s=6.0).imu
    put_log(tmp_path / "in.mcap", imu.t_ns, imu.gyro, imu.accel, None, crcs=False)
    done = work(task(tmp_path / "in.mcap", tmp_path / "out", Settings(command=kind)))
    assert done.status == "ok", done.error
    assert any("lie where no CRC covers them" in warning for warning in done.warnings)


def test_a_model_of_another_sensor_is_refused_or_warned_of(logs: Path, tmp_path: Path) -> None:
    settings = Settings(command="debias", model="tum_vi-bmi160-linear")
    refused = work(task(logs / "flight_1.mcap", tmp_path / "out", settings))
    assert (refused.status, refused.exit_code) == ("failed", 6)
    assert "does not fit this log" in refused.error
    forced = work(task(logs / "flight_1.mcap", tmp_path / "out", msgspec.structs.replace(settings, force=True)))
    assert forced.status == "ok"
    assert any("the model is unfit" in warning for warning in forced.warnings)


def test_the_imu_is_the_one_that_is_named(logs: Path, tmp_path: Path, settings: Settings) -> None:
    named = msgspec.structs.replace(settings, imu=("gyro=/imu0,accel=/imu1",))
    refused = work(task(logs / "flight_1.mcap", tmp_path / "out", named))
    assert refused.status == "failed"
    assert "the log has no topic gyro=/imu0,accel=/imu1; expected /imu0 (sensor_msgs/msg/Imu)" in refused.error


def test_a_fleet_names_the_imus_of_all_its_logs(logs: Path, tmp_path: Path, settings: Settings) -> None:
    """Logs with one IMU and logs with two in one run: each takes what it has of the named ones."""
    two = tmp_path / "two.mcap"
    write_two_imus(flight(2, duration_s=10.0), two)
    alone = work(task(two, tmp_path / "out", settings, name="two.mcap"))
    assert (alone.status, alone.exit_code) == ("failed", 5)
    assert "2 IMU topics: /imu0, /imu1. Choose one with `imu`" in alone.error
    named = msgspec.structs.replace(settings, imu=("/imu1", "/imu0"))
    for log, topics in ((two, ["/imu1", "/imu0"]), (logs / "flight_1.mcap", ["/imu0"])):
        done = work(task(log, tmp_path / "out", named, name=log.name))
        assert (done.status, [imu.topic for imu in done.imus]) == ("ok", topics), done.error
    os.truncate(two, two.stat().st_size * 3 // 4)
    done = work(task(two, tmp_path / "out", named, name="cut.mcap"))
    assert (done.status, [imu.topic for imu in done.imus]) == ("lost", ["/imu1", "/imu0"]), done.error
    quick = Settings(command="diagnose", quick=True, imu=("/imu1", "/imu0"))
    assert work(task(logs / "flight_1.mcap", tmp_path / "found", quick, name="flight_1.json")).status == "ok"


def test_done_again_it_is_the_same_byte_for_byte(done: Result, logs: Path, tmp_path: Path, settings: Settings) -> None:
    """Nothing in it tells of the time, the machine or the place."""
    moved = tmp_path / "elsewhere" / "flight_1.mcap"
    moved.parent.mkdir()
    moved.write_bytes((logs / "flight_1.mcap").read_bytes())
    assert work(task(moved, tmp_path / "other", settings)).target_sha256 == done.target_sha256
    assert work(task(logs / "flight_1.mcap", tmp_path / "out", settings)).target_sha256 == done.target_sha256


def test_a_machine_without_the_model_gets_it(done: Result, logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = (logs / "linear.safetensors").read_bytes()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    away = with_model_hash(Settings(command="debias", model=str(logs / "linear.safetensors")))
    away = msgspec.structs.replace(away, model="/not/here/linear.safetensors")
    assert work(task(logs / "flight_1.mcap", tmp_path / "far", away), model).target_sha256 == done.target_sha256
    spoiled = work(task(logs / "flight_1.mcap", tmp_path / "far", away), model + b"more")
    assert (spoiled.status, spoiled.exit_code) == ("failed", 6)


def test_what_stands_is_skipped(done: Result, logs: Path, tmp_path: Path, settings: Settings) -> None:
    target = tmp_path / "out" / "a" / "log.mcap"
    before = target.stat().st_mtime_ns
    again = work(task(logs / "flight_1.mcap", tmp_path / "out", settings, done=done, recheck=True))
    assert (again.status, again.earlier, again.target_sha256) == ("skipped", "ok", done.target_sha256)
    assert target.stat().st_mtime_ns == before


@pytest.mark.parametrize("harm", ["gone", "cut", "footer"])
def test_what_no_longer_stands_is_done_again(done: Result, logs: Path, tmp_path: Path, settings: Settings, harm: str) -> None:
    target = tmp_path / "out" / "a" / "log.mcap"
    whole = target.read_bytes()
    if harm == "gone":
        target.unlink()
    else:
        target.write_bytes(whole[:-100] + (b"" if harm == "cut" else bytes(100)))
    again = work(task(logs / "flight_1.mcap", tmp_path / "out", settings, done=done))
    assert again.status == "ok"
    assert target.read_bytes() == whole


def test_a_flipped_byte_is_seen_when_all_is_read_again(done: Result, logs: Path, tmp_path: Path, settings: Settings) -> None:
    target = tmp_path / "out" / "a" / "log.mcap"
    whole = bytearray(target.read_bytes())
    whole[len(whole) // 2] ^= 1
    target.write_bytes(whole)
    again = work(task(logs / "flight_1.mcap", tmp_path / "out", settings, done=done, recheck=True))
    assert (again.status, sha256(target)) == ("ok", done.target_sha256)


def test_every_flipped_byte_of_a_large_log_is_seen_by_its_digest(
    logs: Path, tmp_path: Path, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(targets, "LARGEST_HASHED", 1000)
    done = work(task(logs / "flight_1.mcap", tmp_path / "out", settings))
    assert (done.target_sha256, len(done.target_digest)) == ("", 64)
    again = work(task(logs / "flight_1.mcap", tmp_path / "out", settings, done=done, recheck=True))
    assert (again.status, again.target_digest) == ("skipped", done.target_digest)
    target = tmp_path / "out" / "a" / "log.mcap"
    whole = target.read_bytes()
    with Log(target) as log:
        chunks, end = log.index.blocks, log.index.data_end
    outside = [8, chunks[0].offset - 1, chunks[0].offset + 20, chunks[-1].end - 1, end - 1, end + 10, len(whole) - 9]
    for place in [*outside, *np.linspace(0, len(whole) - 1, 60, dtype=int).tolist()]:
        target.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        assert not is_current(done, target, whole=True), place
    target.write_bytes(whole)
    assert is_current(done, target, whole=True)


def test_the_time_of_a_log_does_not_grow_with_its_folder(logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "glob", lambda *_: pytest.fail("the whole folder is listed"))
    assert work(task(logs / "flight_1.mcap", tmp_path / "out", Settings(command="info"), "a/log.json")).status == "ok"


def test_a_damaged_log_is_a_result_and_leaves_nothing(logs: Path, tmp_path: Path, settings: Settings) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes((logs / "flight_1.mcap").read_bytes()[:50_000])
    found = work(task(broken, tmp_path / "out", settings))
    assert (found.status, found.exit_code, found.target_sha256) == ("failed", 5, "")
    assert "nothing in it can be saved" in found.error
    assert not [one for one in (tmp_path / "out").rglob("*") if one.is_file()]
    told = work(task(broken, tmp_path / "out", Settings(command="info")))  # which says what of it is left
    assert (told.status, told.exit_code, told.messages) == ("lost", 3, 0)
    assert "235250 bytes" in told.losses[0]


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A ROS 1 bag of forty messages in several chunks."""
    store, path = get_typestore(Stores.ROS1_NOETIC), tmp_path / "log.bag"
    text = store.types["std_msgs/msg/String"]
    writer = Writer(path)
    writer.chunk_threshold = 500
    with writer as out:
        connection = out.add_connection("/text", text.__msgtype__, typestore=store)
        for n in range(40):
            out.write(connection, 10**18 + n, bytes(store.serialize_ros1(text("x" * 100), text.__msgtype__)))
    return path


def bag_task(source: Path, out: Path, settings: Settings) -> Task:
    (one,) = find(str(source), Path("/nowhere"), bags=True).logs
    return Task(key="k", source=one, out=str(out), target=target_name(one.name, "repair"), settings=settings)


def test_a_bag_is_repaired_as_a_bag(bag: Path, tmp_path: Path) -> None:
    out, repair = tmp_path / "out", Settings(command="repair")
    whole = work(bag_task(bag, out, repair))
    assert (whole.status, whole.messages, whole.warnings) == ("ok", 40, ())
    bag.write_bytes(bag.read_bytes()[:7000])
    repair_bag(bag, tmp_path / "alone.bag")
    found = work(bag_task(bag, out, repair))
    assert (out / "log.bag").read_bytes() == (tmp_path / "alone.bag").read_bytes()
    assert (found.status, found.exit_code) == ("lost", 3)
    assert 0 < found.messages < 40
    assert "index: it was rebuilt" in found.warnings[0]
    with Reader(out / "log.bag") as reader:
        assert len(list(reader.messages())) == found.messages
    again = work(msgspec.structs.replace(bag_task(bag, out, repair), done=found))
    assert (again.status, again.earlier) == ("skipped", "lost")


def test_damaged_bytes_of_a_bag_cannot_be_kept(bag: Path, tmp_path: Path) -> None:
    found = work(bag_task(bag, tmp_path / "out", Settings(command="repair", damaged="keep")))
    assert (found.status, found.exit_code) == ("failed", ConfigError.exit_code)
    assert "a bag has no attachments" in found.error
    assert not [one for one in (tmp_path / "out").rglob("*") if one.is_file()]


def test_a_log_that_is_still_being_written_waits(logs: Path, tmp_path: Path, settings: Settings) -> None:
    growing = tmp_path / "growing.mcap"
    growing.write_bytes((logs / "flight_1.mcap").read_bytes())
    listed = task(growing, tmp_path / "out", settings)
    os.utime(growing, ns=(1, 1))
    assert "has changed since it was listed" in work(listed).error


def test_of_a_log_that_is_written_to_meanwhile_nothing_is_kept(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    growing = tmp_path / "growing.mcap"
    growing.write_bytes((logs / "flight_1.mcap").read_bytes())
    info = COMMANDS["info"]

    def while_it_grows(job: Any) -> dict[str, Any]:
        entries = info(job)
        os.utime(growing, ns=(1, 1))
        return entries

    monkeypatch.setitem(COMMANDS, "info", while_it_grows)
    done = work(task(growing, tmp_path / "out", Settings(command="info"), "growing.json"))
    assert (done.status, done.exit_code) == ("failed", LogError.exit_code)
    assert not (tmp_path / "out" / "growing.json").exists()


def test_a_result_of_an_earlier_run_is_named_where_this_one_fails(logs: Path, tmp_path: Path, settings: Settings) -> None:
    log, out = tmp_path / "log.mcap", tmp_path / "out"
    log.write_bytes((logs / "flight_1.mcap").read_bytes())
    assert work(task(log, out, settings, "log.mcap")).status == "ok"
    before = (out / "log.mcap").read_bytes()
    log.write_bytes(b"no log any more")
    failed = work(task(log, out, settings, "log.mcap"))
    assert failed.status == "failed"
    assert f"{out / 'log.mcap'} is from an earlier run" in failed.error
    assert (out / "log.mcap").read_bytes() == before


def test_a_log_that_has_gone_is_a_result(tmp_path: Path) -> None:
    source = Source(str(tmp_path / "gone.mcap"), "gone.mcap", 1, "1")
    out = Task(key="k", source=source, out=str(tmp_path), target="gone.json", settings=Settings(command="info"))
    assert (work(out).status, work(out).exit_code) == ("failed", ConfigError.exit_code)


def test_info_is_what_info_says(logs: Path, tmp_path: Path) -> None:
    found = work(task(logs / "flight_1.mcap", tmp_path, Settings(command="info"), "a.json"))
    report = json.loads((tmp_path / "a.json").read_text())
    assert (report["schema"], report["messages"]) == ("imutool.info/1", found.messages)
    assert found.duration_s == report["duration_s"]


def test_a_robot_is_its_folder_or_what_the_pattern_says(logs: Path, tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    write(
        read(logs / "flight_1.mcap").__class__(**{**vars(read(logs / "flight_1.mcap")), "metadata": {"unit": {"serial": "7"}}}),
        log,
    )
    assert robot_of("site/robot 3/log.mcap", None, log) == "site/robot 3"
    assert robot_of("robot_3.mcap", None, log) == "robot_3"
    assert robot_of("site/r3_monday.mcap", r"(r\d+)_", log) == "r3"
    assert robot_of("site/b_monday.mcap", r"(a)_|(b)_", log) == "b"
    with pytest.raises(ConfigError, match="matches nothing"):
        robot_of("site/monday.mcap", r"(r\d+)?", log)
    assert robot_of("any.mcap", "metadata:unit.serial", log) == "7"
    with pytest.raises(ConfigError, match="matches nothing"):
        robot_of("site/monday.mcap", r"(r\d+)_", log)
    with pytest.raises(ConfigError, match="has no 'name'"):
        robot_of("any.mcap", "metadata:unit.name", log)
    for wrong in ("(", "metadata:serial"):
        with pytest.raises(ConfigError, match="robot_from"):
            robot_pattern(wrong)


def test_names_are_made_of_a_log_whose_suffix_is_in_capital_letters_as_of_others():
    assert target_name("a/x.MCAP", "info") == target_name("a/x.mcap", "info") == "a/x.json"
    assert page_name("x.MCAP") == page_name("x.mcap") == "x.html"
