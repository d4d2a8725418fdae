"""The right effects and no others: none on noise, one, two, the channel that drives next to its like, none by a wrong name."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy.signal import butter, sosfilt
from scipy.special import gammaincc
from scipy.stats import chi2
from support import planted
from support.seeds import seeds

from imutool.diagnosis.diagnose import candidates_for
from imutool.diagnosis.estimation import model_selection
from imutool.diagnosis.estimation import unnamed_effects as unnamed
from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.candidate_score import Candidates
from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.model_selection import select_effects
from imutool.diagnosis.estimation.noise_estimate import whitened
from imutool.diagnosis.estimation.observability import with_plainer_effects
from imutool.diagnosis.estimation.significance import gain_of, log_p_value
from imutool.diagnosis.estimation.trial import verdicts
from imutool.diagnosis.estimation.trial.effect_forms import exponential, in_forms
from imutool.diagnosis.estimation.trial.filter_forms import with_delay_of_accel, with_form_of_low_pass
from imutool.diagnosis.estimation.trial.selection import Selection
from imutool.diagnosis.estimation.trial.sensor_filters import with_filter_of_each_sensor
from imutool.diagnosis.estimation.trial.walking_bias import std_of_unseen_walk, with_bias_walk
from imutool.diagnosis.settings import SearchSettings
from imutool.processes.forked import Forked
from imutool.sensor import catalogue
from imutool.sensor.effects import clock_wander, gyro_bias_drift, gyro_bias_step, gyro_scale
from imutool.sensor.samples import IdealMotion
from imutool.units import SENSORS

SURE = 4.0
DURATION_S = 20.0
NULL_SEEDS, WITH_ALL = 5, 1  # what has no name takes a second more
TAIL = 0.02  # in natural logarithms: what the next term of the tail's expansion takes for nine parameters

SINGLE = {
    "lever_arm": [0.2, -0.05, 0.1],
    "clock_offset": [0.01],
    "low_pass": [12.0],
    "second_order_low_pass": [5.0, 0.7],
    "gyro_scale": [0.02, -0.03, 0.01],
    "accel_misalignment": [0.01, -0.02, 0.005, 0.01, -0.01, 0.02],
    "mount_rotation": [0.03, -0.02, 0.04],
    "gyro_g_sensitivity": [1e-3, 0.0, 0.0, 0.0, -1e-3, 0.0, 0.0, 0.0, 2e-3],
    "gravity": [0.05, 0.02, -0.02],
    "gyro_scale_asymmetry": [0.05, -0.04, 0.06],
    "gyro_hysteresis": [0.01],
    "gyro_delay": [0.004],
    "gyro_scale_drift": [1e-3, -5e-4, 2e-3],
}


def asked(pair: Pair, beyond: bool = True) -> Selection:
    """The catalogue, then (beyond it) channels, then what has no name."""
    if not beyond:
        return select_effects([planted.weighed(pair)], planted.catalogue())
    like = unnamed.like([pair])
    later = [tuple(unnamed.driven([pair])), (*unnamed.curves(like), *unnamed.terms(like))]
    return select_effects([planted.weighed(pair)], planted.catalogue(), later)


def names(found: Selection) -> list[str]:
    return [one.effect.key for one in found.selected]


@pytest.mark.parametrize("turned", [[0.0, 0.0, np.pi / 2], [-2.2214, 2.2214, 0.0], [1.2, 1.2, -1.2]])
def test_a_sensor_may_be_mounted_in_any_direction(turned: list[float]) -> None:
    """By a right angle, upside down, with its axes exchanged: no fit from no rotation gets there."""
    found = select_effects([planted.weighed(planted.pair(planted.shaken(2), {"mount_rotation": turned}))], planted.catalogue())
    assert names(found) == ["mount_rotation"]
    assert found.selected[0].theta == pytest.approx(turned, abs=1e-3)


def sure(found: Selection, name: str, truth: list[float]) -> bool:
    one = next(one for one in found.selected if one.effect.key == name)
    return bool((np.abs(one.theta - truth) < SURE * one.std).all())


FORMS = {
    "exponential smoothing": ("low_pass", {"f_c": 9.0, "rate": math.inf, "order": 1.0, "smoothing_rate": planted.RATE_HZ}),
    "a share that lags": ("gyro_hysteresis", {"width": 0.3, "share": 0.1}),
    "a damper at rest": (
        "mount_resonance",
        {"f0": 12.0, "zeta": 0.15, "share_x": 0.6, "share_y": 0.4, "share_z": 0.8, "damper": 0.0},
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_an_effect_of_another_form_is_no_sum_of_others(form: str) -> None:
    """A hysteresis of a tenth of the reading was a scale, a delay and a low-pass that cancelled a clock's offset."""
    name, truth = FORMS[form]
    motion, f_hz = planted.rich(), np.linspace(2.0, 25.0, 24)
    trembles = np.sin(2.0 * np.pi * f_hz * motion.t_s[:, None] + f_hz**2) @ np.full((24, 3), 0.3)
    motion = replace(motion, accel=motion.accel + trembles)
    (one,) = asked(planted.pair(motion, {name: list(truth.values())}, 4), beyond=False).selected
    assert one.effect.name == name
    fitted = [parameter.name for parameter in one.effect.parameters]
    assert one.theta == pytest.approx([truth[parameter] for parameter in fitted], rel=0.1)
    assert {parameter.name: value for parameter, value in one.effect.constants} == {
        key: value for key, value in truth.items() if key == "damper"
    }


def test_nothing_is_found_where_there_is_nothing_to_try() -> None:
    """As where all of a misfit lies in a reference's own moments."""
    assert not select_effects([planted.weighed(planted.pair(planted.rich(), {}, 0))], ()).selected


# ── a bias that walks ──

WALK_S, CORNER_HZ = 60.0, 0.1  # where the walk and the white noise have one density


def walking(effects: dict[str, list[float]], seed: int) -> Pair:
    count = len(planted.clock(WALK_S))
    steps = 2.0 * np.pi * CORNER_HZ / planted.RATE_HZ * planted.noise(count, seed + 100)
    return planted.pair(planted.rich(duration_s=WALK_S), effects, seed, added=np.cumsum(steps, axis=0))


def test_a_bias_that_walks_is_no_drift() -> None:
    assert names(asked(walking({}, 2), beyond=False)) == []


@pytest.mark.parametrize(("sensor", "corner_hz", "seed"), [("gyro", 0.1, 5), ("accel", 0.05, 1)])
def test_a_bias_that_walks_is_no_step_however_fast_and_whatever_the_other_sensor_does(
    sensor: str, corner_hz: float, seed: int
) -> None:
    assert names(asked(walking_fast(sensor, corner_hz, seed), beyond=False)) == []


@pytest.mark.parametrize(("seed", "beyond"), [(6, False), (4, True)])
def test_a_bias_that_walks_fast_neither_follows_the_motion_nor_is_a_curve(seed: int, beyond: bool) -> None:
    assert names(asked(walking_fast("gyro", 1.5, seed), beyond)) == []


def walking_fast(sensor: str, corner_hz: float, seed: int) -> Pair:
    felt = planted.rich(seed + 1, WALK_S)
    steps = 2.0 * np.pi * corner_hz / planted.RATE_HZ * planted.noise(len(felt.t_s), seed + 1000)
    steps *= np.repeat([sensor != "accel", sensor != "gyro"], 3)
    return planted.pair(felt, {}, seed, added=np.cumsum(steps, axis=0))


