"""ROS 2 bag, sqlite3 or MCAP, split or compressed: every topic under its own name.

A bag is the folder with its metadata.yaml, a folder of storage files that its recorder did not finish, or a single .db3 file.
Bags of old ROS 2 versions hold no definitions: those of ROS 2 Jazzy stand in, then .msg files next to the bag or in the
workspace that is sourced. A type without any keeps its bytes, and is named.
"""

from __future__ import annotations

import re
import sqlite3
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cache, partial
from pathlib import Path, PurePath
from typing import Any

from imutool.errors import DataError
from imutool.recording.message_log import Message, MessageLog, MessageTopic, Remarks

from . import Sequence, mcap_log
from ._ros_types import IMAGES, definition_from_files, need_rosbags, plain_cdr, ros2_definition
from ._source import find_files, find_folders, head, with_suffix
from .mcap_log import METADATA, is_bag_folder

GENERAL = True
SQLITE = b"SQLite format 3\0"
LISTED = re.compile(r"relative_file_paths:\s*\n((?:\s*- .*\n)+)")
STATED = r"{}:[ \t]*['\"]?\w"  # a text of metadata.yaml that is not empty
MALFORMED = (ValueError, KeyError, TypeError, AttributeError, AssertionError)  # of metadata that rosbags does not check
ENCODINGS = {"MSG": "ros2msg", "IDL": "ros2idl"}


def sequences(source: Path) -> list[Sequence]:
    """Bag folders and storage files of sqlite3 in the source."""
    folders = find_folders(source, _is_bag)
    taken = [sequence.path for sequence in folders]
    files = [] if source in taken else find_files(source, (".db3",), lambda start: start.startswith(SQLITE))
    return folders + [file for file in files if file.path.parent not in taken and _has_messages(file.path)]


def parts(sequence: Sequence) -> list[Path]:
    """Storage files of a bag's folder: those that its metadata.yaml names, if all are there."""
    path = sequence.path
    named = [path / name for name in _named(path)] if path.is_dir() and is_bag_folder(path) else []
    return named if named and all(file.is_file() for file in named) else with_suffix(path, ".mcap")


def read_sequence(sequence: Sequence, *, images: bool = True) -> MessageLog:
    """Message log of a bag.

    Raises:
        ConfigError: rosbags is not installed.
        DataError: the bag cannot be read.
    """
    need_rosbags(sequence.path)
    remarks = Remarks()
    if files := _mcap_files(sequence.path):  # rosbags gives no publish times, and no messages that are not CDR
        return _of_mcap(sequence, files, remarks, images)
    with _open(sequence.path, remarks) as readers:
        topics: dict[str, MessageTopic] = {}
        counts = Counter[str]()
        for connection in (c for reader in readers for c in reader.connections):
            if images or connection.msgtype not in IMAGES:
                if connection.topic not in topics:
                    topics[connection.topic] = _topic(connection, sequence.path, remarks)
                counts[connection.topic] += connection.msgcount
    return MessageLog(
        sequence.name,
        sequence.path.name,
        topics=tuple(topics.values()),
        messages=partial(_messages, sequence.path, topics),
        counts=dict(counts),
        metadata={"imutool": {"format": "ros2_bag", "sequence": sequence.name}},
        remarks=remarks,
    )


def _mcap_files(path: Path) -> list[Path]:
    """Storage files of a bag with metadata.yaml, in order, where all are finished MCAP logs."""
    if not (path.is_dir() and is_bag_folder(path)):
        return []
    files = [path / name for name in _named(path)]
    if not all(file.is_file() for file in files):
        files = sorted(with_suffix(path, ".mcap"), key=mcap_log.first_ns)
    return files if all(mcap_log.is_finished(file) for file in files) else []


