"""Rotation between a log's poses and its IMU, and how far the poses explain the gyro."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.cleaning.samples import BLOCK
from imutool.cleaning.truth import Truth, Turned, best_rotation, read_truth, reversed_axes, rotation_deg, turning
from imutool.geometry import quaternion
from imutool.inertial.strapdown import velocity_follows
from imutool.log_info.imu_samples import ImuSamples
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.log import Log
from imutool.recording import GAP_FACTOR, Imu, Recording, seconds
from imutool.recording.columns import median, quantile
from imutool.units import AXES, MAX_RATE_RAD_S

logger = logging.getLogger(__name__)

MIN_TURNS = 20  # between poses
MIN_RATE_RAD_S = 0.02  # rms of the gyro about its mean: less shows nothing
MIN_EXPLAINED = 0.5  # of the gyro's motion, for a rotation to be reported
LESS_TURNED = 1.0 / 3.0  # at most, of what the poses leave of the gyro's motion as recorded, remains with a turned body
UNLIKE_RAD_S = 0.1  # rms that poses leave of the gyro's motion; EuRoC, TUM-VI and FETCH explain at least 91 %
JUMP_DEG, JUMP_MEDIANS, JUMP_SHARE = 5.0, 10.0, 0.2  # misfit of a turn in 0.1 s; by the usual misfit; of the gyro's turn
MIN_JUMPS_DEG = 15.0  # their sum, below which one is no news
MAX_JUMPS, REFITS = 0.1, 4  # share of the turns up to which jumps are left out, and fits that find them
UNSURE_SHARE, UNSURE_DEG = 0.1, (1.0, 3.0)  # of a rotation, within these: its standard deviation, if it is not reported
SPARSE_S, FEWEST_BETWEEN = 0.15, 8  # period of poses, from which on they may be too far apart, and poses that show it
MAX_BETWEEN_DEG, OFTEN = 1.0, 0.9  # error of turns between poses, and share of them that have less
TURNED_DEG = 4.0  # more than a mount that was meant to be straight; EuRoC, TUM-VI and BROAD have up to 1.5
CORRECTION = "imutool convert LOG OUT --fix corrects it"
BY_HAND = "turn the axes of the IMU or those of the poses to one body, or record turns about two axes for --fix"
SAME_TURN = 1e-9  # of two quaternions, how far the product may be from 1


class Agreement(NamedTuple):
    """Part of the gyro that poses explain, and the rotation of their body."""

    rms_rad_s: float
    explained: float
    as_recorded: float  # share that they explain without that rotation; below zero, rates of the other sign
    turned: Turned | None  # None if the motion does not show it
    jumps: int  # steps of a tenth of a second in which the poses turn and the gyro does not
    largest_jump_deg: float
    reversed_axes: str  # of the gyro, such as `y`

    def figures(self) -> dict[str, float | str]:
        """Entries of a report on the poses."""
        own: dict[str, float | str] = {"gyro_rms_rad_s": self.rms_rad_s, "gyro_explained": self.explained}
        own["gyro_explained_as_recorded"] = self.as_recorded
        return own | {"jumps": self.jumps, "largest_jump_deg": self.largest_jump_deg, "gyro_reversed_axes": self.reversed_axes}


class GyroTurns:
    """Turns of a gyro between poses, from samples in blocks."""

    def __init__(self, poses: Truth, period_ns: float) -> None:
        """`period_ns` is the median step between the samples."""
        self._poses, self._gap_ns, self._samples = poses, GAP_FACTOR * period_ns, 0
        self._turned = np.full((len(poses.t_ns), 3), np.nan)  # from the first sample to each pose
        self._gaps = [np.zeros((0, 2), np.int64)]
        self._first_ns, self._last_ns = 0, 0
        self._last: tuple[Float64[np.ndarray, "1 3"], Float64[np.ndarray, "1 3"]] | None = None  # rate, and turn so far

    def see(self, t_ns: Int64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"]) -> None:
        """Add the next samples, in order of time; rates that no gyro measures count as missing."""
        sound = (np.abs(gyro) <= MAX_RATE_RAD_S).all(axis=1)
        t_ns, gyro = t_ns[sound], gyro[sound]
        if not len(t_ns):
            return
        if self._last is None:
            self._first_ns, turned = int(t_ns[0]), np.zeros((1, 3))
        else:
            t_ns, gyro = np.append(self._last_ns, t_ns), np.concatenate([self._last[0], gyro])
            turned = self._last[1]
        t, steps = seconds(t_ns, self._first_ns), np.diff(t_ns)
        turned = np.cumsum(np.concatenate([turned, np.diff(t)[:, None] * (gyro[1:] + gyro[:-1]) / 2.0]), axis=0)
        first, end = np.searchsorted(self._poses.t_ns, t_ns[0]), np.searchsorted(self._poses.t_ns, t_ns[-1], side="right")
        at = seconds(self._poses.t_ns[first:end], self._first_ns)
        for axis, column in enumerate(turned.T):
            self._turned[first:end, axis] = np.interp(at, t, column)
        gap = steps > self._gap_ns
        self._gaps.append(np.stack([t_ns[:-1][gap], t_ns[1:][gap]], axis=1))
        self._samples += len(t_ns) - (self._last is not None)
        self._last_ns, self._last = int(t_ns[-1]), (gyro[-1:], turned[-1:])

    def agreement(self) -> Agreement | None:
        """Agreement of the turns of poses with the gyro; None where the two share too little motion.

        gyro = b + R omega, with the constant bias b and rotation R that fit best (Kabsch), over intervals of a tenth of a
        second without a gap of the IMU. A few jumps of the poses are counted, and left out of all other figures.
        """
        poses = self._poses
        if self._samples < MIN_TURNS or len(poses.t_ns) < MIN_TURNS:
            return None
        start_ns, end_ns, rate = turning(poses)
        steps = (end_ns - start_ns).astype(float)
        inside = (start_ns >= self._first_ns) & (end_ns <= self._last_ns) & (steps < 4.0 * median(steps))
        inside &= np.isfinite(rate).all(axis=1)
        gaps = np.concatenate(self._gaps)
        inside &= np.searchsorted(gaps[:, 0], end_ns) <= np.searchsorted(gaps[:, 1], start_ns, side="right")
        if inside.sum() < MIN_TURNS:
            return None
        begin, end = (seconds(t_ns[inside], self._first_ns) for t_ns in (start_ns, end_ns))
        mean = (self._turned[1:] - self._turned[:-1])[inside] / (end - begin)[:, None]
        return _agreement(mean, rate[inside], begin, end)


def agreement(poses: Truth, imu: Imu) -> Agreement | None:
    """Agreement of poses with samples in memory, as `GyroTurns.agreement`."""
    if len(imu) < MIN_TURNS:
        return None
    turns = GyroTurns(poses, float(median(np.diff(imu.t_ns))))
    for first in range(0, len(imu), BLOCK):
        turns.see(imu.t_ns[first : first + BLOCK], imu.gyro[first : first + BLOCK])
    return turns.agreement()


def _agreement(
    mean: Float64[np.ndarray, "n 3"],
    rate: Float64[np.ndarray, "n 3"],
    begin: Float64[np.ndarray, " n"],
    end: Float64[np.ndarray, " n"],
) -> Agreement | None:
    """Agreement of mean rates of the gyro with those of the poses, between two times."""
    length_s, kept, jumps = end - begin, np.ones(len(begin), bool), np.zeros(0)
    for _ in range(REFITS):
        gyro, omega = mean - mean[kept].mean(axis=0), rate - rate[kept].mean(axis=0)
        turn = best_rotation(gyro[kept], omega[kept])
        misfit = np.linalg.norm(gyro - omega @ turn.T, axis=1)
        off_deg = np.degrees(misfit * length_s)
        clear = JUMP_SHARE * np.linalg.norm(gyro, axis=1) < misfit  # else a scale or a clock may be off
        jumped = clear & (off_deg > max(JUMP_DEG, JUMP_MEDIANS * median(off_deg)))
        jumps = off_deg[jumped] if off_deg[jumped].sum() > MIN_JUMPS_DEG else np.zeros(0)
        if not len(jumps) or len(jumps) > MAX_JUMPS * len(kept):
            break
        kept = ~jumped
    motion = float(np.sqrt((gyro[kept] ** 2).sum(axis=1).mean()))
    if motion < MIN_RATE_RAD_S:
        return None
    rms = float(np.sqrt((misfit[kept] ** 2).mean()))
    explained = max(0.0, 1.0 - (rms / motion) ** 2)
    as_recorded = 1.0 - float(((gyro - omega)[kept] ** 2).sum(axis=1).mean()) / motion**2
    seen = explained > MIN_EXPLAINED
    opposite = reversed_axes(gyro[kept], omega[kept]) if seen else ""  # then no turned body explains the rates
    body = rotation_deg(turn, gyro[kept], omega[kept], float(end[-1] - begin[0])) if seen and not opposite else None
    if body is not None and body.std_deg.max() >= np.clip(UNSURE_SHARE * np.linalg.norm(body.deg), *UNSURE_DEG):
        body = None
    return Agreement(rms, explained, as_recorded, body, len(jumps), float(jumps.max(initial=0.0)), opposite)


def turned_somehow(explained: float, as_recorded: float) -> bool:
    """Whether poses explain the gyro's motion with their body turned, and none without."""
    less = 1.0 - explained < LESS_TURNED * (1.0 - as_recorded)
    return explained > MIN_EXPLAINED and as_recorded < 0.0 and less