STEPS = {
    "in the middle": {"gyro_bias_step": [0.01, -0.005, 0.0, 13.3]},
    "before all held-out time": {"accel_bias_step": [0.0, 0.1, 0.0, 7.7]},
    "within held-out time, beside an arm": {"accel_bias_step": [0.03, 0.0, 0.0, 9.0], "lever_arm": [0.1, 0.0, 0.2]},
    "beside a drift": {"gyro_bias_step": [0.005, 0.0, 0.0, 13.3], "gyro_bias_drift": [0.02, 0.02, -0.03, 8.0]},
}


@pytest.mark.parametrize("case", STEPS)
def test_a_step_of_a_bias_is_found_wherever_it_lies(case: str) -> None:
    found = asked(planted.pair(planted.rich(), STEPS[case], 3), beyond=False)
    assert sorted(names(found)) == sorted(STEPS[case])
    assert all(sure(found, name, theta) for name, theta in STEPS[case].items())


@pytest.mark.parametrize(("sensor", "scale"), [("gyro", [0.05, -0.03, 0.04]), ("accel", [0.02, 0.03, -0.02])])
def test_a_scale_that_sets_in_is_that_scale_with_its_time(sensor: str, scale: list[float]) -> None:
    """It was a scale that grows with the time, and steps of the bias."""
    motion = planted.rich()
    added = np.where(np.arange(6) // 3 == ("gyro", "accel").index(sensor), [*scale, *scale], 0.0) * planted.ideal(motion)
    pair = planted.pair(motion, {}, 3, added=added * (motion.t_s >= 13.3)[:, None])
    (one,) = select_effects([planted.weighed(pair)], tuple(gyro_scale.in_both_forms(planted.catalogue()))).selected
    assert (one.effect.name, [parameter.name for parameter in one.effect.parameters]) == (f"{sensor}_scale", [*"xyz", "t_step"])
    assert (np.abs(one.theta - [*scale, 13.3]) < SURE * one.std).all()


def test_a_mount_that_slips_is_that_rotation_with_its_time() -> None:
    """It was a step of the accelerometer's bias; beside poses it was half of the rotation, throughout."""
    motion, phi = planted.rich(), [0.02, -0.03, 0.04]
    slips = planted.ideal(motion, planted.acting({"mount_rotation": phi})) - planted.ideal(motion)
    pair = planted.pair(motion, {}, 3, added=slips * (motion.t_s >= 13.3)[:, None])
    (one,) = select_effects([planted.weighed(pair)], tuple(gyro_scale.in_both_forms(planted.catalogue()))).selected
    assert (one.effect.name, one.effect.parameters[-1].name) == ("mount_rotation", "t_step")
    assert (np.abs(one.theta - [*phi, 13.3]) < SURE * one.std).all()


def test_a_gyro_that_becomes_late_is_no_jump_of_the_clock() -> None:
    """The clock was said to jump; behind the jump the accelerometer was thirty times farther off than without."""
    motion = planted.rich()
    late = planted.ideal(motion, planted.acting({"clock_offset": [-0.015]})) - planted.ideal(motion)
    from_half_on = np.outer(motion.t_s >= 13.3, [1.0] * 3 + [0.0] * 3)
    assert "clock_jump" not in names(asked(planted.pair(motion, {}, 3, added=late * from_half_on)))


@pytest.mark.parametrize(
    ("name", "theta"),
    [("gyro_delay", [0.006]), ("gyro_g_sensitivity", [1e-3, 0.0, 5e-4, 0.0, -1e-3, 0.0, 3e-4, 0.0, 8e-4])],
)
def test_an_error_of_the_gyro_that_sets_in_has_its_name_and_time(name: str, theta: list[float]) -> None:
    """A gyro that became late by 6 ms was a clock that jumped for both sensors; a g-sensitivity had no name."""
    motion = planted.rich()
    error = planted.ideal(motion, planted.acting({name: theta})) - planted.ideal(motion)
    pair = planted.pair(motion, {}, 3, added=error * (motion.t_s >= 13.3)[:, None])
    (one,) = select_effects([planted.weighed(pair)], tuple(gyro_scale.in_both_forms(planted.catalogue()))).selected
    assert (one.effect.name, one.effect.parameters[-1].name) == (name, "t_step")
    assert (np.abs(one.theta - [*theta, 13.3]) < SURE * one.std).all()


def several_times(pair: Pair) -> Selection:
    """The catalogue, with what may act more than once."""
    forms = gyro_bias_step.repeated([*gyro_bias_drift.within(planted.catalogue(), float(pair.stamp_s[-1]))])
    return select_effects([planted.weighed(pair)], tuple(forms))


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
@pytest.mark.parametrize("times_s", [(17.3, 41.9), (12.1, 24.7, 44.2)])
def test_a_bias_may_step_several_times(sensor: str, times_s: tuple[float, ...]) -> None:
    """Two steps had no name: each alone leaves a curve that a walk explains as well."""
    motion, steps = planted.rich(duration_s=WALK_S), 0.02 * np.array([[1.0, -0.5, 0.2], [-1.0, -0.6, 0.7], [0.5, 0.9, -1.0]])
    steps = steps * (1.0 if sensor == "gyro" else 5.0)
    added = np.zeros((len(motion.t_s), 6))
    for size, t_s in zip(steps, times_s, strict=False):
        added[:, :3] += np.outer(motion.t_s >= t_s, size)
    found = several_times(planted.pair(motion, {}, 3, added=added if sensor == "gyro" else np.roll(added, 3, axis=1)))
    assert {one.effect.name for one in found.selected} == {f"{sensor}_bias_step"}
    selected = sorted(found.selected, key=lambda one: one.theta[3])
    assert len({one.effect.equation for one in selected}) == len(times_s)  # by which a finding is told from another
    for one, size, t_s in zip(selected, steps, times_s, strict=False):
        assert (np.abs(one.theta - [*size, t_s]) < SURE * one.std).all()


def test_a_bias_may_settle_with_two_time_constants() -> None:
    """A sensor turned on: the second was a step that is none, and a curve."""
    motion = planted.rich(duration_s=WALK_S)
    fast, slow = (np.outer(-np.expm1(-motion.t_s / tau_s), [0.03, -0.02, 0.04]) for tau_s in (5.0, 40.0))
    added = np.concatenate([fast - slow[:, ::-1], np.zeros_like(fast)], axis=1)
    found = several_times(planted.pair(motion, {}, 3, added=added)).selected
    assert [one.effect.name for one in found] == ["gyro_bias_drift"] * 2
    assert sorted(one.theta[3] for one in found) == pytest.approx([5.0, 40.0], rel=0.15)


@pytest.mark.parametrize(("corner_hz", "seed"), [(0.05, 2), (0.1, 5), (0.3, 7), (1.2, 3)])
def test_a_bias_that_walks_steps_and_drifts_no_number_of_times(corner_hz: float, seed: int) -> None:
    """Of two drifts that nearly cancel each is needed next to the other, and both together are a walk."""
    steps = 2.0 * np.pi * corner_hz / planted.RATE_HZ * planted.noise(len(planted.clock(WALK_S)), seed + 1000)
    walk = np.cumsum(steps, axis=0)
    assert names(several_times(planted.pair(planted.rich(seed + 1, WALK_S), {}, seed, added=walk))) == []


def test_an_effect_is_found_with_its_uncertainty_beside_a_bias_that_walks() -> None:
    found = asked(walking({"accel_scale": SINGLE["gyro_scale"]}, 1), beyond=False)
    assert names(found) == ["accel_scale"]
    assert sure(found, "accel_scale", SINGLE["gyro_scale"])


def test_sizes_are_as_unsure_as_a_walk_too_slow_to_be_found_makes_them() -> None:
    """Deviations by the white noise alone are two to five times too small: the rate's corner is at one turn of the log."""
    felt, step, off = planted.shaken(duration_s=WALK_S), [0.02, -0.01, 0.03, 25.0], []
    for seed in range(8):
        walk = np.cumsum(2.0 * np.pi * 0.02 / planted.RATE_HZ * planted.noise(len(felt.t_s), seed + 50), axis=0)
        one = planted.pair(felt, {"gyro_bias_step": step}, seed, added=walk)
        found = fit([planted.weighed(one)], planted.acting({"gyro_bias_step": step}), part="all", hold_onsets=True)
        std = found.stds()["gyro_bias_step"], std_of_unseen_walk(found)["gyro_bias_step"]
        off += [((found.chosen[0][1] - step) / s)[:3] for s in (std[0], np.hypot(*std))]
    white, both = (np.sqrt(np.mean(np.square(off[k::2]))) for k in (0, 1))
    assert white > 1.5 > both > 0.6, (white, both)


def test_a_misfit_that_follows_the_motion_is_no_walk() -> None:
    pair = planted.pair(planted.shaken(), {"gyro_scale": [0.05, -0.05, 0.05]})
    without = fit([planted.weighed(pair)], ())
    assert with_bias_walk(without) is without


def test_a_drift_is_a_drift_and_no_walk() -> None:
    drift = [0.01, -0.02, 0.01, 20.0]
    pair = planted.pair(planted.rich(duration_s=WALK_S), {"gyro_bias_drift": drift})
    found = asked(pair, beyond=False)
    assert names(found) == ["gyro_bias_drift"]
    assert sure(found, "gyro_bias_drift", drift)


# ── two gains of an axis ──


def test_two_gains_of_an_axis_that_never_changes_its_sign_are_a_scale() -> None:
    pair = planted.pair(planted.rich(), {"accel_scale": [0.0, 0.0, 0.02]})
    logs, named = [planted.weighed(pair)], planted.catalogue()
    told = fit(logs, planted.acting({"accel_scale_asymmetry": [0.0] * 3}))
    assert with_plainer_effects(told, named).keys == ("accel_scale",)


def test_two_gains_beside_a_scale_are_both_named() -> None:
    found = asked(planted.pair(planted.shaken(), {"gyro_scale": [0.03] * 3, "gyro_scale_asymmetry": [0.06] * 3}), beyond=False)
    assert sorted(names(found)) == ["gyro_scale", "gyro_scale_asymmetry"]
    assert sure(found, "gyro_scale_asymmetry", [0.06] * 3)


def test_a_wrong_reference_leaves_no_candidate_and_no_finding() -> None:
    assert names(select_effects([planted.weighed(planted.pair(planted.rich()))], ())) == []


# ── lines ──

BAND_HZ, PASSED, WHITE = (18.0, 24.0), 2.0, 0.3


@pytest.mark.parametrize("line_m_s2", [0.0, 0.03])
def test_noise_that_a_filter_has_coloured_is_no_vibration_and_a_line_on_it_is_one(line_m_s2: float) -> None:
    felt = planted.rich(duration_s=60.0)
    white = planted.noise(6000, 51)
    passed = sosfilt(butter(2, BAND_HZ, "bandpass", fs=planted.RATE_HZ, output="sos"), white, axis=0)
    line = line_m_s2 * np.sin(2.0 * np.pi * 33.3 * felt.t_s)[:, None] * [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]
    pair = planted.pair(felt, seed=51, added=PASSED * passed - (1.0 - WHITE) * white + line)
    found = select_effects([whitened(pair, ())], catalogue.diagnosed(["vibration"]))
    assert names(found) == (["vibration"] if line_m_s2 else [])


@pytest.mark.parametrize("turns", [0.0, 0.05], ids=["steady", "turning"])
def test_a_line_that_turns_its_phase_is_no_vibration(turns: float) -> None:
    """As of a motor, whose speed is never quite constant."""
    felt = planted.rich(duration_s=60.0)
    phase = turns * np.cumsum(np.random.default_rng(4).normal(size=len(felt.t_s)))
    line = np.sin(2.0 * np.pi * 31.0 * felt.t_s + phase)[:, None] * [0.0, 0.0, 0.0, 0.1, 0.1, 0.4]
    pair = planted.pair(felt, seed=52, added=line)
    found = select_effects([whitened(pair, ())], catalogue.diagnosed(["vibration"]))
    assert names(found) == ([] if turns else ["vibration"])


# ── a misfit of another form ──

DRAG_S, LATE_S = 0.25, 0.02  # of a velocity's acceleration, 1/s; of an accelerometer


def with_force(seed: int, what: str) -> Pair:
    """A flight whose accelerometer reads a drag against the velocity that no simulation knew, or is late."""
    felt, path = planted.rich(seed, 60.0), planted.moving(seed, 60.0)
    motion = path.at(path.start_ns + np.round(felt.t_s * 1e9).astype(np.int64))
    added = np.zeros((len(felt.t_s), 6))
    if what == "drag":
        assert motion.v_w is not None
        added[:, 3:] = -DRAG_S * np.einsum("nji,nj->ni", felt.R_wb, motion.v_w)
    else:
        late = np.stack([np.interp(felt.t_s - LATE_S, felt.t_s, column) for column in felt.accel.T], axis=1)
        added[:, 3:] = late - felt.accel
    return planted.pair(felt, {}, seed, added=added)


def test_what_grows_with_the_velocity_is_no_hysteresis_of_which_much_is_left() -> None:
    assert names(asked(with_force(3, "drag"), beyond=False)) == []


@pytest.mark.parametrize("what", ["late", "drag"])
def test_a_late_accelerometer_is_no_hysteresis_and_what_a_delay_leaves_is_no_delay(what: str) -> None:
    logs = [planted.weighed(with_force(1, what))]
    (hysteresis,) = (one for one in planted.catalogue() if one.name == "accel_hysteresis" and not one.variant)
    found = with_delay_of_accel(fit(logs, ((hysteresis, np.array([0.1])),)), planted.catalogue())
    both = {effect.name: float(theta[0]) for effect, theta in found.chosen}
    if what == "late":
        assert both == {name: pytest.approx(-LATE_S, abs=1e-3) for name in ("clock_offset", "gyro_delay")}
    else:
        assert list(both) == ["accel_hysteresis"]


@pytest.mark.parametrize("clock_s", [0.0, -0.005])
def test_a_second_order_filter_of_the_accelerometer_that_shows_its_lag_alone_is_that_lag(clock_s: float) -> None:
    truth = {"clock_offset": [clock_s - 0.003], "gyro_delay": [-0.003]}
    logs = [planted.weighed(planted.pair(trembling(6.0), truth))]
    of = {one.key: one for one in planted.catalogue()}
    clock = [(of["clock_offset"], np.array([clock_s]))] if clock_s else []
    wrong = fit(logs, (*clock, (of["second_order_low_pass:accel"], np.array([70.0, 0.7]))))
    found = with_delay_of_accel(wrong, planted.catalogue())
    assert {effect.name: theta for effect, theta in found.chosen} == {
        name: pytest.approx(theta, abs=2e-4) for name, theta in truth.items()
    }


def by_poses(pair: Pair) -> Selection:
    """What a recording's own poses show."""
    known = replace(pair, band_hz=7.0)
    return select_effects([planted.weighed(known)], candidates_for([known]))


NO_FILTER = "low_pass", [math.inf]


@pytest.mark.parametrize(
    ("of_gyro", "of_accel", "late_s"),
    [
        (NO_FILTER, ("low_pass", [15.0]), 0.0),
        (NO_FILTER, ("low_pass", [12.0]), 0.02),
        (("low_pass", [20.0]), ("low_pass", [10.0]), 0.0),
        (NO_FILTER, ("second_order_low_pass", [8.0, 0.7]), 0.0),
    ],
)
def test_poses_show_the_filter_of_a_sensor(
    of_gyro: tuple[str, list[float]], of_accel: tuple[str, list[float]], late_s: float
) -> None:
    """A clock that follows the slower sensor is found first, and had two to five wrong names with it."""
    found = by_poses(through(trembling(6.0), of_gyro, of_accel, late_s))
    each = zip(SENSORS, (of_gyro, of_accel), strict=True)
    filters = {f"{name}:{sensor}": theta for sensor, (name, theta) in each if math.isfinite(theta[0])}
    assert sorted(names(found)) == sorted([*filters, *(["clock_offset"] if late_s else [])])
    assert all(sure(found, key, theta) for key, theta in filters.items())


@pytest.mark.parametrize("effects", [{"clock_offset": [-0.01], "gyro_delay": [-0.01]}, {"gyro_delay": [0.004]}], ids="+".join)
def test_poses_show_that_a_sensor_is_late_and_filters_nothing(effects: dict[str, list[float]]) -> None:
    found = by_poses(planted.pair(trembling(3.0), effects))
    assert sorted(names(found)) == sorted(effects)


def test_filters_that_poses_cannot_show_leave_room_for_what_they_do_show() -> None:
    """Three of them promised most, none was an answer, and the search ended before it came to the scale."""
    truth = {"low_pass": [60.0], "gyro_scale": [0.005, -0.005, 0.005]}
    pair = replace(planted.pair(trembling(9.0), truth), band_hz=7.0)
    candidates = [one for one in candidates_for([pair]) if one.name == "low_pass" or one.key == "gyro_scale"]
    assert names(select_effects([planted.weighed(pair)], candidates)) == ["gyro_scale"]


# ── log_p_value ──


@pytest.mark.parametrize("k", [1, 2, 3, 6, 9])
def test_chance_is_the_tail_of_chi_square(k: int) -> None:
    for gain in (0.0, 1.0, 10.0, 100.0, 500.0):
        assert log_p_value(gain, k) == pytest.approx(float(np.log(gammaincc(k / 2.0, gain / 2.0))), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("k", [1, 2, 3, 6, 9])
def test_chance_goes_on_smoothly_where_the_tail_is_less_than_a_number_holds(k: int) -> None:
    gains = np.concatenate([np.arange(500.0, 1600.0, 1.0), np.geomspace(1600.0, 1e8, 200)])
    log_p = np.array([log_p_value(float(gain), k) for gain in gains])
    assert np.isfinite(log_p).all()
    assert (np.diff(log_p) < 0).all()
    step = np.diff(log_p[:1100])
    # each square costs half a logarithm, less what the power in front of the exponential gives back: (k/2 - 1) / 250
    assert np.abs(step + 0.5).max() < 0.016 + TAIL
    with np.errstate(divide="ignore"):
        known = chi2.logsf(gains[:900], k)
    np.testing.assert_allclose(log_p[:900][np.isfinite(known)], known[np.isfinite(known)], atol=TAIL)


def test_chance_of_two_parameters_is_known_in_closed_form() -> None:
    for gain in (1.0, 599.0, 601.0, 1e4, 1e7):
        assert log_p_value(gain, 2) == pytest.approx(-gain / 2.0, rel=1e-12)


def test_more_parameters_need_a_larger_gain() -> None:
    for gain in (30.0, 1000.0):
        log_p = [log_p_value(gain, k) for k in (1, 3, 6, 9)]
        assert log_p == sorted(log_p)


def test_a_loss_is_no_evidence() -> None:
    assert log_p_value(-5.0, 3) == 0.0


# ── the order of candidates ──


def test_the_best_candidates_are_the_same_whether_all_are_derived_anew_or_only_the_likely_ones() -> None:
    effects = {name: SINGLE[name] for name in ("gyro_scale", "lever_arm", "low_pass")}
    logs = [planted.weighed(planted.pair(planted.rich(3, DURATION_S), effects, 3))]
    screened, few = Candidates(logs, planted.catalogue()), 3
    first = fit(logs, ())
    screened.ranked(first, planted.catalogue())
    for names_of in (["lever_arm"], ["lever_arm", "gyro_scale"], ["lever_arm", "gyro_scale", "low_pass"], ["gyro_scale"]):
        now = fit(logs, planted.acting({name: SINGLE[name] for name in names_of}))
        best = screened.ranked(now, planted.catalogue(), few)
        every = Candidates(logs, planted.catalogue()).ranked(now, planted.catalogue())
        assert [scored.effect.key for scored in best[:few]] == [scored.effect.key for scored in every[:few]]
        assert [scored.gain for scored in best[:few]] == [scored.gain for scored in every[:few]]
        if "low_pass" not in names_of:
            assert len(best) < len(every)


# ── nothing ──


@pytest.mark.parametrize("seed", seeds(NULL_SEEDS))
def test_noise_and_a_bias_are_nothing(seed: int) -> None:
    pair = planted.pair(planted.rich(seed, DURATION_S), None, seed)
    found = asked(pair, beyond=seed < WITH_ALL)
    assert names(found) == []
    np.testing.assert_allclose(found.whole.bias[0], planted.BIAS, atol=float(SURE * planted.NOISE[3] / np.sqrt(1000)))
    assert found.tried > len(planted.catalogue())


def test_the_first_effect_that_goes_in_any_case_is_the_one_that_all_verdicts_name(monkeypatch: pytest.MonkeyPatch) -> None:
    logs, candidates = (
        [planted.weighed(planted.pair(planted.rich(4, DURATION_S), {"gyro_scale": [0.02, 0.0, 0.01]}, 4))],
        planted.catalogue(),
    )
    now = fit(logs, planted.acting({"gyro_scale": [0.02, 0.0, 0.01], "accel_scale": [0.0] * 3, "clock_offset": [0.0]}))
    known = Candidates(logs, candidates)
    search = model_selection._Search(logs, candidates, (), (), lambda word: None, known, before=fit(logs, ()).objective)
    short = search.tested(now)
    monkeypatch.setattr(verdicts, "FOLLOWING", frozenset(now.keys))  # whatever it is, the others may matter to it
    whole = search.tested(now)
    assert names(short) == names(whole) == ["gyro_scale"]
    np.testing.assert_array_equal(short.selected[0].theta, whole.selected[0].theta)
    assert short.selected[0].gain == whole.selected[0].gain


def test_the_first_effect_is_tried_alone_where_unseen_time_refutes_all_that_came_in(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = {"gyro_scale": [0.02, -0.03, 0.01], "lever_arm": [0.2, -0.05, 0.1]}
    log = planted.weighed(planted.pair(planted.rich(4, DURATION_S), truth, 4))
    tested = list[tuple[str, ...]]()

    def refuted(now: Fit, first: int) -> int:
        tested.append(now.keys)
        return first if len(tested) < 3 else len(now.chosen)

    monkeypatch.setattr(verdicts, "first_refuted", refuted)
    found = select_effects([log], planted.catalogue())
    both, last, alone = tested
    assert sorted(both) == sorted(truth)
    assert (last, alone) == (both[1:], both[:1])
    assert names(found) == list(alone)


@pytest.mark.parametrize("model_error", [1e-9, 0.5])
def test_of_what_comes_after_a_refuted_effect_only_a_bound_is_asked_unless_it_could_hide_one(
    model_error: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = {"clock_offset": [0.001], "gyro_scale": [0.02, 0.0, 0.01], "lever_arm": [0.1, -0.1, 0.05]}
    pair = planted.pair(planted.rich(4, DURATION_S), truth, 4)
    search_settings = msgspec.structs.replace(pair.settings.search, model_error=model_error)
    log = planted.weighed(replace(pair, settings=msgspec.structs.replace(pair.settings, search=search_settings)))
    candidates, now = planted.catalogue(), fit([log], planted.acting(truth), part="all")
    asked_of = list[tuple[int, int | None]]()

    def recorded(whole: Fit, k: int, iterations: int | None = None) -> tuple[float, float]:
        asked_of.append((k, iterations))
        return gain_of(whole, k, iterations)

    monkeypatch.setattr(verdicts, "gain_of", recorded)
    known = Candidates([log], candidates)
    search = model_selection._Search([log], candidates, (), (), lambda word: None, known, before=0.0)
    offset, *_ = search.verdicts(now, 0, Forked(lambda: 1))
    assert (offset.false_discovery_rate == 1.0) == (model_error == 0.5)
    assert asked_of == [(0, 1), (0, None), (1, 0), (2, 0), *([(1, None), (2, None)] if model_error == 0.5 else [])]
    assert all(gain_of(now, k)[0] <= gain_of(now, k, 0)[0] for k in range(3))


def test_unseen_time_is_not_waited_for_where_chance_explains_the_first_effect() -> None:
    truth = {"gyro_scale": [0.02, 0.0, 0.01]}
    log = planted.weighed(planted.pair(planted.rich(4, DURATION_S), truth, 4))
    candidates = planted.catalogue()
    known = Candidates([log], candidates)
    search = model_selection._Search([log], candidates, (), (), lambda word: None, known, before=0.0)

    def unseen() -> int:
        raise AssertionError("nobody needs it")

    chance = fit([log], planted.acting({"accel_scale": [0.0] * 3, **truth}), part="all")
    assert search.verdicts(chance, 0, Forked(unseen)) == []
    with pytest.raises(AssertionError, match="nobody needs it"):
        search.verdicts(fit([log], planted.acting(truth), part="all"), 0, Forked(unseen))


# ── one, two ──


@pytest.mark.parametrize("name", SINGLE)
def test_a_single_effect_is_found_alone_and_by_its_name(name: str) -> None:
    found = asked(
        planted.pair(planted.rich(2, DURATION_S), {name: SINGLE[name]}, 2),
        beyond=name in ("lever_arm", "low_pass"),
    )
    assert names(found) == [name]
    assert sure(found, name, SINGLE[name])
    assert found.selected[0].false_discovery_rate <= SearchSettings().false_discovery_rate
    assert found.selected[0].unidentified == ()


@pytest.mark.parametrize(
    "both", [("lever_arm", "clock_offset"), ("gyro_scale", "low_pass"), ("mount_rotation", "accel_misalignment")], ids="+".join
)
def test_a_pair_is_found_both_by_name(both: tuple[str, str]) -> None:
    effects = {name: SINGLE[name] for name in both}
    found = asked(planted.pair(planted.rich(3, DURATION_S), effects, 3), beyond=False)
    assert sorted(names(found)) == sorted(both)
    assert found.selected[0].gain >= found.selected[1].gain  # strongest first
    assert all(sure(found, name, effects[name]) for name in both)


@pytest.mark.parametrize(
    ("small", "share", "found"),
    [
        ("accel_scale", 0.0, ["lever_arm", "accel_scale"]),
        ("accel_scale", 0.2, ["lever_arm"]),
        ("gyro_scale", 0.2, ["lever_arm", "gyro_scale"]),
    ],
)
def test_a_search_ends_at_an_effect_that_is_negligible_beside_the_largest_of_its_axes(
    small: str, share: float, found: list[str]
) -> None:
    """A model of large accelerations that is a little wrong leaves nothing in the gyro."""
    log = planted.pair(planted.rich(3, DURATION_S), {"lever_arm": [0.4, -0.1, 0.2], small: [4e-3, 0.0, 0.0]}, 3)
    search = msgspec.structs.replace(log.settings.search, negligible_share=share)
    log = replace(log, settings=msgspec.structs.replace(log.settings, search=search))
    assert names(asked(log, beyond=False)) == found


def test_two_logs_show_together_what_each_shows_alone() -> None:
    logs = [
        planted.weighed(planted.pair(planted.rich(seed, DURATION_S), {"lever_arm": [0.1, 0.0, 0.05]}, seed)) for seed in (4, 5)
    ]
    found = select_effects(logs, planted.catalogue())
    assert names(found) == ["lever_arm"]
    assert found.whole.bias.shape == (2, 6)


def test_what_the_motion_cannot_show_of_a_found_effect_is_named() -> None:
    found = asked(planted.pair(planted.planar(DURATION_S), {"lever_arm": [0.3, 0.1, 0.0]}, 6), beyond=False)
    assert names(found) == ["lever_arm"]
    assert found.selected[0].unidentified == ("lever_arm.z",)


# ── by another channel, or by nothing that has a name ──


def current(seed: int, t: np.ndarray) -> np.ndarray:
    """Twenty cosines below 1 Hz."""
    rng = np.random.default_rng([seed, 5])
    f, phase = rng.uniform(0.05, 1.0, 20), rng.uniform(0.0, 2.0 * np.pi, 20)
    return np.asarray(np.cos(2.0 * np.pi * np.outer(t, f) + phase).sum(1) / np.sqrt(10.0))


@pytest.mark.parametrize("seed", seeds(1))
def test_the_channel_that_drives_is_told_from_one_like_it(seed: int) -> None:
    t = planted.clock(DURATION_S)
    true, other = current(seed, t), current(seed + 50, t)
    decoy = 0.9 * true + np.sqrt(1.0 - 0.9**2) * other  # correlated by 0.9
    felt = planted.rich(seed + 1, DURATION_S, {"/a_decoy": decoy, "/motor": true})
    added = np.zeros((len(t), 6))
    added[:, 3:] = np.interp(t - 0.06, t, true - true.mean())[:, None] * [0.1, 0.0, -0.06]
    found = asked(planted.pair(felt, None, seed, added=added))
    assert names(found) == ["driven:/motor:accel"]
    assert sure(found, "driven:/motor:accel", [0.1, 0.0, -0.06, 0.06])


def test_channels_that_drive_nothing_are_not_named() -> None:
    t = planted.clock(DURATION_S)
    felt = planted.rich(7, DURATION_S, {"/motor": current(1, t), "/wheel": current(2, t)})
    assert names(asked(planted.pair(felt, {"lever_arm": [0.2, -0.05, 0.1]}, 7))) == ["lever_arm"]


@pytest.mark.parametrize(("column", "seed"), [(1, 0), (4, 1)])
def test_a_misfit_without_a_name_gets_none_of_the_catalogues(column: int, seed: int) -> None:
    felt = planted.shaken(seed + 8, DURATION_S)
    added = np.zeros((len(felt.t_s), 6))
    added[:, column] = (0.05 if column < 3 else 0.5) * np.tanh(felt.gyro[:, 2] / 0.4)
    found = asked(planted.pair(felt, None, seed, added=added))
    assert found.selected
    assert all(name.startswith("unknown:") for name in names(found)), names(found)
    before, after = fit_cost(found)
    assert after < 0.2 * before  # of the squares above the noise


def fit_cost(found: Selection) -> tuple[float, float]:
    """Squares above the noise that the effects took, with those that are left; and those that are left."""
    left = max(found.whole.objective - found.whole.numbers, 0.0)
    return left + sum(one.gain for one in found.selected), left


# ── rivals, and what sets in ──


def test_a_scale_of_the_gyro_may_follow_the_temperature() -> None:
    """It was a scale and steps of the bias."""
    warm = planted.rich(channels={"/temperature.data": 20.0 + 5.0 * np.sin(0.3 * planted.rich().t_s)})
    pair = planted.pair(warm, {"gyro_scale_temperature": [4e-3, -2e-3, 3e-3]})
    found = select_effects([planted.weighed(pair)], (*planted.catalogue(), *catalogue.effects(["gyro_scale_temperature"])))
    assert names(found) == ["gyro_scale_temperature"]
    assert sure(found, "gyro_scale_temperature", [4e-3, -2e-3, 3e-3])


def test_a_temperature_that_rises_as_the_bias_does_is_named_beside_the_drift() -> None:
    """Both say the same with this channel, so that neither can be ruled out; with another course of it one of them can."""
    felt = planted.shaken(2, DURATION_S)
    rising = 20.0 + 5.0 * (1.0 - np.exp(-felt.t_s / 8.0))
    effects = {"gyro_bias_drift": [0.01, -0.02, 0.015, 8.0]}

    def told(temperature: np.ndarray) -> dict[str, tuple[str, ...]]:
        pair = planted.pair(planted.shaken(2, DURATION_S), effects, 5)
        pair = replace(pair, ideal=replace(pair.ideal, channels={"/temperature.data": temperature}))
        pair = replace(pair, channels={"/temperature.data": temperature})
        drift, temp = (
            planted.acting({name: size})[0][0] for name, size in (("gyro_bias_drift", [0] * 4), ("temperature", [0] * 6))
        )
        return dict(select_effects([planted.weighed(pair)], (drift, temp)).similar())

    (name, rivals), *more = told(rising).items()
    assert {name, *rivals} == {"gyro_bias_drift", "temperature"}
    assert not more
    assert told(20.0 + np.sin(felt.t_s)) == {"gyro_bias_drift": ()}


def test_an_effect_on_the_other_sensor_that_explains_as_much_is_no_rival() -> None:
    """A search that may find one effect leaves the other one unexplained, and that puts no name in doubt."""
    pair = planted.pair(planted.shaken(2, DURATION_S), {"gyro_scale": [0.02] * 3, "lever_arm": [0.01, 0.0, 0.0]}, 5)
    one = msgspec.structs.replace(pair.settings, search=msgspec.structs.replace(pair.settings.search, max_effects=1))
    log = planted.weighed(replace(pair, settings=one))
    arm, scale = planted.acting({"lever_arm": [0.0] * 3, "gyro_scale": [0.0] * 3})
    assert select_effects([log], (arm[0], scale[0]), begin=(arm,)).similar() == {"lever_arm": ()}


@pytest.mark.parametrize("t_jump", [4.8, 9.1])
def test_the_time_of_a_jump_is_found_also_beside_another_effect_and_between_fitted_rows(t_jump: float) -> None:
    pair = planted.pair(planted.rich(3, DURATION_S), {"clock_jump": [t_jump, -0.02], "gyro_scale": [0.02, -0.03, 0.01]}, 3)
    found = asked(pair, beyond=False)
    assert sorted(names(found)) == ["clock_jump", "gyro_scale"]
    jump = next(one for one in found.selected if one.effect.key == "clock_jump")
    assert abs(jump.theta[0] - t_jump) < 0.05  # s: five samples, in which it may hardly move
    assert jump.theta[1] == pytest.approx(-0.02, abs=2e-4)


def test_a_clock_that_runs_fast_and_jumps_shows_both() -> None:
    """Neither two offsets nor a straight line shows when it jumps: only a step on a trend does."""
    seed, eps, t_jump, step = 7, 2.45e-3, 10.19, -0.015
    truth = {"clock_skew": [eps], "clock_jump": [t_jump, step]}
    found = asked(planted.pair(planted.shaken(seed, DURATION_S), truth, 4), beyond=False)
    assert sorted(names(found)) == ["clock_jump", "clock_skew"]
    assert sure(found, "clock_skew", [eps])
    assert sure(found, "clock_jump", [t_jump, step])


def test_a_search_that_begins_with_too_much_and_with_wrong_values_ends_alike() -> None:
    pair = planted.pair(planted.rich(), {"lever_arm": SINGLE["lever_arm"], "gyro_scale": SINGLE["gyro_scale"]})
    begin = planted.acting({"mount_rotation": [0.01, 0.0, 0.0], "lever_arm": [0.0, 0.3, 0.0], "accel_quadratic": [1e-3] * 3})
    found = select_effects([planted.weighed(pair)], planted.catalogue(), begin=begin)
    assert sorted(names(found)) == ["gyro_scale", "lever_arm"]
    assert sure(found, "lever_arm", SINGLE["lever_arm"])
    assert sure(found, "gyro_scale", SINGLE["gyro_scale"])


def test_candidates_are_scored_beside_two_curves_of_one_axis_whose_constants_are_one() -> None:
    pair = planted.pair(planted.rich(), {"lever_arm": SINGLE["lever_arm"]})
    curves = [curve for curve in unnamed.curves(unnamed.like([pair])) if curve.key.startswith("unknown:gyro.y")]
    for other in curves[1:]:
        chosen = tuple((curve, curve.null_value.astype(float)) for curve in (curves[0], other))
        now = fit([planted.weighed(pair)], chosen)
        (arm,) = catalogue.diagnosed(["lever_arm"])
        (scored,) = Candidates(now.logs, (arm,)).ranked(now, [arm])
        assert scored.gain > 0.99 * (now.objective - fit(now.logs, (*chosen, (arm, arm.null_value.astype(float)))).objective)


OFFSETS_S = [0.003, 0.001, -0.002, 0.002, *[0.002] * (len(clock_wander.KNOTS_S) - 4)]


@pytest.mark.parametrize(
    "truth",
    [
        {"clock_wander": OFFSETS_S},
        {"clock_offset": [2e-3], "clock_skew": [3e-5]},
        {"clock_offset": [-2e-3], "clock_jump": [40.3, 4e-3]},
    ],
    ids="+".join,
)
def test_a_clock_wanders_beside_poses_only_where_offset_skew_and_jump_do_not_say_it(truth: dict[str, list[float]]) -> None:
    duration_s = 90.0
    pair = planted.pair(planted.shaken(2, duration_s), {**truth, "gyro_scale": [0.02, -0.03, 0.01]}, 4)
    candidates = (*planted.catalogue(), clock_wander.until(duration_s))
    found = select_effects([planted.weighed(replace(pair, band_hz=7.0))], candidates)
    assert sorted(names(found)) == sorted([*truth, "gyro_scale"])
    for name, theta in truth.items():
        knots = len(clock_wander.until(duration_s).parameters)
        assert sure(found, name, theta[:knots] if name == "clock_wander" else theta)


@pytest.mark.parametrize(("f0", "seed"), [(10.0, 0), (10.0, 2), (18.0, 1)])
def test_slow_motion_leaves_the_frequency_of_a_resonance_open(f0: float, seed: int) -> None:
    """Each of many frequencies is a narrow peak of the likelihood: one alone was 20 deviations off and more."""
    truth = {"mount_resonance": [f0, 0.1, 1.0, 1.0, 1.0]}
    effects = [effect for effect, _ in planted.acting(truth)]
    (found,) = select_effects([planted.weighed(planted.pair(planted.shaken(), truth, seed))], effects).selected
    assert abs(found.theta[0] - f0) < SURE * found.std[0]


def test_a_lever_arm_beside_a_resonance_is_not_called_a_size_effect() -> None:
    """On level ground nine numbers do what three do, and a little more as long as nobody thinks of the resonance."""
    pair = planted.pair(planted.planar(), {"lever_arm": [-0.4, -0.9, 0.0], "mount_resonance": [3.0, 0.2, 0.3, 1.0, 0.0]})
    assert set(names(asked(pair, beyond=False))) == {"lever_arm", "mount_resonance"}


def rattled(seed: int = 1) -> IdealMotion:
    """A body that rattles up to half of the rate."""
    felt, rng = planted.rich(seed), np.random.default_rng([seed, 5])
    gyro, accel = (x + size * rng.normal(size=x.shape) for x, size in ((felt.gyro, 0.2), (felt.accel, 2.0)))
    return replace(felt, gyro=gyro, accel=accel)


@pytest.mark.parametrize("seed", seeds(1))
@pytest.mark.parametrize(("name", "theta"), [("low_pass", [20.0, 100.0, 1.0]), ("second_order_low_pass", [14.0, 0.7, 100.0])])
def test_a_digital_low_pass_is_told_with_its_rate_and_nothing_else(name: str, theta: list[float], seed: int) -> None:
    """An analog one in its place leaves an error near half of the rate, which other effects would take."""
    found = asked(planted.pair(rattled(seed), {name: theta}, seed), beyond=False)
    assert names(found) == [name]
    assert [n.name for n in found.selected[0].effect.parameters][-1] == "rate"
    assert sure(found, name, theta[: len(found.selected[0].theta)])


@pytest.mark.parametrize(("order", "f_c"), [(4.0, 15.0), (0.0, 0.4429 * 12.5)])
def test_a_filter_of_fourth_order_and_a_moving_average_are_low_passes_and_no_delay_beside_one(order: float, f_c: float) -> None:
    found = asked(planted.pair(rattled(), {"low_pass": [f_c, 100.0, order]}), beyond=False)
    assert names(found) == [f"low_pass:order {order:g}"]
    ((_, value),) = found.selected[0].effect.constants
    assert value == order
    assert sure(found, names(found)[0], [f_c, 100.0])


def test_a_low_pass_of_one_sensor_is_told_on_it() -> None:
    felt = rattled()
    slow, plain = (planted.ideal(felt, planted.acting(of)) for of in ({"second_order_low_pass": [8.0, 0.7]}, {}))
    added = np.zeros_like(plain)
    added[:, 3:] = (slow - plain)[:, 3:]
    found = asked(planted.pair(felt, added=added), beyond=False)
    assert names(found) == ["second_order_low_pass:accel"]
    assert found.selected[0].effect.sensors == ("accel",)
    assert sure(found, "second_order_low_pass:accel", [8.0, 0.7])


def trembling(max_hz: float) -> IdealMotion:
    """A body that moves up to some frequency."""
    felt, rng, band = planted.rich(), np.random.default_rng(6), butter(4, max_hz, fs=planted.RATE_HZ, output="sos")
    gyro, accel = (
        x + sosfilt(band, size * rng.normal(size=x.shape), axis=0) for x, size in ((felt.gyro, 0.2), (felt.accel, 2.0))
    )
    return replace(felt, gyro=gyro, accel=accel)


def through(felt: IdealMotion, of_gyro: tuple[str, list[float]], of_accel: tuple[str, list[float]], late_s: float) -> Pair:
    """Samples whose sensors have a filter each, and a clock that is late."""
    clock = {"clock_offset": [-late_s]}
    gyro, accel = (planted.ideal(felt, planted.acting({name: theta} | clock)) for name, theta in (of_gyro, of_accel))
    added = np.concatenate([gyro[:, :3], accel[:, 3:]], axis=1) - planted.ideal(felt, ())
    return planted.pair(felt, added=added)


AVERAGES = [("low_pass", [0.4429 * planted.RATE_HZ / length, planted.RATE_HZ, 0.0]) for length in (3.0, 8.0)]


@pytest.mark.parametrize(
    ("of_gyro", "of_accel", "late_s", "found"),
    [
        (("second_order_low_pass", [20.0, 0.7]), ("low_pass", [8.0]), 0.0, ("second", "low")),
        (*AVERAGES, 0.0, ("low", "low")),
        (("second_order_low_pass", [25.0, 0.7]), ("second_order_low_pass", [12.0, 0.7]), 0.004, ("second", "second", "clock")),
    ],
)
def test_each_sensor_has_its_own_filter(
    of_gyro: tuple[str, list[float]], of_accel: tuple[str, list[float]], late_s: float, found: tuple[str, ...]
) -> None:
    """Found as one filter of both, a clock and a late gyro that took parts of it back, one of these filters was lost."""
    selection = asked(through(trembling(15.0), of_gyro, of_accel, late_s), beyond=False)
    assert sorted(name.partition("_")[0] for name in names(selection)) == sorted(found)
    for sensor, (_, theta) in (("gyro", of_gyro), ("accel", of_accel)):
        (one,) = (one for one in selection.selected if one.effect.sensors == (sensor,))
        assert one.theta[0] == pytest.approx(theta[0], abs=SURE * one.std[0])


def test_a_gyro_is_not_ahead_of_a_slow_accelerometer_but_the_clock_is() -> None:
    """Of slow motion a faster filter next to a gyro that looks ahead leaves as little, and no filter looks ahead."""
    felt, slow = trembling(8.0), ("second_order_low_pass", [20.0, 0.7])
    logs = [planted.weighed(through(felt, ("clock_skew", [0.0]), slow, -0.004))]
    delay, filtered = ([of for of in planted.catalogue() if of.key == key] for key in ("gyro_delay", f"{slow[0]}:accel"))
    wrong = fit(logs, ((delay[0], np.array([-0.004])), (filtered[0], np.array([33.0, 0.7]))))
    found = with_filter_of_each_sensor(wrong, planted.catalogue())
    assert {effect.key for effect, _ in found.chosen} == {"clock_offset", filtered[0].key}
    assert found.chosen[0][1] == pytest.approx([0.004], abs=3e-4)


def test_a_gyro_that_is_ahead_is_plainer_than_a_clock_and_a_filter() -> None:
    """Its delay alone gave way to two effects that leave no less."""
    logs = [planted.weighed(planted.pair(trembling(6.0), {"gyro_delay": [-0.00125]}))]
    delay = next(of for of in planted.catalogue() if of.key == "gyro_delay")
    now = fit(logs, ((delay, np.array([-0.001])),))
    assert with_filter_of_each_sensor(now, planted.catalogue()) is now


def test_a_filter_of_each_sensor_that_shows_its_lag_alone_has_no_order_by_chance() -> None:
    """Far above the motion all forms are alike, and one of a single parameter looked sure of its cut-off."""
    of_gyro, of_accel = ("second_order_low_pass", [40.0, 0.7]), ("low_pass", [8.0])
    selection = asked(through(trembling(6.0), of_gyro, of_accel, 0.0), beyond=False)
    assert names(selection) in (["low_pass:accel", "gyro_delay"], ["gyro_delay", "low_pass:accel"])
    assert sure(selection, "gyro_delay", [2.0 * 0.7 / (2.0 * np.pi * 40.0)])


def test_a_digital_filter_whose_rate_stood_for_a_scale_is_analog_again() -> None:
    """Next to the scale its rate had no size, so that neither of them was a finding."""
    truth = {"second_order_low_pass": [20.0, 0.7], "gyro_scale": [0.02, -0.015, 0.01]}
    logs, of = [planted.weighed(planted.pair(trembling(6.0), truth))], {one.key: one for one in planted.catalogue()}
    smoothing = exponential(of["second_order_low_pass"]), np.array([16.0, 0.66, 558.0])
    wrong = fit(logs, (smoothing, (of["gyro_scale"], np.zeros(3))))
    found = with_form_of_low_pass(wrong, planted.catalogue())
    assert {effect.key: theta for effect, theta in found.chosen} == {
        key: pytest.approx(theta, rel=0.05) for key, theta in truth.items()
    }


def test_two_exponential_filters_in_a_row_are_one_low_pass_and_no_clock() -> None:
    """Each lags by half a sample less than the analog filter that it looks like."""
    twice = [9.0, 1.0, math.inf, planted.RATE_HZ]
    found = asked(planted.pair(rattled(), {"second_order_low_pass": twice}), beyond=False)
    assert names(found) == ["second_order_low_pass"]
    assert [n.name for n in found.selected[0].effect.parameters] == ["f_c", "zeta", "smoothing_rate"]
    assert sure(found, "second_order_low_pass", [9.0, 1.0, planted.RATE_HZ])


def test_the_cut_off_of_an_analog_filter_is_as_unsure_as_the_rate_of_a_digital_one() -> None:
    """Slow motion shows the lag of a filter at 1 kHz, whose cut-off is 0.13 % lower."""
    found = asked(planted.pair(trembling(15.0), {"second_order_low_pass": [20.0, 0.7, 1000.0]}), beyond=False)
    assert names(found) == ["second_order_low_pass"]
    assert found.selected[0].theta[0] == pytest.approx(20.0, abs=SURE * found.selected[0].std[0])
    assert found.selected[0].std[0] >= 20.0 * (np.pi * 20.0 / 1000.0) ** 2 / 3.0


def test_a_late_accelerometer_is_no_low_pass_of_it() -> None:
    """A clock that is late and a gyro that is ahead of it: one alone explains little, and a filter or a mount was named."""
    felt, late_s = trembling(15.0), 0.008
    late, plain = (planted.ideal(felt, planted.acting(of)) for of in ({"clock_offset": [-late_s]}, {}))
    added = np.zeros_like(plain)
    added[:, 3:] = (late - plain)[:, 3:]
    found = asked(planted.pair(felt, added=added), beyond=False)
    assert sorted(names(found)) == ["clock_offset", "gyro_delay"]
    assert sure(found, "clock_offset", [-late_s])
    assert sure(found, "gyro_delay", [-late_s])


def test_a_dead_band_of_noisy_readings_is_as_unsure_as_its_edges_are() -> None:
    """Without noise inside the band chi-square is small, but a few samples at its edges hold all of it."""
    seed, width = 3, 0.06
    felt = planted.rich(seed, 40.0)
    pair = planted.pair(replace(felt, gyro=0.15 * felt.gyro, alpha=0.15 * felt.alpha), bias=np.zeros(6), seed=seed)
    real = pair.real.copy()
    real[:, :3] = np.where(np.abs(real[:, :3]) < width, 0.0, real[:, :3])
    every = [one for one in planted.catalogue() if one.name != "second_order_low_pass"]
    found = select_effects([whitened(replace(pair, real=real), every)], planted.catalogue())
    assert names(found) == ["gyro_dead_band"]
    assert sure(found, "gyro_dead_band", [width])


def test_a_dead_zone_whose_faster_readings_lose_its_width_is_a_dead_band() -> None:
    """It was a scale of one axis and signs of the other two."""
    found = asked(planted.pair(planted.rich(), {"gyro_dead_band": [0.02, 1.0]}))
    assert names(found) == ["gyro_dead_band:zone"]
    assert sure(found, "gyro_dead_band:zone", [0.02])
    assert [value for _, value in found.selected[0].effect.constants] == [1.0]


def test_a_low_pass_above_what_samples_can_show_is_told_by_its_delay() -> None:
    """Against an exact simulation; what smoothed poses say ends six times above their band, and beyond it is a delay."""
    pair = planted.pair(planted.shaken(), {"low_pass": [48.0]})
    found = asked(pair, beyond=False)
    assert names(found) == ["low_pass"]
    assert sure(found, "low_pass", [48.0])
    assert names(asked(replace(pair, band_hz=7.0), beyond=False)) == ["clock_offset"]


def test_a_low_pass_that_replaced_its_delay_beside_a_scale_gives_way_to_it_again() -> None:
    pair = planted.pair(planted.shaken(), {"low_pass": [20.0], "gyro_scale": [0.05, -0.05, 0.05]})
    found = names(asked(replace(pair, band_hz=3.0), beyond=False))
    assert sorted(found) == ["clock_offset", "gyro_scale"]


@pytest.mark.parametrize("arms_mm", [(107.0, 101.0, 107.0), (150.0, 120.0, 150.0)])
def test_three_arms_that_agree_are_a_lever_arm_and_the_rest_a_size_effect(arms_mm: tuple[float, float, float]) -> None:
    theta = [0.0, 0.0, arms_mm[0] * 1e-3, 0.0, 0.0, arms_mm[1] * 1e-3, 0.0, 0.0, arms_mm[2] * 1e-3]
    pair = planted.pair(planted.shaken(), {"size_effect": theta}, 9)
    found = asked(pair, beyond=False)
    assert names(found)[0] == "lever_arm"
    assert set(names(found)) <= {"lever_arm", "size_effect"}
    arm = found.selected[0]
    assert abs(arm.theta[2] - 1e-3 * arms_mm[2]) < 0.02
    assert np.abs(arm.theta[:2]).max() < 0.02


def test_two_axes_that_sit_together_far_from_the_third_are_a_size_effect_alone() -> None:
    """On a floor that shakes a little the arm of x and y explains almost all; the three have none in common."""
    together, apart, floor = [0.006, -0.02, 0.013], [-0.012, 0.04, -0.026], planted.shaken()
    floor = replace(floor, gyro=floor.gyro * [0.1, 0.1, 1.0], alpha=floor.alpha * [0.1, 0.1, 1.0])
    pair = planted.pair(floor, {"size_effect": [*together, *together, *apart]}, 9)
    assert names(asked(pair, beyond=False)) == ["size_effect"]


def test_a_name_that_leaves_no_more_takes_the_place_of_a_term() -> None:
    """On level ground five of six misalignments are noise, and one term alone costs less by BIC; the physics is the same."""
    pair = planted.pair(planted.planar(), {"accel_misalignment": [0.0, 0.0, 0.06, 0.0, 0.0, 0.0]})
    log, named = planted.weighed(pair), planted.catalogue()
    term = next(effect for effect in unnamed.terms(unnamed.like([pair])) if effect.equation == "accel.y += c f_x")
    known, before = Candidates([log], (*named, term)), fit([log], ()).objective
    search = model_selection._Search([log], named, (term,), (), lambda text: None, known, before=before)
    assert list(search.simplified(fit([log], ((term, np.zeros(1)),))).keys) == ["accel_misalignment"]


def test_a_filter_of_one_sensor_leaves_the_offset_of_clocks_without_an_epoch_in_every_fit() -> None:
    """The form of the filter did without that offset, and was then taken for it: a low-pass of 5 Hz was no finding."""
    candidates = in_forms(catalogue.diagnosed(["clock_offset", "low_pass", "second_order_low_pass"]), exact=True)
    (filtered,) = (one for one in candidates if one.key == "low_pass:accel")
    (offset,) = (one for one in candidates if one.name == "clock_offset")
    felt = planted.rich(2)
    low = planted.ideal(felt, ((filtered, np.array([5.0])),)) - planted.ideal(felt)
    found = select_effects([planted.weighed(planted.pair(felt, added=low))], candidates, always=((offset, np.zeros(1)),))
    assert (found.whole.keys[0], [one.effect.key for one in found.selected]) == ("clock_offset", ["low_pass:accel"])
