"""Impacts are motion of the body, and glitches are errors of the poses; the IMU tells them apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from imutool.diagnosis.estimation.jacobians import expected
from imutool.diagnosis.estimation.whitening import Band
from imutool.diagnosis.reference.own_poses import align_with_poses, is_in_raw_poses
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.recording import GRAVITY_M_S2, Imu, Poses, Recording
from imutool.sensor.effects.vibration import line_p_value, steady_p_value
from imutool.sensor.simulate import TRUTH_TOPIC
from imutool.sensor.trajectory import smooth_motion

DURATION_S, RATE_HZ, POSE_HZ = 14.0, 200.0, 200.0
WIDTH_S, SIZE = 0.008, (2e-3, 2e-4)  # of an impact, as a bump of the heading (rad) and of the height (m)
NOISE = (3e-4, 5e-3)  # of a sample, rad/s and m/s²
LINE_HZ = 17.0
START_NS = 1_700_000_000_000_000_000
ALMOST = 1.3  # times the noise in the band


def walking(strikes_s: np.ndarray) -> tuple[Recording, np.ndarray]:
    """Body that turns and rises in closed form and is struck at some times, and the noise of its samples."""
    t, pose_s = (np.arange(round(DURATION_S * hz)) / hz for hz in (RATE_HZ, POSE_HZ))
    u = (t[:, None] - strikes_s) / WIDTH_S
    bump = np.exp(-(u**2) / 2.0)
    rate = 0.5 * np.cos(2.0 * t) + SIZE[0] * (-u * bump).sum(axis=1) / WIDTH_S
    up = -0.2 * np.sin(3.0 * t) + SIZE[1] * ((u**2 - 1.0) * bump).sum(axis=1) / WIDTH_S**2
    rng, zero = np.random.default_rng(1), np.zeros_like(t)
    noise = np.repeat(NOISE, 3) * rng.normal(size=(len(t), 6))
    samples = np.stack([zero, zero, rate, zero, zero, up + GRAVITY_M_S2], axis=1) + noise
    bumps = np.exp(-(((pose_s[:, None] - strikes_s) / WIDTH_S) ** 2) / 2.0).sum(axis=1)
    heading, height = 0.25 * np.sin(2.0 * pose_s) + SIZE[0] * bumps, 0.2 / 9.0 * np.sin(3.0 * pose_s) + SIZE[1] * bumps
    heading, height = heading + 1e-5 * rng.normal(size=len(pose_s)), height + 1e-5 * rng.normal(size=len(pose_s))
    none = np.zeros_like(pose_s)
    q_wb = np.stack([np.cos(heading / 2.0), none, none, np.sin(heading / 2.0)], axis=1)
    t_ns, pose_ns = (START_NS + np.round(each * 1e9).astype(np.int64) for each in (t, pose_s))
    poses = Poses(pose_ns, np.stack([none, none, height], axis=1), q_wb)
    return Recording("walk", Imu(t_ns, samples[:, :3].copy(), samples[:, 3:].copy()), truths={TRUTH_TOPIC: poses}), noise


@pytest.mark.parametrize("loud", [0.0, 20.0])  # of the noise: what else the samples hold is no reason to lose an impact
def test_impacts_are_no_glitches(loud: float) -> None:
    strikes_s = np.arange(0.4, DURATION_S, 0.31)
    real, noise = walking(strikes_s)
    more = loud * np.repeat(NOISE, 3) * np.random.default_rng(4).normal(size=noise.shape)
    real = replace(real, imu=Imu(real.imu.t_ns, real.imu.gyro + more[:, :3], real.imu.accel + more[:, 3:]))
    assert smooth_motion(real.truth).glitches > len(strikes_s)  # a robust curve leaves them out
    (pair,) = align_with_poses(real, DiagnoseSettings())
    rows = np.searchsorted(real.imu.t_ns, pair.start_ns) + np.arange(len(pair.real))
    left = pair.real - expected(pair, ()) - more[rows]
    assert slow(left[:, 2]) < ALMOST * slow(noise[:, 2])
    assert slow(left[:, 5]) < ALMOST * slow(noise[:, 5])


def test_glitches_are_left_out() -> None:
    real, _ = walking(np.zeros(0))
    p_wb = real.truth.p_wb.copy()
    p_wb[100::250, 2] += 0.02
    poses = Poses(real.truth.t_ns, p_wb, real.truth.q_wb_wxyz)
    (clean,), (dirty,) = (
        align_with_poses(Recording("walk", real.imu, truths={TRUTH_TOPIC: each}), DiagnoseSettings())
        for each in (real.truth, poses)
    )
    both = [one.ideal.accel[100:-100, 2] for one in (clean, dirty)]
    assert both[1] == pytest.approx(both[0], abs=0.05)  # 2 cm in 5 ms would be 800 m/s²


def test_a_vibration_keeps_its_phase_and_a_gait_wanders() -> None:
    t, rng = np.arange(4000) / RATE_HZ, np.random.default_rng(2)
    noise, wander = rng.normal(size=(len(t), 6)), np.cumsum(rng.normal(size=len(t))) * 0.05
    for phase, steady in ((np.zeros_like(t), True), (wander, False)):
        line = np.sin(2.0 * np.pi * LINE_HZ * t + phase)[:, None] * [0.0, 0.3, 0.0, 1.0, 0.0, 1.0]
        assert (steady_p_value(t, noise + line, LINE_HZ) < 1e-6) is steady
        assert line_p_value(noise + line, RATE_HZ, LINE_HZ) < 1e-3  # both stand out from their neighbours


def test_a_line_that_poses_show_before_smoothing_is_motion() -> None:
    real, _ = walking(np.zeros(0))
    (pair,) = align_with_poses(real, DiagnoseSettings())
    poses, omega = pair.truth, 2.0 * np.pi * LINE_HZ
    assert poses is not None
    up = 1e-4 * np.sin(omega * pair.stamp_s)[:, None] * [0.0, 0.0, 1.0]
    line = np.concatenate([np.zeros_like(up), -(omega**2) * up], axis=1)
    noisy = line + np.repeat(NOISE, 3) * np.random.default_rng(3).normal(size=line.shape)
    moved = Poses(poses.t_ns, poses.p_wb + up, poses.q_wb_wxyz)
    assert not is_in_raw_poses(pair, noisy, LINE_HZ)
    assert is_in_raw_poses(replace(pair, truth=moved), noisy, LINE_HZ)


def slow(x: np.ndarray) -> float:
    """Deviation of what is slower than 4 Hz."""
    return float(Band.below(4.0, RATE_HZ)(x[:, None])[5:-5].std())
