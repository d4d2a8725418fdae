"""What blocks of time say of a fit: the truth about noise that lasts, and no more than the information where noise is white."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import norm
from support import planted

from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import Chosen
from imutool.diagnosis.estimation.significance import Scatter, log_p_value, scatter
from imutool.diagnosis.estimation.trial import unseen_time
from imutool.diagnosis.estimation.trial.unseen_time import first_refuted, prediction_p_value
from imutool.diagnosis.estimation.whitening import WhitenedLog, Whitener

FELT = planted.shaken(duration_s=45.0)
SEEDS = 16
LASTS = 0.98  # from one sample at 100 Hz to the next: half a second
SPREAD = (0.7, 1.35)  # of sixteen times three numbers of unit variance, not quite independent
SCALE = [0.02, -0.01, 0.015]


def noisy(seed: int, lasting: bool) -> tuple[WhitenedLog, Fit, Scatter]:
    """A scale that is fitted as if the noise were white."""
    added = None
    if lasting:
        white = np.random.default_rng([seed, 11]).normal(size=(len(FELT.t_s), 6))
        added = 2.0 * planted.NOISE * lfilter([np.sqrt(1.0 - LASTS**2)], [1.0, -LASTS], white, axis=0)
    log = planted.weighed(planted.pair(FELT, {"gyro_scale": SCALE}, seed, added=added))
    found = fit([log], planted.acting({"gyro_scale": [0.0] * 3}), part="all")
    return log, found, scatter(found)


def z(found: Fit, std: np.ndarray) -> np.ndarray:
    return np.asarray((found.chosen[0][1] - SCALE) / std)


def test_an_effect_without_parameters_gains_nothing_by_chance_or_otherwise() -> None:
    """All of its parameters were implausible: a replacement by it would be a replacement by nothing."""
    assert log_p_value(100.0, 0) == 0.0


def test_white_noise_scatters_as_the_information_says() -> None:
    ratio = []
    for seed in range(SEEDS // 2):
        _, found, seen = noisy(seed, lasting=False)
        ratio.append(seen.std["gyro_scale"] / found.stds()["gyro_scale"])
    assert np.min(ratio) >= 1.0  # never surer than the information
    assert np.mean(ratio) < 1.15


def test_noise_that_lasts_spreads_as_the_blocks_say_and_more_than_the_information() -> None:
    stated, honest = [], []
    for seed in range(SEEDS):
        _, found, seen = noisy(seed, lasting=True)
        stated.append(z(found, found.stds()["gyro_scale"]))
        honest.append(z(found, seen.std["gyro_scale"]))
    assert np.std(stated) > 1.5
    assert SPREAD[0] < np.std(honest) < SPREAD[1]


def test_poses_that_err_make_a_scale_as_unsure_as_they_dilute_it() -> None:
    error = 0.2 * np.random.default_rng(3).normal(size=FELT.gyro.shape)  # rad/s, of the expectation
    pair = replace(planted.pair(FELT), ideal=replace(FELT, gyro=FELT.gyro + error), band_hz=40.0)
    log = WhitenedLog(pair, Whitener(np.ones((6, 1)), np.array([0.2] * 3 + [0.03] * 3)))
    found = fit([log], planted.acting({"gyro_scale": [0.0] * 3}), part="all")
    diluted, stated = found.chosen[0][1], scatter(found).std["gyro_scale"]
    simulated = WhitenedLog(replace(pair, band_hz=None), log.whiten)
    blocks = scatter(replace(found, logs=(simulated,))).std["gyro_scale"]
    assert (diluted < -5.0 * blocks).all()  # there is no scale
    assert (np.abs(diluted) < 1.5 * stated).all()


def test_beside_poses_effects_without_a_name_must_not_cancel_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each gains much next to the other, and both together lose; a named effect is no part of it."""
    names = ("gyro_scale", "accel_scale", "gyro_quadratic")
    pair = planted.pair(FELT)
    beside = fit(
        [planted.weighed(replace(pair, band_hz=7.0))], planted.acting({name: [0.0] * 3 for name in names}), part="fitted"
    )
    chosen = tuple(
        (replace(effect, kind="catalogue" if effect.name == "gyro_scale" else "unknown"), x) for effect, x in beside.chosen
    )
    exact = replace(beside, chosen=chosen, logs=(planted.weighed(pair),))

    def gains(now: Fit, others: Chosen, part: str, constant_of: str) -> np.ndarray:
        sign = -1.0 if len(now.chosen) - len(others) > 1 else 1.0
        return np.stack([sign * np.arange(9.0, 13.0), np.ones(4)], axis=1)

    monkeypatch.setattr(unseen_time, "held_out_gains", gains)
    monkeypatch.setattr(unseen_time, "fit", lambda logs, *rest, **options: beside)
    assert first_refuted(replace(beside, chosen=chosen), 0) == 1
    assert first_refuted(replace(beside, chosen=chosen[:2]), 0) == 2, "one alone cancels nothing"
    assert first_refuted(exact, 0) == 3


