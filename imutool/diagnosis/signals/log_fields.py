"""Varying numbers of two logs, read for comparison: topics that correspond, names of joints."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from imutool.diagnosis.signals.joints import JOINTS, SPEEDS, joint_names
from imutool.errors import LogError
from imutool.file_location import Location
from imutool.mcap_io.codec.schemas import IMU, ODOMETRY, POSE, PRESSURE, TF, TWIST
from imutool.mcap_io.fields import Fields, PlainLog, numeric_fields, others
from imutool.mcap_io.log import Log
from imutool.recording.columns import longest_run

MAX_READ = 400  # fields of a log to compare, and as many that may drive them
MAGNETIC, GNSS = "sensor_msgs/msg/MagneticField", "sensor_msgs/msg/NavSatFix"
RANGE, TEMPERATURE = "sensor_msgs/msg/Range", "sensor_msgs/msg/Temperature"
FIELDS_OF: Mapping[str, frozenset[str]] = {
    JOINTS: frozenset({"position[0]"}),
    ODOMETRY: frozenset(SPEEDS),
    MAGNETIC: frozenset(f"magnetic_field.{axis}" for axis in "xyz"),
    GNSS: frozenset({"latitude", "longitude", "altitude"}),
    PRESSURE: frozenset({"fluid_pressure"}),
    RANGE: frozenset({"min_range", "max_range", "range"}),
    TEMPERATURE: frozenset({"temperature", "variance"}),
}
"""Fields by which a message in another type, as of protobuf, is known for one of ROS 2."""
ELSEWHERE = frozenset(
    {IMU, POSE, TF, TWIST, "geometry_msgs/msg/TransformStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"}
)


@dataclass(frozen=True)
class LogFields:
    """One log: schemas by topic, varying fields by topic and path, and names of joints."""

    schemas: Mapping[str, str]
    fields: Mapping[str, Mapping[str, Fields]]
    joints: Mapping[str, list[str]]
    mixed: Sequence[str]  # topics on which messages name now these joints, now those: an index is no one joint

    @classmethod
    def of(cls, path: Location, schemas: Mapping[str, str], compared: Collection[str]) -> LogFields:
        """Fields of a log, those of the topics that are `compared` first.

        Raises:
            ConfigError, LogError: the log cannot be opened, or is damaged.
        """
        with PlainLog(path) as log:
            named = {name: joint_names(log, name) for name, schema in schemas.items() if schema == JOINTS}
        mixed = {name for name, lists in named.items() if len(lists) > 1}
        joints = {name: lists[0] if len(lists) == 1 else [] for name, lists in named.items()}
        found: dict[str, dict[str, Fields]] = {}
        for skipped in (set(schemas) - set(compared), set(compared)):
            for name, values in others(path, "", MAX_READ, skip=skipped | mixed, gaps=True).items():
                topic = max((topic for topic in schemas if name.startswith(f"{topic}.")), key=len)
                found.setdefault(topic, {})[name[len(topic) + 1 :]] = on_one_clock(values)
        return cls(schemas, {name: found[name] for name in schemas if name in found}, joints, sorted(mixed))


def read_both(real: Location, sim: Location) -> tuple[LogFields, LogFields, dict[str, str]]:
    """Fields of both logs, and the simulation's topic for each topic of the recording.

    Raises:
        ConfigError, LogError: a log cannot be opened, or is damaged.
    """
    schemas = [_schemas(path) for path in (real, sim)]
    topics = dict(_corresponding(*schemas))
    own, other = LogFields.of(real, schemas[0], topics), LogFields.of(sim, schemas[1], set(topics.values()))
    return own, other, {topic: name for topic, name in topics.items() if topic in own.fields and name in other.fields}


def _schemas(path: Location) -> dict[str, str]:
    """Message of every topic; that of ROS 2 with its fields, where a type of its own has them."""
    with Log(path) as log, PlainLog(path) as plain:
        return {name: _schema(plain, name, topic.schema_name) for name, topic in log.topics.items() if name in plain.topics}


def _schema(log: Log, name: str, schema: str) -> str:
    recorded = log.topics[name].schema_name
    if recorded in FIELDS_OF or recorded in ELSEWHERE or schema == IMU:
        return recorded if recorded in FIELDS_OF else schema
    try:
        paths = set(numeric_fields(log, name, long=False))
    except LogError:
        return schema
    known = (kind for kind, wanted in FIELDS_OF.items() if wanted <= paths and (kind != JOINTS or any(joint_names(log, name))))
    return next(known, schema)


def _corresponding(real: Mapping[str, str], sim: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Topics of one message: of one name, in another namespace, or the only ones in both logs."""
    for topic, schema in real.items():
        if schema in ELSEWHERE:
            continue
        if sim.get(topic) == schema:
            yield topic, topic
            continue
        sim_names = [name for name, other in sim.items() if other == schema and real.get(name) != schema]
        real_names = [name for name, other in real.items() if other == schema and sim.get(name) != schema]
        moved = [name for name in sim_names if name.endswith(topic) or topic.endswith(name)]
        if len(moved) == 1:
            yield topic, moved[0]
        elif len(sim_names) == len(real_names) == 1 and not schema.startswith("std_msgs/"):
            yield topic, sim_names[0]


def on_one_clock(values: Fields) -> Fields:
    """Longest stretch without a jump of the clock, of stamps that increase."""
    run = longest_run(values.t_ns)
    t_ns, numbers = values.t_ns[run], values.values[run]
    late = np.append(True, t_ns[1:] > np.maximum.accumulate(t_ns)[:-1]) if len(t_ns) else np.zeros(0, bool)
    return replace(values, t_ns=t_ns[late], values=numbers[late])
