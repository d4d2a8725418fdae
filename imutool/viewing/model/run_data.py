"""Everything a picture of a log shows, computed once, free of any viewer; Rerun, the report and tests read this."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from imutool.errors import ConfigError, DataError
from imutool.inertial.metrics import evaluate
from imutool.inertial.strapdown import StartPose, dead_reckon, stretch_with_truth, with_velocity
from imutool.recording import GAP_FACTOR, MIN_GAP_S, Imu, Poses, Recording, Scalars, Times, nanoseconds, seconds
from imutool.viewing.model.decimate import MOST
from imutool.viewing.model.events import Event, gathered, of_stops, of_worst
from imutool.viewing.model.spectra import Spectrum, spectra
from imutool.viewing.model.trajectory_error import Alignment, Drift, Errors, Window, aligned, drift_since_reset, errors, windows

RAW = "raw"
TRUTH = "truth"  # its place in the pictures; no run may take it
LEVELLING_S = 0.5  # without truth the first half second of specific force says where up is
TRUE_BIAS = {"gyro": "/ground_truth/bias/gyro", "accel": "/ground_truth/bias/accel"}


@dataclass(frozen=True, eq=False)
class Run:
    """One way of reading the IMU: `raw`, or a model's name, with what it subtracted (zeros for raw).

    `bias_std` is one standard deviation of what was subtracted, gyro (rad/s) then accel (m/s²), where the model states it.
    """

    name: str
    imu: Imu
    gyro_bias: Float64[np.ndarray, "n 3"]
    accel_bias: Float64[np.ndarray, "n 3"]
    bias_std: Float64[np.ndarray, "n 6"] | None = None

    def __post_init__(self) -> None:
        for name in ("gyro_bias", "accel_bias", "bias_std"):
            value = getattr(self, name)
            if value is not None and (rows := len(value)) != len(self.imu):
                raise DataError(f"{name} has {rows} rows", where=self.name, expected=f"{len(self.imu)}, as the IMU")

    @classmethod
    def raw(cls, imu: Imu) -> Run:
        """The IMU as recorded."""
        nothing = np.zeros_like(imu.gyro)
        return cls(RAW, imu, nothing, nothing)


@dataclass(frozen=True, eq=False)
class Trace:
    """A run and what follows from it: the dead-reckoned path, its errors and its figures (without truth: none of these).

    `path` and `errors` are after the log's `alignment`; `drift`, `windows` and `figures` know none.
    """

    run: Run
    path: Poses
    errors: Errors | None
    drift: Drift | None = None  # each reset to the truth
    windows: tuple[Window, ...] = ()  # how far windows of 1, 5, 10 and 30 s drift
    figures: Mapping[str, Any] = field(default_factory=dict)
    spectra: Mapping[str, Spectrum] = field(default_factory=dict)  # `gyro` and `accel`, of the samples

    @property
    def name(self) -> str:
        """The run's name."""
        return self.run.name

    @property
    def is_raw(self) -> bool:
        """Whether this is the IMU as recorded."""
        return self.run.name == RAW


@dataclass(frozen=True, eq=False)
class Logged:
    """Header stamps (strictly increasing) and the log time of the same messages, in ns."""

    stamp_ns: Times
    log_ns: Times

    def at(self, t_ns: Times) -> Times:
        """Log times at stamps: exact where a message has that stamp, in between and beyond with the nearest message's delay."""
        right = np.clip(np.searchsorted(self.stamp_ns, t_ns), 0, len(self.stamp_ns) - 1)
        left = np.maximum(right - 1, 0)
        nearer = np.where(t_ns - self.stamp_ns[left] < self.stamp_ns[right] - t_ns, left, right)
        times: Times = t_ns + (self.log_ns - self.stamp_ns)[nearer]
        return times


