"""A start says what was measured and how sure it is; measurement and prior meet by their variances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.bias import linear, static
from imutool.bias.model import BiasModel
from imutool.bias_start import bias_at_rest
from imutool.bias_start.bias_at_rest import at_rest, auto, over_all_rest, rest_differences
from imutool.bias_start.bias_from_truth import TRUTH_S, from_truth, poses_turn_alone
from imutool.bias_start.bias_tracking import Samples
from imutool.bias_start.initial_bias import (
    AT_REST_STD,
    InitialBias,
    NoRestError,
    bias_prior,
    from_numbers,
    prior,
    smoothed_start,
    tracked_from_prior,
)
from imutool.bias_start.model_choice import find_initial_bias
from imutool.bias_start.prior_width import LeastWidth, supported_std, widened
from imutool.errors import ConfigError, DataError
from imutool.inertial.stationary import Blocks, block_statistics
from imutool.inertial.strapdown import dead_reckon
from imutool.recording import GRAVITY_M_S2, Imu, Poses, Recording, seconds
from imutool.sensor.made_up_flight import FlightSettings as Flight
from imutool.sensor.made_up_flight import TriadSettings, flight, trajectory

RATE_HZ = 200.0
NOISE = np.array([2.4e-3] * 3 + [0.03] * 3)  # of a sample: the ADIS16448 at 200 Hz
GYRO_BIAS, ACCEL_BIAS = np.array([0.03, -0.02, 0.01]), np.array([0.15, -0.1, 0.2])
Moves = Callable[[np.ndarray], np.ndarray]


def resting(
    stops: list[tuple[float, float]] | None = None, *, seed: int = 0, duration_s: float = 20.0, tilt: float = 0.3
) -> tuple[Imu, Rotation]:
    """An IMU that is still during the stops and shaken between them, and its attitude; tilts differ from stop to stop."""
    stops = [(0.0, 4.0)] if stops is None else stops
    rng = np.random.default_rng(seed)
    t = np.arange(int(duration_s * RATE_HZ) + 1) / RATE_HZ
    still = np.zeros(len(t), bool)
    which = np.zeros(len(t), int)
    for start, end in stops:
        still |= (t >= start) & (t <= end)
        which += t > end
    shake = np.where(still[:, None], 0.0, np.sin(t[:, None] * np.array([7.0, 9.0, 11.0]) + 1.0))
    attitude = Rotation.from_euler("xy", np.column_stack([tilt * (1 + which), -0.5 * tilt + 0.9 * which]))
    gyro = shake + GYRO_BIAS + NOISE[:3] * rng.normal(size=(len(t), 3))
    up_b = attitude.inv().apply(np.tile([0.0, 0.0, GRAVITY_M_S2], (len(t), 1)))
    accel = up_b + 4.0 * shake + ACCEL_BIAS + NOISE[3:] * rng.normal(size=(len(t), 3))
    t_ns = 10**18 + np.round(t * 1e9).astype(np.int64)
    return Imu(t_ns, gyro, accel), attitude


def blocks_of(imu: Imu) -> Blocks:
    return block_statistics([(imu.t_ns, imu.gyro, imu.accel)], imu.period_s)


def model(mean: float = 0.0, **std: float) -> BiasModel:
    """A static model with a prior of its own."""
    made = static.Model()
    made.prior_mean[:] = mean
    for name, value in std.items():
        made.tensors[name][:] = value
    return made


# ── at rest ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_resting_start_shows_the_gyros_bias_and_the_accelerometers_along_gravity() -> None:
    imu, attitude = resting()
    start = at_rest(static.Model(), imu)
    assert "4." in start.how or "3.9" in start.how
    n = 4.0 * RATE_HZ
    assert np.abs(start.rest[:3] - GYRO_BIAS).max() < 5 * NOISE[0] / np.sqrt(n) + 5e-4  # noise, and the pull of the prior
    up_b = attitude[0].inv().apply([0.0, 0.0, 1.0])
    assert up_b @ start.rest[3:] == pytest.approx(up_b @ ACCEL_BIAS, abs=0.02)  # its other parts tilt |f| in second order
    across = start.rest[3:] - up_b * (up_b @ start.rest[3:])
    assert np.linalg.norm(across) < 0.02, "gravity says nothing about these"
    assert (start.std[:3] < 5e-4).all()
    assert start.std[3:] @ np.abs(up_b) < 0.4
    np.testing.assert_allclose(start.noise, NOISE, rtol=0.1)


def test_it_is_the_kalman_update_of_the_prior() -> None:
    """Against the textbook's matrices: x = x0 + K (z - h(x0)), K = P H^T (H P H^T + R)^-1, P = (I - K H) P."""
    imu, _ = resting()
    made = model(mean=0.01, prior_std=0.02)
    start = at_rest(made, imu)
    (stretch, *_) = bias_at_rest.rest_stretches(imu)
    still = imu.rows(slice(*stretch))
    x = np.full(6, 0.01)
    P = np.eye(6) * 0.02**2
    mean = np.concatenate([still.gyro.mean(axis=0), still.accel.mean(axis=0)])
    force = mean[3:] - x[3:]
    up = force / np.linalg.norm(force)
    H = np.zeros((4, 6))
    H[:3, :3] = np.eye(3)
    H[3, 3:] = up
    z = np.concatenate([mean[:3] - x[:3], [np.linalg.norm(force) - GRAVITY_M_S2]])
    noise = np.concatenate([still.gyro, still.accel], axis=1).std(axis=0)
    R = np.diag(np.concatenate([AT_REST_STD[:3] ** 2 + noise[:3] ** 2 / len(still), AT_REST_STD[3:4] ** 2]))
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    np.testing.assert_allclose(start.rest, x + K @ z, rtol=0, atol=1e-12)
    np.testing.assert_allclose(start.std, np.sqrt(np.diag((np.eye(6) - K @ H) @ P)), rtol=1e-9)


