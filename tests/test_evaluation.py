"""Raw figures of the real recordings are the published ones, the JSON holds what programs read, and evo agrees."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import driven
from support.evo import statistics
from typer.testing import CliRunner

import imutool
from imutool import evaluation
from imutool.api.logs import convert
from imutool.bias import linear
from imutool.bias.model_file import find_model, save
from imutool.bias_start.correction import apply_with_std
from imutool.bias_start.initial_bias import MIN_STD
from imutool.bias_start.model_choice import find_initial_bias
from imutool.bias_start.prior_width import BiasPrior
from imutool.cli import load
from imutool.debiasing import debias
from imutool.errors import ConfigError, DataError, LogError, ModelError
from imutool.evaluation import evaluate, runs, started
from imutool.geometry import quaternion
from imutool.inertial import metrics
from imutool.inertial.aids import Aids
from imutool.inertial.metrics import DISTANCES_M
from imutool.inertial.strapdown import StartPose, along_truth, dead_reckon
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.recording import Imu, Poses, Recording
from imutool.sensor.made_up_flight import ACCEL_BIAS, GYRO, GYRO_BIAS, FlightSettings, TriadSettings, flight

# AOE of the raw samples in degrees, unaligned, from the true start: the published column (method.md), rooms as in issue 2.
PUBLISHED = {
    "euroc/MH_04_difficult.zip": 130.33,
    "euroc/V1_03_difficult.zip": 120.13,
    "euroc/V2_02_medium.zip": 116.92,
    "tumvi/dataset-room2.tar.gz": 32.82,
    "tumvi/dataset-room4.tar.gz": 70.19,
    "tumvi/dataset-room6.tar.gz": 65.15,
    "fetch/05_random": 73.28,
}
PUBLISHED_DEG = 0.1
EDGES_S = 0.02  # samples before the first true pose of the common stretch and after its last one are not scored
EVO_TOLERANCE = 1e-6  # relative: evo reads stamps as floats and quaternions through other arithmetic
DRIFTS = ("orientation_deg", "orientation_std_deg"), ("velocity_m_s", "velocity_std_m_s")
FIELDS = {  # contracts.md, JSON of evaluate
    "log": str,
    "model": str,
    "init": (str, type(None)),
    "estimate": str,
    "smooth": bool,
    "samples": int,
    "duration_s": float,
    "aoe_deg": float,
    "aoe_aligned_deg": float,
    "ape_m": float,
    "ape_aligned_m": float,
    "velocity_rmse_m_s": float,
    "roe_deg": dict,
    "rpe_m": dict,
    "gyro_bias": list,
    "accel_bias": list,
}


def test_samples_that_a_log_has_debiased_are_scored_as_their_model(log: Path, model: Path, tmp_path: Path) -> None:
    debias(log, tmp_path / "debiased.mcap", model=str(model))
    raw, written = evaluate(tmp_path / "debiased.mcap", trajectories=tmp_path / "paths")
    _, expected = evaluate(log, models=[model])
    assert (raw["model"], written["model"]) == ("raw", expected["model"])
    assert written["aoe_deg"] == pytest.approx(expected["aoe_deg"], rel=1e-3)
    assert written["aoe_deg"] < raw["aoe_deg"]
    named = {path.name.removeprefix(raw["log"]) for path in (tmp_path / "paths").iterdir()}
    assert named == {"_truth.tum", "_raw.tum", f"_{written['model']}.tum"}
    asked = evaluate(tmp_path / "debiased.mcap", models=["static"])
    assert [result["model"] for result in asked] == ["raw", "static"]


def test_a_truth_of_orientations_alone_scores_the_orientation_alone(recording: Recording, tmp_path: Path) -> None:
    turned = {topic: Poses(p.t_ns, np.zeros_like(p.p_wb), p.q_wb_wxyz) for topic, p in recording.truths.items()}
    write(recording, tmp_path / "whole.mcap")
    write(replace(recording, truths=turned), tmp_path / "turned.mcap")
    whole, alone = (evaluate(tmp_path / f"{name}.mcap", models=["static"], init="truth") for name in ("whole", "turned"))
    for one, other in zip(whole, alone, strict=True):
        assert other["aoe_deg"] == pytest.approx(one["aoe_deg"], rel=1e-9)
        assert other["drift_orientation_deg"] == pytest.approx(one["drift_orientation_deg"], rel=1e-9)
        for name in ("ape_m", "ape_aligned_m", "aoe_aligned_deg", "velocity_rmse_m_s", "drift_velocity_m_s"):
            assert (one[name] is None, other[name]) == (False, None), name
        assert set(other["rpe_m"].values()) == {None}
    np.testing.assert_allclose(alone[1]["gyro_bias"], whole[1]["gyro_bias"], rtol=1e-9)
    assert alone[1]["accel_bias"] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("init", ["auto", "truth"])
def test_the_drift_is_as_large_as_the_covariance_of_the_bias_lets_expect(init: str, tmp_path: Path) -> None:
    shares = []
    for seed in range(6):
        write(flight(seed, duration_s=40.0, sensor_seed=seed), tmp_path / f"{seed}.mcap")
        raw, found = evaluate(tmp_path / f"{seed}.mcap", models=["static"], init=init)
        assert raw["drift_orientation_std_deg"] is None
        shares.append([found[f"drift_{name}"] / found[f"drift_{std}"] for name, std in DRIFTS])
    assert (np.sqrt(np.mean(np.square(shares), axis=0)) < 2.0).all()
    assert (np.median(shares, axis=0) > 0.1).all()


def test_the_drift_of_a_constant_error_is_that_error_times_the_window(tmp_path: Path) -> None:
    """Of a body at rest; what is expected of it is the deviation of the bias times the window."""
    t_ns = 5_000_000 * np.arange(4001)
    imu = Imu(t_ns, np.tile([0.0, 0.0, 0.01], (4001, 1)), np.tile([0.0, 0.0, 9.91], (4001, 1)))
    still = Poses(t_ns[::2], np.zeros((2001, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (2001, 1)))
    recording = Recording("still", imu, {"/t": still})
    write(recording, tmp_path / "still.mcap")
    raw, given = evaluate(tmp_path / "still.mcap", models=["static"], init="0,0,0.004,0,0,0.04")
    for result, gyro, accel in ((raw, 0.01, 0.1), (given, 0.006, 0.06)):
        assert result["drift_orientation_deg"] == pytest.approx(np.degrees(5.0 * gyro), rel=1e-6)
        assert result["drift_velocity_m_s"] == pytest.approx(5.0 * accel, rel=1e-6)
    _, measured = evaluate(tmp_path / "still.mcap", models=["static"])
    ((_, _, start),) = started(recording, ["static"], "auto", "still")
    gyro, accel = 5.0 * np.linalg.norm(start.std.reshape(2, 3), axis=1)  # the bias walks, too, which shows in the gyro's alone
    assert measured["drift_velocity_std_m_s"] == pytest.approx(accel, rel=1e-3)
    assert measured["drift_orientation_std_deg"] == pytest.approx(np.degrees(gyro), rel=0.7)


@pytest.mark.parametrize("late_s", [0.006, -0.004])
def test_late_poses_are_named_and_their_part_of_the_error(late_s: float, tmp_path: Path) -> None:
    made = flight(3, duration_s=40.0, gyro=msgspec.structs.replace(GYRO, scale=0.0, misalignment_rad=0.0, warm_up=0.0))
    late = {topic: replace(p, t_ns=p.t_ns + round(late_s * 1e9)) for topic, p in made.truths.items()}
    for name, recording in (("straight", made), ("late", replace(made, truths=late))):
        write(recording, tmp_path / f"{name}.mcap")
    (_, straight), (raw, found) = (evaluate(tmp_path / f"{name}.mcap", models=["static"]) for name in ("straight", "late"))
    assert straight["pose_delay_s"] is None
    assert raw["pose_delay_s"] is None
    assert found["pose_delay_s"] == pytest.approx(late_s, abs=3e-4)
    assert 0.0 < found["pose_delay_std_s"] < 3e-4
    for name in ("aoe", "drift_orientation"):
        assert found[f"{name}_without_delay_deg"] < 1.1 * straight[f"{name}_deg"]
    assert found["drift_orientation_without_delay_deg"] < 0.8 * found["drift_orientation_deg"]


# ── real recordings ──────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def converted(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    folder = tmp_path_factory.mktemp("converted")

    def log(source: str) -> Path:
        out = folder / f"{Path(source).name}.mcap"
        if not out.exists():
            convert(data / source, out, workers=1)
        return out

    return log


@pytest.mark.parametrize("source", PUBLISHED)
def test_raw_orientation_error_is_the_published_one(converted: Callable[[str], Path], source: str) -> None:
    (raw,) = evaluate(converted(source), init="truth")
    assert raw["model"] == "raw"
    assert raw["aoe_deg"] == pytest.approx(PUBLISHED[source], abs=PUBLISHED_DEG)


def test_what_evo_says_of_the_written_trajectories(converted: Callable[[str], Path], tmp_path: Path) -> None:
    """Of half a minute, which evo goes through pose by pose."""
    whole, log = read(converted("fetch/05_random")), tmp_path / "begun" / "log.mcap"
    log.parent.mkdir()
    write(whole.between(int(whole.imu.t_ns[0]), int(whole.imu.t_ns[0]) + 30 * 10**9), log)
    tmp_path = tmp_path / "trajectories"
    results = evaluate(log, models=["static"], init="truth", trajectories=tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "05_random_raw.tum",
        "05_random_static.tum",
        "05_random_truth.tum",
    ]
    raw, static = results
    runs = (
        (raw, "ape_m", ("-r", "trans_part")),
        (raw, "aoe_deg", ("-r", "angle_deg")),
        (raw, "aoe_aligned_deg", ("--align", "-r", "angle_deg")),
        (static, "aoe_aligned_deg", ("--align", "-r", "angle_deg")),
    )
    truth = "05_random_truth.tum"
    found = statistics(tmp_path, [("ape", truth, f"05_random_{one['model']}.tum", *words) for one, _, words in runs])
    for (result, figure, _), evos in zip(runs, found, strict=True):
        assert result[figure] == pytest.approx(evos["rmse"], rel=EVO_TOLERANCE), (result["model"], figure)


# ── made-up recordings ───────────────────────────────────────────────────────────────────────────────────────────────

PERFECT = TriadSettings(
    noise_density=0.0, walk_density=0.0, typical_bias=0.0, turn_on_bias=0.0, warm_up=0.0, scale=0.0, misalignment_rad=0.0
)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return flight(1, duration_s=20.0)


@pytest.fixture(scope="module")
def log(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "flight.mcap"
    write(recording, path)
    return path


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "linear_1.safetensors"
    save(linear.Model(rate_hz=200.0, tensors={"prior_std": np.ones(6), "truth_std": np.full(6, 1e-3)}), path)
    return path


def test_every_field_of_the_contract_is_there_and_is_json(log: Path, model: Path) -> None:
    results = json.loads(json.dumps(evaluate(log, models=["static", model], init="truth"), allow_nan=False))
    assert [result["model"] for result in results] == ["raw", "static", "linear_1"]
    for result in results:
        for name, kind in FIELDS.items():
            assert isinstance(result[name], kind), (result["model"], name)
        assert result["log"] == "flight_1"
        distances = {f"{d:g}" for d in DISTANCES_M}
        assert set(result["roe_deg"]) == set(result["rpe_m"]) == distances == {"5", "10", "15", "20"}
        assert len(result["gyro_bias"]) == len(result["accel_bias"]) == 3
        assert result["duration_s"] == pytest.approx(20.0, abs=EDGES_S)
        assert result["samples"] == pytest.approx(4001, abs=EDGES_S * 200)
    assert results[0]["init"] is None
    assert results[0]["gyro_bias"] == [0.0, 0.0, 0.0]
    assert results[1]["init"] == results[2]["init"] == "truth"
    assert results[1]["gyro_bias"] != [0.0, 0.0, 0.0]


def test_a_perfect_imu_follows_the_truth() -> None:
    """What is left is Euler's rule: half a step of lag."""
    settings = FlightSettings(gyro=PERFECT, accel=PERFECT, truth_noise_m=0.0, truth_noise_rad=0.0, duration_s=10.0)
    made = flight(2, settings)
    estimate, true, valid = along_truth(made.imu, made.truth, made.name)
    assert valid[2:-2].all()
    assert len(estimate) == len(true) == len(made.imu)
    turn = Rotation.from_quat(true.q_wb_wxyz, scalar_first=True).inv() * Rotation.from_quat(
        estimate.q_wb_wxyz, scalar_first=True
    )
    assert np.degrees(turn.magnitude()).max() < 1.0
    assert np.linalg.norm(estimate.p_wb - true.p_wb, axis=1).max() < 2.0
    np.testing.assert_array_equal(estimate.q_wb_wxyz[0], true.q_wb_wxyz[0])
    np.testing.assert_array_equal(estimate.p_wb[0], true.p_wb[0])


