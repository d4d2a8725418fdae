"""Pure integration against the plain loop and closed forms; the velocity of a truth; the published raw figures."""

from __future__ import annotations

import io
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from imutool.errors import DataError, NumericsError
from imutool.inertial.metrics import absolute
from imutool.inertial.strapdown import (
    GRAVITY_W,
    WINDOWS_AT_ONCE,
    StartPose,
    dead_reckon,
    drift,
    truth_velocity,
    velocity_follows,
    window_drift,
)
from imutool.recording import Imu, Poses, unit_quaternions

RATE_NS = 5_000_000
LOOP_TOLERANCE = 1e-9  # both round once a sample; the prefix product in another order
PUBLISHED_TOLERANCE_DEG = 0.1
BUDGET_S = 0.05

LEVEL = StartPose(np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros(3))


def made_up(n: int, seed: int = 0) -> Imu:
    rng = np.random.default_rng(seed)
    stamps = np.cumsum(rng.integers(4_900_000, 5_100_000, n)) + 1_400_000_000_000_000_000
    return Imu(stamps.astype(np.int64), rng.normal(size=(n, 3)), rng.normal(size=(n, 3)) + np.array([0, 0, 9.81]))


def steady(n: int, gyro: tuple[float, ...], accel: tuple[float, ...]) -> Imu:
    t_ns = np.arange(n, dtype=np.int64) * RATE_NS
    return Imu(t_ns, np.tile(np.array(gyro, float), (n, 1)), np.tile(np.array(accel, float), (n, 1)))


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 7, 8, 9, 1000])
def test_integration_is_the_papers_euler_loop(n: int) -> None:
    imu = made_up(n)
    start = StartPose(np.array([0.5, -0.5, 0.5, 0.5]), np.array([1.0, 2.0, 3.0]), np.array([0.1, -0.2, 0.3]))
    R, p, v = Rotation.from_quat(start.q_wb_wxyz, scalar_first=True), start.p_wb, start.v_w
    gyro, accel = imu.gyro.copy(), imu.accel.copy()  # scipy wants them writeable
    got = dead_reckon(imu, start)
    assert np.array_equal(got.t_ns, imu.t_ns)
    for k in range(n):
        turn = Rotation.from_quat(got.q_wb_wxyz[k].copy(), scalar_first=True)
        assert (R.inv() * turn).magnitude() < LOOP_TOLERANCE
        assert np.abs(got.p_wb[k] - p).max() < LOOP_TOLERANCE
        assert got.v_w is not None
        assert np.abs(got.v_w[k] - v).max() < LOOP_TOLERANCE
        if k + 1 < n:
            dt = float(imu.t_ns[k + 1] - imu.t_ns[k]) * 1e-9
            R, p, v = R * Rotation.from_rotvec(gyro[k] * dt), p + v * dt, v + (R.apply(accel[k]) + GRAVITY_W) * dt


def test_a_body_at_rest_stays_and_a_dropped_one_falls() -> None:
    n, dt = 2001, RATE_NS * 1e-9
    rest = dead_reckon(steady(n, (0, 0, 0), (0, 0, 9.81)), LEVEL)
    assert np.abs(rest.p_wb).max() < LOOP_TOLERANCE
    fall = dead_reckon(steady(n, (0, 0, 0), (0, 0, 0)), LEVEL)
    k = np.arange(n)
    assert fall.v_w is not None
    assert np.abs(fall.v_w[:, 2] + 9.81 * k * dt).max() < LOOP_TOLERANCE
    assert np.abs(fall.p_wb[:, 2] + 9.81 * dt**2 * k * (k - 1) / 2).max() < 1e-8  # 490 m


