"""ROS 2 bags in every storage: all topics arrive with the bytes they have."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

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
    assert (done.returncode, done.stderr.strip()) == (0, "")
    ours, _ = messages_of(log)
    assert len(ours) == 9 * COUNT
    assert {t: sum(topic == t for topic, _, _ in ours) for t in ("/left/imu", "/right/imu", "/load")} == dict.fromkeys(
        ("/left/imu", "/right/imu", "/load"), 3 * COUNT
    )
    with Reader(bag) as reader:
        theirs = [(c.topic, t_ns, bytes(data)) for c, t_ns, data in reader.messages()]
    assert sorted(ours) == sorted(theirs)
    assert [t for _, t, _ in ours] == sorted(t for _, t, _ in theirs)


@pytest.mark.parametrize("form", FORMS)
def test_every_message_arrives_with_its_bytes(convert, tmp_path, form):
    bag, log = write_bag(tmp_path / "bag", *FORMS[form]), tmp_path / "bag.mcap"
    done = convert(bag, log)
    assert (done.returncode, done.stderr.strip()) == (0, "")
    ours, definitions = messages_of(log)
    with Reader(bag) as reader:
        theirs = [(c.topic, t_ns, bytes(data)) for c, t_ns, data in reader.messages()]
    assert sorted(ours) == sorted(theirs)
    assert [t for _, t, _ in ours] == sorted(t for _, t, _ in theirs)
    assert "float64 load" in definitions["/load"]


def test_a_bag_without_metadata_and_a_lone_database_convert(convert, tmp_path):
    bag = write_bag(tmp_path / "bag", StoragePlugin.SQLITE3)
    (bag / "metadata.yaml").unlink()
    done = convert(bag, tmp_path / "a.mcap")
    assert done.returncode == 0
    assert "has no metadata.yaml" in done.stderr
    (database,) = bag.glob("*.db3")
    assert convert(database.rename(tmp_path / "found.sqlite"), tmp_path / "b.mcap").returncode == 0
    assert messages_of(tmp_path / "a.mcap") == messages_of(tmp_path / "b.mcap")


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


def test_the_public_sample_arrives_whole(convert, tmp_path, data):
    bag = data / "outside" / "bags" / "rosbag2_sqlite"
    done = convert(bag, tmp_path / "a.mcap")
    assert (done.returncode, done.stderr.strip()) == (0, "")
    ours, definitions = messages_of(tmp_path / "a.mcap")
    with Reader(bag) as reader:
        theirs = [(c.topic, t_ns, bytes(data)) for c, t_ns, data in reader.messages()]
    assert sorted(ours) == sorted(theirs)
    assert "float32 voltage" in definitions["/battery"]