def test_a_prior_that_knows_nothing_gives_way_and_so_does_one_that_rest_rules_out() -> None:
    imu, attitude = resting()
    sure, unsure = (at_rest(model(mean=0.5, prior_std=std), imu) for std in (1e-9, 1e3))
    np.testing.assert_allclose(sure.rest[:3], GYRO_BIAS, atol=5e-4)
    np.testing.assert_allclose(unsure.rest[:3], GYRO_BIAS, atol=5e-4)
    up_b = attitude[0].inv().apply([0.0, 0.0, 1.0])
    assert up_b @ unsure.rest[3:] == pytest.approx(up_b @ ACCEL_BIAS, abs=0.2)


def test_stops_in_several_attitudes_show_the_accelerometer_from_all_sides() -> None:
    stops = [(0.0, 4.0), (6.0, 10.0), (12.0, 16.0), (18.0, 22.0)]
    imu, _ = resting(stops, duration_s=22.0, tilt=0.7)
    one, all_of_them = at_rest(static.Model(), imu), over_all_rest(static.Model(), blocks_of(imu))
    assert np.linalg.norm(all_of_them.rest[3:] - ACCEL_BIAS) < 0.5 * np.linalg.norm(one.rest[3:] - ACCEL_BIAS)
    assert (all_of_them.std <= one.std + 1e-12).all()
    np.testing.assert_allclose(all_of_them.rest[:3], GYRO_BIAS, atol=4e-4)


def test_a_bias_at_rest_is_that_of_the_calm_stops() -> None:
    """A car on a straight road looks like rest, but shakes: its bends were a bias of 10 mrad/s."""
    imu, _ = resting([(0.0, 20.0)], duration_s=20.0)
    t_s = seconds(imu.t_ns, int(imu.t_ns[0]))[:, None]
    shaken = (t_s > 6.0) * (np.sin(2.0 * np.pi * 71.0 * t_s) * [0.03, 0.03, 0.03] + [0.0, 0.0, 0.01])
    start = over_all_rest(static.Model(), blocks_of(replace(imu, gyro=imu.gyro + shaken)))
    np.testing.assert_allclose(start.rest[:3], GYRO_BIAS, atol=1e-3)
    assert start.how.startswith("the calmest 6.")


def test_at_one_sample_a_second_the_calm_is_found_too() -> None:
    """Its blocks of two samples are longer than the seconds that are compared: some had no block, and were warned of."""
    accel = np.tile([0.0, 0.0, GRAVITY_M_S2], (120, 1))
    gyro = np.full((120, 3), 0.01) + 1e-4 * np.random.default_rng(0).standard_normal((120, 3))
    gyro[80:] += 0.02 * (-1.0) ** np.arange(40)[:, None] + 0.005
    start = over_all_rest(static.Model(), blocks_of(Imu(10**9 * np.arange(120), gyro, accel)))
    np.testing.assert_allclose(start.rest[:3], 0.01, atol=1e-4)


def test_a_models_own_part_is_taken_off_first() -> None:
    """At rest the accelerometer's matrix sees gravity: W f is no turn-on bias."""
    imu, _ = resting()
    W = np.diag([0.02, -0.01, 0.03])
    made = linear.Model(tensors={"W.accel": W, "prior_std": np.ones(6)})
    plain = static.Model()
    plain.prior_std[:] = 1.0
    corrected = Imu(imu.t_ns, imu.gyro, imu.accel @ (np.eye(3) - W).T)
    np.testing.assert_allclose(at_rest(made, imu).rest, at_rest(plain, corrected).rest, atol=1e-12)


@pytest.mark.parametrize("stops", [[], [(8.0, 12.0)], [(0.0, 0.9)]])
def test_a_log_that_does_not_start_at_rest_is_refused(stops: list[tuple[float, float]]) -> None:
    imu, _ = resting(stops)
    with pytest.raises(DataError, match=r"the log does not start at rest.*`init=prior`"):
        at_rest(static.Model(), imu)


def test_a_stop_later_in_the_log_serves_a_constant_only() -> None:
    imu, _ = resting([(8.0, 12.0)])
    np.testing.assert_allclose(over_all_rest(static.Model(), blocks_of(imu)).rest[:3], GYRO_BIAS, atol=1e-3)
    imu, _ = resting([])
    with pytest.raises(DataError, match="the log never rests"):
        over_all_rest(static.Model(), blocks_of(imu))


@pytest.mark.parametrize("count", [0, 1, 20])
def test_too_few_samples_are_no_rest(count: int) -> None:
    imu = resting()[0].rows(slice(0, count))
    with pytest.raises(DataError, match="does not start at rest"):
        at_rest(static.Model(), imu)


# ── from the truth ───────────────────────────────────────────────────────────────────────────────────────────────────

PERFECT = TriadSettings(
    noise_density=0.0, walk_density=0.0, typical_bias=0.0, turn_on_bias=0.0, warm_up=0.0, scale=0.0, misalignment_rad=0.0
)
# Exact samples and truth: what is left over 12 s is the rule's second order, 1e-5 rad/s, and 1e-3 m/s² with its tilt.
TRUTH = np.array([5e-5] * 3 + [5e-3] * 3)


