"""Data of a view: runs, traces with errors and spectra, events; decimated for drawing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import welch
from scipy.spatial.transform import Rotation

from imutool.array_types import Float64, Int64
from imutool.bias_start.aided_path import aided_path
from imutool.bias_start.prior_width import BiasPrior
from imutool.errors import DataError
from imutool.inertial.aids import Aids
from imutool.inertial.strapdown import StartPose, dead_reckon
from imutool.recording import GAP_FACTOR, MIN_GAP_S, Imu, Poses, Scalars, Times, nanoseconds, seconds
from imutool.recording.columns import quantile
from imutool.viewing.model.events import Event
from imutool.viewing.model.trajectory_error import Alignment, Drift, Errors, Window

RAW = "raw"
IN_LOG = "in the log: "  # before the name of the model whose samples a log holds
TRUTH = "truth"  # label of the truth; no run may have this name
LEVELLING_S = 0.5  # without truth, the mean specific force of this time gives the vertical
HIDDEN_FIGURES = ("aoe_aligned_deg",)  # aligned positions say nothing about the attitude of a path that drifts by metres
TRUE_BIAS = {"gyro": "/ground_truth/bias/gyro", "accel": "/ground_truth/bias/accel"}


@dataclass(frozen=True, eq=False)
class Run:
    """IMU samples, raw or corrected by a model, with the subtracted bias (zeros for raw).

    `path_from` gives the path of samples from a start pose: pure integration, or a smoothed path with aids.
    `bias_std` is one standard deviation of the bias, gyro (rad/s) then accel (m/s²), where the model states it. `start` is the
    method of the initial bias (`init`), where it is known.
    """

    name: str
    imu: Imu
    gyro_bias: Float64[np.ndarray, "n 3"]
    accel_bias: Float64[np.ndarray, "n 3"]
    bias_std: Float64[np.ndarray, "n 6"] | None = None
    start: str = ""
    path_from: Callable[[Imu, StartPose], Poses] = dead_reckon

    def __post_init__(self) -> None:
        for name in ("gyro_bias", "accel_bias", "bias_std"):
            value = getattr(self, name)
            if value is not None and (rows := len(value)) != len(self.imu):
                raise DataError(f"{name} has {rows} rows", where=self.name, expected=f"{len(self.imu)}, as the IMU")

    @classmethod
    def raw(cls, imu: Imu) -> Run:
        """Run of the IMU as recorded."""
        zeros = np.zeros(imu.gyro.shape)  # without memory until one is changed
        return cls(RAW, imu, zeros, zeros)

    @property
    def is_aided(self) -> bool:
        """Whether the path is smoothed with aids; the samples are those of another run."""
        return self.path_from is not dead_reckon

    def between(self, first_ns: int, last_ns: int) -> Run:
        """Run of the samples from one stamp to another."""
        first, last = np.searchsorted(self.imu.t_ns, [first_ns, last_ns + 1])
        rows = slice(int(first), int(last))
        std = None if self.bias_std is None else self.bias_std[rows]
        return replace(
            self, imu=self.imu.rows(rows), gyro_bias=self.gyro_bias[rows], accel_bias=self.accel_bias[rows], bias_std=std
        )

    def aided(self, aids: Aids, prior: BiasPrior) -> Run:
        """The same samples, with a smoothed path by the aids of the log; `prior` is that of the bias that is left."""
        return replace(self, name=f"{self.name} aided", path_from=partial(aided_path, prior=prior, aids=aids))


@dataclass(frozen=True, eq=False)
class Trace:
    """Run with its dead-reckoned path, errors and figures (no errors or figures without truth).

    `path` and `errors` are after the log's `alignment`; `drift`, `windows` and `figures` are without alignment.
    """

    run: Run
    path: Poses
    errors: Errors | None
    drift: Drift | None = None  # since each reset to the truth
    windows: tuple[Window, ...] = ()  # drift over windows of 1, 5, 10 and 30 s
    figures: Mapping[str, Any] = field(default_factory=dict)
    spectra: Mapping[str, Spectrum] = field(default_factory=dict)  # of the samples, for `gyro` and `accel`

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.run.name

    @property
    def is_raw(self) -> bool:
        """Whether the run is the IMU as recorded."""
        return self.run.name == RAW


@dataclass(frozen=True, eq=False)
class LogTimes:
    """Header stamps (strictly increasing) and the log time of the same messages, in ns."""

    stamp_ns: Times
    log_ns: Times

    def at(self, t_ns: Times) -> Times:
        """Log times at header stamps: exact at a message's, elsewhere with the nearest one's delay."""
        right = np.clip(np.searchsorted(self.stamp_ns, t_ns), 0, len(self.stamp_ns) - 1)
        left = np.maximum(right - 1, 0)
        nearer = np.where(t_ns - self.stamp_ns[left] < self.stamp_ns[right] - t_ns, left, right)
        times: Times = t_ns + (self.log_ns - self.stamp_ns)[nearer]
        return times


@dataclass(frozen=True, eq=False, repr=False)
class RunData:
    """Data of one log for viewing: traces in the order of the runs, events, provenance.

    `true_bias` holds `gyro` (rad/s) and `accel` (m/s²) where the log has them; `notes` are sentences for the reader;
    `provenance` names file, size, models with digest and start, and versions.
    `logged` pairs header stamps with log times; None without a log.
    """

    name: str
    start_ns: int
    end_ns: int
    truth: Poses | None
    true_bias: Mapping[str, Scalars]
    traces: tuple[Trace, ...]
    notes: tuple[str, ...]
    alignment: Alignment = "none"
    events: tuple[Event, ...] = ()
    provenance: Mapping[str, str] = field(default_factory=dict)
    source: Path | None = None
    logged: LogTimes | None = None

    def __repr__(self) -> str:
        return f"RunData({self.name!r}: {', '.join(trace.name for trace in self.traces)}; {self.duration_s:.3f} s)"

    @property
    def duration_s(self) -> float:
        """Time from the first IMU sample to the last."""
        return (self.end_ns - self.start_ns) * 1e-9

    def elapsed_s(self, t_ns: Times) -> Float64[np.ndarray, " n"]:
        """Seconds since the first IMU sample."""
        return seconds(t_ns, self.start_ns)

    def log_ns(self, t_ns: Times) -> Times:
        """Log times of header stamps; the stamps themselves without a log."""
        return t_ns if self.logged is None else self.logged.at(t_ns)

    def table(self) -> list[tuple[str, list[float | None]]]:
        """Figures as rows: a label (`aoe_deg`, `roe_deg 5`) and one value or None per trace."""
        columns = [dict(_numbers(trace.figures)) for trace in self.traces]
        labels = dict.fromkeys(label for column in columns for label in column if label not in HIDDEN_FIGURES)
        return [(label, [column.get(label) for column in columns]) for label in labels]

    def models(self) -> tuple[Trace, ...]:
        """Traces of models."""
        return tuple(trace for trace in self.traces if not trace.is_raw)

    def integrated(self) -> RunData:
        """The same without aided paths, which have no samples or biases of their own; they come last."""
        return replace(self, traces=tuple(trace for trace in self.traces if not trace.run.is_aided))


def level_start(imu: Imu) -> StartPose:
    """Start at the origin, at rest, heading zero, levelled by the first specific force.

    roll = atan2(f_y, f_z), pitch = atan2(-f_x, hypot(f_y, f_z)): exact if the IMU does not accelerate in that time.
    """
    f_x, f_y, f_z = imu.between(int(imu.t_ns[0]), int(imu.t_ns[0]) + nanoseconds(LEVELLING_S)).accel.mean(axis=0)
    level = Rotation.from_euler("ZYX", [0.0, np.arctan2(-f_x, np.hypot(f_y, f_z)), np.arctan2(f_y, f_z)])
    return StartPose(level.as_quat(scalar_first=True), np.zeros(3), np.zeros(3))


def gap_rows(t_ns: Times) -> Int64[np.ndarray, " m"]:
    """Rows that follow a gap, as `Poses.at` defines it."""
    if len(t_ns) < 2:
        return np.zeros(0, np.int64)
    step_ns = np.diff(t_ns)
    return np.flatnonzero(step_ns > max(GAP_FACTOR * float(quantile(step_ns, 0.5)), nanoseconds(MIN_GAP_S))) + 1


def split_at_gaps(poses: Poses) -> list[Poses]:
    """Split poses at their gaps, so that no line crosses one."""
    edges = [0, *gap_rows(poses.t_ns).tolist(), len(poses)]
    return [poses.rows(slice(first, last)) for first, last in pairwise(edges)]


def _numbers(figures: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    """Numbers of nested figures, each with its keys joined by spaces."""
    for key, value in figures.items():
        label = f"{prefix} {key}".strip()
        if isinstance(value, Mapping):
            yield from _numbers(value, label)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield label, float(value)


WINDOW_S = 8.0  # longest: resolves 1/8 Hz
MIN_SAMPLES = 64  # samples in a window, below which there is no spectrum


@dataclass(frozen=True, eq=False)
class Spectrum:
    """One-sided density of each axis, in the signal's unit squared per Hz."""

    frequency_hz: Float64[np.ndarray, " k"]
    density: Float64[np.ndarray, "k 3"]


