"""Plant an effect and it is found, named, and as sure as it says; plant none and none is found."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from imutool.errors import ConfigError, DataError
from imutool.recording import Imu, Poses, Recording, seconds
from imutool.sensor import catalogue
from imutool.sensor.linear_form import LinearForm, compiled
from imutool.sensor.signals import SignalFilter
from imutool.training.calibration.effect_selection import Calibration, calibrate
from imutool.training.calibration.normal_equations import FOLDS, design_effect, folded
from imutool.training.candidates import CANDIDATES, best_predicted
from imutool.training.settings import LINEAR, SensorPrior
from imutool.training.training_windows import Pool
from imutool.units import Sensor

MakeRecording = Callable[..., Recording]
RATE_HZ = 100.0
FLIGHT = {"rate_hz": RATE_HZ, "duration_s": 60.0, "still_s": 0.0}
NOISE = {"gyro": 2e-3, "accel": 0.05}  # of a sample
REST = {"gyro": 0.01, "accel": 0.1}
SURE = 3.0  # standard deviations
NEAR_PRIOR = 0.3  # deviations of the prior, of what the motion does not show
# A clock or an arm may be each log's own: only that all logs have the same one speaks for an effect. A drift shows in long
# windows, of which such a flight has few.
MIN_GAIN = {"clock_offset": 0.05, "lever_arm": 0.05, "gyro_bias_drift": 0.2}
OTHERS = (1, 16)  # first of three flights; long windows of some fit their log's own unknowns too well
# what a flight of a quadrotor's kind shows: sizes that change its drift several times over
GYRO = ("gyro_scale", "gyro_misalignment", "gyro_g_sensitivity", "gyro_quadratic", "gyro_bias_drift", "clock_offset")
ACCEL = ("accel_scale", "accel_misalignment", "lever_arm", "clock_offset", "accel_bias_drift")
PLANTED: list[tuple[Sensor, str]] = [*(("gyro", name) for name in GYRO), *(("accel", name) for name in ACCEL)]


def measured(recording: Recording, effects: Sequence[LinearForm], theta: np.ndarray, seed: int) -> Recording:
    """The samples of a sensor with errors: u = true + E(u) + rest, solved by going round, then noise."""
    imu, rng = recording.imu, np.random.default_rng(seed)
    t_s, u = seconds(imu.t_ns, int(imu.t_ns[0])), {"gyro": imu.gyro.copy(), "accel": imu.accel.copy()}
    for _ in range(8):
        signals = SignalFilter(RATE_HZ)(t_s, u["gyro"], u["accel"])
        for sensor in ("gyro", "accel"):
            own = [effect for effect in effects if effect.sensor == sensor]
            error = compiled(own, theta)(signals) if own else 0.0
            u[sensor] = getattr(imu, sensor) + error
    for sensor in ("gyro", "accel"):
        u[sensor] = u[sensor] + REST[sensor] * rng.normal(size=3) + NOISE[sensor] * rng.normal(size=u[sensor].shape)
    return Recording(recording.name, Imu(imu.t_ns, u["gyro"], u["accel"]), recording.truths)


def planted_theta(effects: Sequence[LinearForm], of_plausible: float = 0.3) -> np.ndarray:
    """A share of what is plausible, alternately up and down."""
    plausible = np.concatenate([SensorPrior().std_of(effect) for effect in effects])
    signs = np.where(np.arange(len(plausible)) % 2, -1.0, 1.0)
    return of_plausible * plausible * signs


@pytest.fixture(scope="module")
def three(perfect: MakeRecording) -> Callable[[int], list[Recording]]:
    """Three flights from a first seed on."""
    return functools.cache(lambda first: [perfect(first + k, **FLIGHT) for k in range(3)])


@pytest.fixture(scope="module")
def flights(three: Callable[[int], list[Recording]]) -> list[Recording]:
    return three(1)


@pytest.fixture(scope="module")
def without_effects(three: Callable[[int], list[Recording]]) -> Callable[[int, Sensor], Calibration]:
    """The calibration of three flights with a rest bias alone, from a first seed on."""
    return functools.cache(lambda first, sensor: found(three(first), sensor, ()))


def found(
    flights: Sequence[Recording],
    sensor: Sensor,
    effects: Sequence[LinearForm],
    names: Sequence[str] | None = None,
    of_plausible: float = 0.3,
) -> Calibration:
    """The calibration of flights with effects planted on one sensor; the other's errors are its rest bias alone."""
    theta = planted_theta(effects, of_plausible) if effects else np.zeros(0)
    pool = Pool.of([measured(flight, effects, theta, seed) for seed, flight in enumerate(flights)])
    true_gyro = torch.cat([torch.tensor(flight.overlap().imu.gyro) for flight in flights])
    return calibrate(pool, sensor, pool.gyro if sensor == "gyro" else true_gyro, names)