@pytest.fixture(scope="module")
def biased() -> Recording:
    """An exact flight with a constant on each axis."""
    settings = msgspec.structs.replace(Flight(gyro=PERFECT, accel=PERFECT), duration_s=12.0, still_s=0.5)
    made = flight(3, settings)
    poses = trajectory(3, settings).poses(made.imu.t_ns)
    imu = Imu(made.imu.t_ns, made.imu.gyro + GYRO_BIAS, made.imu.accel + ACCEL_BIAS)
    return Recording("biased", imu, {"/truth": poses})


def sees_everything() -> BiasModel:
    return model(prior_std=10.0, truth_std=1e-6)


def test_twelve_seconds_of_truth_show_the_bias(biased: Recording) -> None:
    start = from_truth(sees_everything(), biased)
    assert (np.abs(start.rest - np.concatenate([GYRO_BIAS, ACCEL_BIAS])) < TRUTH).all()
    np.testing.assert_allclose(start.std, 1e-6 * TRUTH_S / 12.0, rtol=1e-6)  # less truth than the model's figure is of
    assert start.how == "truth over 12.0 s, ±1e-06 rad/s (0.0043° a minute)"


def test_a_bias_that_turns_by_more_than_half_a_turn_is_found_by_the_truth(biased: Recording) -> None:
    large = np.array([0.0, 0.6, 0.2])  # it was found off by (-0.07, -1.27, -0.56)
    start = from_truth(sees_everything(), replace(biased, imu=replace(biased.imu, gyro=biased.imu.gyro + large)))
    assert (np.abs(start.rest[:3] - GYRO_BIAS - large) < TRUTH[:3]).all()


@pytest.mark.parametrize("late_s", [0.02, -0.025])
def test_poses_that_are_late_give_the_start_of_poses_that_are_not(late_s: float) -> None:
    """30 ms cost 7e-4 rad/s on V1_02, three of the deviations that were stated."""
    made = flight(3, duration_s=40.0)
    late = replace(made.truth, t_ns=made.truth.t_ns + round(late_s * 1e9))
    right, start = (from_truth(sees_everything(), replace(made, truths={"/truth": truth})) for truth in (made.truth, late))
    assert np.abs(start.rest - right.rest)[:3].max() < 2e-4
    assert f"of poses {abs(late_s) * 1e3:.0f} ms {'late' if late_s > 0 else 'early'}" in start.how
    assert "late" not in right.how


@pytest.mark.parametrize("turn", [0.05, -0.06])
def test_a_body_of_poses_that_is_turned_against_the_sensor_is_no_bias_of_the_gyro(biased: Recording, turn: float) -> None:
    """Markers are meant to be straight, and are off by some degrees, also against those of the training logs."""
    truth = biased.truth
    q = Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True) * Rotation.from_rotvec([turn, 0.0, -0.4 * turn])
    mounted = replace(biased, truths={"/truth": Poses(truth.t_ns, truth.p_wb, q.as_quat(scalar_first=True))})
    trained = sees_everything()
    trained.card = {"logs": [{}]}
    for model in (sees_everything(), trained):
        off = from_truth(model, mounted).rest[:3] - GYRO_BIAS
        assert np.abs(off).max() < 2e-3  # 0.01 rad/s and more without


@pytest.mark.parametrize("what", ["clipped", "lost", "poses that jump"])
def test_what_the_gyro_does_not_show_is_no_bias(biased: Recording, what: str) -> None:
    """Each leaves an error of ten degrees and more to the end of the path; it was taken for a drift."""
    t = seconds(biased.imu.t_ns, int(biased.imu.t_ns[0]))
    fast = int(np.argmax(np.abs(biased.imu.gyro[: len(t) // 2, 0])))
    near = np.abs(t - t[fast]) < 0.5
    imu, truth = biased.imu, biased.truth
    if what == "clipped":
        maximum = 0.7 * np.abs(imu.gyro[:, 0]).max()
        imu = Imu(imu.t_ns, np.column_stack([imu.gyro[:, 0].clip(-maximum, maximum), imu.gyro[:, 1:]]), imu.accel)
    elif what == "lost":
        imu = imu.rows(~near)
    else:
        q = Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True)
        jumped = Rotation.from_rotvec((t > t[fast])[:, None] * [0.0, 0.3, 0.2]) * q
        truth = Poses(truth.t_ns, truth.p_wb, jumped.as_quat(scalar_first=True), truth.v_w)
    start = from_truth(sees_everything(), replace(biased, imu=imu, truths={"/truth": truth}))
    assert np.abs(start.rest[:3] - GYRO_BIAS).max() < 2e-3


def test_poses_that_jump_and_are_back_at_once_are_no_bias(biased: Recording) -> None:
    """One step of the comparison shows the jump, those next to it half of it: what is left out has to be the whole."""
    t = seconds(biased.truth.t_ns, int(biased.imu.t_ns[0]))
    away = np.radians(3.5) * np.interp(t, [8.0, 8.1, 8.2, 8.3], [0.0, -1.0, 1.0, 0.0])[:, None] * [0.6, 0.0, 0.8]
    turned = (Rotation.from_quat(biased.truth.q_wb_wxyz, scalar_first=True) * Rotation.from_rotvec(away)).as_quat(
        scalar_first=True
    )
    jumped = replace(biased.truth, q_wb_wxyz=np.ascontiguousarray(turned))
    right, start = (
        from_truth(sees_everything(), replace(biased, truths={"/truth": truth})) for truth in (biased.truth, jumped)
    )
    np.testing.assert_allclose(start.rest[:3], right.rest[:3], atol=3e-4)


def test_poses_that_are_wrong_and_then_hidden_for_a_second_are_no_bias(biased: Recording) -> None:
    """Only the jump to the wrong pose was left out and not that back: a phone had 125° where its raw samples had 2°."""
    t = seconds(biased.truth.t_ns, int(biased.imu.t_ns[0]))
    away = np.radians(40.0) * ((t > 7.9) & (t < 8.1))[:, None] * [0.6, 0.0, 0.8]
    turned = Rotation.from_quat(biased.truth.q_wb_wxyz, scalar_first=True) * Rotation.from_rotvec(away)
    jumped = replace(biased.truth, q_wb_wxyz=turned.as_quat(scalar_first=True)).rows((t < 8.1) | (t > 9.3))
    right, start = (
        from_truth(sees_everything(), replace(biased, truths={"/truth": truth})) for truth in (biased.truth, jumped)
    )
    np.testing.assert_allclose(start.rest[:3], right.rest[:3], atol=1e-3)


def test_a_fast_turn_while_poses_are_hidden_is_shown_by_a_gyro_of_another_scale() -> None:
    """5 % of 150° are more than poses jump by, and no more than such a gyro errs by."""
    t = np.arange(0.0, 5.0, 0.005)
    turning, t_ns = (t > 2.0) & (t < 3.5), np.round(1e9 * t).astype(np.int64)
    rate = np.radians(100.0) * turning
    turn = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * 0.005)])
    q_wb = Rotation.from_rotvec(turn[:, None] * [0.0, 0.0, 1.0]).as_quat(scalar_first=True)
    poses = Poses(t_ns, np.zeros((len(t), 3)), q_wb).rows(~turning)
    for scale, alone in ((1.05, False), (0.5, True)):
        imu = Imu(t_ns, scale * rate[:, None] * [0.0, 0.0, 1.0], np.tile([0.0, 0.0, GRAVITY_M_S2], (len(t), 1)))
        assert poses_turn_alone(imu, poses).any() == alone


