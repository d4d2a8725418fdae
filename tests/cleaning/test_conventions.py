"""Every unit, frame and permutation of the axes is named in a made-up log; where the motion shows nothing, nothing is."""

from __future__ import annotations

from itertools import accumulate

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import drifting
from support.imu_defects import batch_of

from imutool.cleaning.conventions import Conventions, judge
from imutool.cleaning.likelihood import signed_permutations
from imutool.cleaning.pose_quaternions import MISREAD, OTHER_WORLD, left_when_turned, read_right
from imutool.cleaning.position_unit import POSITIONS, Misfits
from imutool.cleaning.rule import CleaningSettings, TopicSummary
from imutool.cleaning.rules.axes import LATE_S, TO_Z_UP, Axes
from imutool.cleaning.samples import Motion, Samples
from imutool.cleaning.survey import Survey, examine
from imutool.cleaning.truth import Truth, of_poses
from imutool.cleaning.unit_evidence import FORCES, RATES
from imutool.recording import GRAVITY_M_S2, Imu, Poses
from imutool.sensor.made_up_flight import flight

PERMUTATIONS = signed_permutations()
RATE_HZ = 100


def motion_of(imu: Imu) -> Motion:
    motion = Motion()
    motion.see(Samples(np.arange(len(imu)), imu.t_ns, imu.t_ns, np.concatenate([imu.gyro, imu.accel], axis=1)))
    return motion


