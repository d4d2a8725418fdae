"""From a log to figures: keyframes, gaps, the alignment at the first pose, the JSON, the table and the command."""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.cli import evaluate as scores
from imutool.config import plain
from imutool.errors import DataError, LogError
from imutool.inertial import metrics
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.recording import Imu, Poses, Recording
from imutool.vio.run import SCHEMA, VioSettings, from_first_pose, plan, tabulate, vio

SHORT = VioSettings(duration_s=7.0)


@pytest.fixture(scope="module")
def results(logs: Path) -> list[dict[str, Any]]:
    """Flight 2, which the model of `logs` has not seen: three seconds at rest, four in motion."""
    return vio(logs / "flight_2.mcap", models=[logs / "linear.safetensors"], settings=SHORT)


def test_keyframes_are_samples_on_an_even_clock(perfect: Recording) -> None:
    course = plan(perfect, VioSettings(keyframes_hz=5.0))
    t_ns = perfect.imu.t_ns[course.rows][course.keyframes]
    assert np.abs(np.diff(t_ns) * 1e-9 - 0.2).max() <= perfect.imu.period_s
    assert len(t_ns) == len(course.frames) == len(course.true) == 51
    np.testing.assert_array_equal(t_ns, course.true.t_ns)


def test_a_gap_of_the_truth_is_dark_and_not_scored(perfect: Recording) -> None:
    t_s = (perfect.truth.t_ns - perfect.truth.t_ns[0]) * 1e-9
    holed = replace(perfect, truths={"/t": perfect.truth.rows((t_s < 5.0) | (t_s > 8.0))})
    course = plan(holed, VioSettings())
    dark = np.array([not len(frame.tracks) for frame in course.frames])
    np.testing.assert_array_equal(dark, ~course.valid)
    assert dark.sum() == pytest.approx(3.0 * 4, abs=1)


def test_too_little_truth_is_said(perfect: Recording) -> None:
    with pytest.raises(DataError, match="two keyframes at 4 Hz"):
        plan(perfect, VioSettings(duration_s=0.2))


def test_orientations_alone_show_no_camera(perfect: Recording) -> None:
    truth = perfect.truth
    turns = Poses(truth.t_ns, np.zeros_like(truth.p_wb), truth.q_wb_wxyz)
    with pytest.raises(DataError, match="have no positions"):
        plan(replace(perfect, truths={"/pose": turns}), VioSettings())


def test_poses_that_contradict_the_imu_give_no_figures(logs: Path, tmp_path: Path) -> None:
    """Of poses whose z is down it said 4.24 m raw and 4.26 m with a model, without a word."""
    made = read(sorted(logs.glob("*.mcap"))[0])
    truth, turn = made.truth, Rotation.from_rotvec([np.pi, 0.0, 0.0])
    q = (turn * Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True)).as_quat(scalar_first=True)
    down = Poses(truth.t_ns, turn.apply(np.array(truth.p_wb)), q)
    write(replace(made, truths={"/ground_truth/pose": down}), tmp_path / "down.mcap")
    with pytest.raises(DataError, match="has -z up"):
        vio(tmp_path / "down.mcap", settings=SHORT)


def test_heading_and_position_of_the_start_are_taken_out_and_tilt_is_not(perfect: Recording) -> None:
    truth = perfect.truth
    valid = np.ones(len(truth), bool)
    turn = Rotation.from_euler("z", 40.0, degrees=True)

    def moved(by: Rotation) -> Poses:
        q = (by * Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True)).as_quat(scalar_first=True)
        assert truth.v_w is not None
        R = by.as_matrix()
        return Poses(truth.t_ns, truth.p_wb @ R.T + [1.0, -2.0, 3.0], q, truth.v_w @ R.T)

    figures = metrics.absolute(from_first_pose(moved(turn), truth), truth, valid)
    assert max(figures[name] or 0.0 for name in ("aoe_deg", "ape_m", "velocity_rmse_m_s")) < 1e-6
    tilted = metrics.absolute(from_first_pose(moved(Rotation.from_euler("x", 2.0, degrees=True)), truth), truth, valid)
    assert tilted["aoe_deg"] == pytest.approx(2.0, abs=1e-6)


def test_there_is_a_result_for_each_model_with_and_without_bias_states(results: list[dict[str, Any]], logs: Path) -> None:
    kinds = [(one["model"], one["bias_states"]) for one in results]
    assert kinds == [("raw", True), ("raw", False), ("linear", True), ("linear", False)]
    for one in json.loads(json.dumps(results, allow_nan=False)):
        assert one["log"] == "flight_2"
        assert one["failed"] is None
        assert one["settings"] == plain(SHORT)
        assert one["samples"] == 29
        assert one["tracks"] == 30.0
        assert "EuRoC" in one["camera"]
        assert set(one["roe_deg"]) == set(one["rpe_m"]) == {"5", "10", "15", "20"}
        assert one["aoe_deg"] > 0.0
    assert results[0]["init"] is None
    assert results[2]["init"] == "auto"


