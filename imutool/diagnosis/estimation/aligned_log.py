"""Aligned logs: samples in k columns, their expectation on one clock, and rows of a fit."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from imutool.array_types import Bool, Float64
from imutool.diagnosis.settings import DiagnoseSettings, SplitSettings
from imutool.inertial.wiener import NoiseLeft
from imutool.recording import Poses
from imutool.sensor.effect import Effect, SignalState, Theta
from imutool.sensor.samples import NOTHING, IdealMotion, SensorSamples
from imutool.units import ASCII_UNITS, AXES, COLUMNS

DEFAULT = DiagnoseSettings()
Blocks = tuple[tuple[int, Float64[np.ndarray, "n _"]], ...]
Variables = Mapping[str, tuple[str, Float64[np.ndarray, " n"]]]


class ClockDifference(NamedTuple):
    """How far a simulation's clock is ahead of the recording's, and its deviation (s)."""

    ahead_s: float
    std_s: float


@dataclass(frozen=True, eq=False)
class AlignedLog(ABC):
    """Recorded samples by stamp (s from the log's start), with their forward model.

    `fitted` and `held_out` are rows; rows in neither are borders, gaps and ends. `known` marks samples that measure their axis
    (none: all): those of a converter at its end and of an axis that is stuck do not. Above `band_hz` the expectation is wrong
    (none: nowhere). `aligned_s` was added to the stamps where the two clocks share no epoch.
    """

    name: str
    stamp_s: Float64[np.ndarray, " n"]
    real: Float64[np.ndarray, "n k"]
    fitted: Bool[np.ndarray, " n"]
    held_out: Bool[np.ndarray, " n"]
    ideal: Any = field(kw_only=True)  # signals of a sensor without effects, with a method `sample`
    known: Bool[np.ndarray, "n k"] | None = field(default=None, kw_only=True)
    band_hz: float | None = field(default=None, kw_only=True)
    aligned_s: float = field(default=0.0, kw_only=True)
    start_ns: int = field(default=0, kw_only=True)
    noise_left: NoiseLeft | None = field(default=None, kw_only=True)
    settings: DiagnoseSettings = field(default=DEFAULT, kw_only=True, repr=False)

    @property
    @abstractmethod
    def bias_std(self) -> Float64[np.ndarray, " k"]:
        """Standard deviation of the prior of a constant bias, by column."""

    @property
    @abstractmethod
    def exact(self) -> bool:
        """Whether the expectation is a simulation, which errs by white noise alone, and not poses."""

    @property
    @abstractmethod
    def denoised(self) -> bool:
        """Whether the expectation had noise of its own, which was filtered out."""

    @abstractmethod
    def blocks(self, samples: Any) -> Blocks:
        """Sampled signals by sensor: first column, and the columns.

        An effect leaves the arrays of other sensors as they are.
        """

    @abstractmethod
    def recorded(self) -> tuple[Any, Any]:
        """Ideal signals, and the recorded samples in the form that effects take."""

    @property
    @abstractmethod
    def signals(self) -> Mapping[str, slice]:
        """Columns by the name of the signal."""

    @abstractmethod
    def unit_of(self, signal: str) -> str:
        """Unit of a signal, as JSON holds it."""

    @abstractmethod
    def variables(self) -> Variables:
        """Variables of a regime at the samples, with their units."""

    @property
    def usable(self) -> Bool[np.ndarray, "n k"]:
        """Samples that count, fitted or held out."""
        rows = (self.fitted | self.held_out)[:, None]
        return np.asarray(np.broadcast_to(rows, self.real.shape) if self.known is None else rows & self.known)

    @property
    def axes(self) -> Bool[np.ndarray, " k"]:
        """Columns of which any sample is known."""
        return np.ones(self.columns, bool) if self.known is None else np.asarray(self.known.any(axis=0))

    @property
    def columns(self) -> int:
        """Number of columns k."""
        return int(self.real.shape[1])

    @property
    def period_s(self) -> float:
        """Median time between recorded samples."""
        return float(np.median(np.diff(self.stamp_s)))

    @property
    def log_start_ns(self) -> int:
        """Stamp of the log's first sample, from which `stamp_s` counts."""
        return self.start_ns - round(float(self.stamp_s[0]) * 1e9)

    def state(self) -> SignalState:
        """Ideal signals before any effect, to be sampled at the log's stamps."""
        return SignalState(self.ideal, self.stamp_s, self.stamp_s)

    def starts(self, effect: Effect) -> list[Theta]:
        """Parameters to start a fit of an effect from."""
        if effect.starts is None:
            return [effect.null_value.astype(float)]
        return [np.asarray(start, dtype=float) for start in effect.starts(*self.recorded())]

    def alternatives(self, effect: Effect) -> int:
        """Number of choices of which the effect's starts are the best."""
        return 0 if effect.alternatives is None else effect.alternatives(self.recorded()[1])


@dataclass(frozen=True, eq=False)
class Pair(AlignedLog):
    """Aligned IMU samples (rad/s, m/s²) with the `ideal` motion on an even clock.

    `sim_noise` was filtered out of a simulation's samples but for `noise_left` (zero where its poses replace them), `truth` are
    the true poses at the stamps, and `poses_hz` is the rate at which they were recorded. `batched_s` is the deviation of the
    log's stamps from `stamp_s`, if they came in batches. `sim_lsb` are the digits of the simulation (zero: none).
    """

    ideal: IdealMotion = field(kw_only=True)
    truth: Poses | None = field(default=None, kw_only=True)
    poses_hz: float = field(default=0.0, kw_only=True)
    batched_s: float = field(default=0.0, kw_only=True)
    sim_noise: Float64[np.ndarray, "6"] = field(default_factory=lambda: np.zeros(6), kw_only=True)
    sim_lsb: Float64[np.ndarray, "6"] = field(default_factory=lambda: np.zeros(6), kw_only=True)
    channels: Mapping[str, Float64[np.ndarray, " n"]] = field(default_factory=lambda: NOTHING, kw_only=True)

    @cached_property
    def bias_std(self) -> Float64[np.ndarray, " k"]:
        """Prior of a turn-on bias, by axis (rad/s, m/s²)."""
        own = self.settings.split
        return np.array([own.gyro_bias_std] * 3 + [own.accel_bias_std] * 3)

    @property
    def exact(self) -> bool:
        """Whether the expectation is a simulation along other poses than the recording's own."""
        return self.band_hz is None

    @property
    def denoised(self) -> bool:
        """Whether the simulation's samples were filtered."""
        return bool(self.sim_noise.any())

    def blocks(self, samples: SensorSamples) -> Blocks:
        """Gyro, then accelerometer."""
        return (0, samples.gyro), (3, samples.accel)

    @property
    def signals(self) -> Mapping[str, slice]:
        """Gyro and accelerometer."""
        return COLUMNS

    def unit_of(self, signal: str) -> str:
        """rad/s or m/s^2."""
        return ASCII_UNITS[signal]

    def variables(self) -> Variables:
        """Rates, forces, time, tilt and the channels of the log."""
        read = self.ideal.sample(self.stamp_s, self.stamp_s)
        rate, force = np.linalg.norm(read.gyro, axis=1), np.linalg.norm(read.accel, axis=1)
        out = {
            "angular rate": ("rad/s", rate),
            "acceleration": ("m/s²", np.abs(force - 9.81)),
            "angular acceleration": ("rad/s²", np.linalg.norm(read.alpha, axis=1)),
            "time": ("s", self.stamp_s),
        }
        if read.at.R_wb is not None:
            out["tilt"] = ("rad", np.arccos(np.clip(read.at.R_wb[:, 2, 2], -1.0, 1.0)))
        for k, axis in enumerate(AXES):
            out[f"rate about {axis}"] = ("rad/s", np.abs(read.gyro[:, k]))
            out[f"force along {axis}"] = ("m/s²", np.abs(read.accel[:, k]))
        return out | {name: ("", values) for name, values in self.channels.items()}

    def recorded(self) -> tuple[IdealMotion, SensorSamples]:
        """The ideal motion and the recorded samples; angular acceleration is not recorded."""
        gyro, accel = self.real[:, :3], self.real[:, 3:]
        at = IdealMotion(self.stamp_s, gyro, accel, np.zeros_like(gyro))
        return self.ideal, SensorSamples(self.stamp_s, gyro, accel, at)


def split(
    stamp_s: Float64[np.ndarray, " n"], settings: SplitSettings = DEFAULT.split
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Held-out rows; and usable ones, away from gaps and from borders of held-out blocks."""
    each, margin_s = settings.held_out_each, settings.margin_s
    since = stamp_s - stamp_s[0]
    block_s = max(settings.block_s, settings.block_samples * float(np.median(np.diff(stamp_s))))
    block_s = min(block_s, since[-1] / (2 * each))
    block = np.floor(since / block_s).astype(int)
    held_out = block % each == each - 1
    inside = since - block * block_s
    changed_before = held_out != ((block - 1) % each == each - 1)
    changes_after = held_out != ((block + 1) % each == each - 1)
    usable = ~(((inside < margin_s) & changed_before & (block > 0)) | ((inside > block_s - margin_s) & changes_after))
    usable &= (since > margin_s) & (since < since[-1] - margin_s)
    step = np.diff(stamp_s)
    for k in np.flatnonzero(step > settings.gap_periods * np.median(step)):
        usable &= (stamp_s < stamp_s[k] - margin_s) | (stamp_s > stamp_s[k + 1] + margin_s)
    return held_out, usable