def test_a_constant_rate_turns_exactly_and_a_turning_thrust_draws_a_circle() -> None:
    n, rate, thrust, dt = 3001, 2.0, 3.0, RATE_NS * 1e-9
    got = dead_reckon(steady(n, (0, 0, rate), (thrust, 0, 9.81)), LEVEL)
    angle = rate * np.arange(n) * dt
    assert (
        Rotation.from_rotvec(angle[:, None] * [0, 0, 1]).inv() * Rotation.from_quat(got.q_wb_wxyz, scalar_first=True)
    ).magnitude().max() < LOOP_TOLERANCE
    # v_k = thrust dt sum_{j<k} (cos, sin)(j a), a geometric series
    a, k = rate * dt, np.arange(n)
    series = thrust * dt * (np.exp(1j * k * a) - 1) / (np.exp(1j * a) - 1)
    assert got.v_w is not None
    assert np.abs(got.v_w[:, 0] + 1j * got.v_w[:, 1] - series).max() < LOOP_TOLERANCE


def test_a_sample_acts_on_later_poses_only() -> None:
    imu = made_up(200)
    gyro, accel = imu.gyro.copy(), imu.accel.copy()
    gyro[100:] += 1.0
    accel[100:] += 1.0
    a, b = dead_reckon(imu, LEVEL), dead_reckon(Imu(imu.t_ns, gyro, accel), LEVEL)
    assert np.abs(a.q_wb_wxyz[:101] - b.q_wb_wxyz[:101]).max() < LOOP_TOLERANCE
    assert np.abs(a.p_wb[:102] - b.p_wb[:102]).max() < LOOP_TOLERANCE
    assert np.abs(a.q_wb_wxyz[101] - b.q_wb_wxyz[101]).max() > 1e-4


def test_other_gravity_and_unnormalised_start_are_taken_as_given() -> None:
    start = StartPose(np.array([2.0, 0, 0, 0]), np.zeros(3), np.zeros(3))
    moon = dead_reckon(steady(201, (0, 0, 0), (0, 0, 1.62)), start, g_w=(0.0, 0.0, -1.62))
    assert np.abs(moon.p_wb).max() < LOOP_TOLERANCE
    assert np.array_equal(moon.q_wb_wxyz[-1], [1, 0, 0, 0])


def test_a_log_of_30_000_samples_takes_less_than_the_budget() -> None:
    imu = made_up(30_000)
    dead_reckon(imu, LEVEL)

    def once() -> float:
        begin = time.process_time()
        dead_reckon(imu, LEVEL)
        return time.process_time() - begin

    assert min(once() for _ in range(5)) < BUDGET_S


def turned_away(n: int, seed: int) -> tuple[Imu, Poses, Poses]:
    """Samples, what they integrate to from a start of their own, and another motion on the same stamps as the truth."""
    imu, other = made_up(n, seed), made_up(n, seed + 1)
    truth = dead_reckon(Imu(imu.t_ns, other.gyro, other.accel), LEVEL)
    return imu, dead_reckon(imu, StartPose(np.array([0.1, 0.7, -0.1, 0.7]), np.array([5.0, 6.0, 7.0]), np.ones(3))), truth


def test_one_integration_tells_where_each_from_the_truth_would_have_ended() -> None:
    imu, path, truth = turned_away(2000, 3)
    first, last = np.array([0, 17, 500, 1999]), np.array([1999, 18, 1300, 1999])
    got = window_drift(path, truth, first, last)
    for row, (a, b) in enumerate(zip(first, last, strict=True)):
        again = dead_reckon(imu.rows(slice(a, b + 1)), StartPose.of(truth, int(a)))
        assert again.v_w is not None
        assert truth.v_w is not None
        turns = [Rotation.from_quat(q.copy(), scalar_first=True) for q in (truth.q_wb_wxyz[b], again.q_wb_wxyz[-1])]
        assert got.orientation_rad[row] == pytest.approx((turns[0].inv() * turns[1]).magnitude(), abs=LOOP_TOLERANCE)
        assert got.velocity_m_s[row] == pytest.approx(np.linalg.norm(again.v_w[-1] - truth.v_w[b]), abs=LOOP_TOLERANCE)
        assert got.position_m[row] == pytest.approx(np.linalg.norm(again.p_wb[-1] - truth.p_wb[b]), abs=LOOP_TOLERANCE)
    assert max(got.position_m[3], got.orientation_rad[3], got.velocity_m_s[3]) < LOOP_TOLERANCE  # a window of no length
    assert got.position_m[0] > 1.0


