"""Everything a picture of a log shows, computed once, free of any viewer; Rerun, the report and tests read this."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial.transform import Rotation

from imutool.errors import ConfigError, DataError
from imutool.metrics import evaluate
from imutool.recording import GAP_FACTOR, MIN_GAP_S, Imu, Poses, Recording, Scalars, Times, nanoseconds, seconds
from imutool.strapdown import Start, along_truth, dead_reckon, with_velocity

RAW = "raw"
TRUTH = "truth"  # its place in the pictures; no run may take it
LEVELLING_S = 0.5  # without truth the first half second of specific force says where up is
TRUE_BIAS = {"gyro": "/ground_truth/bias/gyro", "accel": "/ground_truth/bias/accel"}

Vectors = Float64[np.ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class Run:
    """One way of reading the IMU: `raw`, or a model's name, with what it subtracted (zeros for raw)."""

    name: str
    imu: Imu
    gyro_bias: Float64[np.ndarray, "n 3"]
    accel_bias: Float64[np.ndarray, "n 3"]

    def __post_init__(self) -> None:
        for name in ("gyro_bias", "accel_bias"):
            rows = len(getattr(self, name))
            if rows != len(self.imu):
                raise DataError(f"{name} has {rows} rows", where=self.name, expected=f"{len(self.imu)}, as the IMU")

    @classmethod
    def raw(cls, imu: Imu) -> Run:
        """The IMU as recorded."""
        nothing = np.zeros_like(imu.gyro)
        return cls(RAW, imu, nothing, nothing)


@dataclass(frozen=True, eq=False)
class Errors:
    """How far an estimate is from the truth at its own stamps; a row is NaN where there is no truth to compare with."""

    t_ns: Times
    orientation_deg: Float64[np.ndarray, "n 3"]  # Log(R_true^T R_estimated), in the true body frame
    position_m: Float64[np.ndarray, "n 3"]  # estimated minus true, world

    @property
    def orientation_total_deg(self) -> Float64[np.ndarray, " n"]:
        """The angle of the orientation error, 0 to 180 degrees."""
        return _length(self.orientation_deg)

    @property
    def position_total_m(self) -> Float64[np.ndarray, " n"]:
        """The length of the position error."""
        return _length(self.position_m)


@dataclass(frozen=True, eq=False)
class Trace:
    """A run and what follows from it: the dead-reckoned path, its errors and its figures (without truth: neither)."""

    run: Run
    path: Poses
    errors: Errors | None
    figures: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The run's name."""
        return self.run.name

    @property
    def is_raw(self) -> bool:
        """Whether this is the IMU as recorded."""
        return self.run.name == RAW


@dataclass(frozen=True, eq=False)
class RunData:
    """A log, ready to be looked at: `traces` in the order of the runs, elapsed time counted from `start_ns`.

    `true_bias` holds `gyro` (rad/s) and `accel` (m/s²) where the log knows them; `notes` are sentences for the reader.
    """

    name: str
    start_ns: int
    end_ns: int
    truth: Poses | None
    true_bias: Mapping[str, Scalars]
    traces: tuple[Trace, ...]
    notes: tuple[str, ...]

    @property
    def duration_s(self) -> float:
        """From the first IMU sample to the last."""
        return (self.end_ns - self.start_ns) * 1e-9

    def elapsed_s(self, t_ns: Times) -> Float64[np.ndarray, " n"]:
        """Seconds since the first IMU sample."""
        return seconds(t_ns, self.start_ns)

    def table(self) -> list[tuple[str, list[float | None]]]:
        """The figures as rows: a label (`aoe_deg`, `roe_deg 5`) and one value per trace, `None` where it has none."""
        columns = [dict(_numbers(trace.figures)) for trace in self.traces]
        labels = list(dict.fromkeys(label for column in columns for label in column))
        return [(label, [column.get(label) for column in columns]) for label in labels]

    def models(self) -> tuple[Trace, ...]:
        """The traces that are not raw."""
        return tuple(trace for trace in self.traces if not trace.is_raw)


