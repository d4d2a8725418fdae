"""Motion of an IMU in blocks, for the rules about units, axes and frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from imutool.cleaning.rule import CleaningSettings, TopicSummary
from imutool.cleaning.rules.units import Units
from imutool.cleaning.samples import BLOCK, STEP_NS, Motion, Samples
from imutool.cleaning.truth import Truth, truth_of, turning
from imutool.inertial.stationary import StationarySettings
from imutool.log_info.pose_imu_rotation import GyroTurns
from imutool.recording import Imu, Recording

STOP_STEPS, MIN_STOPS = 50, 4  # of 0.1 s in a piece that may be a stop; pieces that show a turn
MIN_TURN_RAD_S, SURE = 2e-3, 5.0  # 7 degrees a minute; standard deviations


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


def turns_at_stops(whole: TopicSummary) -> Iterator[str]:
    """Sentence on a steady turn of the true poses where the samples look like a stop."""
    if whole.truth is None or len(whole.truth.t_ns) <= STOP_STEPS or not whole.motion.samples:
        return
    caps, (step, mean) = StationarySettings(), whole.motion.table()
    starts, ends, turn = turning(whole.truth, STOP_STEPS)
    first, last = (np.searchsorted(step * STEP_NS + whole.motion.middle_ns, ns) for ns in (starts, ends))
    found = []
    for k in range(0, len(turn), STOP_STEPS):
        gyro, accel = np.split(mean[first[k] : last[k]] * whole.scale, 2, axis=1)
        scatter = (
            [float(np.sqrt(x.var(axis=0).sum())) for x in (gyro, accel)] if abs(len(gyro) - STOP_STEPS) < 3 else [np.inf] * 2
        )
        if scatter[0] <= caps.gyro_scatter_rad_s and scatter[1] <= caps.accel_scatter_m_s2:
            found.append((gyro.mean(axis=0), turn[k]))
    calmest = min((gyro for gyro, _ in found), key=np.linalg.norm, default=np.zeros(3))
    turns = [rate for gyro, rate in found if np.linalg.norm(gyro - calmest) <= caps.gyro_agreement_rad_s]
    if len(turns) < MIN_STOPS or np.linalg.norm(calmest) > caps.gyro_mean_rad_s:
        return
    size, std = np.linalg.norm(np.mean(turns, axis=0)), np.linalg.norm(np.std(turns, axis=0, ddof=1)) / np.sqrt(len(turns))
    if size > max(MIN_TURN_RAD_S, SURE * std):
        where = "where the samples look like a stop: a bias from stops is off by that"
        yield f"{whole.truth.topic} turns steadily by {size:.2g} rad/s {where}"
