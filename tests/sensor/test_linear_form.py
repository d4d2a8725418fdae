"""Contract of every effect with a linear form; a new file in imutool/sensor/effects is tested by being there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from imutool import registry
from imutool.errors import ConfigError
from imutool.sensor import catalogue
from imutool.sensor.effects.gyro_bias_drift import TRAINING_TAU_S
from imutool.sensor.effects.rate_curve import KNOTS_RAD_S, NONZERO, hats
from imutool.sensor.linear_form import LinearForm, compiled, patterns
from imutool.sensor.made_up_flight import trajectory
from imutool.sensor.signals import ACCEL, ALPHA, COUNT, GYRO, GYRO_SLOW, LOAD, LOAD_TAU_S, LOADS, SignalFilter, Signals
from imutool.units import SENSORS, Sensor

RATE_HZ = 200.0
NAMES = [effect.name for effect in catalogue.effects() if effect.trained]
EACH = [pytest.param(form.name, sensor, id=f"{form.name}-{sensor}") for sensor in SENSORS for form in catalogue.trained(sensor)]
SAME = 1e-12  # of the largest: two orders of the same sums
# parameters that reach a sensor, and their unit
CATALOGUE = {
    "gyro_scale": (3, "-"),
    "gyro_misalignment": (6, "-"),
    "gyro_g_sensitivity": (9, "rad/s per m/s²"),
    "gyro_quadratic": (3, "s/rad"),
    "gyro_bias_drift": (3, "rad/s"),
    "accel_scale": (3, "-"),
    "accel_misalignment": (6, "-"),
    "accel_quadratic": (3, "s²/m"),
    "accel_bias_drift": (3, "m/s²"),
    "lever_arm": (3, "m"),
    "clock_offset": (1, "s"),
}
ONLY_OURS = {"rate_curve", "vibration_rectification", "gyro_warm_up", "gyro_rate_load", "gyro_force_load"}


def lively(n: int = 200) -> Signals:
    """Rates up to beyond the last knot of the rate curve, and forces."""
    rng = np.random.default_rng(3)
    return SignalFilter(RATE_HZ)(np.arange(n) / RATE_HZ, 3.0 * rng.normal(size=(n, 3)), 9.0 * rng.normal(size=(n, 3)))


def some_theta(effect: LinearForm, seed: int = 0) -> np.ndarray:
    return effect.plausible * np.random.default_rng(seed).normal(size=len(effect.parameters))


def close(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(a, b, rtol=0, atol=SAME * max(1e-300, float(np.abs(b).max())))


@pytest.fixture
def effect(name: str, sensor: Sensor) -> LinearForm:
    (form,) = catalogue.trained(sensor, [name])
    return form


@pytest.mark.parametrize(("name", "sensor"), EACH)
def test_terms_pattern_and_parameters_fit_one_another(effect: LinearForm, name: str, sensor: Sensor) -> None:
    signals = lively()
    terms = effect.terms(signals)
    assert terms.shape[0] == len(signals.t_s)
    assert effect.pattern.shape == (3, terms.shape[1], len(effect.parameters))
    assert effect.plausible.shape == (len(effect.parameters),)
    assert (effect.plausible > 0).all()
    assert effect.pattern.any(axis=(0, 1)).all(), "a parameter does nothing"
    assert effect.pattern.any(axis=(0, 2)).all(), "a term is for nothing"
    assert len({parameter.name for parameter in effect.parameters}) == len(effect.parameters)
    assert all(parameter.unit for parameter in effect.parameters)
    assert (effect.name, effect.sensor) == (name, sensor)
    assert registry.summary("imutool.effects", name).endswith(".")


@pytest.mark.parametrize(("name", "sensor"), EACH)
def test_at_work_it_is_the_matrix_way(effect: LinearForm) -> None:
    theta, signals = some_theta(effect), lively()
    expected = effect.terms(signals) @ effect.matrix(theta)
    assert np.abs(expected).max() > 0
    rows = list(zip(signals.t_s.tolist(), signals.columns.tolist(), strict=True))
    alone, together = effect.compiled(theta), compiled([effect], theta)
    close(alone(signals), expected)
    close(together(signals), expected)
    close(np.array([alone.one(*row) for row in rows]), expected)
    close(np.array([np.dot(row[1], together.matrix) + together.others_at(*row) for row in rows]), expected)


@pytest.mark.parametrize(("name", "sensor"), EACH)
def test_it_is_linear_in_its_parameters_each_through_its_own_pattern(effect: LinearForm) -> None:
    signals = lively(20)
    terms = effect.terms(signals)
    error = effect.compiled(some_theta(effect))(signals)
    close(np.einsum("iqp,nq,p->ni", effect.pattern, terms, some_theta(effect)), error)


@pytest.mark.parametrize(("name", "sensor"), EACH)
def test_nothing_in_no_motion_at_the_start_of_a_log(effect: LinearForm) -> None:
    """No rate, no force, time zero: every effect belongs to something, and the rest bias stays what is read at rest."""
    still = Signals(np.zeros(2), np.zeros((2, COUNT)))
    assert not effect.terms(still).any()
    assert not effect.compiled(some_theta(effect))(still).any()


@pytest.mark.parametrize("name", NAMES)
def test_the_registry_finds_it_under_the_name_it_gives_itself(name: str) -> None:
    effect = registry.load("imutool.effects", name).EFFECT
    assert effect.name == name
    assert effect.sensors
    assert set(effect.sensors) <= set(SENSORS)
    assert name in CATALOGUE.keys() | ONLY_OURS


@pytest.mark.parametrize(("name", "counted"), CATALOGUE.items())
def test_it_is_the_catalogues(name: str, counted: tuple[int, str]) -> None:
    (effect,) = catalogue.effects([name])
    for sensor in effect.sensors:
        (form,) = catalogue.trained(sensor, [name])
        parameters = form.parameters
        assert (len(parameters), {parameter.unit for parameter in parameters}) == (counted[0], {counted[1]})


@pytest.mark.parametrize(("name", "sensor"), EACH)
def test_columns_beyond_what_it_wants_change_nothing(effect: LinearForm) -> None:
    together, signals = compiled([effect], some_theta(effect)), lively(30)
    assert 0 < together.wanted <= COUNT
    cut = signals.columns.copy()
    cut[:, together.wanted :] = 0.0
    np.testing.assert_array_equal(together(Signals(signals.t_s, cut)), together(signals))


def test_samples_alone_need_no_filters_and_no_effect_needs_nothing() -> None:
    wanted = [
        compiled(effects, np.concatenate([some_theta(effect) for effect in effects])).wanted
        for effects in (
            catalogue.trained("gyro", ["gyro_scale"]),
            catalogue.trained("gyro", ["gyro_scale", "gyro_g_sensitivity"]),
            catalogue.trained("accel", ["vibration_rectification"]),
            catalogue.trained("gyro", ["gyro_scale", "rate_curve"]),
            catalogue.trained("gyro", ["gyro_force_load"]),
        )
    ]
    assert wanted == [3, 6, 18, LOAD.start, COUNT]
    assert compiled([], np.zeros(0)).wanted == 0


def test_some_effects_together_are_their_sum() -> None:
    signals = lively(50)
    for sensor in SENSORS:
        effects = catalogue.trained(sensor)
        thetas = [some_theta(effect, seed) for seed, effect in enumerate(effects)]
        alone = sum(effect.compiled(theta)(signals) for effect, theta in zip(effects, thetas, strict=True))
        together = compiled(effects, np.concatenate(thetas))
        close(together(signals), np.asarray(alone))
        rows = zip(signals.t_s.tolist(), signals.columns.tolist(), strict=True)
        close(np.array([np.dot(row, together.matrix) + together.others_at(t_s, row) for t_s, row in rows]), np.asarray(alone))
        terms = np.concatenate([effect.terms(signals) for effect in effects], axis=1)
        close(np.einsum("nq,iqp,p->ni", terms, patterns(effects), np.concatenate(thetas)), np.asarray(alone))
    assert compiled([], np.zeros(0))(signals).shape == (50, 3)
    assert not compiled([], np.zeros(0))(signals).any()


def test_a_slip_of_the_pen_is_answered_with_the_nearest_name() -> None:
    with pytest.raises(ConfigError, match=r"'gyro_scal' is not known.*Did you mean 'gyro_scale'"):
        catalogue.trained("gyro", ["gyro_scal"])


def test_an_effect_on_the_wrong_sensor_or_given_twice_is_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"effects of the gyro: lever_arm does not act on the gyro; expected some of .*gyro_scale"
    ):
        catalogue.trained("gyro", ["gyro_scale", "lever_arm"])
    with pytest.raises(ConfigError, match="a name occurs twice"):
        catalogue.trained("gyro", ["gyro_scale", "gyro_scale"])
    assert [effect.name for effect in catalogue.trained("gyro", ["rate_curve", "gyro_scale"])] == ["rate_curve", "gyro_scale"]


# ── what each one is ─────────────────────────────────────────────────────────────────────────────────────────────────


def exact_signals(n: int = 60) -> tuple[Signals, Callable[..., np.ndarray]]:
    """Signals of a true motion, its angular acceleration the true one, and the force that a point of the body feels."""
    path = trajectory(4)
    t_ns = path.start_ns + 5_000_000_000 + np.arange(n, dtype=np.int64) * 5_000_000
    motion = path.at(t_ns)
    columns = np.zeros((n, COUNT))
    columns[:, GYRO], columns[:, ACCEL], columns[:, ALPHA] = motion.omega_b, motion.specific_force(), motion.alpha_b
    return Signals(np.arange(n) / RATE_HZ, columns), motion.specific_force


def test_a_lever_arm_is_the_rigid_body_law() -> None:
    signals, felt_at = exact_signals()
    r_b = np.array([0.1, -0.2, 0.3])
    (effect,) = catalogue.trained("accel", ["lever_arm"])
    error = effect.compiled(r_b)(signals)
    assert np.abs(error).max() > 0.1
    np.testing.assert_allclose(error, felt_at(r_b) - felt_at(), rtol=0, atol=1e-12)


def test_alpha_of_the_filter_is_that_of_the_motion_but_for_its_lag() -> None:
    """In flight, whose attitude turns at 1.4 Hz: (2 pi 1.4 Hz 0.02 s)² = 0.03 of it is smoothed away."""
    path = trajectory(4)
    t_ns = path.start_ns + 3_000_000_000 + np.arange(2000, dtype=np.int64) * 5_000_000
    motion = path.at(t_ns)
    t_s = np.arange(2000) / RATE_HZ
    alpha = SignalFilter(RATE_HZ)(t_s, motion.omega_b, motion.specific_force()).alpha[200:]
    lagged = path.at(t_ns - 20_000_000).alpha_b[200:]
    assert np.sqrt(np.mean((alpha - lagged) ** 2)) < 0.05 * np.sqrt(np.mean(lagged**2))


def test_a_scale_and_a_misalignment_make_a_matrix() -> None:
    signals = lively(30)
    W = np.arange(9.0).reshape(3, 3) / 100
    for sensor, u in (("gyro", signals.gyro), ("accel", signals.accel)):
        off = W[~np.eye(3, dtype=bool)]  # row by row: xy, xz, yx, yz, zx, zy
        both = catalogue.trained(sensor, [f"{sensor}_misalignment", f"{sensor}_scale"])  # type: ignore[arg-type]
        assert [p.name for p in both[0].parameters] == ["xy", "xz", "yx", "yz", "zx", "zy"]
        close(compiled(both, np.concatenate([off, W.diagonal()]))(signals), u @ W.T)


def test_g_sensitivity_and_rectification_are_full_matrices_row_by_row() -> None:
    signals, G = lively(30), np.arange(9.0).reshape(3, 3)
    for name, u in (("gyro_g_sensitivity", signals.accel), ("vibration_rectification", signals.vibration)):
        (effect,) = catalogue.trained("gyro", [name])
        close(effect.compiled(G.ravel())(signals), u @ G.T)


def test_a_load_drift_is_the_answer_of_a_slow_ode_to_the_load() -> None:
    """At rest, then at a steady rate: K g (1 - exp(-t/tau)) for each time constant, g the ramps that the rate has passed."""
    t_s = np.arange(6000) / RATE_HZ
    rate = np.zeros((6000, 3))
    rate[1000:, 1] = 0.5  # halfway up the second ramp, from 0.3 to 0.7
    signals = SignalFilter(RATE_HZ)(t_s, rate, np.tile([0.0, 0.0, 9.81], (6000, 1)))
    (effect,) = catalogue.trained("gyro", ["gyro_rate_load"])
    theta = np.random.default_rng(0).normal(size=len(effect.parameters))
    K = theta.reshape(3, len(LOAD_TAU_S), -1)
    since_s = np.clip(t_s - 5.0 + 1.0 / RATE_HZ, 0.0, None)[:, None]
    z = -np.expm1(-since_s / LOAD_TAU_S)
    expected = np.einsum("nk,ik->ni", z, K[:, :, 0] + 0.5 * K[:, :, 1])
    np.testing.assert_allclose(effect.compiled(theta)(signals), expected, rtol=0, atol=1e-12)


def test_a_warm_up_of_any_time_constant_is_a_sum_of_those_given() -> None:
    t_s = np.arange(12000) / 100.0
    still = np.zeros((12000, 3))
    z = SignalFilter(100.0)(t_s, still, still + np.array([0.0, 0.0, 9.81])).load[:, :, 0]
    assert z.shape[1] < LOADS
    for tau_s in (8.0, 12.0, 30.0, 45.0, 60.0):
        course = np.exp(-t_s / tau_s)
        columns = np.concatenate([z, np.ones((len(z), 1))], axis=1)
        off = columns @ np.linalg.lstsq(columns, course, rcond=None)[0] - course
        assert np.abs(off[100:]).max() < 0.03


def test_a_clock_offset_moves_the_samples_in_time() -> None:
    t_s = np.arange(400) / RATE_HZ
    wave = np.stack([np.sin(3 * t_s + phase) for phase in range(3)], axis=1)
    signals = SignalFilter(RATE_HZ)(t_s, wave, wave)
    tau = 1e-3
    shifted = np.stack([np.sin(3 * (t_s + tau) + phase) for phase in range(3)], axis=1)
    for sensor in SENSORS:
        (effect,) = catalogue.trained(sensor, ["clock_offset"])
        error = effect.compiled(np.array([tau]))(signals)[1:]
        half_a_period = 9 * tau / (2 * RATE_HZ)  # the backward difference is half a period late: its second derivative
        np.testing.assert_allclose(error, (shifted - wave)[1:], rtol=0, atol=half_a_period + 9 * tau**2)


def test_warm_up_starts_at_zero_and_ends_at_the_amplitude() -> None:
    (effect,) = catalogue.trained("gyro", ["gyro_bias_drift"])
    tau = TRAINING_TAU_S
    at = Signals(np.array([0.0, tau, 100 * tau]), np.zeros((3, COUNT)))
    amplitude = np.array([1e-3, -2e-3, 3e-3])
    error = effect.compiled(amplitude)(at)
    np.testing.assert_allclose(error, np.outer([0.0, 1 - np.exp(-1.0), 1.0], amplitude), rtol=1e-12, atol=1e-18)


def test_the_hats_of_all_knots_and_zeros_own_add_up_to_one() -> None:
    """A partition of unity: values at the knots are values of the curve, a line is reproduced, beyond the ends it is level."""
    x = np.stack([np.linspace(-6.0, 6.0, 241)] * 3, axis=1)
    each = hats(x).reshape(len(x), 3, -1)
    assert each.shape[2] == len(KNOTS_RAD_S) - 1
    assert ((each >= 0) & (each <= 1)).all()
    near = (np.abs(x[:, 0]) < KNOTS_RAD_S[NONZERO].max()) & (np.abs(x[:, 0]) >= KNOTS_RAD_S[KNOTS_RAD_S > 0].min())
    np.testing.assert_allclose(each.sum(2)[near], 1.0, rtol=1e-12)
    line = each @ KNOTS_RAD_S[NONZERO]
    np.testing.assert_allclose(line, np.clip(x, KNOTS_RAD_S[0], KNOTS_RAD_S[-1]), rtol=0, atol=1e-12)
    at_knots = hats(np.stack([KNOTS_RAD_S[NONZERO]] * 3, axis=1)).reshape(-1, 3, int(NONZERO.sum()))
    for axis in range(3):
        np.testing.assert_array_equal(at_knots[:, axis], np.eye(int(NONZERO.sum())))
    assert not hats(np.zeros((1, 3))).any()


def test_the_curves_second_half_sees_the_filtered_rate() -> None:
    columns = np.zeros((2, COUNT))
    columns[:, GYRO_SLOW] = 0.5
    (effect,) = catalogue.trained("gyro", ["rate_curve"])
    names = [parameter.name for parameter in effect.parameters]
    theta = np.zeros(len(names))
    theta[names.index("slow_y+0.5")] = 0.02
    work = effect.compiled(theta)
    np.testing.assert_allclose(work(Signals(np.zeros(2), columns)), [[0.0, 0.02, 0.0]] * 2, rtol=1e-12)
    np.testing.assert_allclose(work.one(0.0, columns[0].tolist()), [0.0, 0.02, 0.0], rtol=1e-12)
