"""Logs that hold less than one would wish: each is told what is the matter, and what can be answered all the same is."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from support import planted

from imutool.api.sensors import example_recording
from imutool.diagnosis.diagnose import diagnose
from imutool.diagnosis.result import Diagnosis
from imutool.diagnosis.to_sensor_files import to_physics_file
from imutool.diagnosis.wording.conclusion import conclusion
from imutool.errors import DataError, LogError
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.recording import Poses
from imutool.report import json_values

ARM = [0.2, -0.05, 0.1]
SCALE = [0.03, -0.02, 0.04]
SURE = 4.5
SIM_HZ = 200.0
LSB = np.repeat([0.01, 0.1], 3)  # coarser than the noise
ALMOST = 0.98
POSES_HZ = 25.0


class Logs(NamedTuple):
    """Where they are."""

    real: Path
    sim: Path


def moving(
    folder: Path,
    effects: Mapping[str, Sequence[float]],
    *,
    duration_s: float = planted.DURATION_S,
    rate_hz: float = planted.RATE_HZ,
    limit: np.ndarray | None = None,
    stuck: int | None = None,
    poses_s: np.ndarray | None = None,
    sim_from_s: float = 0.0,
    sim_seed: int = 1,
    name: str = "real",
) -> Logs:
    """A recording of a motion with effects, which may be clipped, stuck on an axis or have poses, and a simulation."""
    felt, t_s = planted.rich(1, duration_s), planted.clock(duration_s, rate_hz)
    samples = planted.ideal(felt, planted.acting(effects), t_s) + planted.noise(len(t_s), 1) + planted.BIAS
    if limit is not None:
        samples = np.clip(samples, -limit, limit)
    if stuck is not None:
        samples[:, stuck] = 3.25
    poses = None if poses_s is None else planted.poses(planted.moving(1, duration_s), poses_s)
    write(planted.recording(name, t_s, samples, poses=poses), folder / f"{name}.mcap")
    path, t_sim = planted.moving(sim_seed, duration_s), planted.clock(duration_s, SIM_HZ, sim_from_s)
    imu = path.imu(path.start_ns + np.round(t_sim * 1e9).astype(np.int64))
    sim = np.concatenate([imu.gyro, imu.accel], axis=1) + planted.noise(len(t_sim), 99)
    write(planted.recording("sim", t_sim, sim, poses=planted.poses(path, t_sim)), folder / f"{name}_sim.mcap")
    return Logs(folder / f"{name}.mcap", folder / f"{name}_sim.mcap")


def resting(
    folder: Path, name: str, *, poses: bool = False, lsb: np.ndarray | None = None, noisy: bool = True, seed: int = 3
) -> Path:
    """A recording at rest."""
    t_s = planted.clock()
    samples = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.81]) + planted.BIAS + noisy * planted.noise(len(t_s), seed)
    samples = samples if lsb is None else lsb * np.round(samples / lsb)
    p_wb = np.random.default_rng(1).normal(0.0, 1e-4, (len(t_s), 3))
    t_ns = planted.START_NS + np.round(t_s * 1e9).astype(np.int64)
    truth = Poses(t_ns, p_wb, np.tile([1.0, 0.0, 0.0, 0.0], (len(t_s), 1))) if poses else None
    write(planted.recording(name, t_s, samples, poses=truth), folder / f"{name}.mcap")
    return folder / f"{name}.mcap"


def effects(d: Diagnosis) -> list[str]:
    json.dumps(json_values(d.report), allow_nan=False)
    return [one.effect for one in d.findings]


def near(d: Diagnosis, effect: str, truth: Mapping[str, float]) -> bool:
    (one,) = (one for one in d.findings if one.effect == effect)
    return all(abs(one.parameters[name].value - value) < SURE * one.parameters[name].std for name, value in truth.items())


# ── a sensor, or an axis, that tells nothing ──


@pytest.fixture(scope="module")
def saturated(tmp_path_factory: pytest.TempPathFactory) -> Diagnosis:
    """An accelerometer at half a metre a second squared throughout, next to a gyro with a scale error."""
    limit = np.array([np.inf] * 3 + [0.05] * 3)
    return diagnose([(logs := moving(tmp_path_factory.mktemp("limit"), {"gyro_scale": SCALE}, limit=limit)).real], logs.sim)


def test_beside_an_accelerometer_at_its_limit_throughout_the_gyro_is_answered(saturated: Diagnosis) -> None:
    assert "gyro_scale" in effects(saturated)
    assert near(saturated, "gyro_scale", dict(zip("xyz", SCALE, strict=True)))
    assert set(effects(saturated)) <= {"gyro_scale", "saturation"}
    assert any("accel is at its limit of 0.05 m/s²: x in " in one for one in saturated.remarks)


def test_what_only_the_saturated_sensor_shows_is_listed_as_not_identifiable(saturated: Diagnosis) -> None:
    assert {"accel_scale.z", "accel_quadratic.z"} & set(saturated.not_identifiable) or {
        "accel_scale",
        "accel_quadratic",
    } <= set(saturated.not_identifiable)
    assert not any(name.startswith("gyro") for name in saturated.not_identifiable)


def test_a_stuck_axis_is_told_and_the_others_are_answered(tmp_path: Path) -> None:
    logs = moving(tmp_path, {"lever_arm": ARM}, stuck=4)
    d = diagnose([logs.real], logs.sim)
    assert effects(d) == ["lever_arm"]
    assert near(d, "lever_arm", dict(zip("xyz", ARM, strict=True)))
    assert d.mismatch
    assert "The accel's y is no measurement: it reads 3.25 m/s² in every sample." in conclusion(d)
    (place,) = (one for one in d.located if one.axes == ("y",))
    assert place.intervals_s[0][1] - place.intervals_s[0][0] > ALMOST * planted.DURATION_S
    assert "accel_scale.y" in d.not_identifiable
    assert "accel_scale.x" not in d.not_identifiable
    assert d.unexplained["accel"].white


def test_a_dead_sensor_is_refused_with_what_it_reads(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"gyro x reads 0.02 rad/s in every sample"):
        diagnose([resting(tmp_path, "dead", poses=True, noisy=False)])


# ── rest ──


def test_at_rest_bias_noise_and_digits_are_answered_and_the_rest_is_listed(tmp_path: Path) -> None:
    d = diagnose([resting(tmp_path, "still", poses=True, lsb=LSB)])
    assert effects(d) == ["quantization"]
    assert np.abs(d.bias[0] - planted.BIAS).max() < LSB.max()
    assert {"gyro_scale", "lever_arm", "clock_offset", "low_pass", "mount_resonance"} <= set(d.not_identifiable)
    assert not {"gyro_bias_drift", "vibration"} & set(d.not_identifiable)
    assert any("too little motion for anything but a bias" in one for one in d.remarks)


def test_at_rest_a_simulation_at_rest_serves_though_nothing_can_be_aligned(tmp_path: Path) -> None:
    d = diagnose([resting(tmp_path, "still")], resting(tmp_path, "sim", seed=4))
    assert effects(d) == []
    assert not d.mismatch
    assert "clock_offset" in d.not_identifiable


# ── time and motion ──


def test_ten_seconds_are_enough_for_what_is_large(tmp_path: Path) -> None:
    logs = moving(tmp_path, {"lever_arm": ARM}, duration_s=10.0)
    d = diagnose([logs.real], logs.sim)
    assert effects(d) == ["lever_arm"]
    assert near(d, "lever_arm", dict(zip("xyz", ARM, strict=True)))


def test_a_recording_of_another_rate_than_the_simulation_is_compared(tmp_path: Path) -> None:
    logs = moving(tmp_path, {"lever_arm": ARM}, rate_hz=73.0)
    assert effects(diagnose([logs.real], logs.sim)) == ["lever_arm"]


def test_nothing_separates_a_recording_from_a_copy_of_itself(tmp_path: Path) -> None:
    """Its noise was filtered as that of a simulation, and what the filter took was found."""
    write(example_recording(3, duration_s=40.0), tmp_path / "copy.mcap")
    write(example_recording(3, duration_s=40.0), tmp_path / "log.mcap")
    d = diagnose([tmp_path / "log.mcap"], tmp_path / "copy.mcap")
    assert not d.findings
    assert conclusion(d).startswith("Nothing but a constant bias and noise")


def test_too_little_shared_time_is_refused_with_how_much_there_is(tmp_path: Path) -> None:
    logs = moving(tmp_path, {}, sim_from_s=19.0)
    with pytest.raises(DataError, match=r"(4.9|5.0) s shared with the simulation.*at least 8 s"):
        diagnose([logs.real], logs.sim)


# ── names ──


def test_a_field_that_no_log_has_is_refused_before_anything_is_searched(tmp_path: Path) -> None:
    logs, told = moving(tmp_path, {}), []
    with pytest.raises(LogError, match=r"no topic /odom|/odom"):
        diagnose([logs.real], logs.sim, signals=["/odom.twist"], tell=lambda done, total, word: told.append(word))
    assert told == ["reading"]


def test_an_imu_that_the_log_does_not_have_is_refused_with_those_there_are(tmp_path: Path) -> None:
    real = moving(tmp_path, {}).real
    with pytest.raises(LogError, match="/imu0"):
        diagnose([real], imu="/imu7")


# ── poses ──


def test_poses_too_slow_to_be_differentiated_leave_what_samples_show_by_themselves(tmp_path: Path) -> None:
    logs = moving(tmp_path, {}, poses_s=planted.clock(rate_hz=5.0))
    d = diagnose([logs.real])
    assert effects(d) == []
    (said,) = d.remarks
    assert "can be differentiated" in said
    assert "Only the checks of stamps and digits were possible" in said
    assert {"lever_arm", "gyro_scale", "clock_offset"} <= set(d.not_identifiable)
    assert to_physics_file(d).bias is None  # nobody knows it
    told = json_values(d.report)
    assert told["bias"] == {"gyro": None, "accel": None}
    assert (told["mismatch"], told["unexplained"]["white"]) == (None, None)  # a script may not read that the two agree
    clipped = diagnose([moving(tmp_path, {}, poses_s=planted.clock(rate_hz=5.0), limit=np.full(6, 1.0), name="clipped").real])
    assert effects(clipped) == ["saturation"]
    assert conclusion(clipped).split(".")[0].endswith("; nothing else could be compared")


@pytest.mark.parametrize(
    ("factors", "said"), [((1.0, [1, -1, -1, -1]), "are the inverse"), ((1e3, [1, 1, 1, 1]), "are in mm and not in m")]
)
def test_poses_that_are_misread_are_no_reference(factors: tuple[float, list[int]], said: str, tmp_path: Path) -> None:
    """They gave a mount of 49 degrees, and a misfit of 3700 m/s² without a name."""
    made = example_recording(duration_s=40.0)
    poses = Poses(made.truth.t_ns, factors[0] * made.truth.p_wb, made.truth.q_wb_wxyz * factors[1])
    write(replace(made, truths={"/ground_truth/pose": poses}, scalars={}), tmp_path / "real.mcap")
    found = diagnose([tmp_path / "real.mcap"]).report
    assert (len(found.findings), len(found.remarks)) == (0, 1)
    assert said in found.remarks[0]


@pytest.mark.parametrize("amplitude", [0.0, 0.05])
def test_a_vibration_faster_than_the_poses_know_the_motion_is_named(tmp_path: Path, amplitude: float) -> None:
    line = {"vibration": [31.7, amplitude, 0.0, 0.0, -amplitude, *[0.0] * 8]}
    logs = moving(tmp_path, line if amplitude else {}, poses_s=planted.clock(rate_hz=POSES_HZ))
    d = diagnose([logs.real])
    assert effects(d) == (["vibration"] if amplitude else [])
    assert not amplitude or near(d, "vibration", {"f": 31.7, "accel_sin_x": amplitude, "accel_cos_y": -amplitude})


def test_poses_of_a_part_answer_for_that_part(tmp_path: Path) -> None:
    logs = moving(tmp_path, {"lever_arm": ARM}, poses_s=planted.clock(15.0, first_s=3.0))
    d = diagnose([logs.real])
    assert effects(d) == ["lever_arm"]
    (trace,) = d.traces
    assert 3.0 <= trace.t_s[0] < 4.0
    assert 14.0 < trace.t_s[-1] <= 15.0
    assert any("poses cover 12 of 24 s" in one for one in d.remarks)


def test_a_stretch_of_poses_that_the_samples_hardly_share_is_left_out(tmp_path: Path) -> None:
    """A motion capture began before a phone, and lost it soon after: 3.3 of 106 s were said to be shared."""
    logs = moving(tmp_path, {"lever_arm": ARM}, poses_s=np.concatenate([planted.clock(9.0), planted.clock(first_s=9.4)]))
    real = read(logs.real)
    late = real.imu.rows(real.imu.t_ns > real.imu.t_ns[0] + 6 * 10**9)
    write(replace(real, imu=late), tmp_path / "late.mcap")
    assert effects(diagnose([tmp_path / "late.mcap"])) == ["lever_arm"]


def test_of_several_logs_one_without_usable_poses_is_left_out_with_a_word(tmp_path: Path) -> None:
    whole = moving(tmp_path, {"lever_arm": ARM}, poses_s=planted.clock(15.0), duration_s=15.0, name="whole")
    poor = moving(tmp_path, {"lever_arm": ARM}, poses_s=planted.clock(rate_hz=5.0), name="poor")
    d = diagnose([poor.real, whole.real])
    assert effects(d) == ["lever_arm"]
    assert any(one.startswith("left out, poor") for one in d.remarks)