def test_poses_whose_parts_disagree_are_trusted_less(biased: Recording) -> None:
    """The world of the poses leans to and fro by six degrees, slowly."""
    t = seconds(biased.truth.t_ns, int(biased.imu.t_ns[0]))
    lean = np.radians(6.0) * np.sin(2.0 * np.pi * t / 8.0)[:, None] * [1.0, 0.0, 0.0]
    leaning = (Rotation.from_rotvec(lean) * Rotation.from_quat(biased.truth.q_wb_wxyz, scalar_first=True)).as_quat(
        scalar_first=True
    )
    worse = replace(biased.truth, q_wb_wxyz=np.ascontiguousarray(leaning))
    usual = model(mean=0.0, prior_std=0.03, truth_std=1e-3)
    sound, doubted = (from_truth(usual, replace(biased, truths={"/truth": truth})) for truth in (biased.truth, worse))
    assert sound.std[:3].max() < 1.3e-3  # 12 s instead of 15
    off = np.abs(doubted.rest[:3] - GYRO_BIAS)
    assert off.max() > 3.0 * sound.std[:3].max()  # what was stated before
    assert (off < 3.0 * doubted.std[:3]).all()
    assert "thirds contradict each other" in doubted.how
    assert "contradict" not in sound.how


@pytest.mark.parametrize("scale_std", [1e-3, 0.05])
def test_a_scale_that_the_model_does_not_know_is_no_fault_of_the_poses(biased: Recording, scale_std: float) -> None:
    """A model of a minute that turned one way: each third of a start turns otherwise, and the poses had the blame."""
    tensors = {"prior_std": np.full(6, 0.03), "truth_std": np.full(6, 1e-4), "covariance.gyro": scale_std**2 * np.eye(9)}
    fitted = linear.Model(linear.Config(covariance=True), RATE_HZ, tensors)
    imu = replace(biased.imu, gyro=1.04 * biased.imu.gyro)
    how = from_truth(fitted, replace(biased, imu=imu)).how
    assert ("thirds contradict each other" in how) == (scale_std < 0.01)


SPOILED = {
    "late": ("late|explain", lambda poses: replace(poses, t_ns=poses.t_ns + 300_000_000)),
    "frozen": ("explain 0%", lambda poses: replace(poses, q_wb_wxyz=np.repeat(poses.q_wb_wxyz[:1], len(poses), axis=0))),
    "turned": (
        "is turned by 20°",
        lambda poses: replace(
            poses,
            q_wb_wxyz=(Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True) * Rotation.from_rotvec([0.35, 0, 0])).as_quat(
                scalar_first=True
            ),
        ),
    ),
}


@pytest.mark.parametrize("how", SPOILED)
def test_poses_that_contradict_the_gyro_give_no_start(how: str, biased: Recording) -> None:
    """Their bias would be wrong by some degrees a second, with a deviation of 0.02°/s."""
    said, spoil = SPOILED[how]
    with pytest.raises(DataError, match=said):
        from_truth(sees_everything(), replace(biased, truths={"/truth": spoil(biased.truth)}))


