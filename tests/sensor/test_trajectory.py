"""SmoothMotion poses: how near rate and force come to the exact ones, and that nothing is invented where nothing is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Bool, Float64
from numpy.random import default_rng
from scipy.spatial.transform import Rotation

from imutool.converters import tum_vi
from imutool.errors import ConfigError, DataError
from imutool.inertial.kinematics import Trajectory
from imutool.recording import Poses
from imutool.sensor.made_up_flight import FlightSettings, trajectory
from imutool.sensor.trajectory import MAX_GAP_S, SmoothMotion, smooth_motion

DURATION_S = 30.0
DEG = np.pi / 180.0
# Rate and force errors (rad/s, m/s², root mean square by axis) of a flight with that noise; a third above what was measured,
# which is what another numpy or another seed changes. Without noise the splines' own knots are what is left.
NOISE = [
    (200.0, 0.0, 0.0, 1e-6, 4e-4),
    (200.0, 1e-4, 0.05, 5e-3, 0.07),
    (120.0, 1e-3, 0.1, 8.4e-3, 0.14),
    (100.0, 5e-3, 0.5, 0.024, 0.23),
]
SAID = (0.8, 4.0)  # stated over true error: motion of control points 0.35 s apart is smoother than the white jerk of the prior
END_RATIO = 1.6  # of the error in the first 50 ms of what is trusted to that amid it; 1.35 was measured


def clock(start_ns: int, rate_hz: float, duration_s: float = DURATION_S) -> np.ndarray:
    return start_ns + np.round(np.arange(int(duration_s * rate_hz) + 1) * 1e9 / rate_hz).astype(np.int64)


def noisy(path: Trajectory, t_ns: np.ndarray, noise_m: float, noise_deg: float, seed: int = 0) -> Poses:
    rng, exact = default_rng(seed), path.poses(t_ns)
    shaken = turned(exact.q_wb_wxyz, noise_deg * DEG * rng.normal(size=(len(t_ns), 3)))
    return Poses(t_ns, exact.p_wb + noise_m * rng.normal(size=(len(t_ns), 3)), shaken)


def turned(q_wb_wxyz: np.ndarray, by: np.ndarray) -> np.ndarray:
    both = Rotation.from_quat(q_wb_wxyz, scalar_first=True) * Rotation.from_rotvec(by)
    return np.ascontiguousarray(both.as_quat(scalar_first=True))


def errors(motion: SmoothMotion, path: Trajectory) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Of rate and specific force, over all that is trusted."""
    gyro, accel = [], []
    for felt in motion.ideal_motions(200.0):
        exact = path.at(motion.start_ns + np.round(felt.t_s * 1e9).astype(np.int64))
        gyro.append(felt.gyro - exact.omega_b)
        accel.append(felt.accel - exact.specific_force())
    return np.concatenate(gyro), np.concatenate(accel)


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def without(poses: Poses, gone: Bool[np.ndarray, " n"]) -> Poses:
    return Poses(poses.t_ns[~gone], poses.p_wb[~gone], poses.q_wb_wxyz[~gone])


@pytest.fixture(scope="module")
def path() -> Trajectory:
    return trajectory(1, FlightSettings(duration_s=DURATION_S, still_s=2.0))


@pytest.mark.parametrize(("rate_hz", "noise_m", "noise_deg", "gyro", "accel"), NOISE, ids=lambda value: f"{value:g}")
def test_rate_and_force_come_near_the_exact_ones(
    path: Trajectory, rate_hz: float, noise_m: float, noise_deg: float, gyro: float, accel: float
) -> None:
    motion = smooth_motion(noisy(path, clock(path.start_ns, rate_hz), noise_m, noise_deg))
    found = errors(motion, path)
    assert rms(found[0]) < gyro
    assert rms(found[1]) < accel
    assert len(motion.stretches) == 1
    assert motion.glitches == motion.steps == 0
    assert motion.duration_s > DURATION_S - 0.5


def test_the_noise_of_poses_and_what_it_does_are_stated(path: Trajectory) -> None:
    motion = smooth_motion(noisy(path, clock(path.start_ns, 120.0), 2e-4, 0.03))
    (stretch,) = motion.stretches
    assert stretch.noise_m == pytest.approx(2e-4, rel=0.1)
    assert stretch.noise_rad == pytest.approx(0.03 * DEG, rel=0.1)
    found = errors(motion, path)
    assert SAID[0] < motion.gyro_std / rms(found[0]) < SAID[1]
    assert SAID[0] < motion.accel_std / rms(found[1]) < SAID[1]


def test_a_motion_is_smoothed_once_though_others_ask_for_it_again(path: Trajectory) -> None:
    poses = noisy(path, clock(path.start_ns, 120.0), 2e-4, 0.03)
    assert smooth_motion(poses) is smooth_motion(poses)
    assert smooth_motion(poses) is not smooth_motion(Poses(poses.t_ns, poses.p_wb, poses.q_wb_wxyz))


