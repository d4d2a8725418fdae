"""Planted parameters come back within their stated uncertainty, which is neither too small nor too large."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support import planted

from imutool.diagnosis.estimation.gauss_newton import ONSET_TAKES, Fit, fit
from imutool.diagnosis.estimation.jacobians import Jacobians, bound, bound_slopes, expected, free
from imutool.diagnosis.settings import DiagnoseSettings, FitSettings
from imutool.sensor import catalogue
from imutool.sensor.effects import gyro_bias_drift

SURE = 4.0  # standard deviations: 1 in 16 000 outside
SEEDS = 20
SAME = 0.1  # of a standard deviation, or a square: kept derivatives are right to a few per cent of what noise does
CALIBRATED = (0.7, 1.4)  # root mean square of z-scores; a hundred of them scatter by 0.07

EFFECTS: dict[str, dict[str, tuple[list[float], list[float]]]] = {  # what is planted, and where the fit starts
    "lever arm": {"lever_arm": ([0.2, -0.05, 0.1], [0.0] * 3)},
    "gyro scale": {"gyro_scale": ([0.03, -0.02, 0.01], [0.0] * 3)},
    "gyro misalignment": {"gyro_misalignment": ([0.02, -0.01, 0.005, 0.01, -0.02, 0.01], [0.0] * 6)},
    "accel quadratic": {"accel_quadratic": ([2e-3, -1e-3, 3e-3], [0.0] * 3)},
    "g-sensitivity": {"gyro_g_sensitivity": ([1e-3, 0, -5e-4, 0, 2e-3, 0, 1e-3, 0, -1e-3], [0.0] * 9)},
    "mount rotation": {"mount_rotation": ([0.05, -0.03, 0.08], [0.0] * 3)},
    "gravity": {"gravity": ([0.03, 0.02, -0.01], [0.0] * 3)},
    "clock offset": {"clock_offset": ([0.03], [0.0])},
    "clock skew": {"clock_skew": ([1e-3], [0.0])},
    "low pass": {"low_pass": ([8.0], [20.0])},
    "gyro drift": {"gyro_bias_drift": ([0.02, -0.03, 0.01, 8.0], [0.01, -0.01, 0.01, 10.0])},
    "arm and clock": {"lever_arm": ([0.2, -0.05, 0.1], [0.0] * 3), "clock_offset": ([-0.02], [0.0])},
}

SETTINGS = FitSettings()


def fit_of_planted(effects: dict[str, tuple[list[float], list[float]]], seed: int) -> tuple[Fit, dict[str, np.ndarray]]:
    """A fit, and by effect how far the parameters are from the planted ones in stated standard deviations."""
    felt = planted.rich()
    pair = planted.pair(felt, {name: truth for name, (truth, _) in effects.items()}, seed)
    got = fit(
        [planted.weighed(pair)],
        planted.acting({name: start for name, (_, start) in effects.items()}),
        iterations=12,
    )
    stds = got.stds()
    return got, {p.name: (theta - np.array(effects[p.name][0])) / stds[p.name] for p, theta in got.chosen}


@pytest.mark.parametrize("name", EFFECTS)
def test_planted_parameters_come_back_within_their_uncertainty(name: str) -> None:
    got, z = fit_of_planted(EFFECTS[name], 3)
    for effect, scores in z.items():
        assert np.abs(scores).max() < SURE, f"{effect}: {scores}"
        truth = np.abs(EFFECTS[name][effect][0]).max()
        assert got.stds()[effect].min() < 0.1 * truth  # and that is not because nothing is said


@pytest.mark.parametrize("name", ["arm and clock", "gyro scale", "low pass"])
def test_uncertainties_are_calibrated(name: str) -> None:
    scores = np.concatenate([np.concatenate(list(fit_of_planted(EFFECTS[name], seed)[1].values())) for seed in range(SEEDS)])
    rms = float(np.sqrt(np.mean(scores**2)))
    assert CALIBRATED[0] < rms < CALIBRATED[1], f"{rms:.2f} over {len(scores)}"


def test_what_is_left_of_the_right_model_is_noise() -> None:
    got, _ = fit_of_planted(EFFECTS["arm and clock"], 5)
    n = got.numbers
    assert abs(got.objective - n) < SURE * np.sqrt(2 * n)


def test_biases_come_back_beside_the_effects() -> None:
    got, _ = fit_of_planted(EFFECTS["lever arm"], 6)
    assert (np.abs(got.bias[0] - planted.BIAS) < 2 * SURE * planted.NOISE / np.sqrt(got.numbers / 6)).all()


def test_without_effects_the_bias_is_the_mean_of_what_is_left() -> None:
    felt = planted.rich()
    pair = planted.pair(felt, None, 7)
    got = fit([planted.weighed(pair)], ())
    left = (pair.real - expected(pair, ()))[pair.fitted]
    np.testing.assert_allclose(got.bias[0], left.mean(axis=0), rtol=1e-4)  # but for a weak prior
    assert got.covariance.shape == (0, 0)
    assert got.keys == ()


def test_what_a_planar_motion_does_not_excite_stays_at_nothing_and_says_so() -> None:
    misalignment, arm = planted.acting({"gyro_misalignment": [0.0] * 6, "lever_arm": [0.0] * 3})
    pair = planted.pair(planted.planar(), {"gyro_misalignment": [0, 0.02, 0, -0.03, 0, 0], "lever_arm": [0.3, 0.1, 0.0]}, 8)
    got = fit([planted.weighed(pair)], (misalignment, arm))
    stds = got.stds()
    names = [number.name for number in misalignment[0].parameters]
    for name, value, std in zip(names, got.chosen[0][1], stds["gyro_misalignment"], strict=True):
        prior = SETTINGS.prior_std * misalignment[0].parameters[names.index(name)].plausible
        if name in ("xz", "yz"):  # what the turn about z adds to the others
            assert std < 0.01 * prior
            assert abs(value - {"xz": 0.02, "yz": -0.03}[name]) < SURE * std
        else:
            assert std == pytest.approx(prior, rel=0.01)
            assert abs(value) < 0.01 * prior
    assert abs(got.chosen[1][1][2]) < 1e-3
    assert stds["lever_arm"][2] == pytest.approx(SETTINGS.prior_std * 0.3, rel=0.01)
    assert np.abs((got.chosen[1][1][:2] - [0.3, 0.1]) / stds["lever_arm"][:2]).max() < SURE


def test_two_logs_share_parameters_and_keep_biases_of_their_own() -> None:
    truth = np.array([0.2, -0.05, 0.1])
    biases = np.array([planted.BIAS, -2.0 * planted.BIAS])
    logs = [
        planted.weighed(planted.pair(planted.rich(seed), {"lever_arm": truth}, seed, bias=bias))
        for seed, bias in zip((1, 2), biases, strict=True)
    ]
    begun = planted.acting({"lever_arm": [0.0] * 3})
    both, alone = fit(logs, begun), [fit([log], begun) for log in logs]
    std = both.stds()["lever_arm"]
    assert np.abs((both.chosen[0][1] - truth) / std).max() < SURE
    assert (np.abs(both.bias - biases) < 2 * SURE * planted.NOISE / np.sqrt(both.numbers / 12)).all()
    information = sum(one.stds()["lever_arm"] ** -2.0 for one in alone)
    np.testing.assert_allclose(std, information**-0.5, rtol=0.1)  # but for correlations between the axes


def test_a_constant_in_one_log_alone_is_no_effect_of_both() -> None:
    """g-sensitivity is a bias where nothing tilts: only a bias for each log keeps two logs of a planar motion apart."""
    logs = [
        planted.weighed(planted.pair(planted.planar(), None, seed, bias=bias))
        for seed, bias in ((1, planted.BIAS), (2, -planted.BIAS))
    ]
    got = fit(logs, planted.acting({"gyro_g_sensitivity": [0.0] * 9}))
    assert (np.abs(got.chosen[0][1]) < SURE * got.stds()["gyro_g_sensitivity"]).all()
    assert (np.abs(got.chosen[0][1].reshape(3, 3)[:, 2]) < 1e-4).all()  # what always feels +g


def test_held_out_rows_do_not_enter_a_fit() -> None:
    felt = planted.rich()
    pair = planted.pair(felt, {"lever_arm": [0.2, -0.05, 0.1]}, 9)
    begun = planted.acting({"lever_arm": [0.0] * 3})
    here = fit([planted.weighed(pair)], begun)
    pair.real[~pair.fitted] += 100.0
    there = fit([planted.weighed(pair)], begun)
    np.testing.assert_array_equal(here.chosen[0][1], there.chosen[0][1])
    assert here.numbers == there.numbers == 6 * int(pair.fitted.sum())


@pytest.mark.parametrize("part", ["fitted", "held_out", "all"])
def test_each_part_gives_the_same_answer_but_for_its_noise(part: str) -> None:
    pair = planted.pair(planted.rich(), {"clock_offset": [0.02]}, 10)
    got = fit([planted.weighed(pair)], planted.acting({"clock_offset": [0.0]}), part=part)
    assert abs(got.chosen[0][1][0] - 0.02) < SURE * got.stds()["clock_offset"][0]
    rows = {"fitted": pair.fitted, "held_out": pair.held_out, "all": pair.fitted | pair.held_out}[part]
    assert got.numbers == 6 * int(rows.sum())


def test_a_fit_never_ends_worse_than_it_began() -> None:
    pair = planted.pair(planted.rich(), {"mount_rotation": [0.05, 0.02, -0.03]}, 11)
    log = planted.weighed(pair)
    for name in ("low_pass", "clock_offset", "gyro_scale", "size_effect"):
        ((physics, start),) = planted.acting({name: [5.0] if name == "low_pass" else catalogue.diagnosed([name])[0].null_value})
        began = fit([log], ((physics, start),), iterations=0)
        assert fit([log], ((physics, start),)).objective <= began.objective


@pytest.mark.parametrize("physics", catalogue.diagnosed(), ids=lambda one: one.name)
def test_parameters_come_back_from_how_they_are_fitted(physics: catalogue.Physics) -> None:
    theta = np.where(np.isfinite(physics.null_value), physics.null_value, 0.0) + 0.7 * np.where(
        physics.plausible > 0, physics.plausible, 1.0
    )
    np.testing.assert_allclose(bound(physics, free(physics, theta)), theta, rtol=1e-12)


@pytest.mark.parametrize("name", ["low pass", "arm and clock", "gyro drift"])
def test_derivatives_of_a_fit_nearby_lead_to_the_same_answer(name: str) -> None:
    effects = EFFECTS[name]
    pair = planted.pair(planted.rich(), {one: truth for one, (truth, _) in effects.items()}, 12)
    log, begun = planted.weighed(pair), planted.acting({one: start for one, (_, start) in effects.items()})
    scale = planted.acting({"gyro_scale": [0.0] * 3})
    alone = fit([log], (*begun, *scale))
    near = fit([log], (*begun, *scale), near=fit([log], begun))
    assert near.objective == pytest.approx(alone.objective, abs=SAME)
    for one, std in alone.stds().items():
        both = ({p.name: theta for p, theta in got.chosen}[one] for got in (near, alone))
        assert (np.abs(np.subtract(*both)) < SAME * std).all()
        np.testing.assert_allclose(near.stds()[one], std, rtol=SAME)


def test_derivatives_that_were_kept_end_where_new_ones_end(monkeypatch: pytest.MonkeyPatch) -> None:
    pair = planted.pair(planted.rich(), {"low_pass": [6.0], "lever_arm": [0.3, -0.2, 0.1]}, 13)
    log, begun = planted.weighed(pair), planted.acting({"low_pass": [15.0], "lever_arm": [0.0] * 3})
    kept = fit([log], begun)
    never = DiagnoseSettings(fit=FitSettings(jacobian_error=1e-300))  # so that every step asks for new ones
    monkeypatch.setattr(Jacobians, "linear", lambda self: None)
    anew = fit([replace(log, pair=replace(pair, settings=never))], begun)
    for (_, one), (physics, other) in zip(kept.chosen, anew.chosen, strict=True):
        assert (np.abs(one - other) < SAME * anew.stds()[physics.key]).all()


def test_a_fit_that_falls_short_of_what_was_hoped_for_goes_no_further() -> None:
    pair = planted.pair(planted.rich(), {"low_pass": [3.0]}, 14)
    log, begun = planted.weighed(pair), planted.acting({"low_pass": [80.0]})
    whole = fit([log], begun)
    short = fit([log], begun, iterations=SETTINGS.patience_steps)
    assert whole.objective < short.objective - 1.0
    np.testing.assert_array_equal(fit([log], begun, give_up_above=0.0).chosen[0][1], short.chosen[0][1])
    np.testing.assert_array_equal(fit([log], begun, give_up_above=np.inf).chosen[0][1], whole.chosen[0][1])


def test_a_fit_that_leaves_an_effect_out_gives_up_before_its_first_step_where_that_foretells_too_much() -> None:
    log = planted.weighed(planted.pair(planted.rich(4), {"gyro_scale": [0.02, -0.03, 0.01], "lever_arm": [0.2, -0.05, 0.1]}, 4))
    now = fit([log], planted.acting({"gyro_scale": [0.0] * 3, "lever_arm": [0.0] * 3}))
    begun = now.chosen[1:]
    without = fit([log], begun, near=now)
    at_once = fit([log], begun, near=now, give_up_above=0.5 * (now.objective + without.objective))
    np.testing.assert_array_equal(at_once.chosen[0][1], begun[0][1])  # no step was taken
    assert at_once.objective >= without.objective > now.objective
    hoped = fit([log], begun, near=now, give_up_above=without.objective + 1.0)  # less than this is foretold
    np.testing.assert_array_equal(hoped.chosen[0][1], without.chosen[0][1])


def test_of_an_onset_which_moves_later_a_first_step_foretells_less() -> None:
    truth = {"clock_jump": [25.0, 0.004], "gyro_scale": [0.02, -0.03, 0.01]}
    log = planted.weighed(planted.pair(planted.rich(4), truth, 4))
    now = fit([log], planted.acting(truth))
    without = fit([log], now.chosen[:1], near=now)
    gain = without.objective - now.objective
    for share, stepped in ((0.5, True), (0.5 / ONSET_TAKES, False)):
        limited = fit([log], now.chosen[:1], near=now, give_up_above=now.objective + share * gain)
        assert (limited.objective <= without.objective + 1.0) == stepped


def test_a_drift_far_longer_than_its_log_is_found_by_what_the_log_reaches_of_it() -> None:
    truth = np.array([100.0, -60.0, 80.0, 1e4])  # a slope of 0.01 rad/s², so clear that the time constant has to be right
    pair = planted.pair(planted.rich(), {"gyro_bias_drift": truth.tolist()})
    warm_up, _, steady = gyro_bias_drift.within(catalogue.diagnosed(["gyro_bias_drift"]), float(pair.stamp_s[-1]))
    slope = truth[:3] / truth[3]
    for effect in (warm_up, steady):
        got = fit([planted.weighed(pair)], ((effect, pair.starts(effect)[-1]),))
        assert got.reduced_chi_square < 1.1
        (_, theta), std = got.chosen[0], got.stds()[effect.key]
        assert theta[:3] / theta[3] == pytest.approx(slope, rel=0.02)
        assert std[3] > 0.5 * theta[3]  # no log of half a minute shows hours
    assert np.abs(theta[:3] / theta[3] - slope).max() < SURE * std[:3].max() / theta[3]
    assert bound(warm_up, free(warm_up, truth)) == pytest.approx(truth)


def test_parameters_change_with_the_free_ones_as_their_slopes_say() -> None:
    warm_up, *_ = gyro_bias_drift.within(catalogue.diagnosed(["gyro_bias_drift"]), 40.0)
    theta, h = np.array([0.02, -0.01, 0.03, 90.0]), 1e-6
    x = free(warm_up, theta)
    differences = np.stack(
        [(bound(warm_up, x + step) - bound(warm_up, x - step)) / (2.0 * h) for step in h * np.eye(4)], axis=1
    )
    assert bound_slopes(warm_up, theta) == pytest.approx(differences, rel=2e-3)
