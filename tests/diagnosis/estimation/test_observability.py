"""What a motion can show of the catalogue: closed forms of what an effect adds, and motions that show little."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from support import planted

from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import Chosen
from imutool.diagnosis.estimation.observability import (
    beyond_the_band,
    unidentified,
    unobservable,
    with_plainer_effects,
    with_steady_clock,
    without_implausible,
)
from imutool.diagnosis.estimation.significance import bic, parameter_cost
from imutool.diagnosis.estimation.trial.effect_forms import in_forms
from imutool.diagnosis.estimation.whitening import WhitenedLog, Whitener
from imutool.diagnosis.settings import SearchSettings
from imutool.sensor import catalogue
from imutool.sensor.effects import clock_wander, gyro_scale

SETTINGS = SearchSettings()
STEPS_HZ = 5.9  # a harmonic of a walk


def shown(felt: object, names: list[str] | None = None, *, noise: float = 1.0, known: np.ndarray | None = None) -> set[str]:
    """What is not seen of some effects, at so many times the planted noise."""
    pair = replace(planted.pair(felt), known=known)
    white = Whitener(np.ones((6, 1)), noise * planted.NOISE)
    log = WhitenedLog(pair, white if known is None else white.counting(known))
    some = [one for one in planted.catalogue() if names is None or one.name in names]
    return set(unobservable([log], some))


def test_a_motion_about_every_axis_shows_every_scale() -> None:
    assert shown(planted.rich(), ["gyro_scale", "gyro_misalignment", "lever_arm", "clock_offset", "mount_rotation"]) == set()


def test_a_planar_robot_shows_no_scale_of_axes_that_never_turn() -> None:
    hidden = shown(planted.planar(), ["gyro_scale", "gyro_misalignment", "gyro_quadratic", "lever_arm"])
    assert hidden == {"gyro_scale.x", "gyro_scale.y", "gyro_quadratic.x", "gyro_quadratic.y", "lever_arm.z"} | {
        f"gyro_misalignment.{entry}" for entry in ("xy", "yx", "zx", "zy")
    }


@pytest.mark.parametrize(("share", "seen"), [(0.98, True), (1.02, False)])
def test_a_number_is_seen_where_its_plausible_size_adds_enough_squares(share: float, seen: bool) -> None:
    felt = planted.planar()
    pair = planted.pair(felt)
    rows = pair.fitted | pair.held_out
    rate = felt.gyro[rows, 2]
    plausible = next(one for one in planted.catalogue() if one.name == "gyro_scale").plausible[2]
    noise = plausible * np.sqrt(((rate - rate.mean()) ** 2).sum() / SETTINGS.observable_squares)
    hidden = shown(felt, ["gyro_scale"], noise=share * noise / planted.NOISE[0])
    assert ("gyro_scale" not in hidden) == seen


def test_what_delays_is_seen_by_a_delay_and_at_rest_by_nothing() -> None:
    felt = planted.planar()
    rest = replace(felt, gyro=0 * felt.gyro, accel=np.tile([0.0, 0.0, 9.81], (len(felt.t_s), 1)), alpha=0 * felt.alpha)
    hidden = shown(replace(rest, R_wb=np.tile(np.eye(3), (len(felt.t_s), 1, 1))))
    assert {"clock_offset", "clock_skew", "clock_jump", "low_pass", "mount_resonance", "lever_arm", "gyro_scale"} <= hidden
    assert not {"vibration", "gyro_bias_drift", "accel_bias_drift"} & hidden


def test_an_axis_of_which_nothing_is_known_shows_nothing() -> None:
    felt = planted.rich()
    known = np.ones((len(felt.t_s), 6), bool)
    known[:, 1] = False
    assert shown(felt, ["gyro_scale", "accel_scale"], known=known) == {"gyro_scale.y"}


@pytest.mark.parametrize(("shares", "beyond"), [([0.5, 0.4, -0.02], False), ([-0.022, -0.035, -0.01], True)])
def test_a_mount_has_no_negative_share(shares: list[float], beyond: bool) -> None:
    log = planted.weighed(planted.pair(planted.shaken(2)))
    ((effect, theta),) = planted.acting({"mount_resonance": [30.0, 0.05, *shares]})
    assert beyond_the_band(effect, theta, [log]) == beyond


@pytest.mark.parametrize(("zeta", "beyond"), [(0.9, False), (17.6, True)])
def test_an_overdamped_mount_is_a_lag_and_no_answer(zeta: float, beyond: bool) -> None:
    """Shares above one of such a mount are a delay (Padé)."""
    log = planted.weighed(planted.pair(planted.shaken(2)))
    ((effect, theta),) = planted.acting({"mount_resonance": [1.0, zeta, 1.9, 2.0, 1.9]})
    assert beyond_the_band(effect, theta, [log]) == beyond


@pytest.mark.parametrize(("sim_noise", "beyond"), [(0.0, False), (1e-3, False), (1e-2, True)])
def test_a_dead_band_within_the_noise_of_a_simulation_is_that_noise(sim_noise: float, beyond: bool) -> None:
    """In rad/s of a sample: what the filter leaves of it at rest, no gyro reads."""
    pair = replace(planted.pair(planted.shaken(2)), sim_noise=np.full(6, sim_noise))
    ((effect, theta),) = planted.acting({"gyro_dead_band": [0.015]})
    assert beyond_the_band(effect, theta, [planted.weighed(pair)]) == beyond


@pytest.mark.parametrize(("periodic", "beyond"), [(True, True), (False, False)])
def test_a_line_of_the_bodys_own_motion_is_no_vibration(periodic: bool, beyond: bool) -> None:
    """A gait repeats itself, and smoothed poses lose a part of each of its lines."""
    felt, rng = planted.shaken(2), np.random.default_rng(2)
    shaken = 0.2 * rng.normal(size=(len(felt.t_s), 3)) + periodic * np.sin(2.0 * np.pi * STEPS_HZ * felt.t_s)[:, None]
    pair = replace(planted.pair(replace(felt, accel=felt.accel + shaken)), band_hz=STEPS_HZ + 2.0)
    ((effect, theta),) = planted.acting({"vibration": [STEPS_HZ, *(0.05 * np.ones(6)), *np.zeros(6)]})
    assert beyond_the_band(effect, theta, [planted.weighed(pair)]) == beyond


RINGS = [4.0, 0.02, 0.0, 0.0, 0.5]  # above the band of these poses, lightly damped, along z alone
POSES_HZ, NEAR_HZ = 2.0, 6.0


@pytest.mark.parametrize(
    ("real", "band_hz", "beyond"), [({}, POSES_HZ, True), ({"mount_resonance": RINGS}, POSES_HZ, False), ({}, NEAR_HZ, False)]
)
def test_a_mount_beyond_the_poses_has_to_ring_in_the_samples(
    real: dict[str, list[float]], band_hz: float, beyond: bool
) -> None:
    felt = planted.shaken(2)
    felt = replace(felt, accel=felt.accel + 0.05 * np.sin(2.0 * np.pi * RINGS[0] * felt.t_s)[:, None])
    log = planted.weighed(replace(planted.pair(felt, real, 1), band_hz=band_hz))
    ((effect, theta),) = planted.acting({"mount_resonance": RINGS})
    assert beyond_the_band(effect, theta, [log]) == beyond


@pytest.mark.parametrize(
    ("truth", "named"), [({"clock_offset": [0.01]}, "clock_offset"), ({"clock_jump": [6.0, 0.01]}, "clock_jump")]
)
def test_a_clock_that_jumps_right_after_the_start_has_an_offset(truth: dict[str, list[float]], named: str) -> None:
    """Where it is right, a jump after a quarter of the log stays one."""
    logs = [planted.weighed(planted.pair(planted.rich(), truth))]
    jump, *others = catalogue.diagnosed(["clock_jump", "clock_offset", "clock_skew"])
    found = fit(logs, ((jump, np.array([1.0 if named == "clock_offset" else 6.0, 0.01])),))
    simpler = with_plainer_effects(found, (jump, *others))
    assert simpler.keys == (named,)
    assert simpler.chosen[0][1][-1] == pytest.approx(0.01, abs=1e-4)


def test_a_clock_that_runs_fast_is_no_jump_in_the_middle_of_the_log() -> None:
    logs = [planted.weighed(planted.pair(planted.rich(), {"clock_skew": [2e-4]}))]
    middle_s = 0.5 * float(logs[0].pair.stamp_s[-1])
    jump, *others = catalogue.diagnosed(["clock_jump", "clock_offset", "clock_skew"])
    found = fit(logs, ((jump, np.array([middle_s, 2e-4 * middle_s])),))
    simpler = with_plainer_effects(found, (jump, *others))
    assert simpler.keys == ("clock_skew",)
    assert simpler.chosen[0][1][0] == pytest.approx(2e-4, rel=0.1)


def test_a_steady_clock_stands_for_one_that_wanders_and_is_given_up_where_it_cannot(monkeypatch: pytest.MonkeyPatch) -> None:
    logs = [planted.weighed(planted.pair(planted.rich(), {"clock_jump": [4.0, 0.01], "clock_skew": [5e-4]}))]
    clocks = catalogue.diagnosed(["clock_offset", "clock_skew", "clock_jump"])
    best = found = fit(logs, ((clock_wander.until(15.0), np.array([0.0, 0.02])),))
    trials: list[tuple[float, Fit]] = []

    def recorded(logs: Sequence[WhitenedLog], begun: Chosen, *, near: Fit, give_up_above: float = np.inf) -> Fit:
        trials.append((give_up_above, fit(logs, begun, near=near, give_up_above=give_up_above)))
        return trials[-1][1]

    monkeypatch.setattr("imutool.diagnosis.estimation.observability.fit", recorded)
    steady = with_steady_clock(found, clocks, {effect.key: logs[0].pair.starts(effect) for effect in clocks})
    assert steady.keys == ("clock_skew", "clock_jump")
    assert len(trials) == 6
    for limit, trial in trials:
        assert limit == pytest.approx(bic(best) - parameter_cost(found, trial.chosen))
        best = min(best, trial, key=bic)
    assert best is steady


@pytest.mark.parametrize(
    ("truth", "begun", "named"),
    [
        ({"gravity": [-0.02, 0.0, 0.0]}, ("accel_scale", [-2e-3] * 3), "gravity"),
        ({"accel_scale": [-2e-3, 2e-3, -2e-3]}, ("accel_scale", [-2e-3, 2e-3, -2e-3]), "accel_scale"),
        ({"accel_scale": [0.02, 0.02, 0.02]}, ("accel_scale", [0.02] * 3), "accel_scale"),  # of no place on Earth
    ],
)
def test_three_equal_scales_are_gravity_within_what_the_earth_has(
    truth: dict[str, list[float]], begun: tuple[str, list[float]], named: str
) -> None:
    logs = [planted.weighed(planted.pair(planted.rich(), truth))]
    effects = catalogue.diagnosed(["accel_scale", "gravity"])
    found = fit(logs, ((effects[0], np.array(begun[1])),))
    assert with_plainer_effects(found, effects).keys == (named,)


def test_a_drift_that_follows_the_logs_temperature_has_that_name() -> None:
    felt = planted.rich()
    warm = {"temperature": 20.0 + 15.0 * (1.0 - np.exp(-felt.t_s / 5.0))}
    truth = {"gyro_bias_drift": [0.02, -0.01, 0.015, 5.0]}
    drift, temperature = catalogue.diagnosed(["gyro_bias_drift", "temperature"])
    for channels, named in ((warm, "temperature"), ({"temperature": 25.0 + np.sin(felt.t_s)}, "gyro_bias_drift")):
        logs = [planted.weighed(planted.pair(replace(felt, channels=channels), truth))]
        found = fit(logs, ((drift, np.array(truth["gyro_bias_drift"])),))
        assert with_plainer_effects(found, (drift, temperature)).keys == (named,)


@pytest.mark.parametrize(
    ("name", "theta", "std", "vague"),
    [
        ("low_pass", (20.0,), (2.0,), ()),
        ("low_pass", (20.0,), (25.0,), ("low_pass.f_c",)),
        ("lever_arm", (6.0, -0.4, 0.1), (0.5, 0.5, 0.2), ("lever_arm.y",)),  # z is as sure as an arm is plausible
    ],
)
def test_a_number_is_unidentified_if_it_is_as_unsure_as_it_is_large(
    name: str, theta: tuple[float, ...], std: tuple[float, ...], vague: tuple[str, ...]
) -> None:
    """A cut-off of 20 Hz, certain to 2 Hz, was told as one that the logs cannot show, and so was an arm of 6 m."""
    first = in_forms(catalogue.effects([name]), exact=False)[0]
    assert tuple(unidentified(first, np.array(theta), np.array(std), curve=False)) == vague


@pytest.mark.parametrize(
    ("name", "theta", "left"),
    [
        ("lever_arm", (3.2, -0.6, 40.0), ["x", "y"]),  # it may sit metres from the tracked point
        ("gyro_scale", (0.01, -1.8, 0.02), ["x", "y", "z"]),  # an axis that reads the opposite, as FETCH's gyro about y
        ("gyro_scale", (-1.0, 0.01, 0.02), ["y", "z"]),  # the motion is noise of the poses, and a scale of -1 takes it away
        ("gyro_scale:step", (-1.0, -0.97, 0.02, 2.2), ["z", "t_step"]),
        ("gyro_scale:step", (-1.0, -0.97, 3.0, 2.2), []),
    ],
)
def test_sizes_that_no_sensor_has_leave(name: str, theta: tuple[float, ...], left: list[str]) -> None:
    (effect,) = (one for one in gyro_scale.in_both_forms(catalogue.diagnosed()) if one.key == name)
    reduced = without_implausible(effect, np.array(theta), SETTINGS.implausible_factor)
    assert [parameter.name for parameter in reduced.parameters] == left
