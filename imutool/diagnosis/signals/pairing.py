"""Pairs of signals that a recording and its simulation both hold.

Fields that belong together are compared together: efforts of an arm with its motion, speeds of a vehicle with its wheels, the
three components of a field or a position. Left out are IMUs and poses (compared elsewhere), constants, enumerations, clocks,
covariances, and what is the same in both.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from imutool.diagnosis.signals.ideal_signal import SignalPair
from imutool.diagnosis.signals.quantities import in_one_unit, metres, unwrapped
from imutool.geometry import quaternion
from imutool.location import Location
from imutool.mcap_io.codec.schemas import IMU, ODOMETRY, POSE, PRESSURE, TF, TWIST
from imutool.mcap_io.fields import Fields, others
from imutool.mcap_io.log import Log
from imutool.recording.columns import longest_run
from imutool.sensor.channels import is_quantity

MOST_READ, MOST_COMPARED, MOST_DRIVERS = 400, 24, 6
SAME = 1e-12  # relative difference of two copies
LEAST_COPIED = 0.9  # of the longer log, that two copies share
LISTED = 12
JOINTS, MAGNETIC = "sensor_msgs/msg/JointState", "sensor_msgs/msg/MagneticField"
GNSS = "sensor_msgs/msg/NavSatFix"
RANGE, TEMPERATURE = "sensor_msgs/msg/Range", "sensor_msgs/msg/Temperature"
ELSEWHERE = frozenset(
    {IMU, POSE, TF, TWIST, "geometry_msgs/msg/TransformStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"}
)
VALUES: Mapping[str, tuple[str, str, str]] = {
    PRESSURE: ("fluid_pressure", "pressure", "Pa"),
    RANGE: ("range", "range", "m"),
    TEMPERATURE: ("temperature", "number", "K"),
}
"""Field, kind and unit of messages that hold one value; their other fields are settings."""
TRIPLES: Mapping[str, tuple[tuple[str, str, str], str, str]] = {
    MAGNETIC: (("magnetic_field.x", "magnetic_field.y", "magnetic_field.z"), "magnetic", "T"),
    GNSS: (("longitude", "latitude", "altitude"), "gnss", "m"),
}
JOINT_UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m"}
SPEEDS = ("twist.twist.linear.x", "twist.twist.angular.z")
UNIT_UNITS = {"linear": "m/s", "angular": "rad/s"}


@dataclass(frozen=True)
class Pairing:
    """Signals to compare, channels that may drive them, and remarks on what was not compared."""

    pairs: tuple[SignalPair, ...]
    drivers: Mapping[str, Fields]
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class _Side:
    """One log: schemas by topic, varying fields by topic and path, and names of joints."""

    schemas: Mapping[str, str]
    fields: Mapping[str, Mapping[str, Fields]]
    joints: Mapping[str, list[str]]

    @classmethod
    def of(cls, path: Location) -> _Side:
        with Log(path) as log:
            schemas = {name: topic.schema_name for name, topic in log.topics.items()}
            joints = {name: _joint_names(log, name) for name, schema in schemas.items() if schema == JOINTS}
        found: dict[str, dict[str, Fields]] = {}
        for name, values in others(path, "", MOST_READ).items():
            topic = max((topic for topic in schemas if name.startswith(f"{topic}.")), key=len)
            found.setdefault(topic, {})[name[len(topic) + 1 :]] = on_one_clock(values)
        return cls(schemas, found, joints)


def on_one_clock(values: Fields) -> Fields:
    """Longest stretch without a jump of the clock: the comparison has an even grid of time."""
    run = longest_run(values.t_ns)
    return replace(values, t_ns=values.t_ns[run], values=values.values[run])


def paired(real: Location, sim: Location) -> Pairing:
    """Signals that both logs hold, in the order of the recording.

    Raises:
        ConfigError, LogError: a log cannot be opened, or is damaged.
    """
    own, other = _Side.of(real), _Side.of(sim)
    remarks, pairs, same = list[str](), list[SignalPair](), list[str]()
    topics = dict(_topics(own, other))
    for given in (pair for topic, theirs in topics.items() for pair in _of_topic(own, other, topic, theirs)):
        if _is_copy(given):
            same.extend(given.names)
        else:
            pair, remark = in_one_unit(given)
            remarks += [remark] if remark else []
            pairs.append(pair)
    if any(pair.kind == "wheels" for pair in pairs):  # the wheels are given, as the motion of an arm is
        joints = tuple(f"{topic}." for topic, schema in own.schemas.items() if schema == JOINTS)
        pairs = [pair for pair in pairs if not pair.names[0].startswith(joints)]
    pairs.sort(key=lambda pair: pair.kind == "number")  # a sort keeps the log's order otherwise
    untried = [name for pair in pairs[MOST_COMPARED:] for name in pair.names]
    pairs = pairs[:MOST_COMPARED]
    compared = {name for pair in pairs for name in pair.names}
    remarks += _listed("The same in both logs", same) + _listed(f"Not compared, for at most {MOST_COMPARED} are", untried)
    return Pairing(tuple(pairs), _drivers(own, compared), tuple(remarks))


def _is_copy(pair: SignalPair) -> bool:
    """Whether one log's numbers are those of the other, which may have left out some at its ends."""
    _, mine, theirs = np.intersect1d(pair.real_ns, pair.sim_ns, return_indices=True)
    whole = len(mine) == min(len(pair.real), len(pair.sim)) > LEAST_COPIED * max(len(pair.real), len(pair.sim))
    return whole and np.allclose(pair.real[mine], pair.sim[theirs], rtol=SAME, atol=0.0)


