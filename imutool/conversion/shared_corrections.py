"""Corrections that the logs of one setup share: some show what others are too short for.

Each log is corrected by its own motion first. What most of the logs that show anything agree on is then put on the others,
unless their motion contradicts it.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TypeVar

import numpy as np

from imutool.array_types import Float64
from imutool.cleaning.pose_delay import LONGEST_DELAY_S, StepIntegral, lateness, pose_delay, usable
from imutool.cleaning.samples import STEP_NS, STEP_S, Motion
from imutool.cleaning.truth import Truth, read_truth, turning
from imutool.cleaning.unit_evidence import POSES_APART_NS
from imutool.conversion.corrections import NOT_TURNED, Corrections, pose_notes
from imutool.geometry import quaternion
from imutool.log_info.imu_samples import ImuSamples
from imutool.log_info.pose_imu_rotation import Body, body_of, frames_of_copies
from imutool.mcap_io.codec.reflection import Reflected
from imutool.mcap_io.log import Log
from imutool.mcap_io.topics import ENCODINGS, Topic
from imutool.recording.columns import median

FEWEST = 2  # logs that show the same
ALIKE_RAD, ALIKE_NS = np.radians(10.0), 30_000_000  # between rotations of the body, and between delays, of one setup
SAME_RAD = np.radians(0.5)  # between rotations of the body that need not be made equal
SAID = "as in the other logs"

T = TypeVar("T")
FEWEST_TURNS, SEARCHED = 15, 1.0 / 6.0  # turns of a log, and share of it, in which another delay is searched
LAG_S, ALIKE_S = 0.02, 0.03  # steps of the search; between delays of one setup
APART = 1, 4  # poses of 0.1 s between which the body turns: over more, noise of the poses counts less
MIN_CORRELATION = 0.8  # under the best delay
CLEAR = 5.0  # logarithm of a likelihood ratio, with a sample each second


def combined(rounds: Sequence[Corrections]) -> Corrections:
    """Corrections of some rounds in one, without stamps.

    Misread quaternions are corrected in the first round, if in any.
    """
    made = Corrections()
    for found in rounds:
        imus = {topic: matrices @ made.imus.get(topic, np.eye(3)) for topic, matrices in found.imus.items()}
        made = Corrections(
            imus={**made.imus, **imus},
            world=found.world @ made.world,
            late_ns=made.late_ns + found.late_ns,
            body=Body(found.body.turn @ made.body.turn, frozenset()),
            pose_topic=found.pose_topic or made.pose_topic,
            unit=found.unit if made.unit == "m" else made.unit,
            quaternions=made.quaternions or found.quaternions,
        )
    return made


def shared(own: Mapping[int, Corrections]) -> tuple[Corrections, list[int]]:
    """Corrections that logs of one setup share, and the numbers of those that lack any of them."""
    common = _agreed([*own.values()])
    return common, [number for number, found in own.items() if _lacks(found, common)]


def _agreed(logs: Sequence[Corrections]) -> Corrections:
    """What most of the logs that are corrected in a point agree on, point by point."""
    topics = dict.fromkeys(chain.from_iterable(each.imus for each in logs))
    found = {topic: most_alike([each.imus[topic] for each in logs if topic in each.imus], np.allclose) for topic in topics}
    imus = {topic: matrices for topic, matrices in found.items() if matrices is not None}
    pose_topic = most_alike([each.pose_topic for each in logs if each.pose_topic]) or ""
    of_poses = [each for each in logs if each.pose_topic == pose_topic != "" and _corrects(each, imus)]
    worlds = [each.world for each in of_poses if not _is_identity(each.world)]
    turns = [each.body.turn for each in of_poses if not _is_identity(each.body.turn)]
    late = _group([each.late_ns for each in of_poses if each.late_ns], lambda a, b: abs(a - b) < ALIKE_NS)
    world = most_alike(worlds, np.array_equal)
    return Corrections(
        imus=imus,
        world=np.eye(3) if world is None else world,
        late_ns=round(median(np.array(late, float))) if late else 0,
        body=Body(_mean(_group(turns, lambda a, b: _angle(a, b) < ALIKE_RAD)), frozenset()),
        pose_topic=pose_topic,
        unit=most_alike([each.unit for each in of_poses if each.unit != "m"]) or "m",
        quaternions=most_alike([each.quaternions for each in of_poses if each.quaternions]) or "",
    )


def _corrects(log: Corrections, imus: Mapping[str, Float64[np.ndarray, "2 3 3"]]) -> bool:
    """Whether a log corrects IMUs so: what another shows of its poses may come from an IMU that is not corrected."""
    return all(topic in log.imus and np.allclose(log.imus[topic], matrices) for topic, matrices in imus.items())


def _lacks(own: Corrections, common: Corrections) -> bool:
    """Whether a log lacks a common correction, and shows no other in its place; of its delay its own motion says most."""
    has, needs = _points(own), _points(common)
    is_turned, are_turned = not _is_identity(own.body.turn), not _is_identity(common.body.turn)
    angle = _angle(own.body.turn, common.body.turn)
    if any(not _alike(has[point], needs[point]) for point in has.keys() & needs.keys()):
        return False
    if is_turned and are_turned and angle > ALIKE_RAD:
        return False
    return bool(needs.keys() - has.keys()) or (are_turned and angle > SAME_RAD) or (common.late_ns != 0 and own.late_ns == 0)


def _points(found: Corrections) -> dict[str, str | Float64[np.ndarray, "..."]]:
    """What is corrected, but for the delay and the rotation of the body, of which two logs show nearly the same."""
    points: dict[str, str | Float64[np.ndarray, "..."]] = {f"IMU {topic}": matrices for topic, matrices in found.imus.items()}
    points |= {} if _is_identity(found.world) else {"world": found.world}
    points |= {"unit": found.unit} if found.unit != "m" else {}
    return points | ({"quaternions": found.quaternions} if found.quaternions else {})


def _alike(a: str | Float64[np.ndarray, "..."], b: str | Float64[np.ndarray, "..."]) -> bool:
    return a == b if isinstance(a, str) or isinstance(b, str) else bool(np.allclose(a, b))


def fitted_to(path: Path, common: Corrections) -> Corrections | None:
    """Common corrections for a log; None if it lacks a topic, or has messages of another kind."""
    with Log(path) as log:
        needed = [*common.imus, *filter(None, [common.pose_topic])]
        if not needed or not all(name in log.topics and _is_corrected(log.topics[name]) for name in needed):
            return None
        own_types = {t: found for t in common.imus if isinstance(found := log.topics[t].reflected, Reflected)}
        notes = dict.fromkeys(common.imus, f"units and axes are now {SAID}")
        if not common.pose_topic:
            return replace(common, reflected=own_types, notes=notes)
        kept, late_s = list[str](), common.late_ns * 1e-9
        if late_s and log.imu_topics and contradicts_delay(log, log.imu_topics[0], common.pose_topic, late_s):
            of_others = f"in the other logs it is {lateness(late_s)}, which its own motion contradicts"
            kept.append(f"{common.pose_topic} keeps its clock: {of_others}")
            common = replace(common, late_ns=0)
        turned = None if _is_identity(common.body.turn) else body_of(log, common.pose_topic, common.body.turn)
        frame_id = next(log.pose_batches(common.pose_topic)).frame_id
        copies = frames_of_copies(log, common.pose_topic)
    if note := pose_notes(common.world, common.quaternions, common.unit, common.late_ns, turned):
        notes[common.pose_topic] = f"{SAID}, {'; '.join(note)}"
    body = turned or NOT_TURNED
    return replace(common, frame_id=frame_id, body=body, copies=copies, reflected=own_types, notes=notes, kept=kept)


def _is_corrected(topic: Topic) -> bool:
    patched = topic.reflected is None or isinstance(topic.reflected, Reflected)
    return patched and topic.message_encoding in ENCODINGS and topic.count > 0


def _group(values: Sequence[T], alike: Callable[[T, T], bool]) -> Sequence[T]:
    """Largest group of values that are like one of them; empty if it is small, or no majority."""
    groups = [[other for other in values if alike(value, other)] for value in values]
    largest = max(groups, key=len, default=[])
    return largest if len(largest) >= FEWEST and 2 * len(largest) > len(values) else []


def most_alike(values: Sequence[T], alike: Callable[[T, T], bool] = operator.eq) -> T | None:
    """Value that most of the others are like; None without such a majority."""
    group = _group(values, alike)
    return group[0] if group else None


def _is_identity(R: Float64[np.ndarray, "3 3"]) -> bool:
    return np.array_equal(R, np.eye(3))


def _angle(a: Float64[np.ndarray, "3 3"], b: Float64[np.ndarray, "3 3"]) -> float:
    return float(np.linalg.norm(quaternion.log(quaternion.of_matrix(a.T @ b))))


def _mean(turns: Sequence[Float64[np.ndarray, "3 3"]]) -> Float64[np.ndarray, "3 3"]:
    """Mean rotation; of orders of axes and measured rotations that of the measured ones."""
    measured = [turn for turn in turns if not np.isin(np.abs(turn), (0.0, 1.0)).all()] or turns
    if not measured:
        return np.eye(3)
    left, _, right = np.linalg.svd(np.sum(measured, axis=0))
    mean: Float64[np.ndarray, "3 3"] = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    return mean


def contradicts_delay(log: Log, imu_topic: str, pose_topic: str, late_s: float) -> bool:
    """Whether poses that are not late by `late_s` fit the gyro clearly better.

    A delay that the log shows itself decides: it is nearer to `late_s`, or to none. Where it shows none, the correlation of the
    rates is that under the best rotation between the body of the poses and the gyro.
    """
    motion, truth = Motion(), read_truth(log, topics=[pose_topic])
    for samples in ImuSamples(log, imu_topic):
        motion.see(samples)
    if truth is None or len(motion.table()[0]) < FEWEST_TURNS:
        return False
    own = pose_delay(motion, truth)
    if own is not None and own.step is None:
        return abs(own.seconds - late_s) > abs(own.seconds)
    return any(_contradicts(motion, truth, late_s, spacing) for spacing in APART)


def _contradicts(motion: Motion, truth: Truth, late_s: float, spacing: int) -> bool:
    step, mean = motion.table()
    gyro = StepIntegral.of(step, mean[:, :3])
    longest_s = min(LONGEST_DELAY_S, SEARCHED * STEP_S * float(step[-1] - step[0]))
    lags, fits, spans_s = np.arange(-longest_s, longest_s + 1e-9, LAG_S), [], []
    for centre_s in (late_s, 0.0):
        first, last, rate = turning(truth._replace(t_ns=truth.t_ns - round(1e9 * centre_s)), spacing)
        use, first_s, last_s = usable(first, last, motion.middle_ns, step, POSES_APART_NS + (spacing - 1) * STEP_NS)
        inside = (first_s > longest_s + STEP_S * step[0]) & (last_s + longest_s < STEP_S * (step[-1] + 1))
        fits.append(np.zeros(len(lags)))
        if inside.sum() >= FEWEST_TURNS:
            means = (gyro.between(first_s[inside] - lag, last_s[inside] - lag) for lag in lags)
            fits[-1] = np.array([_aligned(rate[use[inside]], measured) for measured in means])
            spans_s.append(float(last_s[inside][-1] - first_s[inside][0]))
    fit_near_zero, best = float(fits[0][np.abs(lags) <= ALIKE_S].max()), float(np.max(fits))
    ratio = np.log((1.0 - min(fit_near_zero, best) ** 2) / max(1.0 - best**2, 1e-9))
    return best > MIN_CORRELATION and bool(0.5 * max(spans_s) * ratio > CLEAR)


def _aligned(a: Float64[np.ndarray, "n 3"], b: Float64[np.ndarray, "n 3"]) -> float:
    """Correlation of vectors under the best rotation."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    singular = np.linalg.svd(a.T @ b, compute_uv=False)
    return float(singular.sum() / np.sqrt(max(float((a**2).sum() * (b**2).sum()), 1e-300)))
