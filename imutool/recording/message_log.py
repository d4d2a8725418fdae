"""Message log: topics of any type, as arrays or as encoded messages.

A `Recording` holds one IMU as arrays. A `MessageLog` holds what a robot recorded: every topic, in its own encoding, streamed
in bounded memory. What a converter knows as numbers (`imus`, `poses`, `scalars`, `tables`) it gives as arrays.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from imutool.array_types import Shaped
from imutool.recording import Imu, Poses, Scalars, Times

KINDS = ("truth", "estimate", "odometry", "unknown")  # what poses are worth

COMMAND = "command"  # where a robot shall go: poses that are of no body
KIND_WORDS = {  # in the names of topics
    "truth": "ground_truth|groundtruth|gt|truth|mocap|vicon|vrpn|optitrack|qualisys|natnet",
    COMMAND: "set_?points?|goals?|way_?points?|desired|planned|cmd|command(s|ed)?|target_pose",
    "estimate": r"filter(ed)?|fused|fusion|estimat(e|ed|or|ion)|ekf|ukf|kalman|slam\d?|vio|vins|msckf|okvis|orb|lio|amcl|ndt|"
    "rovio|svo|localization|tracked_pose|local_position|vision|zed_node",
    "odometry": "odom|odometry|wheel|wheels|encoder|encoders",
}

TRUE_TYPES = r"^(mocap|motion_capture|gazebo)\w*/"  # of messages
DOUBTFUL = ("estimate", "odometry", COMMAND)  # kinds of poses that no command uses unasked
ESTIMATED = r"PoseWithCovarianceStamped$|TFMessage$|FrameTransforms?$"  # a filter states its covariance, or moves the frames


@dataclass(frozen=True)
class MessageTopic:
    """Topic whose messages pass as bytes: its schema, encoding and channel metadata."""

    name: str
    schema_name: str
    schema_encoding: str
    schema: bytes
    message_encoding: str
    metadata: tuple[tuple[str, str], ...] = ()

    def __hash__(self) -> int:  # of every message, whose topic is looked up
        return hash(self.name)


class Message(NamedTuple):
    """Encoded message of a topic with its log and publish times (ns)."""

    topic: MessageTopic
    log_time: int
    publish_time: int
    payload: bytes | memoryview


class Attachment(NamedTuple):
    """Attachment record of an MCAP log, where its bytes lie: the data may be larger than memory."""

    path: Path
    offset: int  # of the record
    length: int  # of the whole record


@dataclass(frozen=True)
class Table:
    """Columns of numbers on one clock, written as messages of a type made from them.

    `columns` is a structured array. A field may have a subarray shape: `gyro_rad` of three numbers.
    """

    t_ns: Times
    columns: Shaped[np.ndarray, " n"]
    schema_name: str

    def __post_init__(self) -> None:
        if len(self.t_ns) != len(self.columns):
            raise ValueError(f"{len(self.t_ns)} times for {len(self.columns)} rows")


@dataclass
class Remarks:
    """Sentences about a conversion.

    `losses` say what of the source is not in the log. `doubts` are the notes that ask whether something is stated rightly.
    """

    notes: list[str] = field(default_factory=list)
    losses: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)

    def doubt(self, sentences: list[str]) -> None:
        """Enter doubts, which are notes, too."""
        self.notes += sentences
        self.doubts += sentences


def named_kind(topic: str, schema_name: str) -> str:
    """Kind of poses by their topic's name, then by their type; `COMMAND` of those of no body."""
    words = "_".join(filter(None, re.split(r"[^a-z0-9]+", topic.lower())))
    for kind, pattern in KIND_WORDS.items():
        if re.search(rf"(^|_)({pattern})(_|$)", words):
            return kind
    if re.search(TRUE_TYPES, schema_name):
        return "truth"
    if re.search(r"[/.]Odometry$", f"/{schema_name}"):
        return "odometry"
    return "estimate" if re.search(ESTIMATED, schema_name) else "unknown"


def computed_kind(topic: str, schema_name: str) -> str:
    """Kind of poses that a sensor computes with its IMU: an estimate, unless a name says more."""
    kind = named_kind(topic, schema_name)
    return "estimate" if kind == "unknown" else kind


def no_messages() -> Iterator[Message]:
    """Yield nothing: the messages of a log that is all arrays."""
    yield from ()


@dataclass(frozen=True)
class MessageLog:
    """Log of several topics: arrays by topic, and encoded messages in log-time order.

    `topics` are defined ahead of the messages; `messages` may use further ones. `counts` states how many messages of a
    topic the source says it has; the writer compares. `kinds` says what the poses of a topic are worth, where the source
    knows. `remarks` grows while the messages are read.
    """

    name: str
    source: str
    topics: tuple[MessageTopic, ...] = ()
    messages: Callable[[], Iterator[Message]] = no_messages
    counts: Mapping[str, int] = field(default_factory=dict)
    imus: Mapping[str, Imu] = field(default_factory=dict)
    poses: Mapping[str, Poses] = field(default_factory=dict)
    scalars: Mapping[str, Scalars] = field(default_factory=dict)
    tables: Mapping[str, Table] = field(default_factory=dict)
    kinds: Mapping[str, str] = field(default_factory=dict)
    pairs: Mapping[str, tuple[str, str]] = field(default_factory=dict)  # IMU topic: topics of its gyro and accelerometer
    metadata: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    attachments: tuple[Attachment, ...] = ()
    remarks: Remarks = field(default_factory=Remarks)
