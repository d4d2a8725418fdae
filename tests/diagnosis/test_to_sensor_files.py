"""The noise of a diagnosis is what its findings leave: its density, and the colour by which a simulation draws it again."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from support import diagnoses
from support.diagnoses import replace as replace_struct

from imutool.bias.physics import load
from imutool.diagnosis.estimation.trial.effect_forms import in_forms
from imutool.diagnosis.result import Estimate, Traces
from imutool.diagnosis.to_sensor_files import start_values, to_noise_file, to_physics_file
from imutool.sensor import catalogue, physics_file
from imutool.sensor.effects import gyro_scale

RATE_HZ, SECONDS = 200.0, 60


def test_the_noise_has_the_size_of_what_is_left_and_its_colour() -> None:
    rng, n = np.random.default_rng(0), int(RATE_HZ * SECONDS)
    slow = lfilter([0.3], [1.0, -0.95], rng.normal(size=(n, 6)), axis=0)
    left, after = 0.02 * slow, rng.normal(size=(n, 6))
    trace = Traces("made", np.arange(n) / RATE_HZ, after + left, after, after, np.zeros(n, bool))
    noise = to_noise_file(replace(diagnoses.NOTHING, traces=(trace,)))
    assert noise is not None
    assert noise.colour is not None
    np.testing.assert_allclose(noise.values("gyro_density") * np.sqrt(RATE_HZ), left.std(axis=0)[:3], rtol=1e-6)
    assert noise.colour.mean[0][0] > noise.colour.mean[0][-1] + 2.0


def test_a_search_begins_with_the_first_values_of_what_was_found_and_nothing_for_what_was_not_seen() -> None:
    arm, delay = catalogue.diagnosed(["lever_arm", "gyro_delay"])
    again = replace_struct(diagnoses.LEVER_ARM, parameters={"x": Estimate(9.0, 1.0, "m")})
    some = replace_struct(diagnoses.LEVER_ARM, parameters={"x": Estimate(0.2, 0.01, "m"), "z": Estimate(0.1, 0.01, "m")})
    jitter = replace_struct(diagnoses.LEVER_ARM, effect="timestamp_jitter")
    ((effect, theta),) = start_values([some, jitter, again], [delay, arm])
    assert effect is arm
    assert theta.tolist() == [0.2, 0.0, 0.1]


def test_a_search_begins_with_the_low_pass_of_the_sensor_and_order_that_were_found() -> None:
    candidates = in_forms(catalogue.diagnosed(["low_pass"]), exact=True)
    average = {"f_c": Estimate(11.0, 0.1, "Hz"), "order": Estimate(0.0, 0.0, "-")}
    found = replace_struct(diagnoses.LEVER_ARM, effect="low_pass", signal="accel", parameters=average)
    first = replace_struct(found, signal="gyro", parameters={"f_c": Estimate(20.0, 0.1, "Hz")})
    chosen = start_values([found, first], candidates)
    assert [(effect.key, theta.tolist()) for effect, theta in chosen] == [
        ("low_pass:accel order 0", [11.0]),
        ("low_pass:gyro", [20.0]),
    ]


def test_a_search_begins_with_the_scale_that_sets_in_where_that_was_found() -> None:
    candidates = [*gyro_scale.in_both_forms(catalogue.diagnosed(["gyro_scale"]))]
    whole = replace_struct(diagnoses.LEVER_ARM, effect="gyro_scale", signal="gyro", parameters={"x": Estimate(0.1, 0.01, "-")})
    later = replace_struct(whole, parameters={"x": Estimate(0.2, 0.01, "-"), "t_step": Estimate(9.0, 0.1, "s")})
    chosen = [(effect.key, theta.tolist()) for effect, theta in start_values([later, whole], candidates)]
    assert chosen == [("gyro_scale:step", [0.2, 0.0, 0.0, 9.0]), ("gyro_scale", [0.1, 0.0, 0.0])]


def test_without_samples_there_is_no_noise() -> None:
    assert to_noise_file(replace(diagnoses.NOTHING, traces=())) is None


def test_physics_found_in_other_axes_says_so_where_debias_reads_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The effects are in the axes of the simulation; the recording's samples have another order."""
    order = replace_struct(diagnoses.LEVER_ARM, effect="permuted_axes", parameters={})
    file = to_physics_file(replace(diagnoses.NOTHING, findings=(order, diagnoses.LEVER_ARM)))
    assert [entry.name for entry in file.effect] == ["lever_arm"]
    physics_file.write(file, tmp_path / "physics.toml")
    assert physics_file.read(tmp_path / "physics.toml").conventions == ("permuted_axes",)
    with caplog.at_level(logging.WARNING):
        load(tmp_path / "physics.toml", RATE_HZ)
    assert "permuted_axes" in caplog.text
