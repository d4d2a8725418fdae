"""A physics.toml corrects the samples that it made: exactly, to first order, or not at all."""

from __future__ import annotations

import logging
import pickle
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from imutool.bias.model_file import find_model
from imutool.bias.physics import MAX_TAU_S, Model
from imutool.bias_start.correction import OnlineDebiaser, apply
from imutool.bias_start.initial_bias import prior
from imutool.debiasing import debias
from imutool.errors import ConfigError, ModelError
from imutool.evaluation import evaluate
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.recording import Imu, Recording, seconds
from imutool.sensor import catalogue, physics_file
from imutool.sensor.effects import gyro_scale
from imutool.sensor.made_up_flight import flight
from imutool.sensor.physics_file import Bias, Curve, Entry, PhysicsFile, Term, Value
from imutool.sensor.simulate import simulate

RATE_HZ = 200.0
BIAS = Bias(gyro=(0.05, -0.03, 0.02), accel=(0.2, -0.1, 0.3))
EXACT = 1e-9  # of a matrix and its inverse
STREAMED = 1e-6  # the contract of every model: in blocks and one by one the same
# What is left of the error, as a share of its own root mean square: an effect of the true motion is computed from the measured
# one (first order: as much of itself as it is of the signal), a derivative lags by its filter of 0.02 s.
FIRST_ORDER, BY_DERIVATIVE = 0.2, 0.5

EFFECTS: Mapping[str, tuple[Mapping[str, float], float]] = {
    "gyro_scale": ({"x": 0.05, "y": -0.1, "z": 0.08}, EXACT),
    "accel_scale": ({"x": 0.02, "y": -0.03, "z": 0.01}, EXACT),
    "gyro_scale_asymmetry": ({"x": 0.1, "y": -0.05}, FIRST_ORDER),
    "accel_scale_asymmetry": ({"x": 0.04, "y": -0.05}, FIRST_ORDER),
    "gyro_misalignment": ({"xy": 0.05, "yx": -0.04, "zx": 0.06}, EXACT),
    "accel_misalignment": ({"xz": 0.03, "zy": -0.02}, EXACT),
    "mount_rotation": ({"phi_x": 0.2, "phi_y": -0.1, "phi_z": 0.3}, EXACT),
    "gyro_g_sensitivity": ({"xx": 2e-3, "yz": -3e-3}, FIRST_ORDER),
    "gyro_quadratic": ({"x": 0.05, "z": -0.03}, FIRST_ORDER),
    "accel_quadratic": ({"z": 3e-3}, FIRST_ORDER),
    "gyro_bias_drift": ({"x": 0.03, "y": -0.02, "tau": 15.0}, EXACT),
    "lever_arm": ({"x": 0.2, "y": -0.3, "z": 0.1}, BY_DERIVATIVE),
    "clock_offset": ({"tau": 0.004}, BY_DERIVATIVE),
    "gyro_delay": ({"tau": 0.003}, BY_DERIVATIVE),
}

TERM = Term(signal="accel", term="omega_x omega_y", value=(0.2, 0.0, -0.1))
BENT = (0.06, 0.0, 0.0), (0.0, 0.0, 0.0), (0.06, 0.0, 0.0)
CURVE = Curve(signal="gyro", variable="f_x", unit="m/s²", x=(-3.0, 0.0, 3.0), y=BENT)


def entry(name: str, values: Mapping[str, float], std: float | None = None) -> Entry:
    (physics,) = catalogue.effects([name])
    units = {number.name: number.unit for number in gyro_scale.of_form(physics, values).parameters}
    return Entry(name=name, parameters={key: Value(value=v, std=std, unit=units[key]) for key, v in values.items()})


def written(
    path: Path, *entries: Entry, bias: Bias | None = BIAS, unknown: tuple[Curve, ...] = (), term: tuple[Term, ...] = ()
) -> Path:
    path.write_text(physics_file.to_toml(PhysicsFile(effect=entries, bias=bias, unknown=unknown, term=term)), "utf-8")
    return path


@pytest.fixture(scope="module")
def trajectory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("trajectory") / "trajectory.mcap"
    write(flight(7, duration_s=20.0), path)
    return path


@pytest.fixture(scope="module")
def ideal(trajectory: Path) -> Recording:
    return along(trajectory, None, "ideal")


