"""Samples that a sensor took, without those that its driver repeats, on its own clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from imutool.array_types import Bool, Float64, Rows6
from imutool.cleaning.stamp_line import batch_words, read_stamps, restamped
from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.timestamps import JITTER, even, uneven
from imutool.diagnosis.result import Finding
from imutool.diagnosis.settings import TimestampSettings
from imutool.inertial.stationary import white_noise
from imutool.recording import Recording, seconds
from imutool.recording.columns import true_ranges

SELDOM = 0.1  # of the samples of an axis that are equal to the one before: digits are finer than the noise
MOSTLY_NEW = 0.3  # of the samples that repeat the one before: more is a topic that is faster than its sensor
MIN_NEW = 0.05  # of the samples with news of both sensors: two that take turns have none
STRAIGHT = 1e-3  # of the median change of the slope, up to which three samples are on a line: float32 rounds far less
STUCK = 10  # samples in a row that a sensor stands still, and is not held
MOSTLY_COMMON, OWN_NOISE = 0.5, 0.1  # of the stamps of a simulation; of the noise, that two logs of one sample differ by


def new_samples(recording: Recording) -> Recording:
    """Recording without readings that are held, where a topic is faster than its sensor.

    Half of the samples of a gyro at half of the rate are late by a sample, and look like a low-pass.
    """
    repeated = np.zeros(len(recording.imu), bool)
    for sensor in (recording.imu.gyro, recording.imu.accel):
        equal = np.concatenate([np.zeros((1, 3), bool), np.diff(sensor, axis=0) == 0])[: len(sensor)]
        equal_rows = np.asarray(equal.all(axis=1))
        for start, end in true_ranges(equal_rows):
            equal_rows[start:end] = end - start < STUCK
        if equal_rows.any() and equal_rows.mean() >= MOSTLY_NEW and equal[~equal_rows].mean(axis=0).max() < SELDOM:
            repeated |= equal_rows
    if not repeated.any() or (~repeated).mean() < MIN_NEW:
        return recording
    return replace(recording, imu=recording.imu.rows(~repeated))


def repeats(real: Rows6) -> Bool[np.ndarray, " n"]:
    """Samples that repeat the one before on every axis.

    The axes seldom read the same twice otherwise. A driver that missed a sample may send the last one again. Digits that are
    coarser than the noise repeat by themselves.
    """
    equal = np.concatenate([np.zeros((1, 6), bool), np.diff(real, axis=0) == 0])[: len(real)]
    repeated = equal.all(axis=1)
    by_chance = equal[~repeated].mean(axis=0) if (~repeated).any() else np.ones(6)
    return np.asarray(repeated & bool(by_chance.max() < SELDOM and repeated.mean() < MOSTLY_NEW))


def filled(stamp_s: Float64[np.ndarray, " n"], real: Rows6) -> Bool[np.ndarray, " n"]:
    """Samples on a line between their neighbours on every axis, as where a gap was filled.

    It cuts the peaks of a motion, which looks like a scale. No axis lies on a line elsewhere, unless its digits are coarse.
    """
    found = np.zeros(len(real), bool)
    if len(real) < 3:
        return found
    slope = np.diff(real, axis=0) / np.diff(stamp_s)[:, None]
    bend = np.abs(np.diff(slope, axis=0))
    straight = bend <= STRAIGHT * np.median(bend, axis=0)
    found[1:-1] = straight.all(axis=1)
    by_chance = straight[~found[1:-1]].mean(axis=0) if not found[1:-1].all() else np.ones(6)
    return found & bool(by_chance.max() < SELDOM and found.mean() < MOSTLY_NEW)


def on_own_clock(recording: Recording) -> tuple[Recording, float]:
    """Recording on its sensor's clock if its stamps came in batches, and their deviation (s).

    Most steps between stamps of a driver that reads batches are far shorter than the sensor's period.
    """
    t_ns = recording.imu.t_ns
    if read_stamps(t_ns).batch <= 1.0:
        return recording, 0.0
    own_ns = restamped(t_ns)
    return replace(recording, imu=replace(recording.imu, t_ns=own_ns)), float((t_ns - own_ns).std()) * 1e-9


def without_common_jitter(real: Recording, sim: Recording, settings: TimestampSettings) -> tuple[Recording, Recording]:
    """Both on an even clock, if the simulation was made of the recording's own samples.

    Then it has its stamps and its noise. What wanders in both alike sets neither apart, and no spline has to pass through noise
    between two stamps.
    """
    t_ns, *rows = np.intersect1d(real.imu.t_ns, sim.imu.t_ns, return_indices=True)
    if len(t_ns) <= MOSTLY_COMMON * len(sim.imu):
        return real, sim
    read, simulated = (
        np.concatenate([imu.gyro, imu.accel], axis=1)[row] for imu, row in zip((real.imu, sim.imu), rows, strict=True)
    )
    if not (white_noise(read - simulated) < OWN_NOISE * white_noise(read)).any():
        return real, sim
    since_s, start_ns = seconds(t_ns, int(t_ns[0])), int(t_ns[0])
    late_s = since_s - even(since_s, settings)[0]
    imus = [
        replace(imu, t_ns=imu.t_ns - np.round(1e9 * np.interp(seconds(imu.t_ns, start_ns), since_s, late_s)).astype(np.int64))
        for imu in (real.imu, sim.imu)
    ]
    return replace(real, imu=imus[0]), replace(sim, imu=imus[1])


def batched(pairs: Sequence[Pair], others: Sequence[Finding]) -> list[Finding]:
    """Finding of stamps that came in batches, if none of the others says that they jitter."""
    late_s = max(pair.batched_s for pair in pairs)
    if not late_s or any(finding.effect == JITTER for finding in others):
        return []
    return [uneven(pairs, late_s, "stamps come in batches, samples do not")]


def batch_remark(recording: Recording) -> list[str]:
    """Remark on stamps in batches."""
    size = read_stamps(recording.imu.t_ns).batch
    words = f"{recording.name}: {batch_words(size)}. The diagnosis is of samples on the sensor's clock, a line under the stamps"
    return [words] if size > 1.0 else []
