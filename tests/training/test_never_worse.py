"""A trained model is not worse than the simple thing on logs of other switchings-on; what is learned has evidence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.switchings_on import Switchings, log

from imutool.bias.model import BiasModel
from imutool.config import load
from imutool.errors import DataError
from imutool.evaluation import evaluate
from imutool.mcap_io.write import write
from imutool.recording import Recording
from imutool.sensor.made_up_flight import flight
from imutool.training.calibration.effect_selection import calibrate
from imutool.training.left_out import Score, beaten, better_without, keep, network_scores
from imutool.training.log_agreement import Contradiction, check_axes, contradicting
from imutool.training.run import train
from imutool.training.settings import LINEAR, full_name, settings_of
from imutool.training.training_windows import Pool

KIND = Switchings(sensor_seed=0, rest_s=10.0, duration_s=30.0, rate_hz=50.0)
TRAINING, TESTS = 4, 4  # tests/bench/never_worse.py has many sensors, six and eight logs of each


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of one switching-on, and the default method without its neural ODE."""
    folder = tmp_path_factory.mktemp("one_switching_on")
    logs = [folder / f"{seed}.mcap" for seed in range(TRAINING)]
    for seed, path in enumerate(logs):
        write(log(seed, 0, KIND), path)
    train(logs, folder / "model.safetensors", settings=load(settings_of("hybrid"), None, ["model.remainder=false"]))
    return folder / "model.safetensors"


