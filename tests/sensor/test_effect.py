"""The forward side of every effect: what it makes of ideal signals, against closed forms that share nothing with it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.signal import butter, lfilter
from scipy.spatial.transform import Rotation
from support.planted import simulate_samples

from imutool import registry
from imutool.errors import ConfigError, DataError
from imutool.sensor import catalogue
from imutool.sensor.effect import Effect, Stage, distort
from imutool.sensor.effects import clock_wander, gyro_bias_step, low_pass
from imutool.sensor.samples import IdealMotion, SensorSamples
from imutool.sensor.signals import SLOW_S

RATE_HZ = 200.0
G = 9.81
SAME = 1e-12  # of a result's size: two orders of the same few sums
SPLINE = 1e-5  # of a sine at 2 Hz: a cubic spline's error at a hundredth of the sample rate is (pi/100)^4 of it
FILTER = 1e-3  # what `_filters` promises, gain and phase, up to a quarter of the sample rate
SLOWLY = 1e-4  # and up to a tenth of it
ALL = [pytest.param(one, id=one.name) for one in catalogue.effects()]
WITH_STARTS = [pytest.param(one, id=one.name) for one in catalogue.effects() if one.starts is not None]


def clock(seconds: float = 10.0, rate_hz: float = RATE_HZ) -> np.ndarray:
    return np.arange(round(seconds * rate_hz)) / rate_hz


def lively(seconds: float = 10.0) -> IdealMotion:
    """Turning and shaking in every axis, below 4 Hz."""
    t, rng = clock(seconds), np.random.default_rng(4)

    def waves(size: float) -> np.ndarray:
        f, at = rng.uniform(0.1, 4.0, (2, 5, 3))
        return size * np.sin(2.0 * np.pi * f * t[:, None, None] + at).sum(axis=1)

    R_wb = Rotation.from_rotvec(waves(0.3)).as_matrix()
    return IdealMotion(t, waves(1.0), waves(3.0) + np.array([0.0, 0.0, G]), waves(5.0), R_wb, {"/imu0.temperature": 20.0 + t})


def still(seconds: float = 1.0, gyro: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> IdealMotion:
    """Level, perhaps turning at a constant rate."""
    t = clock(seconds)
    n = len(t)
    accel = np.tile([0.0, 0.0, G], (n, 1))
    return IdealMotion(t, np.tile(gyro, (n, 1)), accel, np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)))


def sine(f_hz: float, seconds: float = 20.0, rate_hz: float = RATE_HZ) -> IdealMotion:
    """One frequency on every axis."""
    t = clock(seconds, rate_hz)
    x = np.tile(np.sin(2.0 * np.pi * f_hz * t)[:, None], (1, 3))
    return IdealMotion(t, x, x.copy(), x.copy())


def ideal(one: Effect, felt: IdealMotion) -> IdealMotion | SensorSamples | np.ndarray:
    """What an effect acts on."""
    if one.stage < Stage.CLOCK:
        return felt
    return felt.t_s + 0.3 if one.stage == Stage.CLOCK else felt.sample(felt.t_s, felt.t_s)


def numbers(of: IdealMotion | SensorSamples | np.ndarray) -> dict[str, np.ndarray]:
    if isinstance(of, np.ndarray):
        return {"taken_s": of}
    arrays = {column.name: getattr(of, column.name) for column in fields(of)}
    return {name: value for name, value in arrays.items() if isinstance(value, np.ndarray)} | dict(of.channels)


def some_theta(one: Effect) -> np.ndarray:
    draw = np.random.default_rng(1).uniform(0.3, 1.0, len(one.parameters))
    return one.plausible * draw


def only(name: str) -> Effect:
    return catalogue.effects([name])[0]


def act(name: str, of: IdealMotion | SensorSamples, *theta: float) -> IdealMotion | SensorSamples:
    out: IdealMotion | SensorSamples = only(name).forward(of, np.array(theta))
    return out


def close(a: np.ndarray, b: np.ndarray, tolerance: float = SAME) -> None:
    np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * max(1.0, float(np.abs(b).max())))


# every file with EFFECT


@pytest.mark.parametrize("one", ALL)
def test_it_says_what_it_is(one: Effect) -> None:
    module = registry.load("imutool.effects", one.name)
    assert module.EFFECT is one
    assert set(one.sensors) <= {"gyro", "accel"}
    assert one.sensors
    assert one.equation
    assert one.observable_if
    names = [number.name for number in one.parameters]
    assert len(set(names)) == len(names) > 0
    assert all(number.unit for number in one.parameters)
    assert np.all(np.isfinite(one.plausible) & (one.plausible > 0))
    assert one.linear or one.starts is not None


@pytest.mark.parametrize("one", ALL)
def test_at_nothing_it_does_nothing(one: Effect) -> None:
    felt = lively()
    before, after = numbers(ideal(one, felt)), numbers(one.forward(ideal(one, felt), one.null_value))
    assert before.keys() == after.keys()
    for name, value in before.items():
        np.testing.assert_array_equal(after[name], value, err_msg=name)


@pytest.mark.parametrize("one", ALL)
def test_it_acts_keeps_shapes_and_leaves_what_it_is_given_alone(one: Effect) -> None:
    felt = lively(30.0)  # clocks jump within it
    given = ideal(one, felt)
    theta = some_theta(one)
    if one.stage == Stage.CONVERTER:
        theta = theta / 20.0  # limits that are reached, steps that are not
    before = {name: value.copy() for name, value in numbers(given).items()}
    asked = theta.copy()
    after = numbers(one.forward(given, theta))
    np.testing.assert_array_equal(theta, asked)
    for name, value in numbers(given).items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)
        assert (after[name].shape, after[name].dtype) == (value.shape, np.float64)
        assert np.isfinite(after[name]).all()
    changed = {name for name in before if not np.array_equal(after[name], before[name])}
    assert changed
    sensors = changed & {"gyro", "accel"}
    assert sensors == set(one.sensors) or one.stage == Stage.CLOCK


@pytest.mark.parametrize("name", ["gravity", "earth_rotation", "gyro_bias_step", "accel_bias_step"])
def test_columns_that_lie_in_one_piece_of_memory_stay_so(name: str) -> None:
    """Else each effect behind it takes several times as long."""
    felt = lively()
    felt = replace(felt, gyro=np.asfortranarray(felt.gyro), accel=np.asfortranarray(felt.accel))
    after = only(name).forward(ideal(only(name), felt), some_theta(only(name)))
    assert after.gyro.flags.f_contiguous
    assert after.accel.flags.f_contiguous


@pytest.mark.parametrize("one", [p for p in ALL if p.values[0].linear])
def test_a_linear_one_adds_in_proportion(one: Effect) -> None:
    felt = lively()
    theta = some_theta(one)
    zero, once, twice = (numbers(one.forward(ideal(one, felt), k * theta)) for k in (0.0, 1.0, 2.0))
    for name in zero:
        close(twice[name] - zero[name], 2.0 * (once[name] - zero[name]))


def test_an_onset_of_a_g_sensitivity_is_found_in_a_log_that_ends_at_rest() -> None:
    """Forces that stay the same leave the columns of an axis alike: from there on, no one has a size of its own."""
    t, rng = clock(20.0), np.random.default_rng(3)
    force = rng.normal(size=(len(t), 3))
    force[t >= 15.0] = [1.0, 2.0, 4.0]
    sensitivity = 1e-3 * rng.normal(size=(3, 3))
    error = (t[:, None] >= 8.0) * (force @ sensitivity.T)
    columns = [along[:, None] for along in force.T]
    start = gyro_bias_step.likeliest_onset(t, error, (t < 1.0).astype(float)[:, None], setting_in=columns)
    assert start[-1] == pytest.approx(8.0, abs=1.0 / RATE_HZ)
    close(start[:-1].reshape(3, 3), sensitivity, 1e-6)


@pytest.mark.parametrize("one", WITH_STARTS)
def test_starts_are_finite_and_positive_where_the_number_is_and_work(one: Effect) -> None:
    assert one.starts is not None
    felt = lively()
    real = simulate_samples(felt, felt.t_s, [(one, some_theta(one))])
    starts = one.starts(felt, SensorSamples(felt.t_s, real.gyro, real.accel, felt))
    assert starts
    for start in starts:
        assert start.shape == one.null_value.shape
        assert np.isfinite(start).all()
        assert all(value > 0 for value, number in zip(start, one.parameters, strict=True) if number.positive)
        assert np.isfinite(simulate_samples(felt, felt.t_s, [(one, start)]).accel).all()


def test_effects_meet_where_they_share_a_column_and_one_without_columns_meets_all() -> None:
    scale, arm, clock = catalogue.effects(["gyro_scale", "lever_arm", "clock_offset"])
    assert not scale.meets(arm)
    assert all(one.meets(another) for one, another in [(scale, scale), (scale, clock), (clock, arm)])
    everywhere = replace(scale, sensors=())
    assert arm.meets(everywhere)
    assert everywhere.meets(arm)


def test_the_catalogue_of_left_out_physics_is_there() -> None:
    sensor = ("scale", "scale_asymmetry", "misalignment", "quadratic", "hysteresis", "bias_drift", "bias_step")
    expected = {f"{of}_{what}" for of in ("gyro", "accel") for what in sensor}
    expected |= {"gyro_g_sensitivity", "lever_arm", "size_effect", "mount_rotation", "mount_resonance", "low_pass", "gravity"}
    expected |= {
        "gyro_dead_band",
        "second_order_low_pass",
        "gyro_delay",
        "clock_offset",
        "clock_skew",
        "clock_jump",
        "clock_wander",
        "saturation",
        "quantization",
        "earth_rotation",
        "vibration",
    }
    expected |= {"temperature", "vibration_rectification", "gyro_scale_drift", "gyro_scale_temperature"}
    assert {one.name for one in catalogue.diagnosed()} == expected
    assert {one.name for one in catalogue.effects()} == expected | {
        "rate_curve",
        "gyro_warm_up",
        "gyro_rate_load",
        "gyro_force_load",
    }


def test_names_pick_some_and_a_wrong_one_suggests_the_nearest() -> None:
    assert [one.name for one in catalogue.effects(["low_pass", "gravity"])] == ["low_pass", "gravity"]
    with pytest.raises(ConfigError, match="low_pass"):
        catalogue.effects(["lowpass"])
    with pytest.raises(ConfigError, match="rate_curve is not diagnosed; expected some of accel_bias_drift"):
        catalogue.diagnosed(["rate_curve"])


def test_an_effect_without_closed_form_is_no_term_of_a_bias_model() -> None:
    assert "low_pass" not in {effect.name for effect in catalogue.trained("gyro")}
    with pytest.raises(ConfigError, match="low_pass does not act on the gyro"):
        catalogue.trained("gyro", ["low_pass"])


# what the mounting point feels


def test_a_constant_turn_pulls_a_lever_arm_inwards() -> None:
    """omega = 2 rad/s about z at 0.5 m along x: omega² r = 2 m/s² towards the axis."""
    out = act("lever_arm", still(gyro=(0.0, 0.0, 2.0)), 0.5, 0.0, 0.3)
    close(out.accel, np.tile([-2.0, 0.0, G], (len(out.accel), 1)))


def test_an_angular_acceleration_pushes_a_lever_arm_sideways() -> None:
    felt = still()
    felt = replace(felt, alpha=felt.alpha + np.array([0.0, 0.0, 3.0]))
    close(act("lever_arm", felt, 0.5, 0.0, 0.0).accel, felt.accel + np.array([0.0, 1.5, 0.0]))


def test_a_lever_arm_is_the_rigid_bodys_law() -> None:
    felt, r = lively(), np.array([0.2, -0.1, 0.4])
    more = np.cross(felt.alpha, r) + np.cross(felt.gyro, np.cross(felt.gyro, r))
    close(act("lever_arm", felt, *r).accel, felt.accel + more)


def test_each_axis_of_a_large_accelerometer_has_its_own_lever_arm() -> None:
    felt, r = lively(), 0.05 * np.arange(1.0, 10.0).reshape(3, 3)
    out = act("size_effect", felt, *r.ravel())
    for axis in range(3):
        close(out.accel[:, axis], act("lever_arm", felt, *r[axis]).accel[:, axis])


def test_at_rest_gravity_of_another_size_and_tilt_is_read() -> None:
    dg, tilt = 0.05, 0.1
    felt = still()
    close(act("gravity", felt, dg, 0.0, 0.0).accel, felt.accel + np.array([0.0, 0.0, dg]))
    up = [0.0, -(G + dg) * math.sin(tilt), (G + dg) * math.cos(tilt)]  # z turned about x
    close(act("gravity", felt, dg, tilt, 0.0).accel, np.tile(up, (len(felt.t_s), 1)))


def test_gravity_is_felt_in_the_body() -> None:
    felt = lively()
    out = act("gravity", felt, 0.0, 0.02, -0.03)
    more_w = np.einsum("nij,nj->ni", felt.R_wb, out.accel - felt.accel)
    close(more_w, np.tile(more_w[0], (len(more_w), 1)))
    close(np.linalg.norm(more_w[0] + [0.0, 0.0, G]), np.array(G))


@pytest.mark.parametrize(("latitude", "heading"), [(0.0, 0.0), (0.9, 1.0), (-1.2, -2.0)])
def test_at_rest_the_earth_turns_once_a_sidereal_day(latitude: float, heading: float) -> None:
    felt = still()
    rate = act("earth_rotation", felt, latitude, heading).gyro
    np.testing.assert_allclose(2.0 * np.pi / np.linalg.norm(rate, axis=1), 86164.1, rtol=1e-6)
    np.testing.assert_allclose(rate[0, 2], 7.292115e-5 * math.sin(latitude), rtol=1e-12, atol=1e-20)
    np.testing.assert_allclose(math.atan2(rate[0, 1], rate[0, 0]), heading, atol=1e-12)


@pytest.mark.parametrize("name", ["gravity", "earth_rotation"])
def test_what_needs_the_attitude_says_so(name: str) -> None:
    assert only(name).needs == ("attitude",)
    with pytest.raises(DataError, match="attitude is not known"):
        only(name).forward(replace(still(), R_wb=None), 0.5 * only(name).plausible)


def test_a_line_has_its_frequency_and_amplitudes() -> None:
    felt = still(10.0)
    shaken = act("vibration", felt, 7.0, 0.3, 0.0, 0.0, 0.4, 0.3, 0.4, 0.02, 0.0, 0.0, 0.0, 0.0, 0.03)
    turning = 2.0 * np.abs(np.fft.rfft(shaken.gyro - felt.gyro, axis=0)) / len(felt.t_s)
    close(turning[70], np.array([0.02, 0.0, 0.03]))
    out = shaken.accel - felt.accel
    spectrum = 2.0 * np.abs(np.fft.rfft(out, axis=0)) / len(out)
    assert np.argmax(spectrum, axis=0).tolist() == [70, 70, 70]  # of 0.1 Hz each
    close(spectrum[70], np.array([0.3, 0.4, 0.5]))
    close(out[0], np.array([0.0, 0.4, 0.4]))


def test_a_line_is_found_to_a_fiftieth_of_a_turn() -> None:
    felt, one = lively(60.0), only("vibration")
    theta = np.array([31.4159, 0.3, 0.1, 0.0, 0.2, -0.1, 0.0, 0.03, 0.0, 0.0, -0.01, 0.0, 0.0])
    noise = 0.05 * np.random.default_rng(2).normal(size=(2, *felt.accel.shape))
    real = simulate_samples(felt, felt.t_s, [(one, theta)])
    assert one.starts is not None
    start = one.starts(felt, real.with_readings(gyro=real.gyro + 0.1 * noise[0], accel=real.accel + noise[1] + 0.1))[0]
    assert abs(start[0] - theta[0]) * felt.t_s[-1] < 0.02
    np.testing.assert_allclose(start[1:7], theta[1:7], atol=0.03)
    np.testing.assert_allclose(start[7:], theta[7:], atol=0.003)


# mount and bandwidth


def test_a_mount_turns_both_sensors_alike() -> None:
    """A sensor turned by 90 degrees about z: its x axis lies along the body's y."""
    felt = lively()
    out = act("mount_rotation", felt, 0.0, 0.0, math.pi / 2.0)
    for name in ("gyro", "accel", "alpha"):
        body, sensor = getattr(felt, name), getattr(out, name)
        close(sensor, np.stack([body[:, 1], -body[:, 0], body[:, 2]], axis=1))
    assert out.R_wb is felt.R_wb


