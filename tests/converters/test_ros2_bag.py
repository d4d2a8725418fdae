"""ROS 2 bags in every storage: all topics arrive with the bytes they have."""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from imutool.converters._ros_types import definition_from_files

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE.register(get_types_from_msg("float64 load\nstring[] names\n", "my_robot/msg/Load"))
TYPES = STORE.types
START_NS = 1_700_000_000_000_000_007
COUNT = 60


def imu(t_ns: int, n: int) -> Any:
    time = TYPES["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    header, xyz = TYPES["std_msgs/msg/Header"](time, "imu"), TYPES["geometry_msgs/msg/Vector3"]
    turn, none = TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0), np.zeros(9)
    return TYPES["sensor_msgs/msg/Imu"](header, turn, none, xyz(0.1, n, 0.3), none, xyz(n, 0.5, 9.8), none)


def load(t_ns: int, n: int) -> Any:
    return TYPES["my_robot/msg/Load"](n / 7, ["a"] * (n % 3))


def write_bag(path: Path, storage: StoragePlugin, compression: CompressionMode | None = None, start: int = 0) -> Path:
    writer = Writer(path, version=9, storage_plugin=storage)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer as bag:
        topics = {"/left/imu": imu, "/right/imu": imu, "/load": load}
        connections = {t: bag.add_connection(t, make(0, 0).__msgtype__, typestore=STORE) for t, make in topics.items()}
        for n in range(start, start + COUNT):
            t_ns = START_NS + n * 10_000_000
            for topic, make in topics.items():
                message = make(t_ns, n)
                bag.write(connections[topic], t_ns, STORE.serialize_cdr(message, message.__msgtype__))
    return path


def messages_of(log: Path) -> tuple[list[tuple[str, int, bytes]], dict[str, str]]:
    with log.open("rb") as file:
        every = [(s, c, m) for s, c, m in make_reader(file, validate_crcs=True).iter_messages()]
    return [(c.topic, m.log_time, m.data) for _, c, m in every], {c.topic: s.data.decode() for s, c, _ in every if s}