def along(trajectory: Path, physics: Path | None, name: str) -> Recording:
    """Without noise, so that what is left is the method's own."""
    out = trajectory.with_name(f"{name}.mcap")
    simulate(trajectory, out, physics=physics, rate_hz=RATE_HZ, overwrite=True)
    return read(out)


def left(file: Path, raw: Recording, ideal: Recording) -> tuple[float, float]:
    """Root mean square distance from the ideal before (but for the bias) and after."""
    model = find_model(file, RATE_HZ)
    clean = apply(model, prior(model), raw.imu).imu
    b = np.array([*BIAS.gyro, *BIAS.accel])
    return distance(raw.imu, ideal.imu, b), distance(clean, ideal.imu, np.zeros(6))


def distance(one: Imu, other: Imu, b: np.ndarray) -> float:
    """An accelerometer's m/s² counts as a tenth of a gyro's rad/s; what a clock takes off the end is not compared."""
    n = min(len(one), len(other))
    assert n > len(other) - 5
    assert np.array_equal(one.t_ns[:n], other.t_ns[:n])
    mine, theirs = (np.concatenate([imu.gyro, imu.accel], axis=1)[:n] for imu in (one, other))
    away = (mine - theirs - b) * np.repeat([1.0, 0.1], 3)
    return float(np.sqrt(np.mean(away**2)))


@pytest.mark.parametrize("name", EFFECTS)
def test_what_an_effect_adds_is_taken_off(name: str, trajectory: Path, ideal: Recording) -> None:
    values, tolerance = EFFECTS[name]
    file = written(trajectory.with_name(f"{name}.toml"), entry(name, values))
    before, after = left(file, along(trajectory, file, name), ideal)
    assert after < tolerance * before


def test_scale_misalignment_and_mount_together_are_exact(trajectory: Path, ideal: Recording) -> None:
    names = ("gyro_scale", "gyro_misalignment", "accel_scale", "accel_misalignment", "mount_rotation")
    file = written(trajectory.with_name("together.TOML"), *(entry(name, EFFECTS[name][0]) for name in names))
    before, after = left(file, along(trajectory, file, "together"), ideal)
    assert after < EXACT * before


def test_terms_and_curves_without_a_name_are_taken_off(trajectory: Path, ideal: Recording) -> None:
    file = written(trajectory.with_name("nameless.toml"), unknown=(CURVE,), term=(TERM,))
    before, after = left(file, along(trajectory, file, "nameless"), ideal)
    assert after < FIRST_ORDER * before


def test_an_online_debiaser_goes_to_another_process(trajectory: Path, ideal: Recording) -> None:
    """Every effect that a file can hold, also those without a name."""
    every = (entry(name, values) for name, (values, _) in EFFECTS.items())
    path = written(trajectory.with_name("every.toml"), *every, unknown=(CURVE,), term=(TERM,))
    online = OnlineDebiaser(find_model(path, RATE_HZ), with_covariance=True)
    for t_ns, gyro, accel in zip(ideal.imu.t_ns[:20], ideal.imu.gyro, ideal.imu.accel, strict=False):
        sent = pickle.loads(pickle.dumps(online))
        here, there = online(int(t_ns), gyro, accel), sent(int(t_ns), gyro, accel)
        np.testing.assert_array_equal(np.concatenate(there), np.concatenate(here))


def test_blocks_and_single_samples_agree(trajectory: Path) -> None:
    file = written(trajectory.with_name("all.toml"), *(entry(name, values) for name, (values, _) in EFFECTS.items()))
    imu = along(trajectory, file, "all").imu.rows(slice(0, 900))
    model = find_model(file, RATE_HZ)
    rest, t_s = model.prior_mean + 0.01, seconds(imu.t_ns, int(imu.t_ns[0]))
    whole = model.stream(rest)(t_s, imu.gyro, imu.accel)
    stream = model.stream(rest)
    cuts = [stream(t_s[a:b], imu.gyro[a:b], imu.accel[a:b]) for a, b in ((0, 1), (1, 400), (400, 401), (401, 900))]
    assert np.allclose(np.concatenate(cuts), whole, rtol=0, atol=STREAMED)