def response(out: np.ndarray, f_hz: float, t_s: np.ndarray) -> complex:
    """Gain and phase of the answer to a sine, away from the ends."""
    inside = slice(len(t_s) // 4, 3 * len(t_s) // 4)
    wave = 2.0 * np.pi * f_hz * t_s[inside]
    s, c = np.linalg.lstsq(np.stack([np.sin(wave), np.cos(wave)], axis=1), out[inside], rcond=None)[0]
    return complex(s, c)


def promised(f_hz: float) -> float:
    """How far a filter may be from its formula, relative."""
    return SLOWLY if f_hz < 0.1 * RATE_HZ else FILTER


def test_a_low_pass_delays_what_is_slow_by_its_time_constant() -> None:
    """A hundredth of a sample too much or too little would look like another clock."""
    f_hz, cutoff_hz = 0.5, 24.0
    out = act("low_pass", sine(f_hz), cutoff_hz)
    late_s = -np.angle(response(out.gyro[:, 0], f_hz, sine(f_hz).t_s)) / (2.0 * np.pi * f_hz)
    assert late_s == pytest.approx(math.atan(f_hz / cutoff_hz) / (2.0 * np.pi * f_hz), abs=1e-5 / RATE_HZ)


@pytest.mark.parametrize("f_hz", [0.5, 3.0, 11.0, 27.0, 50.0])
@pytest.mark.parametrize("cutoff_hz", [2.0, 8.0, 30.0, 90.0, 400.0])
def test_a_low_pass_has_the_gain_and_phase_of_its_formula(f_hz: float, cutoff_hz: float) -> None:
    felt = sine(f_hz)
    out = act("low_pass", felt, cutoff_hz)
    exact = 1.0 / (1.0 + 1j * f_hz / cutoff_hz)
    for values in (out.gyro, out.accel, out.alpha):
        assert abs(response(values[:, 0], f_hz, felt.t_s) / exact - 1.0) < promised(f_hz)


@pytest.mark.parametrize(("order", "name", "shape"), [(1, "low_pass", ()), (2, "second_order_low_pass", (0.5**0.5,))])
@pytest.mark.parametrize("cutoff_hz", [8.0, 40.0, 80.0])  # of 200 Hz
def test_a_digital_low_pass_is_that_of_scipy(order: int, name: str, shape: tuple[float, ...], cutoff_hz: float) -> None:
    """Once the start is forgotten, up to half of the rate."""
    felt = lively()
    felt = replace(felt, gyro=felt.gyro + np.random.default_rng(order).normal(size=felt.gyro.shape))
    b, a = butter(order, cutoff_hz, fs=felt.rate_hz)
    out = act(name, felt, cutoff_hz, *shape, felt.rate_hz)
    for values, exact in ((out.gyro, lfilter(b, a, felt.gyro, axis=0)), (out.accel, lfilter(b, a, felt.accel, axis=0))):
        np.testing.assert_allclose(values[100:-100], exact[100:-100], atol=1e-6)


@pytest.mark.parametrize(("order", "cutoff_hz"), [(4, 25.0), (4, 70.0), (3, 25.0), (0, 0.4429 * 25.0)])
def test_a_low_pass_of_higher_order_and_a_moving_average_are_those_of_scipy(order: int, cutoff_hz: float) -> None:
    felt = lively()
    felt = replace(felt, gyro=felt.gyro + np.random.default_rng(order).normal(size=felt.gyro.shape))
    b, a = butter(order, cutoff_hz, fs=felt.rate_hz) if order else (np.full(8, 1.0 / 8.0), [1.0])  # 40 ms at 200 Hz
    out = act("low_pass", felt, cutoff_hz * felt.rate_hz / 200.0 if not order else cutoff_hz, felt.rate_hz, float(order))
    for values, exact in ((out.gyro, lfilter(b, a, felt.gyro, axis=0)), (out.accel, lfilter(b, a, felt.accel, axis=0))):
        np.testing.assert_allclose(values[200:-200], exact[200:-200], atol=1e-6)


@pytest.mark.parametrize("cutoff_hz", [5.0, 30.0])
def test_exponential_smoothing_is_its_recursion_on_the_samples(cutoff_hz: float) -> None:
    felt = lively()
    felt = replace(felt, gyro=felt.gyro + np.random.default_rng(1).normal(size=felt.gyro.shape))
    k = 1.0 - math.exp(-2.0 * math.pi * cutoff_hz / felt.rate_hz)
    out = act("low_pass", felt, cutoff_hz, math.inf, 1.0, felt.rate_hz)
    np.testing.assert_allclose(out.gyro[200:-200], lfilter([k], [1.0, k - 1.0], felt.gyro, axis=0)[200:-200], atol=1e-6)
    design, f_hz = low_pass.Design(cutoff_hz, smoothing_hz=felt.rate_hz), np.array([0.01])
    assert design.lag_s == pytest.approx(-np.angle(design.answer(f_hz))[0] / (2.0 * np.pi * f_hz[0]), rel=1e-4)


@pytest.mark.parametrize(("cutoff_hz", "zeta"), [(12.0, 1.2), (20.0, 0.7)])
def test_exponential_smoothing_of_second_order_is_two_in_a_row(cutoff_hz: float, zeta: float) -> None:
    felt = lively()
    felt = replace(felt, gyro=felt.gyro + np.random.default_rng(1).normal(size=felt.gyro.shape))
    poles = np.exp(2.0 * np.pi * cutoff_hz / felt.rate_hz * np.roots([1.0, 2.0 * zeta, 1.0]).astype(complex))
    out, a = act("second_order_low_pass", felt, cutoff_hz, zeta, math.inf, felt.rate_hz), np.poly(poles).real
    np.testing.assert_allclose(out.gyro[200:-200], lfilter([a.sum()], a, felt.gyro, axis=0)[200:-200], atol=1e-6)
    design, f_hz = low_pass.Design(cutoff_hz, zeta, smoothing_hz=felt.rate_hz), np.array([0.01])
    assert design.lag_s == pytest.approx(-np.angle(design.answer(f_hz))[0] / (2.0 * np.pi * f_hz[0]), rel=1e-4)


@pytest.mark.parametrize("order", [0.0, 1.0, 3.0, 4.0])
@pytest.mark.parametrize("rate_hz", [math.inf, 200.0])
def test_the_lag_of_a_low_pass_is_that_of_slow_motion(order: float, rate_hz: float) -> None:
    design = low_pass.Design(20.0, None, rate_hz, order)
    f_hz = np.array([0.01])
    assert design.lag_s == pytest.approx(-np.angle(design.answer(f_hz))[0] / (2.0 * np.pi * f_hz[0]), rel=1e-4)
    assert abs(design.answer(np.array([20.0]))[0]) == pytest.approx(0.5**0.5, rel=0.02 if order == 0.0 else 1e-9)


@pytest.mark.parametrize("name", ["low_pass", "second_order_low_pass"])
def test_a_low_pass_of_one_sensor_leaves_the_other(name: str) -> None:
    felt, (both,) = lively(), catalogue.effects([name])
    theta = np.array([10.0] if name == "low_pass" else [10.0, 0.7])
    for sensor, other in (("gyro", "accel"), ("accel", "gyro")):
        one = low_pass.of_one(both, sensor)
        for forward in ("forward", "lagless"):
            out, of_both = (getattr(effect, forward)(felt, theta) for effect in (one, both))
            np.testing.assert_array_equal(getattr(out, sensor), getattr(of_both, sensor))
            assert getattr(out, other) is getattr(felt, other)


@pytest.mark.parametrize("f_hz", [3.0, 66.0])  # of 200 Hz
@pytest.mark.parametrize("tau_s", [-0.012, 0.0015, 0.02])
def test_a_late_gyro_has_the_phase_of_its_delay_and_the_rest_stays(f_hz: float, tau_s: float) -> None:
    felt = sine(f_hz)
    out = act("gyro_delay", felt, tau_s)
    exact = np.exp(-2j * np.pi * f_hz * tau_s)
    assert abs(response(out.gyro[:, 0], f_hz, felt.t_s) / exact - 1.0) < promised(f_hz)
    assert out.accel is felt.accel
    assert out.alpha is felt.alpha


@pytest.mark.parametrize("n", [2, 3, 510, 1001])  # periods of 2 n - 2 samples: 1018 is twice a prime
@pytest.mark.parametrize("late", [1e-9, 0.4, -2.0, 3.0 + 1e-12, 11.7])
def test_a_late_gyro_is_the_turned_spectrum_of_its_mirrored_column(n: int, late: float) -> None:
    still = np.zeros((n, 3))
    felt = IdealMotion(0.005 * np.arange(n), np.random.default_rng(2).normal(size=(n, 3)), still, still)
    x = felt.gyro[:, 0]
    ramp = np.linspace(x[0], x[-1], n)
    mirrored = np.fft.rfft(np.concatenate([x - ramp, (ramp - x)[-2:0:-1]]))
    turn = np.exp(-2j * np.pi * np.fft.rfftfreq(2 * n - 2) * late)
    exact = ramp - late * (x[-1] - x[0]) / (n - 1) + np.fft.irfft(mirrored * turn, 2 * n - 2)[:n]
    out = act("gyro_delay", felt, late / felt.rate_hz)
    close(out.gyro[:, 0], exact)
    turned = act("mount_rotation", felt, 0.0, 0.0, 0.1)
    assert (act("gyro_delay", turned, 0.004).gyro[:, 2] == act("gyro_delay", felt, 0.004).gyro[:, 2]).all()
    assert act("gyro_delay", felt, late / felt.rate_hz).gyro is out.gyro  # a derivative asks for it again and again


def test_a_hysteresis_holds_a_reading_until_the_rate_has_moved_on() -> None:
    rate = np.array([0.0, 0.3, 1.0, 0.8, -0.5, -0.5, 0.1, 0.2])
    felt = still(gyro=(0.0, 0.0, 0.0))
    samples = felt.sample(felt.t_s[: len(rate)], felt.t_s[: len(rate)]).with_readings(
        gyro=np.stack([rate, 0.0 * rate, -rate]).T
    )
    held = np.array([0.0, 0.05, 0.75, 0.75, -0.25, -0.25, -0.15, -0.05])
    close(act("gyro_hysteresis", samples, 0.25).gyro, np.stack([held, 0.0 * rate, -held]).T)


def test_a_share_of_a_reading_holds_and_the_rest_follows() -> None:
    felt = lively()
    samples = felt.sample(felt.t_s, felt.t_s)
    whole, share = (act("gyro_hysteresis", samples, 0.2, *more).gyro for more in ([], [0.25]))
    close(share, 0.75 * samples.gyro + 0.25 * whole)


def test_a_hysteresis_starts_at_its_width_beside_a_bias_and_noise() -> None:
    felt = lively()
    read = act("accel_hysteresis", felt.sample(felt.t_s, felt.t_s), 0.1)
    noisy = read.with_readings(accel=read.accel + np.random.default_rng(1).normal(0.3, 0.03, felt.accel.shape))
    starts = only("accel_hysteresis").starts
    assert starts is not None
    (start,) = starts(felt, noisy)
    assert start[0] == pytest.approx(0.1, rel=0.2)


@pytest.mark.parametrize(("width", "lost"), [(0.02, 0), (0.3, 0), (0.3, 1)])
def test_a_dead_band_starts_at_its_width_beside_a_bias_and_noise(width: float, lost: int) -> None:
    felt = lively()
    noise = np.random.default_rng(1).normal(0.0, 0.003, felt.gyro.shape)
    past = felt.gyro - lost * width * np.sign(felt.gyro)
    gyro = np.where(np.abs(felt.gyro) < width, 0.0, past) + noise + np.array([0.01, -0.02, 0.005])
    read = felt.sample(felt.t_s, felt.t_s).with_readings(gyro)
    starts = only("gyro_dead_band").starts
    assert starts is not None
    assert starts(felt, read)[lost] == pytest.approx([width, lost], rel=0.2)
    out = act("gyro_dead_band", felt.sample(felt.t_s, felt.t_s), width, float(lost))
    assert (out.gyro[np.abs(felt.gyro) < 0.98 * width] == 0.0).all()
    close(out.gyro[np.abs(felt.gyro) > 1.02 * width], past[np.abs(felt.gyro) > 1.02 * width])


@pytest.mark.parametrize("f_hz", [0.5, 3.0, 11.0, 27.0, 50.0])
@pytest.mark.parametrize(("f0_hz", "zeta"), [(4.0, 0.1), (11.0, 0.05), (30.0, 0.3), (60.0, 0.1), (20.0, 1.4)])
@pytest.mark.parametrize("damper", [1.0, 0.0])
def test_a_soft_mount_has_the_gain_and_phase_of_its_formula(f_hz: float, f0_hz: float, zeta: float, damper: float) -> None:
    felt = sine(f_hz)
    out = act("mount_resonance", felt, f0_hz, zeta, 1.0, 0.5, 0.0, *([] if damper else [damper]))
    x = f_hz / f0_hz
    exact = (1.0 + 2j * damper * zeta * x) / (1.0 - x**2 + 2j * zeta * x)
    assert abs(response(out.accel[:, 0], f_hz, felt.t_s) / exact - 1.0) < promised(f_hz)
    assert abs(response(out.accel[:, 1], f_hz, felt.t_s) - (0.5 + 0.5 * exact)) < promised(f_hz) * abs(exact)
    np.testing.assert_array_equal(out.accel[:, 2], felt.accel[:, 2])
    np.testing.assert_array_equal(out.gyro, felt.gyro)


@pytest.mark.parametrize("f_hz", [0.5, 11.0, 50.0])
@pytest.mark.parametrize(("cutoff_hz", "zeta"), [(8.0, 0.3), (30.0, 0.7071), (30.0, 1.0), (90.0, 2.5), (1e8, 1e7)])
def test_a_second_order_low_pass_has_the_gain_and_phase_of_its_formula(f_hz: float, cutoff_hz: float, zeta: float) -> None:
    felt = sine(f_hz)
    out = act("second_order_low_pass", felt, cutoff_hz, zeta)
    exact = 1.0 / (1.0 - (f_hz / cutoff_hz) ** 2 + 2.0j * zeta * f_hz / cutoff_hz)
    for values in (out.gyro, out.accel, out.alpha):
        assert abs(response(values[:, 0], f_hz, felt.t_s) / exact - 1.0) < promised(f_hz)


@pytest.mark.parametrize(("name", "theta"), [("low_pass", (3.0,)), ("mount_resonance", (9.0, 0.05, 1.0, 1.0, 1.0))])
def test_filters_begin_settled(name: str, theta: tuple[float, ...]) -> None:
    felt = still(gyro=(1.0, -2.0, 0.5))
    out = act(name, felt, *theta)
    close(out.gyro, felt.gyro)
    close(out.accel, felt.accel)


# clocks


def test_an_offset_takes_a_shifted_sine() -> None:
    felt, tau = sine(2.0), 0.0137
    stamp_s = felt.t_s[200:-200]
    out = simulate_samples(felt, stamp_s, [(only("clock_offset"), np.array([tau]))])
    np.testing.assert_array_equal(out.stamp_s, stamp_s)
    close(out.gyro[:, 0], np.sin(2.0 * np.pi * 2.0 * (stamp_s + tau)), SPLINE)


def test_a_skewed_clock_takes_a_sine_of_another_frequency() -> None:
    felt, eps = sine(2.0), 1e-3
    stamp_s = felt.t_s[200:-200]
    out = simulate_samples(felt, stamp_s, [(only("clock_skew"), np.array([eps]))])
    close(out.accel[:, 1], np.sin(4.0 * np.pi * (stamp_s + eps * stamp_s)), SPLINE)


def test_a_clock_jumps_once() -> None:
    felt, step = sine(2.0), 0.02
    stamp_s = felt.t_s[200:-200]
    out = simulate_samples(felt, stamp_s, [(only("clock_jump"), np.array([6.0 - 1e-9, step]))])
    late = stamp_s >= 6.0 - 1e-9  # of the log, whatever part of it is looked at
    assert np.count_nonzero(~late) == 1000
    close(out.gyro[:, 2], np.sin(4.0 * np.pi * (stamp_s + step * late)), SPLINE)


def test_a_clock_wanders_straight_from_knot_to_knot() -> None:
    felt = sine(2.0)
    stamp_s = felt.t_s[200:-200]
    offsets_s = np.zeros(len(clock_wander.KNOTS_S))
    offsets_s[:2] = 0.004, 0.010
    out = simulate_samples(felt, stamp_s, [(only("clock_wander"), offsets_s)])
    close(out.gyro[:, 2], np.sin(4.0 * np.pi * (stamp_s + 0.004 + 0.006 * stamp_s / 30.0)), SPLINE)


def test_a_clock_that_wanders_has_knots_for_the_length_of_a_log_and_holds_its_last_offset() -> None:
    effect = clock_wander.until(61.0)
    assert [parameter.name for parameter in effect.parameters] == ["at_0", "at_30", "at_60", "at_90"]
    taken_s = effect.forward(np.array([45.0, 90.0, 120.0]), np.array([0.0, 0.0, 0.002, -0.001]))
    assert taken_s == pytest.approx([45.001, 89.999, 119.999])
    assert clock_wander.until(1e6).parameters == clock_wander.EFFECT.parameters


def test_a_jump_is_found_where_it_is() -> None:
    felt, one = lively(60.0), only("clock_jump")
    truth = np.array([32.0, 0.004])
    real = simulate_samples(felt, felt.t_s, [(one, truth), (only("clock_offset"), np.array([0.01]))])
    noise = 1e-3 * np.random.default_rng(5).normal(size=real.gyro.shape)
    assert one.starts is not None
    start = one.starts(felt, real.with_readings(gyro=real.gyro + noise + 0.1))[0]
    assert np.all(np.abs(start - truth) < [0.05, 0.001])


# sensor and converter


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_scale_misalignment_and_square_are_what_their_equations_say(sensor: str) -> None:
    taken = lively().sample(clock() + 0.002, clock())
    x = getattr(taken, sensor)
    theta = np.array([0.01, -0.02, 0.03])
    close(getattr(act(f"{sensor}_scale", taken, *theta), sensor), x + theta * x)
    close(getattr(act(f"{sensor}_quadratic", taken, *theta), sensor), x + theta * x**2)
    xy, xz, yx, yz, zx, zy = m = (0.01, 0.02, 0.03, 0.04, 0.05, 0.06)
    M = np.array([[0, xy, xz], [yx, 0, yz], [zx, zy, 0]])
    close(getattr(act(f"{sensor}_misalignment", taken, *m), sensor), np.array([row + M @ row for row in x]))


def test_no_scale_acts_on_what_is_added_and_a_gyro_feels_the_force_as_it_is() -> None:
    """A step with a scale, and a sensitivity with an accelerometer's scale, were off by their product: five deviations."""
    taken = lively().sample(clock(), clock())
    s, added, G_xz = np.full(3, 0.05), np.array([0.2, 0.3, 0.4]), np.array([0.0, 0.0, 1e-3, *[0.0] * 6])
    names = {"gyro_scale": s, "accel_scale": s, "gyro_g_sensitivity": G_xz}
    names |= {f"{sensor}_bias_step": [*added, -1.0] for sensor in ("gyro", "accel")}
    after = distort(taken, [(only(name), np.asarray(theta)) for name, theta in names.items()])
    close(after.gyro, 1.05 * taken.gyro + added + np.outer(1e-3 * taken.accel[:, 2], [1.0, 0.0, 0.0]))
    close(after.accel, 1.05 * taken.accel + added)


def test_force_turns_a_gyro_by_its_sensitivity() -> None:
    taken = still().sample(clock(1.0), clock(1.0))
    g = np.arange(9.0) * 1e-3
    close(act("gyro_g_sensitivity", taken, *g).gyro, np.tile(G * g[2::3], (len(taken.gyro), 1)))


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_a_warm_up_reaches_what_its_time_constant_says(sensor: str) -> None:
    taken = still(20.0).sample(clock(20.0), clock(20.0))
    more = getattr(act(f"{sensor}_bias_drift", taken, 0.1, 0.2, -0.3, 4.0), sensor) - getattr(taken, sensor)
    close(more[0], np.zeros(3))
    close(more[round(4.0 * RATE_HZ)], (1.0 - math.exp(-1.0)) * np.array([0.1, 0.2, -0.3]))


@pytest.mark.parametrize(("sensor", "A"), [("gyro", 0.02), ("accel", 0.5)])
def test_a_warm_up_starts_with_its_amplitude_at_the_right_time_constant(sensor: str, A: float) -> None:
    felt, one = lively(90.0), only(f"{sensor}_bias_drift")
    real = simulate_samples(felt, felt.t_s, [(one, np.array([A, -A, 0.0, 30.0]))])
    real = real.with_readings(real.gyro + 0.1, real.accel - 0.2)
    assert one.starts is not None
    close(next(start for start in one.starts(felt, real) if start[3] == 30.0), np.array([A, -A, 0.0, 30.0]), 1e-9)


@pytest.mark.parametrize(("sensor", "A"), [("gyro", 0.01), ("accel", 0.2)])
def test_a_bias_steps_at_its_time_and_is_sought_there_beside_larger_errors(sensor: str, A: float) -> None:
    felt, one, t_step = lively(60.0), only(f"{sensor}_bias_step"), 41.0
    truth = np.array([A, 0.0, -A, t_step - 1e-9])
    read = act(one.name, ideal(one, felt), *truth)
    more = getattr(read, sensor) - getattr(felt, sensor)
    close(more, np.where((felt.t_s < t_step)[:, None], 0.0, truth[:3]))
    others = [("gyro_scale", [0.1, -0.05, 0.02]), ("accel_scale", [0.02, 0.03, -0.02]), ("clock_offset", [0.005])]
    others += [("lever_arm", [0.2, 0.1, -0.1]), ("gyro_bias_drift", [0.05, -0.03, 0.02, 25.0])]
    real = simulate_samples(felt, felt.t_s, [(one, truth), *((only(name), np.array(theta)) for name, theta in others)])
    noise = np.random.default_rng(5).normal(size=(len(felt.t_s), 3))
    assert one.starts is not None
    start = one.starts(felt, real.with_readings(real.gyro + 2e-3 * noise + 0.1, real.accel + 0.03 * noise - 0.2))[1]
    assert abs(start[3] - t_step) < 0.2
    assert np.abs(start[:3] - truth[:3]).max() < 0.7 * A, "a fit from here moves the step in its own direction"


def test_biases_follow_the_temperature() -> None:
    felt = lively()
    out = act("temperature", ideal(only("temperature"), felt), 1e-3, 0.0, 0.0, 0.0, 2e-2, 0.0)
    warmer = felt.t_s - felt.t_s.mean()
    close(out.gyro - felt.gyro, np.outer(warmer, [1e-3, 0.0, 0.0]))
    close(out.accel - felt.accel, np.outer(warmer, [0.0, 2e-2, 0.0]))
    scaled = act("gyro_scale_temperature", ideal(only("gyro_scale_temperature"), felt), 1e-3, 0.0, 2e-3)
    close(scaled.gyro - felt.gyro, np.outer(warmer, [1e-3, 0.0, 2e-3]) * felt.gyro)
    battery = replace(felt, channels={"/battery.temperature": np.zeros(len(felt.t_s)), **felt.channels})
    close(act("temperature", ideal(only("temperature"), battery), 1e-3, 0.0, 0.0, 0.0, 2e-2, 0.0).gyro, out.gyro)
    with pytest.raises(DataError, match=r"no temperature channel; .*close"):
        act("temperature", replace(out, at=replace(felt, channels={"/motor.current": felt.t_s})), *np.ones(6))


def test_vibration_that_is_rectified_has_the_power_of_a_sine() -> None:
    """A sine of amplitude 3 has power 4.5, times the gain of what tells vibration from motion: 1 - g / (z - 1 + g)."""
    felt = still(10.0)
    felt = replace(felt, accel=felt.accel + [3.0, 0.0, 0.0] * np.sin(2.0 * np.pi * 40.0 * felt.t_s)[:, None])
    taken = felt.sample(felt.t_s, felt.t_s)
    theta = np.zeros(18)
    theta[3], theta[9] = 1e-3, 1e-2  # gyro_yx, accel_xx
    out = act("vibration_rectification", taken, *theta)
    more = (out.gyro - taken.gyro)[1800:].mean(axis=0), (out.accel - taken.accel)[1800:].mean(axis=0)
    g = 1.0 - math.exp(-1.0 / (RATE_HZ * SLOW_S))
    power = 4.5 * abs(1.0 - g / (np.exp(2j * np.pi * 40.0 / RATE_HZ) - 1.0 + g)) ** 2
    np.testing.assert_allclose(more, [[0.0, 1e-3 * power, 0.0], [1e-2 * power, 0.0, 0.0]], rtol=1e-3, atol=1e-12)


def test_readings_are_clipped_at_their_limit_and_the_limit_is_found() -> None:
    felt, one = lively(), only("saturation")
    out = simulate_samples(felt, felt.t_s, [(one, np.array([1.5, 12.0]))])
    np.testing.assert_array_equal(out.gyro, np.minimum(np.maximum(felt.gyro, -1.5), 1.5))
    np.testing.assert_array_equal(out.accel, np.minimum(np.maximum(felt.accel, -12.0), 12.0))
    assert one.starts is not None
    np.testing.assert_array_equal(one.starts(felt, out)[2], [1.5, 12.0])


def test_readings_are_rounded_to_whole_steps_and_the_step_is_found() -> None:
    felt, one = lively(), only("quantization")
    out = simulate_samples(felt, felt.t_s, [(one, np.array([0.1, 0.25]))])
    np.testing.assert_allclose(out.gyro, np.round(felt.gyro, 1), atol=1e-12)
    np.testing.assert_array_equal(out.accel, np.round(4.0 * felt.accel) / 4.0)
    assert one.starts is not None
    np.testing.assert_allclose(one.starts(felt, out)[2], [0.1, 0.25], rtol=1e-9)


# the way through


def test_stages_act_in_their_order_whatever_the_order_given() -> None:
    felt, theta = lively(), {}
    stamp_s = felt.t_s[100:-100]
    theta = {"quantization": [0.05, 0.05], "gyro_scale": [0.1] * 3, "clock_offset": [0.01], "low_pass": [5.0]}
    theta |= {"saturation": [1.02, 9.99], "lever_arm": [0.3, 0.0, 0.0], "mount_rotation": [0.1, 0.2, 0.3]}
    acting = [(only(name), np.array(value)) for name, value in theta.items()]
    now: IdealMotion | SensorSamples = felt
    for name in ("lever_arm", "mount_rotation", "low_pass"):
        now = act(name, now, *theta[name])
    assert isinstance(now, IdealMotion)
    now = now.sample(stamp_s + 0.01, stamp_s)
    for name in ("gyro_scale", "saturation", "quantization"):
        now = act(name, now, *theta[name])
    for order in (acting, acting[::-1]):
        out = simulate_samples(felt, stamp_s, order)
        np.testing.assert_array_equal(out.gyro, now.gyro)
        np.testing.assert_array_equal(out.accel, now.accel)
    assert np.abs(out.gyro).max() == pytest.approx(1.0)  # 1.02 clipped, then rounded to 1.00


def test_sensed_is_the_part_behind_the_clock() -> None:
    felt = lively()
    acting = [(only("gyro_scale"), np.full(3, 0.1)), (only("clock_offset"), np.array([0.01]))]
    taken = simulate_samples(felt, felt.t_s, acting[1:])
    np.testing.assert_array_equal(distort(taken, acting).gyro, simulate_samples(felt, felt.t_s, acting).gyro)


# what is felt, taken at other times


@pytest.mark.parametrize("at", [lambda t: t, lambda t: t + 0.0013, lambda t: t[5:-5:3] + 0.002])
def test_taken_is_the_signal_at_those_times(at: Callable[[np.ndarray], np.ndarray]) -> None:
    felt = replace(sine(2.0), channels={"/a.b": clock(20.0) ** 2})
    taken_s = at(felt.t_s)[100:-100]
    out = felt.sample(taken_s, taken_s - 1.0)
    for values in (out.gyro, out.accel, out.alpha):
        close(values, np.tile(np.sin(4.0 * np.pi * taken_s)[:, None], (1, 3)), SPLINE)
    close(out.channels["/a.b"], taken_s**2, 1e-9)
    np.testing.assert_array_equal(out.stamp_s, taken_s - 1.0)


def test_beyond_the_ends_what_was_there_is_held() -> None:
    felt = lively()
    out = felt.sample(np.array([-5.0, 99.0]), np.array([0.0, 1.0]))
    close(out.gyro, felt.gyro[[0, -1]])
    close(out.accel, felt.accel[[0, -1]])


def test_instants_of_the_motions_own_clock_read_its_rows() -> None:
    """Also where the clock goes on before and behind them: a spline there would only cost time."""
    felt = lively()
    for rows in (slice(0, -1), slice(1, None), slice(3, 40), slice(None)):
        out = felt.sample(felt.t_s[rows], felt.t_s[rows])
        assert np.shares_memory(out.gyro, felt.gyro)
        np.testing.assert_array_equal(out.accel, felt.accel[rows])
    assert not np.shares_memory(felt.sample(felt.t_s[1:] + 1e-5, felt.t_s[1:]).gyro, felt.gyro)


def test_what_is_remembered_never_outlives_a_change() -> None:
    felt, t = lively(), clock() + 0.001
    fresh = replace(felt, gyro=felt.gyro * 2.0, channels={"/x": felt.t_s, "/y": -felt.t_s})
    ways = [(felt, t), (fresh, t), (felt, t[:50]), (fresh, felt.t_s), (felt, felt.t_s), (felt, t), (fresh, t)]
    for one, taken_s in ways:
        alone = IdealMotion(one.t_s, one.gyro, one.accel, one.alpha, one.R_wb, one.channels)
        seen, expected = one.sample(taken_s, taken_s), alone.sample(taken_s, taken_s)
        for name, value in numbers(expected).items():
            np.testing.assert_array_equal(numbers(seen)[name], value, err_msg=name)


@pytest.mark.parametrize("changed", [[], [1], [0, 2], [0, 1, 2]])
def test_columns_taken_from_an_earlier_motion_are_those_of_a_new_one(changed: list[int]) -> None:
    felt, t = lively(), clock() + 0.001
    acting = [(only("mount_resonance"), np.array([20.0, 0.2, 0.5, 0.0, 0.5])), (only("low_pass"), np.array([15.0]))]
    accel = felt.accel.copy()
    accel[:, changed] += np.sin(felt.t_s)[:, None]
    moved = replace(felt, accel=accel)
    alone = IdealMotion(felt.t_s, felt.gyro, accel, felt.alpha, felt.R_wb, felt.channels)
    seen, again, expected = (simulate_samples(one, t, acting) for one in (felt, moved, alone))
    np.testing.assert_array_equal(again.gyro, expected.gyro)
    np.testing.assert_array_equal(again.accel, expected.accel)
    assert (seen.accel != again.accel).any(axis=0).tolist() == [k in changed for k in range(3)]


def test_a_clock_that_is_not_even_is_refused() -> None:
    felt = still()
    t_s = felt.t_s.copy()
    t_s[50:] += 0.004
    with pytest.raises(DataError, match=r"off in row 50|off in row 49"):
        replace(felt, t_s=t_s).sample(felt.t_s + 0.001, felt.t_s)