def test_windows_begin_where_there_is_truth_and_never_hold_a_gap() -> None:
    _, path, truth = turned_away(2000, 5)
    valid = np.ones(2000, bool)
    assert len(drift(path, truth, valid, 1.0).position_m) == 9  # of ten seconds less one sample
    valid[150:250] = False  # the first window ends here, and does not count; the next begins at 250
    assert len(drift(path, truth, valid, 1.0).position_m) == 8
    gappy = np.delete(np.arange(2000), np.arange(1010, 1030))
    cut = [
        Poses(p.t_ns[gappy], p.p_wb[gappy], p.q_wb_wxyz[gappy], None if p.v_w is None else p.v_w[gappy]) for p in (path, truth)
    ]
    assert len(drift(cut[0], cut[1], np.ones(len(gappy), bool), 1.0).position_m) == 8
    assert len(drift(path, truth, valid, 60.0).position_m) == 0


def test_paths_of_other_stamps_or_without_velocity_have_no_drift() -> None:
    _, path, truth = turned_away(50, 7)
    rows = np.array([0]), np.array([9])
    with pytest.raises(DataError, match="do not match"):
        window_drift(path, truth.rows(slice(0, 40)), *rows)
    bare, bare_truth = (Poses(poses.t_ns, poses.p_wb, poses.q_wb_wxyz) for poses in (path, truth))
    for one, other in ((path, bare_truth), (bare, truth)):
        with pytest.raises(DataError, match="do not match"):
            window_drift(one, other, *rows)


def test_overflow_and_missing_samples_are_refused() -> None:
    t_ns = np.array([0, 10**12, 2 * 10**12], np.int64)
    with pytest.raises(NumericsError, match=r"overflows at 1000000000000 ns"):
        dead_reckon(Imu(t_ns, np.zeros((3, 3)), np.full((3, 3), 1e308)), LEVEL)
    with pytest.raises(DataError, match="no samples"):
        dead_reckon(Imu(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3))), LEVEL)


def test_a_start_needs_a_velocity_and_a_row() -> None:
    poses = Poses(np.array([0, 1], np.int64), np.ones((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)))
    with pytest.raises(DataError, match="no velocity"):
        StartPose.of(poses)
    moving = Poses(poses.t_ns, poses.p_wb, poses.q_wb_wxyz, np.full((2, 3), 2.0))
    assert np.array_equal(StartPose.of(moving, -1).v_w, [2, 2, 2])
    with pytest.raises(DataError, match="no row 2"):
        StartPose.of(moving, 2)


# --- velocity of the truth ---------------------------------------------------------------------------------------------


def poses_at(t_ns: np.ndarray, p_wb: np.ndarray) -> Poses:
    return Poses(t_ns.astype(np.int64), p_wb, np.tile([1.0, 0, 0, 0], (len(t_ns), 1)))