def build(recording: Recording, runs: Sequence[Run]) -> RunData:
    """What there is to see of a log read in one or several ways.

    With truth every path starts at the true pose and velocity of the first sample that has one, ends with the last
    such sample, and errors are without any alignment. Without, a path starts at the origin, at rest, level by the
    first half second of its own specific force and with heading zero, and there are no errors.

    Raises:
        ConfigError: no run, or two of one name.
        DataError: IMU and truth share fewer than two samples.
        NumericsError: an integration overflows.
    """
    names = [run.name for run in runs]
    if not names or len(set(names)) < len(names) or TRUTH in names:
        raise ConfigError(f"runs are called {names}", where=recording.name, expected="names of their own, not 'truth'")
    imu = recording.imu
    if recording.truths:
        truth = with_velocity(recording.truth)
        traces = tuple(_scored(run, truth, recording.name) for run in runs)
        started = seconds(traces[0].path.t_ns[:1], int(imu.t_ns[0]))[0]
        notes = (f"Paths start at the true pose, {started:.2f} s into the log; errors are without alignment.",)
    else:
        truth = None
        traces = tuple(Trace(run, dead_reckon(run.imu, level_start(run.imu)), None) for run in runs)
        notes = (
            f"This log has no truth, so there are no errors. Paths start at the origin, at rest, heading 0, "
            f"levelled by the first {LEVELLING_S:g} s of specific force.",
        )
    return RunData(
        name=recording.name,
        start_ns=int(imu.t_ns[0]),
        end_ns=int(imu.t_ns[-1]),
        truth=None if truth is None else truth.between(int(imu.t_ns[0]), int(imu.t_ns[-1])),
        true_bias=_true_bias(recording),
        traces=traces,
        notes=notes,
    )


def level_start(imu: Imu) -> Start:
    """The start at the origin, at rest, heading zero, with roll and pitch that make the first specific force point up.

    roll = atan2(f_y, f_z), pitch = atan2(-f_x, hypot(f_y, f_z)): exact if the IMU does not accelerate in that time.
    """
    first = imu.between(int(imu.t_ns[0]), int(imu.t_ns[0]) + nanoseconds(LEVELLING_S))
    f_x, f_y, f_z = first.accel.mean(axis=0)
    level = Rotation.from_euler("ZYX", [0.0, np.arctan2(-f_x, np.hypot(f_y, f_z)), np.arctan2(f_y, f_z)])
    return Start(level.as_quat(scalar_first=True), np.zeros(3), np.zeros(3))


def errors(estimate: Poses, truth: Poses, valid: Bool[np.ndarray, " n"]) -> Errors:
    """The error of an estimate against the truth at the same stamps, NaN where `valid` is false."""
    true, found = (Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True) for poses in (truth, estimate))
    hole = np.where(valid, 0.0, np.nan)[:, None]
    turned = np.rad2deg((true.inv() * found).as_rotvec())
    return Errors(estimate.t_ns, turned + hole, estimate.p_wb - truth.p_wb + hole)


def stretches(poses: Poses) -> list[Poses]:
    """The poses cut at their gaps (as `Poses.at` knows them), so that nobody draws a line across one."""
    if len(poses) < 2:
        return [poses]
    gap_ns = nanoseconds(max(GAP_FACTOR * poses.period_s, MIN_GAP_S))
    edges = [0, *(np.flatnonzero(np.diff(poses.t_ns) > gap_ns) + 1).tolist(), len(poses)]
    return [poses.rows(slice(first, last)) for first, last in pairwise(edges)]


def sparse(count: int, most: int) -> Int64[np.ndarray, " m"]:
    """Rows to draw when there are more than `most`: evenly strided, the last one always among them."""
    stride = max(1, -(-count // most))
    return np.unique(np.append(np.arange(0, count, stride), max(count - 1, 0)))


def _true_bias(recording: Recording) -> Mapping[str, Scalars]:
    """The true biases that the log knows, while the IMU runs."""
    imu = recording.imu
    known = {kind: recording.scalars[topic] for kind, topic in TRUE_BIAS.items() if topic in recording.scalars}
    return MappingProxyType({kind: b.between(int(imu.t_ns[0]), int(imu.t_ns[-1])) for kind, b in known.items()})


def _scored(run: Run, truth: Poses, where: str) -> Trace:
    """One run from the first sample with truth to the last, with its errors and figures."""
    path, true, valid = along_truth(run.imu, truth, where)
    return Trace(run, path, errors(path, true, valid), MappingProxyType(evaluate(path, true, valid)))


def _numbers(figures: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    """The numbers of nested figures, each under the words that lead to it."""
    for key, value in figures.items():
        label = f"{prefix} {key}".strip()
        if isinstance(value, Mapping):
            yield from _numbers(value, label)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield label, float(value)


def _length(rows: Vectors) -> Float64[np.ndarray, " n"]:
    length: Float64[np.ndarray, " n"] = np.linalg.norm(rows, axis=1)
    return length
