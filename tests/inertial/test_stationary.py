"""Rest is found, and motion, however smooth, is not taken for it."""

from __future__ import annotations

import numpy as np
import pytest

from imutool.converters import euroc, fetch, tum_vi
from imutool.inertial.stationary import (
    OnlineRestDetector,
    StationarySettings,
    block_statistics,
    rest_stretches,
    resting_blocks,
    white_noise,
)
from imutool.recording import GRAVITY_M_S2, Imu
from imutool.sensor.made_up_flight import flight

RATE_HZ = 200.0
GYRO_NOISE, ACCEL_NOISE = 2.4e-3, 0.03  # rad/s and m/s² a sample and axis: an ADIS16448 at 200 Hz
BIAS = np.array([-0.002, 0.02, 0.078])
EDGE_S = 0.2  # two blocks: an end of rest is found to this
# Against the true poses: below 1.5 cm/s and 0.03 rad/s is rest, above 5 cm/s or 0.05 rad/s is motion, both over 0.2 s.
MIN_PRECISION, MIN_RECALL = 0.995, 0.9  # measured: 1.0 and 0.999, 0.94 and 0.94


def made(seconds: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps, rates and specific forces of a resting, biased, noisy sensor."""
    rng = np.random.default_rng(seed)
    count = round(seconds * RATE_HZ)
    t_ns = (np.arange(count) * round(1e9 / RATE_HZ)).astype(np.int64)
    gyro = BIAS + GYRO_NOISE * rng.normal(size=(count, 3))
    accel = np.array([0.0, 0.0, GRAVITY_M_S2]) + ACCEL_NOISE * rng.normal(size=(count, 3))
    return t_ns, gyro, accel


def in_seconds(imu: Imu) -> list[tuple[float, float]]:
    return [(a / RATE_HZ, b / RATE_HZ) for a, b in rest_stretches(imu)]


def test_a_resting_log_is_one_stretch_in_nearly_its_whole_length():
    found = in_seconds(Imu(*made(20.0)))
    assert sum(b - a for a, b in found) > 19.0
    assert found[0][0] < EDGE_S


def test_noise_of_one_axis_above_the_others_breaks_no_rest():
    t_ns, gyro, accel = made(1800.0)
    found = in_seconds(Imu(t_ns, BIAS + (gyro - BIAS) * np.array([1.0, 1.0, 3.0]), accel))
    assert len(found) <= 10  # with the margin of three equal axes 22: an Allan deviation ends at a quarter of a stretch


def test_the_ends_of_rest_are_found_to_two_blocks():
    t_ns, gyro, accel = made(20.0)
    t = t_ns * 1e-9
    moving = (t >= 8.0) & (t < 13.0)
    gyro[moving] += 0.3 * np.sin(2 * np.pi * 0.7 * t[moving])[:, None]
    (first, second) = in_seconds(Imu(t_ns, gyro, accel))
    assert first == pytest.approx((0.0, 8.0), abs=EDGE_S)
    assert second == pytest.approx((13.0, 20.0), abs=EDGE_S)


def test_the_vibration_of_idling_motors_is_still_rest():
    t_ns, gyro, accel = made(10.0)
    t = t_ns * 1e-9
    gyro += 0.03 * np.sin(2 * np.pi * 71.0 * t)[:, None]
    accel += 0.5 * np.sin(2 * np.pi * 83.0 * t)[:, None]
    assert sum(b - a for a, b in in_seconds(Imu(t_ns, gyro, accel))) > 9.0


MOTIONS = {
    "swaying in the hand": (0.05, 0.4, 0.0),
    "hovering": (0.06, 1.5, 0.5),
    "rocking slowly": (0.03, 0.25, 0.3),
}


@pytest.mark.parametrize("motion", MOTIONS)
def test_slow_motion_is_not_rest(motion):
    rate, frequency, sway = MOTIONS[motion]
    t_ns, gyro, accel = made(30.0)
    t = t_ns * 1e-9
    gyro[:, :2] += rate * np.sin(2 * np.pi * frequency * t)[:, None]
    accel[:, 0] += sway * np.cos(2 * np.pi * frequency * t)
    assert sum(b - a for a, b in in_seconds(Imu(t_ns, gyro, accel))) < 0.05 * 30.0


def test_a_steady_turn_that_disagrees_with_the_other_stretches_is_not_rest():
    t_ns, gyro, accel = made(30.0)
    t = t_ns * 1e-9
    gyro[(t >= 12.0) & (t < 17.0), 2] += 0.1
    found = in_seconds(Imu(t_ns, gyro, accel))
    assert [round(a) for a, _ in found] == [0, 17]
    assert found[0][1] == pytest.approx(12.0, abs=EDGE_S)


@pytest.mark.parametrize("turn", [np.full(3400, 0.1), 0.03 + 0.06 * np.sin(np.pi * np.arange(3400) / 6800.0)])
def test_a_camera_that_pans_for_longer_than_it_rests_rests_before(turn: np.ndarray) -> None:
    """The median of all rates was that of the pan: `debias` then took the turn off, 60° in a minute."""
    _, gyro, accel = made(23.0)
    gyro[1200:, 2] += turn
    t_ns = np.arange(len(gyro)) * 5_000_000
    (found,) = in_seconds(Imu(t_ns, gyro, accel))
    assert found == pytest.approx((0.0, 6.0), abs=EDGE_S)
    assert told(gyro, accel) == [False] * 2 + [True] * 10 + [False] * 34


@pytest.mark.parametrize(("rate", "for_s", "accel_noise"), [(-0.05, 20.0, 3.0), (0.1, 80.0, 1.0)], ids=["shaking", "long"])
def test_a_table_that_turns_against_the_bias_or_for_long_rests_before(rate: float, for_s: float, accel_noise: float) -> None:
    """A turn nearer to zero than the bias, or five times as long as the rest, was the rest: 50 to 100° with `static`."""
    _, gyro, accel = made(6.0 + for_s)
    gyro[1200:, 2] += rate
    accel[1200:] = np.array([0.0, 0.0, GRAVITY_M_S2]) + accel_noise * (accel[1200:] - [0.0, 0.0, GRAVITY_M_S2])
    (found,) = in_seconds(Imu(np.arange(len(gyro)) * 5_000_000, gyro, accel))
    assert found == pytest.approx((0.0, 6.0), abs=EDGE_S)
    assert told(gyro, accel) == [False] * 2 + [True] * 10 + [False] * (round(for_s) * 2)


def test_a_steady_turn_too_fast_for_a_bias_is_not_rest():
    t_ns, gyro, accel = made(10.0)
    assert rest_stretches(Imu(t_ns, gyro + np.array([0.0, 0.0, 0.5]), accel)) == []


@pytest.mark.parametrize(("bias", "rests"), [((0.3, -0.25, 0.0), True), ((0.0, 0.0, 0.3), False), ((0.9, 0.0, 0.0), False)])
def test_a_large_rate_that_leaves_gravity_aside_of_it_in_place_is_a_bias(bias: tuple[float, ...], rests: bool) -> None:
    t_ns, gyro, accel = made(4.0)
    gyro = gyro + np.array(bias)
    detector, half = OnlineRestDetector(), int(0.5 * RATE_HZ)
    live = [detector(gyro[k : k + half], accel[k : k + half]) for k in range(0, len(t_ns), half)]
    assert (bool(rest_stretches(Imu(t_ns, gyro, accel))), live[-1]) == (rests, rests)


def test_the_calmest_seconds_of_a_log_that_never_rests_are_no_rest():
    """A slow turn to and fro, whose rate changes by 0.015 rad/s in a second."""
    t_ns, gyro, accel = made(60.0)
    gyro[:, 2] += 0.015 * np.abs((t_ns * 1e-9 + 2.0) % 8.0 - 4.0) - 0.03
    assert rest_stretches(Imu(t_ns, gyro, accel)) == []
    detector = OnlineRestDetector()
    assert not any(detector(gyro[k : k + 100], accel[k : k + 100]) for k in range(0, len(gyro), 100))


def test_a_gap_in_the_samples_breaks_a_stretch():
    t_ns, gyro, accel = made(10.0)
    late = t_ns + np.where(np.arange(len(t_ns)) >= 1000, 500_000_000, 0)
    assert len(rest_stretches(Imu(late, gyro, accel))) == 2


def test_rest_shorter_than_asked_for_is_left_out():
    t_ns, gyro, accel = made(10.0)
    t = t_ns * 1e-9
    gyro[(t < 4.0) | (t > 6.5)] += 0.3 * np.sin(2 * np.pi * 0.7 * t[(t < 4.0) | (t > 6.5)])[:, None]
    imu = Imu(t_ns, gyro, accel)
    assert len(rest_stretches(imu)) == 1
    assert rest_stretches(imu, StationarySettings(min_s=3.0)) == []


@pytest.mark.parametrize("count", [0, 1, 2, 100])
def test_a_log_shorter_than_a_window_has_no_stretches(count):
    t_ns, gyro, accel = made(1.0)
    assert rest_stretches(Imu(t_ns[:count], gyro[:count], accel[:count])) == []


def test_a_stuck_sensor_does_not_hide_the_real_rest():
    t_ns, gyro, accel = made(20.0)
    gyro[:300], accel[:300] = gyro[0], accel[0]
    assert sum(b - a for a, b in in_seconds(Imu(t_ns, gyro, accel))) > 17.0


def truth_labels(recording):
    """Rest and motion of each IMU sample from the true poses 0.1 s before and after; neither where there are none."""
    t_ns, half_ns = recording.imu.t_ns, 100_000_000
    (before, known), (after, also) = recording.truth.at(t_ns - half_ns), recording.truth.at(t_ns + half_ns)
    speed = np.linalg.norm(after.p_wb - before.p_wb, axis=1) / 0.2
    cosine = np.abs((after.q_wb_wxyz * before.q_wb_wxyz).sum(axis=1)).clip(0.0, 1.0)
    rate = 2.0 * np.arccos(cosine) / 0.2
    known &= also
    rest = known & (speed < 0.015) & (rate < 0.03)
    edges = np.flatnonzero(np.diff(rest.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    for a, b in edges:  # a pause shorter than a stretch may be is not asked for
        rest[a:b] = t_ns[b - 1] - t_ns[a] >= StationarySettings().min_s * 1e9
    return rest, known & ((speed > 0.05) | (rate > 0.05)), known


@pytest.mark.parametrize(("place", "module"), [("euroc", euroc), ("fetch", fetch), ("tumvi", tum_vi)])
def test_rest_agrees_with_the_true_poses_of_the_real_recordings(data, place, module):
    found_known = wrong = hit = resting_blocks = 0
    for recording in module.read(data / place):
        rest, motion, known = truth_labels(recording)
        found = np.zeros(len(recording.imu), bool)
        for a, b in rest_stretches(recording.imu):
            found[a:b] = True
        found_known += int((found & known).sum())
        wrong += int((found & motion).sum())
        hit += int((found & rest).sum())
        resting_blocks += int(rest.sum())
    if place == "tumvi":  # carried in the hand from the first sample to the last
        assert found_known == 0
    else:
        assert 1.0 - wrong / found_known > MIN_PRECISION
        assert hit / resting_blocks > MIN_RECALL


def test_white_noise_is_found_under_the_motion() -> None:
    """The calmer quarter of white noise is five sixths of it; a flight under whose motion it lies hardly differs."""
    made = flight(1, duration_s=20.0).imu
    sigma = np.array([0.1] * 3 + [2.0] * 3)
    plain = sigma * np.random.default_rng(2).normal(size=(len(made), 6))
    np.testing.assert_allclose(white_noise(plain), sigma * 5 / 6, rtol=0.1)
    flown = white_noise(np.concatenate([made.gyro, made.accel], axis=1))
    np.testing.assert_allclose(flown, [2.4e-3 * 5 / 6] * 3 + [0.0283 * 5 / 6] * 3, rtol=0.1)
    assert not white_noise(plain[:10]).any()


def test_white_noise_at_25_hz_is_not_the_motion_of_a_hand() -> None:
    """It was four to twenty times the noise, as were the deviations of debiased messages and the density that `info` gives."""
    t, sigma = np.arange(1500) / 25.0, 0.0025
    hand = np.sin(2.0 * np.pi * 1.5 * t)[:, None]
    noisy = hand + sigma * np.random.default_rng(1).normal(size=(len(t), 3))
    np.testing.assert_allclose(white_noise(noisy, 1.0 / 25.0), sigma * 5 / 6, rtol=0.15)


# ── as samples come ──────────────────────────────────────────────────────────────────────────────────────────────────


def told(gyro: np.ndarray, accel: np.ndarray, block: int = 100) -> list[bool]:
    still = OnlineRestDetector()
    return [still(gyro[a : a + block], accel[a : a + block]) for a in range(0, len(gyro) - block + 1, block)]


def test_rest_is_known_a_second_and_a_half_after_it_begins_and_its_end_at_once():
    t_ns, gyro, accel = made(20.0)
    t = t_ns * 1e-9
    moving = (t >= 8.0) & (t < 13.0)
    gyro[moving] += 0.3 * np.sin(2 * np.pi * 0.7 * t[moving])[:, None]
    found = told(gyro, accel)
    assert found == [False] * 2 + [True] * 14 + [False] * 12 + [True] * 12


def test_what_it_says_depends_on_nothing_later():
    _, gyro, accel = made(20.0)
    changed = gyro.copy()
    changed[2000:] += 0.5
    assert told(gyro, accel)[:20] == told(changed, accel)[:20]


def test_missing_samples_and_short_blocks_begin_it_anew():
    _, gyro, accel = made(4.0)
    still = OnlineRestDetector()
    answers = [still(gyro[a : a + 100], accel[a : a + 100], whole=a != 400) for a in range(0, 800, 100)]
    assert answers == [False, False, True, True, False, False, False, True]
    assert not any(told(gyro, accel, block=3))


@pytest.mark.parametrize("block", [4, 5, 8])  # half a second at 8, 10 and 16 Hz
def test_a_slow_sensor_rests_too(block: int) -> None:
    _, gyro, accel = made(10.0)
    moving = gyro + 0.3 * np.sin(0.7 * np.arange(len(gyro)) / block)[:, None]
    assert np.mean(told(gyro, accel, block)) > 0.8
    assert not any(told(moving, accel, block))


def test_it_agrees_with_the_whole_log_on_real_recordings(data):
    """Where the whole log says rest, it says rest within two seconds; where it does not, neither does this but for edges."""
    recordings = [*euroc.read(data / "euroc" / "V2_01_easy.zip"), *fetch.read(data / "fetch" / "01_square")]
    for recording in recordings:
        imu = recording.imu
        block = round(0.5 / imu.period_s)
        mask = np.zeros(len(imu), bool)
        for a, b in rest_stretches(imu):
            mask[a:b] = True
        share = np.array([mask[a : a + block].mean() for a in range(0, len(imu) - block + 1, block)])
        found = np.array(told(imu.gyro, imu.accel, block))
        assert (share[found] > 0.0).all(), recording.name
        inside = np.convolve(share == 1.0, np.ones(4), "full")[: len(share)] == 4  # two seconds in
        assert found[inside].mean() > 0.9, recording.name


@pytest.mark.parametrize("size", [1, 7, 20, 333, 5000])
def test_the_borders_of_batches_change_nothing(size):
    t_ns, gyro, accel = made(12.0)
    moving = (t_ns > 4_000_000_000) & (t_ns < 7_000_000_000)
    gyro[moving] += 0.3 * np.sin(4.4e-9 * t_ns[moving])[:, None]
    t_ns = t_ns + np.where(t_ns > 10_000_000_000, 700_000_000, 0)
    imu = Imu(t_ns, gyro, accel)
    parts = [slice(first, first + size) for first in range(0, len(imu), size)]
    streamed = block_statistics(((t_ns[part], gyro[part], accel[part]) for part in parts), imu.period_s)
    whole = block_statistics([(t_ns, gyro, accel)], imu.period_s)
    for ours, theirs in zip(streamed, whole, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert [(a * whole.k, b * whole.k) for a, b in resting_blocks(streamed)] == rest_stretches(imu)
    assert len(rest_stretches(imu)) == 3