def body_warnings(topic: str, turned_deg: Sequence[float], explained: float, as_recorded: float) -> list[str]:
    """Warning of poses whose body is turned far, also where the motion does not show how."""
    if not len(turned_deg) and turned_somehow(explained, as_recorded):
        text = f"the poses {topic} turn as the gyro does only with their body turned, and the motion does not show how"
        return [f"{text}: turns about one axis, as of a vehicle; {BY_HAND}"]
    deg = float(np.linalg.norm(turned_deg))
    text = f"the body of the poses {topic} is turned by {deg:.0f}° against the gyro; {CORRECTION}"
    return [text] if _is_far(turned_deg) else []


def reversed_warnings(topic: str, axes: str) -> list[str]:
    """Warning of axes of the gyro that read the opposite of poses; other rules find all three."""
    what = f"the gyro reads turns about {', '.join(axes)} with the opposite sign of the poses {topic}: its axes are left-handed"
    fix = "imutool convert LOG OUT --fix reverses them"  # a model may learn from such a log, and no command refuses it
    return [f"{what}; {fix}"] if 0 < len(axes) < len(AXES) else []


def _is_far(turned_deg: Sequence[float] | Float64[np.ndarray, " 3"]) -> bool:
    return float(np.linalg.norm(turned_deg)) > TURNED_DEG


