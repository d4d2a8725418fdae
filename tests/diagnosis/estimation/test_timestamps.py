"""What stamps and digits show by themselves: every missing sample, jitter, the LSB, the limit; and none where none are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support import planted

from imutool.diagnosis.estimation import timestamps
from imutool.diagnosis.estimation.gauss_newton import fit
from imutool.diagnosis.estimation.model_selection import select_effects
from imutool.diagnosis.estimation.observability import beyond_the_band
from imutool.sensor.physics_file import Entry, PhysicsFile, Value

N = 2400
SURE = 4.0
NANOSECOND = 1e-9
PARTS_PER_MILLION = 1e-6


def clean() -> np.ndarray:
    """As a log stores them: whole nanoseconds."""
    return np.round(planted.clock() * 1e9) * 1e-9


def without(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng([seed, 11])
    gone = rng.choice(np.arange(20, N - 20), count, replace=False)
    return np.delete(clean(), gone)


# ── missing samples ──


def test_a_clean_clock_misses_nothing_and_is_its_own_even_clock() -> None:
    even, missing = timestamps.even(clean())
    assert missing == 0
    assert np.abs(even - clean()).max() < 2 * NANOSECOND


@pytest.mark.parametrize("ppm", [-1000.0, 300.0])
def test_a_clock_that_runs_fast_misses_nothing(ppm: float) -> None:
    t = clean() * (1.0 + ppm * PARTS_PER_MILLION)
    even, missing = timestamps.even(t)
    assert missing == 0
    assert np.abs(even - t).max() < 2 * NANOSECOND


@pytest.mark.parametrize("gone", [[], [777], [777, 778, 1500]])
def test_a_clock_that_is_slowed_for_seconds_misses_no_more(gone: list[int]) -> None:
    """Steps of a phone were 2 % longer for seconds, none was twice as long: 28 samples were said to be missing."""
    steps = np.diff(clean()) * np.where(np.arange(N - 1) % 1000 < 300, 1.02, 1.0)
    slowed = np.concatenate([[0.0], np.cumsum(steps)])
    assert timestamps.even(np.delete(slowed, gone))[1] == len(gone)


@pytest.mark.parametrize(
    ("count", "jitter_s"),
    [(n, jitter_s) for n in (1, 5, 17) for jitter_s in (0.0, 1e-4)]
    + [
        (60, 0.0),
        pytest.param(60, 1e-4),
        pytest.param(17, 5e-4),
        pytest.param(60, 5e-4),
    ],
)
@pytest.mark.parametrize("seed", range(3))
def test_missing_samples_are_counted_exactly(count: int, seed: int, jitter_s: float) -> None:
    t = without(count, seed)
    t = t + jitter_s * np.random.default_rng([seed, 12]).normal(size=len(t))
    even, missing = timestamps.even(t)
    assert missing == count
    assert np.abs(even - (t if not jitter_s else without(count, seed))).max() < (1e-6 if not jitter_s else 4 * jitter_s)


@pytest.mark.parametrize("length", [2, 10, 100])
def test_samples_missing_in_a_row_are_counted_exactly(length: int) -> None:
    assert timestamps.even(np.delete(clean(), slice(1000, 1000 + length)))[1] == length


def test_the_finding_states_count_and_share() -> None:
    felt = planted.rich()
    one = planted.pair(felt, stamp_s=without(24, 0))
    (found,) = timestamps.dropped([one])
    assert found.effect == "dropped_samples"
    assert found.parameters["missing"].value == 24
    assert found.parameters["share"].value == pytest.approx(24 / N)
    (both,) = timestamps.dropped([one, one])
    assert both.parameters["missing"].value == 48


# ── jitter ──


@pytest.mark.parametrize(("jitter_s", "seed"), [(1e-4, 1), (5e-4, 2), (1e-3, 1), (3e-3, 1), pytest.param(2e-3, 2)])
def test_jitter_has_the_size_that_was_planted(jitter_s: float, seed: int) -> None:
    t = clean() + jitter_s * np.random.default_rng(seed).normal(size=N)
    even, missing = timestamps.even(t)
    assert missing == 0
    assert float((t - even).std()) == pytest.approx(jitter_s, rel=SURE / np.sqrt(2 * N))


@pytest.mark.parametrize(("share", "jitter_s"), [(1.0, 5e-4), (0.0, 5e-4), (0.0, 2e-3), pytest.param(1.0, 2e-3)])
def test_whether_samples_jitter_with_their_stamps_is_seen_in_the_signals(share: float, jitter_s: float) -> None:
    felt = planted.rich()
    t = clean()
    t[1:-1] += jitter_s * np.random.default_rng(2).normal(size=N - 2)
    one = planted.pair(felt, stamp_s=t)
    taken = t if share == 0.0 else clean()
    one = replace(one, real=planted.ideal(felt, (), taken) + planted.noise(N, 3) + planted.BIAS)
    (physics,) = timestamps.jitter([one])
    assert physics.name == "timestamp_jitter"
    got = fit([planted.weighed(one)], ((physics, np.zeros(3)),))
    assert abs(got.chosen[0][1][0] - share) < SURE * got.stds()["timestamp_jitter"][0]


def test_even_stamps_do_not_jitter() -> None:
    assert timestamps.jitter([planted.pair(planted.rich(), stamp_s=clean())]) == ()


@pytest.mark.parametrize("follows", [True, False])
def test_jitter_is_taken_off_stamps_that_samples_do_not_follow(follows: bool) -> None:
    """A slow wander of the same clock stays, and so do holes."""
    even = np.delete(clean() + 5e-3 * np.sin(0.3 * clean()), [700, 701, 1800])
    stamps = even + 5e-4 * np.random.default_rng(4).normal(size=len(even))
    samples = planted.ideal(planted.rich(), (), stamps if follows else even) + planted.noise(len(even), 3)
    got = timestamps.without_jitter(stamps, samples)
    if follows:
        np.testing.assert_array_equal(got, stamps)
    else:
        assert float((got - even)[50:-50].std()) < 0.35 * 5e-4


# ── digits ──


@pytest.mark.parametrize("times", [1.0, 3.0])
def test_the_lsb_is_found_to_a_thousandth(times: float) -> None:
    lsb = times * np.array([planted.NOISE[0], planted.NOISE[3]])
    one = planted.pair(planted.rich())
    one = replace(one, real=np.repeat(lsb, 3) * np.round(one.real / np.repeat(lsb, 3)))
    (found,) = timestamps.rounded([one], planted.NOISE)
    assert found.effect == "quantization"
    assert found.signal == "both"
    assert found.parameters["gyro_lsb"].value == pytest.approx(lsb[0], rel=1e-3)
    assert found.parameters["accel_lsb"].value == pytest.approx(lsb[1], rel=1e-3)
    assert found.parameters["gyro_lsb"].unit == "rad/s"


def test_a_grid_in_one_sensor_is_told_of_that_one() -> None:
    one = planted.pair(planted.rich())
    one.real[:, 3:] = 0.06 * np.round(one.real[:, 3:] / 0.06)
    (found,) = timestamps.rounded([one], planted.NOISE)
    assert found.signal == "accel"
    assert set(found.parameters) == {"accel_lsb"}


def test_a_grid_much_finer_than_the_noise_is_not_told() -> None:
    one = planted.pair(planted.rich())
    lsb = planted.NOISE / 10.0
    assert timestamps.rounded([replace(one, real=lsb * np.round(one.real / lsb))], planted.NOISE) == []


def test_few_distinct_values_are_no_grid() -> None:
    assert timestamps.grid(np.repeat([1.0, 2.0], 50)) == 0.0
    assert timestamps.grid(np.zeros(100)) == 0.0


# ── limits ──


def clipped_pair(limit: float) -> tuple[object, np.ndarray]:
    one = planted.pair(planted.rich())
    there = one.real.copy()
    return replace(one, real=np.concatenate([np.clip(there[:, :3], -limit, limit), there[:, 3:]], axis=1)), there


@pytest.mark.parametrize("quantile", [0.9, 0.97])
def test_the_limit_is_found_exactly_and_clipped_rows_are_those_at_it(quantile: float) -> None:
    raw = planted.pair(planted.rich()).real
    limit = float(np.quantile(np.abs(raw[:, :3]), quantile))
    one, there = clipped_pair(limit)
    assert timestamps.limits(one.real) == {"gyro": limit}
    beyond = (np.abs(there[:, :3]) >= limit).any(axis=1)
    clipped = timestamps.clipped(one.real)
    assert clipped[:, :3][np.abs(there[:, :3]) >= limit].all()
    assert not clipped[:, 3:].any()
    assert clipped.any(axis=1).sum() < 3 * beyond.sum()
    (found,) = timestamps.saturated([one], [there], 50)
    assert found.effect == "saturation"
    assert found.signal == "gyro"
    assert found.parameters["gyro_limit"].value == limit
    assert found.held_out.rms_after < 1e-12 < found.held_out.rms_before
    assert found.p_value < 1e-6
    assert found.share == pytest.approx(1.0)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_limits_of_a_converter_are_not_alike_on_both_sides(sign: float) -> None:
    one = planted.pair(planted.rich())
    lsb = float(np.quantile(np.abs(one.real[:, :3]), 0.9)) / 32768
    digits = sign * np.clip(np.round(sign * one.real[:, :3] / lsb), -32768, 32767)
    clipped = replace(one, real=np.concatenate([lsb * digits, one.real[:, 3:]], axis=1))
    assert timestamps.limits(clipped.real) == {"gyro": 32768 * lsb}
    (found,) = timestamps.saturated([clipped], [one.real], 50)
    assert found.held_out.rms_after < 0.1 * found.held_out.rms_before


def test_one_axis_may_have_a_limit_of_its_own() -> None:
    """The other axes read more, so that there was no limit: a curve without a name was said to be missing."""
    one = planted.pair(planted.rich())
    limit, real = float(np.quantile(np.abs(one.real[:, 1]), 0.9)), one.real.copy()
    real[:, 1] = np.clip(real[:, 1], -limit, limit)
    assert np.abs(real[:, :3]).max() > limit
    assert timestamps.limits(real) == {"gyro_y": limit}
    clipped = timestamps.clipped(real)
    assert clipped[np.abs(one.real[:, 1]) >= limit, 1].all()
    assert not clipped[:, [0, 2, 3, 4, 5]].any()
    (found,) = timestamps.saturated([replace(one, real=real)], [one.real], 50)
    assert (found.signal, list(found.parameters)) == ("gyro", ["gyro_limit_y"])
    entry = Entry(name="saturation", parameters={"gyro_limit_y": Value(value=limit, unit="rad/s")})
    ((effect, theta),) = PhysicsFile(effect=(entry,)).acting()
    again = planted.ideal(planted.rich(), ((effect, theta),))
    assert np.abs(again[:, 1]).max() == limit < np.abs(again[:, [0, 2]]).max()


def test_a_dead_axis_has_no_limit() -> None:
    one = planted.pair(planted.rich())
    assert timestamps.limits(one.real * np.array([0, 0, 0, 1, 1, 1])) == {}


def test_an_axis_that_is_always_at_its_limit_is_cut_though_its_bias_hides_it() -> None:
    """A robot on a flat floor: gravity and the bias of z are beyond the limit, and the bias is unknown."""
    one = planted.pair(planted.rich())
    noisy = 9.8 + 0.02 * np.random.default_rng(4).normal(size=len(one.real))
    real, expected = one.real.copy(), one.real.copy()
    real[:, 3:5], real[:, 5], expected[:, 5] = 0.0, np.minimum(noisy, 9.79), 9.7
    (found,) = timestamps.saturated([replace(one, real=real)], [expected], 50)
    assert found.parameters["accel_limit"].value == 9.79
    real[:, 5] = np.minimum(np.round(noisy, 1), 9.8)  # on a grid the largest recurs
    assert not timestamps.saturated([replace(one, real=real)], [expected], 50)


def test_the_same_reading_again_and_again_is_no_limit_where_no_more_was_expected() -> None:
    """A parked vehicle on a coarse grid reads its largest value often, and nothing says that it should read more."""
    t = planted.clock()
    real = np.zeros((N, 6))
    real[:, 5] = 9.81
    one = replace(planted.pair(planted.rich()), real=real, stamp_s=t)
    rng = np.random.default_rng(3)
    assert timestamps.saturated([one], [real + 1e-3 * rng.normal(size=real.shape)], 50) == []


def test_a_soft_limit_is_one_that_readings_pass_by_no_more_than_noise() -> None:
    """Readings in another unit are small, and clipping what was expected at their size would explain most of them."""
    limit = 0.8
    one, there = clipped_pair(limit)
    noisy = replace(one, real=one.real + planted.noise(len(one.real), 8))
    in_g = replace(one, real=there / 9.81)
    for pair, gyro_limit, is_answer in ((noisy, limit, True), (in_g, 0.3 * np.abs(in_g.real[:, :3]).max(), False)):
        gyro, *_ = timestamps.soft_limits([pair], [np.zeros(6)])
        assert beyond_the_band(gyro, np.array([gyro_limit]), [planted.weighed(pair)]) is not is_answer


def test_a_limit_is_found_though_the_sensor_corrects_its_bias_behind_it() -> None:
    """Each axis then stops elsewhere, and on both sides of zero by different readings: no limit below them was an answer."""
    limit, bias = 2.0, np.array([0.15, -0.2, 0.1, 0.0, 0.0, 0.0])
    one, _ = clipped_pair(limit)
    pair = replace(one, real=one.real + bias + planted.noise(len(one.real), 8))
    candidates = timestamps.soft_limits([pair], [np.median(pair.real - planted.ideal(planted.rich()), axis=0)])
    (found,) = select_effects([planted.weighed(pair)], (*planted.catalogue(), *candidates)).selected
    assert found.effect.key == "saturation:corrected gyro"
    assert found.theta == pytest.approx([limit], abs=0.02)


# ── nothing of it ──


@pytest.mark.parametrize("seed", range(5))
def test_clean_samples_show_nothing_of_all_that(seed: int) -> None:
    one = planted.pair(planted.rich(seed), seed=seed, stamp_s=clean())
    assert timestamps.dropped([one]) == []
    assert timestamps.jitter([one]) == ()
    assert timestamps.rounded([one], planted.NOISE) == []
    assert timestamps.limits(one.real) == {}
    assert not timestamps.clipped(one.real).any()
    assert timestamps.saturated([one], [one.real], 50) == []
