"""Planted biases are found, as surely as it says; nothing later changes what came before; smoothing sees the end."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.nees import consistency

from imutool.bias import static
from imutool.bias.model import BiasModel
from imutool.bias_start.bias_at_rest import auto
from imutool.bias_start.bias_tracking import (
    CHUNK_S,
    BiasFilter,
    BiasTrajectory,
    FilteredBlock,
    TrackedBiasStream,
    filter_blocks,
    filter_together,
    smooth_blocks,
)
from imutool.bias_start.initial_bias import bias_prior, smooth_bias
from imutool.bias_start.prior_width import BiasPrior, LeastWidth, shown_bias, supported_std
from imutool.inertial import inertial_filter
from imutool.inertial.inertial_filter import FilterSettings
from imutool.recording import Imu, seconds
from imutool.sensor.made_up_flight import FlightSettings, TriadSettings, flight

Filtered = Callable[[int, float], list[FilteredBlock]]
RATE_HZ = 200.0
PRIOR = np.array([3e-3] * 3 + [0.1] * 3)
GROUND = np.array([1e-3] * 3 + [0.03] * 3)
SENSOR = {
    "gyro": TriadSettings(
        noise_density=2e-4, walk_density=0.0, typical_bias=0.0, turn_on_bias=0.0, warm_up=0.0, scale=0.0, misalignment_rad=0.0
    ),
    "accel": TriadSettings(
        noise_density=2e-3, walk_density=0.0, typical_bias=0.0, turn_on_bias=0.0, warm_up=0.0, scale=0.0, misalignment_rad=0.0
    ),
}
SETTINGS = FlightSettings(**SENSOR, room_m=0.6, position_knot_s=0.9, tilt_rad=0.25)  # speeds of about 1 m/s
KNOWN = BiasPrior(np.zeros(6), PRIOR, GROUND)
NOTHING_HELD = BiasTrajectory(np.zeros(1), np.zeros((1, 6)), np.tile(PRIOR, (1, 1)))
SEEDS = range(12)
SAME = 1e-11  # sums of products of order one, in another order
BOUND = 0.999  # of chi-square: one run of this suite in a thousand would fail by chance, were the seeds not fixed


def planted(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A run's bias in motion, and what is added at rest."""
    rng = np.random.default_rng([7, seed])
    return PRIOR * rng.normal(size=6), GROUND * rng.normal(size=6) * np.array([1, 1, 1, 0, 0, 0])


def biased(seed: int, *, duration_s: float = 60.0, still_s: float = 0.0, backwards: bool = False) -> Imu:
    """A flight with planted biases: still at its start, or, flown backwards, at its end."""
    made = flight(seed, SETTINGS, duration_s=duration_s, still_s=still_s).imu
    bias, ground = planted(seed)
    gyro, accel = made.gyro.copy(), made.accel.copy()
    resting = (seconds(made.t_ns, int(made.t_ns[0])) < still_s)[:, None]
    if backwards:  # time reversed: rates change sign, forces do not
        gyro, accel, resting = -gyro[::-1], accel[::-1], resting[::-1]
    both = bias + resting * ground
    return Imu(made.t_ns, gyro + both[:, :3], accel + both[:, 3:])


def samples(imu: Imu) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return seconds(imu.t_ns, int(imu.t_ns[0])), imu.gyro, imu.accel


def model() -> BiasModel:
    return static.Model()


def forward(imu: Imu, known: BiasPrior = KNOWN) -> list[FilteredBlock]:
    return list(filter_blocks(model(), [samples(imu)], known))


@pytest.fixture(scope="module")
def filtered() -> Filtered:
    """Blocks of the flight of a seed with planted biases, still for some seconds at its start; each is filtered once."""
    return functools.cache(lambda seed, still_s: forward(biased(seed, still_s=still_s)))