@pytest.mark.parametrize("rate_hz", [120.0, 20.0])
def test_a_start_in_motion_is_the_truth_of_that_moment(rate_hz: float) -> None:
    """The IMU begins between two true poses: starting from the later one would turn the whole path by what lies between."""
    quiet = FlightSettings(gyro=PERFECT, accel=PERFECT, truth_noise_m=0.0, truth_noise_rad=0.0, duration_s=12.0)
    made = flight(2, msgspec.structs.replace(quiet, truth_rate_hz=rate_hz))
    for begin_s in (6.013, 7.281, 8.507):
        moving = made.imu.between(int(made.imu.t_ns[0]) + round(begin_s * 1e9), int(made.imu.t_ns[-1]))
        estimate, true, valid = along_truth(moving, made.truth, made.name)
        assert len(estimate) >= len(moving) - 2 * 200 / rate_hz
        assert metrics.evaluate(estimate, true, valid)["aoe_deg"] < 0.6


def test_a_long_log_costs_what_its_samples_do(tmp_path: Path) -> None:
    """Memory grows with the samples, and by little for each: no path is in memory."""
    peaks, samples = [], (20_000, 20_000, 60_000)  # the first run imports
    for count in samples:
        turned = np.sin(np.arange(count) / 300.0)
        gyro = np.stack([np.zeros(count), np.zeros(count), np.gradient(turned, 0.005)], axis=1) + 0.001
        t_ns = np.arange(count, dtype=np.int64) * 5_000_000
        q_wb = quaternion.exp(np.stack([0 * turned, 0 * turned, turned], axis=1))
        gyro[:2000], q_wb[:2000] = 0.001, [1.0, 0.0, 0.0, 0.0]
        poses = Poses(t_ns[::2], np.zeros((count, 3))[::2], q_wb[::2])
        imu = Imu(t_ns, gyro, np.tile([0.0, 0.0, 9.81], (count, 1)))
        write(Recording("long", imu, truths={"/ground_truth/pose": poses}), tmp_path / f"{count}.mcap", overwrite=True)
        tracemalloc.start()
        evaluate(tmp_path / f"{count}.mcap", models=["static"])
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # bytes a sample; the samples, corrected ones and poses have 140
    assert (peaks[2] - peaks[1]) / (samples[2] - samples[1]) < 260