def turned(omega: np.ndarray, a_w: np.ndarray | None = None, noise: float = 0.002) -> tuple[Imu, Poses]:
    """IMU and poses of a body that turns at the given rates, and accelerates in the world."""
    t_ns = np.arange(len(omega)) * (1_000_000_000 // RATE_HZ)
    steps = Rotation.from_rotvec(omega / RATE_HZ).as_matrix()
    R_wb = Rotation.from_matrix(list(accumulate(steps[:-1], np.matmul, initial=np.eye(3))))
    a_w = np.zeros_like(omega) if a_w is None else a_w
    rng = np.random.default_rng(5)
    accel = R_wb.inv().apply(a_w + np.array([0.0, 0.0, GRAVITY_M_S2])) + 10 * noise * rng.normal(size=omega.shape)
    p_wb = np.cumsum(np.cumsum(a_w, axis=0), axis=0) / RATE_HZ**2
    return Imu(t_ns, omega + noise * rng.normal(size=omega.shape), accel), Poses(t_ns, p_wb, R_wb.as_quat(scalar_first=True))


def waves(seconds: float, sizes: tuple[float, float, float], seed: int = 1) -> np.ndarray:
    """Smooth signals of three axes."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    rng = np.random.default_rng(seed)
    parts = [np.sin(2 * np.pi * f * t[:, None] + rng.uniform(0, 6, 3)) for f in (0.13, 0.29, 0.41, 0.67)]
    return np.sum(parts, axis=0) * sizes


@pytest.fixture(scope="module")
def flown() -> tuple[Imu, Truth]:
    made = flight(3, duration_s=40.0)
    truth = of_poses("/ground_truth/pose", made.truth)
    assert truth is not None
    return made.imu, truth


@pytest.mark.parametrize("number", range(48))
def test_units_axes_and_worlds_are_named_by_poses(number: int, flown: tuple[Imu, Truth]) -> None:
    imu, truth = flown
    P, Q = PERMUTATIONS[number], PERMUTATIONS[(7 * number + 5) % 48]
    unit, force_unit = list(RATES)[number % len(RATES)], list(FORCES)[number % len(FORCES)]
    up = ["+z", *TO_Z_UP][number % 6]
    C = np.eye(3) if up == "+z" else TO_Z_UP[up].T
    late_ns = 40_000_000 * (number % 3 - 1)
    world = truth._replace(
        t_ns=truth.t_ns + late_ns,
        p_wb=truth.p_wb @ C.T,
        q_wb_wxyz=(Rotation.from_matrix(C) * Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True)).as_quat(scalar_first=True),
    )
    planted = Imu(imu.t_ns, imu.gyro @ P / RATES[unit], imu.accel @ Q / FORCES[force_unit])
    found = judge(motion_of(planted), world, FORCES[force_unit])
    assert found.gyro is not None
    assert (found.gyro.axes == P).all()
    assert found.gyro.unit == unit
    assert found.quaternions == ""
    assert found.accel is not None
    assert (found.accel.axes == Q).all()
    assert found.up == up
    assert found.delay is not None
    assert found.delay.seconds == pytest.approx(late_ns * 1e-9, abs=0.005)


def misread(q_wxyz: np.ndarray, what: str) -> np.ndarray:
    """Quaternions as a log has them that is read wrongly."""
    rows, signs = MISREAD[what]
    read = np.empty_like(q_wxyz)
    read[:, rows] = q_wxyz * signs
    return read


@pytest.mark.parametrize("what", MISREAD)
def test_misread_quaternions_of_poses_are_named_and_not_the_gyro(what: str, flown: tuple[Imu, Truth]) -> None:
    imu, truth = flown
    assert judge(motion_of(imu), truth._replace(q_wb_wxyz=misread(truth.q_wb_wxyz, what)), 1.0).quaternions == what
    found = judge(motion_of(imu), truth, 1.0)
    assert found.quaternions == ""
    assert found.gyro is not None
    assert found.gyro.as_is


@pytest.mark.parametrize("what", MISREAD)
@pytest.mark.parametrize("number", [row for row, P in enumerate(PERMUTATIONS) if np.linalg.det(P) > 0][1::7])
def test_misread_quaternions_of_a_body_that_is_turned_against_the_gyro_are_named(
    what: str, number: int, flown: tuple[Imu, Truth]
) -> None:
    imu, truth = flown
    read = misread(truth.q_wb_wxyz, what)
    planted = Imu(imu.t_ns, imu.gyro @ PERMUTATIONS[number], imu.accel @ PERMUTATIONS[number])
    found = judge(motion_of(planted), truth._replace(q_wb_wxyz=read), 1.0)
    assert found.quaternions
    assert found.gyro is not None
    rows, signs = MISREAD[found.quaternions]  # some readings are alike, up to a turn of the world
    q = Rotation.from_quat(read[:, rows] * signs, scalar_first=True)
    rate = (q[:-1].inv() * q[1:]).as_rotvec() * 1e9 / np.diff(truth.t_ns)[:, None]
    middle = 0.5 * (truth.t_ns[1:] + truth.t_ns[:-1])
    measured = np.stack([np.interp(middle, imu.t_ns, column) for column in (planted.gyro @ found.gyro.axes.T).T], axis=1)
    assert np.median(np.abs(measured - rate)) < 0.2 * np.median(np.abs(rate))


@pytest.mark.parametrize("up", ["+z", "+y"])
@pytest.mark.parametrize("what", MISREAD)
@pytest.mark.parametrize("number", [row for row, P in enumerate(PERMUTATIONS) if np.linalg.det(P) > 0][3::6])
def test_of_readings_of_quaternions_that_are_alike_the_positions_show_the_right_one(
    what: str, number: int, up: str, flown: tuple[Imu, Truth]
) -> None:
    """Inverse ones of a turned body passed for w in the place of z: the positions were turned to another world."""
    imu, truth = flown
    world = Rotation.from_matrix(np.eye(3) if up == "+z" else [[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    q_wxyz = (world * Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True)).as_quat(scalar_first=True)
    planted = Imu(imu.t_ns, imu.gyro @ PERMUTATIONS[number], imu.accel @ PERMUTATIONS[number])
    found = judge(motion_of(planted), truth._replace(q_wb_wxyz=misread(q_wxyz, what), p_wb=world.apply(truth.p_wb)), 1.0)
    assert (found.quaternions, found.up) == (what, up)
    assert found.gyro is not None
    np.testing.assert_array_equal(found.gyro.axes, PERMUTATIONS[number])


@pytest.mark.parametrize("what", MISREAD)
def test_without_positions_gravity_shows_the_right_one_of_readings_that_are_alike(what: str, flown: tuple[Imu, Truth]) -> None:
    """Transposed matrices of a motion capture passed for w in the place of z, and --fix turned a world whose z was up."""
    imu, truth = flown
    on_its_back = Imu(imu.t_ns, imu.gyro * [1.0, -1.0, -1.0], imu.accel * [1.0, -1.0, -1.0])
    read = truth._replace(q_wb_wxyz=misread(truth.q_wb_wxyz, what), p_wb=np.zeros_like(truth.p_wb))
    found = judge(motion_of(on_its_back), read, 1.0)
    assert found.quaternions == what


@pytest.mark.parametrize("what", MISREAD)
def test_a_body_that_is_turned_by_any_angle_leaves_little_and_a_misread_quaternion_much(what: str) -> None:
    """A phone's markers were turned so that no order of axes fits: --fix changed the order of stated quaternions."""
    omega = waves(20.0, (0.1, 0.2, 0.37))
    rate = Rotation.from_rotvec([-54.2, -105.1, 86.5], degrees=True).inv().apply(omega)
    q = Rotation.from_quat(misread(turned(rate)[1].q_wb_wxyz, what), scalar_first=True)
    wrong = RATE_HZ * (q[:-1].inv() * q[1:]).as_rotvec()
    assert left_when_turned(omega, rate) < 1e-9
    assert left_when_turned(omega[:-1], wrong) > 0.2


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("step_s", [0.06, 0.5, -0.2])
def test_a_step_of_one_clock_is_no_delay(share: float, step_s: float, flown: tuple[Imu, Truth]) -> None:
    """All poses of a log were moved by 194 ms for a step of the IMU's clock by 200 ms after a fifth of it."""
    imu, truth = flown
    at_ns = int(imu.t_ns[int(share * len(imu))])
    stepped = truth._replace(t_ns=truth.t_ns + np.where(truth.t_ns > at_ns, round(step_s * 1e9), 0))
    if step_s < 0.0:  # poses that come twice are left out
        keep = np.diff(np.maximum.accumulate(stepped.t_ns), prepend=0) > 0
        stepped = Truth(truth.topic, *(column[keep] for column in stepped[1:4]), truth.kind)
    whole = TopicSummary(CleaningSettings(), len(imu), motion_of(imu), stepped)
    delay = whole.conventions.delay
    assert delay is not None
    assert delay.step is not None
    assert delay.step.after_s - delay.step.before_s == pytest.approx(step_s, abs=0.03)
    assert abs(delay.step.at_ns - at_ns) < 0.15 * np.ptp(imu.t_ns)
    (found,) = Axes().findings(whole)
    assert "the clock of the IMU or that of the poses /ground_truth/pose steps by" in found.what
    assert "fix" not in found.values
    assert whole.pose_delay_ns == 0


def test_a_part_that_fits_any_delay_shows_no_step() -> None:
    """The gyro's bias drifts while the body hardly turns: the first eighth fits 70 ms as well as none."""
    recording = drifting.log(52, drifting.Drifting(kind="warm_up"), 100.0)
    truth = of_poses("/ground_truth/pose", recording.truth)
    delay = TopicSummary(CleaningSettings(), len(recording.imu), motion_of(recording.imu), truth).conventions.delay
    assert delay is not None
    assert delay.step is None
    assert abs(delay.seconds) < 0.001


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_quaternions_of_another_world_than_the_positions_are_named(sign: float, flown: tuple[Imu, Truth]) -> None:
    """NED next to ENU, either way round: not an accelerometer that is reversed, which looks alike."""
    imu, truth = flown
    in_ned = truth._replace(q_wb_wxyz=read_right(OTHER_WORLD, truth.q_wb_wxyz))
    both = in_ned._replace(p_wb=truth.p_wb[:, [1, 0, 2]] * [1, 1, -1])
    samples = motion_of(Imu(imu.t_ns, imu.gyro, sign * imu.accel))
    for poses, quaternions in (
        (truth, ""),
        (both, ""),
        (in_ned, OTHER_WORLD),
        (both._replace(q_wb_wxyz=truth.q_wb_wxyz), OTHER_WORLD),
    ):
        found = judge(samples, poses, 1.0)
        if sign > 0:
            assert found.quaternions == quaternions
        else:
            assert found.quaternions == "" or quaternions


@pytest.mark.parametrize(("unit", "up"), [("mm", "+z"), ("cm", "-z"), ("mm", "+y"), ("m", "+z")])
def test_the_unit_of_positions_is_named_by_the_accelerometer(unit: str, up: str, flown: tuple[Imu, Truth]) -> None:
    imu, truth = flown
    C = np.eye(3) if up == "+z" else TO_Z_UP[up].T
    turns = Rotation.from_matrix(C) * Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True)
    world = truth._replace(p_wb=truth.p_wb @ C.T / POSITIONS[unit], q_wb_wxyz=turns.as_quat(scalar_first=True))
    found = judge(motion_of(imu), world, 1.0)
    assert (found.unit, found.up, found.accel and found.accel.as_is) == (unit, up, True)