def of_effects(names: Sequence[str], sensor: Sensor) -> list[tuple[str, str]]:
    """Effect and parameter of each entry of theta."""
    return [(form.name, parameter.name) for form in catalogue.trained(sensor, names) for parameter in form.parameters]


def z_scores(calibration: Calibration, theta: np.ndarray) -> np.ndarray:
    z: np.ndarray = (calibration.theta.numpy() - theta) / calibration.covariance.diagonal().sqrt().numpy()
    return z


@pytest.mark.parametrize(("sensor", "name"), PLANTED, ids=str)
def test_a_planted_effect_is_found_and_named_and_no_other(flights: list[Recording], sensor: Sensor, name: str) -> None:
    effects = catalogue.trained(sensor, [name])
    calibration = found(flights, sensor, effects)
    assert set(calibration.effects) == {name, *LINEAR[sensor]}
    assert next(iter(calibration.gains)) == name
    assert calibration.gains[name] > MIN_GAIN.get(name, 0.3)
    planted = dict(zip(of_effects([name], sensor), planted_theta(effects), strict=True))
    z = z_scores(calibration, np.array([planted.get(key, 0.0) for key in of_effects(calibration.effects, sensor)]))
    assert np.abs(z).max() < SURE, z
    assert calibration.unseen == ()


def test_an_effect_far_beyond_its_prior_is_not_held_back_by_it(flights: list[Recording]) -> None:
    """What the first steps leave of it counts as noise, and the prior outweighs that: many more have to follow."""
    effects = catalogue.trained("gyro", ["gyro_g_sensitivity"])
    calibration = found(flights, "gyro", effects, ["gyro_g_sensitivity"], of_plausible=10.0)
    np.testing.assert_allclose(calibration.theta.numpy(), planted_theta(effects, 10.0), rtol=0.05)


def test_a_clock_that_all_flights_share_is_found(three: Callable[[int], list[Recording]]) -> None:
    """3 ms: logs that agree share it, though each may have a clock of its own."""
    effects = catalogue.trained("gyro", ["clock_offset"])
    calibration = found(three(OTHERS[-1]), "gyro", effects)
    assert next(iter(calibration.gains)) == "clock_offset"
    assert set(calibration.effects) == {"clock_offset", *LINEAR["gyro"]}
    assert float(calibration.theta[0]) == pytest.approx(planted_theta(effects)[0], rel=0.05)


def test_a_clock_of_one_log_is_not_the_sensors(three: Callable[[int], list[Recording]]) -> None:
    """It may be that of the poses: other logs would be shifted by it."""
    flight = three(OTHERS[-1])[:1]
    calibration = found(flight, "gyro", catalogue.trained("gyro", ["clock_offset"]))
    assert calibration.effects == found(flight, "gyro", ()).effects == LINEAR["gyro"]
    assert np.abs(z_scores(calibration, np.zeros(len(calibration.theta)))).max() < SURE


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
@pytest.mark.parametrize("first", OTHERS)
def test_where_nothing_is_planted_scale_and_misalignment_are_near_zero_and_nothing_else_is_found(
    without_effects: Callable[[int, Sensor], Calibration], sensor: Sensor, first: int
) -> None:
    calibration = without_effects(first, sensor)
    assert calibration.effects == LINEAR[sensor]
    assert max(calibration.gains.values()) < 0.06
    prior = np.concatenate([SensorPrior().std_of(form) for form in catalogue.trained(sensor, LINEAR[sensor])])
    assert np.abs(calibration.theta.numpy()).max() < 0.1 * prior.min()
    assert np.abs(z_scores(calibration, np.zeros(9))).max() < SURE