def unlike(explained: float, rms_rad_s: float) -> bool:
    """Whether poses leave most of the gyro's motion unexplained."""
    return explained <= MIN_EXPLAINED and rms_rad_s >= UNLIKE_RAD_S


def motion_warnings(topic: str, explained: float, rms_rad_s: float, jumps: int, largest_deg: float) -> list[str]:
    """Warning of poses that do not turn as the gyro does, or at times jump."""
    if unlike(explained, rms_rad_s):
        causes = (
            "clocks that differ, a gyro in another unit, poses of another recording or body, jumps or noise, or quaternions"
            " inverted or in another order"
        )
        return [f"the poses {topic} explain {explained:.0%} of the gyro's motion: {causes}"]
    if not jumps:
        return []
    often = "once" if jumps == 1 else f"{jumps} times"
    text = f"the poses {topic} turn by up to {largest_deg:.0f}° in 0.1 s that the gyro does not show, {often}"
    return [f"{text}: markers that were exchanged or hidden, a gyro that stands still or is clipped, or clocks that differ"]


def sparse_warnings(poses: Truth) -> list[str]:
    """Warning of poses so far apart that interpolation misses the turns between them.

    Where every other pose is left out, interpolation misses about four times as much as between all.
    """
    period_s = 1e-9 * float(median(np.diff(poses.t_ns)))
    t_s = seconds(poses.t_ns, int(poses.t_ns[0]))
    middle = np.flatnonzero(t_s[2:] - t_s[:-2] < GAP_FACTOR * period_s) + 1
    if period_s < SPARSE_S or len(middle) < FEWEST_BETWEEN:
        return []
    q_wxyz, share = quaternion.unit(poses.q_wb_wxyz), (t_s[middle] - t_s[middle - 1]) / (t_s[middle + 1] - t_s[middle - 1])
    between = quaternion.slerp(q_wxyz[middle - 1], q_wxyz[middle + 1], share)
    missed_deg = float(np.degrees(quantile(quaternion.angle_between(between, q_wxyz[middle]), OFTEN))) / 4.0
    if missed_deg < MAX_BETWEEN_DEG:
        return []
    what = (
        f"the poses {poses.topic} are {period_s:.2g} s apart, and interpolation between them is off by up to {missed_deg:.1f}°"
    )
    return [f"{what}: starts, training and scores take this for an error of the samples"]