@pytest.mark.parametrize("unit", ["mm", "cm", "m"])
@pytest.mark.parametrize("noise_m", [0.01, 0.03])
def test_the_unit_of_noisy_positions_is_named_by_their_slower_motion(
    unit: str, noise_m: float, flown: tuple[Imu, Truth]
) -> None:
    """In 0.1 s the noise alone accelerates by 2.4 and 7 m/s²."""
    imu, truth = flown
    noise = noise_m * np.random.default_rng(8).normal(size=truth.p_wb.shape)
    assert judge(motion_of(imu), truth._replace(p_wb=(truth.p_wb + noise) / POSITIONS[unit]), 1.0).unit == unit


@pytest.mark.parametrize("scale", [0.02, 3.0, 30.0, 300.0, 3000.0])
def test_positions_of_no_certain_scale_have_no_other_unit(scale: float, flown: tuple[Imu, Truth]) -> None:
    imu, truth = flown
    assert judge(motion_of(imu), truth._replace(p_wb=scale * truth.p_wb), 1.0).unit == "m"


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("noise_m", [0.02, 0.2, 2.0, 20.0])
def test_noisy_positions_have_no_other_unit(noise_m: float, seed: int, flown: tuple[Imu, Truth]) -> None:
    imu, truth = flown
    noise = noise_m * np.random.default_rng(seed).normal(size=truth.p_wb.shape)
    assert judge(motion_of(imu), truth._replace(p_wb=truth.p_wb + noise), 1.0).unit == "m"