# ── what it finds ────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("still_s", [0.0, 5.0])
def test_planted_biases_are_found_within_three_of_its_standard_deviations(filtered: Filtered, still_s: float) -> None:
    for seed in (1, 2, 3):
        last = filtered(seed, still_s)[-1].step.after
        bias, _ = planted(seed)
        std = np.sqrt(np.diag(last.P)[9:15])
        assert (np.abs(last.bias - bias) < 3 * std).all()
        assert (std[:3] < 0.7 * PRIOR[:3]).any(), "gravity in motion has shown something"


@pytest.mark.parametrize("still_s", [0.0, 5.0])
@pytest.mark.parametrize("way", ["forward", "smooth"])
def test_it_is_as_sure_as_it_should_be(filtered: Filtered, still_s: float, way: str) -> None:
    """Never overconfident. The biases planted do not walk, so that it may be surer than it says."""
    errors, covariances = [], []
    for seed in SEEDS:
        blocks = filtered(seed, still_s)
        state = blocks[-1].step.after if way == "forward" else [s for _, s in smooth_blocks(blocks)][len(blocks) // 2]
        errors.append((state.bias - planted(seed)[0])[:3])
        covariances.append(state.P[9:12, 9:12])
    found = consistency(np.array(errors), np.array(covariances), BOUND)
    assert 0.1 < found["nees_mean"] < found["nees_upper"], found


def test_a_state_of_a_wide_prior_becomes_that_of_the_width_that_the_log_supports() -> None:
    """As if the filter had begun with it: `supported` and a second run agree, but for the change of the linearization."""
    imu = biased(3)
    wide = replace(KNOWN, std=3.0 * KNOWN.std, minimum=LeastWidth(0.1 * KNOWN.std))
    last = forward(imu, wide)[-1]
    state = last.step.after
    (found, _), (P, _) = wide.supported([state] * 2, np.full(2, last.end_s), np.array([False, True]))
    walked = wide.walk**2 * last.end_s
    shown = shown_bias(state.bias, np.diag(state.covariance(False)), wide.mean, wide.std**2 + walked)
    again = forward(imu, replace(wide, std=supported_std(wide.std, wide.minimum, *shown), minimum=None))[-1].step.after
    std = np.sqrt(np.diag(again.covariance(False)))
    wider = np.sqrt(np.diag(P)) / std
    assert ((wider > 0.95) & (wider < 1.5)).all(), "nor is it known that this is the width"
    assert (np.abs(found - again.bias) < 0.5 * std).all()
    assert np.linalg.norm(state.bias - again.bias) > np.linalg.norm(found - again.bias)


def test_a_width_that_the_log_does_not_show_is_counted() -> None:
    """Widths evenly spread in their logarithm: before the log shows anything, the variance is the mean of their squares."""
    prior = replace(KNOWN, std=np.full(6, 1e-2), minimum=LeastWidth(np.full(6, 1e-3)))
    first = forward(biased(3, still_s=0.0), prior)[0]
    blind = first.step.after._replace(P=np.diag([1.0] * 9 + [1e-4] * 6 + [1e-6] * 6))
    _, (P,) = prior.supported([blind], np.zeros(1), np.array([False]))
    exact = (1e-4 - 1e-6) / (2 * np.log(10.0))
    np.testing.assert_allclose(np.diag(P), exact, rtol=0.1)
    assert (np.diag(P) > 1.5 * 1e-2 * 1e-3).all(), "more than that of the middle width"


def test_a_stop_tells_the_bias_at_rest_from_that_in_motion(filtered: Filtered) -> None:
    for seed in (1, 2, 3):
        blocks = filtered(seed, 5.0)
        bias, ground = planted(seed)
        at_rest = [block for block in blocks if block.resting and block.end_s < 5.0][-1].step.after  # then it moves, slowly
        np.testing.assert_allclose(at_rest.rest_bias(True)[:3], (bias + ground)[:3], rtol=0, atol=3e-4)
        std = np.sqrt(np.diag(at_rest.covariance(False))[:3])
        assert (std > 0.6 * GROUND[:3]).all(), "what differs at rest is not known yet"


@pytest.mark.parametrize(("push_m_s2", "rate_rad_s"), [(1.0, 0.0), (0.0, 0.012)], ids=["speeds up", "bends"])
def test_a_car_that_drives_steadily_does_not_stop(push_m_s2: float, rate_rad_s: float) -> None:
    """An engine hides that the rate is not constant: stops at 15 m/s, or in a long bend, moved the bias by 20 mrad/s."""
    t_s, rng = np.arange(0.0, 40.0, 0.01), np.random.default_rng(0)
    drives = np.clip(t_s - 10.0, 0.0, 1.0)[:, None]
    engine = np.sin(2.0 * np.pi * (30.0 * t_s[:, None] + 0.1 * np.sin(t_s[:, None]) + [0.0, 0.3, 0.7])) * drives
    gyro = 1e-3 * rng.normal(size=(4000, 3)) + 0.01 * engine + np.outer(drives, [0.0, 0.0, rate_rad_s])
    accel = [0.0, 0.0, 9.81] + 0.02 * rng.normal(size=(4000, 3)) + 0.3 * engine + np.outer(drives, [push_m_s2, 0.0, 0.0])
    car = replace(KNOWN, settings=FilterSettings(speed_m_s=10.0, speed_correlation_s=5.0))
    blocks = list(filter_blocks(model(), [(t_s, gyro, accel)], car))
    assert [block.resting for block in blocks] == [block.start_s < 9.9 for block in blocks]
    assert np.abs(blocks[-1].step.after.bias[:3]).max() < 2e-3


@pytest.mark.parametrize(("known", "rate", "rests"), [(0.0, 0.08, False), (0.08, 0.08, True), (0.08, 0.0, True)])
def test_a_steady_rate_that_no_bias_explains_is_a_turn_and_no_stop(known: float, rate: float, rests: bool) -> None:
    """A bias may be as this sensor has it, or as a sensor usually has it: a file may state another unit's."""
    t_s, rng = np.arange(0.0, 4.0, 0.005), np.random.default_rng(0)
    gyro = 1e-3 * rng.normal(size=(800, 3)) + [0.0, 0.0, rate]
    accel = [0.0, 0.0, 9.81] + 0.02 * rng.normal(size=(800, 3))
    filter_ = BiasFilter(replace(KNOWN, mean=np.array([0.0, 0.0, known, 0.0, 0.0, 0.0])), ahead=True)
    blocks = [*filter_.feed(t_s, gyro, accel), *filter_.finish()]
    assert {block.resting for block in blocks} == {rests}


def test_a_body_of_unknown_speed_may_be_a_car() -> None:
    """Its long acceleration looked like a tilt, hence a bias of 0.8 mrad/s; `static --smooth` had three times its error."""
    t_s, rng = np.arange(0.0, 100.0, 0.02), np.random.default_rng(0)
    push = 1.5 * (((t_s > 10.0) & (t_s < 25.0)) * 1.0 - ((t_s > 65.0) & (t_s < 80.0)))
    sways = np.sin(6.0 * t_s[:, None] + [0.0, 1.0, 2.0]) * ((t_s > 10.0) & (t_s < 80.0))[:, None]
    gyro = 1e-3 * rng.normal(size=(5000, 3)) + 0.02 * sways
    accel = [0.0, 0.0, 9.81] + 0.02 * rng.normal(size=(5000, 3)) + np.outer(push, [1.0, 0.0, 0.0])
    found = smooth_bias(static.Model(), [(t_s, gyro, accel)], bias_prior(static.Model())).track
    assert np.abs(found.rest[:, :3]).max() < 4e-4


def test_rest_at_the_end_is_seen_by_smoothing_and_not_before() -> None:
    imu = biased(4, still_s=6.0, backwards=True)
    bias, ground = planted(4)
    sure = BiasPrior(np.zeros(6), PRIOR, np.array([1e-4] * 3 + [0.03] * 3))  # no difference at rest: the stop shows it all
    imu = Imu(
        imu.t_ns, imu.gyro - np.where(np.arange(len(imu)) > len(imu) - 6 * RATE_HZ, 1, 0)[:, None] * ground[:3], imu.accel
    )
    track, rested_s, *_ = smooth_bias(model(), [samples(imu)], sure)
    assert 5.4 < rested_s < 6.6  # it comes to rest slowly
    causal = forward(imu, sure)
    half = len(causal) // 2
    assert not any(block.resting for block in causal[:half])
    np.testing.assert_array_less(track.std[half, :3], 0.8 * np.sqrt(np.diag(causal[half].step.after.P)[9:12]).max())
    late = len(track.t_s) - 16  # two seconds before it stops
    assert np.linalg.norm(track.rest[late, :3] - bias[:3]) < 1e-3
    assert np.linalg.norm(track.rest[late, :3] - bias[:3]) < np.linalg.norm(causal[late].step.after.bias[:3] - bias[:3])


def test_a_log_that_begins_in_motion_gets_up_to_its_first_stop_what_that_shows() -> None:
    """A later stop than the first minute's is not waited for, and after the stop nothing is known before it is measured."""
    made = model()
    made.card = {"name": "m", "logs": [{}] * 6}
    made.tensors["prior_std"][:], made.tensors["rest_std"][:] = PRIOR, GROUND
    errors, priors, covariances = [], [], []
    for seed in SEEDS:
        imu = biased(seed, duration_s=40.0, still_s=6.0, backwards=True)
        start = auto(made, imu)
        assert " s at rest from 3" in start.how
        found = start.estimator(made).estimate(*samples(imu))
        middle = len(imu) // 2
        errors.append((found.bias[middle] - planted(seed)[0])[:3])
        priors.append(planted(seed)[0][:3])
        covariances.append(found.covariance[middle, :3, :3])
    assert np.std(errors) < 0.5 * np.std(priors)
    assert consistency(np.array(errors), np.array(covariances), BOUND)["nees_mean"] < 4.0
    late = auto(made, biased(1, duration_s=80.0, still_s=6.0, backwards=True))
    assert late.track is None
    assert "at rest" not in late.how


def test_smoothing_is_never_less_sure() -> None:
    imu = biased(5, still_s=4.0)
    blocks = forward(imu)
    for block, state in smooth_blocks(blocks):
        less = np.linalg.eigvalsh(block.step.before.P[9:, 9:] - state.P[9:, 9:])
        assert less.min() > -1e-10


def test_biases_are_the_same_in_a_world_turned_about_the_vertical() -> None:
    """And in samples: the body starts with another heading, which no sample knows. So turn the body about its own axis."""
    imu = biased(6)
    turn = Rotation.from_euler("xyz", [0.3, -0.8, 1.2]).as_matrix()
    turned = Imu(imu.t_ns, imu.gyro @ turn.T, imu.accel @ turn.T)
    even = BiasPrior(np.zeros(6), np.array([3e-3] * 3 + [0.1] * 3), GROUND)
    one, other = forward(imu, even)[-1].step.after, forward(turned, even)[-1].step.after
    np.testing.assert_allclose(other.bias[:3], turn @ one.bias[:3], rtol=0, atol=1e-8)
    np.testing.assert_allclose(other.P[9:12, 9:12], turn @ one.P[9:12, 9:12] @ turn.T, rtol=0, atol=1e-9)


# ── when it knows it ─────────────────────────────────────────────────────────────────────────────────────────────────


def test_nothing_later_changes_what_came_before() -> None:
    imu = biased(7, duration_s=30.0, still_s=4.0)
    cut = 3333
    other = biased(8, duration_s=30.0)
    changed = Imu(
        imu.t_ns,
        np.concatenate([imu.gyro[:cut], other.gyro[cut:]]),
        np.concatenate([imu.accel[:cut], 2.0 * other.accel[cut:]]),
    )
    one, two = (TrackedBiasStream(model(), KNOWN, NOTHING_HELD, 0.0)(*samples(some)) for some in (imu, changed))
    np.testing.assert_array_equal(one[:cut], two[:cut])
    assert np.abs(one[cut + 200 :] - two[cut + 200 :]).max() > 1e-5


@pytest.mark.parametrize("size", [1, 7, 1000])
def test_batches_of_any_size_give_the_same_numbers(size: int) -> None:
    t, gyro, accel = samples(biased(9, duration_s=12.0, still_s=3.0))
    whole = TrackedBiasStream(model(), KNOWN, NOTHING_HELD, 0.0)(t, gyro, accel)
    stream = TrackedBiasStream(model(), KNOWN, NOTHING_HELD, 0.0)
    parts = [stream(t[a : a + size], gyro[a : a + size], accel[a : a + size]) for a in range(0, len(t), size)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    assert len(np.unique(whole[:, 0])) > 15


def test_chunks_of_smoothing_agree_with_smoothing_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = forward(biased(10, duration_s=90.0))
    assert blocks[-1].end_s < CHUNK_S
    whole = [(state.bias, np.sqrt(np.diag(state.P)[9:15])) for _, state in smooth_blocks(blocks)]
    monkeypatch.setattr("imutool.bias_start.bias_tracking.CHUNK_S", 10.0)
    monkeypatch.setattr("imutool.bias_start.bias_tracking.LOOK_AHEAD_S", 60.0)
    chunks = [(block, state.bias) for block, state in smooth_blocks(blocks)]
    assert [block.start_s for block, _ in chunks] == [block.start_s for block in blocks]
    away = max(np.abs((bias - best) / std).max() for (_, bias), (best, std) in zip(chunks, whole, strict=True))
    assert 0.0 < away < 1.0  # what comes a minute later moves an estimate by a fraction of its doubt


def test_a_hole_in_the_samples_makes_it_less_sure_and_a_long_one_starts_the_pose_anew() -> None:
    imu = biased(11, duration_s=40.0)
    t = seconds(imu.t_ns, int(imu.t_ns[0]))
    short, long = (imu.rows((t < 20.0) | (t > 20.0 + hole)) for hole in (0.2, 5.0))
    whole, little, much = (forward(some)[45].step.after for some in (imu, short, long))
    assert np.trace(little.P[:3, :3]) > np.trace(whole.P[:3, :3])
    assert np.isfinite(much.bias).all()
    end = forward(long)[-1].step.after
    assert (np.abs(end.bias - planted(11)[0])[:3] < 3 * np.sqrt(np.diag(end.P)[9:12])).all()


def test_filters_together_find_what_each_finds_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    imu, other = biased(12, duration_s=30.0, still_s=4.0), biased(13, duration_s=30.0)  # the other never rests
    t = seconds(imu.t_ns, int(imu.t_ns[0]))
    kept = (t < 10.0) | ((t > 10.2) & (t < 20.0)) | (t > 25.0)
    given = [(t[kept], x.gyro[kept] + shift, x.accel[kept]) for x, shift in ((imu, 0.0), (imu, 0.02), (other, 0.0))]
    priors = [KNOWN, replace(KNOWN, std=10.0 * PRIOR), KNOWN]
    alone = []
    for prior, of in zip(priors, given, strict=True):
        filter_ = BiasFilter(prior, ahead=True)
        alone.append([*filter_.feed(*of), *filter_.finish()])
    steps, motion_step = [], inertial_filter.motion_step
    monkeypatch.setattr(inertial_filter, "motion_step", lambda *given: steps.append(1) or motion_step(*given))
    filters = [BiasFilter(prior, ahead=True) for prior in priors]
    for found, right, filter_ in zip(filter_together(filters, given), alone, filters, strict=True):
        assert [block[:3] for block in found] == [block[:3] for block in right]
        for a, b in zip(found, right, strict=True):
            for x, y in ((a.step.expected, b.step.expected), (a.step.after, b.step.after)):
                np.testing.assert_allclose(x.rest_bias(True), y.rest_bias(True), rtol=0.0, atol=SAME)
                np.testing.assert_allclose(x.P, y.P, rtol=0.0, atol=SAME)
            np.testing.assert_allclose(a.step.F, b.step.F, rtol=0.0, atol=SAME)
        assert filter_.state is found[-1].step.after
    moving = sum(not block.resting for found in alone for block in found)
    assert any(block.resting for block in alone[0])
    assert len(steps) < 0.6 * moving


@pytest.mark.parametrize("count", [0, 1, 2, 50, 100])
def test_less_than_a_block_says_nothing(count: int) -> None:
    imu = biased(1, duration_s=2.0).rows(slice(0, count))
    t, gyro, accel = samples(imu) if count else (np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    filter_ = BiasFilter(KNOWN, ahead=True)
    assert [*filter_.feed(t, gyro, accel), *filter_.finish()] == []
    track, rested_s, *_ = smooth_bias(model(), [(t, gyro, accel)], KNOWN)
    assert (len(track.t_s), rested_s) == (0, 0.0)


def test_a_track_holds_each_row_until_the_next() -> None:
    track = BiasTrajectory(np.array([0.0, 1.0]), np.array([[1.0] * 6, [2.0] * 6]), np.ones((2, 6)))
    np.testing.assert_array_equal(track.at(np.array([-1.0, 0.0, 0.99, 1.0, 9.0]))[:, 0], [1, 1, 1, 2, 2])


def test_a_flight_of_150_seconds_takes_well_under_a_second() -> None:
    imu = biased(1, duration_s=150.0)
    best = np.inf
    for _ in range(3):
        began = time.process_time()
        blocks = forward(imu)
        best = min(best, time.process_time() - began)
    assert len(blocks) == 300
    assert best < 1.5, f"{best:.2f} s, with shapes checked at every call"


def carried(pivot: np.ndarray, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples of an exact IMU on a body that turns about a pivot, which moves with a mean velocity in body axes."""
    t_s = np.arange(0.0, 60.0, 1.0 / RATE_HZ)
    slow = np.stack([np.sin(2 * np.pi * f * t_s + p) for f, p in ((0.23, 1.0), (0.37, 2.0), (0.11, 0.0), (0.31, 0.5))])
    R_wb = Rotation.from_euler("ZYX", np.stack([2.0 * slow[2] + 0.5 * slow[3], 0.4 * slow[1], 0.5 * slow[0]], axis=1))
    v_w = np.gradient(R_wb.apply(-pivot), t_s, axis=0) + R_wb.apply(mean)
    turned = (R_wb[:-1].inv() * R_wb[1:]).as_rotvec() * RATE_HZ
    accel = R_wb.inv().apply(np.gradient(v_w, t_s, axis=0) + np.array([0.0, 0.0, 9.81]))
    inner = slice(2, -2)
    return t_s[inner], 0.5 * (turned[:-1] + turned[1:])[1:-1], accel[inner]


def test_an_arm_that_swings_and_a_vehicle_that_drives_where_it_points_are_found() -> None:
    for pivot, mean in (
        ([0.1, -0.6, 0.2], [0.0, 0.0, 0.0]),
        ([0.0, 0.0, 0.0], [0.6, 0.0, 0.0]),
        ([0.0, 0.4, 0.0], [0.3, 0.2, 0.0]),
    ):
        blocks = list(BiasFilter(KNOWN).feed(*carried(np.array(pivot), np.array(mean))))
        found = blocks[-1].step.after
        np.testing.assert_allclose(found.steady, [*pivot, *mean], rtol=0, atol=0.05)
        assert np.sqrt(np.diag(found.P)[21:27]).max() < 0.25  # the mean vertical velocity is seen least
        explained = np.array([block.step.innovation[0] for block in blocks[40:] if block.step.innovation is not None])
        assert np.sqrt((explained**2).mean()) < 0.1  # m/s, of speeds of about 0.5