def test_taking_off_the_true_bias_helps(log: Path, recording: Recording) -> None:
    bias = [recording.scalars[topic].values.mean(axis=0) for topic in (GYRO_BIAS, ACCEL_BIAS)]
    words = ",".join(str(float(b)) for half in bias for b in half)
    raw, static = evaluate(log, models=["static"], init=words)
    assert static["aoe_deg"] < raw["aoe_deg"] / 5
    np.testing.assert_allclose([*static["gyro_bias"], *static["accel_bias"]], np.concatenate(bias), rtol=1e-12)
    assert static["init"] == words
    assert static["init_how"] == "given"


def test_a_loaded_model_scores_as_its_file_does(log: Path, model: Path, tmp_path: Path) -> None:
    loaded = [imutool.load_model("static"), imutool.load_model(model)]
    assert imutool.evaluate(log, models=loaded) == evaluate(log, models=["static", model])
    assert imutool.evaluate(log, models=loaded[1], trajectories=tmp_path)[1]["model"] == "linear_1"
    with pytest.raises(ConfigError, match="two trajectories are called 'linear_1'"):
        imutool.evaluate(log, models=[model, loaded[1]], trajectories=tmp_path, overwrite=True)


def test_an_aided_path_is_a_row_beside_pure_integration(log: Path, model: Path, tmp_path: Path) -> None:
    pure = evaluate(log, models=["static", model], init="auto")
    both = evaluate(log, models=["static", model], init="auto", aid="stops", trajectories=tmp_path)
    assert [(one["model"], one["estimate"]) for one in both] == [
        (name, kind) for name in ("raw", "static", "linear_1") for kind in ("integration", "aided")
    ]
    assert both[::2] == pure
    for integrated, stopped in zip(both[::2], both[1::2], strict=True):
        assert stopped["ape_m"] < 0.5 * integrated["ape_m"], stopped["model"]
        assert stopped["samples"] == integrated["samples"]
        assert (integrated["aids"], stopped["aids"]) == ({}, {"stops": ""})
    assert {path.name for path in tmp_path.glob("*aided*")} == {
        f"flight_1_{n}_aided.tum" for n in ("raw", "static", "linear_1")
    }
    json.dumps(both, allow_nan=False)