@pytest.mark.parametrize("scale", [0.0, 0.05, 0.5, 5.0, 50.0])
def test_unrelated_positions_have_no_other_unit(scale: float, flown: tuple[Imu, Truth]) -> None:
    imu, truth = flown
    assert judge(motion_of(imu), truth._replace(p_wb=scale * truth.p_wb[::-1]), 1.0).unit == "m"


@pytest.mark.parametrize("number", range(48))
def test_units_and_axes_of_the_gyro_are_named_by_gravity(number: int) -> None:
    P, unit = PERMUTATIONS[number], list(RATES)[number % len(RATES)]
    imu, _ = turned(waves(60.0, (0.3, 0.3, 0.3)))
    found = judge(motion_of(Imu(imu.t_ns, imu.gyro @ P / RATES[unit], imu.accel)), None, 1.0).relative
    assert found is not None
    assert (found.axes == P).all()
    assert found.unit == unit


@pytest.mark.parametrize("late_s", [-7.0, 1e9])
@pytest.mark.parametrize("rotation", [np.eye(3), PERMUTATIONS[17]])
def test_the_clock_of_poses_is_found_however_far_it_is_off(rotation: np.ndarray, late_s: float) -> None:
    imu, poses = turned(waves(90.0, (0.5, 0.4, 0.6), 5))
    truth = of_poses("/mocap", poses)
    assert truth is not None
    other = truth._replace(t_ns=truth.t_ns + round(late_s * 1e9))
    found = judge(motion_of(Imu(imu.t_ns, imu.gyro @ rotation, imu.accel)), other, 1.0)
    assert found.delay is not None
    assert found.delay.seconds == pytest.approx(late_s, abs=0.005)
    assert found.gyro is not None
    assert (found.gyro.axes == rotation).all()


@pytest.mark.parametrize("rate_hz", [25, 26, 50])
def test_steps_that_hold_no_whole_number_of_samples_shift_no_clock(rate_hz: int) -> None:
    """Half a sample is 20 ms at 25 Hz."""
    made = flight(3, duration_s=40.0, rate_hz=rate_hz)
    truth = of_poses("/ground_truth/pose", made.truth)
    assert truth is not None
    found = judge(motion_of(made.imu), truth, 1.0).delay
    assert found is not None
    assert found.seconds == pytest.approx(0.0, abs=0.004)


@pytest.mark.parametrize("seed", range(3))
def test_one_part_that_errs_does_not_make_a_delay_unsure(seed: int) -> None:
    """A part whose poses are 0.1 s off, as of exchanged markers: the others tell the delay as surely as without it."""
    imu, poses = turned(waves(16.0, (0.5, 0.4, 0.6), seed))
    truth = of_poses("/truth", poses)
    assert truth is not None
    late_ns = np.where(np.arange(len(truth.t_ns)) < 0.8 * len(truth.t_ns), 80_000_000, 180_000_000)
    found = judge(motion_of(imu), truth._replace(t_ns=truth.t_ns + late_ns), 1.0).delay
    assert found is not None
    assert found.seconds == pytest.approx(0.08, abs=0.04)
    assert 5.0 * found.std_s < 0.08