def cubic(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    c = np.array([[1.0, -2.0, 0.5], [0.3, 0.1, -0.7], [-0.2, 0.4, 0.05], [0.01, -0.02, 0.03]])
    powers = np.stack([t**0, t, t**2, t**3], axis=1)
    slopes = np.stack([0 * t, t**0, 2 * t, 3 * t**2], axis=1)
    return powers @ c, slopes @ c


def test_on_an_even_clock_the_velocity_is_scipys_savitzky_golay_derivative() -> None:
    count = WINDOWS_AT_ONCE + 500
    p = np.cumsum(np.random.default_rng(1).normal(size=(count, 3)), axis=0)
    got = truth_velocity(poses_at(np.arange(count) * RATE_NS, p))
    assert np.abs(got - savgol_filter(p, 41, 3, deriv=1, delta=0.005, axis=0, mode="interp")).max() < 1e-7


def test_a_cubic_is_differentiated_exactly_on_a_jittering_clock_with_gaps_up_to_the_ends_of_every_stretch() -> None:
    rng = np.random.default_rng(2)
    steps = rng.integers(2_000_000, 15_000_000, 900)
    steps[[200, 500, 501, 503]] = 2_000_000_000  # stretches of 201, 300, 1 (alone), 2 and 396 poses
    t_ns = np.cumsum(steps)
    t = t_ns * 1e-9
    p, v = cubic(t)
    got = truth_velocity(poses_at(t_ns, p))
    error = np.abs(got - v).max(axis=1)
    whole = np.ones(900, bool)
    whole[500:503] = False
    assert error[whole].max() < 1e-8
    assert np.allclose(got[500], (p[501] - p[499]) / (t[501] - t[499]))
    assert np.allclose(got[501], (p[502] - p[501]) / (t[502] - t[501]))


def test_a_window_never_reaches_over_a_gap() -> None:
    t_ns = np.concatenate([np.arange(200), np.arange(200) + 400]) * RATE_NS
    p = np.zeros((400, 3))
    p[200:] = 1e3  # the body was carried elsewhere in between
    assert np.abs(truth_velocity(poses_at(t_ns, p))).max() < 1e-9


def test_a_single_pose_has_no_velocity() -> None:
    with pytest.raises(DataError, match="at least 2"):
        truth_velocity(poses_at(np.array([0]), np.zeros((1, 3))))


# --- the published raw column --------------------------------------------------------------------------------------------


def columns(text: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and values of a data set's CSV; the converters' own readers are not what is tested here."""
    table = np.genfromtxt(io.BytesIO(text), delimiter=",", comments="#", skip_header=1)
    stamps = [line.split(b",", 1)[0] for line in text.splitlines()[1:] if line]
    t_ns = np.array([int(s) if s.isdigit() else int(float(s)) for s in stamps], np.int64)
    return t_ns, table[:, 1:]


def test_v1_01_gives_the_published_error_against_its_recomputed_truth_once_their_origins_agree(data: Path) -> None:
    """Published 113.47: started from one truth, scored against the other, the first orientations made equal.

    The raw figures of the other sequences: tests/test_evaluation.py.
    """
    with zipfile.ZipFile(data / "euroc" / "V1_01_easy.zip") as archive:
        (t_imu, u), (t_true, _), (t_ns, x) = (
            columns(archive.read(next(n for n in archive.namelist() if n.endswith(f"{name}/data.csv"))))
            for name in ("imu0", "state_groundtruth_estimate0", "state_groundtruth_recomputed0")
        )
    other = Poses(t_ns, x[:, :3].copy(), unit_quaternions(x[:, 3:7].copy()))
    imu = Imu(t_imu, u[:, :3].copy(), u[:, 3:6].copy()).between(int(t_true[0]), int(t_true[-1]))
    true, valid = other.at(imu.t_ns)
    assert valid.all()
    figures = absolute(dead_reckon(imu, StartPose(true.q_wb_wxyz[0], true.p_wb[0], np.zeros(3))), true, valid)
    assert figures["aoe_deg"] == pytest.approx(113.47, abs=PUBLISHED_TOLERANCE_DEG)


@pytest.mark.parametrize(("count", "follows"), [(0, True), (1, True), (100, True), (400, False)])
def test_velocities_of_other_axes_are_refuted_by_positions_over_more_than_a_second(count: int, follows: bool) -> None:
    t_ns = RATE_NS * np.arange(count)
    p_wb = np.outer(1e-9 * t_ns, [2.0, 0.0, 0.0])
    poses = Poses(t_ns, p_wb, np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), np.tile([0.0, 2.0, 0.0], (count, 1)))
    assert velocity_follows(poses) == follows
    assert velocity_follows(Poses(t_ns, p_wb, poses.q_wb_wxyz))
