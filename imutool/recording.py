"""What a log means in memory: immutable, validated arrays on integer-nanosecond clocks.

Everything in the project passes through a `Recording`; at rest everything is MCAP, and `read(write(r)) == r` bit for bit.
Time is int64 nanoseconds here; `seconds` is the one function that turns it into the float seconds of the mathematics,
always relative to a start (float64 seconds at an epoch of 2014 are only good to 384 ns).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from imutool.errors import DataError
from imutool.geometry import quaternion

GRAVITY_M_S2 = 9.81
UNIT_QUATERNION_TOLERANCE = 1e-6  # six printed decimals, as in the EuRoC truth after normalising
GAP_FACTOR = 4.0  # a hole is this many median periods without truth
MIN_GAP_S = 0.08  # but never shorter than this: a 20 Hz truth, or the 70 ms jitter of FETCH, is no gap

Times = Int64[np.ndarray, " n"]


def seconds(t_ns: Int64[np.ndarray, "*n"], start_ns: int) -> Float64[np.ndarray, "*n"]:
    """Seconds since `start_ns`; the subtraction is done on integers, so nothing is rounded before it is small."""
    return (t_ns - np.int64(start_ns)).astype(np.float64) * 1e-9


def nanoseconds(duration_s: float) -> int:
    """A duration in whole nanoseconds."""
    return round(duration_s * 1e9)


class _Columns:
    """Shared by the array types: freeze, check the clock, compare bit for bit, slice by row or by time."""

    t_ns: Times

    def _freeze(self) -> None:
        for column in fields(self):  # type: ignore[arg-type]
            value = getattr(self, column.name)
            if isinstance(value, np.ndarray):
                if not (value.flags.c_contiguous and _is_fixed(value)):
                    value = np.array(value, order="C")
                    value.flags.writeable = False
                object.__setattr__(self, column.name, value)

    def _check(self, **shapes: tuple[int, ...]) -> None:
        """Types, lengths, finite values, strictly increasing time; the message names the row."""
        kind = type(self).__name__
        if self.t_ns.dtype != np.int64 or self.t_ns.ndim != 1:
            raise DataError(f"{kind}.t_ns is {self.t_ns.dtype}{list(self.t_ns.shape)}", expected="int64[n]")
        for name, tail in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            if value.dtype != np.float64 or value.shape != (len(self.t_ns), *tail):
                raise DataError(
                    f"{kind}.{name} is {value.dtype}{list(value.shape)}",
                    expected=f"float64{[len(self.t_ns), *tail]}",
                )
            if not np.isfinite(value).all():
                row = int(np.argmin(np.isfinite(value).reshape(len(value), -1).all(axis=1)))
                raise DataError(f"{kind}.{name} row {row} is {value[row].tolist()}", expected="finite numbers")
        backward = np.flatnonzero(np.diff(self.t_ns) <= 0)
        if len(backward):
            row = int(backward[0]) + 1
            raise DataError(
                f"{kind} time goes from {self.t_ns[row - 1]} to {self.t_ns[row]} ns at row {row}",
                expected="strictly increasing stamps",
            )

    def __len__(self) -> int:
        return len(self.t_ns)

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(_same(getattr(self, c.name), getattr(other, c.name)) for c in fields(self))  # type: ignore[arg-type]

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[object, ...]:
        """Arrays come out of a pickle writeable; the constructor fixes them again."""
        return type(self), tuple(getattr(self, c.name) for c in fields(self))  # type: ignore[arg-type]

    def rows(self, index: slice | Bool[np.ndarray, " n"]) -> Any:
        """The same columns at some rows."""
        cut = {
            c.name: value[index]
            for c in fields(self)  # type: ignore[arg-type]
            if isinstance(value := getattr(self, c.name), np.ndarray)
        }
        return replace(self, **cut)  # type: ignore[type-var]

    def between(self, start_ns: int, end_ns: int) -> Any:
        """The rows with `start_ns <= t_ns <= end_ns`."""
        first, last = np.searchsorted(self.t_ns, start_ns), np.searchsorted(self.t_ns, end_ns, side="right")
        return self.rows(slice(int(first), int(last)))

    @property
    def period_s(self) -> float:
        """Median time between rows.

        Raises:
            DataError: fewer than two rows.
        """
        if len(self.t_ns) < 2:
            raise DataError(f"{type(self).__name__} has {len(self.t_ns)} rows", expected="at least 2")
        return float(np.median(np.diff(self.t_ns))) * 1e-9

    @property
    def duration_s(self) -> float:
        """Time from the first row to the last."""
        return float(self.t_ns[-1] - self.t_ns[0]) * 1e-9 if len(self.t_ns) else 0.0


@dataclass(frozen=True, eq=False)
class Imu(_Columns):
    """Angular rate (rad/s) and specific force (m/s², at rest it reads +g up) in the body frame b, as measured."""

    t_ns: Times
    gyro: Float64[np.ndarray, "n 3"]
    accel: Float64[np.ndarray, "n 3"]

    def __post_init__(self) -> None:
        self._freeze()
        self._check(gyro=(3,), accel=(3,))


@dataclass(frozen=True, eq=False)
class Poses(_Columns):
    """Where the body is in the world (m), `q_wb` taking body vectors to world, and its world velocity (m/s) if known."""

    t_ns: Times
    p_wb: Float64[np.ndarray, "n 3"]
    q_wb_wxyz: Float64[np.ndarray, "n 4"]
    v_w: Float64[np.ndarray, "n 3"] | None = None

    def __post_init__(self) -> None:
        self._freeze()
        self._check(p_wb=(3,), q_wb_wxyz=(4,), v_w=(3,))
        error = np.abs(quaternion.length(self.q_wb_wxyz) - 1.0)
        if len(error) and error.max() > UNIT_QUATERNION_TOLERANCE:
            row = int(np.argmax(error))
            raise DataError(f"Poses.q_wb_wxyz row {row} is {self.q_wb_wxyz[row].tolist()}", expected="norm 1")

    def at(self, t_ns: Times, max_gap_s: float | None = None) -> tuple[Poses, Bool[np.ndarray, " n"]]:
        """Poses at other times, and where they can be trusted.

        Position (and velocity) linearly, orientation by slerp along the shorter arc. The mask is false before the first
        pose, after the last, and inside a gap longer than `max_gap_s` (by default four median periods, at least
        80 ms). Masked rows hold the end's pose or what lies across the gap, so that
        every row stays a valid one.

        Raises:
            DataError: fewer than two poses.
        """
        gap_s = max(GAP_FACTOR * self.period_s, MIN_GAP_S) if max_gap_s is None else max_gap_s
        clipped = np.clip(t_ns, self.t_ns[0], self.t_ns[-1])
        after = np.clip(np.searchsorted(self.t_ns, clipped, side="left"), 1, len(self.t_ns) - 1)
        exact = self.t_ns[after] == clipped
        exact_first = self.t_ns[after - 1] == clipped
        span_ns = self.t_ns[after] - self.t_ns[after - 1]
        valid = (clipped == t_ns) & ((span_ns <= nanoseconds(gap_s)) | exact | exact_first)

        start = int(self.t_ns[0])
        knots, wanted = seconds(self.t_ns, start), seconds(clipped, start)
        share = (clipped - self.t_ns[after - 1]) / span_ns
        q_wb_wxyz = quaternion.unit(quaternion.slerp(self.q_wb_wxyz[after - 1], self.q_wb_wxyz[after], share))
        p_wb = _interpolate(wanted, knots, self.p_wb)
        v_w = None if self.v_w is None else _interpolate(wanted, knots, self.v_w)
        return Poses(t_ns, p_wb, q_wb_wxyz, v_w), valid


@dataclass(frozen=True, eq=False)
class Scalars(_Columns):
    """Any other numeric channel on its own clock: one column (a temperature) or three (a vector), and its unit."""

    t_ns: Times
    values: Float64[np.ndarray, "n k"]
    unit: str = ""

    def __post_init__(self) -> None:
        self._freeze()
        self._check(values=self.values.shape[1:])
        if self.values.ndim != 2 or self.values.shape[1] not in (1, 3):
            raise DataError(f"Scalars.values is {list(self.values.shape)}", expected="[n, 1] or [n, 3]")


@dataclass(frozen=True)
class Frames:
    """Camera frames that stay in their source: opened only to be copied, in the order the source holds them."""

    format: str
    count: int
    each: Callable[[], Iterator[tuple[int, bytes]]]  # (t_ns, the encoded image, byte for byte)


def _mapping(value: Mapping[str, Any]) -> Mapping[str, Any]:
    """A copy that cannot be changed, nor what mappings are in it."""
    return MappingProxyType({k: _mapping(v) if isinstance(v, Mapping) else v for k, v in value.items()})


def _dict(value: Any) -> Any:
    return {k: _dict(v) for k, v in value.items()} if isinstance(value, MappingProxyType) else value


@dataclass(frozen=True, eq=False)
class Recording:
    """One IMU, what is known of the truth, and everything else that came with them.

    `truths` and `scalars` are keyed by topic (`/ground_truth/pose`), `frames` likewise, `metadata` by record name.
    Frames are not compared: they are copied byte for byte by the writer, and a test there holds it to that.
    """

    name: str
    imu: Imu
    truths: Mapping[str, Poses] = field(default_factory=dict)
    scalars: Mapping[str, Scalars] = field(default_factory=dict)
    frames: Mapping[str, Frames] = field(default_factory=dict)
    metadata: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    imu_topic: str = "/imu0"
    source: str = ""

    def __post_init__(self) -> None:
        for name in ("truths", "scalars", "frames", "metadata"):
            object.__setattr__(self, name, _mapping(getattr(self, name)))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Recording):
            return NotImplemented
        names = ("name", "imu", "truths", "scalars", "metadata", "imu_topic", "source")
        return all(getattr(self, n) == getattr(other, n) for n in names)

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[object, ...]:
        """Mapping proxies do not pickle; plain dicts do (recordings cross to worker processes)."""
        return type(self), tuple(_dict(getattr(self, f.name)) for f in fields(self))

    @property
    def truth(self) -> Poses:
        """The first true trajectory.

        Raises:
            DataError: the recording has none.
        """
        if not self.truths:
            raise DataError("no true poses", where=self.name, expected="a pose topic in the log")
        return next(iter(self.truths.values()))

    def with_truth(self, topic: str) -> Recording:
        """The same recording with one of its true trajectories alone.

        Raises:
            DataError: no such topic; the message lists those there are.
        """
        if topic not in self.truths:
            raise DataError(
                f"no true poses on {topic}", where=self.name, expected=f"one of {', '.join(self.truths) or '(none)'}"
            )
        return replace(self, truths={topic: self.truths[topic]})

    def between(self, start_ns: int, end_ns: int) -> Recording:
        """Everything but the frames, cut to `start_ns <= t_ns <= end_ns`."""
        return replace(
            self,
            imu=self.imu.between(start_ns, end_ns),
            truths={k: v.between(start_ns, end_ns) for k, v in self.truths.items()},
            scalars={k: v.between(start_ns, end_ns) for k, v in self.scalars.items()},
            frames={},
        )

    def overlap(self) -> Recording:
        """The stretch in which both the IMU and the (first) truth exist.

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


