"""Labels that the user puts on a log: the sensor's name, and what its poses are worth."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

from imutool.errors import ConfigError
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.joined_imu import parse_parts, whole_of
from imutool.mcap_io.topics import ENCODINGS, MESSAGE_POSES
from imutool.mcap_io.write import RECORD
from imutool.recording import Recording
from imutool.recording.message_log import KINDS, MessageLog, MessageTopic

POSES = (*MESSAGE_POSES, schemas.TF, "geometry_msgs/msg/PoseArray")


@dataclass(frozen=True)
class Labels:
    """Labels of a log: `sensor` names the IMU, `kinds` says what the poses of a topic are worth."""

    sensor: str = ""
    kinds: tuple[tuple[str, str], ...] = ()
    parts: tuple[str, str] | None = None  # topics of a gyro and an accelerometer that become one IMU

    def put_on(self, content: Recording | MessageLog) -> Recording | MessageLog:
        """Content with the labels.

        Raises:
            ConfigError: a kind is stated for a topic without poses.
        """
        if self.sensor:
            own = {**content.metadata.get(RECORD, {}), "sensor": self.sensor}
            content = replace(content, metadata={**content.metadata, RECORD: own})
        if self.parts is not None:
            content = self._with_pair(content, self.parts)
        if not self.kinds:
            return content
        if isinstance(content, Recording):
            self._check(list(content.truths), content.name)
            if wrong := [f"{topic}={kind}" for topic, kind in self.kinds if kind != "truth"]:
                raise ConfigError(f"{wrong[0]}: the data set states that these poses are its truth", where="kinds")
            return content
        known = {topic.name: schemas.canonical(topic.schema_name) for topic in content.topics}
        poses = [*content.poses, *(name for name, kind in known.items() if kind in POSES)]
        others = [name for name in content.counts if name not in known]  # an MCAP log's, which the writer judges as they come
        self._check([*poses, *others], content.name, [f"{name}/pose" for name in (*known, *others)])
        return replace(content, kinds={**content.kinds, **dict(self.kinds)})

    def _with_pair(self, content: Recording | MessageLog, parts: tuple[str, str]) -> MessageLog:
        """Log with the IMU that two topics make up, on `imu` in the folder they share."""
        types = {topic.name: topic.schema_name for topic in content.topics} if isinstance(content, MessageLog) else {}
        topics = [name for name, kind in types.items() if kind == schemas.IMU]
        if isinstance(content, Recording) or not set(parts) <= set(topics):
            named, expected = " and ".join(parts), ", ".join(topics) or "a bag or a log with IMU topics"
            are_vectors = all(types.get(part) in schemas.VECTORS for part in parts)
            fix = "Convert without `imu`: other commands join these vectors by it" if are_vectors else ""
            raise ConfigError(f"no IMU messages to join on {named}", where="imu", expected=expected, fix=fix)
        return replace(content, pairs={whole_of(parts): parts})

    def _check(self, topics: Collection[str], name: str, perhaps: Collection[str] = ()) -> None:
        for topic, _ in self.kinds:
            if topic not in topics and topic not in perhaps:
                raise _without_poses(topic, topics, name)


def check_kinds(content: MessageLog, topics: Iterable[MessageTopic], made: Iterable[str]) -> None:
    """Refuse a kind of a topic that turned out to have no poses, as its encoding shows it.

    Raises:
        ConfigError: such a topic.
    """
    types = {topic.name: (topic.message_encoding, schemas.canonical(topic.schema_name)) for topic in topics}
    poses = [*content.poses, *made, *(name for name, (_, kind) in types.items() if kind in POSES)]
    for name in content.kinds:
        if name not in poses and types.get(name, ("cdr", ""))[0] in ENCODINGS:
            raise _without_poses(name, poses, content.name)


def _without_poses(topic: str, topics: Collection[str], name: str) -> ConfigError:
    have = ", ".join(topics) or "a recording with poses, which this one lacks"
    return ConfigError(f"{topic!r} holds no poses in {name}", where="kinds", expected=have)


def parse_kinds(texts: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Topics and kinds of `TOPIC=KIND` texts.

    Raises:
        ConfigError: no such text, or no such kind.
    """
    kinds = []
    for text in texts:
        topic, equals, kind = text.rpartition("=")
        if not (equals and topic and kind in KINDS):
            raise ConfigError(f"{text!r}", where="kinds", expected=f"TOPIC=KIND with one of {', '.join(KINDS)}")
        kinds.append((topic, kind))
    return tuple(kinds)


def parse_pair(text: str) -> tuple[str, str] | None:
    """Topics of `gyro=/a,accel=/b`; None of an empty text.

    Raises:
        ConfigError: any other text.
    """
    if (parts := parse_parts(text)) is None and text:
        raise ConfigError(f"{text!r}", where="imu", expected="gyro=TOPIC,accel=TOPIC")
    return parts