@pytest.mark.parametrize("late_s", [0.3, -3.1, 1e5])
@pytest.mark.parametrize("seed", range(3))
def test_poses_that_jump_some_times_do_not_hide_their_delay(seed: int, late_s: float) -> None:
    """Markers are exchanged for 0.3 s, nine times in two minutes: turns by 2.5 rad that the gyro does not show."""
    imu, poses = turned(waves(120.0, (0.5, 0.4, 0.6), seed))
    truth = of_poses("/truth", poses)
    assert truth is not None
    jumps = 2.5 * np.isin(np.arange(len(truth.t_ns)) % 130, (50, 51, 52))[:, None] * [0.0, 0.6, 0.8]
    q_wxyz = (Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True) * Rotation.from_rotvec(jumps)).as_quat(scalar_first=True)
    other = truth._replace(t_ns=truth.t_ns + round(late_s * 1e9), q_wb_wxyz=q_wxyz)
    found = judge(motion_of(imu), other, 1.0).delay
    assert found is not None
    assert found.seconds == pytest.approx(late_s, abs=0.02)


@pytest.mark.parametrize(
    ("length_s", "late_s", "accuracy_s"), [(21.0, 0.35, 0.012), (21.0, -1.2, 0.012), (10.0, 0.12, 0.05), (10.0, -0.3, 0.05)]
)
@pytest.mark.parametrize("seed", range(5))
def test_twenty_seconds_show_the_delay_of_poses_by_up_to_two_and_ten_by_up_to_half_a_second(
    seed: int, length_s: float, late_s: float, accuracy_s: float
) -> None:
    imu, poses = turned(waves(length_s, (0.5, 0.4, 0.6), seed))
    truth = of_poses("/truth", poses)
    assert truth is not None
    found = judge(motion_of(imu), truth._replace(t_ns=truth.t_ns + round(late_s * 1e9)), 1.0)
    assert found.delay is not None
    assert found.delay.seconds == pytest.approx(late_s, abs=accuracy_s)
    _, other = turned(waves(length_s, (0.5, 0.4, 0.6), 100 + seed))
    unrelated = of_poses("/truth", other)
    assert unrelated is not None
    assert judge(motion_of(imu), unrelated, 1.0).delay is None


def one_axis_after_another(each_s: float, rate_rad_s: float) -> np.ndarray:
    """Angular rates of a yaw, then a pitch, then a roll, there and back twice."""
    turn = rate_rad_s * np.sin(4 * np.pi * np.arange(round(each_s * RATE_HZ)) / (each_s * RATE_HZ))
    return np.concatenate([np.outer(turn, axis) for axis in np.eye(3)[::-1]])


@pytest.mark.parametrize("up", ["+z", "-x"])
def test_turns_about_one_axis_after_another_show_the_world_of_straight_poses(up: str) -> None:
    """In so few seconds no order of the axes is clearly the best, and yet the best rotation is a small one."""
    omega = one_axis_after_another(5.0, 1.5)
    imu, poses = turned(omega, 2.0 * waves(15.0, (1.0, 1.0, 1.0), 7), noise=0.01)
    truth = of_poses("/truth", poses)
    assert truth is not None
    C = np.eye(3) if up == "+z" else TO_Z_UP[up].T
    q_wxyz = (Rotation.from_matrix(C) * Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True)).as_quat(scalar_first=True)
    found = judge(motion_of(imu), truth._replace(p_wb=1e3 * truth.p_wb @ C.T, q_wb_wxyz=q_wxyz), 1.0)
    assert found.gyro is not None
    assert not found.gyro.sole
    assert found.up == up
    mirrored = Imu(imu.t_ns, imu.gyro * [1.0, 1.0, -1.0], imu.accel)
    assert judge(motion_of(mirrored), truth._replace(p_wb=1e3 * truth.p_wb @ C.T, q_wb_wxyz=q_wxyz), 1.0).up in (None, "+z")


