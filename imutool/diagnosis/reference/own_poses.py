"""Alignment of a recording with the motion of its own true poses.

A robust curve through poses takes an impact for a glitch: both are fast and rare. The IMU is their witness. A glitch is an
error of a pose, which no sensor reads, but an impact is a motion of the body. So a curve in which all poses count alike is
taken where the samples follow it.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.fft import dct, idct
from scipy.spatial.transform import Rotation

from imutool.array_types import Float64, Rows6, Vectors
from imutool.cleaning.rules.axes import TO_Z_UP
from imutool.cleaning.truth import truth_of
from imutool.diagnosis.audit.spectral_lines import by_differences
from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.jacobians import expected
from imutool.diagnosis.estimation.time_alignment import with_truth
from imutool.diagnosis.settings import DiagnoseSettings, ReferenceSettings
from imutool.errors import DataError
from imutool.geometry import quaternion
from imutool.log_info.convention_report import check_poses
from imutool.log_info.imu_motion import motion_of
from imutool.recording import Poses, Recording
from imutool.sensor.effects.vibration import is_motion
from imutool.sensor.samples import IdealMotion
from imutool.sensor.trajectory import SmoothMotion, Stretch, smooth_motion

CLEAR = 3.0  # deviations of the slope


def align_with_poses(real: Recording, settings: DiagnoseSettings) -> Iterator[Pair]:
    """Stretches of a recording that its true poses cover without a hole.

    Raises:
        DataError: no stretch is long enough, or the poses cannot be differentiated, or their quaternions or unit are misread.
    """
    check_poses(real, world=False, warn=False)
    real = _with_z_up(real)
    motion = smooth_motion(real.truth)
    pairs = list(_pairs(real, motion, settings))
    if motion.glitches:
        plain = list(_pairs(real, smooth_motion(real.truth, robust=False), settings))
        pairs = plain if _is_followed(plain, pairs) else pairs
    if not pairs:
        raise DataError(
            f"the true poses have no stretch of {settings.alignment.min_s:g} s that can be differentiated",
            where=real.name,
            expected="poses at 40 Hz or more, without holes",
            fix="Give a simulation with `sim`",
        )
    yield from pairs


def _with_z_up(real: Recording) -> Recording:
    """Recording with its true poses in a world whose z is up: along another axis gravity would be a misfit of 2 g."""
    truth = truth_of(real)
    up = motion_of(real.imu, truth).summary(truth).conventions.up
    if up not in TO_Z_UP:
        return real
    turn, (topic, poses) = TO_Z_UP[up], next(iter(real.truths.items()))
    q_wb_wxyz = quaternion.multiply(quaternion.of_matrix(turn), poses.q_wb_wxyz)
    turned = Poses(poses.t_ns, poses.p_wb @ turn.T, q_wb_wxyz, None if poses.v_w is None else poses.v_w @ turn.T)
    return replace(real, truths={**real.truths, topic: turned})


def band_hz(stretch: Stretch, settings: ReferenceSettings) -> float:
    """Frequency up to which the motion of a stretch of poses is known."""
    return max(settings.band_share * min(stretch.cutoff_hz), settings.min_band_hz)


def is_in_raw_poses(pair: Pair, line: Rows6, f_hz: float) -> bool:
    """Whether the poses have a spectral line before smoothing, so that it is motion of the body."""
    if pair.truth is None or not pair.truth.has_positions or f_hz > 0.5 * pair.poses_hz:
        return False
    shown, _ = by_differences(pair.truth, np.zeros(3))
    return is_motion(pair.stamp_s[1:-1], shown, line[1:-1], f_hz, pair.settings.search.false_discovery_rate)


def _pairs(real: Recording, motion: SmoothMotion, settings: DiagnoseSettings) -> Iterator[Pair]:
    min_s, started_ns = settings.alignment.min_s, int(real.imu.t_ns[0])
    for ideal in motion.ideal_motions(1.0 / real.imu.period_s):
        # times are told from the log's start, also where its poses begin earlier or later
        since = replace(ideal, t_s=ideal.t_s + (motion.start_ns - started_ns) * 1e-9)
        if min(since.t_s[-1], real.imu.duration_s) - max(since.t_s[0], 0.0) < min_s:
            continue
        middle_s = (ideal.t_s[0] + ideal.t_s[-1]) / 2.0
        stretch = next(part for part in motion.stretches if part.start_s <= middle_s <= part.end_s)
        since = _with_lost_motion(since, stretch.cutoff_hz, settings.reference.band_share)
        pair = with_truth(real, since, band_hz(stretch, settings.reference), settings)
        of_gyro = np.tile(np.arange(6) < 3, (len(pair.stamp_s), 1))  # without positions nothing is known of the accelerometer
        yield pair if real.truth.has_positions else replace(pair, known=of_gyro)


def _is_followed(plain: Sequence[Pair], robust: Sequence[Pair]) -> bool:
    """Whether samples follow plain curves where these leave the robust ones.

    The difference of the samples and the robust curve is regressed on the difference of the curves: an error of a pose has a
    slope of 0, a motion of 1. No sensor may be nearer to 0, and one has to be clearly nearer to 1.
    """
    if not plain or not robust:
        return bool(plain)
    blocks = np.concatenate([_products(*both) for both in product(plain, robust)])
    products, squares = blocks[:, 0], blocks[:, 1]
    total = squares.sum(axis=0)
    slope = products.sum(axis=0) / np.where(total > 0.0, total, 1.0)
    std = np.sqrt(((products - slope * squares) ** 2).sum(axis=0)) / np.where(total > 0.0, total, 1.0)
    nearer = ((slope - 0.5) / np.maximum(std, np.finfo(np.float64).tiny))[total > 0.0]
    return bool(len(nearer) and nearer.min() > 0.0 and nearer.max() > CLEAR)


def _products(plain: Pair, robust: Pair) -> Float64[np.ndarray, "b 2 2"]:
    """Products of the rest with the difference of the curves, and its squares, by block of time and sensor."""
    t_s, plain_rows, robust_rows = np.intersect1d(plain.stamp_s, robust.stamp_s, return_indices=True)
    if not len(t_s):
        return np.zeros((0, 2, 2))
    motion = expected(robust, ())[robust_rows]
    differs, rest = (expected(plain, ())[plain_rows] - motion) * robust.axes, robust.real[robust_rows] - motion
    rest = rest - np.median(rest, axis=0)
    block = ((t_s - t_s[0]) / robust.settings.search.held_out_block_s).astype(int)
    each = [[(x[:, part] * differs[:, part]).sum(axis=1) for part in robust.signals.values()] for x in (rest, differs)]
    return np.moveaxis(np.array([[np.bincount(block, weights=column) for column in columns] for columns in each]), 2, 0)


def _with_lost_motion(ideal: IdealMotion, cutoffs_hz: tuple[float, float], share: float) -> IdealMotion:
    """Motion with what the splines through its poses took of it, up to a share of each cut-off.

    A spline with a penalty on its third derivative leaves 1 / (1 + (f / cutoff)^6) of a motion (position, rotation), in the
    axes of the world. Uncorrected, the edge of the band shows it as a smoothing of the poses, or as a scale.
    """
    R_wb, n = ideal.R_wb, len(ideal.t_s)
    assert R_wb is not None, "poses have an attitude"
    to_world = functools.partial(np.einsum, "nij,nj->ni", R_wb)
    f_hz = np.arange(n)[:, None] * ideal.rate_hz / (2.0 * n)
    of_position, of_rotation = (np.minimum(f_hz / hz, share) ** 6 for hz in cutoffs_hz)

    def lost(x: Vectors, part: Float64[np.ndarray, "n 1"]) -> Vectors:
        return np.asarray(idct(dct(x, axis=0) * part, axis=0))

    force, turn = to_world(ideal.accel), lost(to_world(ideal.gyro), of_rotation)
    angle = np.cumsum(turn, axis=0) / ideal.rate_hz
    back = Rotation.from_rotvec(angle - angle.mean(axis=0)) * Rotation.from_matrix(R_wb)
    force = force + lost(force, of_position)
    alpha = to_world(ideal.alpha)
    gyro, accel, alpha = (back.inv().apply(x) for x in (to_world(ideal.gyro) + turn, force, alpha + lost(alpha, of_rotation)))
    return replace(ideal, gyro=gyro, accel=accel, alpha=alpha, R_wb=back.as_matrix())