def test_after_the_truth_the_rest_bias_is_followed_from_what_it_showed() -> None:
    """Four seconds of truth, and a stop after which the gyro is another; the start itself knows nothing of that."""
    imu, attitude = resting([(5.0, 15.0)])
    debiased = Imu(imu.t_ns, imu.gyro - GYRO_BIAS, imu.accel - ACCEL_BIAS)
    poses = dead_reckon(debiased, (attitude[0].as_quat(scalar_first=True), np.zeros(3), np.zeros(3)))
    truth = {"/truth": poses.rows(slice(0, int(4 * RATE_HZ) + 1))}
    moved = np.where(np.arange(len(imu))[:, None] >= 5 * RATE_HZ, [2e-3, 0.0, 0.0], 0.0)
    made = trained(prior_std=0.05, truth_std=1e-4)
    before, after = (from_truth(made, Recording("one", Imu(imu.t_ns, imu.gyro + x, imu.accel), truth)) for x in (0.0, moved))
    np.testing.assert_allclose(before.rest, after.rest, rtol=1e-12)
    assert after.how.endswith("then gravity in motion and every stop")
    bias = after.stream(made)(*samples(Imu(imu.t_ns, imu.gyro + moved, imu.accel)))
    held = int(after.hold_s * RATE_HZ)
    np.testing.assert_array_equal(bias[:held], np.tile(after.rest, (held, 1)))
    assert held == int(4 * RATE_HZ)
    np.testing.assert_allclose(bias[int(15 * RATE_HZ), :3], GYRO_BIAS + np.array([2e-3, 0.0, 0.0]), atol=5e-4)


def test_a_truth_whose_world_leans_is_believed_beside_itself_and_not_beside_gravity(biased: Recording) -> None:
    """A motion capture set up askew by half a degree: a tenth of m/s² that the accelerometer has not got."""
    lean = Rotation.from_rotvec([0.009, 0.0, 0.0])
    truth = biased.truth
    assert truth.v_w is not None
    q = (lean * Rotation.from_quat(np.array(truth.q_wb_wxyz), scalar_first=True)).as_quat(scalar_first=True)
    askew = replace(truth, q_wb_wxyz=q, p_wb=lean.apply(np.array(truth.p_wb)), v_w=lean.apply(np.array(truth.v_w)))
    made = trained(mean=0.0, prior_std=0.02, truth_std=1e-3)
    made.prior_mean[:] = np.concatenate([GYRO_BIAS, ACCEL_BIAS])
    upright, leaning = (from_truth(made, replace(biased, truths={"/truth": one})) for one in (truth, askew))
    assert upright.follows is not None
    assert leaning.follows is not None
    assert np.linalg.norm(leaning.rest[3:] - upright.rest[3:]) > 0.02
    np.testing.assert_allclose(leaning.rest[:3], upright.rest[:3], atol=1e-6)
    np.testing.assert_allclose(leaning.follows.mean[3:], ACCEL_BIAS, atol=0.005)
    np.testing.assert_allclose(leaning.follows.mean[:3], leaning.rest[:3], rtol=1e-12)
    assert (leaning.follows.std[3:] > leaning.std[3:]).all()


def test_a_shorter_truth_can_be_asked_for(biased: Recording) -> None:
    start = find_initial_bias("truth:4", sees_everything(), biased)
    assert (np.abs(start.rest - np.concatenate([GYRO_BIAS, ACCEL_BIAS])) < TRUTH).all()
    assert start.how == "truth over 4.0 s, ±4e-06 rad/s (0.013° a minute)"
    np.testing.assert_allclose(start.std, 1e-6 * TRUTH_S / 4.0, rtol=1e-6)
    for word in ("truth:0", "truth:nan", "truth:five"):
        with pytest.raises(ConfigError, match="truth:SECONDS"):
            find_initial_bias(word, sees_everything(), biased)


def test_truth_and_prior_meet_by_their_variances(biased: Recording) -> None:
    """Equal variances: half-way; a model sure of its prior (or of nothing else) keeps to it."""
    full = from_truth(sees_everything(), biased)
    half = from_truth(model(prior_std=0.1, truth_std=0.1 * 12.0 / TRUTH_S), biased)
    np.testing.assert_allclose(half.rest, 0.5 * full.rest, rtol=1e-6)
    np.testing.assert_allclose(half.std, 0.1 / np.sqrt(2), rtol=1e-12)
    for truth_std in (1.0, 0.0):
        kept = from_truth(model(mean=0.2, prior_std=0.0, truth_std=truth_std), biased)
        np.testing.assert_allclose(kept.rest, 0.2)
        np.testing.assert_array_equal(kept.std, 0.0)


def test_the_models_own_part_is_taken_off_the_samples_first(biased: Recording) -> None:
    W = np.array([[0.02, 0.01, 0.0], [0.0, -0.02, 0.005], [0.01, 0.0, 0.01]])
    made = linear.Model(tensors={"W.gyro": W, "prior_std": np.full(6, 10.0), "truth_std": np.full(6, 1e-6)})
    measured = np.linalg.solve(np.eye(3) - W, biased.imu.gyro.T).T  # then (I - W) u - rest is true again
    start = from_truth(made, replace(biased, imu=Imu(biased.imu.t_ns, measured, biased.imu.accel)))
    assert (np.abs(start.rest - np.concatenate([GYRO_BIAS, ACCEL_BIAS])) < TRUTH).all()


def test_a_gap_in_the_truth_does_no_harm(biased: Recording) -> None:
    t_s = (biased.truth.t_ns - biased.truth.t_ns[0]) * 1e-9
    holed = replace(biased, truths={"/truth": biased.truth.rows((t_s < 1.0) | (t_s > 4.0))})
    start = from_truth(sees_everything(), holed)
    assert (np.abs(start.rest - np.concatenate([GYRO_BIAS, ACCEL_BIAS])) < TRUTH).all()


