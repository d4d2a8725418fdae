"""Topics of a log, and batches of their messages."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np

from imutool.array_types import Bool, Float64, Int64, Shaped, UInt8
from imutool.errors import LogError
from imutool.mcap_io.codec import messages, ros2_definition, schemas
from imutool.mcap_io.codec.decode import (
    CUT,
    ImuBatch,
    PoseBatch,
    ScalarBatch,
    TwistColumns,
    check_finite,
    decode_imu,
    decode_poses,
    decode_scalars,
    decode_twist,
    named,
)
from imutool.mcap_io.codec.formats.objects import OF_OBJECTS
from imutool.mcap_io.codec.joined_imu import JoinedImu, Vectors, whole_of
from imutool.mcap_io.codec.messages import Messages, Rows
from imutool.mcap_io.codec.reflection import Reflected, reflect, reflect_cdr
from imutool.mcap_io.codec.transforms import Transforms, listed_poses
from imutool.mcap_io.index import LogIndex
from imutool.recording.joined_imu import joined
from imutool.recording.message_log import computed_kind, named_kind

ENCODINGS, DESCRIBED = ("cdr", "ros1"), {("ros2msg", "cdr"), ("ros1msg", "ros1")}
REFLECTED = ("protobuf", "flatbuffer", *OF_OBJECTS)  # encodings whose messages are searched for those of an IMU and for poses
DERIVED_KEY = "imutool_source_topic"  # channel metadata: computed by imutool from this topic
PART_KEY = "imutool_part_of"  # channel metadata: one sensor of the IMU on that topic
RECORDED_KEY = "imutool_recorded_as"  # channel metadata: the original of the IMU on that topic
KIND_KEY = "imutool_kind"  # channel metadata of poses: truth, estimate, odometry or unknown
VELOCITY_KEY = "imutool_velocity_of"  # channel metadata: the world velocity of the poses on this topic
UNIT_KEY = "unit"  # channel metadata of a scalar
MESSAGE_POSES = (schemas.POSE, schemas.ODOMETRY, schemas.TRANSFORM, schemas.POSE_COVARIANCE)
SCALARS = {schemas.FLOAT: 1, schemas.VECTOR3: 3}


@dataclass(frozen=True)
class Topic:
    """A topic as its Channel record describes it; several channels of one topic count as one.

    An IMU or a pose in a type of its own (`reflected`) counts as an Imu or PoseStamped of ROS 2, and its messages come as CDR.
    """

    name: str
    schema_name: str  # in ROS 2 spelling; empty where the channel has no schema
    schema_encoding: str
    message_encoding: str
    count: int
    metadata: Mapping[str, str]
    reflected: Reflected | JoinedImu | Transforms | None = None
    own_schema: str = ""  # name in the log of the type of a reflected IMU or pose
    recorded_on: str = ""  # topic whose messages stand for its own: the gyro of a joined IMU, or an IMU with poses

    @property
    def is_derived(self) -> bool:
        """Whether imutool computed the topic from another one."""
        return DERIVED_KEY in self.metadata

    @property
    def pose_kind(self) -> str:
        """Kind of the topic's poses: `truth`, `estimate`, `odometry` or `unknown`.

        The channel's metadata state it (`convert --kind`); else the words of the topic's name, then the message type.
        """
        return self.metadata.get(KIND_KEY) or named_kind(self.name, self.own_schema or self.schema_name)

    @property
    def is_read(self) -> bool:
        """Whether imutool reads the topic's encoding."""
        return self.reflected is not None or self.message_encoding in ENCODINGS

    @property
    def _encoding(self) -> str:
        """Encoding of the messages as they come from `cut`."""
        return self.message_encoding if self.reflected is None else "cdr"

    def cut(
        self, found: Messages, mask: Bool[np.ndarray, " n"]
    ) -> Iterator[tuple[Shaped[np.ndarray, " n"], UInt8[np.ndarray, "n L"]]]:
        """Heads and payloads of the chosen messages, per stretch of equal size."""
        yield from messages.cut(found, mask) if self.reflected is None else self.reflected.cut(found, mask)

    def decode_imu(self, rows: Rows, unreadable: Callable[[str], None] | None = None) -> Iterator[ImuBatch]:
        """IMU messages from their bytes, one batch per stretch with one frame, unchecked.

        `unreadable` is called with what is wrong with a payload that is no such message. It has NaN, and its log time.

        Raises:
            LogError: a payload that is no such message, without `unreadable`.
        """
        while len(rows.sequence):
            try:
                for cut, layout in _runs(rows, schemas.IMU, self._encoding):
                    columns = decode_imu(cut.payload, self._encoding, layout)
                    rows = rows.where(slice(len(cut.sequence), None))
                    yield ImuBatch(cut.log_time, cut.publish_time, cut.sequence, *columns)
            except LogError as error:
                if unreadable is None:
                    raise
                unreadable(error.what)
                _, log_time, publish_time, sequence, _ = rows.where(slice(1))
                yield ImuBatch(log_time, publish_time, sequence, log_time, nan := np.full((1, 3), np.nan), nan, "")
                rows = rows.where(slice(1, None))

    def vectors(self, rows: Rows, sensor: str) -> Iterator[Vectors]:
        """Samples of one sensor, `gyro` or `accel`, from messages of an IMU or from plain vectors.

        Raises:
            LogError: a payload that is no such message.
        """
        if (at := schemas.VECTORS.get(self.schema_name)) is not None:
            yield from (Vectors(part.stamp_ns, part.values[:, at], part.frame_id) for part in self.decode_scalars(rows))
        else:
            yield from (Vectors(part.stamp_ns, getattr(part, sensor), part.frame_id) for part in self.decode_imu(rows))

    def decode_poses(self, rows: Rows, *, lost: bool = False) -> Iterator[PoseBatch]:
        """Poses from their bytes, one batch per stretch with one frame and per transform; with `lost` also those not tracked.

        Raises:
            LogError: a payload that is no such message.
        """
        for cut, layout in _runs(rows, self.schema_name, self._encoding):
            for columns in decode_poses(cut.payload, self.schema_name, self._encoding, layout):
                every = PoseBatch(cut.log_time, cut.publish_time, cut.sequence, *columns)
                yield every if lost else every.tracked()

    def decode_scalars(self, rows: Rows) -> Iterator[ScalarBatch]:
        """Numbers from their bytes, one batch per stretch with one frame.

        Raises:
            LogError: a payload that is no such message, NaN or infinite values.
        """
        for cut, layout in _runs(rows, self.schema_name, self.message_encoding):
            columns = decode_scalars(cut.payload, self.schema_name, self.message_encoding, layout)
            check_finite(cut, values=columns.values)
            stamp_ns = cut.log_time if columns.stamp_ns is None else columns.stamp_ns
            yield ScalarBatch(cut.log_time, cut.publish_time, cut.sequence, stamp_ns, columns.values, columns.frame_id)

    def decode_twist(self, rows: Rows) -> Iterator[TwistColumns]:
        """Biases with covariance from their bytes, one batch per stretch with one frame.

        Raises:
            LogError: a payload that is no such message.
        """
        for cut, layout in _runs(rows, schemas.TWIST, self.message_encoding):
            yield decode_twist(cut.payload, self.message_encoding, layout)


