"""What may be the error of a model is no finding: a clock next to a far larger effect, a scale or an arm next to a low-pass."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, sosfilt, sosfilt_zi
from support import planted
from support.seeds import seeds

from imutool.diagnosis.diagnose import candidates_for
from imutool.diagnosis.estimation import unnamed_effects
from imutool.diagnosis.estimation.gauss_newton import fit
from imutool.diagnosis.estimation.model_selection import select_effects
from imutool.diagnosis.estimation.noise_estimate import whitened
from imutool.diagnosis.estimation.observability import for_noise
from imutool.diagnosis.estimation.time_alignment import with_simulation
from imutool.diagnosis.estimation.trial.model_error import (
    FOLLOWING,
    OF_MOTION,
    LowPassError,
    below_model_error,
    below_reference_error,
    is_over_at_once,
    is_part_of_misfit,
    is_swing_of_motion,
    of_motion,
    with_low_pass_error,
)
from imutool.diagnosis.estimation.trial.selection import SelectedEffect, Selection
from imutool.diagnosis.reference.coverage import without_unseen_offset
from imutool.diagnosis.settings import DiagnoseSettings, SearchSettings
from imutool.recording import Recording
from imutool.sensor import catalogue
from imutool.sensor.effects import gyro_bias_drift

SETTINGS = SearchSettings()
FAST_HZ, RATE_HZ, DURATION_S = 2000, 250, 24.0
CUTOFF_HZ, DAMPING = 12.0, 0.5**0.5
SURE = 4.0


def test_every_effect_with_a_model_error_floor_is_in_the_catalogue() -> None:
    assert {one.name for one in catalogue.diagnosed(sorted(OF_MOTION))} == OF_MOTION


@pytest.mark.parametrize(("denoised", "allowed"), [(False, SETTINGS.model_error), (True, SETTINGS.model_error_denoised)])
def test_a_filter_or_a_clock_must_explain_more_than_a_larger_models_error(denoised: bool, allowed: float) -> None:
    for name in FOLLOWING:
        assert below_model_error({"lever_arm": 1e8, name: 0.9e8 * allowed}, SETTINGS, denoised=denoised, poses=False) == {name}
        assert not below_model_error({"lever_arm": 1e8, name: 1.1e8 * allowed}, SETTINGS, denoised=denoised, poses=False)


def test_a_mass_on_springs_does_more_than_its_model_says() -> None:
    between = 0.5 * SETTINGS.model_error_resonance
    assert below_model_error({"mount_resonance": 1.0, "clock_offset": between}, SETTINGS, denoised=False, poses=False) == {
        "clock_offset"
    }
    assert not below_model_error({"lever_arm": 1.0, "clock_offset": between}, SETTINGS, denoised=False, poses=False)


@pytest.mark.parametrize(
    ("name", "poses", "hidden"), [("mount_resonance", True, True), ("clock_skew", True, False), ("low_pass", False, False)]
)
def test_a_filter_beside_a_clock_of_poses_is_what_the_clock_leaves(name: str, poses: bool, hidden: bool) -> None:
    """The clock of poses drifts to and fro, and a filter fits what one jump of it leaves."""
    assert below_model_error({"clock_jump": 71.0, name: 2.0}, SETTINGS, denoised=False, poses=poses) == (
        {name} if hidden else set()
    )


@pytest.mark.parametrize(("name", "hidden"), [("mount_resonance", True), ("accel_hysteresis", True), ("clock_skew", False)])
def test_a_small_filter_beside_a_low_pass_is_what_another_form_leaves(name: str, hidden: bool) -> None:
    """A recording behind a filter of fourth order, or a moving average."""
    small = 0.5 * SETTINGS.model_error_low_pass
    for key in ("low_pass", "second_order_low_pass:accel"):
        names = {key: key.partition(":")[0], name: name}
        found = below_model_error({key: 1.0, name: small}, SETTINGS, denoised=False, poses=False, names=names)
        assert found == ({name} if hidden else set())


@pytest.mark.parametrize(("name", "hidden"), [("gyro_delay", True), ("gyro_bias_step", False)])
def test_a_small_delay_beside_a_hysteresis_is_a_turn_between_two_samples(name: str, hidden: bool) -> None:
    small = {"gyro_hysteresis": 1.0, name: 0.5 * SETTINGS.model_error_resonance}
    assert below_model_error(small, SETTINGS, denoised=False, poses=False) == ({name} if hidden else set())


@pytest.mark.parametrize(("name", "below"), [("gyro_scale", True), ("gyro_bias_drift", False)])
def test_what_moves_with_the_body_is_more_than_the_rounding_of_a_simulation(name: str, below: bool) -> None:
    felt = planted.rich()
    now = fit([planted.weighed(planted.pair(felt))], ())
    (effect,) = catalogue.diagnosed([name])
    gyro = (planted.ideal(felt)[:, :3] - planted.ideal(felt)[:, :3].mean(axis=0)) / planted.NOISE[0]
    minimum = SETTINGS.model_error_reference * float((gyro[now.logs[0].rows("fitted")] ** 2).sum())
    assert below_reference_error(effect, 0.99 * minimum, now) == below
    assert not below_reference_error(effect, 1.01 * minimum, now)


@pytest.mark.parametrize(("name", "rim"), [("accel_scale", True), ("accel_bias_step", False), ("gyro_scale", False)])
def test_a_name_that_explains_little_of_a_far_larger_misfit_is_its_rim(name: str, rim: bool) -> None:
    """The force follows the cube of the rate, which no effect does: whatever moves as well explains some of it."""
    felt = planted.rich()
    added = np.concatenate([np.zeros_like(felt.gyro), 0.5 * felt.gyro[:, [1, 2, 0]] ** 3], axis=1)
    now = fit([planted.weighed(planted.pair(felt, added=added))], ())
    (effect,) = catalogue.diagnosed([name])
    left = now.objective - now.numbers
    assert is_part_of_misfit(effect, 0.02 * left, now) == rim
    assert not is_part_of_misfit(effect, 0.5 * left, now)


@pytest.mark.parametrize(
    ("name", "theta", "over"),
    [
        ("accel_bias_drift", [-8.0, 5.0, 1.0, 0.14], True),
        ("accel_bias_drift", [-0.8, 0.5, 0.1, 2.0], False),
        ("accel_bias_drift", [30.0, 0.0, 0.0, 5000.0], False),  # of which 24 s show 0.14 m/s²
        ("accel_bias_step", [-8.0, 5.0, 1.0, 0.14], False),
    ],
)
def test_a_drift_that_was_over_before_the_first_sample_has_no_size(name: str, theta: list[float], over: bool) -> None:
    effect = planted.acting({name: theta})[0][0]
    if effect.reached is not None:
        effect = next(gyro_bias_drift.within([effect], planted.DURATION_S))
    assert is_over_at_once(effect, np.array(theta), SETTINGS.implausible_factor) == over


def test_what_has_no_name_follows_the_motion_unless_it_is_a_curve_over_time() -> None:
    like = unnamed_effects.like([planted.pair(planted.rich())])
    unnamed = [*unnamed_effects.curves(like), *unnamed_effects.terms(like)]
    assert {of_motion(effect) for effect in unnamed if effect.of_time} == {False}
    assert {of_motion(effect) for effect in unnamed if not effect.of_time} == {True}


def test_what_does_not_follow_the_motion_is_told_however_faint() -> None:
    assert not below_model_error(
        {"timestamp_jitter": 1e9, "temperature": 300.0, "gyro_scale": 30.0}, SETTINGS, denoised=True, poses=False
    )


def test_an_effect_alone_is_told() -> None:
    assert not below_model_error({"clock_offset": 25.0}, SETTINGS, denoised=True, poses=False)
    assert not below_model_error({}, SETTINGS, denoised=False, poses=False)


# ── next to a low-pass ──


def low_passed(seed: int, vibrates_hz: tuple[float, float], scale: float = 1.0, duration_s: float = DURATION_S) -> Selection:
    """A body that vibrates, on a clock without an epoch: a simulation folds the vibration, and the sensor filters first."""
    rng, t = np.random.default_rng(seed), np.arange(int(duration_s * FAST_HZ)) / FAST_HZ
    slow, wanders = (butter(2, hz, output="sos", fs=FAST_HZ) for hz in (3.0, 0.5))
    motion = np.stack([sosfilt(slow, rng.normal(size=len(t))) * s for s in (8.0, 8.0, 6.0, 15.0, 15.0, 15.0)], axis=1)
    turns = (
        2.0
        * np.pi
        * np.cumsum(np.mean(vibrates_hz) + 2000.0 * np.ptp(vibrates_hz) * 1e-2 * sosfilt(wanders, rng.normal(size=len(t))))
        / FAST_HZ
    )
    vibration = np.cos(turns[:, None] + rng.uniform(0.0, 6.0, 6)) * np.array([0.1] * 3 + [2.0] * 3)
    felt = motion + vibration + [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]
    sos = butter(2, CUTOFF_HZ, output="sos", fs=FAST_HZ)
    read = scale * np.stack([sosfilt(sos, x, zi=sosfilt_zi(sos) * x[0])[0] for x in felt.T], axis=1)
    every = slice(None, None, FAST_HZ // RATE_HZ)
    noise = np.array([1e-3] * 3 + [1e-2] * 3)
    white = rng.normal(size=(2, len(t[every]), 6))
    real = planted.recording("real", t[every], read[every] + planted.BIAS + noise * white[0])
    sim = planted.recording("sim", t[every], felt[every] + 0.3 * noise * white[1], start_ns=5_000_000_000)
    return selected(real, sim)


def selected(real: Recording, sim: Recording) -> Selection:
    """Effects that separate a recording from a simulation."""
    settings = DiagnoseSettings()
    pairs = list(with_simulation(real, sim, settings))
    candidates = candidates_for(pairs)
    logs = [whitened(pair, for_noise(candidates)) for pair in pairs]
    named, always = without_unseen_offset(candidates, pairs)
    return select_effects(logs, named, always=always)


def low_pass(found: Selection) -> SelectedEffect:
    """The low-pass, which is right within its deviations."""
    one = next(one for one in found.selected if one.effect.name == "second_order_low_pass")
    assert (np.abs(one.theta - [CUTOFF_HZ, DAMPING]) < SURE * one.std).all()
    return one


def test_a_low_pass_is_found_although_the_clocks_offset_has_taken_its_lag() -> None:
    found = low_passed(1, (60.0, 90.0), duration_s=10.0)
    assert low_pass(found).std[0] < 0.01 * CUTOFF_HZ
    assert len(found.selected) == 1
    assert found.remarks == ()


def test_a_small_scale_is_told_beside_a_low_pass_by_slow_motion() -> None:
    found = low_passed(0, (60.0, 90.0), scale=1.01, duration_s=10.0)
    assert low_pass(found).std[0] < 0.01 * CUTOFF_HZ
    scales = {one.effect.name: one for one in found.selected[1:]}
    assert scales.keys() == {"gyro_scale", "accel_scale"}
    for one in scales.values():
        np.testing.assert_array_less(np.abs(one.theta - 0.01), SURE * one.std)


def test_what_a_simulation_folds_is_no_effect_but_makes_the_low_pass_less_sure() -> None:
    """A vibration near the sample rate looks like slow motion, which the sensor does not read."""
    found = low_passed(6, (230.0, 270.0))
    assert low_pass(found).std[0] > 0.1 * CUTOFF_HZ
    assert len(found.selected) == 1
    (remark,) = found.remarks
    assert "accel scale" in remark


def test_the_low_pass_of_a_remark_is_said_to_be_of_the_simulations_noise_if_none_is_found() -> None:
    now = fit([planted.weighed(planted.pair(planted.rich(duration_s=DURATION_S)))], ())
    (remark,) = Selection((), now, now, 1, within_error=("mount_resonance",)).remarks
    assert "a low-pass, without which the simulation is noisier" in remark


def test_a_filter_that_only_fits_with_an_endless_damping_is_of_first_order() -> None:
    """Its two parameters have one value together: what came in next to them was chosen by the last bits of a processor."""
    (found,) = low_passed(0, (230.0, 270.0)).selected
    assert found.effect.key == "low_pass:accel"


@pytest.mark.parametrize("seed", seeds(1))
def test_a_faint_low_pass_beside_a_large_arm_is_told_by_the_gyro_and_not_taken_for_scales(seed: int) -> None:
    """The offset of clocks without an epoch has its lag; what it takes is a share of 1e-4 of what the arm does."""
    felt, rng = planted.rich(seed + 1, 60.0), np.random.default_rng(seed + 1)
    noise = np.array([1e-3] * 3 + [1e-2] * 3)
    read = planted.ideal(felt, planted.acting({"lever_arm": [0.25, 0.0, 0.1], "low_pass": [15.0]}))
    real, sim = (x + s * noise * rng.normal(size=x.shape) for x, s in ((read, 1.0), (planted.ideal(felt), 0.3)))
    found = selected(
        planted.recording("real", felt.t_s, real + planted.BIAS),
        planted.recording("sim", felt.t_s, sim, start_ns=5_000_000_000),
    )
    arm, filtered = found.selected
    assert (arm.effect.name, filtered.effect.name) == ("lever_arm", "low_pass")
    assert abs(filtered.theta[0] - 15.0) < SURE * filtered.std[0] < 1.0


def test_what_is_larger_than_a_low_pass_says_nothing_of_its_error() -> None:
    now = fit([planted.weighed(planted.pair(planted.rich()))], ())
    selection, error = Selection((), now, now, 1), LowPassError(size=100.0, squares=0.1, cutoff_hz=CUTOFF_HZ)
    assert with_low_pass_error(selection, error, {"accel_scale": 101.0}) is selection
    assert with_low_pass_error(selection, error, {"accel_scale": 101.0, "lever_arm": 99.0}).within_error == ("lever_arm",)


@pytest.mark.parametrize("A", [(0.0, 0.0, 0.0), (0.02, -0.01, 0.015)])
def test_a_step_has_to_show_beside_what_follows_the_motion_around_it(A: tuple[float, ...]) -> None:
    """Axes whose crosstalk grows with the temperature had three steps of the bias in the first four seconds."""
    felt = planted.rich(3)
    crosstalk = np.exp(-felt.t_s / 8.0)[:, None] * felt.gyro[:, [1, 2, 0]] * 0.3
    stepped = np.outer(felt.t_s > 4.0, A)
    log = planted.weighed(planted.pair(felt, added=np.hstack([crosstalk + stepped, 0.0 * crosstalk])))
    (step,) = catalogue.diagnosed(["gyro_bias_step"])
    for size in ((0.02, -0.01, 0.015), (-0.03, 0.0, 0.03)):
        found = fit([log], ((step, np.array([*size, 3.995])),), iterations=0)
        assert is_swing_of_motion(step, found) == (not any(A))