def test_a_truth_without_velocity_gets_one(biased: Recording) -> None:
    bare = replace(biased, truths={"/truth": replace(biased.truth, v_w=None)})
    start = from_truth(sees_everything(), bare)
    assert (np.abs(start.rest[:3] - GYRO_BIAS) < TRUTH[:3]).all()
    assert (np.abs(start.rest[3:] - ACCEL_BIAS) < 0.05).all()  # a derived velocity is good to 0.1 m/s at the ends: over 5 s


def test_a_truth_that_is_not_there_or_too_short_is_refused(biased: Recording) -> None:
    with pytest.raises(DataError, match="biased: no true poses"):
        from_truth(static.Model(), replace(biased, truths={}))
    begin = int(biased.imu.t_ns[0])
    short: Poses = biased.truth.between(begin, begin + 900_000_000)
    with pytest.raises(DataError, match=r"biased: 0\.9 s of truth"):
        from_truth(static.Model(), replace(biased, truths={"/truth": short}))


# ── followed, and from the whole log ─────────────────────────────────────────────────────────────────────────────────


def trained(logs: int = 6, **std: float) -> BiasModel:
    made = model(**std)
    made.card = {"name": "m", "logs": [{}] * logs}
    return made


def samples(imu: Imu) -> Samples:
    return seconds(imu.t_ns, int(imu.t_ns[0])), imu.gyro, imu.accel


def test_auto_is_the_stop_the_log_begins_with_and_says_how_sure() -> None:
    imu, _ = resting()
    start = auto(trained(prior_std=0.05), imu)
    np.testing.assert_allclose(start.rest[:3], GYRO_BIAS, atol=5e-4)
    found = "4.0 s at rest from 0.0 s on, prior of 6 logs, ±0.0002 rad/s (0.61° a minute)"
    assert start.how == f"{found}, then gravity in motion and every stop"
    assert (start.hold_s, start.follows, start.track) == (pytest.approx(4.0, abs=0.01), start.follows, None)
    assert start.follows is not None
    assert (start.follows.std[:3] == 0.05).all(), "from what was known before that stop"
    np.testing.assert_allclose(start.noise[:3], NOISE[:3], rtol=0.3)


def test_only_the_first_stop_makes_the_start() -> None:
    """Later samples, in motion or at rest again, change nothing in it."""
    imu, _ = resting([(0.0, 4.0), (10.0, 15.0)])
    other = Imu(imu.t_ns, np.where(np.arange(len(imu))[:, None] < 900, imu.gyro, 0.3), imu.accel)
    one, two = auto(trained(), imu), auto(trained(), other)
    np.testing.assert_array_equal(one.rest, two.rest)
    np.testing.assert_array_equal(one.std, two.std)


def test_during_that_stop_its_samples_get_what_the_whole_of_it_says() -> None:
    imu, _ = resting()
    made = trained(prior_std=0.05)
    start = auto(made, imu)
    bias = start.stream(made)(*samples(imu))
    still = int(start.hold_s * RATE_HZ)
    np.testing.assert_array_equal(bias[:still], np.tile(start.rest, (still, 1)))
    assert len(np.unique(bias[still + 200 :, 0])) > 5, "and then it is followed"


def test_an_untrained_model_has_no_prior_to_follow_from() -> None:
    with pytest.raises(DataError, match="the log does not start at rest"):
        auto(static.Model(), resting([])[0])


def test_the_whole_log_is_surer_than_its_start_and_later_stops_count() -> None:
    imu, _ = resting([(12.0, 18.0)])
    made = trained(prior_std=0.02)
    start = smoothed_start(made, [samples(imu)], bias_prior(made))
    assert start.track is not None
    assert start.how.startswith(("5.", "6."))
    assert "s at rest in all, gravity in motion, prior of 6 logs, ±0.000" in start.how
    np.testing.assert_allclose(start.track.at(np.array([11.0, 14.0]))[:, :3], np.tile(GYRO_BIAS, (2, 1)), atol=1.5e-3)
    assert (start.std[:3] < 0.2 * prior(made).std[:3]).all()


def test_smoothing_needs_something_to_go_by() -> None:
    imu, _ = resting([])
    with pytest.raises(NoRestError, match="here: the log never rests"):
        smoothed_start(static.Model(), [samples(imu)], bias_prior(static.Model()), "here")
    wide = smoothed_start(made := trained(prior_std=0.05), [samples(imu)], bias_prior(made))
    assert wide.std[:3].max() > 1e-4
    with pytest.raises(DataError, match="too short to be smoothed"):
        smoothed_start(made := trained(), [samples(imu.rows(slice(0, 20)))], bias_prior(made))


def test_the_bias_of_every_stop_is_compared_with_the_bias_in_motion() -> None:
    away = np.array([2e-3, -5e-4, 0.0])
    imu, _ = resting([(0.0, 4.0), (15.0, 20.0)])
    own = np.concatenate([GYRO_BIAS - away, ACCEL_BIAS])
    stopping, moving = rest_differences(static.Model(), [samples(imu), samples(resting([])[0])], np.array([own, own]))
    np.testing.assert_allclose(stopping[:, :3], np.tile(away, (2, 1)), atol=2.5e-4)
    assert moving.shape == (0, 6)


# ── a prior that the log contradicts ───────────────────────────────────────────────────────────────────────────────