def test_what_tracking_found_out_narrows_the_prior_of_an_aided_path(
    log: Path, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bias that was tracked is known better than its start: else an unobservable heading wanders."""
    priors = []

    def path(imu: Imu, start: StartPose, prior: BiasPrior, _: Aids) -> Poses:
        priors.append(prior)
        return dead_reckon(imu, start)

    monkeypatch.setattr(evaluation, "aided_path", path)
    recording = read(log)
    loaded = find_model(model, 200.0)
    start = find_initial_bias("auto", loaded, recording)
    evaluate(log, models=[model], aid="stops")
    raw, known = (prior.std for prior in priors)
    _, std = apply_with_std(loaded, start, recording.imu)
    assert (known <= np.maximum(start.std, MIN_STD)).all()
    np.testing.assert_allclose(known, np.maximum(np.minimum(start.std, np.median(std, axis=0)), MIN_STD), rtol=1e-12)
    assert (known < start.std).any()
    assert (raw > known)[:3].all()


def test_all_aids_of_a_log_and_each_setting_of_its_clock(tmp_path: Path) -> None:
    """A drive twice, with the clock set back between: wheels and barometer go with their own stretch."""
    drive = driven.drive(duration_s=30.0)
    topics = {
        "/odom": driven.odometry(drive.vehicle),
        "/air": driven.pressure(drive.vehicle.t_ns, np.zeros(len(drive.vehicle))),
    }
    path = driven.write(tmp_path / "drive.mcap", drive.imu, drive.truth, topics)
    pure, aided = evaluate(path, models=["static"], aid="auto")[2:]
    assert set(aided["aids"]) == {"stops", "barometer", "odometry", "ground"}
    assert aided["ape_m"] < min(0.3, 0.05 * pure["ape_m"])
    assert aided["rpe_m"]["10"] < 0.05 * pure["rpe_m"]["10"]
    assert aided["velocity_rmse_m_s"] < 0.05 * pure["velocity_rmse_m_s"]
    twice = driven.write(tmp_path / "twice.mcap", drive.imu, drive.truth, topics, again_ns=-7200 * 10**9)
    found = [
        one for one in evaluate(twice, models=["static"], aid="auto") if one["estimate"] == "aided" and one["model"] == "static"
    ]
    assert [one["log"] for one in found] == ["twice_1", "twice_2"]
    for one in found:
        assert one["ape_m"] == pytest.approx(aided["ape_m"], rel=1e-6)


def test_smoothing_is_said_and_finds_its_own_start(log: Path, model: Path) -> None:
    _, causal = evaluate(log, models=[model])
    _, smooth = evaluate(log, models=[model], smooth=True)
    assert (causal["smooth"], smooth["smooth"]) == (False, True)
    assert smooth["init_how"].endswith("forward and backward")
    assert smooth["aoe_deg"] != causal["aoe_deg"]
    with pytest.raises(ConfigError, match=r"`smooth` with `init=truth`"):
        evaluate(log, models=[model], init="truth", smooth=True)


@pytest.mark.parametrize("init", ["trut", "truth:0", "1,2"])
def test_an_unknown_start_is_refused_without_a_model_too(log: Path, init: str) -> None:
    with pytest.raises(ConfigError, match=f"init: '{init}'"):
        evaluate(log, init=init)


def test_masked_rows_count_nowhere(recording: Recording, log: Path, tmp_path: Path) -> None:
    """A hole in the truth: fewer samples are scored; the trajectory itself is that of the whole log."""
    t_s = (recording.truth.t_ns - recording.truth.t_ns[0]) * 1e-9
    holed = tmp_path / "holed.mcap"
    write(replace(recording, truths={"/t": recording.truth.rows((t_s < 5.0) | (t_s > 8.0))}), holed)
    (whole,), (part,) = evaluate(log), evaluate(holed)
    assert whole["samples"] - part["samples"] == pytest.approx(3.0 * 200, abs=5)
    assert part["duration_s"] == whole["duration_s"]
    evaluate(holed, trajectories=tmp_path / "tum")
    for name in ("truth", "raw"):
        lines = (tmp_path / "tum" / f"flight_1_{name}.tum").read_text().splitlines()
        assert len(lines) == part["samples"]


def test_a_gap_of_the_imu_is_warned_of(recording: Recording, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    number = np.arange(len(recording.imu))
    kept = recording.imu.rows((number < 1000) | (number >= 1500))  # at 200 Hz
    write(replace(recording, imu=kept), tmp_path / "gap.mcap")
    write(recording, tmp_path / "whole.mcap")
    evaluate(tmp_path / "whole.mcap", models=["static"])
    assert "gaps of the IMU" not in caplog.text
    evaluate(tmp_path / "gap.mcap", models=["static"])
    assert caplog.text.count("gaps of the IMU: 1, 2.5 s in all, the first at ") == 1


def test_poses_a_second_apart_are_warned_of(recording: Recording, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Between its poses the truth that is scored is interpolated."""
    topic, truth = next(iter(recording.truths.items()))
    every = round(1.0 / truth.period_s)
    write(replace(recording, truths={topic: truth.rows(slice(None, None, every))}), tmp_path / "sparse.mcap")
    evaluate(tmp_path / "sparse.mcap")
    assert [r.message for r in caplog.records if f"{topic} are 1 s apart, and interpolation between them" in r.message]


def test_the_truth_that_is_named_gives_start_and_score(recording: Recording, tmp_path: Path) -> None:
    """A second truth, turned by ten degrees and moved: against the wrong start the raw error would show it."""
    turn = Rotation.from_euler("z", 10.0, degrees=True)
    first = recording.truth
    assert first.v_w is not None
    q = (turn * Rotation.from_quat(first.q_wb_wxyz, scalar_first=True)).as_quat(scalar_first=True)
    second = Poses(first.t_ns, turn.apply(first.p_wb.copy()) + 5.0, q, turn.apply(first.v_w.copy()))
    path = tmp_path / "two.mcap"
    write(replace(recording, truths={"/ground_truth/pose": first, "/ground_truth_other/pose": second}), path)
    (a,), (b,), (c,) = (
        evaluate(path),
        evaluate(path, truth="/ground_truth_other/pose"),
        evaluate(path, truth="/ground_truth/pose"),
    )
    assert a == c  # without a name the first counts
    for figure in ("aoe_deg", "ape_m", "velocity_rmse_m_s"):
        assert b[figure] == pytest.approx(a[figure], rel=1e-9)
    with pytest.raises(LogError, match="/nowhere"):
        evaluate(path, truth="/nowhere")


def test_a_folder_for_trajectories_that_cannot_be_made_is_said(log: Path) -> None:
    with pytest.raises(ConfigError, match=r"tum: cannot be written \(Not a directory\)"):
        evaluate(log, trajectories=log / "tum")


def test_trajectories_are_not_written_over_unless_told(log: Path, tmp_path: Path) -> None:
    evaluate(log, trajectories=tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ConfigError, match="exists"):
        evaluate(log, trajectories=tmp_path)
    evaluate(log, trajectories=tmp_path, overwrite=True)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("name", ["raw", "truth"])
def test_a_model_cannot_take_the_place_of_the_truth(log: Path, tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match=f"two trajectories are called '{name}'"):
        evaluate(log, models=[tmp_path / f"{name}.safetensors"], trajectories=tmp_path, overwrite=True)


def test_of_two_logs_of_one_name_none_is_written_over(log: Path, tmp_path: Path) -> None:
    """As a raw log and the debiased one of it have; the second one's trajectories took the place of the first one's."""
    (tmp_path / "b.mcap").symlink_to(log)
    words = ["evaluate", str(log), str(tmp_path / "b.mcap"), "--trajectories", str(tmp_path / "tum"), "--overwrite"]
    done = CliRunner().invoke(load(), words)
    assert done.exit_code == ConfigError.exit_code
    assert f"--trajectories: {log} and {tmp_path}/b.mcap are both called" in done.stderr
    assert not (tmp_path / "tum").exists()


def test_a_logs_name_cannot_lead_out_of_the_folder(recording: Recording, tmp_path: Path) -> None:
    """The name comes from the log, and the log from anybody."""
    for i, name in enumerate(("../../outside", "/tmp/outside", "a/b", "..")):
        path = tmp_path / f"{i}.mcap"
        write(replace(recording, name=name, scalars={}), path)
        folder = tmp_path / "deep" / str(i)
        evaluate(path, trajectories=folder)
        assert len(list(folder.iterdir())) == 2
    everything = {path.relative_to(tmp_path).parts[0] for path in tmp_path.rglob("*")}
    assert everything == {"0.mcap", "1.mcap", "2.mcap", "3.mcap", "deep"}


def test_one_name_for_two_models_is_refused_before_anything_is_written(log: Path, model: Path, tmp_path: Path) -> None:
    twin = tmp_path / "other" / model.name
    twin.parent.mkdir()
    twin.write_bytes(model.read_bytes())
    with pytest.raises(ConfigError, match="two trajectories are called 'linear_1'"):
        evaluate(log, models=[model, twin], init="truth", trajectories=tmp_path / "tum", overwrite=True)
    assert not (tmp_path / "tum").exists()


# ── refusals ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_log_without_truth_is_refused(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "blind.mcap"
    write(Recording("blind", recording.imu), path)
    with pytest.raises(DataError, match="blind: no true poses"):
        evaluate(path)


def test_a_truth_of_another_time_is_refused(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "late.mcap"
    imu = recording.imu
    write(Recording("late", Imu(imu.t_ns + 10**12, imu.gyro, imu.accel), recording.truths), path)
    with pytest.raises(DataError, match="late: IMU and true poses share fewer than two samples"):
        evaluate(path)


def test_a_truth_shorter_than_a_start_is_refused_for_that_start_only(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "short.mcap"
    begin = int(recording.imu.t_ns[0])
    write(Recording("short", recording.imu, {"/t": recording.truth.between(begin, begin + 9 * 10**8)}), path)
    assert len(evaluate(path, models=["static"])) == 2
    with pytest.raises(DataError, match=r"short: 0\.9 s of truth"):
        evaluate(path, models=["static"], init="truth")


def test_a_model_that_cannot_be_used_is_refused(log: Path, tmp_path: Path) -> None:
    slow = tmp_path / "slow.safetensors"
    save(linear.Model(rate_hz=10.0), slow)
    with pytest.raises(ModelError, match=r"IMU at 200.0 Hz; expected 10.0 Hz"):
        evaluate(log, models=[slow])
    with pytest.raises(ModelError, match="no model 'nothing'"):
        evaluate(log, models=["nothing"])
    moving = tmp_path / "moving.mcap"
    write(flight(2, duration_s=8.0, still_s=0.0), moving)
    with pytest.raises(ModelError, match="holds no stretch at rest"):
        evaluate(moving, models=["static"])


def test_samples_beyond_any_sensor_are_refused(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "absurd.mcap"
    imu = recording.imu
    write(Recording("absurd", Imu(imu.t_ns, imu.gyro, imu.accel * 1e306), recording.truths), path)
    with pytest.raises(ConfigError, match=r"no sample is a measurement .* beyond any sensor"):
        evaluate(path)


def test_runs_come_in_the_order_asked_for(recording: Recording, model: Path) -> None:
    found: list[tuple[str, Any]] = [(name, start) for name, _, start in runs(recording, [model, "static"], "truth", "here")]
    assert [name for name, _ in found] == ["raw", "linear_1", "static"]
    assert found[0][1] is None


@pytest.mark.parametrize("wrong", ["body", "mm/s", "right", "drift of 2 %"])
def test_velocities_that_do_not_follow_the_positions_are_not_used(
    wrong: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A start with the body's velocities had a path that is off by kilometres, without a word."""
    flown = flight(1, FlightSettings())
    truth = flown.truth
    assert truth.v_w is not None
    stated = {
        "body": Rotation.from_quat(truth.q_wb_wxyz.copy(), scalar_first=True).inv().apply(truth.v_w.copy()),
        "mm/s": 1000.0 * truth.v_w,
        "right": truth.v_w,
        "drift of 2 %": 1.02 * truth.v_w,
    }
    topic = next(iter(flown.truths))
    for name, v_w in (("stated", stated[wrong]), ("none", None)):
        write(replace(flown, truths={topic: replace(truth, v_w=v_w)}), tmp_path / f"{name}.mcap")
    (with_it,), (without,) = (evaluate(tmp_path / f"{name}.mcap", init="auto") for name in ("stated", "none"))
    unused = wrong in ("body", "mm/s")
    assert caplog.text.count("do not follow its positions") == unused
    assert (with_it["ape_m"] == without["ape_m"]) == unused