class Body(NamedTuple):
    """Rotation from a turned body of poses to the gyro's axes, and its frames in transforms."""

    turn: Float64[np.ndarray, "3 3"]
    frames: frozenset[str]


def turned_body(log: Log, imu: ImuSamples, topic: str) -> Body | None:
    """Body of poses that is turned by more than `TURNED_DEG`."""
    found = agreement_in(log, imu, topic)
    if found is None or found.turned is None or not _is_far(found.turned.deg):
        return None
    return body_of(log, topic, quaternion.matrix(quaternion.exp(np.radians(found.turned.deg)[None]))[0])


def is_straight(log: Log, imu: ImuSamples, topic: str) -> bool:
    """Whether an IMU shows that it lies as the body of poses does."""
    found = agreement_in(log, imu, topic)
    return found is not None and found.turned is not None and not _is_far(found.turned.deg)


def agreement_in(log: Log, imu: ImuSamples, topic: str) -> Agreement | None:
    """Agreement of the poses of a log with an IMU; None where the two share too little motion."""
    if (poses := read_truth(log, topics=[topic])) is None:
        return None
    turns = GyroTurns(poses, imu.sound.steps.median())
    for samples in imu:
        turns.see(samples.stamp_ns, samples.values[:, :3])
    return turns.agreement()


def body_of(log: Log, topic: str, turn: Float64[np.ndarray, "3 3"]) -> Body:
    """Body of poses that is turned so, with its frames in transforms.

    A frame whose transforms have the same orientations is the same body.
    """

    def same(poses: Float64[np.ndarray, "n 7"], frames: Float64[np.ndarray, "n 7"]) -> bool:
        return bool((np.abs((poses[:, 3:] * frames[:, 3:]).sum(axis=1)) > 1.0 - SAME_TURN).all())

    return Body(turn, _frames_alike(log, topic, same))


def frames_of_copies(log: Log, topic: str) -> frozenset[str]:
    """Frames of transforms whose positions are those of a topic, wherever they share a stamp."""
    return _frames_alike(log, topic, lambda poses, frames: np.array_equal(poses[:, :3], frames[:, :3]))


def _frames_alike(log: Log, topic: str, same: Callable[..., bool]) -> frozenset[str]:
    """Frames of transforms that share stamps with a topic and are there the `same`, by positions and quaternions."""
    poses = read_truth(log, topics=[topic])
    alike, other = set[str](), set[str]()
    if poses is None:
        return frozenset()
    for named in log.with_schema((schemas.TF,)):
        for batch in log.pose_batches(named.name):
            _, pose_rows, imu_rows = np.intersect1d(poses.t_ns, batch.stamp_ns, return_indices=True)
            own = np.hstack([poses.p_wb, poses.q_wb_wxyz])[pose_rows]
            frame = np.hstack([batch.p_wb, batch.q_wb_wxyz])[imu_rows]
            (alike if len(pose_rows) and same(own, frame) else other).add(batch.child_frame_id)
    return frozenset(alike - other)


def velocities_judged(recording: Recording) -> Recording:
    """The recording; a warning of velocities that `strapdown.with_velocity` does not use."""
    for topic, poses in [*recording.truths.items()][:1]:
        if not velocity_follows(poses):
            warn_of_velocities(recording.name, topic)
    return recording


def warn_of_velocities(name: str, topic: str) -> None:
    """Warn of velocities that do not follow the positions of a topic."""
    what = "%s: the velocities of %s do not follow its positions (body axes, another unit); the positions give them"
    logger.warning(what, name, topic)