def test_a_prior_that_the_log_contradicts_gives_way_and_one_that_it_bears_out_stays() -> None:
    std = np.array([5e-4] * 3 + [0.02] * 3)
    variance = np.array([1e-8] * 3 + [np.inf] * 3)
    near, far = np.full(6, 1e-3), np.array([0.0, 0.0, 9e-3, 5.0, 5.0, 5.0])
    np.testing.assert_array_equal(widened(std, near, variance), std)
    wide = widened(std, far, variance)
    np.testing.assert_allclose(wide[:3], 9e-3 / np.sqrt(3))
    np.testing.assert_array_equal(wide[3:], std[3:], "nothing was shown of the accelerometer")
    of_one_axis = np.array([np.inf, np.inf, 1e-8] + [np.inf] * 3)
    np.testing.assert_allclose(widened(std, far, of_one_axis)[:3], 9e-3)


def test_two_axes_that_repeat_speak_for_the_third_and_a_large_change_is_believed() -> None:
    minimum, maximum = LeastWidth(np.array([5e-4] * 3 + [0.02] * 3)), np.array([7e-3] * 3 + [0.15] * 3)
    variance = np.array([4e-4, 4e-4, 5e-3] + [np.inf] * 3) ** 2
    repeats = supported_std(maximum, minimum, np.array([3e-4, -2e-4, -7e-3, 0.0, 0.0, 0.0]), variance)
    assert (repeats[:3] < 2 * minimum.std[:3]).all(), "the third axis shows 7 mrad/s with a deviation of 5"
    np.testing.assert_allclose(
        repeats[3:], np.sqrt(minimum.std * maximum)[3:]
    )  # nothing shown of the accelerometer: the middle
    changed = supported_std(maximum, minimum, np.array([6e-3, -8e-3, -7e-3, 0.0, 0.0, 0.0]), variance)
    assert (changed[:3] > 0.6 * maximum[:3]).all()
    np.testing.assert_array_equal(supported_std(maximum, None, np.zeros(6), variance), maximum)
    same = supported_std(maximum, minimum._replace(probability=1.0), np.array([6e-3, -8e-3, -7e-3, 0.0, 0.0, 0.0]), variance)
    np.testing.assert_allclose(same[3:], minimum.std[3:])


@pytest.mark.parametrize("start", ["auto", "stationary", "smooth"])
def test_a_long_rest_outweighs_the_prior_of_another_switching_on(start: str) -> None:
    imu, _ = resting([(0.0, 6.0), (20.0, 26.0)])
    made = trained(mean=0.03, prior_std=5e-4)
    if start == "smooth":
        found = smoothed_start(made, [samples(imu)], bias_prior(made))
    else:
        found = auto(made, imu) if start == "auto" else at_rest(made, imu)
    np.testing.assert_allclose(found.rest[:3], GYRO_BIAS, atol=3e-4)


@pytest.mark.parametrize("rest_s", np.arange(1.0, 3.0, 0.125).tolist())
def test_a_short_rest_against_the_prior_gives_a_start_whatever_its_length(rest_s: float) -> None:
    imu, _ = resting([(0.0, rest_s)], duration_s=4.0)
    start = auto(trained(mean=0.03, prior_std=5e-4), imu)
    assert np.isfinite(start.rest).all()
    assert (start.std > 0).all()


def test_a_log_of_a_session_that_training_saw_starts_from_its_prior() -> None:
    made = model(mean=0.3, prior_std=0.2)
    hour = 3600 * 10**9
    session = {"start_ns": 100 * hour, "end_ns": 101 * hour, "mean": [0.1] * 6, "std": [1e-3] * 6}
    made.card = {"sessions": [session, session | {"start_ns": 130 * hour, "end_ns": 131 * hour, "mean": [0.2] * 6}]}
    assert prior(made, 104 * hour).rest[0] == 0.1
    assert prior(made, 128 * hour).rest[0] == 0.2
    assert prior(made, 115 * hour).rest[0] == pytest.approx(0.3)
    np.testing.assert_array_equal(bias_prior(made, 104 * hour).std, [0.2] * 6)  # it may have been switched on again
    minimum = bias_prior(made, 104 * hour).minimum
    assert minimum is not None
    np.testing.assert_array_equal(minimum.std, [1e-3] * 6)
    assert 0.0 < minimum.probability < 1.0
    assert 1e-3 < tracked_from_prior(made, 104 * hour).std[0] < 0.1, "before the log shows anything: over all widths"
    assert tracked_from_prior(made, 115 * hour).std[0] == pytest.approx(0.2)


@pytest.mark.parametrize("moved", [0.0, 6e-3])
def test_a_sensor_switched_on_again_within_a_sessions_hours_is_not_held_to_its_bias(moved: float) -> None:
    settings = Flight(gyro=PERFECT, accel=PERFECT, duration_s=30.0, still_s=0.0, room_m=1.0, position_knot_s=1.5)
    exact, noise = flight(4, settings).imu, NOISE * np.random.default_rng(4).normal(size=(6001, 6))
    imu = Imu(exact.t_ns, exact.gyro + GYRO_BIAS + noise[:, :3], exact.accel + ACCEL_BIAS + noise[:, 3:])
    made, first_ns = trained(prior_std=5e-3), int(imu.t_ns[0])
    mean = np.concatenate([GYRO_BIAS + np.array([moved, -moved, moved]), ACCEL_BIAS])
    std = [8e-4] * 3 + [1e-2] * 3
    made.card |= {"sessions": [{"start_ns": first_ns, "end_ns": first_ns, "mean": mean.tolist(), "std": std}]}
    found = auto(made, imu).estimator(made).estimate(*samples(imu))
    off = found.bias[:, :3] - GYRO_BIAS
    assert np.abs(off[-1]).max() < 2e-3
    assert ((off / np.sqrt(found.covariance[:, range(3), range(3)])) ** 2).mean() < 3.0**2