@dataclass(frozen=True, eq=False)
class RunData:
    """A log, ready to be looked at: `traces` in the order of the runs, elapsed time counted from `start_ns`.

    `true_bias` holds `gyro` (rad/s) and `accel` (m/s²) where the log knows them; `notes` are sentences for the reader;
    `provenance` says in words what this was made from: file, size, model, its digest, start, version.
    `logged` pairs header stamps with the times at which the log says they were written; none where there is no log.
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
    logged: Logged | None = None

    @property
    def duration_s(self) -> float:
        """From the first IMU sample to the last."""
        return (self.end_ns - self.start_ns) * 1e-9

    def elapsed_s(self, t_ns: Times) -> Float64[np.ndarray, " n"]:
        """Seconds since the first IMU sample."""
        return seconds(t_ns, self.start_ns)

    def log_ns(self, t_ns: Times) -> Times:
        """The log times that belong to header stamps; the stamps themselves where no log is known."""
        return t_ns if self.logged is None else self.logged.at(t_ns)

    def table(self) -> list[tuple[str, list[float | None]]]:
        """The figures as rows: a label (`aoe_deg`, `roe_deg 5`) and one value per trace, `None` where it has none."""
        columns = [dict(_numbers(trace.figures)) for trace in self.traces]
        labels = list(dict.fromkeys(label for column in columns for label in column))
        return [(label, [column.get(label) for column in columns]) for label in labels]

    def models(self) -> tuple[Trace, ...]:
        """The traces that are not raw."""
        return tuple(trace for trace in self.traces if not trace.is_raw)


def build(
    recording: Recording,
    runs: Sequence[Run],
    *,
    align: Alignment = "none",
    events: Sequence[Event] = (),
    notes: Sequence[str] = (),
) -> RunData:
    """What there is to see of a log read in one or several ways, with the events and notes that are known beforehand.

    With truth every path starts at the true pose and velocity of the first sample that has one and ends with the last such
    sample; figures, drift and windows are of that path, errors after the alignment asked for. Without, a path starts at the
    origin, at rest, level by the first half second of its own specific force and with heading zero, and there are no errors.

    Raises:
        ConfigError: no run, or two of one name.
        DataError: IMU and truth share fewer than two samples, or leave the alignment open.
        NumericsError: an integration overflows.
    """
    names = [run.name for run in runs]
    if not names or len(set(names)) < len(names) or TRUTH in names:
        raise ConfigError(f"runs are called {names}", where=recording.name, expected="names of their own, not 'truth'")
    imu = recording.imu
    start_ns, end_ns = int(imu.t_ns[0]), int(imu.t_ns[-1])
    if recording.truths:
        truth = with_velocity(recording.truth)
        traces, of_paths = _scored(runs, truth, recording.name, align)
    else:
        truth, align = None, "none"
        traces = tuple(Trace(run, dead_reckon(run.imu, level_start(run.imu)), None, spectra=spectra(run.imu)) for run in runs)
        of_paths = [
            f"This log has no truth, so there are no errors and nothing to align with. Paths start at the origin, at rest, "
            f"heading 0, levelled by the first {LEVELLING_S:g} s of specific force."
        ]
    judged = [trace for trace in traces if not trace.is_raw] or traces
    worst = [one for trace in judged if trace.errors is not None for one in of_worst(trace.name, trace.errors)]
    shown, of_events = gathered([*events, *of_stops(imu), *worst], start_ns, end_ns)
    return RunData(
        name=recording.name,
        start_ns=start_ns,
        end_ns=end_ns,
        truth=None if truth is None else truth.between(start_ns, end_ns),
        true_bias=_true_bias(recording),
        traces=traces,
        notes=(*of_paths, *_thinned(imu), *notes, *of_events),
        alignment=align,
        events=shown,
    )


def level_start(imu: Imu) -> StartPose:
    """The start at the origin, at rest, heading zero, with roll and pitch that make the first specific force point up.

    roll = atan2(f_y, f_z), pitch = atan2(-f_x, hypot(f_y, f_z)): exact if the IMU does not accelerate in that time.
    """
    first = imu.between(int(imu.t_ns[0]), int(imu.t_ns[0]) + nanoseconds(LEVELLING_S))
    f_x, f_y, f_z = first.accel.mean(axis=0)
    level = Rotation.from_euler("ZYX", [0.0, np.arctan2(-f_x, np.hypot(f_y, f_z)), np.arctan2(f_y, f_z)])
    return StartPose(level.as_quat(scalar_first=True), np.zeros(3), np.zeros(3))


def stretches(poses: Poses) -> list[Poses]:
    """The poses cut at their gaps (as `Poses.at` knows them), so that nobody draws a line across one."""
    if len(poses) < 2:
        return [poses]
    gap_ns = nanoseconds(max(GAP_FACTOR * poses.period_s, MIN_GAP_S))
    edges = [0, *(np.flatnonzero(np.diff(poses.t_ns) > gap_ns) + 1).tolist(), len(poses)]
    return [poses.rows(slice(first, last)) for first, last in pairwise(edges)]


def _true_bias(recording: Recording) -> Mapping[str, Scalars]:
    """The true biases that the log knows, while the IMU runs."""
    imu = recording.imu
    known = {kind: recording.scalars[topic] for kind, topic in TRUE_BIAS.items() if topic in recording.scalars}
    return MappingProxyType({kind: b.between(int(imu.t_ns[0]), int(imu.t_ns[-1])) for kind, b in known.items()})


def _scored(runs: Sequence[Run], truth: Poses, where: str, align: Alignment) -> tuple[tuple[Trace, ...], list[str]]:
    """Each run from the first sample with truth to the last, with its errors and figures; and what is to be said of that."""
    known: list[Known] = []
    for k, run in enumerate(runs):
        alike = k > 0 and np.array_equal(run.imu.t_ns, runs[k - 1].imu.t_ns)
        known.append(known[-1] if alike else Known(*stretch_with_truth(run.imu.t_ns, truth, where)))
    with ThreadPoolExecutor() as pool:  # nearly all of it is numpy's, which lets other threads work
        scored = list(pool.map(partial(_score, align=align), runs, known))
    traces, motions = tuple(trace for trace, _ in scored), [motion for _, motion in scored if motion]
    started = seconds(traces[0].path.t_ns[:1], int(runs[0].imu.t_ns[0]))[0]
    how = "errors are without alignment" if align == "none" else f"paths and errors are shown after alignment {align}"
    return traces, [
        f"Paths start at the true pose, {started:.2f} s into the log; {how}.",
        *(["The figures, drift and windows are without alignment."] if motions else []),
        *motions,
    ]


class Known(NamedTuple):
    """Where the truth is known: rows of the IMU, the true poses at them, and a mask of those between which there is no gap."""

    rows: slice
    true: Poses
    valid: Bool[np.ndarray, " n"]


def _score(run: Run, known: Known, align: Alignment) -> tuple[Trace, str]:
    """One run, and how it was aligned (nothing where it was not)."""
    rows, true, valid = known
    path = dead_reckon(run.imu.rows(rows), StartPose.of(true))
    moved, motion = aligned(path, true, valid, align)
    of_truth = (
        drift_since_reset(path, true, valid),
        windows(path, true, valid),
        MappingProxyType(evaluate(path, true, valid)),
    )
    trace = Trace(run, moved, errors(moved, true, valid), *of_truth, spectra=spectra(run.imu))
    if align == "none":
        return trace, ""
    away_m = np.linalg.norm(moved.p_wb[valid].mean(axis=0) - path.p_wb[valid].mean(axis=0))
    turned = np.rad2deg(motion.turn.magnitude())
    return trace, f"{run.name}: alignment {align} turned the path by {turned:.3g} deg, its centre moved {away_m:.3g} m."


def _thinned(imu: Imu) -> list[str]:
    """What is to be said of a log too long to be drawn whole."""
    if len(imu) <= MOST:
        return []
    return [f"Of curves with {len(imu)} samples at most {MOST} are drawn, the lowest and highest of every stretch among them."]


def _numbers(figures: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    """The numbers of nested figures, each under the words that lead to it."""
    for key, value in figures.items():
        label = f"{prefix} {key}".strip()
        if isinstance(value, Mapping):
            yield from _numbers(value, label)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield label, float(value)