def unit_quaternions(q_wxyz: Float64[np.ndarray, "n 4"], tolerance: float = 1e-2) -> Float64[np.ndarray, "n 4"]:
    """Quaternions made unit; rows that already are (to 1e-9) keep every bit.

    Raises:
        DataError: a norm is further than `tolerance` from one; the message names the row.
    """
    norm = np.linalg.norm(q_wxyz, axis=1)
    bad = ~(np.abs(norm - 1.0) <= tolerance)
    if bad.any():
        row = int(np.argmax(bad))
        raise DataError(f"quaternion {q_wxyz[row].tolist()} in row {row} has norm {norm[row]:.6g}", expected="norm 1")
    return np.where(np.abs(norm - 1.0)[:, None] <= 1e-9, q_wxyz, q_wxyz / norm[:, None])


def _interpolate(
    t: Float64[np.ndarray, " n"], knots: Float64[np.ndarray, " m"], values: Float64[np.ndarray, "m k"]
) -> Float64[np.ndarray, "n k"]:
    return np.stack([np.interp(t, knots, column) for column in values.T], axis=1)


def _same(a: object, b: object) -> bool:
    """Equal to the last bit (so that -0.0 and 0.0 differ, as they do in a file)."""
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        if not (isinstance(a, np.ndarray) and isinstance(b, np.ndarray)):
            return False
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    return bool(a == b)


def _is_fixed(array: np.ndarray) -> bool:
    """Whether nobody can write to an array, also not through the one it is a view of."""
    owner: object = array
    while isinstance(owner, np.ndarray):
        if owner.flags.writeable:
            return False
        owner = owner.base
    return owner is None or isinstance(owner, bytes)
