"""Poses are held against the gyro: a planted mount and bias count for nothing, another motion does."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.cleaning.truth import Truth
from imutool.log_info.pose_imu_rotation import agreement, body_warnings, motion_warnings, reversed_warnings, sparse_warnings
from imutool.recording import Imu, Poses

RNG = np.random.default_rng(6)
START_NS = 1_600_000_000_000_000_123
T = np.arange(0.0, 30.0, 0.005)
MOUNT = Rotation.from_rotvec([0.3, -1.2, 0.7])
NOISE_RAD_S = 0.002


def attitude(t: np.ndarray, tempo: float = 1.0) -> Rotation:
    angles = [0.5 * np.sin(tempo * 2 * np.pi * f * t + k) for k, f in enumerate((0.2, 0.31, 0.13))]
    return Rotation.from_euler("ZYX", np.stack(angles, axis=1))


def poses(tempo: float = 1.0) -> Truth:
    t = np.arange(0.0, 30.0, 0.1)
    return Truth(
        "/pose",
        START_NS + np.rint(t * 1e9).astype(np.int64),
        np.zeros((len(t), 3)),
        attitude(t, tempo).as_quat(scalar_first=True),
    )


def imu(share: float = 1.0) -> Imu:
    step = 1e-4
    rate = (attitude(T - step).inv() * attitude(T + step)).as_rotvec() / (2 * step)
    gyro = share * MOUNT.apply(rate) + [0.02, -0.01, 0.03] + RNG.normal(0.0, NOISE_RAD_S, rate.shape)
    return Imu(START_NS + np.rint(T * 1e9).astype(np.int64), gyro, np.tile([0.0, 0.0, 9.81], (len(T), 1)))


def test_poses_of_the_same_motion_explain_the_gyro_whatever_its_mount_and_bias():
    found = agreement(poses(), imu())
    assert found is not None
    assert found.explained > 0.999
    assert found.rms_rad_s < 2 * NOISE_RAD_S

    assert found.turned is not None
    turned_deg, std_deg = found.turned
    assert np.abs(turned_deg - MOUNT.as_rotvec(degrees=True)).max() < 5 * std_deg.max()
    assert 0.001 < std_deg.max() < 0.5
    assert motion_warnings("/mocap", found.explained, found.rms_rad_s, found.jumps, found.largest_jump_deg) == []


@pytest.mark.parametrize("wrong", [1e5, 1e30, 1.7e308])
def test_rates_that_no_gyro_measures_count_as_missing(wrong: float) -> None:
    samples = imu()
    gyro = samples.gyro.copy()
    gyro[[1000, 4000]] = wrong
    found = agreement(poses(), dataclasses.replace(samples, gyro=gyro))
    assert found is not None
    assert found.explained > 0.999
    assert found.jumps == 0
    assert agreement(poses(), dataclasses.replace(samples, gyro=np.full_like(gyro, wrong))) is None


def test_poses_that_turn_about_one_axis_show_no_mount() -> None:
    """A robot on a floor: its gyro sees it pitch and roll, its wheels do not, and nothing shows a turn about the vertical."""
    t, t_imu = np.arange(0.0, 300.0, 0.1), np.arange(0.0, 300.0, 0.02)
    rate = np.stack([0.4 * np.sin(3.1 * t_imu), 0.4 * np.sin(4.3 * t_imu), 1.2 * np.cos(t_imu)], axis=1)
    q_wxyz = Rotation.from_rotvec(1.2 * np.sin(t)[:, None] * [0.0, 0.0, 1.0]).as_quat(scalar_first=True)
    truth = Truth("/odom", np.rint(t * 1e9).astype(np.int64), np.zeros((len(t), 3)), q_wxyz)
    accel = np.tile([0.0, 0.0, 9.81], (len(t_imu), 1))
    found = agreement(truth, Imu(np.rint(t_imu * 1e9).astype(np.int64), MOUNT.apply(rate), accel))
    assert found is not None
    assert found.explained > 0.8
    assert found.turned is None


@pytest.mark.parametrize("reversed_axes", ["", "y", "x"])
def test_an_axis_of_the_gyro_that_is_reversed_is_named_although_it_hardly_turns(reversed_axes: str) -> None:
    """A robot on a floor pitches and rolls a little; no turned body reads one axis alone the other way."""
    rng = np.random.default_rng(3)
    small = np.stack([np.sin(T), 0.01 * np.sin(4.0 * T), 0.01 * np.cos(3.1 * T)], axis=1)
    turned, error = Rotation.from_euler("ZYX", small), Rotation.from_rotvec(1e-3 * rng.normal(size=(len(T[::20]), 3)))
    skew = turned.inv().as_matrix() @ np.gradient(turned.as_matrix(), T, axis=0)  # R^T dR/dt = [omega]x
    gyro = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    gyro *= [-1.0 if axis in reversed_axes else 1.0 for axis in "xyz"]
    t_ns = START_NS + np.rint(T * 1e9).astype(np.int64)
    truth = Truth("/pose", t_ns[::20], np.zeros((len(T[::20]), 3)), (turned[::20] * error).as_quat(scalar_first=True))
    found = agreement(truth, Imu(t_ns, gyro, np.tile([0.0, 0.0, 9.81], (len(T), 1))))
    assert found is not None
    assert found.reversed_axes == reversed_axes
    warnings = [warning for warning in reversed_warnings("/pose", found.reversed_axes) if "left-handed" in warning]
    assert len(warnings) == len(reversed_axes)


def test_a_gap_of_the_imu_counts_for_nothing():
    whole = imu()
    rows = np.r_[0:2000, 3001:4100, 4120:6000]  # 5 s and 0.1 s are missing; no gap begins at a pose
    found = agreement(poses(), Imu(whole.t_ns[rows], whole.gyro[rows], whole.accel[rows]))
    assert found is not None
    assert found.explained > 0.999
    assert found.rms_rad_s < 2 * NOISE_RAD_S
    assert found.turned is not None
    assert np.abs(found.turned.deg - MOUNT.as_rotvec(degrees=True)).max() < 5 * found.turned.std_deg.max()


def test_poses_of_another_motion_do_not():
    found = agreement(poses(tempo=1.7), imu())
    assert found is not None
    assert found.explained < 0.3
    assert found.turned is None
    (warning,) = motion_warnings("/mocap", found.explained, found.rms_rad_s, found.jumps, found.largest_jump_deg)
    assert warning.startswith("the poses /mocap explain ")
    assert "another recording" in warning


def test_a_gyro_at_rest_or_poses_of_another_time_show_nothing():
    late = poses()._replace(t_ns=poses().t_ns + 10**12)
    assert agreement(poses(), imu(share=0.0)) is None
    assert agreement(late, imu()) is None


@pytest.mark.parametrize(
    ("sizes_deg", "warned"), [((40.0,), True), ((7.0, -7.0, 7.0), True), ((7.0,), False), ((2.0,) * 40, False)]
)
def test_poses_that_jump_are_named(sizes_deg: tuple[float, ...], warned: bool) -> None:
    """As a motion capture does that exchanges markers."""
    truth = poses()
    after = np.zeros(len(truth.t_ns))
    for place, size in enumerate(sizes_deg, 1):
        after[len(after) * place // (len(sizes_deg) + 1) :] += np.radians(size)
    jumped = Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True) * Rotation.from_rotvec(after[:, None] * [0.0, 0.6, 0.8])
    found = agreement(truth._replace(q_wb_wxyz=jumped.as_quat(scalar_first=True)), imu())
    assert found is not None
    assert found.explained > 0.5
    assert found.jumps == (len(sizes_deg) if warned else 0)
    said = motion_warnings("/mocap", found.explained, found.rms_rad_s, found.jumps, found.largest_jump_deg)
    assert len(said) == warned
    if warned:
        assert abs(found.largest_jump_deg - abs(sizes_deg[0])) < 1.0
        assert f"that the gyro does not show, {'once' if len(sizes_deg) == 1 else f'{len(sizes_deg)} times'}:" in said[0]


def test_a_few_large_jumps_hide_neither_the_motion_nor_the_mount() -> None:
    """Markers are exchanged four times, for one pose each: turns of 26 rad/s next to a motion of 1 rad/s."""
    truth = poses()
    swapped = np.radians(150.0) * (np.arange(len(truth.t_ns)) % 70 == 40)
    R = Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True) * Rotation.from_rotvec(swapped[:, None] * [0.6, 0.0, 0.8])
    found = agreement(truth._replace(q_wb_wxyz=R.as_quat(scalar_first=True)), imu())
    assert found is not None
    assert found.explained > 0.999
    assert found.jumps == 8
    assert found.turned is not None
    assert np.abs(found.turned.deg - MOUNT.as_rotvec(degrees=True)).max() < 5 * found.turned.std_deg.max()
    (warning,) = motion_warnings("/mocap", found.explained, found.rms_rad_s, found.jumps, found.largest_jump_deg)
    assert "turn by up to 150° in 0.1 s that the gyro does not show, 8 times" in warning


@pytest.mark.parametrize(("every", "tempo", "warned"), [(1, 1.0, False), (10, 1.0, True), (10, 0.1, False)])
def test_poses_too_far_apart_for_their_motion_are_named(every: int, tempo: float, warned: bool) -> None:
    """Slow turns may be interpolated over a second, fast ones over a tenth of it."""
    truth = poses(tempo)
    t = np.arange(0.0, 29.0, 0.01)
    kept = truth._replace(**{name: getattr(truth, name)[::every] for name in ("t_ns", "p_wb", "q_wb_wxyz")})
    said = sparse_warnings(kept)
    assert len(said) == warned
    between, _ = Poses(*kept[1:4]).at(START_NS + np.rint(t * 1e9).astype(np.int64))
    missed = Rotation.from_quat(between.q_wb_wxyz, scalar_first=True).inv() * attitude(t, tempo)
    largest_deg = float(np.degrees(missed.magnitude()).max())
    if warned:
        stated_deg = float(said[0].split("up to ")[1].split("°")[0])
        assert "/pose are 1 s apart" in said[0]
        assert 0.5 * largest_deg < stated_deg < 1.5 * largest_deg
    else:
        assert largest_deg < 1.0


def test_noise_jumps_and_gaps_of_poses_do_not_make_them_sparse() -> None:
    t = np.concatenate([np.arange(0.0, 60.0, 1.0), np.arange(300.0, 360.0, 1.0)])
    turn = 2.0 * (t > 30.0) + 0.01 * np.random.default_rng(0).normal(size=len(t))
    q_wxyz = Rotation.from_rotvec(turn[:, None] * [0.0, 0.6, 0.8]).as_quat(scalar_first=True)
    assert sparse_warnings(Truth("/pose", np.rint(t * 1e9).astype(np.int64), np.zeros((len(t), 3)), q_wxyz)) == []


@pytest.mark.parametrize(("mount", "turned"), [((180.0, 0.0), True), ((180.0, 40.0), True), ((0.0, 0.0), False)])
def test_a_vehicle_s_poses_in_another_body_are_named_though_the_motion_does_not_show_how(
    mount: tuple[float, float], turned: bool
) -> None:
    """It turns about its vertical alone, and its poses are of a body whose z axis points down."""
    t, t_imu = np.arange(0.0, 60.0, 0.1), np.arange(0.0, 60.0, 0.01)
    body = Rotation.from_euler("XZ", mount, degrees=True)
    gyro = np.stack([0.0 * t_imu, 0.0 * t_imu, 0.6 * np.cos(t_imu)], axis=1) + RNG.normal(0.0, NOISE_RAD_S, (len(t_imu), 3))
    q_wxyz = (Rotation.from_rotvec(0.6 * np.sin(t)[:, None] * [0.0, 0.0, 1.0]) * body).as_quat(scalar_first=True)
    truth = Truth("/ins", np.rint(t * 1e9).astype(np.int64), np.zeros((len(t), 3)), q_wxyz)
    accel = np.tile([0.0, 0.0, 9.81], (len(t_imu), 1))
    found = agreement(truth, Imu(np.rint(t_imu * 1e9).astype(np.int64), gyro, accel))
    assert found is not None
    assert found.explained > 0.99
    assert found.turned is None
    said = body_warnings("/ins", [], found.explained, found.as_recorded)
    assert ["with their body turned, and the motion does not show how" in each for each in said] == [True] * turned
