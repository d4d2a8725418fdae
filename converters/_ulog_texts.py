"""Text messages of PX4, as ROS 2 logs them (`rcl_interfaces/msg/Log`)."""

from __future__ import annotations

import struct
from collections.abc import Iterator

from imutool.recording.message_log import Message, MessageTopic

LOG_DEFINITION = (
    "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\nuint32 line\n"
    f"{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
LOG_LEVELS = {"DEBUG": 10, "INFO": 20, "NOTICE": 20, "WARNING": 30, "ERROR": 40}  # of rcl_interfaces/Log; others are fatal


def log_topic() -> MessageTopic:
    """Topic of the texts."""
    return MessageTopic("/logged_messages", "rcl_interfaces/msg/Log", "ros2msg", LOG_DEFINITION.encode(), "cdr")


def logged(lines: list[tuple[int, str, str]]) -> Iterator[Message]:
    """Text messages of PX4, as ROS 2 logs them."""
    topic = log_topic()
    for t_ns, level, text in sorted(lines, key=lambda line: line[0]):
        payload = bytearray(b"\0\1\0\0") + struct.pack("<iIB", *divmod(t_ns, 10**9), LOG_LEVELS.get(level, 50))
        for part in ("px4", text, "", ""):
            _put_text(payload, part)
        payload += bytes(-(len(payload) - 4) % 4) + struct.pack("<I", 0)
        yield Message(topic, t_ns, t_ns, bytes(payload))


def _put_text(payload: bytearray, text: str) -> None:
    raw = text.encode("utf-8", "replace") + b"\0"
    payload += bytes(-(len(payload) - 4) % 4) + struct.pack("<I", len(raw)) + raw