def test_the_ends_that_are_trusted_are_nearly_as_good_as_the_middle(path: Trajectory) -> None:
    poses = noisy(path, clock(path.start_ns, 120.0), 5e-4, 0.05)
    first, middle = [], []
    for start in range(240, len(poses) - 240, 240):
        found = errors(smooth_motion(poses.rows(slice(start, start + 240))), path)
        first.append(np.concatenate([found[1][:10], found[1][-10:]]))
        middle.append(found[1][60:-60])
    assert rms(np.concatenate(first)) < END_RATIO * rms(np.concatenate(middle))


def test_nothing_is_invented_across_a_hole(path: Trajectory) -> None:
    poses = noisy(path, clock(path.start_ns, 120.0), 2e-4, 0.03)
    t_s = (poses.t_ns - poses.t_ns[0]) * 1e-9
    motion = smooth_motion(without(poses, (t_s > 10.0) & (t_s < 10.3)))
    before, after = motion.stretches
    assert before.end_s < 10.0
    assert after.start_s > 10.3
    assert not motion.covers(poses.t_ns)[(t_s > 10.0) & (t_s < 10.3)].any()
    assert [(len(felt.t_s) > 0 and felt.t_s[-1] < 10.0) or felt.t_s[0] > 10.3 for felt in motion.ideal_motions(100.0)] == [
        True,
        True,
    ]
    assert rms(errors(motion, path)[1]) < 0.1  # as without the hole


def test_a_short_hole_is_bridged(path: Trajectory) -> None:
    poses = noisy(path, clock(path.start_ns, 120.0), 2e-4, 0.03)
    t_s = (poses.t_ns - poses.t_ns[0]) * 1e-9
    motion = smooth_motion(without(poses, (t_s > 10.0) & (t_s < 10.0 + MAX_GAP_S - 0.03)))
    assert len(motion.stretches) == 1


def test_glitches_are_dropped_and_do_no_harm(path: Trajectory) -> None:
    clean = noisy(path, clock(path.start_ns, 200.0), 1e-4, 0.05)
    rng = default_rng(3)
    wild = rng.random(len(clean)) < 0.01
    p_wb, by = clean.p_wb.copy(), np.zeros((len(clean), 3))
    p_wb[wild] += 0.1 * rng.normal(size=(wild.sum(), 3))
    by[wild] = 0.3 * rng.normal(size=(wild.sum(), 3))
    motion = smooth_motion(Poses(clean.t_ns, p_wb, turned(clean.q_wb_wxyz, by)))
    assert motion.glitches == wild.sum()
    without_them = errors(smooth_motion(clean), path)
    for ours, best in zip(errors(motion, path), without_them, strict=True):
        assert rms(ours) < 1.1 * rms(best)  # a hundredth of the poses is gone, some two in a row


def test_a_glitch_as_long_as_a_hole_is_a_hole(path: Trajectory) -> None:
    clean = noisy(path, clock(path.start_ns, 120.0), 2e-4, 0.03)
    p_wb = clean.p_wb.copy()
    p_wb[1200:1224] += default_rng(0).normal(size=(24, 3))  # a fifth of a second of nonsense
    motion = smooth_motion(Poses(clean.t_ns, p_wb, clean.q_wb_wxyz))
    assert len(motion.stretches) == 2
    assert not motion.covers(clean.t_ns[1200:1224]).any()
    assert rms(errors(motion, path)[1]) < 0.1


def test_steps_of_the_position_are_no_motion(path: Trajectory) -> None:
    """An estimator that takes in a fix each second jumps by millimetres; twice differentiated that would be 100 m/s²."""
    clean = noisy(path, clock(path.start_ns, 200.0), 2e-5, 0.01)
    rng, jump = default_rng(1), np.zeros((len(clean), 3))
    at = np.arange(100, len(clean) - 100, 200)
    jump[at] = 5e-3 * rng.normal(size=(len(at), 3))
    motion = smooth_motion(Poses(clean.t_ns, clean.p_wb + np.cumsum(jump, axis=0), clean.q_wb_wxyz))
    assert motion.steps == len(at)
    accel, best = rms(errors(motion, path)[1]), rms(errors(smooth_motion(clean), path)[1])
    assert accel < 1.5 * best + 0.02  # what comes back over seconds adds a hundredth of m/s² for each centimetre
    exact = path.at(clean.t_ns)
    p_wb = motion.stretches[0].trajectory.at(clean.t_ns[1000:2000]).p_wb
    assert np.abs(p_wb - (exact.p_wb + np.cumsum(jump, axis=0))[1000:2000]).max() < 0.03  # and the position is not lost


def test_an_uneven_clock_is_no_matter(path: Trajectory) -> None:
    rng = default_rng(5)
    t_ns = np.unique(path.start_ns + np.sort(rng.uniform(0.0, DURATION_S * 1e9, int(DURATION_S * 100.0))).astype(np.int64))
    motion = smooth_motion(noisy(path, t_ns, 2e-4, 0.03))
    assert rms(errors(motion, path)[0]) < 6e-3  # a random clock has holes of several periods


