"""A gyro bias that follows the load of its motion is learned from poses; where there is none, none is found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.drifting import TEMPERATURE, Drifting, Kind, log

from imutool.bias import neural_ode
from imutool.bias.hybrid import Config
from imutool.bias.model import BiasModel
from imutool.cli.demo import made_up
from imutool.config import load
from imutool.evaluation import evaluate
from imutool.mcap_io.write import write
from imutool.recording import Scalars
from imutool.training.calibration.effect_selection import DRIFTS
from imutool.training.log_signals import loaded_signals
from imutool.training.run import train
from imutool.training.settings import TrainSettings, settings_of
from imutool.training.training_windows import Pool

TRAINING_S, TEST_S, LAG_S = (40.0, 40.0, 40.0), (60.0,), 10.0
ALONE = ("model.remainder=false", 'model.accel_effects=["accel_misalignment","accel_scale"]')  # no network, gyro chosen
FEW = ("steps=1", "samples=500", "gyro_window_s=[1.0]", "accel_window_s=[0.5]")
BETTER = 4.0  # tests/bench/drift.py has more kinds and logs: five to twelve there
BETTER_WARM = 1.5  # three logs hardly tell how long each of them was on; taken for cold, they show no warm-up at all


def saved(folder: Path, kind: Kind, first: int, durations_s: tuple[float, ...], on_s: tuple[float, ...] = ()) -> list[Path]:
    """Logs on disk, of sensors that were on for `on_s` before."""
    paths = [folder / f"{seed}.mcap" for seed in range(first, first + len(durations_s))]
    for k, (path, duration_s) in enumerate(zip(paths, durations_s, strict=True)):
        before_s = on_s[k] if on_s else 0.0
        whole = log(first + k, Drifting(kind=kind, rate_hz=50.0, lag_s=LAG_S), before_s + duration_s)
        write(whole.between(int(whole.imu.t_ns[0] + 1e9 * before_s), int(whole.imu.t_ns[-1])), path)
    return paths


def trained(folder: Path, logs: list[Path], method: str, *words: str) -> BiasModel:
    settings = load(settings_of(method), None, ["compare=false", *words])
    return train(logs, folder / f"{method}.safetensors", method=method, settings=settings)


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], Path]:
    """Logs of a bias that follows the load: to train on, and to test."""
    folder = tmp_path_factory.mktemp("loaded")
    return saved(folder, "rate", 0, TRAINING_S), saved(folder, "rate", 50, TEST_S)[0]


def test_hybrid_learns_a_drift_that_follows_the_load(tmp_path: Path, loaded: tuple[list[Path], Path]) -> None:
    logs, test = loaded
    trained(tmp_path, logs, "linear")
    model = trained(tmp_path, logs, "hybrid", *ALONE)
    assert isinstance(model.config, Config)
    assert "gyro_rate_load" in (model.config.gyro_effects or ())
    models = ["static", *(str(tmp_path / f"{method}.safetensors") for method in ("linear", "hybrid"))]
    for init in ("truth", "auto"):
        _, static, linear, hybrid = (result["aoe_deg"] for result in evaluate(test, models=models, init=init))
        assert BETTER * hybrid < min(static, linear), init


def test_no_drift_is_found_where_there_is_none(tmp_path: Path) -> None:
    model = trained(tmp_path, saved(tmp_path, "none", 0, TRAINING_S), "hybrid", *ALONE)
    assert isinstance(model.config, Config)
    assert not {*DRIFTS, "gyro_bias_drift"} & {*(model.config.gyro_effects or ())}


def test_training_logs_tell_how_long_their_sensor_was_on(tmp_path: Path) -> None:
    """What is learned from logs that begin warm, each by another time, holds for a cold sensor."""
    logs = saved(tmp_path, "warm_up", 0, TRAINING_S, on_s=(0.0, 10.0, 70.0))
    trained(tmp_path, logs, "linear")
    model = trained(tmp_path, logs, "hybrid", *ALONE)
    assert isinstance(model.config, Config)
    assert "gyro_warm_up" in (model.config.gyro_effects or ())
    (test,) = saved(tmp_path, "warm_up", 50, TEST_S)
    models = ["static", *(str(tmp_path / f"{method}.safetensors") for method in ("linear", "hybrid"))]
    for init in ("truth", "auto"):
        _, static, linear, hybrid = (result["aoe_deg"] for result in evaluate(test, models=models, init=init))
        assert BETTER_WARM * hybrid < min(static, linear), init


def test_logs_that_all_drift_alike_are_taken_for_cold() -> None:
    """A drift that is past in every log cannot be told from none, though noise may make it a little likelier."""
    recordings = [made_up(seed) for seed in (1, 2, 3, 4)]
    _, loads = loaded_signals(recordings, Pool.of(recordings), None, None, TrainSettings().sensors)
    assert loads == [None] * 4


def test_the_neural_ode_has_the_states_of_the_load(tmp_path: Path, loaded: tuple[list[Path], Path]) -> None:
    """One step of descent: what counts is that the drift is found, kept in the file, and taken off the samples."""
    logs, test = loaded
    model = trained(tmp_path, logs, "neural_ode", *FEW)
    assert isinstance(model.config, neural_ode.Config)
    assert "gyro_rate_load" in (model.config.loads or ())
    models = ["static", str(tmp_path / "neural_ode.safetensors")]
    _, static, ode = (result["aoe_deg"] for result in evaluate(test, models=models, init="truth"))
    assert BETTER * ode < static


def test_a_bias_follows_the_temperature_of_its_log(tmp_path: Path, one_start: None) -> None:
    """Logs that are left out decide that the drift stays, and the files of both methods have it."""
    logs = saved(tmp_path, "ambient", 0, (55.0,) * 4)  # its steps are rarer than changes of the load
    hybrid = trained(tmp_path, logs, "hybrid", *ALONE, "compare=true")
    ode = trained(tmp_path, logs, "neural_ode", *FEW)
    assert isinstance(hybrid.config, Config)
    assert isinstance(ode.config, neural_ode.Config)
    assert "gyro_temperature" in (hybrid.config.gyro_effects or ())
    assert "gyro_temperature" in (ode.config.loads or ())
    assert hybrid.config.temperature == ode.config.temperature == TEMPERATURE
    scores = hybrid.card["left_out"]["scores"]
    effects, linear = (np.mean([s["aoe_deg"] for s in scores if s["model"] == name]) for name in ("effects", "linear"))
    assert effects < 0.5 * linear
    (test,) = saved(tmp_path, "ambient", 50, TEST_S)
    models = ["static", *(str(tmp_path / f"{method}.safetensors") for method in ("hybrid", "neural_ode"))]
    _, static, *learnt = (result["aoe_deg"] for result in evaluate(test, models=models, init="truth"))
    assert BETTER * max(learnt) < static


def test_a_temperature_that_explains_a_warm_up_takes_the_place_of_the_time(tmp_path: Path) -> None:
    """Logs that all warm up alike do not tell a drift of the time, or of the motion, from one of the temperature."""
    recordings = [log(seed, Drifting(kind="warm_up", rate_hz=50.0, lag_s=LAG_S), 40.0) for seed in range(3)]
    paths = [tmp_path / f"{recording.name}.mcap" for recording in recordings]
    for path, recording in zip(paths, recordings, strict=True):
        t_ns = recording.imu.t_ns[::50]
        warm = 37.0 - 12.0 * np.exp(-1e-9 * (t_ns - t_ns[0]) / LAG_S)
        write(replace(recording, scalars={TEMPERATURE: Scalars(t_ns, warm[:, None], "degC")}), path)
    model = trained(tmp_path, paths, "hybrid", *ALONE)
    assert isinstance(model.config, Config)
    assert {"gyro_temperature"} == {*DRIFTS} & {*(model.config.gyro_effects or ())}