def test_effects_planted_together_are_told_apart(flights: list[Recording]) -> None:
    effects = catalogue.trained("gyro", ["gyro_misalignment", "gyro_scale"])
    calibration = found(flights, "gyro", effects, ["gyro_misalignment", "gyro_scale"])
    assert np.abs(z_scores(calibration, planted_theta(effects))).max() < SURE


def test_a_curve_that_no_name_describes_is_found_as_a_curve(flights: list[Recording]) -> None:
    """A dead band: below 0.1 rad/s the sensor reads less, beyond it a constant too little."""
    (effect,) = catalogue.trained("gyro", ["rate_curve"])
    names = [parameter.name for parameter in effect.parameters]
    size = {name: 0.0 if name.startswith("slow") else -0.02 * np.sign(float(name[1:])) for name in names}
    size = {name: 0.3 * value if "0.03" in name else value for name, value in size.items()}
    theta = np.array([size[name] for name in names])
    pool = Pool.of([measured(flight, [effect], theta, seed) for seed, flight in enumerate(flights)])
    calibration = calibrate(pool, "gyro", pool.gyro)
    assert "rate_curve" in calibration.effects
    assert next(iter(calibration.gains)) == "rate_curve"


def test_parts_of_one_log_are_predicted_best_by_what_was_planted(flights: list[Recording]) -> None:
    """The table of left-out parts cannot tell: a start from the truth is as long as a part."""
    linear = catalogue.trained("gyro", LINEAR["gyro"])
    (curve,) = catalogue.trained("gyro", ["rate_curve"])
    step = np.array([0.02 * np.sign(float(parameter.name.removeprefix("slow_")[1:])) for parameter in curve.parameters])
    step[["slow" in parameter.name for parameter in curve.parameters]] = 0.0
    none: tuple[LinearForm, ...] = ()
    for effects, theta, expected in (
        (none, np.zeros(0), ("constant",)),
        (linear, planted_theta(linear), ("linear", "effects")),  # the effects contain both
        ((curve,), step, ("effects",)),
    ):
        pool = Pool.of([measured(flights[0], effects, theta, 0)])
        fit = calibrate(pool, "gyro", pool.gyro)
        assert best_predicted(fit, "gyro", CANDIDATES) in expected, fit.gains


def test_a_rest_bias_of_its_own_is_found_for_every_log(without_effects: Callable[[int, Sensor], Calibration]) -> None:
    calibration = without_effects(1, "gyro")
    for seed, rest in enumerate(calibration.own[:, :3].numpy()):
        planted = REST["gyro"] * np.random.default_rng(seed).normal(size=3)
        np.testing.assert_allclose(
            rest, planted, rtol=0, atol=5 * NOISE["gyro"] / np.sqrt(0.8 * RATE_HZ * FLIGHT["duration_s"])
        )