@pytest.mark.parametrize(("effects", "refuted"), [({}, True), ({"clock_jump": (12.0, 0.004)}, False)])
def test_a_jump_is_judged_over_a_clock_that_is_fitted_without_it(
    effects: dict[str, tuple[float, float]], refuted: bool
) -> None:
    """Clocks without a common epoch: an offset and a jump at the start that takes it back again gain much over either alone."""
    log = planted.weighed(planted.pair(FELT, effects, seed=1))
    begins_s, step_s = effects.get("clock_jump", (0.2, 0.004))
    start = planted.acting({"clock_offset": [0.0 if effects else -step_s], "clock_jump": [begins_s, step_s]})
    found = fit([log], start, iterations=0)
    assert (first_refuted(found, 1) == 1) == refuted
    assert effects or first_refuted(found, 0) == 2, "with each held at its value both seem needed"


def test_a_small_effect_stands_next_to_a_step_that_no_unseen_block_shows() -> None:
    """All unseen blocks lie before 40 s, so that a fit of them knows nothing of the step, which the fitted ones need."""
    truth = {"gyro_bias_step": [0.2, -0.2, 0.1, 40.0], "gyro_scale": [1e-3, -1e-3, 1e-3]}
    log = planted.weighed(planted.pair(FELT, truth))
    assert first_refuted(fit([log], planted.acting(truth)), 0) == 2


def test_a_step_that_no_unseen_block_shows_is_not_judged_by_its_own_fit() -> None:
    """A step in noise: where the blocks of its own fit counted as well, three of five were needed."""
    needed = 0
    for seed in range(8):
        log = planted.weighed(planted.pair(FELT, seed=seed))
        for begins_s in (4.0, 38.0, 41.0):
            found = fit([log], planted.acting({"gyro_bias_step": [0.0, 0.0, 0.0, begins_s]}))
            needed += first_refuted(found, 0) == 1
    assert needed <= 6  # of 24, where a twentieth is expected


def test_a_gain_is_as_likely_as_it_comes_where_noise_lasts() -> None:
    """An effect that is not there: chances below a twentieth come about that often, by chi-square far more."""
    often = {"blocks": 0, "squares": 0}
    for seed in range(SEEDS):
        log, _, _ = noisy(seed, lasting=True)
        start = planted.acting({"gyro_scale": SCALE, "gyro_quadratic": [0.0] * 3})
        whole, without = fit([log], start, part="all"), fit([log], start[:1], part="all")
        gain = without.objective - whole.objective
        often["blocks"] += scatter(whole).log_p_value("gyro_quadratic", gain, 3) < np.log(0.05)
        often["squares"] += gain > 7.81  # chi-square of three, one in twenty
    assert often["blocks"] <= 4  # of sixteen, where one is expected
    assert often["squares"] >= 8


def test_a_time_at_which_something_begins_is_taken_as_it_is() -> None:
    log = planted.weighed(planted.pair(FELT, {"clock_jump": [21.3, 0.02]}))
    found = fit([log], planted.acting({"clock_jump": [20.0, 0.01]}), part="all")
    seen = scatter(found)
    begins, step = seen.std["clock_jump"]
    assert begins == found.stds()["clock_jump"][0]
    assert abs(found.chosen[0][1][1] - 0.02) < 4.0 * step < 1e-3


def test_logs_lend_each_other_their_blocks() -> None:
    logs = [planted.weighed(planted.pair(FELT, {"gyro_scale": SCALE}, seed)) for seed in range(2)]
    begun = planted.acting({"gyro_scale": [0.0] * 3})
    one, both = (scatter(fit(some, begun, part="all")) for some in (logs[:1], logs))
    assert both.blocks["gyro_scale"] > 1.4 * one.blocks["gyro_scale"]
    assert (both.std["gyro_scale"] < one.std["gyro_scale"]).all()


def test_what_the_motion_does_not_show_stays_unsure() -> None:
    felt = planted.planar(60.0)
    log = planted.weighed(planted.pair(felt, {"gyro_scale": [0.0, 0.0, 0.02]}))
    found = fit([log], planted.acting({"gyro_scale": [0.0] * 3}), part="all")
    std = scatter(found).std["gyro_scale"]
    assert (std[:2] > 0.1).all()
    assert std[2] < 1e-3


def test_a_prediction_is_as_sure_as_what_has_no_explanation_lets_it_be() -> None:
    """Sixteen times the squares of noise are left: a fourth of the deviations."""
    blocks = np.tile([1.0, 1.0], (40, 1)) * 1.6
    assert prediction_p_value(blocks, 1.0) == pytest.approx(float(norm.sf(8.0)))
    assert prediction_p_value(blocks, 16.0) == pytest.approx(float(norm.sf(2.0)))
    assert prediction_p_value(0.0 * blocks, 1.0) == 1.0