@pytest.fixture(scope="module")
def tests(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Logs of other switchings-on, each of its own."""
    folder = tmp_path_factory.mktemp("other_switchings_on")
    paths = [folder / f"{seed}.mcap" for seed in range(50, 50 + TESTS)]
    for seed, path in enumerate(paths, start=50):
        write(log(seed, seed, KIND), path)
    return paths


@pytest.mark.parametrize(("init", "smooth"), [("auto", False), ("stationary", False), ("auto", True)])
def test_a_model_of_one_switching_on_is_better_than_static_on_others(
    model: Path, tests: list[Path], init: str, smooth: bool
) -> None:
    results = [evaluate(path, models=["static", str(model)], init=init, smooth=smooth) for path in tests]
    raw, static, trained = np.mean([[result["aoe_deg"] for result in log] for log in results], axis=0)
    assert trained <= static
    assert trained < 0.1 * raw


def scores(**models: list[float]) -> list[Score]:
    """One start, one error a log."""
    table = [(str(log), model, error) for model, errors in models.items() for log, error in enumerate(errors)]
    return [Score(log, model, "auto", error, error) for log, model, error in table]


def test_the_simplest_candidate_that_is_not_beaten_is_kept() -> None:
    constant = [1.0, 2.0, 1.5, 1.2]
    better = [0.5 * error for error in constant]
    assert keep(scores(constant=constant, linear=better, effects=better), "gyro") == "linear"
    assert keep(scores(constant=constant, linear=constant, effects=better), "gyro") == "effects"
    assert keep(scores(constant=constant, linear=[0.5, 4.0, 0.7, 2.5]), "gyro") == "constant", "the logs do not agree"
    assert keep(scores(constant=constant, linear=better, static=[0.3] * 4), "gyro") == "constant", "static beats both"
    assert keep(scores(constant=constant, linear=better, static=[0.3] * 4), "accel") == "linear"


def test_logs_that_are_better_without_the_model_are_told() -> None:
    model, worse = [1.0, 2.0, 1.5, 1.2], [1.2, 2.1, 1.9, 1.2]
    half = [0.5 * error for error in model]
    assert not [*better_without(scores(raw=worse, static=worse, constant=model), "constant")]
    (told,) = better_without(scores(raw=half, static=worse, constant=model, linear=half), "constant")
    assert told.startswith("on the left-out logs the raw samples have 50 % less error of orientation than the model: ")
    (told,) = better_without(scores(raw=worse, static=half, constant=model), "constant")
    assert "bias at rest" in told


def test_a_candidate_that_is_worse_from_one_start_is_not_kept() -> None:
    constant, better = [1.0, 2.0, 1.5, 1.2], [0.2, 0.4, 0.3, 0.24]
    from_auto = scores(constant=constant, linear=better)
    smooth = [replace(score, start="smooth") for score in scores(constant=constant, linear=[1.2 * x for x in constant])]
    assert keep(from_auto, "gyro") == "linear"
    assert keep(from_auto + smooth, "gyro") == "constant"
    static = [replace(score, start="smooth") for score in scores(static=[0.1] * 4, linear=better)]
    assert keep(from_auto + static, "gyro") == "constant", "static is better with smooth"


def test_static_that_has_the_truth_alone_is_compared_from_the_truth() -> None:
    """Logs in motion: `static` starts from the truth alone, where the errors of every model are smaller."""
    auto = scores(constant=[9.0, 8.0, 7.0], linear=[2.0, 3.0, 2.5])
    truth = [replace(score, start="truth") for score in scores(static=[0.9, 0.8, 0.7], constant=[2.0] * 3, linear=[0.7] * 3)]
    assert keep(auto + truth, "gyro") == "linear"
    assert not [*better_without(auto + truth, "linear")]


def test_a_drift_counts_where_errors_of_a_whole_log_cancel() -> None:
    """Three logs: a constant is better on one of them by the AOE, and worse on all of them after 5 s."""
    aoe = {"constant": [0.8, 2.3, 2.6], "effects": [0.9, 2.3, 0.85]}
    drift = {"constant": [1.0, 1.3, 1.8], "effects": [0.4, 0.4, 0.5]}
    drifting = [Score(str(log), model, "truth", aoe[model][log], None, drift[model][log]) for model in aoe for log in range(3)]
    assert keep([replace(score, drift_deg=None) for score in drifting], "gyro") == "constant"
    assert keep(drifting, "gyro") == "effects"
    drift["effects"] = [1.2, 1.6, 2.1]
    worse = [replace(score, drift_deg=drift[score.model][int(score.log)], aoe_deg=0.5) for score in drifting]
    assert keep(worse, "gyro") == "constant", "a simpler one drifts less"


def test_a_gain_counts_beyond_its_scatter_from_log_to_log() -> None:
    errors = np.log([1.0, 1.0, 1.0])
    assert beaten(errors, errors - 0.1)
    assert not beaten(errors, errors - 0.01), "too little"
    assert not beaten(errors, errors - np.array([0.5, -0.4, 0.1])), "no agreement"
    assert not beaten(errors, np.full(3, np.nan))
    scattered = errors - np.array([0.3, 0.0, 0.2])
    assert beaten(errors, scattered)
    assert not beaten(errors, scattered, surely=2.0)
    worse_on_one = [0.8, 2.3, 1.1, 1.1]
    assert keep(scores(constant=[1.0, 2.0, 1.5, 1.2], linear=worse_on_one), "gyro") == "constant", (
        "by little more than its standard error"
    )


def test_what_only_fast_motion_shows_is_believed_where_nothing_else_is_lost() -> None:
    shown_by_two = np.array([0.06, -0.01, 0.02, -0.05, 1.18, 1.10])
    with_losses = np.array([0.30, 0.82, -0.39, 0.06, 0.08, -0.23])
    assert beaten(shown_by_two, np.zeros(6), surely=2.0)
    assert not beaten(with_losses, np.zeros(6), surely=2.0), "what it gains it may lose on the next log"
    assert not beaten(np.full(3, 0.2), np.array([0.0, 0.0, 0.3]), surely=2.0), "three logs, and no large gain"


def test_a_start_from_the_truth_is_scored_on_seconds_that_it_did_not_see(tmp_path: Path) -> None:
    """Over logs of eight seconds, all of them fitted, a constant of each log was better than any matrix."""
    logs = [tmp_path / f"{seed}.mcap" for seed in range(8)]
    for seed, path in enumerate(logs):
        write(flight(seed, duration_s=8.0, still_s=1.0, rate_hz=100.0), path)
    card = train(logs, tmp_path / "model.safetensors", method="linear").card
    assert card["left_out"]["kept"]["gyro"] == "linear"


def contradictions(recordings: list[Recording]) -> list[Contradiction]:
    pool = Pool.of(recordings)
    return list(contradicting(pool, {"gyro": calibrate(pool, "gyro", pool.gyro, LINEAR["gyro"])}))


def test_a_log_of_another_unit_is_named_among_logs_of_one() -> None:
    """Its mount and clock differ no more than those of the others."""
    kind = msgspec.structs.replace(KIND, scale=0.03, duration_s=45.0)
    one_unit = [log(seed, 0, kind) for seed in range(4)]
    assert not contradictions(one_unit)
    stranger = log(4, 0, msgspec.structs.replace(kind, sensor_seed=2))
    (found,) = contradictions([*one_unit, stranger])
    assert (found.log, found.sensor) == (stranger.name, "gyro")
    assert found.own < 0.2
    assert found.others > 1.0
    assert stranger.name in str(found)


def test_logs_that_need_no_matrix_contradict_nothing() -> None:
    """Each log's own matrix fits its noise."""
    kind = msgspec.structs.replace(KIND, scale=0.001, misalignment_rad=0.0005, rest_s=4.0, duration_s=45.0)
    for first in range(0, 20, 4):
        assert not contradictions([log(seed, 0, kind) for seed in range(first, first + 4)])


@pytest.mark.parametrize(
    ("axes", "more"),
    [(np.diag([1.0, -1.0, -1.0]), 0.0), (np.eye(3), 0.0), (np.eye(3), 0.1)],
    ids=["turned", "as the others", "another unit"],
)
def test_a_log_in_turned_axes_is_refused_though_its_scale_agrees(
    axes: np.ndarray, more: float, caplog: pytest.LogCaptureFixture
) -> None:
    """As of a driver in FRD among logs in FLU: poses and gravity agree with each, and a scale is the same in both.

    A bias that no switching-on changes so much is named.
    """
    bias = np.array([0.03, 0.02, -0.03, 0.6, -0.7, 0.6])
    logs = []
    for seed in range(3):
        one, P = log(seed, 0, KIND), axes if seed == 1 else np.eye(3)
        imu = replace(one.imu, gyro=(one.imu.gyro + bias[:3] + more * (seed == 1)) @ P, accel=(one.imu.accel + bias[3:]) @ P)
        q_wb = Rotation.from_quat(one.truth.q_wb_wxyz, scalar_first=True) * Rotation.from_matrix(P)
        poses = replace(one.truth, q_wb_wxyz=q_wb.as_quat(scalar_first=True))
        logs.append(replace(one, name=f"log {seed}", imu=imu, truths={"/ground_truth/pose": poses}))
    pool = Pool.of(logs)
    gyro = calibrate(pool, "gyro", pool.gyro, LINEAR["gyro"])
    fits = {"gyro": gyro, "accel": calibrate(pool, "accel", pool.gyro - gyro.own[pool.log, :3], LINEAR["accel"])}
    if axes[1, 1] > 0.0:
        check_axes(pool, fits)
        assert [message[:5] for message in caplog.messages if "another unit?" in message] == ["log 1"] * (more > 0.0)
        return
    with pytest.raises(DataError, match=r"^log 1: its bias is .* \+x -y -z: the axes are turned"):
        check_axes(pool, fits)


def test_parts_of_a_log_contradict_nothing() -> None:
    """They are one unit, and two logs do not tell which of them is the stranger."""
    assert not contradictions([log(seed, 0, msgspec.structs.replace(KIND, sensor_seed=seed)) for seed in range(2)])


def test_a_network_does_not_learn_what_belongs_to_the_poses_of_each_log(tmp_path: Path) -> None:
    """A sensor without any error but its bias: mount, clock and lever arm of the poses are no reason for a neural ODE."""
    none = {"scale": 0.0, "misalignment_rad": 0.0, "walk_rad_s2_rthz": 0.0, "noise_rad_s_rthz": 1e-5, "truth_noise": 1e-4}
    kind = Switchings(sensor_seed=0, rest_s=5.0, duration_s=30.0, mount_rad=np.radians(0.3), **none)
    paths = [tmp_path / f"{seed}.mcap" for seed in range(4)]
    for seed, path in enumerate(paths):
        write(with_lever_arm(log(seed, seed, kind), np.array([0.03, -0.02, 0.05])), path)
    quick = [
        "steps=30",
        "samples=2000",
        "model.ode.curve_width=8",
        "model.gyro_effects=[]",
        "model.accel_effects=[]",
        "compare=false",
    ]
    model = train(paths[:3], tmp_path / "m.safetensors", settings=load(settings_of("hybrid"), None, quick))
    assert not model.config.remainder, model.card["compared"]
    _, static, trained = (r["aoe_deg"] for r in evaluate(paths[3], models=["static", str(tmp_path / "m.safetensors")]))
    assert trained < 1.1 * static


@pytest.mark.parametrize(("factor", "kept"), [(0.3, "conv"), (3.0, "constant")])
def test_a_network_stays_if_left_out_logs_confirm_it(
    tmp_path: Path, one_start: None, monkeypatch: pytest.MonkeyPatch, factor: float, kept: str
) -> None:
    """A sensor without any error but its bias; the scores of the network on other logs are made up."""
    kind = msgspec.structs.replace(KIND, rest_s=5.0, scale=0.0, misalignment_rad=0.0)
    paths = [tmp_path / f"{seed}.mcap" for seed in range(4)]
    for seed, path in enumerate(paths):
        write(log(seed, 0, kind), path)
    halves = list[list[int]]()

    def scored(
        name: str, trained_on: Callable[[Sequence[int]], BiasModel], recordings: Sequence[Recording], *rest: Any
    ) -> list[Score]:
        def counted(half: Sequence[int]) -> BiasModel:
            halves.append([*half])
            return trained_on(half)

        found = network_scores(name, counted, recordings, *rest)
        assert [score.log for score in found] == [recordings[index].name for index in (0, 2, 1, 3)]
        return [
            replace(score, aoe_deg=factor * index, drift_m_s=factor, drift_deg=factor) for index, score in enumerate(found, 1)
        ]

    monkeypatch.setattr("imutool.training.run.network_scores", scored)
    tiny = ["steps=20", "samples=400", "validate_every=20", "channels=[4,8]", "dilations=[1,4]"]
    words = [full_name("conv", word) for word in tiny]
    model = train(paths, tmp_path / "m.safetensors", method="conv", settings=load(settings_of("conv"), None, words))
    assert halves == [[1, 3], [0, 2]]
    assert model.card["left_out"]["kept"]["gyro"] == kept
    learned = np.abs(model.tensors["net.gyro.out"]).max()
    assert (learned > 0.0) == (kept == "conv")


def with_lever_arm(recording: Recording, arm_m: np.ndarray) -> Recording:
    """Recording whose poses are those of a point of the body."""
    truth = recording.truth
    p_wb = truth.p_wb + Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True).apply(arm_m)
    return replace(recording, truths={name: replace(truth, p_wb=p_wb, v_w=None) for name in recording.truths})
