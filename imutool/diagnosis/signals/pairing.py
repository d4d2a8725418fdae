"""Pairs of signals that a recording and its simulation both hold.

Fields that belong together are compared together: efforts of an arm with its motion, speeds of a vehicle with its wheels, the
three components of a field or a position. Left out are IMUs and poses (compared elsewhere), constants, enumerations, clocks,
covariances, and what is the same in both.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from imutool.diagnosis.estimation.aligned_log import ClockDifference
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.diagnosis.signals.ideal_signal import SignalPair, stacked
from imutool.diagnosis.signals.joints import JOINTS, SPEEDS, by_joint, joint_pairs, joint_remarks, rates, wheel_pair
from imutool.diagnosis.signals.lag import is_copy, on_recorded_clock
from imutool.diagnosis.signals.log_fields import ELSEWHERE, GNSS, MAGNETIC, RANGE, TEMPERATURE, LogFields, read_both
from imutool.diagnosis.signals.quantities import field_vectors, in_one_unit, in_radians, in_si, is_air, metres, unwrapped
from imutool.file_location import Location
from imutool.geometry import quaternion
from imutool.mcap_io.codec.schemas import ODOMETRY, PRESSURE
from imutool.mcap_io.fields import Fields
from imutool.sensor.channels import is_quantity
from imutool.units import AXES

MAX_COMPARED, MAX_DRIVERS = 24, 6
LISTED = 12
VALUES: Mapping[str, tuple[str, str, str]] = {
    PRESSURE: ("fluid_pressure", "pressure", "Pa"),
    RANGE: ("range", "range", "m"),
    TEMPERATURE: ("temperature", "number", "K"),
}
"""Field, kind and unit of messages of one sensor; their other fields, if they vary, are plain numbers."""
TRIPLES: Mapping[str, tuple[tuple[str, str, str], str, str]] = {
    MAGNETIC: (("magnetic_field.x", "magnetic_field.y", "magnetic_field.z"), "magnetic", "T"),
    GNSS: (("longitude", "latitude", "altitude"), "gnss", "m"),
}
NUMBER = "data"  # the field of a topic with one number, as the columns of a table become topics
UNIT_UNITS = {"linear": "m/s", "angular": "rad/s"}


@dataclass(frozen=True)
class Pairing:
    """Signals to compare, channels that may drive them, and remarks on what was not compared."""

    pairs: tuple[SignalPair, ...]
    drivers: Mapping[str, Fields]
    remarks: tuple[str, ...]


def paired(real: Location, sim: Location, clock: ClockDifference | None = None) -> Pairing:
    """Signals that both logs hold, in the order of the recording; on one clock by `clock`.

    Raises:
        ConfigError, LogError: a log cannot be opened, or is damaged.
    """
    own, other, topics = read_both(real, sim)
    remarks, pairs, same = _remarks(own, other, topics), list[SignalPair](), list[str]()
    wheels = _wheels(own, other, topics)
    fields = dict(_of_three_topics(own, other, topics))
    parts = {topic for three in fields for topic in three}
    alone = ((topic, sim_topic) for topic, sim_topic in topics.items() if topic not in parts)
    found = chain(fields.values(), *(_of_topic(own, other, topic, sim_topic, wheels) for topic, sim_topic in alone))
    for given in (on_recorded_clock(pair, clock) for pair in found):
        if is_copy(given, DiagnoseSettings()):
            same.extend(given.names)
        else:
            for to_usual in (in_radians, in_si, in_one_unit):
                given, remark = to_usual(given)  # noqa: PLW2901
                remarks += [remark] if remark else []
            pairs.append(given)
    pairs.sort(key=lambda pair: pair.kind == "number")  # a sort keeps the log's order otherwise
    untried = [name for pair in pairs[MAX_COMPARED:] for name in pair.names]
    pairs = pairs[:MAX_COMPARED]
    rate_of = _listed("The rates of recorded positions, which are compared", _rates(own, other, topics, pairs))
    remarks += (
        rate_of + _listed("The same in both logs", same) + _listed(f"Not compared, for at most {MAX_COMPARED} are", untried)
    )
    return Pairing(tuple(pairs), _drivers(own, pairs, parts), tuple(remarks))


def _listed(what: str, names: list[str]) -> list[str]:
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return [f"{what}: {', '.join(names[:LISTED])}{more}"] if names else []


def _rates(real: LogFields, sim: LogFields, topics: Mapping[str, str], pairs: Sequence[SignalPair]) -> list[str]:
    """Velocities of joints that are not compared, because they say no more than a position that is."""
    compared = {name for pair in pairs for name in pair.names}
    joints = [topic for topic in topics if real.schemas[topic] == JOINTS]
    found = (f"{topic}.{path}" for topic in joints for path in rates(*_joints(real, sim, topic, topics[topic])))
    return [name for name in found if name.replace(".velocity", ".position") in compared]


def _wheels(real: LogFields, sim: LogFields, topics: Mapping[str, str]) -> dict[str, tuple[SignalPair, list[str]]]:
    """Vehicles by topic, each with the joints that drive it: those of the first topic that has some."""
    out = dict[str, tuple[SignalPair, list[str]]]()
    joints = [_joints(real, sim, topic, sim_topic) for topic, sim_topic in topics.items() if real.schemas[topic] == JOINTS]
    for topic, sim_topic in topics.items():
        if real.schemas[topic] == ODOMETRY:
            found = (wheel_pair(topic, real.fields[topic], sim.fields[sim_topic], both) for both in joints)
            if (first := next((pair for pair in found if pair is not None), None)) is not None:
                out[topic] = first
    return out


def _joints(real: LogFields, sim: LogFields, topic: str, sim_topic: str) -> tuple[Mapping[str, Fields], Mapping[str, Fields]]:
    """Fields of both logs under the recording's indices of joints."""
    return real.fields[topic], by_joint(sim.fields[sim_topic], real.joints[topic], sim.joints[sim_topic])


