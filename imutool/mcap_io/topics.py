"""The topics of a log, and what kinds of them are told apart: by their messages, and by who made them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from imutool.errors import LogError
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.index import LogIndex

ENCODINGS = ("cdr", "ros1")
DERIVED_KEY = "imutool_source_topic"  # channel metadata: computed by imutool from this topic

MESSAGE_POSES = (schemas.POSE, schemas.ODOMETRY, schemas.TRANSFORM)
SCALARS = {schemas.FLOAT: 1, schemas.VECTOR3: 3}


@dataclass(frozen=True)
class Topic:
    """A topic as its Channel record describes it; several channels of one topic count as one."""

    name: str
    schema_name: str  # in ROS 2 spelling; empty where the channel has no schema
    schema_encoding: str
    message_encoding: str
    count: int
    metadata: Mapping[str, str]


def topics_of(structure: LogIndex) -> dict[str, Topic]:
    """The topics of a log by their names, in order of their channel ids.

    Raises:
        LogError: two channels of one topic carry different messages.
    """
    found: dict[str, Topic] = {}
    counts = structure.counts()
    for identity, channel in sorted(structure.channels.items()):
        kind = structure.schemas.get(channel.schema_id)
        before = found.get(channel.topic)
        found[channel.topic] = Topic(
            channel.topic,
            schemas.canonical(kind.name) if kind else "",
            kind.encoding if kind else "",
            channel.message_encoding,
            counts.get(identity, 0) + (before.count if before else 0),
            MappingProxyType(dict(channel.metadata)),
        )
        if before and (before.schema_name, before.message_encoding) != (
            found[channel.topic].schema_name,
            found[channel.topic].message_encoding,
        ):
            raise LogError(f"{channel.topic} carries {before.schema_name} and {found[channel.topic].schema_name}")
    return found