def _runs(rows: Rows, schema_name: str, encoding: str) -> Iterator[tuple[Rows, schemas.Layout]]:
    """Stretches of messages that share one layout; a message that is none is refused by its number."""
    done = 0
    try:
        for part, layout in schemas.runs(rows.payload, schema_name, encoding):
            done = part.stop
            yield rows.where(part), layout
    except LogError as error:
        what = f"{named(rows, done)} is no {schema_name}: {error.what}"
        raise LogError(what, expected=error.expected, fix=error.fix or ("" if error.expected else CUT)) from error


def topics_of(index: LogIndex) -> dict[str, Topic]:
    """The topics of a log by their names, in order of their channel ids.

    A topic whose channels carry different messages is listed with both types, and nothing reads it.
    """
    found: dict[str, Topic] = {}
    counts = index.counts()
    for identity, channel in sorted(index.channels.items()):
        schema, before = index.schemas.get(channel.schema_id), found.get(channel.topic)
        topic = Topic(
            channel.topic,
            schemas.canonical(schema.name) if schema else "",
            schema.encoding if schema else "",
            channel.message_encoding,
            counts.get(identity, 0) + (before.count if before else 0),
            MappingProxyType(dict(channel.metadata)),
        )
        if before and (before.schema_name, before.message_encoding) != (topic.schema_name, topic.message_encoding):
            both = " and ".join(t.schema_name or f"no type in {t.message_encoding}" for t in (before, topic))
            topic = replace(topic, schema_name=both, schema_encoding="", message_encoding="several types")
        found[channel.topic] = topic
    return found


