"""What has no name in the catalogue: channels that drive, curves and short equations, each an effect that can be fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support import planted

from imutool.diagnosis.estimation import unnamed_effects as unnamed
from imutool.diagnosis.estimation.gauss_newton import fit
from imutool.sensor.effect import Effect
from imutool.sensor.samples import IdealMotion

SURE = 4.0
T = planted.clock()
CURRENT = np.sin(0.7 * T) + 0.5 * np.cos(1.9 * T)


def named(physics: str, among: object) -> Effect:
    return next(one for one in among if one.key == physics)  # type: ignore[attr-defined]


def test_each_channel_may_drive_each_sensor_and_none_that_the_catalogue_names() -> None:
    channels = {"/motor": CURRENT, "/imu0/temperature": 20.0 + T, "/still": np.ones_like(T)}
    pair = planted.pair(planted.rich(channels=channels))
    assert [one.key for one in unnamed.driven([pair])] == ["driven:/motor:gyro", "driven:/motor:accel"]


def test_the_imus_own_samples_under_another_name_drive_nothing() -> None:
    """Calibrated, they are not even equal to the raw ones."""
    ideal = planted.rich()
    calibrated = ideal.gyro @ [0.02, 1.03, -0.01] + 0.1
    pair = planted.pair(planted.rich(channels={"/calibrated_gyro_y": calibrated, "/motor": CURRENT}))
    assert {one.key.split(":")[1] for one in unnamed.driven([pair])} == {"/motor"}


def test_only_channels_of_all_logs_may_drive() -> None:
    pairs = [planted.pair(planted.rich(channels={"/motor": CURRENT, name: CURRENT**2})) for name in ("/one", "/other")]
    assert {one.key.split(":")[1] for one in unnamed.driven(pairs)} == {"/motor"}


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
@pytest.mark.parametrize("lag_s", [0.0, 0.08, -0.15])
def test_what_a_channel_adds_is_gain_times_its_departure_some_time_earlier(sensor: str, lag_s: float) -> None:
    pair = planted.pair(planted.rich(channels={"/motor": CURRENT}))
    physics = named(f"driven:/motor:{sensor}", unnamed.driven([pair]))
    before = pair.ideal.sample(pair.stamp_s, pair.stamp_s)
    after = physics.forward(before, np.array([0.1, -0.2, 0.3, lag_s]))
    t = T - lag_s
    then = np.sin(0.7 * t) + 0.5 * np.cos(1.9 * t) - CURRENT.mean()
    inner = (T > 0.2) & (T[-1] - 0.2 > T)
    added = (after.gyro - before.gyro) if sensor == "gyro" else (after.accel - before.accel)
    np.testing.assert_allclose(added[inner], then[inner, None] * [0.1, -0.2, 0.3], atol=1e-4)
    other = (after.accel - before.accel) if sensor == "gyro" else (after.gyro - before.gyro)
    assert not other.any()


def test_gain_and_lag_of_a_driver_come_back() -> None:
    felt = planted.rich(channels={"/motor": CURRENT})
    truth = np.array([0.1, -0.05, 0.03, 0.12])
    added = np.zeros((len(T), 6))
    added[:, 3:] = np.interp(T - truth[3], T, CURRENT - CURRENT.mean())[:, None] * truth[:3]
    pair = planted.pair(felt, added=added)
    physics = named("driven:/motor:accel", unnamed.driven([pair]))
    assert physics.starts is not None
    fits = [
        fit([planted.weighed(pair)], ((physics, start),), iterations=12) for start in physics.starts(felt, unnamed.like([pair]))
    ]
    best = min(fits, key=lambda one: one.objective)
    assert (np.abs(best.chosen[0][1] - truth) < SURE * best.stds()[physics.key]).all()


def test_every_curve_and_term_adds_on_one_axis_in_proportion_to_its_parameters_and_nothing_at_zero() -> None:
    before = unnamed.like([planted.pair(planted.rich(duration_s=10.0))])
    columns = np.concatenate([before.gyro, before.accel], axis=1)
    everything = (*unnamed.curves(before), *unnamed.terms(before))
    assert len(everything) > 500
    assert len({one.key for one in everything}) == len(everything)
    for physics in everything[::7]:  # eighty of them, every axis and kind among them
        theta = np.linspace(0.5, 1.0, len(physics.parameters)) * physics.plausible
        once, twice, none = (physics.forward(before, factor * theta) for factor in (1.0, 2.0, 0.0))
        added, doubled, nothing = (np.concatenate([r.gyro, r.accel], axis=1) - columns for r in (once, twice, none))
        np.testing.assert_allclose(doubled, 2.0 * added, atol=1e-9 * max(1.0, np.abs(added).max()))
        assert not nothing.any()
        signal, _, rest = physics.key.removeprefix("unknown:").partition(".")
        column = {"gyro": 0, "accel": 3}[signal] + "xyz".index(rest[0])
        assert np.flatnonzero(added.any(axis=0)).tolist() == [column]
        assert physics.sensors == (signal,)
        assert physics.linear


def test_a_curve_is_held_beyond_its_ends() -> None:
    before = unnamed.like([planted.pair(planted.rich(duration_s=10.0))])
    curve = named("unknown:accel.y(omega_z)", unnamed.curves(before)).forward
    first, last = curve.inner[0], curve.inner[-1]
    values = curve.basis(np.array([first - 5.0, first, last, last + 5.0])) @ np.arange(1.0, unnamed.KNOTS + 1.0)
    assert values[0] == values[1]
    assert values[2] == values[3]
    assert np.isfinite(values).all()


def test_a_curve_finds_a_shape_that_has_no_name_within_its_band() -> None:
    felt = planted.rich()
    added = np.zeros((len(T), 6))
    added[:, 4] = 0.5 * np.tanh(felt.gyro[:, 2] / 0.6)
    pair = planted.pair(felt, added=added)
    physics = named("unknown:accel.y(omega_z)", unnamed.curves(unnamed.like([pair])))
    got = fit([planted.weighed(pair)], ((physics, np.zeros(unnamed.KNOTS)),))
    x = np.linspace(*np.quantile(felt.gyro[:, 2], [0.05, 0.95]), 30)
    basis = physics.forward.basis(x)
    centred = basis - basis.mean(axis=0)
    truth = 0.5 * np.tanh(x / 0.6)
    error = centred @ got.chosen[0][1] - (truth - truth.mean())
    band = np.sqrt(np.einsum("nq,qp,np->n", centred, got.covariance, centred))
    assert (np.abs(error) < SURE * band + 0.05 * 0.5).all()  # and what seven splines cannot follow
    assert band.max() < 0.1


@pytest.mark.parametrize(
    ("text", "column", "size"), [("omega_x omega_y", 5, 0.05), ("omega_z |omega_z|", 0, 0.004), ("sign(f_x)", 3, 0.02)]
)
def test_the_coefficient_of_a_term_comes_back(text: str, column: int, size: float) -> None:
    felt = planted.rich()
    w, f = felt.gyro, felt.accel
    value = {
        "omega_x omega_y": w[:, 0] * w[:, 1],
        "omega_z |omega_z|": w[:, 2] * np.abs(w[:, 2]),
        "sign(f_x)": np.sign(f[:, 0]),
    }
    added = np.zeros((len(T), 6))
    added[:, column] = size * value[text]
    pair = planted.pair(felt, added=added)
    name = f"unknown:{('gyro', 'accel')[column // 3]}.{'xyz'[column % 3]}:{text}"
    physics = named(name, unnamed.terms(unnamed.like([pair])))
    got = fit([planted.weighed(pair)], ((physics, np.zeros(1)),))
    assert abs(got.chosen[0][1][0] - size) < SURE * got.stds()[name][0]


def test_a_variable_that_never_changes_makes_no_curve_and_no_term() -> None:
    like = unnamed.like([planted.pair(planted.planar())])
    assert not any("omega_x" in one.key or "f_z" in one.key for one in unnamed.curves(like))
    assert not any("omega_x" in one.key for one in unnamed.terms(like))


def test_what_is_like_the_first_log_are_its_ideal_signals_at_its_fitted_samples() -> None:
    felt = planted.rich()
    pair = planted.pair(felt, stamp_s=felt.t_s[100:-100])
    like = unnamed.like([pair, planted.pair(planted.planar())])
    np.testing.assert_allclose(like.gyro, felt.gyro[100:-100][pair.fitted], atol=1e-6)
    assert np.array_equal(like.stamp_s, pair.stamp_s[pair.fitted])


@pytest.mark.parametrize(
    ("variable", "unit"), [("omega_x", "rad/s"), ("|omega|", "rad/s"), ("|f|", "m/s²"), ("alpha_z", "rad/s²"), ("t", "s")]
)
def test_units_of_variables(variable: str, unit: str) -> None:
    assert unnamed.unit(variable) == unit


def test_a_curve_bends_where_the_samples_are() -> None:
    """A step near zero, in a variable that is rarely far from it: knots at even distances would not see it."""
    rng = np.random.default_rng(0)
    x = np.where(rng.random(4000) < 0.02, 6.0, 0.5) * rng.standard_normal(4000)
    gyro = np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)
    t_s = np.arange(len(x)) * 0.01
    like = IdealMotion(t_s, gyro, np.zeros_like(gyro), np.zeros_like(gyro)).sample(t_s, t_s)
    curve = next(one for one in unnamed.curves(like) if one.key == "unknown:gyro.z(omega_x)").forward
    assert isinstance(curve, unnamed.Curve)
    y = np.tanh(x / 0.3)
    basis = curve.basis(x)
    left = y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
    assert left.std() < 0.05 * y.std()
    shown = curve.points(41)
    assert np.allclose(shown[[0, -1]], curve.inner[[0, -1]], rtol=0, atol=0)
    assert (np.diff(shown) > 0).all()


def test_a_curve_follows_the_range_of_a_robot_that_stands_most_of_the_time() -> None:
    """A dead band, passed on the way to a turn: knots by samples alone would all lie where it stands, and where it turns."""
    rng = np.random.default_rng(0)
    turning = np.clip(np.concatenate([np.zeros(7000), np.linspace(0.0, 0.5, 200), np.full(3000, 0.5)]), 0.0, 0.5)
    x = turning + 1e-3 * rng.standard_normal(len(turning))
    gyro = np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)
    t_s = np.arange(len(x)) * 0.01
    like = IdealMotion(t_s, gyro, np.zeros_like(gyro), np.zeros_like(gyro)).sample(t_s, t_s)
    coarse = next(one for one in unnamed.curves(like) if one.key == "unknown:gyro.x(omega_x)")
    fine = unnamed.finer(coarse, like)
    assert fine is not None
    assert isinstance(fine.forward, unnamed.Curve)
    assert np.diff(fine.forward.inner).max() < 1.1 * 0.5 / (unnamed.FINE_KNOTS - 3) / unnamed.BY_RANGE
    passing = (x > 0.05) & (x < 0.45)
    y = np.where(np.abs(x) < 0.3, -x, 0.0)
    basis = fine.forward.basis(x)
    left = y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
    assert left[passing].std() < 0.4 * y[passing].std()  # by samples alone: 0.58


@pytest.mark.parametrize(("gain", "poses", "shrinks"), [(-0.09, True, True), (-0.01, True, False), (-0.09, False, False)])
def test_a_term_that_takes_away_the_motion_of_poses_is_their_noise(gain: float, poses: bool, shrinks: bool) -> None:
    """Next to gravity of 9.81 m/s² along z, a rate times the force is a scale of ten times the gain."""
    pair = replace(planted.pair(planted.planar()), band_hz=6.0 if poses else None)
    (term,) = (one for one in unnamed.terms(unnamed.like([pair])) if one.variant == "gyro.z:omega_z f_z")
    assert unnamed.takes_noise(term, np.array([gain]), [planted.weighed(pair)]) == shrinks