@pytest.mark.parametrize("hz", [1.85, 2.1, 2.3, 2.6])
def test_late_poses_of_a_walking_robot_are_not_a_stride_later(hz: float) -> None:
    """Trot about roll and pitch, its phase wandering, and slow turns: strides are alike."""
    rng = np.random.default_rng(1)
    beat = np.cumsum(2 * np.pi * hz / RATE_HZ + 0.06 * np.sqrt(2 * np.pi * hz / RATE_HZ) * rng.normal(size=60 * RATE_HZ))
    trot = np.stack([0.04 * np.sin(beat + 0.3), 0.03 * np.sin(2 * beat + 1.0) + 0.01 * np.sin(beat)], axis=1)
    omega = np.column_stack([np.gradient(trot, axis=0) * RATE_HZ, waves(60.0, (0.0, 0.0, 0.12))[:, 2]])
    imu, poses = turned(omega)
    truth = of_poses("/truth", poses)
    assert truth is not None
    found = judge(motion_of(imu), truth._replace(t_ns=truth.t_ns + 30_000_000), 1.0)
    assert found.delay is not None
    assert found.delay.seconds == pytest.approx(0.03, abs=0.015)


@pytest.mark.parametrize("seed", range(6))
def test_late_poses_of_a_pendulum_are_not_a_swing_later(seed: int) -> None:
    """Its swings of 3 s are alike but for a small part."""
    t, rng = np.arange(40 * RATE_HZ) / RATE_HZ, np.random.default_rng(seed)
    swing, other = 2.0 * np.sin(2.0 * np.pi / 3.0 * t), 0.03 * rng.normal(size=(2, len(t))).cumsum(axis=1) / RATE_HZ**0.5
    imu, poses = turned(np.column_stack([swing, *other]), noise=0.2)
    truth = of_poses("/truth", poses)
    assert truth is not None
    found = judge(motion_of(imu), truth._replace(t_ns=truth.t_ns + 30_000_000), 1.0)
    assert found.delay is not None
    assert found.delay.seconds == pytest.approx(0.03, abs=0.03)


@pytest.mark.parametrize("seed", range(20))
def test_poses_of_another_motion_have_no_clock_in_common(seed: int) -> None:
    imu, _ = turned(waves(90.0, (0.5, 0.4, 0.6), seed))
    _, poses = turned(waves(70.0, (0.5, 0.4, 0.6), 100 + seed))
    truth = of_poses("/mocap", poses)
    assert truth is not None
    assert judge(motion_of(imu), truth._replace(t_ns=truth.t_ns + 10**12), 1.0).delay is None


NULLS = {
    "rest": (waves(60.0, (0.0, 0.0, 0.0)), None),
    "planar": (waves(60.0, (0.0, 0.0, 0.4)), 1.5 * waves(60.0, (1.0, 1.0, 0.0), 2)),
    "planar on a rough road": (waves(60.0, (0.02, 0.02, 0.4)), 1.5 * waves(60.0, (1.0, 1.0, 0.3), 3)),
}


@pytest.mark.parametrize("tilt_deg", [0.0, 4.0])
@pytest.mark.parametrize("name", NULLS)
@pytest.mark.parametrize("posed", ["truth", "unknown", ""])
def test_rest_and_planar_motion_propose_nothing(name: str, posed: str, tilt_deg: float) -> None:
    omega, a_w = NULLS[name]
    imu, poses = turned(omega, a_w)
    mount = Rotation.from_euler("xy", [tilt_deg, -tilt_deg], degrees=True)
    imu = Imu(imu.t_ns, mount.apply(imu.gyro.copy()), mount.apply(imu.accel.copy()))
    truth = of_poses("/pose", poses) if posed else None
    survey = looked(imu, None if truth is None else truth._replace(kind=posed), fix=True)
    assert not [finding for finding in survey.findings if finding.rule in ("axes", "units")]
    assert (survey.matrices == np.eye(3)).all()


def test_a_car_whose_accelerometer_is_tilted_drives_in_a_world_that_is_z_up() -> None:
    """It stays level, so a mirrored accelerometer in a mirrored world fits as well."""
    imu, poses = turned(waves(60.0, (0.02, 0.02, 0.12), 11), waves(60.0, (0.5, 0.5, 0.0), 21))
    tilted = Imu(imu.t_ns, imu.gyro, imu.accel @ Rotation.from_euler("xy", (3.0, -3.0), degrees=True).as_matrix().T)
    found = judge(motion_of(tilted), of_poses("/ground_truth/pose", poses), 1.0)
    assert (found.up, found.accel) == ("+z", None)