def _of_topic(
    real: LogFields, sim: LogFields, topic: str, sim_topic: str, wheels: Mapping[str, tuple[SignalPair, list[str]]]
) -> Iterator[SignalPair]:
    """Signals of one topic."""
    own_fields, other, schema = real.fields[topic], sim.fields[sim_topic], real.schemas[topic]
    if schema == JOINTS:  # the wheels are given, as the motion of an arm is
        used = {k for _, indices in wheels.values() for k in indices}
        yield from joint_pairs(topic, *_joints(real, sim, topic, sim_topic), used)
        return
    done: tuple[str, ...] = SPEEDS if topic in wheels else ()
    if topic in wheels:
        yield wheels[topic][0]
    if schema in TRIPLES:
        done, kind, unit = TRIPLES[schema]
        if all(path in side for path in done for side in (own_fields, other)):
            sides = (metres(own_fields, other), metres(other, other)) if kind == "gnss" else (own_fields, other)
            yield SignalPair.of_columns(topic, done, kind, (unit,) * 3, *sides, _attitude(real))
    else:
        for names in field_vectors(topic, own_fields, other):
            done = (*done, *names)
            yield SignalPair.of_columns(topic, names, "magnetic", ("",) * 3, own_fields, other, _attitude(real))
    for path in own_fields:
        if path in other and path not in done and not (schema == ODOMETRY and path.startswith("pose.")):
            value, kind, unit = VALUES.get(schema, ("", "", ""))
            kind, unit = (kind, unit) if path == value else ("number", _unit(path))
            if all(is_air(f"{topic}.{path}", side[path]) for side in (own_fields, other)):
                kind = "pressure"
            state = _speed(real) if kind == "pressure" else {}
            pair = replace(SignalPair.of_fields(own_fields[path], other[path], f"{topic}.{path}"), kind=kind, state=state)
            if is_quantity(own_fields[path]):
                yield replace(unwrapped(pair), units=(pair.units[0] or unit,))


