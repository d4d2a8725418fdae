"""What is remembered of signals on their course, and derivatives that are kept, are what working it all out anew gives."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import firwin
from support import planted
from support.planted import simulate_samples

from imutool.diagnosis.estimation import unnamed_effects
from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.candidate_score import CandidateScore
from imutool.diagnosis.estimation.gauss_newton import fit
from imutool.diagnosis.estimation.jacobians import ForwardPass, Jacobians, bound, effect_jacobian, free, step_of
from imutool.diagnosis.estimation.whitening import Band, Whitener
from imutool.diagnosis.settings import FitSettings
from imutool.sensor import catalogue
from imutool.sensor.effect import Effect, Stage, Theta

ROUNDED = 1e-6  # of the largest derivative: differences of numbers to sixteen digits, over steps of a thousandth
AROUND = {  # effects of every stage, so that each is asked with others before and behind it
    "lever_arm": [0.1, -0.05, 0.02],
    "mount_rotation": [0.02, -0.01, 0.03],
    "low_pass": [15.0],
    "clock_offset": [0.003],
    "gyro_scale": [0.01, -0.02, 0.03],
    "accel_misalignment": [0.01, 0.0, -0.01, 0.0, 0.02, 0.0],
}
SECONDS = 20.0


def evaluated(pair: Pair, chosen: tuple[tuple[Effect, Theta], ...]) -> np.ndarray:
    """From the start, nothing remembered."""
    got = simulate_samples(
        type(pair.ideal)(*(getattr(pair.ideal, n) for n in ("t_s", "gyro", "accel", "alpha", "R_wb"))), pair.stamp_s, chosen
    )
    return np.concatenate([got.gyro, got.accel], axis=1)


def start(physics: Effect, pair: Pair) -> Theta:
    """Where a fit of it would begin, or a tenth of its plausible size."""
    if physics.starts is None:
        return 0.1 * physics.plausible
    got = simulate_samples(pair.ideal, pair.stamp_s, ())
    return np.asarray(physics.starts(pair.ideal, got.with_readings(pair.real[:, :3], pair.real[:, 3:]))[0], dtype=float)


@pytest.fixture(scope="module")
def pair() -> Pair:
    one: Pair = planted.pair(planted.rich(duration_s=SECONDS), {"lever_arm": [0.1, 0.0, 0.0], "clock_offset": [0.004]}, 1)
    return one


@pytest.mark.parametrize("physics", planted.catalogue(), ids=lambda one: one.name)
def test_jacobians_are_the_differences_of_the_whole(pair: Pair, physics: Effect) -> None:
    others = tuple(one for one in planted.acting(AROUND) if one[0].name != physics.name)
    theta = start(physics, pair)
    chosen = (*others, (physics, theta))
    base, got = evaluated(pair, chosen), np.zeros((6, len(theta), len(pair.stamp_s)))
    for axis, j, row in ForwardPass(pair, chosen, ForwardPass(pair, others)).derivatives(physics):
        got[axis, j] = row
    for j, number in enumerate(physics.parameters):
        x = free(physics, theta)
        x[j] += step_of(number)
        there = (evaluated(pair, (*others, (physics, bound(physics, x)))) - base) / step_of(number)
        np.testing.assert_allclose(got[:, j], there.T, atol=ROUNDED * max(1.0, np.abs(there).max()))


@pytest.mark.parametrize("physics", [one for one in planted.catalogue() if one.linear], ids=lambda one: one.name)
def test_the_jacobian_of_a_linear_effect_needs_no_pass_through_it(pair: Pair, physics: Effect) -> None:
    others = tuple(one for one in planted.acting(AROUND) if one[0].name != physics.name)
    noise = Whitener(np.ones((6, 1)), planted.NOISE)
    beside = effect_jacobian(noise, ForwardPass(pair, others), physics)
    there = effect_jacobian(noise, ForwardPass(pair, (*others, (physics, physics.null_value.astype(float)))), physics)
    np.testing.assert_array_equal(beside.axes, there.axes)
    np.testing.assert_array_equal(beside.parameters, there.parameters)
    np.testing.assert_allclose(beside.rows, there.rows, rtol=1e-12)


@pytest.mark.parametrize("others", [{}, {"vibration_rectification": [1e-4] * 18}], ids=["last", "with one behind"])
def test_columns_that_are_added_are_the_differences_of_the_whole(pair: Pair, others: dict[str, list[float]]) -> None:
    acting = planted.acting({"gyro_scale": [0.01, 0.0, 0.0], **others})
    read = unnamed_effects.like([pair])
    for physics in (*list(unnamed_effects.curves(read))[::17], *list(unnamed_effects.terms(read))[::97]):
        slope = effect_jacobian(Whitener(np.ones((6, 1)), np.ones(6)), ForwardPass(pair, acting), physics)
        base = ForwardPass(pair, acting).expected
        for j, (row, axis) in enumerate(zip(slope.rows, slope.axes, strict=True)):
            theta = np.where(np.arange(slope.width) == slope.parameters[j], physics.plausible, 0.0)
            there = ForwardPass(pair, (*acting, (physics, 1e-3 * theta))).expected - base
            size = 1e-3 * physics.plausible[slope.parameters[j]]
            np.testing.assert_allclose(row, there[:, axis] / size, atol=ROUNDED * np.abs(row).max())


@pytest.mark.parametrize("name", ["mount_resonance", "gyro_bias_drift", "accel_bias_drift", "vibration"])
def test_an_axis_that_a_parameter_leaves_alone_has_no_row_of_rounding(pair: Pair, name: str) -> None:
    physics = next(one for one in planted.catalogue() if one.name == name)
    theta = 0.37 * physics.plausible
    slope = effect_jacobian(Whitener(np.ones((6, 1)), np.ones(6)), ForwardPass(pair, ((physics, theta),)), physics)
    of_one_axis = [j for j, parameter in enumerate(physics.parameters) if not parameter.positive]
    assert [int((slope.parameters == j).sum()) for j in of_one_axis] == [1] * len(of_one_axis)


def test_a_pass_continued_from_another_reads_what_a_new_one_reads(pair: Pair) -> None:
    acting = planted.acting(AROUND)
    known = ForwardPass(pair, acting[4:])
    for chosen in (acting, acting[1:], acting[::-1], acting[:3], (), acting[4:]):
        known = ForwardPass(pair, chosen, known)
        np.testing.assert_array_equal(known.expected, ForwardPass(pair, chosen).expected)
        np.testing.assert_allclose(known.expected, evaluated(pair, chosen), atol=1e-12)


def test_what_an_effect_adds_is_told_for_the_axes_that_it_changes(pair: Pair) -> None:
    nothing, scaled = ForwardPass(pair, ()), ForwardPass(pair, planted.acting({"gyro_scale": [0.01, 0.0, 0.0]}))
    added = scaled.added(nothing)
    assert list(added) == [0]
    np.testing.assert_allclose(added[0], 0.01 * nothing.expected[:, 0])


@pytest.mark.parametrize("band", [None, Band(firwin(67, 8.0, fs=100.0), 4)])
def test_a_step_along_jacobians_is_the_sum_of_their_rows(pair: Pair, band: Band | None) -> None:
    chosen = planted.acting(AROUND)
    whiten = Whitener(np.tile([1.0, -0.4], (6, 1)), planted.NOISE, band)
    slopes = Jacobians([whiten], [ForwardPass(pair, chosen)], chosen)
    assert slopes.fresh
    rows = np.ones(len(pair.stamp_s[:: whiten.every]), bool)
    step = np.random.default_rng(3).normal(size=sum(len(theta) for _, theta in chosen))
    whole, first = np.zeros((6, len(step), len(rows))), 0
    for physics, _ in chosen:
        slope = effect_jacobian(whiten, ForwardPass(pair, chosen), physics)
        whole[slope.axes, first + slope.parameters] = slope.rows
        first += slope.width
    for axis in range(6):
        np.testing.assert_allclose(slopes.along(0, axis, step, rows), step @ whole[axis], atol=1e-9 * np.abs(whole).max())


def test_jacobians_that_are_known_are_taken_as_they_are(pair: Pair) -> None:
    chosen = planted.acting(AROUND)
    noise, course = Whitener(np.ones((6, 1)), planted.NOISE), ForwardPass(pair, chosen)
    known = Jacobians([noise], [ForwardPass(pair, chosen[:2])], chosen[:2])
    both, rows = Jacobians([noise], [course], chosen, known), np.ones(len(pair.stamp_s), bool)
    assert not both.fresh
    assert [one.name for one, _ in both.linear().chosen] == ["lever_arm", "gyro_scale", "accel_misalignment"]
    for axis in range(6):
        where, theirs = known.on_axis(0, axis, rows)
        mine = dict(zip(*both.on_axis(0, axis, rows), strict=True))
        for k, row in zip(where, theirs, strict=True):
            np.testing.assert_array_equal(mine[k], row)


def test_what_the_score_promises_of_a_linear_effect_a_fit_keeps(pair: Pair) -> None:
    log = planted.weighed(pair)
    now = fit([log], planted.acting({"clock_offset": [0.0]}))
    panel = CandidateScore([log], now)
    for name in ("lever_arm", "gyro_scale", "accel_misalignment", "gyro_g_sensitivity"):
        ((physics, nothing),) = planted.acting({name: [0.0] * len(planted.acting({name: []})[0][0].parameters)})
        gained = now.objective - fit([log], (*now.chosen, (physics, nothing))).objective
        assert panel.gain(physics, panel.linear(physics, (*panel.now.chosen, (physics, nothing)))) == pytest.approx(
            gained, rel=0.01, abs=0.1
        )


def test_the_score_promises_no_more_than_a_step_by_a_factor_of_e(pair: Pair) -> None:
    """A low-pass that is far from where it would do no harm: extrapolated, its harm would turn into a gain."""
    log = planted.weighed(pair)
    now = fit([log], planted.acting({"clock_offset": [0.0], "lever_arm": [0.0] * 3}))
    ((physics, _),) = planted.acting({"low_pass": [2.0]})
    score = CandidateScore([log], now)
    assert score.gain(physics, score.linear(physics, (*score.now.chosen, (physics, np.array([2.0]))))) < 0.0
    assert physics.stage == Stage.BANDWIDTH


def test_a_candidate_that_single_precision_leaves_singular_gains_nothing() -> None:
    """So are the rows of a recording that is compared with itself: 1e7 in float32 against the prior's ones."""
    (effect,) = catalogue.effects(["lever_arm"])
    start = np.zeros(3)
    score = object.__new__(CandidateScore)
    score.N, score.g, score.remaining, score.total, score.axes = np.zeros((0, 0)), np.zeros(0), 2.0, 2.0, []
    score.solved_g = score.g
    score.now = SimpleNamespace(settings=FitSettings())  # type: ignore[assignment]
    singular = SimpleNamespace(start=start, rows=[], N=np.zeros((3, 3)))  # the prior's ones are lost
    assert score.gain(effect, singular) == 0.0  # type: ignore[arg-type]
