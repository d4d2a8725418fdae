"""Read a log as a recording: its IMU, true poses, scalar channels and images."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from imutool.array_types import Float64, Int64, UInt32
from imutool.errors import LogError
from imutool.file_location import Location, log_name
from imutool.geometry import quaternion
from imutool.mcap_io.codec import messages, schemas
from imutool.mcap_io.codec.decode import CLEAN_FIX, StampCheck, check_finite
from imutool.mcap_io.codec.transforms import bodies, is_still
from imutool.mcap_io.frames import read_frames
from imutool.mcap_io.log import Log
from imutool.mcap_io.topics import MESSAGE_POSES, SCALARS, UNIT_KEY, VELOCITY_KEY
from imutool.mcap_io.write import own_and_user_metadata
from imutool.processes.system import release_memory
from imutool.recording import UNIT_QUATERNION_TOLERANCE, Imu, Poses, Recording, Scalars, unit_quaternions
from imutool.recording.columns import ClockRun, clock_jumps, clock_runs, jump_warnings
from imutool.recording.message_log import DOUBTFUL

logger = logging.getLogger(__name__)

RELEASED_BYTES = 1 << 20  # parts of a column this large leave memory that is worth its release


def read(
    path: Location, *, imu: str | None = None, truth: str | None = None, start_ns: int | None = None, end_ns: int | None = None
) -> Recording:
    """The recording in a log: `read(write(r)) == r`, bit for bit.

    Of a log whose clock was set back it is the longest stretch, and a warning says so (`stretches.read_stretches`: all).
    Poses of every pose topic are truths (/tf, by child frame, where there are no others), but not those that are an estimate or
    odometry, unless `truth` names them; lost poses (NaN, zero quaternions) and those that lost their velocity are left out with
    a warning. Of a log that imutool did not write, the name is that of the file, and Float64 and Vector3Stamped topics are
    scalars; one that a recording cannot hold (time going back, NaN) is left out with a warning. `start_ns` and `end_ns` select
    by log time.

    Raises:
        ConfigError: the file cannot be opened.
        LogError: no IMU or several without `imu`, no such topic, values or stamps no recording can hold, a damaged log.
    """
    with Log(path) as log:
        return longest_recording(read_recordings(log, imu=imu, truth=truth, start_ns=start_ns, end_ns=end_ns))


def longest_recording(found: Sequence[Recording]) -> Recording:
    """Longest of the recordings of a log; a warning says which it is."""
    longest = max(found, key=lambda recording: len(recording.imu))
    if len(found) > 1:
        between = f"from {longest.imu.t_ns[0]} to {longest.imu.t_ns[-1]} ns"
        logger.warning("%s: only the longest stretch of its clock is read, %s, without images", longest.name, between)
    return longest


def read_recordings(
    log: Log,
    *,
    imu: str | None = None,
    truth: str | None = None,
    start_ns: int | None = None,
    end_ns: int | None = None,
    samples: Imu | None = None,
    derived: bool = True,
    vectors: bool = True,
    images: bool = True,
    refused: Callable[[str, LogError], None] | None = None,
    warn: Callable[..., None] = logger.warning,
) -> list[Recording]:
    """Recordings of an open log, one for each stretch in which its clock is not set back.

    With `samples` those are the IMU's, and its messages are not read. With `refused`, poses that a recording cannot hold are
    left out and `refused` is called with topic and error. Without `derived` the scalars that imutool computed are not read,
    without `vectors` those of three columns. `warn` is called with what a warning says.

    Raises:
        LogError: as `read`.
    """
    imu_topic = imu if imu and samples is not None else log.topic(imu or log.only_imu(), (schemas.IMU,)).name
    own, metadata = own_and_user_metadata(log.metadata_records(), imu_topic)
    truths = _choose_truths(log, truth)
    velocities = {t.name: t.metadata[VELOCITY_KEY] for t in log.topics.values() if VELOCITY_KEY in t.metadata}
    numbers = [t for t in log.with_schema(SCALARS) if t.is_read and (derived or not t.is_derived)]
    scalars = [t.name for t in numbers if t.name not in velocities and (vectors or SCALARS[t.schema_name] == 1)]
    used = {name: of for name, of in velocities.items() if of in truths}
    others = {t: k for t in (*log.pose_topics, *truths) if (k := log.topics[t].pose_kind) in DOUBTFUL or t not in truths}
    columns = _Columns(log, imu_topic, truths, used, scalars, refused, warn)
    with log.named():
        for topic, rows in log.rows(columns.topics[0 if samples is None else 1 :], start_ns, end_ns):
            columns.take(topic, rows)
    found = []
    for run in columns.runs(samples):
        recording = Recording(
            name=own.get("name", log_name(log.path)),
            imu=columns.imu() if samples is None else samples,
            truths=columns.truths(truth),
            scalars=columns.scalars(),
            frames=read_frames(log, start_ns, end_ns) if images else {},
            metadata=metadata,
            imu_topic=imu_topic,
            source=own.get("source", ""),
            other_poses=others,
        )
        found.append(recording if run.alone else recording.between(run.first_ns, run.last_ns))
    return found


def _choose_truths(log: Log, truth: str | None) -> list[str]:
    """The topics to read poses from; a transform of /tf is chosen as TOPIC/CHILD_FRAME."""
    kinds = (*MESSAGE_POSES, schemas.TF)
    if truth is None:
        return [log.topic(name, kinds).name for name in log.truth_topics]
    if truth in log.topics:
        return [log.topic(truth, kinds).name]
    trees = [t.name for t in log.with_schema((schemas.TF,)) if truth.startswith(f"{t.name}/")]
    if not trees:
        raise LogError(f"there are no poses on {truth}", where=log.path, expected=", ".join(log.pose_topics) or "(none there)")
    return trees


@dataclass
class _Columns:
    """Collects the columns of every wanted topic in one pass over the log."""

    log: Log
    imu_topic: str
    truth_topics: list[str]
    velocity_topics: Mapping[str, str]  # the poses that each is of
    scalar_topics: list[str]
    refused: Callable[[str, LogError], None] | None
    warn: Callable[..., None]
    kept: dict[str, list[tuple[np.ndarray, ...]]] = field(default_factory=dict)  # columns, by topic
    frames: dict[str, dict[tuple[str, str], str]] = field(default_factory=dict)  # names of a tree's poses
    left_out: set[str] = field(default_factory=set)
    lost: Counter[str] = field(default_factory=Counter)  # poses that are none, by topic
    run: ClockRun = field(init=False)  # the current one of `runs`

    @property
    def topics(self) -> list[str]:
        return [self.imu_topic, *self.truth_topics, *self.velocity_topics, *self.scalar_topics]

    def take(self, topic: str, rows: messages.Rows) -> None:
        if topic == self.imu_topic:
            with self.log.named(topic):
                for imu in self.log.topics[topic].decode_imu(rows):
                    check_finite(imu, CLEAN_FIX, angular_velocity=imu.gyro, linear_acceleration=imu.accel)
                    self._keep(topic, imu.sequence, imu.stamp_ns, imu.gyro, imu.accel)
        elif topic in self.truth_topics:
            if topic not in self.left_out:
                with self._leave_out_on_error(topic), self.log.named(topic):
                    self._take_poses(topic, rows)
        elif topic in self.velocity_topics:
            with self.log.named(topic):
                for velocity in self.log.topics[topic].decode_scalars(rows):
                    self._keep(topic, velocity.sequence, velocity.stamp_ns, velocity.values)
        elif topic not in self.left_out:
            try:
                for scalar in self.log.topics[topic].decode_scalars(rows):
                    self._keep(topic, scalar.sequence, scalar.stamp_ns, scalar.values)
            except LogError as error:
                self.warn("%s %s is left out: %s", self.log.path, topic, error.what)
                self.left_out.add(topic)

    def _take_poses(self, topic: str, rows: messages.Rows) -> None:
        tree = self.log.topics[topic].schema_name == schemas.TF
        for every in self.log.topics[topic].decode_poses(rows, lost=True):
            parent, child, pose = every.frame_id.lstrip("/"), every.child_frame_id.lstrip("/"), every.tracked()
            name = f"{topic}/{child}" if tree else topic
            self.frames.setdefault(topic, {})[parent, child] = name
            self.lost[name] += len(every.stamp_ns) - len(pose.stamp_ns)
            self._keep(name, pose.sequence, pose.stamp_ns, pose.p_wb, pose.q_wb_wxyz)

    @contextmanager
    def _leave_out_on_error(self, topic: str) -> Iterator[None]:
        """Leaves out a topic that a recording cannot hold, if the caller wants to know of it."""
        try:
            yield
        except LogError as error:
            if self.refused is None:
                raise
            self.left_out.add(topic)
            self.refused(topic, error)

    def _keep(
        self,
        name: str,
        sequence: UInt32[np.ndarray, " n"],
        stamp_ns: Int64[np.ndarray, " n"],
        *columns: Float64[np.ndarray, "n _"],
    ) -> None:
        self.kept.setdefault(name, []).append((stamp_ns, sequence, *columns))

    def runs(self, samples: Imu | None) -> Iterator[ClockRun]:
        """The stretches of the IMU's clock; `columns` are then those of the current one."""
        parts = self.kept.get(self.imu_topic, []) if samples is None else [(samples.t_ns,)]
        stamp_ns = np.concatenate([np.zeros(0, np.int64), *(part[0] for part in parts)])
        for warning in jump_warnings(clock_jumps(stamp_ns)) if samples is None else ():
            self.warn("%s %s: %s", self.log.path, self.imu_topic, warning)
        found = clock_runs(stamp_ns)
        del parts, stamp_ns  # this function would keep them while recordings are made
        for self.run in found:
            yield self.run

    def columns(self, name: str, *widths: int) -> tuple[Int64[np.ndarray, " n"], list[Float64[np.ndarray, "n _"]]]:
        parts = self.kept.pop(name, []) if self.run.alone else self.kept.get(name, [])  # of one stretch nothing is asked twice
        if not parts:
            return np.zeros(0, np.int64), [np.zeros((0, width)) for width in widths]
        columns_of_parts = [list(column) for column in zip(*parts, strict=True)]
        del parts  # so that no topic is in memory twice
        stamp_ns, sequence, *columns = (joined_column(columns_of_parts.pop(0)) for _ in range(len(columns_of_parts)))
        for column in (stamp_ns, *columns) if self.run.alone else ():  # so that a recording needs no copy
            column.flags.writeable = False
        rows = self.run.rows if name == self.imu_topic else self.run.rows_of(stamp_ns)
        StampCheck(rows.start, fix=CLEAN_FIX if name == self.imu_topic else "").check(stamp_ns[rows], sequence[rows])
        return stamp_ns[rows], [column[rows] for column in columns]

    def imu(self) -> Imu:
        with self.log.named(self.imu_topic):
            stamp_ns, (gyro, accel) = self.columns(self.imu_topic, 3, 3)
            return Imu(stamp_ns, gyro, accel)

    def truths(self, wanted: str | None) -> dict[str, Poses]:
        names: list[str] = []
        for topic in (name for name in self.truth_topics if name not in self.left_out):
            frames = self.frames.get(topic, {})
            tree = [name for pair, name in frames.items() if wanted or pair in bodies(frames)]
            names += tree if self.log.topics[topic].schema_name == schemas.TF else [topic]
        if wanted is not None and wanted not in self.log.topics:
            if wanted not in names:
                expected = ", ".join(names) or "a transform"
                raise LogError(f"there are no poses on {wanted}", where=self.log.path, expected=expected)
            names = [wanted]
        elif wanted is not None and len(names) > 1:
            fix = f"Choose one of {', '.join(names)}"
            raise LogError(f"{wanted} has {len(names)} child frames", where=self.log.path, fix=fix)
        found = {}
        for name in (name for name in names if name not in self.left_out):
            with self._leave_out_on_error(name):
                found[name] = self._poses(name)
        still = {name for name, poses in found.items() if name not in self.log.topics and is_still(poses.q_wb_wxyz)}
        return {name: found[name] for name in sorted(found, key=still.__contains__)}  # a wall is not the IMU's body

    def _poses(self, name: str) -> Poses:
        with self.log.named(name):
            stamp_ns, (p_wb, q_wb_wxyz) = self.columns(name, 3, 4)
            if self.lost[name]:
                what = f"{self.lost[name]} of {self.lost[name] + len(stamp_ns)} poses are lost (NaN, or a quaternion of zero)"
                if not len(stamp_ns):
                    raise LogError(what, expected="poses of a tracked body")
                self.warn("%s %s: %s and left out", self.log.path, name, what)
            away = np.abs(quaternion.length(q_wb_wxyz) - 1.0) > UNIT_QUATERNION_TOLERANCE
            if away.any():  # rows that a recording takes as they are keep every bit
                q_wb_wxyz = np.where(away[:, None], unit_quaternions(q_wb_wxyz), q_wb_wxyz)
            v_w = None
            for topic in (t for t, of in self.velocity_topics.items() if of == name and (t in self.kept or not len(stamp_ns))):
                times, (v_w,) = self.columns(topic, 3)
                if np.array_equal(stamp_ns, times):
                    continue
                _, both, rows = np.intersect1d(stamp_ns, times, assume_unique=True, return_indices=True)
                if not len(both) and len(stamp_ns):
                    raise LogError(f"the velocities on {topic} have other stamps than the poses")
                if alone := len(stamp_ns) - len(both):  # a damaged log ends between the two
                    self.warn("%s %s: poses without a velocity are left out: %d", self.log.path, name, alone)
                stamp_ns, p_wb, q_wb_wxyz, v_w = stamp_ns[both], p_wb[both], q_wb_wxyz[both], v_w[rows]
            return Poses(stamp_ns, p_wb, q_wb_wxyz, v_w)

    def scalars(self) -> dict[str, Scalars]:
        found = {}
        for name in (name for name in self.scalar_topics if name not in self.left_out):
            described = self.log.topics[name]
            try:
                stamp_ns, (values,) = self.columns(name, SCALARS[described.schema_name])
            except LogError as error:
                self.warn("%s %s is left out: %s", self.log.path, name, error.what)
                continue
            found[name] = Scalars(stamp_ns, values, described.metadata.get(UNIT_KEY, ""))
        return found


def joined_column(parts: list[np.ndarray]) -> np.ndarray:
    """Parts of a column as one array.

    The list is emptied, and its memory goes back to the system.
    """
    whole = np.concatenate(parts)
    parts.clear()
    if whole.nbytes > RELEASED_BYTES:
        release_memory()
    return whole