def _listed(what: str, names: list[str]) -> list[str]:
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return [f"{what}: {', '.join(names[:LISTED])}{more}"] if names else []


def _topics(real: _Side, sim: _Side) -> Iterator[tuple[str, str]]:
    """Topics that correspond: of one name and message, or the only ones with a message in both logs."""
    for topic, schema in real.schemas.items():
        if schema in ELSEWHERE or topic not in real.fields:
            continue
        if sim.schemas.get(topic) == schema:
            if topic in sim.fields:
                yield topic, topic
            continue
        theirs = [name for name, other in sim.schemas.items() if other == schema and name in sim.fields]
        mine = [name for name, other in real.schemas.items() if other == schema]
        if len(theirs) == len(mine) == 1 and not schema.startswith("std_msgs/"):
            yield topic, theirs[0]


def _of_topic(real: _Side, sim: _Side, topic: str, theirs: str) -> Iterator[SignalPair]:
    """Signals of one topic."""
    mine, other, schema = real.fields[topic], sim.fields[theirs], real.schemas[topic]
    if schema == JOINTS:
        other = _by_joint(other, real.joints[topic], sim.joints[theirs])
        yield from _joints(topic, mine, other)
    elif schema in TRIPLES:
        paths, kind, unit = TRIPLES[schema]
        if all(path in side for path in paths for side in (mine, other)):
            state = _attitude(real)
            if kind == "gnss":
                mine, other = (metres(side, other) for side in (mine, other))
            yield _together(topic, paths, kind, (unit,) * 3, mine, other, state)
    else:
        values = VALUES.get(schema)
        wheels = _wheels(real, sim, topic, mine, other) if schema == ODOMETRY else None
        if wheels is not None:
            yield wheels
        for path in mine:
            if path in other and (values is None or path == values[0]) and not (wheels and path in SPEEDS):
                if schema == ODOMETRY and path.startswith("pose."):
                    continue
                kind, unit = ("number", _unit(path)) if values is None else values[1:]
                state = _speed(real) if kind == "pressure" else {}
                pair = replace(SignalPair.of_fields(mine[path], other[path], f"{topic}.{path}"), kind=kind, state=state)
                if is_quantity(mine[path]):
                    yield replace(unwrapped(pair), units=(pair.units[0] or unit,))


def _unit(path: str) -> str:
    return next((unit for word, unit in UNIT_UNITS.items() if word in path.split(".")), "")


def _together(
    topic: str,
    paths: tuple[str, ...],
    kind: str,
    units: tuple[str, ...],
    mine: Mapping[str, Fields],
    other: Mapping[str, Fields],
    state: Mapping[str, Fields],
    sim_state: Mapping[str, Fields] | None = None,
) -> SignalPair:
    """Fields of one message, which share its stamps."""
    real, sim = (np.stack([side[path].values for path in paths], axis=1) for side in (mine, other))
    names = tuple(f"{topic}.{path}" for path in paths)
    stamps = mine[paths[0]].t_ns, other[paths[0]].t_ns
    return SignalPair(topic, names, units, stamps[0], real, stamps[1], sim, kind, state, sim_state or {})


# ── joints ──