@pytest.mark.parametrize("kind", ["fast with a hole", "bursts"])
def test_odd_clocks_give_a_motion_all_the_same(path: Trajectory, kind: str) -> None:
    """A thousand poses a second with nearly a tenth missing; ten poses in ten microseconds, a hundred times a second."""
    if kind == "bursts":
        t_ns = (clock(path.start_ns, 100.0, 5.0)[:, None] + 1000 * np.arange(10)).ravel()
    else:
        t_ns = clock(path.start_ns, 1000.0, 5.0)
        t_ns = np.concatenate([t_ns[:3000], t_ns[3095:]])
    motion = smooth_motion(noisy(path, t_ns, 1e-4, 0.03))
    assert motion.duration_s > 4.5
    assert rms(errors(motion, path)[0]) < 5e-3


def test_rest_is_rest(path: Trajectory) -> None:
    t_ns = clock(path.start_ns, 120.0, 5.0)
    rng = default_rng(0)
    q_wb = turned(np.tile([1.0, 0.0, 0.0, 0.0], (len(t_ns), 1)), 1e-3 * rng.normal(size=(len(t_ns), 3)))
    (felt,) = smooth_motion(Poses(t_ns, 1e-3 * rng.normal(size=(len(t_ns), 3)), q_wb)).ideal_motions(100.0)
    # differentiated as they are, such poses accelerate by 35 m/s² and turn by 0.17 rad/s
    assert rms(felt.accel - [0.0, 0.0, 9.81]) < 0.02
    assert rms(felt.gyro) < 2e-3


def test_the_even_clock_is_counted_from_the_first_pose(path: Trajectory) -> None:
    motion = smooth_motion(noisy(path, clock(path.start_ns, 100.0), 1e-4, 0.01))
    (felt,) = motion.ideal_motions(250.0)
    np.testing.assert_allclose(felt.t_s * 250.0, np.round(felt.t_s * 250.0), atol=1e-9)
    assert felt.rate_hz == pytest.approx(250.0)
    assert felt.R_wb is not None
    np.testing.assert_allclose(np.linalg.det(felt.R_wb), 1.0, atol=1e-12)


@pytest.mark.parametrize("rate_hz", [0.0, -5.0, float("nan"), float("inf")])
def test_a_rate_must_mean_something(path: Trajectory, rate_hz: float) -> None:
    with pytest.raises(ConfigError, match="a rate of"):
        smooth_motion(noisy(path, clock(path.start_ns, 100.0), 0.0, 0.0)).ideal_motions(rate_hz)


@pytest.mark.parametrize("count", [0, 1, 20])
def test_too_few_poses_are_refused(path: Trajectory, count: int) -> None:
    poses = noisy(path, clock(path.start_ns, 100.0), 0.0, 0.0).rows(slice(0, count))
    with pytest.raises(DataError, match=f"no stretch of the {count} poses"):
        smooth_motion(poses)


def test_poses_with_holes_everywhere_are_refused(path: Trajectory) -> None:
    with pytest.raises(DataError, match=r"poses at 8 Hz, with \d+ steps above 0.1 s, can be differentiated"):
        smooth_motion(noisy(path, clock(path.start_ns, 8.0), 0.0, 0.0))


def test_a_handheld_recording_is_explained_by_its_own_poses(data: Path) -> None:
    """TUM-VI room1, raw: bias aside, its gyro and accelerometer differ from its motion capture by 0.05 and 0.17 in the mean."""
    recording = next(iter(tum_vi.read(data / "tumvi" / "dataset-room1.tar.gz")))
    motion = smooth_motion(recording.truth)
    assert motion.duration_s > 130.0
    gyro, accel = [], []
    for stretch in motion.stretches:
        imu = recording.imu.between(*(motion.start_ns + int(at * 1e9) for at in (stretch.start_s + 1e-6, stretch.end_s - 1e-6)))
        exact = stretch.trajectory.at(imu.t_ns)
        gyro.append(imu.gyro - exact.omega_b)
        accel.append(imu.accel - exact.specific_force())
    for left, largest in ((np.concatenate(gyro), 0.07), (np.concatenate(accel), 0.22)):
        assert rms(left - np.median(left, axis=0)) < largest


def test_a_wild_start_is_dropped_and_makes_no_smoother_motion(path: Trajectory) -> None:
    """A simulator that puts its body in place: its first poses are anywhere."""
    t_ns = clock(path.start_ns, 100.0)
    exact, rng = path.poses(t_ns), default_rng(2)
    p_wb, q_wb_wxyz = exact.p_wb.copy(), exact.q_wb_wxyz.copy()
    p_wb[:6] += np.outer(np.arange(6, 0, -1), [0.3, -0.2, 1.0])
    q_wb_wxyz[:6] = Rotation.random(6, rng).as_quat(scalar_first=True)
    whole, sound = (smooth_motion(one) for one in (Poses(t_ns, p_wb, q_wb_wxyz), exact))
    assert whole.glitches >= 6
    assert min(whole.stretches[0].cutoff_hz) > 0.9 * min(sound.stretches[0].cutoff_hz)
