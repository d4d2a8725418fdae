"""Table with a map of its columns: CSV, .xlsx, JSON, Parquet, .npz, MATLAB .mat or HDF5.

Columns and units are recognised from their names. What stays open is asked for: the refusal holds a map file to complete.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from imutool.array_types import Int64
from imutool.errors import ConfigError
from imutool.geometry import quaternion
from imutool.recording import Imu, Poses, Scalars, unit_quaternions
from imutool.recording.joined_imu import joined
from imutool.recording.message_log import MessageLog, Remarks
from imutool.recording.sample_order import in_order, lost_to_set_back

from . import Sequence, _unpacking
from ._source import head, name
from ._tables.columns.geodetic import to_east_north_up
from ._tables.columns.groups import MAX_CONSTANTS, group_entries, imus_apart, pose_clock, shared_group, time_beside, turned
from ._tables.columns.map import (
    IMU_TOPIC,
    POSES_GROUP,
    TRUE_ENTRIES,
    TRUTH_GROUP,
    Entries,
    Proposal,
    TableMap,
    column_named,
    is_whole,
    read_map,
    share_units,
    times_named,
    vectors_named,
    within_groups,
)
from ._tables.columns.motion import settle_accel_unit, sign_doubts
from ._tables.columns.pose_names import rotations_named, why_no_poses
from ._tables.columns.propose import propose, without_copies
from ._tables.columns.rotations import known_rotations, unit_by_poses
from ._tables.columns.times import COUNTED, begun_at_zero, count_times
from ._tables.columns.units import ACCEL_SI, GYRO_SI, POSITION_SI, unit_doubts
from ._tables.files.formats import kind_of, load
from ._tables.files.layouts import known_layout
from ._tables.recordings.folder import load_split, sequences_below
from ._tables.recordings.parts import load_table, recordings_in, refuse_joined
from ._tables.text.dates import said_epoch
from ._tables.text.delimited import Columns, matrix_columns
from ._tables.text.names import listed, topic_of
from ._tables.text.packed import table_name

unpacked = _unpacking.unpacked  # `convert` asks for it where no converter reads a source as it is
GENERAL = True
MAX_SCALARS = 200  # further columns that become topics
MAX_LOSSES, MAX_LISTED = 8, 20  # in a refusal, of columns in a remark
POSES_TOPIC = "/ground_truth/pose"


def sequences(source: Path) -> list[Sequence]:
    """The source itself, if it is a table; tables in folders, or `data.hdf5`."""
    if source.is_dir():
        return [each for found in sequences_below(source) for each in recordings_in(found)]
    if not source.exists():
        raise ConfigError("does not exist", where=source, expected="a file or a folder")
    return recordings_in(Sequence(name(Path(table_name(source))), source)) if kind_of(head(source), source) else []


def read_sequence(sequence: Sequence, *, images: bool = True, mapping: Path | Mapping[str, Any] | None = None) -> MessageLog:
    """Message log of a table, by the map file or by the names of its columns.

    Raises:
        ConfigError: the columns leave something open, a map names columns that do not exist, or a library is missing.
        DataError: the file cannot be read.
    """
    path = sequence.path
    columns = load_split(path, sequence.inside) if path.is_dir() else load_table(path, sequence.inside)
    remarks, place = columns.remarks, mapping if isinstance(mapping, Path) else path
    given = {} if mapping is None else within_groups(read_map(mapping), columns)
    tables = _mapped(columns, given, place) or _proposed(columns, path / sequence.inside, remarks, given)
    tables = [_clocked(columns, table, place) for table in tables]
    for each in (each for each in tables if each.rate_hz):
        refuse_joined(columns, columns.unsigned(each.gyro[0]), place)
    remarks.doubt([doubt for each in tables if "accel" not in given for doubt in sign_doubts(path, each)])
    table = tables[0]  # other columns are on its clock
    turns = *table.quaternion_wxyz, *table.roll_pitch_yaw, *matrix_columns(table.rotation_matrix)
    true = {table.truth_time, *table.position, *turns}
    samples = {c for each in tables for c in (*each.gyro, *each.accel)}
    used = samples | {c for each in tables for c in (each.time, each.counter, each.accel_time)}
    columns = replace(columns, values={**columns.values})
    imus = {each.topic: _imu(columns, each, place, samples - true if each is tables[-1] else set()) for each in tables}
    poses = _truth(columns, table, path, place, remarks, imus[table.topic])
    group = next((g for g in (POSES_GROUP, TRUTH_GROUP) if g in columns.sources), "") if path.is_dir() else ""
    if not poses and (group or "pose_kind" in given):
        remarks.losses.append(f"{columns.sources.get(group, path.name)} gives no poses: {why_no_poses(columns, group)}")
    if poses and not table.truth_file:
        used |= true
    scalars, constants = _further(columns, tables, {column.removeprefix("-") for column in used}, place)
    remarks.losses.extend(sequence.losses)
    log = MessageLog(
        sequence.name,
        path.name,
        imus=imus,
        poses=poses,
        kinds=dict.fromkeys(poses, table.pose_kind),
        scalars=scalars,
        metadata={
            "imutool": {"format": "table", "sequence": sequence.name},
            **{f"imutool/map{each.topic if len(tables) > 1 else ''}": each.described() for each in tables},
            **({"imutool/constants": constants} if constants else {}),
        },
        remarks=remarks,
    )
    return begun_at_zero(log)


def read(source: Path) -> Iterator[MessageLog]:
    """Message log of the source."""
    return map(read_sequence, sequences(source))


def _proposed(columns: Columns, path: Path, remarks: Remarks, given: Entries) -> list[TableMap]:
    """Map of each IMU from the columns' names, and what is given.

    Raises:
        ConfigError: something is open; the message holds a map file to complete.
    """
    separate = {} if known_layout(columns) or given.keys() & {"gyro", "accel"} else imus_apart(columns)
    proposals = {topic: _proposal(part, given) for topic, part in (separate or {IMU_TOPIC: columns}).items()}
    share_units(proposals)
    proposals = without_copies(proposals, columns)
    own_times = len({str(proposal.entries.get("time", "")) for proposal in proposals.values()}) > 1
    maps = []
    for topic, proposal in proposals.items():
        if proposal.open:
            names = listed([column for column in columns.values if not column.startswith(COUNTED)], 2 * MAX_LISTED)
            more = f"; and {len(remarks.losses) - MAX_LOSSES} more losses" if len(remarks.losses) > MAX_LOSSES else ""
            reasons = "; ".join(proposal.reasons + remarks.losses[:MAX_LOSSES]) + more
            raise ConfigError(
                f"the meaning of its columns is not certain: {reasons}. Its columns are {names}",
                where=path,
                fix=f"Give as `mapping` {proposal.in_words()}this file, completed:\n\n"
                f"{proposal.toml([*separate], own_times=own_times)}",
            )
        named = {key: ", ".join(map(str, np.atleast_1d(value))) for key, value in proposal.entries.items()}
        shown = [key for key in named if not named.get(key.removesuffix("_unit"), "").startswith(COUNTED)]
        text = "columns: " + "; ".join(f"{key} = {named[key]}" for key in shown)
        remarks.notes.extend(f"{topic}: {note}" if separate else note for note in (text, *proposal.reasons))
        maps.append(msgspec.convert({"topic": topic, **proposal.entries, "rate_hz": proposal.rate_hz}, TableMap))
    return maps


def _mapped(columns: Columns, given: Entries, place: Path) -> list[TableMap]:
    """Map that needs nothing from the table, or one for each IMU that the names of its columns show; else none.

    Raises:
        ConfigError: the map names no times, and an IMU's table shows none.
    """
    unnamed = {TRUTH_GROUP, POSES_GROUP} & columns.sources.keys() and not given.keys() & {"truth_file", *TRUE_ENTRIES}
    if is_whole(given) and not unnamed:  # poses of another table that it does not name are found by the motion
        return [msgspec.convert(given, TableMap)]
    has_units = {"gyro_unit", "accel_unit"} <= given.keys() and given.keys() & {"time_unit", "rate_hz"}
    if not has_units or given.keys() & {"gyro", "accel"}:
        return []
    named = {topic: propose(part).entries for topic, part in imus_apart(columns).items()}
    own = ("gyro", "accel") if given.keys() & {"time", "rate_hz"} else ("gyro", "accel", "time")
    for topic, entries in named.items():
        if not {*own} <= entries.keys():
            raise ConfigError(f"names no time, and {topic} shows none", where=place, expected="`time`, or `rate_hz`")
    return [
        msgspec.convert({**given, **{s: entries[s] for s in own}, "topic": topic}, TableMap) for topic, entries in named.items()
    ]


def _proposal(columns: Columns, given: Entries) -> Proposal:
    """Map of one IMU and its poses, by what is given, names, magnitudes and motion."""
    proposal = known_layout(columns) or propose(columns, given)
    if {"time", "time_unit", "gyro", "accel"} <= proposal.entries.keys():
        proposal.entries |= group_entries(columns, proposal.entries, proposal.reasons)
        proposal.entries |= pose_clock(columns, proposal.entries)
        tries = {"poses": {} if "truth_file" in given else proposal.entries, "orientations": turned(columns, proposal.entries)}
        units = (
            {kind: unit_by_poses(columns, entries) for kind, entries in tries.items()} if "gyro_unit" in proposal.open else {}
        )
        for kind, unit in [*filter(lambda each: each[1], units.items())][:1]:
            proposal.settle_unit("gyro", unit, f"the {kind} turn as far as a gyro in {unit} says")
    settle_accel_unit(proposal, columns)
    proposal.state(given)
    return proposal


def _clocked(columns: Columns, table: TableMap, place: Path) -> TableMap:
    """The map with a column of counted times, where it has a rate in place of a time, and with the time of its poses."""
    if table.rate_hz:
        length = len(column_named(columns, table.gyro[0].removeprefix("-"), place))
        time = count_times(columns, table.rate_hz, length, table.counter)
        table = msgspec.structs.replace(table, time=time, time_unit="s")
    return msgspec.structs.replace(table, **pose_clock(columns, msgspec.structs.asdict(table)))


def _imu(columns: Columns, table: TableMap, place: Path, spent: set[str]) -> Imu:
    """IMU of a map, on the gyro's stamps; of the columns that are `spent` the values are let go."""
    gyro_ns = times_named(columns, table.time, table.time_unit, place)
    accel_ns = times_named(columns, table.accel_time, table.time_unit, place) if table.accel_time else gyro_ns
    gyro = vectors_named(columns, table.gyro, table.gyro_scale, table.gyro_offset, place)
    accel = vectors_named(columns, table.accel, table.accel_scale, table.accel_offset, place)
    gyro *= GYRO_SI[table.gyro_unit]
    accel *= ACCEL_SI[table.accel_unit]
    for each in (gyro_ns, gyro, accel):
        each.flags.writeable = False  # so that the IMU needs no copy
    for column in map(columns.unsigned, spent):
        columns.values[column] = np.broadcast_to(0.0, len(columns.values[column]))
    for label, t_ns, values in (("gyro", gyro_ns, gyro), ("accel", accel_ns, accel)):
        if len(t_ns) != len(values):
            fix = "Name its times as `accel_time`" if label == "accel" and not table.accel_time else ""
            raise ConfigError(
                f"the {label} has {len(values)} rows and its time {len(t_ns)}", where=place, expected="as many", fix=fix
            )
    imu, _, notes = joined(gyro_ns, gyro, accel_ns, accel, table.topic)
    columns.remarks.notes.extend([*notes, *said_epoch(int(imu.t_ns[0]), table.time)])
    columns.remarks.losses.extend(lost_to_set_back(gyro_ns, table.topic))
    columns.remarks.doubt([f"{table.topic}: {each}" for each in unit_doubts(imu, table.gyro_unit, table.accel_unit)])
    return imu