def test_wheel_odometry_of_another_frame_is_no_evidence() -> None:
    """Poses of unknown kind that turn otherwise than the gyro, about one axis: nothing is said of the gyro's axes."""
    imu, poses = turned(waves(60.0, (0.01, 0.01, 0.4)), waves(60.0, (1.0, 1.0, 0.1), 4))
    swapped = Imu(imu.t_ns, imu.gyro[:, [0, 2, 1]], imu.accel)
    truth = of_poses("/odom", poses)
    assert truth is not None
    found = judge(motion_of(swapped), truth._replace(kind="unknown"), 1.0)
    assert found.vertical_m_s2 == pytest.approx(GRAVITY_M_S2, abs=0.1)
    assert found == Conventions("/odom", accel=found.accel, up=found.up, delay=found.delay, vertical_m_s2=found.vertical_m_s2)
    assert found.up in (None, "+z")


@pytest.mark.parametrize("of_gyro", [np.eye(3), PERMUTATIONS[17]])
def test_axes_of_an_accel_that_contradict_the_gyro_are_named_by_poses_without_positions(of_gyro: np.ndarray) -> None:
    """As raw columns in the order of a circuit board: gyro z, x, y, and the accelerometer turned by half a turn about z."""
    imu, poses = turned(waves(60.0, (0.3, 0.3, 0.3)))
    recorded = Imu(imu.t_ns, imu.gyro @ of_gyro, imu.accel * [-1.0, -1.0, 1.0])
    truth = of_poses("/vicon", poses)
    assert truth is not None
    found = judge(motion_of(recorded), truth, 1.0)
    assert found.gyro is not None
    assert found.accel is not None
    np.testing.assert_array_equal(found.gyro.axes, of_gyro)
    np.testing.assert_array_equal(found.accel.axes, np.diag([-1.0, -1.0, 1.0]))
    assert found.up == "+z"
    fixed = looked(recorded, truth, fix=True)
    np.testing.assert_array_equal(fixed.axes, [of_gyro, np.diag([-1.0, -1.0, 1.0])])
    np.testing.assert_array_equal(fixed.world, np.eye(3))


@pytest.mark.parametrize("seed", [2, 3])
def test_inverse_quaternions_are_seen_though_those_as_recorded_share_the_yaw(seed: int) -> None:
    """A drone whose IMU lies on its back: the inverse yaws as its gyro does, and leaves no sure order of the axes."""
    imu, poses = turned(waves(60.0, (0.08, 0.08, 0.45), seed), waves(60.0, (1.0, 1.0, 0.3), 4), noise=0.02)
    back = Imu(imu.t_ns, imu.gyro * [1.0, -1.0, -1.0], imu.accel * [1.0, -1.0, -1.0])
    truth = of_poses("/mocap", poses)
    assert truth is not None
    found = judge(motion_of(back), truth._replace(q_wb_wxyz=truth.q_wb_wxyz * [1.0, -1.0, -1.0, -1.0]), 1.0)
    assert found.quaternions == "are the inverse: they take vectors of the world to the body"
    assert found.gyro is not None
    np.testing.assert_array_equal(found.gyro.axes, np.diag([1.0, -1.0, -1.0]))


def test_level_flight_is_no_evidence_without_poses() -> None:
    """A thrust along z does not turn in the body, whatever the gyro says."""
    imu, _ = turned(waves(60.0, (0.4, 0.4, 0.2)))
    thrust = np.tile([0.0, 0.0, GRAVITY_M_S2], (len(imu), 1)) + 0.2 * np.random.default_rng(2).normal(size=(len(imu), 3))
    assert judge(motion_of(Imu(imu.t_ns, imu.gyro, thrust)), None, 1.0).relative is None


def looked(imu: Imu, truth: Truth | None, *, fix: bool) -> Survey:
    return examine(
        lambda: [batch_of(imu)], truth, CleaningSettings(only=("axes", "units"), fix=fix), where="made", topic="/imu0"
    )


def test_a_delay_just_below_what_is_warned_of_is_corrected() -> None:
    """Commands judge other samples of a log than `fix` does: what they refuse must not be just next to what it leaves."""
    imu, poses = turned(waves(60.0, (0.5, 0.4, 0.6)))
    truth = of_poses("/truth", poses)
    assert truth is not None
    late = truth._replace(t_ns=truth.t_ns + round(0.75 * LATE_S * 1e9))
    told, fixed = (looked(imu, late, fix=fix) for fix in (False, True))
    assert told.pose_delay_ns == 0
    assert fixed.pose_delay_ns == pytest.approx(0.75 * LATE_S * 1e9, abs=6e6)