def test_two_logs_are_cut_into_parts_that_predict_one_another(flights: list[Recording]) -> None:
    calibration = found(flights[:2], "gyro", catalogue.trained("gyro", ["gyro_scale"]))
    assert next(iter(calibration.gains)) == "gyro_scale"
    assert set(calibration.effects) == set(LINEAR["gyro"])
    assert calibration.own[:, :3].shape == (2, 3)
    pool = Pool.of(flights[:2])
    parts = folded(pool)
    assert len(parts.names) == 2 * FOLDS
    assert torch.equal(parts.log // FOLDS, pool.log)
    assert bool((torch.diff(parts.log) >= 0).all())
    counts = torch.bincount(parts.log[~pool.held_out], minlength=2 * FOLDS)
    assert int(counts.max() - counts.min()) <= 1
    whole = Pool.of(flights)
    assert folded(whole) is whole


def test_a_minute_keeps_what_it_does_not_show_near_what_sensors_are_like(flights: list[Recording]) -> None:
    """Turning about one axis shows its scale; the other axes read noise alone, and their scale stays within the prior."""
    effects = catalogue.trained("gyro", LINEAR["gyro"])
    theta, rows = planted_theta(effects), of_effects(LINEAR["gyro"], "gyro")
    pool = Pool.of([measured(planar(flights[0]), effects, theta, 0)])
    for sensors in (SensorPrior(), SensorPrior(gyro_scale=0.01)):
        found_theta = calibrate(pool, "gyro", pool.gyro, LINEAR["gyro"], "all", sensors=sensors).theta.numpy()
        for axis in "xy":
            assert abs(found_theta[rows.index(("gyro_scale", axis))]) < 2.0 * sensors.gyro_scale
        z = rows.index(("gyro_scale", "z"))
        assert found_theta[z] == pytest.approx(theta[z], rel=0.05)


def test_logs_of_one_setup_share_errors_so_that_each_more_of_them_says_less(flights: list[Recording]) -> None:
    one, three = Pool.of(flights[:1]), Pool.of(flights)
    assert design_effect(one) == 1.0
    assert 1.0 < design_effect(three) < 3.0
    std = [calibrate(pool, "gyro", pool.gyro, LINEAR["gyro"], "all").covariance.diagonal().sqrt() for pool in (one, three)]
    assert bool((std[1] < std[0]).all())


def planar(recording: Recording, pitch_rad: float = 0.0) -> Recording:
    """The heading of a flight, and nothing else: a robot on a flat floor, or one that pitches as it drives."""
    from scipy.spatial.transform import Rotation

    truth, imu = recording.truth, recording.imu
    w_z, t_s = imu.gyro[:, 2], seconds(imu.t_ns, int(imu.t_ns[0]))
    heading = np.concatenate([[0.0], np.cumsum(0.5 * (w_z[1:] + w_z[:-1]) * np.diff(t_s))])
    pitch = pitch_rad * np.sin(3.0 * t_s)
    q_wb_wxyz = Rotation.from_euler("ZY", np.stack([heading, pitch], axis=1)).as_quat(scalar_first=True)
    still = np.zeros((len(imu), 3))
    assert np.array_equal(truth.t_ns, imu.t_ns)
    poses = Poses(imu.t_ns, still, q_wb_wxyz, still)
    gyro = np.stack([-np.sin(pitch) * w_z, 3.0 * pitch_rad * np.cos(3.0 * t_s), np.cos(pitch) * w_z], axis=1)
    return replace(recording, imu=Imu(imu.t_ns, gyro, still + np.array([0.0, 0.0, 9.81])), truths={"/ground_truth/pose": poses})


def test_what_a_planar_motion_cannot_show_stays_at_its_prior_and_is_named(flights: list[Recording]) -> None:
    effects = catalogue.trained("gyro", ["gyro_misalignment"])
    calibration = found([planar(flight) for flight in flights], "gyro", effects, ["gyro_misalignment"])
    never = {f"gyro_misalignment.{pair}" for pair in ("xy", "yx")}
    assert never <= set(calibration.unseen) <= never | {f"gyro_misalignment.{pair}" for pair in ("zx", "zy")}
    theta, widths = planted_theta(effects), SensorPrior().std_of(effects[0])
    for parameter, value, planted, width in zip(effects[0].parameters, calibration.theta.numpy(), theta, widths, strict=True):
        if parameter.name in ("xz", "yz"):  # what turning about z adds to the others
            assert abs(value - planted) < 0.1 * abs(planted), parameter.name
        else:
            assert abs(value) < NEAR_PRIOR * width, parameter.name


def test_named_effects_are_fitted_whether_or_not_the_logs_support_them(flights: list[Recording]) -> None:
    calibration = found(flights, "gyro", (), ["gyro_quadratic", "gyro_scale"])
    assert calibration.effects == ("gyro_quadratic", "gyro_scale")
    assert np.abs(z_scores(calibration, np.zeros(6))).max() < SURE
    with pytest.raises(ConfigError, match="Did you mean 'gyro_scale'"):
        found(flights, "gyro", (), ["gyro_scael"])


def test_a_log_whose_truth_has_too_many_holes_is_named(flights: list[Recording], without_truth: MakeRecording) -> None:
    bare = without_truth(flights[1], 0.6, 0.97 * FLIGHT["duration_s"])
    pool = Pool.of([flights[0], bare, flights[2]])
    with pytest.raises(DataError, match=r"exact_2: no stretch of truth without a gap in the train part; expected 1 s"):
        calibrate(pool, "gyro", pool.gyro)
