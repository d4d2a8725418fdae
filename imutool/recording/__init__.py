"""Recording of a log in memory: immutable, validated arrays on integer-nanosecond clocks.

All data pass through a `Recording`; files are MCAP, and `read(write(r)) == r` bit for bit. Time is int64 nanoseconds. Only
`seconds` converts it to float seconds, always relative to a start (float64 seconds at an epoch of 2014 resolve 384 ns only).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from imutool.array_types import ArrayLike, Bool, Float64, Int64
from imutool.errors import DataError
from imutool.geometry import quaternion
from imutool.recording.columns import Columns, checked_mapping, clock_jumps, converted

GRAVITY_M_S2 = 9.81
UNIT_QUATERNION_TOLERANCE = 1e-6  # six printed decimals, as in the normalised EuRoC truth
TURNED = 0.1  # change of a quaternion's component: a body that turns so far moves as well
GAP_FACTOR, MIN_GAP_S = 4.0, 0.08  # length of a gap in the truth, in median periods, and its least: FETCH jitters by 70 ms
MAX_STRAIGHT_S = 0.015  # median period of poses between which slerp makes a turn of 4 Hz too small by 1 % at most
MIN_PERIOD_S = 20e-6  # an IMU has at most 32 kHz; stamps in microseconds taken for nanoseconds are closer from 50 Hz on

Times = Int64[np.ndarray, " n"]


def seconds(t_ns: Int64[np.ndarray, "*n"], start_ns: int) -> Float64[np.ndarray, "*n"]:
    """Seconds since `start_ns`; the subtraction is exact because it uses integers."""
    return (t_ns - np.int64(start_ns)).astype(np.float64) * 1e-9


def nanoseconds(duration_s: float) -> int:
    """Nanoseconds of a duration, rounded to an integer."""
    return round(duration_s * 1e9)


@dataclass(frozen=True, eq=False, repr=False)
class Imu(Columns):
    """Angular rate (rad/s) and specific force (m/s²) in the body frame b, as measured.

    At rest the specific force is +g up.
    """

    t_ns: Times
    gyro: Float64[np.ndarray, "n 3"]
    accel: Float64[np.ndarray, "n 3"]
    if TYPE_CHECKING:  # lists become arrays

        def __init__(self, t_ns: ArrayLike, gyro: ArrayLike, accel: ArrayLike) -> None: ...

    def __post_init__(self) -> None:
        self.check(gyro=(3,), accel=(3,))

    def check_rate(self, where: str) -> None:
        """Refuse stamps too close for an IMU, such as microseconds in place of nanoseconds.

        Raises:
            DataError: more than half of the samples follow within 20 µs.
        """
        if len(self) > 1 and self.period_s < MIN_PERIOD_S:
            what = f"the IMU has {1.0 / self.period_s:.3g} samples a second: its t_ns is not in nanoseconds"
            raise DataError(what, where=where, expected=f"steps of at least {MIN_PERIOD_S * 1e9:.0f} ns")


@dataclass(frozen=True, eq=False, repr=False)
class Poses(Columns):
    """Poses of the body in the world (m); `q_wb` takes body vectors to world.

    World velocity (m/s) if known. Orientations alone have positions that are all zero.
    """

    t_ns: Times
    p_wb: Float64[np.ndarray, "n 3"]
    q_wb_wxyz: Float64[np.ndarray, "n 4"]
    v_w: Float64[np.ndarray, "n 3"] | None = None
    if TYPE_CHECKING:

        def __init__(self, t_ns: ArrayLike, p_wb: ArrayLike, q_wb_wxyz: ArrayLike, v_w: ArrayLike | None = None) -> None: ...

    def __post_init__(self) -> None:
        self.check(p_wb=(3,), q_wb_wxyz=(4,), v_w=(3,))
        error = np.abs(quaternion.length(self.q_wb_wxyz) - 1.0)
        if len(error) and error.max() > UNIT_QUATERNION_TOLERANCE:
            row = int(np.argmax(error))
            what = f"Poses.q_wb_wxyz row {row} is {self.q_wb_wxyz[row].tolist()}"
            raise DataError(what, expected="norm 1", fix="Divide each quaternion by its norm")

    @property
    def has_positions(self) -> bool:
        """Whether positions are known; without them all are zero while the body turns."""
        turns = len(self) > 0 and bool((np.ptp(self.q_wb_wxyz, axis=0) > TURNED).any())
        return not turns or bool(self.p_wb.any() or (self.v_w is not None and self.v_w.any()))

    def at(self, t_ns: Times, max_gap_s: float | None = None) -> tuple[Poses, Bool[np.ndarray, " n"]]:
        """Poses interpolated at other times, and a mask of the valid ones.

        Position (and velocity) linearly, orientation by slerp along the shorter arc; by a cubic where poses are further apart
        than `MAX_STRAIGHT_S`. The mask is false before the first pose, after the last, and inside a gap longer than
        `max_gap_s` (by default four median periods, at least 80 ms). Masked rows hold the pose of the end or the interpolation.

        Raises:
            DataError: fewer than two poses.
        """
        if len(self) < 2:
            raise DataError(f"Poses has {len(self)} rows", expected="at least 2")
        t_ns = np.atleast_1d(converted(t_ns, "t_ns", times=True))
        gap_s = max(GAP_FACTOR * self.period_s, MIN_GAP_S) if max_gap_s is None else max_gap_s
        clipped = np.clip(t_ns, self.t_ns[0], self.t_ns[-1])
        after = np.clip(np.searchsorted(self.t_ns, clipped, side="left"), 1, len(self.t_ns) - 1)
        exact = self.t_ns[after] == clipped
        exact_first = self.t_ns[after - 1] == clipped
        span_ns = self.t_ns[after] - self.t_ns[after - 1]
        valid = (clipped == t_ns) & ((span_ns <= np.round(1e9 * gap_s)) | exact | exact_first)

        start = int(self.t_ns[0])
        knots, wanted = seconds(self.t_ns, start), seconds(clipped, start)
        share, curved = (clipped - self.t_ns[after - 1]) / span_ns, knots if self.period_s > MAX_STRAIGHT_S else None
        q_wb_wxyz = quaternion.between_rows(self.q_wb_wxyz, after, share, curved)
        p_wb = interpolate(wanted, knots, self.p_wb)
        v_w = None if self.v_w is None else interpolate(wanted, knots, self.v_w)
        for column in (q_wb_wxyz, p_wb, *([] if v_w is None else [v_w])):  # so that the poses need no copy
            column.flags.writeable = False
        return Poses(t_ns, p_wb, q_wb_wxyz, v_w), valid


@dataclass(frozen=True, eq=False, repr=False)
class Scalars(Columns):
    """Numeric channel on its own clock.

    One column (a temperature) or three (a vector), and its unit.
    """

    t_ns: Times
    values: Float64[np.ndarray, "n k"]
    unit: str = ""
    if TYPE_CHECKING:

        def __init__(self, t_ns: ArrayLike, values: ArrayLike, unit: str = "") -> None: ...

    def __post_init__(self) -> None:
        values = converted(self.values, "Scalars.values")
        object.__setattr__(self, "values", values[:, None] if values.ndim == 1 else values)
        self.check(values=self.values.shape[1:])
        if self.values.ndim != 2 or self.values.shape[1] not in (1, 3):
            raise DataError(f"Scalars.values is {list(self.values.shape)}", expected="[n, 1] or [n, 3]")


@dataclass(frozen=True)
class Frames:
    """Camera frames in their source file; a writer copies them in the order of the source."""

    format: str
    count: int
    each: Callable[[], Iterator[tuple[int, bytes]]]  # (t_ns, bytes of the encoded image)


def _dict(value: Any) -> Any:
    return {k: _dict(v) for k, v in value.items()} if isinstance(value, MappingProxyType) else value


PLAIN_PARTS: dict[str, type] = {"name": str, "imu": Imu, "imu_topic": str, "source": str}
KEYED_PARTS: dict[str, type] = {"truths": Poses, "scalars": Scalars, "frames": Frames, "metadata": Mapping, "other_poses": str}


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """Recording of one IMU with its true poses, scalar channels, camera frames and metadata.

    `truths`, `scalars` and `frames` are keyed by topic (`/ground_truth/pose`), `metadata` by record name. `truths` holds an
    estimate or odometry only if the caller named its topic; `other_poses` then states its kind. Equality ignores
    frames: the writer copies them byte for byte, which its tests check.
    """

    name: str
    imu: Imu
    truths: Mapping[str, Poses] = field(default_factory=dict)
    scalars: Mapping[str, Scalars] = field(default_factory=dict)
    frames: Mapping[str, Frames] = field(default_factory=dict)
    metadata: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    imu_topic: str = "/imu0"
    source: str = ""
    other_poses: Mapping[str, str] = field(default_factory=dict)  # kinds of pose topics that are no truth

    def __post_init__(self) -> None:
        for name, kind in PLAIN_PARTS.items():
            if not isinstance(value := getattr(self, name), kind):
                raise DataError(f"Recording.{name} is of type {type(value).__name__}", expected=kind.__name__)
        for name, kind in KEYED_PARTS.items():
            object.__setattr__(self, name, checked_mapping(getattr(self, name), kind, f"Recording.{name}"))

    def __repr__(self) -> str:
        """A line for each topic."""
        topics: list[tuple[str, object]] = [(self.imu_topic, self.imu), *self.truths.items(), *self.scalars.items()]
        topics += [(topic, f"{frames.count} frames, {frames.format}") for topic, frames in self.frames.items()]
        topics += [(topic, f"poses ({kind}), not read") for topic, kind in self.other_poses.items() if topic not in self.truths]
        return "\n".join([f"Recording {self.name!r}", *(f"  {topic}: {content}" for topic, content in topics)])

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Recording):
            return NotImplemented
        names = ("name", "imu", "truths", "scalars", "metadata", "imu_topic", "source")
        return all(getattr(self, n) == getattr(other, n) for n in names)

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle with plain dicts, because mapping proxies do not pickle (recordings go to worker processes)."""
        return type(self), tuple(_dict(getattr(self, f.name)) for f in fields(self))

    @property
    def truth(self) -> Poses:
        """First true trajectory.

        Raises:
            DataError: the recording has none.
        """
        if not self.truths:
            raise self.no_truth("no true poses")
        return next(iter(self.truths.values()))

    def kind_of(self, topic: str) -> str:
        """Kind of a pose topic; a transform, TOPIC/CHILD_FRAME, has the kind of its topic."""
        others = self.other_poses.items()
        return next((kind for other, kind in others if topic == other or topic.startswith(f"{other}/")), "truth")

    @property
    def truth_caveat(self) -> str:
        """Caveat on named poses that are no truth; else empty."""
        chosen = [f"{topic} ({kind})" for topic in self.truths if (kind := self.kind_of(topic)) != "truth"]
        return f"{', '.join(chosen)} is no truth: poses made with this IMU hide errors of it" if chosen else ""

    def no_truth(self, what: str, expected: str = "a pose topic in the log") -> DataError:
        """Error of a recording without truth; it lists the poses that are an estimate or odometry."""
        if not self.other_poses:
            return DataError(what, where=self.name, expected=expected, fix="Convert the IMU together with its true poses")
        listed = ", ".join(f"{topic} ({kind})" for topic, kind in self.other_poses.items())
        fix = "Name one with `truth` to use it anyway"
        return DataError(f"{what}: the poses are {listed}", where=self.name, expected=expected, fix=fix)

    def with_truth(self, topic: str) -> Recording:
        """Recording with only one of its true trajectories.

        Raises:
            DataError: no such topic; the message lists the available ones.
        """
        if topic not in self.truths:
            known = ", ".join(self.truths) or "(none)"
            raise DataError(f"no true poses on {topic}", where=self.name, expected=f"one of {known}")
        return replace(self, truths={topic: self.truths[topic]})

    def between(self, start_ns: int, end_ns: int) -> Recording:
        """Recording without frames, cut to `start_ns <= t_ns <= end_ns`."""
        truths = {k: v.between(start_ns, end_ns) for k, v in self.truths.items()}
        scalars = {k: v.between(start_ns, end_ns) for k, v in self.scalars.items()}
        return replace(self, imu=self.imu.between(start_ns, end_ns), truths=truths, scalars=scalars, frames={})

    def between_jumps(self) -> list[Recording]:
        """Recordings of the stretches between jumps of the IMU's clock; the recording itself without a jump."""
        starts = [start_ns for start_ns, _ in clock_jumps(self.imu.t_ns)]
        edges = [*self.imu.t_ns[:1].tolist(), *starts, *(self.imu.t_ns[-1:] + 1).tolist()]
        return [self.between(a, b - 1) for a, b in pairwise(edges)] if starts else [self]

    def overlap(self) -> Recording:
        """Recording cut to the time that the IMU and the first truth share.

        Raises:
            DataError: no truth, or the two share less than two samples.
        """
        truth, t_ns = self.truth.t_ns, self.imu.t_ns
        if not len(truth) or not len(t_ns) or truth[0] >= t_ns[-1] or truth[-1] <= t_ns[0]:
            raise DataError("IMU and true poses share no time", where=self.name, expected="an overlap")
        cut = self.between(int(max(truth[0], t_ns[0])), int(min(truth[-1], t_ns[-1])))
        if len(cut.imu) < 2 or len(cut.truth) < 2:
            raise DataError("IMU and true poses share fewer than two samples", where=self.name, expected="an overlap")
        return cut


def unit_quaternions(q_wxyz: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 4"]:
    """Unit quaternions; rows that already are unit (to 1e-9) keep every bit.

    Raises:
        DataError: a norm differs from one by more than 0.01; the message names the row.
    """
    norm = np.linalg.norm(q_wxyz, axis=1)
    if (bad := ~(np.abs(norm - 1.0) <= 0.01)).any():
        row = int(np.argmax(bad))
        raise DataError(f"quaternion {q_wxyz[row].tolist()} in row {row} has norm {norm[row]:.6g}", expected="norm 1")
    return np.where(np.abs(norm - 1.0)[:, None] <= 1e-9, q_wxyz, q_wxyz / norm[:, None])


def interpolate(
    t: Float64[np.ndarray, " n"], knots: Float64[np.ndarray, " m"], values: Float64[np.ndarray, "m k"]
) -> Float64[np.ndarray, "n k"]:
    """Columns along straight lines between knots; beyond them the first and the last row."""
    return np.stack([np.interp(t, knots, column) for column in values.T], axis=1)