def _of_three_topics(
    real: LogFields, sim: LogFields, topics: Mapping[str, str]
) -> Iterator[tuple[tuple[str, ...], SignalPair]]:
    """Magnetic fields whose x, y and z are topics of their own, with these topics."""
    shared = [topic for topic, sim_topic in topics.items() if NUMBER in real.fields[topic] and NUMBER in sim.fields[sim_topic]]
    own_fields, other = (
        {topic: side.fields[of][NUMBER] for topic, of in zip(shared, names, strict=True)}
        for side, names in ((real, shared), (sim, [topics[topic] for topic in shared]))
    )
    for names in field_vectors("", own_fields, other):
        k = next(k for k, letters in enumerate(zip(*names, strict=True)) if len(set(letters)) > 1)
        name = f"{names[0][:k]}xyz{names[0][k + 1 :]}"
        pair = SignalPair.of_columns(name, names, "magnetic", ("",) * 3, own_fields, other, _attitude(real))
        yield names, replace(pair, names=tuple(f"{name}.{axis}" for axis in AXES))


def _unit(path: str) -> str:
    return next((unit for word, unit in UNIT_UNITS.items() if word in path.split(".")), "")


def _remarks(real: LogFields, sim: LogFields, topics: Mapping[str, str]) -> list[str]:
    """What a reader of the findings has to know: joints by index, and what only one log holds."""
    mixed = sorted({*real.mixed, *sim.mixed})
    out = _listed("Not compared, for its messages name now these joints and now those", mixed)
    alone, gaps = list[str](), list[str]()
    for topic, sim_topic in topics.items():
        own_fields, other = real.fields[topic], sim.fields[sim_topic]
        if real.schemas[topic] == JOINTS:
            other = by_joint(other, real.joints[topic], sim.joints[sim_topic])
            out += joint_remarks(topic, real.joints[topic], sim.joints[sim_topic])
        gaps += [
            f"{values.left_out} of {topic}.{path}" for path, values in own_fields.items() if path in other and values.left_out
        ]
        alone += [f"{topic}.{path}" for path in other if path not in own_fields and is_quantity(other[path])]
    out += _listed("Rows of the recording without a number or with a repeated stamp were left out", gaps)
    return out + _listed("Constant, empty or missing in the recording, while the simulation has it", alone)


# ── state ──


def _attitude(side: LogFields) -> dict[str, Fields]:
    """R_wb of the first topic with an orientation that varies, by its entries."""
    for fields in side.fields.values():
        for path in fields:
            if path.endswith("orientation.w"):
                columns = {axis: fields[f"{path[:-1]}{axis}"] for axis in "wxyz" if f"{path[:-1]}{axis}" in fields}
                t_ns, values = stacked(list(columns.values()))
                q = np.zeros((len(t_ns), 4))
                q[:, ["wxyz".index(axis) for axis in columns]] = values
                R = quaternion.matrix(quaternion.unit(q))
                return {f"R{i}{j}": Fields(t_ns, np.ascontiguousarray(R[:, i, j])) for i in range(3) for j in range(3)}
    return {}


def _speed(side: LogFields) -> dict[str, Fields]:
    """Speed from the first topic with a linear velocity."""
    for fields in side.fields.values():
        parts = [values for path, values in fields.items() if ".linear." in f".{path}" and "acceleration" not in path]
        if parts:
            t_ns, values = stacked(parts)
            return {"speed": Fields(t_ns, np.sqrt((values**2).sum(axis=1)))}
    return {}


def _drivers(side: LogFields, pairs: Sequence[SignalPair], parts: Set[str]) -> dict[str, Fields]:
    """Numbers of the recording (but `parts` of a field) that may drive a misfit: temperatures; what is compared last."""
    compared = {name: pair.kind for pair in pairs for name in pair.names}
    found = {
        f"{topic}.{path}": values
        for topic, fields in side.fields.items()
        if side.schemas[topic] not in ELSEWHERE | {JOINTS, ODOMETRY, *TRIPLES} and topic not in parts
        for path, values in fields.items()
        if compared.get(f"{topic}.{path}", "number") == "number"
        and is_quantity(values)
        and (path == VALUES.get(side.schemas[topic], (path,))[0])
    }
    temperatures_first = sorted(found, key=lambda name: ("temperature" not in name.lower(), name in compared))
    return {name: found[name] for name in temperatures_first[:MAX_DRIVERS]}