def reflected_topics(
    index: LogIndex,
    topics: Mapping[str, Topic],
    firsts: Callable[[Collection[str]], Iterator[tuple[str, bytes]]],
    rows: Callable[[Collection[str]], Iterator[tuple[str, Rows]]],
) -> dict[str, Topic]:
    """IMUs and poses among the topics whose type is not that of ROS.

    `firsts` gives the first messages of some, `rows` all of them.
    Types of ROS 2 count only if no other IMU was recorded: drivers publish both.
    """
    definitions = {channel.topic: index.schemas.get(channel.schema_id) for channel in index.channels.values()}
    lists = {name: listed_poses(definitions[name], topic.message_encoding, topic.pose_kind) for name, topic in topics.items()}
    found = {name: _as_ros(topics[name], poses) for name, poses in lists.items() if poses is not None}
    reflected = {n: t for n, t in topics.items() if t.message_encoding in REFLECTED and RECORDED_KEY not in t.metadata}
    of_objects = [name for name, topic in reflected.items() if topic.message_encoding in OF_OBJECTS]
    texts_of = {name: definition.data if (definition := definitions[name]) else b"" for name in reflected}
    by_first = {
        name: reflect(topics[name].message_encoding, name, topics[name].schema_name, texts_of[name], raw)
        for name, raw in firsts(of_objects)
    }
    for name, topic in reflected.items():
        try:
            message = by_first.get(name) or reflect(topic.message_encoding, name, topic.schema_name, texts_of[name], None)
        except ImportError:
            continue
        if message is not None:
            found[name] = _as_ros(topic, message)
    imus = {name: topic for name, topic in {**topics, **found}.items() if topic.schema_name == schemas.IMU}
    texts: dict[str, set[bytes]] = {name: set() for name in topics}  # of all channels of a topic
    for channel in index.channels.values():
        texts[channel.topic] |= {index.schemas[channel.schema_id].data} if channel.schema_id in index.schemas else set()
    odd = {n for n, t in imus.items() if not t.reflected and not all(map(ros2_definition.is_imu_of_ros, texts[n]))}
    known = any(not topic.is_derived for name, topic in imus.items() if name not in odd)
    for name, topic in topics.items():
        described = (topic.schema_encoding, topic.message_encoding) in DESCRIBED and not topic.is_derived
        definition = definitions[name] if described and (name in odd or not known) else None
        imu = None if definition is None else reflect_cdr(topic.schema_name, definition.data, topic.message_encoding)
        if imu is not None and _have_one_layout(topic, texts[name]):
            found[name] = _as_ros(topic, imu)
        elif imu is not None or name in odd:  # whose bytes would be read in the order of another
            which = "two definitions" if len(texts[name]) > 1 else "another definition"
            found[name] = replace(topic, schema_name=f"{topic.schema_name} ({which})")
    settled = [_with_clock(topic, rows([name])) for name, topic in found.items()]
    poses = [pose for topic in settled for pose in _poses_with(topic)]
    return {topic.name: topic for topic in [*settled, *(pose for pose in poses if pose.name not in topics)]}


def _with_clock(topic: Topic, parts: Iterator[tuple[str, Rows]]) -> Topic:
    """Topic whose stamps have the unit that its first messages show."""
    if not isinstance(topic.reflected, Reflected):
        return topic
    messages = ((int(t), raw.tobytes()) for _, rows in parts for t, raw in zip(rows.log_time, rows.payload, strict=True))
    return replace(topic, reflected=topic.reflected.settled(messages))


def _poses_with(imu: Topic) -> Iterator[Topic]:
    """Poses in the messages of an IMU: an estimate, unless the topic's name says more."""
    if isinstance(imu.reflected, Reflected) and (pose := imu.reflected.pose) is not None:
        name, marks = f"{imu.name}/pose", {KIND_KEY: computed_kind(imu.name, imu.own_schema)}
        yield replace(imu, name=name, schema_name=schemas.POSE, metadata=marks, reflected=pose, recorded_on=imu.name)


def _have_one_layout(topic: Topic, texts: Collection[bytes]) -> bool:
    try:
        each = [ros2_definition.parse(topic.schema_name, text) for text in texts]
        ros2_definition.refuse_two(topic.name, topic.schema_name, each)
    except LogError:
        return False
    return True


def _as_ros(topic: Topic, message: Reflected | Transforms) -> Topic:
    return replace(topic, schema_name=message.schema_name, reflected=message, own_schema=topic.schema_name)


def joined_topic(gyro: Topic, accel: Topic, rows: Callable[[str], Iterator[Rows]]) -> tuple[Topic, list[str]]:
    """IMU on the gyro's stamps of two topics, and notes on rates, delay and samples left out.

    Raises:
        DataError: the two share no time.
    """
    gyro_ns, rates = _column(gyro.vectors(found, "gyro") for found in rows(gyro.name))
    accel_ns, forces = _column(accel.vectors(found, "accel") for found in rows(accel.name))
    name = whole_of((gyro.name, accel.name))
    imu, _, notes = joined(gyro_ns, rates, accel_ns, forces, name, spread=False)  # the messages keep their stamps
    message = JoinedImu(gyro.cut, partial(gyro.vectors, sensor="gyro"), imu.t_ns, imu.accel)
    encoding = gyro.message_encoding if gyro.message_encoding in ENCODINGS else "cdr"
    return Topic(name, schemas.IMU, "ros2msg", encoding, len(imu), {}, message, recorded_on=gyro.name), notes


def _column(parts: Iterable[Iterator[Vectors]]) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    every = [vectors for part in parts for vectors in part]
    stamps = np.concatenate([np.zeros(0, np.int64), *(vectors.stamp_ns for vectors in every)])
    return stamps, np.concatenate([np.zeros((0, 3)), *(vectors.values for vectors in every)])
