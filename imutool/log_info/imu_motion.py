"""Motion of an IMU in blocks, for the rules about units, axes and frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from imutool.cleaning.rule import CleaningSettings, TopicSummary
from imutool.cleaning.rules.units import Units
from imutool.cleaning.samples import BLOCK, Motion, Samples
from imutool.cleaning.truth import Truth, truth_of
from imutool.log_info.pose_imu_rotation import GyroTurns
from imutool.recording import Imu, Recording


class ImuMotion:
    """Means, extremes and turns of samples; `turns` are those between the poses of a topic."""

    def __init__(self, period_ns: float, poses: Mapping[str, Truth | None]) -> None:
        """`period_ns` is the median step between the samples."""
        self.motion = Motion()
        self.turns = {name: GyroTurns(known, period_ns) for name, known in poses.items() if known is not None}
        self._minimum, self._maximum = np.full(6, np.inf), np.full(6, -np.inf)

    def see(self, samples: Samples) -> None:
        """Add the next samples, in order of time."""
        self.motion.see(samples)
        for turns in self.turns.values():
            turns.see(samples.stamp_ns, samples.values[:, :3])
        self._minimum = np.minimum(self._minimum, samples.values.min(axis=0, initial=np.inf))
        self._maximum = np.maximum(self._maximum, samples.values.max(axis=0, initial=-np.inf))

    def summary(self, truth: Truth | None) -> TopicSummary:
        """Totals for the rules about conventions; nothing is converted."""
        return TopicSummary(CleaningSettings(convert_units=False), self.motion.samples, self.motion, truth)

    def constant_sensors(self) -> list[str]:
        """Warnings of a gyro or an accelerometer that never changes: a measurement has noise."""
        count, why = self.motion.samples, "no sensor is behind it, or a simulation at rest without noise"
        axes = {"gyro": slice(3), "accel": slice(3, 6)} if count > 1 else {}
        changes = self._maximum > self._minimum
        still = {name: self._minimum[s] + 0.0 for name, s in axes.items() if not changes[s].any()}  # no -0.0
        return [f"{name} reads {value.tolist()} in {count} samples in a row: {why}" for name, value in still.items()]


def motion_of(imu: Imu, truth: Truth | None = None) -> ImuMotion:
    """Motion of samples in memory, with their turns between poses."""
    found = ImuMotion(imu.period_s * 1e9 if len(imu) > 1 else 0.0, {} if truth is None else {truth.topic: truth})
    for samples in blocks_of(imu):
        found.see(samples)
    return found


def blocks_of(imu: Imu) -> Iterator[Samples]:
    """Samples in memory in blocks."""
    for first in range(0, len(imu), BLOCK):
        s = slice(first, first + BLOCK)
        t_ns, values = imu.t_ns[s], np.concatenate([imu.gyro[s], imu.accel[s]], axis=1)
        yield Samples(first + np.arange(len(t_ns)), t_ns, t_ns, values)


def in_si_units(recording: Recording) -> tuple[Recording, list[str]]:
    """Recording in rad/s and m/s², and sentences on units that were converted or are in doubt."""
    imu = recording.imu
    whole = replace(motion_of(imu).summary(truth_of(recording)), settings=CleaningSettings())
    found = [finding for finding in Units().findings(whole) if finding.severity != "note"]
    texts = [finding.what + (", converted" if finding.action == "converted" else "") for finding in found]
    if (whole.scale == 1.0).all():
        return recording, texts
    return replace(recording, imu=Imu(imu.t_ns, imu.gyro * whole.scale[:3], imu.accel * whole.scale[3:])), texts