def _truth(columns: Columns, table: TableMap, path: Path, where: Path, remarks: Remarks, imu: Imu) -> dict[str, Poses]:
    """True poses, where the map names them: in the table, or in a file next to it."""
    if not (table.quaternion_wxyz or table.rotation_matrix or table.roll_pitch_yaw):
        return {}
    if table.truth_file:
        other = (path if path.is_dir() else path.parent) / table.truth_file
        if not other.is_file():
            raise ConfigError(f"truth_file {table.truth_file!r} does not exist", where=where)
        columns = load(other, kind_of(head(other), other))
    t_ns = times_named(columns, table.truth_time or table.time, table.truth_time_unit or table.time_unit, where)
    q_wxyz = rotations_named(columns, table, where)
    p = np.zeros((len(q_wxyz), 3))
    if table.position:
        p = vectors_named(columns, table.position, POSITION_SI[table.position_unit], 0.0, where)
    if not len(t_ns) == len(q_wxyz) == len(p):
        raise ConfigError(f"the truth has {len(t_ns)} times, {len(q_wxyz)} rotations and {len(p)} positions", where=where)
    topic = POSES_TOPIC if table.pose_kind == "truth" else f"/{table.pose_kind}/pose"
    known, notes = known_rotations(q_wxyz, topic)
    t_ns, p, q_wxyz = t_ns[known], p[known], q_wxyz[known]
    if table.pose_world == "ned":
        p, q_wxyz = p[:, [1, 0, 2]] * [1.0, 1.0, -1.0], quaternion.multiply(quaternion.NED_FROM_ENU, q_wxyz)
    else:
        p, q_wxyz, added = to_east_north_up(t_ns, p, q_wxyz, imu)
        notes += added
    kept = in_order(t_ns, np.concatenate([p, q_wxyz], axis=1), topic)
    remarks.notes.extend(notes + kept.notes)
    if not len(kept.t_ns):
        return {}
    if not table.position:
        remarks.notes.append("the poses have no positions: zeros stand for them, and nothing is compared with them")
    return {topic: Poses(kept.t_ns, kept.values[:, :3], unit_quaternions(kept.values[:, 3:]))}