def test_the_bias_is_the_prior_and_the_deviations_its_calibration(trajectory: Path) -> None:
    file = written(trajectory.with_name("sure.toml"), entry("gyro_scale", {"x": 0.1}, std=0.01))
    model = find_model(file, RATE_HZ)
    assert model.prior_mean.tolist() == [*BIAS.gyro, *BIAS.accel]
    unsure = model.calibration_covariance()
    assert unsure is not None
    roots = unsure(np.array([0.0]), np.array([[1.0, 0.0, 0.0]]) + BIAS.gyro, np.array([[0.0, 0.0, 9.81]]))
    assert (roots["gyro"][0] @ roots["gyro"][0].T)[0, 0] == pytest.approx(0.01**2)


def test_what_cannot_be_taken_off_is_told(trajectory: Path, caplog: pytest.LogCaptureFixture) -> None:
    limit = entry("saturation", {"gyro_limit": 5.0})
    late = entry("clock_offset", {"tau": 2.0 * MAX_TAU_S})
    turned = entry("mount_rotation", {"phi_x": 0.1})
    sets_in = entry("accel_scale", {"x": 0.1, "t_step": 20.0})
    file = written(trajectory.with_name("some.toml"), limit, late, turned, entry("gyro_scale", {"x": 0.1}), sets_in)
    with caplog.at_level(logging.WARNING):
        model = find_model(file, RATE_HZ)
    assert isinstance(model, Model)
    assert model.card["not_taken"] == ["saturation", "clock_offset", "accel_scale"]
    assert "saturation, clock_offset, accel_scale" in caplog.text
    assert "body's axes" in caplog.text


def test_a_mount_that_slips_is_not_said_to_be_inverted(trajectory: Path, caplog: pytest.LogCaptureFixture) -> None:
    slips = entry("mount_rotation", {"phi_x": 0.1, "t_step": 20.0})
    with caplog.at_level(logging.WARNING):
        find_model(written(trajectory.with_name("slips.toml"), slips, entry("gyro_scale", {"x": 0.1})), RATE_HZ)
    assert "stay in the samples: mount_rotation" in caplog.text
    assert "body's axes" not in caplog.text


def test_nothing_to_take_off_is_refused(trajectory: Path) -> None:
    file = written(trajectory.with_name("none.toml"), entry("saturation", {"gyro_limit": 5.0}), bias=None)
    with pytest.raises(ModelError, match=r"no effect can be corrected \(saturation\)"):
        find_model(file, RATE_HZ)


def test_a_file_that_says_nothing_sensible_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        find_model(tmp_path / "nosuch.toml", RATE_HZ)
    (tmp_path / "odd.toml").write_text('[[effect]]\nname = "gyro_scal"\n[effect.parameters]\nx = {value = 0.1, unit = "-"}\n')
    with pytest.raises(ConfigError, match="gyro_scale"):
        find_model(tmp_path / "odd.toml", RATE_HZ)
    with pytest.raises(ModelError, match="has no rate; expected a trained model"):
        find_model(tmp_path / "odd.toml")


def test_a_log_is_debiased_by_the_physics_that_made_it(trajectory: Path, ideal: Recording, tmp_path: Path) -> None:
    """The whole way, with a bias to be followed, and noise."""
    file = written(tmp_path / "physics.toml", entry("gyro_scale", EFFECTS["gyro_scale"][0]), entry("lever_arm", {"y": 0.3}))
    raw = tmp_path / "raw.mcap"
    simulate(trajectory, raw, physics=file, noise="adis16448", rate_hz=RATE_HZ, seed=1)
    report = debias(raw, tmp_path / "clean.mcap", model=file)
    assert report.models == {"/imu0": "physics"}
    assert "bias of physics.toml" in report.starts["/imu0"].how
    clean, noisy = read(tmp_path / "clean.mcap", imu="/imu0/debiased"), read(raw)
    for sensor, share in (("gyro", 0.2), ("accel", 0.5)):  # next to white noise of 2.4e-3 rad/s and 0.03 m/s²
        before, after = (
            np.sqrt(np.mean((getattr(one.imu, sensor) - getattr(ideal.imu, sensor)) ** 2)) for one in (noisy, clean)
        )
        assert after < share * before
    before, after = evaluate(raw, models=[file])  # a physics.toml is for the rate of the log
    assert (after["model"], after["fit"]["verdict"]) == ("physics", "fits")
    assert after["aoe_deg"] < 0.1 * before["aoe_deg"]