def test_without_bias_states_a_debiased_imu_is_worth_much(results: list[dict[str, Any]]) -> None:
    raw_on, raw_off, linear_on, linear_off = results
    assert linear_off["aoe_deg"] < raw_off["aoe_deg"] / 3
    assert raw_on["aoe_deg"] < raw_off["aoe_deg"] / 3
    assert linear_on["gyro_bias_end"] != [0.0, 0.0, 0.0]
    assert linear_off["gyro_bias_end"] == [0.0, 0.0, 0.0]
    assert np.linalg.norm(linear_on["gyro_bias_end"]) < np.linalg.norm(raw_on["gyro_bias_end"]) / 5


def test_the_same_seed_gives_the_same_figures_and_another_seed_others(results: list[dict[str, Any]], logs: Path) -> None:
    def figures(seed: int) -> dict[str, Any]:
        settings = VioSettings(duration_s=7.0, seed=seed)
        (one,) = vio(logs / "flight_2.mcap", bias_states=(True,), settings=settings)
        return {name: one[name] for name in ("aoe_deg", "ape_m", "rpe_m", "gyro_bias_end")}

    assert figures(0) == {name: results[0][name] for name in figures(0)}
    assert figures(1)["aoe_deg"] != results[0]["aoe_deg"]


def test_samples_that_are_no_measurement_or_debiased_already_are_named(
    perfect: Recording, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """One reading of 1e30 m/s² ended every run."""
    accel = perfect.imu.accel.copy()
    accel[200] = 1e30
    derived = {"imutool": {"debiased_by": "static"}}
    write(replace(perfect, imu=Imu(perfect.imu.t_ns, perfect.imu.gyro, accel), metadata=derived), tmp_path / "log.mcap")
    (raw,) = vio(tmp_path / "log.mcap", bias_states=(True,), settings=VioSettings(duration_s=2.0))
    assert raw["failed"] is None
    assert "left out: 1 beyond any sensor" in caplog.text
    assert "debiased already, by static" in caplog.text


def test_a_run_that_fails_does_not_stop_the_others(perfect: Recording, tmp_path: Path) -> None:
    """What no estimate survives is in the raw samples; six numbers given as the start take it off."""
    off = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 500.0])
    thrown = replace(perfect, imu=Imu(perfect.imu.t_ns, perfect.imu.gyro, perfect.imu.accel + off[3:]))
    log = tmp_path / "thrown.mcap"
    write(thrown, log)
    init = ",".join(map(str, off))
    raw, static = vio(log, models=["static"], init=init, bias_states=(False,), settings=VioSettings(duration_s=4.0))
    assert "diverged after" in raw["failed"]
    assert raw["ape_m"] is None
    assert static["failed"] is None
    assert static["ape_m"] < 0.1
    (absolute,) = tabulate([raw, static])  # a path shorter than all distances has no table of them
    _, relative = tabulate([raw, {**static, "roe_deg": static["roe_deg"] | {"5": 1.0}}])
    assert [row[3] for row in absolute[1:]] == ["–", f"{static['aoe_deg']:.3f}"]
    assert [row[1] for row in relative[1:]] == ["static"]
    json.dumps([raw, static], allow_nan=False)


def test_the_command_writes_json_and_a_table(
    code: Callable[..., int], capsys: pytest.CaptureFixture[str], logs: Path, tmp_path: Path
) -> None:
    """A log that cannot be read is named in the end, and costs the others nothing but the exit code."""
    (tmp_path / "bad.mcap").write_text("no log")
    words = ("vio", logs / "flight_1.mcap", "--no-bias-states", "--duration", "4", "--blackout", "1", "-q")
    assert code(*words, tmp_path / "bad.mcap", "--json", "-") == LogError.exit_code
    written = capsys.readouterr()
    report = json.loads(written.out)
    assert "bad.mcap: this is not an MCAP log" in written.err
    assert report["schema"] == SCHEMA == "imutool.vio/1"
    (raw,) = report["results"]
    assert raw["bias_states"] is False
    assert raw["settings"]["blackout_s"] == 1.0
    assert code(*words) == 0
    printed = capsys.readouterr().out
    assert f"{raw['aoe_deg']:.3f}" in printed
    assert f"{raw['ape_m']:.3f}" in printed


def test_the_commands_defaults_are_the_settings() -> None:
    given = {name: one.default for name, one in inspect.signature(scores.vio).parameters.items()}
    settings = VioSettings()
    assert given["lag"] == settings.smoother.lag_s
    assert given["keyframes"] == settings.keyframes_hz
    assert given["blackout"] == settings.blackout_s
    assert given["duration"] is settings.duration_s is None
    for name in ("features", "pixel_noise", "seed"):
        assert given[name] == getattr(settings, name)


def test_a_missing_extra_ends_the_command_with_3(
    code: Callable[..., int], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before any log is read."""
    monkeypatch.setitem(sys.modules, "gtsam", None)
    assert code("vio", "nowhere.mcap") == 3
    assert "imutool[vio]" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--keyframes", "0"), "keyframes_hz"),
        (("--keyframes", "1e9"), "keyframes_hz"),  # more of them than memory holds
        (("--features", "0"), "features"),
        (("--set", "blackout_evry_s=3"), "Did you mean blackout_every_s?"),
    ],
)
def test_settings_out_of_range_are_refused(
    code: Callable[..., int], capsys: pytest.CaptureFixture[str], words: tuple[str, str], told: str
) -> None:
    assert code("vio", "nowhere.mcap", *words) == 3
    assert told in capsys.readouterr().err