def _further(
    columns: Columns, tables: list[TableMap], used: set[str], where: Path
) -> tuple[dict[str, Scalars], dict[str, str]]:
    """Further columns as topics, on the clock of their group or on an IMU's, and short ones without time as texts."""
    times = [(each, times_named(columns, each.time, each.time_unit, where)) for each in tables]
    constants, numbers, clocks, separate = {}, [], dict[str, Int64[np.ndarray, " n"]](), dict[str, list[str]]()
    for column in [c for c in columns.values if c not in used]:
        table, t_ns = max(times, key=lambda each: shared_group(each[0].time, column))
        beside = time_beside(columns, column, table.time, table.time_unit, separate=True)
        if beside is not None:
            if beside[0] != column:
                clocks[column] = own_ns = times_named(columns, *beside, where)
                if own_ns[0] > t_ns[-1] or own_ns[-1] < t_ns[0]:
                    separate.setdefault(f"{beside[0]} (in {beside[1]})", []).append(column)
        elif len(columns.values[column]) == len(t_ns):
            clocks[column] = t_ns
        elif len(columns.values[column]) <= MAX_CONSTANTS:
            constants[column] = str(columns.values[column].tolist())
        else:
            numbers.append(column)
    notes = (f"{clock} stays apart from the IMU's clock: {listed(names, MAX_LISTED)}" for clock, names in separate.items())
    columns.remarks.notes.extend(notes)
    if numbers:
        columns.remarks.losses.append(f"columns of another length, without a time, are left out: {listed(numbers, MAX_LISTED)}")
    if (over := len(clocks) - MAX_SCALARS) > 0:
        columns.remarks.losses.append(f"the table has {len(clocks)} further columns: {over} of them are left out")
    scalars: dict[str, Scalars] = {}
    for column, times_ns in list(clocks.items())[:MAX_SCALARS]:
        kept = in_order(times_ns, columns.values[column].astype(np.float64)[:, None], column)
        if len(kept.t_ns):
            unit = re.search(r"[\[(]([^\])]*)[\])]\s*$", column)
            topic = topic_of(column, scalars, columns.remarks.notes)
            scalars[topic] = Scalars(kept.t_ns, kept.values, unit[1] if unit else "")
    return scalars, constants