def test_fix_leads_back_to_the_sensors_that_flew(flown: tuple[Imu, Truth]) -> None:
    imu, truth = flown
    P, Q = PERMUTATIONS[13], PERMUTATIONS[38]
    planted = Imu(imu.t_ns, np.rad2deg(imu.gyro @ P), imu.accel @ Q / FORCES["g"])
    survey = looked(planted, truth, fix=True)
    gyro, accel = survey.matrices
    np.testing.assert_allclose(planted.gyro @ gyro.T, imu.gyro, atol=1e-12)
    np.testing.assert_allclose(planted.accel @ accel.T, imu.accel, atol=1e-12)
    assert survey.verdict == "usable"
    assert not looked(Imu(imu.t_ns, planted.gyro @ gyro.T, planted.accel @ accel.T), truth, fix=True).findings


@pytest.mark.parametrize("late_s", [-1.2, 0.8, 7.0])
def test_the_clock_of_poses_of_a_body_that_turns_on_and_on_is_found(late_s: float) -> None:
    """A drone that flies circles: the median of its gyro is no bias."""
    omega = waves(80.0, (0.06, 0.06, 0.12)) + np.array([0.0, 0.0, -0.4])
    imu, poses = turned(omega)
    truth = of_poses("/ground_truth/pose", Poses(poses.t_ns + round(late_s * 1e9), poses.p_wb, poses.q_wb_wxyz))
    assert truth is not None
    found = judge(motion_of(imu), truth, 1.0)
    assert found.delay is not None
    assert found.delay.seconds == pytest.approx(late_s, abs=0.01)


@pytest.mark.parametrize("up", ["+z", *TO_Z_UP])
def test_gravity_shows_the_world_where_noise_of_positions_hides_the_motion(up: str, flown: tuple[Imu, Truth]) -> None:
    imu, truth = flown
    C = np.eye(3) if up == "+z" else TO_Z_UP[up].T
    rng = np.random.default_rng(3)
    turned_q = (Rotation.from_matrix(C) * Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True)).as_quat(scalar_first=True)
    noisy = truth._replace(p_wb=truth.p_wb @ C.T + 0.1 * rng.normal(size=truth.p_wb.shape), q_wb_wxyz=turned_q)
    found = judge(motion_of(imu), noisy, 1.0)
    assert found.accel is None
    assert found.up == up
    whole = TopicSummary(CleaningSettings(), len(imu), motion_of(imu), noisy)
    said = [finding.what for finding in Axes().findings(whole)]
    assert said == (
        [] if up == "+z" else [f"{said[0].partition(', not')[0]}, not +z, if the accelerometer counts as it should"]
    )


def test_misfits_of_all_readings_at_once_are_those_of_each_and_averages_are_of_the_misfits() -> None:
    rng = np.random.default_rng(1)
    misfits = Misfits(rng.normal(size=(30, 3)), rng.normal(size=(4, 30, 3)), rng.normal(size=(6, 3)))
    triangle = np.array([1.0, 2.0, 1.0]) / 4.0
    for row, (size, averaged) in enumerate(zip(misfits.sizes(0.1), misfits.averaged(2).sizes(0.1), strict=True)):
        each = misfits.of(0.1, row)
        np.testing.assert_array_equal(size, np.linalg.norm(each, axis=1))
        mean = np.stack([np.convolve(column, triangle, mode="valid") for column in each.T], axis=1)
        np.testing.assert_allclose(averaged, np.linalg.norm(mean, axis=1), rtol=0, atol=1e-14)


@pytest.mark.parametrize("axes", [np.diag([1.0, -1.0, 1.0]), PERMUTATIONS[9]], ids=["mirrored", "permuted"])
def test_a_log_that_rests_for_most_of_the_time_shows_the_axes_of_the_gyro(axes: np.ndarray) -> None:
    """A robot's arm moves for three seconds and stops for five."""
    omega = waves(96.0, (0.5, 0.4, 0.6)) * (np.arange(9600) % 800 < 300)[:, None]
    imu, poses = turned(omega)
    truth = of_poses("/ground_truth/pose", poses)
    assert truth is not None
    found = judge(motion_of(Imu(imu.t_ns, imu.gyro @ axes, imu.accel)), truth, 1.0).gyro
    assert found is not None
    assert found.wrong
    assert (found.axes == axes).all()
