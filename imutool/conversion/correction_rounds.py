"""Find what a log's motion shows to be wrong, and write the log with it corrected.

One error may hide another: after each round a log without images shows what the next has to correct.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from imutool import registry
from imutool.array_types import Float64
from imutool.cleaning import CleaningSettings, Survey, look
from imutool.cleaning.likelihood import axis_names
from imutool.conversion.corrections import CONVENTIONS, NOT_TURNED, STAMPS, Corrections, pose_notes
from imutool.conversion.message_writer import BULKY, write_log
from imutool.conversion.restamping import find_stamps
from imutool.conversion.shared_corrections import combined, fitted_to
from imutool.log_info.imu_samples import ImuSamples
from imutool.log_info.pose_imu_rotation import Body, agreement_in, body_of, frames_of_copies, is_straight, turned_body
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.reflection import Reflected
from imutool.mcap_io.log import Log
from imutool.mcap_io.storage.output_conflicts import refuse_existing
from imutool.mcap_io.storage.target import copy_file
from imutool.mcap_io.topics import ENCODINGS, MESSAGE_POSES
from imutool.recording.message_log import Message, MessageLog
from imutool.units import AXES, SENSORS

MAX_ROUNDS = 4  # quaternions first, then the clock of poses, which hides a turned body, which hides a wrong world
AS_RECORDED = np.stack([np.eye(3)] * 2)  # axes of gyro and accel


def find_corrections(path: Path, wanted: Sequence[str]) -> Corrections:
    """Corrections that a log shows to be needed.

    If gyro and accel of an IMU lie alike, the body of the poses is turned and not the IMU: a sensor keeps its axes in all
    logs, as its model needs them. Only an IMU behind one that lies as the poses do is turned to that body.

    Raises:
        LogError: damage.
    """
    imus: dict[str, Float64[np.ndarray, "2 3 3"]] = {}
    notes: dict[str, list[str]] = defaultdict(list)
    poses, kept, before = Corrections(), list[str](), list[str]()
    with Log(path) as log:
        stamps = find_stamps(log, notes) if STAMPS in wanted else {}
        for topic in log.imu_topics if CONVENTIONS in wanted else []:
            described = log.topics[topic]
            if not described.is_read:
                continue
            survey = look(log, topic, CleaningSettings(fix=True))
            kept += [f"{topic}: {step}" for step in survey.clock_steps]
            kept += [f"{topic}: {f.what}; its unit stays" for f in survey.findings if f.rule == "units" and f.distrust]
            mount = None if poses.frame_id or (survey.mount == np.eye(3)).all() else survey.mount
            if poses.frame_id:  # the next round judges by the corrected poses
                survey = replace(survey, axes=AS_RECORDED)
            elif mount is not None and any(is_straight(log, ImuSamples(log, each), survey.pose_topic) for each in before):
                survey, mount = replace(survey, axes=np.stack([mount] * 2)), None
            before.append(topic)
            hidden = poses.frame_id or survey.pose_delay_ns or survey.quaternions or (survey.matrices != np.eye(3)).any()
            if survey.pose_topic and mount is None and not hidden:
                survey = replace(survey, axes=np.stack([_gyro_axes(log, topic, survey.pose_topic), np.eye(3)]))
            patched = described.reflected is None or isinstance(described.reflected, Reflected)
            if not patched or described.message_encoding not in ENCODINGS:
                if mount is not None or (survey.matrices != np.eye(3)).any():
                    own = described.own_schema or described.schema_name
                    kept.append(f"{topic} keeps its units and axes: only messages in CDR or ROS 1 are corrected, not {own}")
                continue
            if (survey.matrices != np.eye(3)).any():
                imus[topic] = survey.matrices
                others = "; other fields of its messages stay" if isinstance(described.reflected, Reflected) else ""
                notes[topic].append(_imu_note(survey) + others)
            if poses.frame_id or not survey.pose_topic:
                continue
            comes_later = topic in imus or survey.pose_delay_ns or survey.quaternions  # all of it hides a body's rotation
            turned: Body | None = None if mount is None else body_of(log, survey.pose_topic, mount.T)
            if mount is None and not comes_later:
                turned = turned_body(log, ImuSamples(log, topic), survey.pose_topic)
            changes = pose_notes(survey.world, survey.quaternions, survey.position_unit, survey.pose_delay_ns, turned)
            if changes and (poses_of := log.topics[survey.pose_topic]).reflected is not None:
                kept.append(f"{poses_of.name} keeps its poses: only those of ROS are corrected, not {poses_of.own_schema}")
            elif changes:
                poses = _of_poses(log, survey, turned)
                notes[survey.pose_topic] += changes
        own_types = {t: found for t in (*stamps, *imus) if isinstance(found := log.topics[t].reflected, Reflected)}
    texts = {topic: "; ".join(lines) for topic, lines in notes.items()}
    return replace(poses, imus=imus, stamps=stamps, reflected=own_types, notes=texts, kept=kept)


def _of_poses(log: Log, survey: Survey, turned: Body | None) -> Corrections:
    return Corrections(
        world=survey.world,
        frame_id=next(log.pose_batches(survey.pose_topic)).frame_id,
        late_ns=survey.pose_delay_ns,
        body=turned or NOT_TURNED,
        pose_topic=survey.pose_topic,
        unit=survey.position_unit,
        quaternions=survey.quaternions,
        copies=frames_of_copies(log, survey.pose_topic),
    )


def _gyro_axes(log: Log, topic: str, pose_topic: str) -> Float64[np.ndarray, "3 3"]:
    """Axes of a gyro that hold against poses: some may read the opposite."""
    found = agreement_in(log, ImuSamples(log, topic), pose_topic)
    axes = "" if found is None else found.reversed_axes
    return np.diag([-1.0 if axis in axes and len(axes) < len(AXES) else 1.0 for axis in AXES])


def _imu_note(survey: Survey) -> str:
    gyro, accel = (axis_names(P) for P in survey.axes)
    sizes = [f"{sensor} times {size:.9g}" for sensor, size in zip(SENSORS, survey.scale[::3], strict=True) if size != 1.0]
    return "; ".join([", ".join(sizes)] * bool(sizes) + [f"x, y, z are now {gyro} of gyro and {accel} of accel as recorded"])


def write_corrected(
    log: Path,
    target: Path,
    wanted: Sequence[str],
    common: Corrections | None = None,
    *,
    compression: str,
    overwrite: bool,
) -> tuple[tuple[str, ...], Corrections]:
    """Write a log with corrections of what its motion shows to be wrong.

    The notes come back, and the corrections in one. `common` are corrections of the other logs of its setup: they come first,
    unless the motion contradicts them.

    Raises:
        ImutoolError: damage, or the target cannot be written.
    """
    refuse_existing(target, overwrite=overwrite)
    first = None if common is None else fitted_to(log, common)
    rounds, kept = ([], []) if first is None else _rounds(log, wanted, _with_stamps(first, log, wanted))
    refused = [] if first is None else first.kept
    if not rounds or not all(found.is_of_clock for found in rounds[1:]):
        refused = [] if rounds else refused
        rounds, kept = _rounds(log, wanted)
    kept = [*dict.fromkeys([*refused, *kept]), *_unjudged_poses(log)]
    if not rounds:
        copy_file(log, target, overwrite=overwrite)
        return (*kept,) or ("the motion shows nothing to correct",), Corrections()
    content = _content(log)
    for found in rounds:
        content = found.put_on(content)
    write_log(content, target, compression=compression, overwrite=overwrite)
    return (*content.remarks.notes, *kept), combined(rounds)


def _unjudged_poses(path: Path) -> list[str]:
    """Note on poses that no rule judges, as a filter gives them, where a log has no others."""
    with Log(path) as log:
        topics = [] if log.truth_topics or not log.imu_topics else log.with_schema(MESSAGE_POSES)
        return [
            f"{topic.name} is of kind {topic.pose_kind}, so its axes, unit and clock were not judged; --kind {topic.name}=truth"
            " has them judged"
            for topic in topics
        ]


def _with_stamps(first: Corrections, log: Path, wanted: Sequence[str]) -> Corrections:
    """Corrections of a first round with new stamps, if they are wanted."""
    found = find_corrections(log, [STAMPS]) if STAMPS in wanted else Corrections()
    notes = {topic: "; ".join(filter(None, (found.notes.get(topic), note))) for topic, note in first.notes.items()}
    reflected = {**found.reflected, **first.reflected}
    return replace(first, stamps=found.stamps, reflected=reflected, notes={**found.notes, **notes})


def _rounds(log: Path, wanted: Sequence[str], first: Corrections | None = None) -> tuple[list[Corrections], list[str]]:
    """Corrections of one round after the other, and what stays wrong.

    After each round a log of what shows errors (`_judged`), in a new folder next to `log`, shows what the next has to correct.
    """
    judged, rounds, kept = log, list[Corrections](), list[str]()
    maximum = MAX_ROUNDS if CONVENTIONS in wanted else 1
    with TemporaryDirectory(prefix="rounds-", dir=log.parent) as folder:
        for number in range(maximum):
            by_setup = first if number == 0 else None
            found = find_corrections(judged, [CONVENTIONS] if number else wanted) if by_setup is None else by_setup
            kept = list(found.kept)
            if not found:
                break
            rounds.append(found)
            if number + 1 == maximum:
                break
            small = Path(folder) / f"{number}_{log.name}"
            write_log(found.put_on(_judged(judged)), small, compression="none")
            judged = small
    return rounds, kept


def _content(log: Path, *, images: bool = True) -> MessageLog:
    """Content of a log with its records."""
    module = registry.load("imutool.converters", "mcap_log")
    content: MessageLog = module.read_sequence(next(iter(module.sequences(log))), images=images)
    with Log(log) as opened:
        return replace(content, metadata=opened.metadata())


def _judged(log: Path) -> MessageLog:
    """Content of a log without images, point clouds and single numbers, which show nothing to correct."""
    content = _content(log, images=False)
    with Log(log) as opened:
        left_out = {topic.name for topic in opened.topics.values() if topic.schema_name in (schemas.FLOAT, *BULKY)}

    def messages() -> Iterator[Message]:
        return (message for message in content.messages() if message.topic.name not in left_out)

    counts = {name: count for name, count in content.counts.items() if name not in left_out}
    return replace(content, messages=messages, counts=counts)
