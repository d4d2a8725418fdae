"""A log tells whether its sensor was warm; a steady turn is no stop."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from support.drifting import Drifting, log

import imutool
from imutool.bias import hybrid
from imutool.bias.model_file import save
from imutool.bias_start.bias_tracking import BiasFilter
from imutool.bias_start.earlier_load import switched_on_before, with_earlier_load
from imutool.bias_start.initial_bias import model_samples
from imutool.bias_start.model_choice import bound_to
from imutool.bias_start.prior_width import BiasPrior
from imutool.debiasing import DebiasedBlock
from imutool.errors import ConfigError
from imutool.mcap_io.log import Log
from imutool.recording import Recording
from imutool.sensor.signals import LOAD_TAU_S, ON
from imutool.viewing.stream.samples import Malformed, Sample
from imutool.viewing.stream.session import run

RATE_HZ, LAG_S = 50.0, 20.0
SENSOR = Drifting(kind="warm_up", lag_s=LAG_S, rate_hz=RATE_HZ, scale=0.0)
TRUTH = "/ground_truth/pose"


def warming() -> hybrid.Model:
    """The made-up sensor as a training would describe it: a bias that decays by its size with a lag of 20 s."""
    made = np.random.default_rng([SENSOR.sensor_seed, 2])
    size = SENSOR.size_rad_s * made.uniform(0.6, 1.6, size=3) * made.choice([-1.0, 1.0], size=3)
    config = hybrid.Config(gyro_effects=("gyro_warm_up",), accel_effects=(), remainder=False)
    K = np.outer(-size, LOAD_TAU_S == LAG_S)
    model = hybrid.Model(
        config,
        RATE_HZ,
        {
            "prior_mean": np.concatenate([size, np.zeros(3)]),
            "prior_std": np.repeat([SENSOR.turn_on_rad_s, SENSOR.turn_on_m_s2], 3),
            "walk_std": np.repeat([1e-5, 1e-4], 3),
            "theta_gyro": K.ravel(),
        },
    )
    model.card = {"name": "warming", "logs": ["cold"]}
    return model


def after(on_s: float, seed: int, length_s: float = 60.0) -> Recording:
    """What a log holds from some time after its sensor was switched on."""
    whole = log(seed, SENSOR, on_s + length_s)
    return whole.between(int(whole.imu.t_ns[0] + 1e9 * on_s), int(whole.imu.t_ns[-1]))


@pytest.mark.parametrize("seed", [50, 52])
def test_a_log_tells_how_long_its_sensor_was_on(seed: int) -> None:
    model = warming()
    assert bound_to(model, after(0.0, seed)) is model
    for on_s in (40.0, 400.0):
        found = bound_to(model, after(on_s, seed)).load_before
        assert found is not None
        assert found[LOAD_TAU_S == LAG_S, ON] == pytest.approx(-math.expm1(-on_s / LAG_S), abs=0.2)  # a few times are tried


def test_the_rest_of_a_log_is_corrected_as_well_as_its_beginning(tmp_path: Path) -> None:
    """The commands and Python agree; a warm sensor that is taken for cold gets a drift that is not there."""
    model = warming()
    save(model, tmp_path / "warming.safetensors")
    imutool.write(tmp_path / "late.mcap", recording := after(60.0, 50))
    for options in ({"init": "truth"}, {"init": "auto"}, {"smooth": True}):
        _, found = imutool.evaluate(tmp_path / "late.mcap", models=[tmp_path / "warming.safetensors"], **options)
        assert found["aoe_deg"] < 8.0, options
    warm, cold = (imutool.debias(recording, m, init="truth").bias[:, :3] for m in (model, switched_on_before(model, 0.0)))
    drift = np.abs(model.tensors["theta_gyro"]).max()
    assert np.ptp(cold, axis=0).max() > 0.8 * drift
    assert np.ptp(warm, axis=0).max() < 0.3 * drift

    imutool.debias(tmp_path / "late.mcap", tmp_path / "clean.mcap", model=tmp_path / "warming.safetensors")
    with Log(tmp_path / "clean.mcap") as clean:
        record = clean.metadata()["imutool"]
    assert record["causal"] == "false"
    in_python = imutool.debias(recording, tmp_path / "warming.safetensors")
    assert "was in use before" in " ".join(in_python.fitness.reasons)
    assert json.loads(record["rest"]) == pytest.approx(in_python.start.rest.tolist(), abs=1e-6)


def test_a_live_node_says_since_when_the_sensor_is_on(tmp_path: Path) -> None:
    save(warming(), tmp_path / "warming.safetensors")
    model = imutool.load_model(tmp_path / "warming.safetensors", on_s=600.0)
    bias = model.stream(np.zeros(6))(*model_samples(model, after(600.0, 50, 60.0).imu))
    assert np.abs(bias).max() < 1e-6 + np.abs(model.tensors["theta_gyro"]).max() * (1 + 1e-6)
    assert np.ptp(bias, axis=0).max() < 1e-9  # it has long been warm
    cold = imutool.load_model(tmp_path / "warming.safetensors", on_s=0.0)
    assert bound_to(cold, after(600.0, 50, 60.0)) is cold  # what is given is not asked again
    for wrong in (-1.0, math.nan, math.inf):
        with pytest.raises(ConfigError, match="on_s"):
            imutool.load_model(tmp_path / "warming.safetensors", on_s=wrong)


def test_the_first_two_seconds_of_a_live_stream_tell() -> None:
    """At rest; the same sensor without a warm-up is one that is warm."""
    model, size = warming(), np.abs(warming().tensors["theta_gyro"]).max()
    for kind, minimum, maximum in (("warm_up", 0.4, 0.7), ("none", 0.0, 0.1)):
        imu = log(50, replace(SENSOR, kind=kind), 20.0).imu
        blocks: list[DebiasedBlock] = []
        rows = zip(imu.t_ns.tolist(), imu.gyro.tolist(), imu.accel.tolist(), strict=True)
        stream = (Sample(t_ns, tuple(gyro), tuple(accel), 0.0) for t_ns, gyro, accel in rows)
        run(stream, model, Malformed(), show=blocks.append)
        moved = np.ptp(np.concatenate([block.bias[:, :3] for block in blocks]), axis=0).max() / size
        assert minimum < moved < maximum, kind


def test_a_model_without_drift_and_a_log_without_samples_are_left_alone() -> None:
    plain = hybrid.Model(hybrid.Config(gyro_effects=("gyro_scale",), accel_effects=(), remainder=False), RATE_HZ)
    assert with_earlier_load(plain, [model_samples(plain, after(60.0, 50, 5.0).imu)]) is plain
    assert switched_on_before(plain, 60.0) is plain
    few = model_samples(plain, after(60.0, 50, 1.0).imu)
    for count in (0, 1, 2, 20):
        assert with_earlier_load(warming(), [tuple(column[:count] for column in few)]).load_before is None


def test_a_steady_turn_is_no_stop() -> None:
    """It looks like one, but no bias of the sensor is that large."""
    rng, n = np.random.default_rng(0), int(10 * RATE_HZ)
    t_s, still = np.arange(n) / RATE_HZ, np.array([0.0, 0.0, 9.81])
    large = np.array([0.0, 0.0, 0.09, 0.0, 0.0, 0.0])  # another sensor's stop reads nothing
    for mean, turn_rad_s, rests in ((0.0, 0.03, True), (0.0, 0.17, False), (1.0, 0.0, True), (1.0, -0.1, False)):
        prior = BiasPrior(mean * large, np.repeat([3e-3, 0.05], 3), np.repeat([1e-4, 0.03], 3))
        gyro = np.array([0.0, 0.0, turn_rad_s]) + 1e-3 * rng.normal(size=(n, 3))
        filter_ = BiasFilter(prior, ahead=True)
        blocks = [*filter_.feed(t_s, gyro, still + 0.01 * rng.normal(size=(n, 3))), *filter_.finish()]
        assert {block.resting for block in blocks} == {rests}


def test_a_log_that_says_nothing_is_taken_for_cold() -> None:
    """A drift so small that its samples do not show it."""
    model = warming()
    model.tensors["theta_gyro"] *= 1e-3
    assert bound_to(model, after(400.0, 50, 20.0)) is model