FORMS = {
    "sqlite3": (StoragePlugin.SQLITE3, None),
    "mcap": (StoragePlugin.MCAP, None),
    "sqlite3 by file": (StoragePlugin.SQLITE3, CompressionMode.FILE),
    "sqlite3 by message": (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
}


def split_bag(path: Path, *form: Any) -> Path:
    """A bag of three storage files, as the recorder splits one by size."""
    parts = [write_bag(path.parent / f"part_{n}", *form, start=n * COUNT) for n in range(3)]
    path.mkdir()
    files = [file.rename(path / f"{n}_{file.name}") for n, part in enumerate(parts) for file in part.glob("part_*")]
    text = (parts[0] / "metadata.yaml").read_text()
    (listed,) = (line for line in text.splitlines() if line.strip() == f"- {files[0].name[2:]}")
    text = text.replace(listed, "\n".join(listed.replace(files[0].name[2:], file.name) for file in files))
    text = text.replace(f"message_count: {COUNT}\n", f"message_count: {3 * COUNT}\n")
    (path / "metadata.yaml").write_text(text)
    return path


@pytest.mark.parametrize("form", FORMS)
def test_a_split_bag_arrives_whole(convert, tmp_path, form):
    bag, log = split_bag(tmp_path / "bag", *FORMS[form]), tmp_path / "bag.mcap"
    done = convert(bag, log)
    assert (done.returncode, [line for line in done.stderr.splitlines() if "state no CRC" not in line]) == (0, [])
    ours, _ = messages_of(log)
    assert len(ours) == 9 * COUNT
    assert {t: sum(topic == t for topic, _, _ in ours) for t in ("/left/imu", "/right/imu", "/load")} == dict.fromkeys(
        ("/left/imu", "/right/imu", "/load"), 3 * COUNT
    )
    with Reader(bag) as reader:
        theirs = [(c.topic, t_ns, bytes(data)) for c, t_ns, data in reader.messages()]
    assert sorted(ours) == sorted(theirs)
    assert [t for _, t, _ in ours] == sorted(t for _, t, _ in theirs)


def test_a_bag_that_is_compressed_by_file_is_read_without_its_metadata(convert, tmp_path):
    bag = write_bag(tmp_path / "bag", *FORMS["sqlite3 by file"])
    (bag / "metadata.yaml").unlink()
    done = convert(bag, tmp_path / "bag.mcap")
    assert done.returncode == 0, done.stderr
    assert len(messages_of(tmp_path / "bag.mcap")[0]) == 3 * COUNT
    assert "nothing in it shows" not in done.stderr


@pytest.mark.parametrize("form", FORMS)
def test_every_message_arrives_with_its_bytes(convert, tmp_path, form):
    bag, log = write_bag(tmp_path / "bag", *FORMS[form]), tmp_path / "bag.mcap"
    done = convert(bag, log)
    assert (done.returncode, [line for line in done.stderr.splitlines() if "state no CRC" not in line]) == (0, [])
    ours, definitions = messages_of(log)
    with Reader(bag) as reader:
        theirs = [(c.topic, t_ns, bytes(data)) for c, t_ns, data in reader.messages()]
    assert sorted(ours) == sorted(theirs)
    assert [t for _, t, _ in ours] == sorted(t for _, t, _ in theirs)
    assert "float64 load" in definitions["/load"]


@pytest.mark.parametrize("moved", ["", "renamed"])
def test_publish_times_and_topics_in_other_encodings_arrive(convert, tmp_path, moved):
    """Some recorders count no topic in metadata.yaml whose messages are not CDR."""
    bag = write_bag(tmp_path / "bag", StoragePlugin.MCAP)
    (file,) = bag.glob("*.mcap")
    with file.open("wb") as raw:
        writer = McapWriter(raw)
        writer.start("ros2")
        schema = writer.register_schema("my_robot/msg/Load", "ros2msg", b"")
        cdr, text = writer.register_channel("/load", "cdr", schema), writer.register_channel("/notes", "json", 0)
        for n in range(COUNT):
            t_ns = START_NS + n * 10_000_000
            writer.add_message(cdr, t_ns, bytes(STORE.serialize_cdr(load(0, n), "my_robot/msg/Load")), t_ns - 7)
            writer.add_message(text, t_ns, b"{}", t_ns - 9)
        writer.add_attachment(1, 1, "rig.yaml", "text/yaml", b"gain: 1")
        writer.finish()
    (bag / "Load.msg").write_text("float64 load\nstring[] names\n")
    if moved:
        file.rename(bag / f"{moved}.mcap")
    done = convert(bag, tmp_path / "out.mcap")
    assert done.returncode == 3
    assert f"/left/imu (0 of {COUNT})" in done.stderr
    with (tmp_path / "out.mcap").open("rb") as raw:
        every = [(c.topic, m.log_time - m.publish_time) for _, c, m in make_reader(raw).iter_messages()]
        raw.seek(0)
        assert [(each.name, each.data) for each in make_reader(raw).iter_attachments()] == [("rig.yaml", b"gain: 1")]
    assert Counter(every) == {("/load", 7): COUNT, ("/notes", 9): COUNT}
    assert "float64 load" in messages_of(tmp_path / "out.mcap")[1]["/load"]


def test_a_bag_without_metadata_and_a_lone_database_convert(convert, tmp_path):
    bag = write_bag(tmp_path / "bag", StoragePlugin.SQLITE3)
    (bag / "metadata.yaml").unlink()
    done = convert(bag, tmp_path / "a.mcap")
    assert done.returncode == 0
    assert "has no metadata.yaml" in done.stderr
    (database,) = bag.glob("*.db3")
    assert convert(database.rename(tmp_path / "found.sqlite"), tmp_path / "b.mcap").returncode == 0
    assert messages_of(tmp_path / "a.mcap") == messages_of(tmp_path / "b.mcap")


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
@pytest.mark.parametrize("alone", [False, True])
def test_messages_that_were_compressed_one_by_one_are_unpacked_without_metadata(convert, tmp_path, storage, alone):
    """Only metadata.yaml says that they are; the recorder writes it last, and a part of the bag may be sent alone."""
    bag = write_bag(tmp_path / "bag", storage, CompressionMode.MESSAGE)
    with Reader(bag) as reader:
        theirs = [(c.topic, t_ns, bytes(data)) for c, t_ns, data in reader.messages()]
    (bag / "metadata.yaml").unlink()
    done = convert(next(bag.glob("bag*.*")) if alone else bag, tmp_path / "bag.mcap")
    assert done.returncode == 0, done.stderr
    assert sorted(messages_of(tmp_path / "bag.mcap")[0]) == sorted(theirs)


def test_a_compressed_message_that_does_not_unpack_is_refused_in_one_sentence(convert, tmp_path):
    bag = write_bag(tmp_path / "bag", StoragePlugin.SQLITE3, CompressionMode.MESSAGE)
    (bag / "metadata.yaml").unlink()
    change(bag, "UPDATE messages SET data = substr(data, 1, 20) WHERE id = 5")
    done = convert(bag, tmp_path / "bag.mcap")
    assert done.returncode == 4
    assert "a compressed message does not unpack" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("form", ["zip", "gztar", "zip of its files"])
def test_a_packed_bag_reads_as_the_bag(convert, tmp_path, form):
    bag = split_bag(tmp_path / "bag", StoragePlugin.SQLITE3, None)
    where = {"root_dir": bag} if form == "zip of its files" else {"root_dir": tmp_path, "base_dir": "bag"}
    packed = shutil.make_archive(str(tmp_path / "packed" / "run"), form.partition(" ")[0], **where)
    assert convert(bag, tmp_path / "a.mcap").returncode == 0
    done = convert(packed, tmp_path / "b.mcap")
    assert done.returncode == 0, done.stderr
    assert f"note: {Path(packed).name}: it is packed" in done.stderr
    assert messages_of(tmp_path / "a.mcap") == messages_of(tmp_path / "b.mcap")


def unfinished(folder: Path, suffix: str, parts: int) -> Path:
    """A bag whose recorder died: numbered parts, and no metadata.yaml."""
    folder.mkdir()
    storage = StoragePlugin.MCAP if suffix == "mcap" else StoragePlugin.SQLITE3
    for n in range(parts):
        part = write_bag(folder.parent / f"{folder.name}_part_{n}", storage, start=n * COUNT)
        next(part.glob(f"*.{suffix}")).rename(folder / f"run_{n}.{suffix}")
    return folder


@pytest.mark.parametrize("suffix", ["mcap", "db3"])
def test_parts_without_metadata_are_read_in_the_order_of_their_times(convert, tmp_path, suffix):
    bag = unfinished(tmp_path / "walk", suffix, 11)
    (bag / "metadata.yaml").touch()  # the recorder had begun it
    done = convert(bag, tmp_path / "out.mcap")
    assert done.returncode == 0, done.stderr
    assert "the bag has no metadata.yaml" in done.stderr
    loads = [data for topic, _, data in messages_of(tmp_path / "out.mcap")[0] if topic == "/load"]
    assert loads == [bytes(STORE.serialize_cdr(load(0, n), "my_robot/msg/Load")) for n in range(11 * COUNT)]
    assert "goes back" not in done.stderr  # the writer names jumps of the clock


@pytest.mark.parametrize("storage", ["mcap", "db3"])
def test_files_of_a_bag_may_end_in_capital_letters(convert, tmp_path, storage):
    bag = unfinished(tmp_path / "walk", storage, 2)
    for file in [*bag.iterdir()]:
        file.rename(file.with_suffix(file.suffix.upper()))
    assert convert(bag, tmp_path / "out.mcap").returncode == 0
    assert len([topic for topic, *_ in messages_of(tmp_path / "out.mcap")[0] if topic == "/load"]) == 2 * COUNT


def test_an_unfinished_part_is_read_up_to_its_last_whole_chunk(convert, tmp_path):
    bag = unfinished(tmp_path / "walk", "mcap", 2)
    with (bag / "run_1.mcap").open("wb") as file:
        writer = McapWriter(file, chunk_size=1024)
        writer.start("ros2")
        schema = writer.register_schema("my_robot/msg/Load", "ros2msg", b"float64 load\nstring[] names\n")
        channel = writer.register_channel("/load", "cdr", schema)
        for n in range(COUNT, 2 * COUNT):
            message = bytes(STORE.serialize_cdr(load(0, n), "my_robot/msg/Load"))
            writer.add_message(channel, START_NS + n * 10_000_000, message, START_NS + n * 10_000_000)
    content = (bag / "run_1.mcap").read_bytes()  # `finish` was never called
    (bag / "run_1.mcap").write_bytes(content[:-20])
    done = convert(bag, tmp_path / "out.mcap")
    assert done.returncode == 3
    assert "run_1.mcap was not finished: it is read up to its last whole chunk, at byte" in done.stderr
    loads = [data for topic, _, data in messages_of(tmp_path / "out.mcap")[0] if topic == "/load"]
    assert COUNT < len(loads) < 2 * COUNT
    assert loads == [bytes(STORE.serialize_cdr(load(0, n), "my_robot/msg/Load")) for n in range(len(loads))]


@pytest.mark.parametrize("change", ["another name", "a pause"])
def test_logs_of_several_recordings_in_a_folder_are_logs_of_their_own(convert, tmp_path, change):
    bag = unfinished(tmp_path / "walks", "mcap", 1)
    later = write_bag(tmp_path / "later", StoragePlugin.MCAP, start=COUNT if change == "another name" else 100 * COUNT)
    name = "hall_1.mcap" if change == "another name" else "run_1.mcap"
    next(later.glob("*.mcap")).rename(bag / name)
    assert convert(bag, bag / "ours.mcap").returncode == 3  # several do not fit into one file
    for _ in range(2):  # what the first run wrote is no source of the second
        assert convert(bag, bag / "logs", "--overwrite").returncode == 0
        assert sorted(path.name for path in (bag / "logs").iterdir()) == sorted(["run_0.mcap", name])
    assert len(messages_of(bag / "logs" / name)[0]) == len(messages_of(bag / name)[0])


def test_what_sqlite_has_not_written_into_the_database_is_a_loss(convert, tmp_path):
    bag = unfinished(tmp_path / "walk", "db3", 1)
    with sqlite3.connect(bag / "run_0.db3") as database:
        database.execute("PRAGMA journal_mode=WAL")
        database.execute(
            "INSERT INTO messages (topic_id, timestamp, data) SELECT topic_id, timestamp, data FROM messages LIMIT 1"
        )
        database.commit()
        shutil.copytree(bag, tmp_path / "crashed")  # while it is open
    done = convert(tmp_path / "crashed", tmp_path / "out.mcap")
    assert done.returncode == 3
    assert "run_0.db3-wal may hold messages that the database lacks" in done.stderr
    assert len(messages_of(tmp_path / "out.mcap")[0]) == 3 * COUNT


@pytest.mark.parametrize(("storage", "suffix"), [(StoragePlugin.SQLITE3, "db3"), (StoragePlugin.MCAP, "mcap")])
def test_a_cut_bag_is_refused_in_one_sentence(convert, tmp_path, storage, suffix):
    bag = write_bag(tmp_path / "bag", storage)
    (database,) = bag.glob(f"*.{suffix}")
    database.write_bytes(database.read_bytes()[: database.stat().st_size // 2])
    done = convert(bag, tmp_path / "a.mcap")
    assert done.returncode == 4
    assert "cannot be read as a ROS 2 bag" in done.stderr
    assert ("each .mcap with imutool repair" in done.stderr) == (suffix == "mcap")
    assert not (tmp_path / "a.mcap").exists()


def test_metadata_of_another_type_is_refused_in_one_sentence(convert, tmp_path):
    bag = write_bag(tmp_path / "walk", StoragePlugin.SQLITE3)
    text = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(text.replace("nanoseconds: ", "nanoseconds: about ", 1))
    done = convert(bag, tmp_path / "out.mcap")
    assert done.returncode == 4
    assert "cannot be read as a ROS 2 bag" in done.stderr
    assert "Traceback" not in done.stderr


def change(bag: Path, statement: str) -> None:
    """Change the database of a bag."""
    (database,) = bag.glob("*.db3")
    with sqlite3.connect(database) as connection:
        connection.execute(statement)
    connection.close()


QOS = """- history: 3
  depth: 0
  reliability: 1
  durability: 2
  deadline: {sec: 2147483647, nsec: 4294967295}
  lifespan: {sec: 2147483647, nsec: 4294967295}
  liveliness: 1
  liveliness_lease_duration: {sec: 2147483647, nsec: 4294967295}
  avoid_ros_namespace_conventions: false
"""


def test_topics_whose_quality_of_service_differs_in_the_metadata_arrive(convert, tmp_path):
    bag = write_bag(tmp_path / "bag", StoragePlugin.SQLITE3)
    change(bag, f"UPDATE topics SET offered_qos_profiles = '{QOS}' WHERE name != '/load'")
    done = convert(bag, tmp_path / "a.mcap")
    assert (done.returncode, done.stderr.strip()) == (0, "")
    assert len(messages_of(tmp_path / "a.mcap")[0]) == 3 * COUNT


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_a_storage_file_that_was_renamed_is_read(convert, tmp_path, storage):
    bag = write_bag(tmp_path / "bag", storage)
    (file,) = (path for path in bag.iterdir() if path.suffix != ".yaml")
    file.rename(file.with_stem("walk"))
    done = convert(bag, tmp_path / "a.mcap")
    assert done.returncode == 0, done.stderr
    assert f"metadata.yaml names {file.name}, which the folder lacks; its files walk{file.suffix} were read" in done.stderr
    assert len(messages_of(tmp_path / "a.mcap")[0]) == 3 * COUNT


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_metadata_that_names_no_storage_is_passed_over(convert, tmp_path, storage):
    """As `ros2 bag reindex` of some versions writes it."""
    bag = write_bag(tmp_path / "bag", storage)
    text = (bag / "metadata.yaml").read_text()
    named = re.compile(r"storage_identifier: \w+")
    assert named.search(text)
    (bag / "metadata.yaml").write_text(named.sub('storage_identifier: ""', text))
    done = convert(bag, tmp_path / "a.mcap")
    assert done.returncode == 0, done.stderr
    assert "metadata.yaml names no storage, so its files" in done.stderr
    assert len(messages_of(tmp_path / "a.mcap")[0]) == 3 * COUNT


def test_a_missing_part_of_a_split_bag_is_a_loss(convert, tmp_path):
    bag = split_bag(tmp_path / "bag", StoragePlugin.SQLITE3, None)
    next(bag.glob("1_*")).unlink()
    done = convert(bag, tmp_path / "a.mcap")
    assert done.returncode == 3
    assert "which the folder lacks" in done.stderr
    assert len(messages_of(tmp_path / "a.mcap")[0]) == 6 * COUNT


def test_definitions_come_from_msg_files_beside_the_bag_or_in_the_workspace(convert, tmp_path, monkeypatch):
    bag = write_bag(tmp_path / "bag", StoragePlugin.SQLITE3)
    change(bag, "DELETE FROM message_definitions")
    done = convert(bag, tmp_path / "none.mcap")
    assert "source its ROS workspace, or copy Load.msg into the bag's folder" in done.stderr
    assert messages_of(tmp_path / "none.mcap")[1]["/load"] == ""
    text = "std_msgs/Header header\nPart[] parts\nfloat64 load\n"
    (bag / "Load.msg").write_text(text)
    assert "or copy Part.msg into the bag's folder" in convert(bag, tmp_path / "part.mcap").stderr
    workspace = tmp_path / "install" / "share" / "my_robot" / "msg"
    workspace.mkdir(parents=True)
    (workspace / "Part.msg").write_text("int32 number\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path / 'other'}{os.pathsep}{tmp_path / 'install'}")
    done = convert(bag, tmp_path / "a.mcap")
    assert (done.returncode, done.stderr.strip()) == (0, "")
    definition = messages_of(tmp_path / "a.mcap")[1]["/load"]
    assert "float64 load" in definition
    assert "MSG: my_robot/Part\nint32 number" in definition
    (bag / "Load.msg").write_text("float64\n")
    done = convert(bag, tmp_path / "b.mcap")
    assert done.returncode == 4
    assert "Load.msg: is no definition of my_robot/msg/Load" in done.stderr


def test_a_type_that_leads_to_another_folder_opens_no_file(tmp_path):
    (tmp_path / "Load.msg").write_text("float64 load\n")
    bag = tmp_path / "bag"
    bag.mkdir()
    assert definition_from_files("my_robot/msg/../Load", bag) == (b"", "my_robot/msg/../Load")


def test_the_public_sample_arrives_whole(convert, tmp_path, data):
    bag = data / "outside" / "bags" / "rosbag2_sqlite"
    done = convert(bag, tmp_path / "a.mcap")
    assert (done.returncode, done.stderr.strip()) == (0, "")
    ours, definitions = messages_of(tmp_path / "a.mcap")
    with Reader(bag) as reader:
        theirs = [(c.topic, t_ns, bytes(data)) for c, t_ns, data in reader.messages()]
    assert sorted(ours) == sorted(theirs)
    assert "float32 voltage" in definitions["/battery"]