def spectra(imu: Imu) -> Mapping[str, Spectrum]:
    """Power spectral densities of gyro ((rad/s)²/Hz) and accel ((m/s²)²/Hz), by Welch's method.

    Samples count as evenly spaced by their median period, so jitter and gaps blur lines a little.
    """
    if len(imu) < MIN_SAMPLES:
        return {}
    rate_hz = 1.0 / imu.period_s
    length = min(len(imu), max(MIN_SAMPLES, round(WINDOW_S * rate_hz)))
    densities = {}
    for kind, values in (("gyro", imu.gyro), ("accel", imu.accel)):
        along = map(np.ascontiguousarray, values.T)  # one column after the other is twice as fast
        columns = [welch(column, rate_hz, nperseg=length, detrend="constant") for column in along]
        density = np.stack([found for _, found in columns], axis=1)
        densities[kind] = Spectrum(columns[0][0][1:], density[1:])  # without the constant part
    return densities


def round_up_125(highest: float) -> float:
    """Next number of the form 1, 2 or 5 times a power of ten, as the end of a scale."""
    decade = 10.0 ** np.floor(np.log10(highest)) if highest > 0.0 else 1.0
    return float(next(step for step in (1.0, 2.0, 5.0, 10.0) if step * decade >= highest * (1.0 - 1e-9)) * decade)
