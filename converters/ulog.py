"""PX4 ULog (.ulg): IMUs in FLU, EKF poses as an estimate, simulated truth, every topic.

Frames: PX4 measures in FRD (x forward, y right, z down) and its world is NED. The IMU and pose topics are written in FLU (x
forward, y left, z up) and ENU, as ROS has them: y and z of the body change sign. The topics of PX4 keep its own frames, as
messages of the types px4_msgs. Stamps are PX4's own clock, in most logs the time since boot.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import replace
from functools import partial
from io import BufferedReader, FileIO, StringIO
from mmap import ACCESS_READ, mmap
from os import fstat
from pathlib import Path
from typing import Any

from imutool.errors import DataError, required
from imutool.recording.message_log import Message, MessageLog, MessageTopic, Remarks

from . import Sequence
from ._px4_topics import Columns, log_of, poses_of
from ._source import find_files, head

GENERAL = True
MAGIC, ENCRYPTED = b"ULog\x01\x12\x35", b"ULogEnc"
HEADER_BYTES = 16
READS_A_BYTE = 2  # at most: where it finds damage, pyulog reads head and content of a message at each byte
LATEST_US = 2**31 * 1_000_000  # that the stamp of a ROS 2 message holds
LOG_DEFINITION = (
    "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\nuint32 line\n"
    f"{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
LOG_LEVELS = {"DEBUG": 10, "INFO": 20, "NOTICE": 20, "WARNING": 30, "ERROR": 40}  # of rcl_interfaces/Log; others are fatal
TEXTS = MessageTopic("/logged_messages", "rcl_interfaces/msg/Log", "ros2msg", LOG_DEFINITION.encode(), "cdr")


def sequences(source: Path) -> list[Sequence]:
    """ULog files in the source, by their first bytes."""
    return find_files(source, (".ulg", ".ulge"), lambda start: start.startswith((MAGIC, ENCRYPTED)))


def read_sequence(sequence: Sequence, *, images: bool = True) -> MessageLog:
    """Message log of a ULog.

    Raises:
        ConfigError: pyulog is not installed.
        DataError: the file is encrypted, damaged beyond reading, or holds no data.
    """
    ulog = _open(sequence.path)
    remarks = Remarks()
    topics: dict[str, Columns] = {}
    several = {data.name for data in ulog.data_list if data.multi_id > 0}
    for data in ulog.data_list:
        name = f"{data.name}/{data.multi_id}" if data.name in several else data.name
        if len(data.data.get("timestamp", ())):
            topics[name] = data.data
    if not topics:
        raise DataError("holds no data", where=sequence.path, expected="a log with messages")
    if ulog.file_corruption:
        remarks.losses.append("the file is damaged: some of its messages could not be read")
    elif _is_cut(sequence.path):
        remarks.losses.append("the file ends within a message: what came after is lost")
    if ulog.dropouts:
        lost_s = sum(dropout.duration for dropout in ulog.dropouts) * 1e-3
        remarks.notes.append(f"PX4's dropouts: {len(ulog.dropouts)}, {lost_s:.3f} s in all: the topics have gaps there")
    if unstamped := sum(int((columns["timestamp"] == 0).sum()) for columns in topics.values()):
        remarks.notes.append(f"messages that PX4 gave no stamp: {unstamped}; they are logged at the start of the log")
    poses = poses_of(topics, remarks)
    start_ns = 1000 * ulog.start_timestamp if ulog.start_timestamp < LATEST_US else 0  # damaged
    texts = [(m.timestamp * 1000, m.log_level_str(), m.message) for m in ulog.logged_messages if m.timestamp < LATEST_US]
    if len(texts) < len(ulog.logged_messages):
        remarks.losses.append(f"texts with an impossible time: {len(ulog.logged_messages) - len(texts)}")
    log = log_of(sequence, "ulog", topics, poses, start_ns, remarks)
    messages, metadata = partial(_logged, texts), {**log.metadata, **_metadata(ulog)}
    return replace(log, topics=(TEXTS,) if texts else (), messages=messages, metadata=metadata)


def read(source: Path) -> Iterator[MessageLog]:
    """Message logs of all ULogs of the source, one after the other."""
    return map(read_sequence, sequences(source))


def _open(path: Path) -> Any:
    pyulog = required("pyulog", "ulog", where=path, user="reading ULogs")
    if head(path, len(ENCRYPTED)) == ENCRYPTED:
        raise DataError("is encrypted", where=path, fix="Decrypt it with PX4's Tools/decrypt_ulog.py first")
    logging.getLogger("pyulog").setLevel(logging.ERROR)
    try:
        # pyulog leaves a file that it refuses open, and prints where our reports go
        with _FiniteFile(FileIO(path)) as file, redirect_stdout(StringIO()):
            return pyulog.ULog(file, None, True)
    except Exception as error:  # pyulog raises TypeError, struct.error, KeyError, IndexError: whatever the bytes lead to
        raise DataError(f"cannot be read as a ULog ({error or type(error).__name__})", where=path) from error


class _FiniteFile(BufferedReader):
    """File that can be read a limited number of times: pyulog 1.3 reads one kind of damage for ever."""

    def __init__(self, raw: FileIO) -> None:
        super().__init__(raw)
        self._left = READS_A_BYTE * fstat(raw.fileno()).st_size + HEADER_BYTES

    def read(self, size: int | None = -1, /) -> bytes:
        """Some bytes, until there were more readings than a file of this size can need."""
        self._left -= 1
        if self._left < 0:
            raise EOFError("it begins again and again")
        return super().read(size)


def _is_cut(path: Path) -> bool:
    """Whether a sound ULog ends within a message, as after a loss of power; pyulog does not tell."""
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as raw:
        position = HEADER_BYTES
        while position + 3 <= len(raw):  # size of what follows (two bytes) and kind (one)
            position += 3 + raw[position] + 256 * raw[position + 1]
        return position != len(raw)


def _metadata(ulog: Any) -> dict[str, dict[str, str]]:
    return {
        "px4/info": {name: str(value) for name, value in ulog.msg_info_dict.items()},
        "px4/parameters": {name: str(value) for name, value in ulog.initial_parameters.items()},
        "px4/changed_parameters": {f"{t} us {name}": str(value) for t, name, value in ulog.changed_parameters},
        "px4/dropouts": {f"{dropout.timestamp} us": f"{dropout.duration} ms" for dropout in ulog.dropouts},
    }


def _logged(lines: list[tuple[int, str, str]]) -> Iterator[Message]:
    """Text messages of PX4, as ROS 2 logs them."""
    for t_ns, level, text in sorted(lines, key=lambda line: line[0]):
        payload = bytearray(b"\0\1\0\0") + struct.pack("<iIB", *divmod(t_ns, 10**9), LOG_LEVELS.get(level, 50))
        for part in ("px4", text, "", ""):
            _put_text(payload, part)
        payload += bytes(-(len(payload) - 4) % 4) + struct.pack("<I", 0)
        yield Message(TEXTS, t_ns, t_ns, bytes(payload))


def _put_text(payload: bytearray, text: str) -> None:
    raw = text.encode("utf-8", "replace") + b"\0"
    payload += bytes(-(len(payload) - 4) % 4) + struct.pack("<I", len(raw)) + raw