def _of_mcap(sequence: Sequence, files: list[Path], remarks: Remarks, images: bool) -> MessageLog:
    """Message log of the MCAP files of a bag; of a topic it counts what metadata.yaml does, if that is more."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    _misleads(sequence.path, remarks)
    define = cache(partial(_with_definition, path=sequence.path, remarks=remarks))
    log = mcap_log.read_parts(sequence, files, remarks, images=images, define=define)
    try:
        about = YAML(typ="safe").load(sequence.path / METADATA)["rosbag2_bagfile_information"]
        listed = [(topic["topic_metadata"], topic["message_count"]) for topic in about["topics_with_message_count"]]
        stated = {topic["name"]: count for topic, count in listed if images or topic["type"] not in IMAGES}
        counts = {name: max(log.counts.get(name, 0), stated.get(name, 0)) for name in {**stated, **log.counts}}
    except (YAMLError, *MALFORMED) as error:
        raise _refusal(sequence.path, error) from error
    identity = {"format": "ros2_bag", "sequence": sequence.name}
    return replace(log, counts=counts, metadata={**log.metadata, "imutool": identity})


def read(source: Path) -> Iterator[MessageLog]:
    """Message logs of all bags of the source, one after the other."""
    return map(read_sequence, sequences(source))


def _is_bag(folder: Path) -> bool:
    return is_bag_folder(folder) or any(_has_messages(path) for path in with_suffix(folder, ".db3"))


def _has_messages(path: Path) -> bool:
    """Whether a database has the tables of a bag; a damaged one counts by its name, and says why when it is read."""
    if head(path, len(SQLITE)) != SQLITE:
        return False
    try:
        with sqlite3.connect(f"file:{path}?immutable=1", uri=True) as database:
            names = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    except sqlite3.Error:
        return path.suffix.lower() == ".db3"
    return {"topics", "messages"} <= names


def _first_ns(path: Path) -> int:
    """Time of the first message of a database; 0 if there is none: names of parts do not sort, `_10` comes before `_2`."""
    try:
        with sqlite3.connect(f"file:{path}?immutable=1", uri=True) as database:
            return int(database.execute("SELECT min(timestamp) FROM messages").fetchone()[0] or 0)
    except sqlite3.Error:
        return 0


def _topic(connection: Any, path: Path, remarks: Remarks) -> MessageTopic:
    """Topic with the definition in the bag, that of ROS 2 Jazzy, or that of .msg files."""
    kind, form = connection.msgtype, connection.msgdef.format.name
    metadata: tuple[tuple[str, str], ...] = (("topic_type_hash", connection.digest),) if connection.digest else ()
    if connection.ext.offered_qos_profiles:
        from rosbags.rosbag2.metadata import dump_qos_v8

        metadata += (("offered_qos_profiles", dump_qos_v8(connection.ext.offered_qos_profiles)),)
    if form in ENCODINGS:
        return MessageTopic(connection.topic, kind, ENCODINGS[form], connection.msgdef.data.encode(), "cdr", metadata)
    return _with_definition(MessageTopic(connection.topic, kind, "", b"", "cdr", metadata), path=path, remarks=remarks)


def _with_definition(topic: MessageTopic, *, path: Path, remarks: Remarks) -> MessageTopic:
    """The topic, with the definition of ROS 2 Jazzy or of .msg files where the bag has none."""
    kind = topic.schema_name
    if topic.schema or topic.message_encoding != "cdr" or not kind:
        return topic
    known = ros2_definition(kind)
    text, missing = (known[0], "") if known else definition_from_files(kind, path if path.is_dir() else path.parent)
    if missing:
        kept = f"{topic.name} has no definition of its {kind}: its messages are kept as they are"
        fix = f"source its ROS workspace, or copy {missing.rpartition('/')[2]}.msg into the bag's folder, and convert again"
        remarks.notes.append(f"{kept}; to have its numbers, {fix}")
        return topic
    return replace(topic, schema_encoding="ros2msg", schema=text)


def _messages(path: Path, topics: dict[str, MessageTopic]) -> Iterator[Message]:
    with _open(path, Remarks()) as readers:
        for reader in readers:
            files = getattr(reader, "storages", [reader])  # metadata.yaml may state another quality of service than the files
            wanted = [c for file in files for c in file.connections if c.topic in topics]
            for connection, time_ns, payload in reader.messages(wanted):
                yield Message(topics[connection.topic], time_ns, time_ns, plain_cdr(payload))


def _text(folder: Path) -> str:
    return (folder / METADATA).read_text(encoding="utf-8", errors="replace") + "\n"


def _named(folder: Path) -> list[str]:
    """Names of the storage files in metadata.yaml."""
    match = LISTED.search(_text(folder))
    return [PurePath(line.strip()[2:].strip("'\" ")).name for line in match[1].splitlines()] if match else []


def _misleads(folder: Path, remarks: Remarks) -> bool:
    """Whether metadata.yaml names no storage, or files that are not there, but others are; fewer than it names are a loss."""
    text, named = _text(folder), _named(folder)
    missing = [name for name in named if not (folder / name).exists()]
    present = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in (".db3", ".mcap"))
    if present and not any(re.search(STATED.format(key), text) for key in ("storage_identifier", "compression_format")):
        remarks.notes.append(f"{METADATA} names no storage, so its files {', '.join(present)} were read one by one")
        return True
    if not missing or not present:
        return False
    note = f"{METADATA} names {', '.join(missing)}, which the folder lacks; its files {', '.join(present)} were read instead"
    (remarks.notes if len(present) >= len(named) else remarks.losses).append(note)
    return True


@contextmanager
def _open(path: Path, remarks: Remarks) -> Iterator[list[Any]]:
    """Open a bag folder, or storage files one by one.

    Raises:
        DataError: rosbags or SQLite cannot read it.
    """
    import apsw
    from rosbags.rosbag2 import ReaderError
    from rosbags.rosbag2.reader import DirectoryReader
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    readers: list[Any]
    if path.is_file():
        readers = [Sqlite3Reader(path)]
    elif is_bag_folder(path) and not _misleads(path, remarks):
        readers = [DirectoryReader(path)]
    else:
        readers = [Sqlite3Reader(file) for file in sorted(with_suffix(path, ".db3"), key=_first_ns) if _has_messages(file)]
        readers = readers or [McapReader(file) for file in with_suffix(path, ".mcap")]
        if not is_bag_folder(path):
            remarks.notes.append(f"the bag has no {METADATA}; its storage files were read in order of their first messages")
    for log in path.glob("*.db3-wal") if path.is_dir() else path.parent.glob(f"{path.name}-wal"):
        if log.stat().st_size:
            command = f"sqlite3 {log.name.removesuffix('-wal')} 'PRAGMA wal_checkpoint(TRUNCATE)'"
            fix = f"to have them, run {command} in a copy of the bag"
            remarks.losses.append(f"{log.name} may hold messages that the database lacks, and is not read; {fix}")
    try:
        with ExitStack() as stack:
            for reader in readers:
                reader.open()
                stack.callback(reader.close)
            yield readers
    except (ReaderError, apsw.Error, OSError, EOFError, zlib.error, *MALFORMED) as error:
        raise _refusal(path, error) from error


def _refusal(path: Path, error: Exception) -> DataError:
    """Error of a bag that cannot be read."""
    reason = str(error).partition("\n")[0] or type(error).__name__
    fix = "Save what is intact of each .mcap with imutool repair, and convert that" if with_suffix(path, ".mcap") else ""
    return DataError(f"cannot be read as a ROS 2 bag ({reason})", where=path, fix=fix)
