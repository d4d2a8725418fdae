"""Export a log as a rosbag2 folder: a byte-for-byte copy and its metadata.yaml."""

from __future__ import annotations

import hashlib
import json
import os
import re
from pathlib import Path

from imutool.errors import ConfigError, LogError
from imutool.exporting import ExportReport
from imutool.file_location import identity
from imutool.mcap_io.log import Log
from imutool.mcap_io.storage.target import SIGNATURE, FolderTarget, writing
from imutool.report import NamedProgress

COPY_BYTES = 1 << 20
VERSION = 5  # of metadata.yaml: the oldest with a list of files, so that Humble plays it, and every later one too
QOS_NUMBERS = {  # as rmw numbers them; names came with version 9
    "history": ("system_default", "keep_last", "keep_all", "unknown"),
    "reliability": ("system_default", "reliable", "best_effort", "unknown", "best_available"),
    "durability": ("system_default", "transient_local", "volatile", "unknown", "best_available"),
    "liveliness": ("system_default", "automatic", "manual_by_node", "manual_by_topic", "unknown", "best_available"),
}


def write(log: Path, out: Path, overwrite: bool, tell: NamedProgress) -> ExportReport:
    """Writes the folder `out`; the arguments are those of `imutool.export`."""
    before = identity(log)
    with Log(log) as opened:
        _check_readable(opened)
        name = f"{out.absolute().name}_0.mcap"
        text = _metadata_yaml(opened, name)
        counts = {topic.name: topic.count for topic in opened.topics.values()}
    holds = rf"metadata\.yaml|{re.escape(name)}"
    with FolderTarget(out, log, signed="metadata.yaml", holds=holds, overwrite=overwrite) as folder, writing(out):
        _copy(log, folder / name, tell)
        if identity(log) != before:  # the index and the bytes are of two logs
            raise LogError("changed while it was copied", where=log, fix="Wait until it is complete")
        (folder / "metadata.yaml").write_text(text, encoding="utf-8", newline="\n")
    return ExportReport(out, "rosbag2", None, counts, [])


def _check_readable(log: Log) -> None:
    """Refuses a log that rosbag2 cannot read as it is.

    Raises:
        LogError: the profile is another, or a topic is not in CDR or has no schema.
    """
    if log.index.header.profile != "ros2":
        what, expected = f"the log's profile is {log.index.header.profile!r}", "'ros2', the only one rosbag2 holds"
        raise LogError(what, where=log.path, expected=expected, fix="Use `format=euroc`")
    for topic in log.topics.values():
        if topic.message_encoding != "cdr" or not topic.schema_name:
            what = (
                f"{topic.name} is encoded as {topic.message_encoding!r}" if topic.schema_name else f"{topic.name} has no schema"
            )
            raise LogError(what, where=log.path, expected="CDR messages of ROS 2", fix="Use `format=euroc`")


def _copy(log: Path, copy: Path, tell: NamedProgress) -> None:
    """Copies the log into a file of its own, reads it back and compares.

    Raises:
        LogError: the log changed while it was copied.
        ConfigError: what was written does not read back the same.
    """
    size, done, digest = log.stat().st_size, 0, hashlib.sha256()
    with log.open("rb") as source, copy.open("xb") as target:
        while block := source.read(COPY_BYTES):
            digest.update(block)
            target.write(block)
            done += len(block)
            tell(done, 2 * size, copy.name)
        target.flush()
        os.fsync(target.fileno())
    if done != size:
        raise LogError("changed while it was copied", where=log, fix="Wait until it is complete")
    copied = hashlib.sha256()
    with copy.open("rb") as written:
        while block := written.read(COPY_BYTES):
            copied.update(block)
            done += len(block)
            tell(done, 2 * size, copy.name)
    if copied.digest() != digest.digest():
        raise ConfigError("does not read back as it was written", where=copy.parent, fix="Look at the disk")


def _metadata_yaml(log: Log, name: str) -> str:
    """The text of metadata.yaml; JSON strings are YAML strings."""
    ends = [(int(t.min()), int(t.max())) for _, t in log.stamps_of(log.topics)]
    start = min((first for first, _ in ends), default=0)
    duration = max((last for _, last in ends), default=0) - start
    total = sum(topic.count for topic in log.topics.values())
    times = (
        f"{{}}starting_time:\n{{}}  nanoseconds_since_epoch: {start}\n{{}}duration:\n{{}}  nanoseconds: {duration}\n"
        f"{{}}message_count: {total}\n"
    )
    text = f"{SIGNATURE}\nrosbag2_bagfile_information:\n  version: {VERSION}\n  storage_identifier: mcap\n" + _indented(
        times, 2
    )
    text += "  topics_with_message_count:" + ("\n" if log.topics else " []\n")
    for topic in log.topics.values():
        text += (
            "    - topic_metadata:\n"
            f"        name: {_quoted(topic.name)}\n"
            f"        type: {_quoted(topic.own_schema or topic.schema_name)}\n"
            "        serialization_format: cdr\n"
            f"        offered_qos_profiles: {_quoted(_qos(topic.metadata.get('offered_qos_profiles', '')))}\n"
            f"      message_count: {topic.count}\n"
        )
    text += f'  compression_format: ""\n  compression_mode: ""\n  relative_file_paths:\n    - {_quoted(name)}\n'
    return text + f"  files:\n    - path: {_quoted(name)}\n" + _indented(times, 6)


def _indented(text: str, by: int) -> str:
    return text.replace("{}", " " * by)


def _qos(text: str) -> str:
    """Offered qualities of service with numbers in place of names."""

    def number(found: re.Match[str]) -> str:
        names = QOS_NUMBERS[found[2]]
        return f"{found[1]}{names.index(found[3])}" if found[3] in names else found[0]

    return re.sub(r"^([-\s]*(history|reliability|durability|liveliness): *)(\w+)", number, text, flags=re.MULTILINE)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=True)