def _joints(topic: str, mine: Mapping[str, Fields], other: Mapping[str, Fields]) -> Iterator[SignalPair]:
    """Efforts with the motion of all joints where both logs have both, else each number by itself."""
    both = [path for path in mine if path in other]
    moving = [path.removeprefix("position") for path in both if path.startswith("position")]
    if moving and all(f"effort{k}" in both for k in moving):
        states = [
            {
                f"{short}{n}": side[f"{word}{k}"]
                for n, k in enumerate(moving)
                for short, word in (("q", "position"), ("dq", "velocity"))
                if f"{word}{k}" in side
            }
            for side in (mine, other)
        ]
        efforts = tuple(f"effort{k}" for k in moving)
        yield _together(topic, efforts, "efforts", (JOINT_UNITS["effort"],) * len(efforts), mine, other, *states)
        return
    for path in both:
        kind = "positions" if path.startswith("position") else "number"
        effort = mine.get(path.replace("position", "effort"))
        state = {"effort": effort} if kind == "positions" and effort is not None else {}
        pair = SignalPair.of_fields(mine[path], other[path], f"{topic}.{path}")
        yield unwrapped(replace(pair, kind=kind, state=state, units=(JOINT_UNITS[path.partition("[")[0]],)))


def _by_joint(fields: Mapping[str, Fields], wanted: list[str], given: list[str]) -> dict[str, Fields]:
    """Fields under the indices that another log gives the same joints."""
    if wanted == given or sorted(wanted) != sorted(given):
        return dict(fields)
    index = {f"[{given.index(name)}]": f"[{k}]" for k, name in enumerate(wanted)}
    return {f"{path[: path.index('[')]}{index[path[path.index('[') :]]}": values for path, values in fields.items()}


def _joint_names(log: Log, topic: str) -> list[str]:
    """Names of the joints in the first message of a topic."""
    for _, rows in log.rows([topic]):
        payload = rows.payload[0].tobytes()
        order, at = "<" if payload[1] else ">", 12
        texts = list[str]()
        count = 1  # the frame of the header, and then the names
        try:
            while len(texts) < count:
                (size,) = struct.unpack_from(f"{order}I", payload, at)
                texts.append(payload[at + 4 : at + 4 + max(size - 1, 0)].decode(errors="replace"))
                at += 4 + size + (-size) % 4
                if len(texts) == 1:
                    (names,) = struct.unpack_from(f"{order}I", payload, at)
                    count, at = 1 + names, at + 4
        except struct.error:
            return []
        return texts[1:]
    return []


# ── state ──


def _attitude(side: _Side) -> dict[str, Fields]:
    """R_wb of the first topic with an orientation that varies, by its entries."""
    for fields in side.fields.values():
        for path in fields:
            if path.endswith("orientation.w"):
                base = path[:-1]
                columns = [fields.get(f"{base}{axis}") for axis in "wxyz"]
                t_ns, n = fields[path].t_ns, len(fields[path])
                q = np.stack([np.zeros(n) if column is None else column.values for column in columns], axis=1)
                R = quaternion.matrix(quaternion.unit(q))
                return {f"R{i}{j}": Fields(t_ns, np.ascontiguousarray(R[:, i, j])) for i in range(3) for j in range(3)}
    return {}


def _speed(side: _Side) -> dict[str, Fields]:
    """Speed from the first topic with a linear velocity."""
    for fields in side.fields.values():
        parts = [values for path, values in fields.items() if ".linear." in f".{path}" and "acceleration" not in path]
        if parts:
            return {"speed": Fields(parts[0].t_ns, np.sqrt(np.sum([part.values**2 for part in parts], axis=0)))}
    return {}


def _wheels(real: _Side, sim: _Side, topic: str, mine: Mapping[str, Fields], other: Mapping[str, Fields]) -> SignalPair | None:
    """Speeds of a vehicle with those of its wheels, where both logs have both."""
    if not all(path in side for path in SPEEDS for side in (mine, other)):
        return None
    states = []
    for side in (real, sim):
        joints = [topic for topic, schema in side.schemas.items() if schema == JOINTS and topic in side.fields]
        speeds = [values for path, values in side.fields[joints[0]].items() if path.startswith("velocity")] if joints else []
        states.append({f"w{k}": values for k, values in enumerate(speeds)})
    if len(states[0]) < 2 or len(states[0]) != len(states[1]):
        return None
    return _together(topic, SPEEDS, "wheels", ("m/s", "rad/s"), mine, other, states[0], states[1])


def _drivers(side: _Side, compared: set[str]) -> dict[str, Fields]:
    """Numbers of the recording that may drive a misfit: no motion, and nothing that is compared itself."""
    found = {
        f"{topic}.{path}": values
        for topic, fields in side.fields.items()
        if side.schemas[topic] not in ELSEWHERE | {JOINTS, ODOMETRY, *TRIPLES}
        for path, values in fields.items()
        if f"{topic}.{path}" not in compared and is_quantity(values) and (path == VALUES.get(side.schemas[topic], (path,))[0])
    }
    temperatures_first = sorted(found, key=lambda name: "temperature" not in name.lower())
    return {name: found[name] for name in temperatures_first[:MOST_DRIVERS]}