def test_a_model_that_says_how_rest_differs_is_believed() -> None:
    made = trained(prior_std=3e-3)
    before = auto(made, resting()[0])
    made.rest_std[:] = [2e-3] * 3 + [0.03] * 3
    np.testing.assert_allclose(bias_prior(made).ground_std[:3], 2e-3)
    after = auto(made, resting()[0])
    assert (after.std[:3] > 5 * before.std[:3]).all(), "in motion it is less sure"
    np.testing.assert_allclose(after.rest[:3], before.rest[:3], atol=3e-4)  # at rest it is what it is


# ── methods of `init` ──────────────────────────────────────────────────────────────────────────────────────────────


def test_the_prior_is_what_the_training_runs_had() -> None:
    start = prior(model(mean=0.3, prior_std=0.2))
    assert (start.rest.tolist(), start.how) == ([pytest.approx(0.3)] * 6, "prior of the training logs")
    np.testing.assert_allclose(start.std, 0.2)


def test_six_numbers_are_taken_as_they_are() -> None:
    start = from_numbers("0.01,-2e-3,0, 1 ,2.5,-3")
    assert start.rest.tolist() == [0.01, -2e-3, 0.0, 1.0, 2.5, -3.0]
    assert not start.std.any()
    assert start.how == "given"


@pytest.mark.parametrize(
    "text",
    ["", "1,2,3", "1,2,3,4,5,6,7", "a,b,c,d,e,f", "nan,0,0,0,0,0", "0,0,0,inf,0,0", "Truth", "stationery", "1;2;3;4;5;6"],
)
def test_other_words_are_refused_with_what_there_is(text: str) -> None:
    imu, _ = resting()
    with pytest.raises(
        ConfigError, match=r"init: .*expected auto, stationary, prior, truth, truth:SECONDS or gx,gy,gz,ax,ay,az"
    ):
        find_initial_bias(text, static.Model(), Recording("r", imu))


def test_each_word_finds_its_way(biased: Recording) -> None:
    imu, _ = resting()
    still, trained = Recording("still", imu), static.Model()
    trained.card = {"name": "trained"}
    moving = Recording("moving", resting([])[0])
    how = {way: find_initial_bias(way, trained, still).how for way in ("auto", "stationary", "prior", "1,2,3,4,5,6")}
    assert "at rest" in how["auto"]
    assert how["auto"].startswith("4.0 s at rest from 0.0 s on, prior of the training logs, ±")
    assert how["1,2,3,4,5,6"] == "given"
    assert find_initial_bias("truth", trained, biased).how.startswith("truth over 12.0 s, weighed against the training logs, ±")
    assert find_initial_bias("auto", trained, moving).how.startswith(
        "prior of the training logs, ±0.05 rad/s (170° a minute), then gravity in motion"
    )
    with pytest.raises(DataError, match="does not start at rest"):
        find_initial_bias("stationary", trained, moving)
    with pytest.raises(DataError, match="does not start at rest"):
        find_initial_bias("auto", static.Model(), moving)  # no training logs, no prior to fall back on
    assert find_initial_bias("prior", static.Model(), moving).how == "zero, as an untrained model has no prior"


@pytest.mark.parametrize("way", ["auto", "stationary", "truth"])
def test_samples_without_specific_force_are_no_start(biased: Recording, way: str) -> None:
    """As a driver sends them until the accelerometer runs; a log has none of them, an array may."""
    whole = biased if way == "truth" else Recording("still", resting([(0.0, 12.0)])[0])
    begun, imu = round((2.0 if way == "truth" else 6.0) * RATE_HZ), whole.imu
    silent = np.where(np.arange(len(imu))[:, None] < begun, 0.0, imu.accel)
    given, cut = (replace(whole, imu=part) for part in (replace(imu, accel=silent), imu.rows(slice(begun, None))))
    found, expected = (find_initial_bias(way, trained(prior_std=0.05, truth_std=1e-3), part) for part in (given, cut))
    for name in ("rest", "std", "noise"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert (found.how, found.hold_s) == (expected.how, expected.hold_s)


def test_a_start_does_not_share_memory_with_the_model() -> None:
    made = model(mean=0.1)
    start = prior(made)
    start.rest[:] = 9.0
    assert isinstance(start, InitialBias)
    assert prior(made).rest.tolist() == [pytest.approx(0.1)] * 6


def test_a_bias_that_warms_up_during_the_first_stop_is_followed_there() -> None:
    """The bias at the end of a stop of 20 s was that of all of it."""
    rng, t_s = np.random.default_rng(0), np.arange(0.0, 24.0, 0.01)
    drift = 0.01 * np.minimum(t_s, 20.0)[:, None] / 20.0 * [1.0, -0.7, 0.5]
    gyro = drift + 1e-3 * rng.normal(size=(len(t_s), 3)) + np.where(t_s > 20.0, np.sin(3.0 * t_s), 0.0)[:, None]
    imu = Imu((1e9 * t_s).astype(np.int64), gyro, [0.0, 0.0, GRAVITY_M_S2] + 0.01 * rng.normal(size=gyro.shape))
    model = static.Model()
    bias = auto(model, imu).stream(model)(t_s, imu.gyro, imu.accel)
    assert np.abs(bias[:, :3] - drift)[t_s < 19.0].max() < 1e-3
