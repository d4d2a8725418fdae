"""A simulated IMU reads what closed forms say, its effects and noise act as stated, and its log says how it was made."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.errors import ConfigError, DataError, LogError
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.encode import encode_pose
from imutool.mcap_io.file_writer import LogWriter
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.noise import datasheet as noises
from imutool.recording import GRAVITY_M_S2, Imu, Poses, Recording, Scalars, seconds
from imutool.sensor import catalogue
from imutool.sensor.effect import Effect, Stage, Theta, simulate_stretches
from imutool.sensor.physics_file import PhysicsFile
from imutool.sensor.samples import SensorSamples
from imutool.sensor.simulate import MOTION_TOPIC, simulate, simulated

START_NS = 1_700_000_000_000_000_123
RATE_HZ = 200.0
NONE = noises.SHEETS["none"]
Run = Callable[..., subprocess.CompletedProcess[str]]
# What splines with knots 10 ms apart, which smooth as if poses were noisy, make of these motions: 1e-8 rad/s and 1e-6 m/s² amid
# them, and 1.4e-6 rad/s and 1.7e-4 m/s² in the first sample that is trusted.
GYRO, ACCEL = 3e-6, 4e-4


def poses(p_wb: np.ndarray, R_wb: Rotation, rate_hz: float = RATE_HZ) -> Poses:
    t_ns = START_NS + np.round(np.arange(len(p_wb)) * 1e9 / rate_hz).astype(np.int64)
    return Poses(t_ns, np.ascontiguousarray(p_wb), np.ascontiguousarray(R_wb.as_quat(scalar_first=True)))


def recording(truth: Poses, **changes: object) -> Recording:
    none = Imu(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    return replace(Recording("made_up", none, {"/ground_truth/pose": truth}), **changes)  # type: ignore[arg-type]


def along(truth: Poses, acting: list[tuple[Effect, Theta]] | None = None, **changes: object) -> Recording:
    return simulated(recording(truth, **changes), acting or [], NONE, RATE_HZ, 0).recording


def elapsed(imu: Imu) -> np.ndarray:
    return seconds(imu.t_ns, START_NS)


T = np.arange(int(6 * RATE_HZ) + 1) / RATE_HZ


def resting() -> Poses:
    return poses(np.tile([1.0, 2.0, 3.0], (len(T), 1)), Rotation.from_euler("ZYX", np.tile([0.4, 0.3, -0.2], (len(T), 1))))


def turning(rate: float = 2.0) -> Poses:
    return poses(np.zeros((len(T), 3)), Rotation.from_rotvec(np.outer(rate * T, [0.0, 0.0, 1.0])))


def circling(radius: float = 1.5, rate: float = 2.0) -> Poses:
    """Nose along the way, wings level: the body turns as it goes round."""
    p_wb = radius * np.stack([np.cos(rate * T), np.sin(rate * T), 0.0 * T], axis=1)
    return poses(p_wb, Rotation.from_rotvec(np.outer(rate * T, [0.0, 0.0, 1.0])))


# ── closed forms ──


def test_at_rest_it_reads_gravity_alone() -> None:
    imu = along(resting()).imu
    up = Rotation.from_euler("ZYX", [0.4, 0.3, -0.2]).inv().apply([0.0, 0.0, GRAVITY_M_S2])
    np.testing.assert_allclose(imu.gyro, 0.0, atol=GYRO)
    np.testing.assert_allclose(imu.accel, np.tile(up, (len(imu), 1)), atol=ACCEL)


def test_a_constant_turn_reads_its_rate() -> None:
    imu = along(turning()).imu
    np.testing.assert_allclose(imu.gyro, np.tile([0.0, 0.0, 2.0], (len(imu), 1)), atol=GYRO)
    np.testing.assert_allclose(imu.accel, np.tile([0.0, 0.0, GRAVITY_M_S2], (len(imu), 1)), atol=ACCEL)


def test_a_circle_reads_its_centripetal_acceleration() -> None:
    """r omega² towards the centre, which is -x of a body that started at (r, 0, 0) with the world's axes."""
    imu = along(circling()).imu
    np.testing.assert_allclose(imu.accel, np.tile([-1.5 * 2.0**2, 0.0, GRAVITY_M_S2], (len(imu), 1)), atol=ACCEL)


def test_coning_reads_its_closed_form() -> None:
    """q = (cos(a/2), sin(a/2) cos(W t), sin(a/2) sin(W t), 0): an axis that goes round (Bortz 1971; Savage 1998, section 7).

    omega = (-W sin a sin(W t), W sin a cos(W t), -2 W sin²(a/2)) in the body.
    """
    a, W = 0.2, 2.0 * np.pi
    q = np.stack([np.full_like(T, np.cos(a / 2)), np.sin(a / 2) * np.cos(W * T), np.sin(a / 2) * np.sin(W * T), 0 * T], axis=1)
    truth = poses(np.zeros((len(T), 3)), Rotation.from_quat(q, scalar_first=True))
    imu = along(truth).imu
    t = elapsed(imu)
    expected = W * np.stack(
        [-np.sin(a) * np.sin(W * t), np.sin(a) * np.cos(W * t), np.full_like(t, -2 * np.sin(a / 2) ** 2)], axis=1
    )
    np.testing.assert_allclose(imu.gyro, expected, atol=GYRO)
    up = Rotation.from_quat(
        np.stack([np.full_like(t, np.cos(a / 2)), np.sin(a / 2) * np.cos(W * t), np.sin(a / 2) * np.sin(W * t), 0 * t], axis=1),
        scalar_first=True,
    ).apply(np.array([0.0, 0.0, GRAVITY_M_S2]), inverse=True)
    np.testing.assert_allclose(imu.accel, up, atol=ACCEL)


# ── effects ──


def test_a_lever_arm_on_a_constant_turn_reads_the_centripetal_acceleration() -> None:
    (lever,) = catalogue.effects(["lever_arm"])
    imu = along(turning(), [(lever, np.array([0.1, 0.0, 0.0]))]).imu
    np.testing.assert_allclose(imu.accel, np.tile([-0.1 * 2.0**2, 0.0, GRAVITY_M_S2], (len(imu), 1)), atol=ACCEL)


def planted(name: str, stage: Stage, forward: Callable[..., object]) -> tuple[Effect, Theta]:
    return Effect(name, stage, ("gyro", "accel"), "", (), "", forward), np.zeros(0)


def test_effects_act_in_the_order_of_their_stages() -> None:
    """A scale before a bias, whatever order they come in, and a shift of the clock before both."""
    scale = planted("a_scale", Stage.MOTION, lambda felt, _: replace(felt, accel=3.0 * felt.accel))
    bias = planted("b_bias", Stage.SENSOR, lambda read, _: read.with_readings(accel=read.accel + 1.0))
    clip = planted("saturation", Stage.CONVERTER, lambda read, _: read.with_readings(accel=np.minimum(read.accel, 10.0)))
    imu = along(resting(), [clip, bias, scale]).imu
    up = Rotation.from_euler("ZYX", [0.4, 0.3, -0.2]).inv().apply([0.0, 0.0, GRAVITY_M_S2])
    np.testing.assert_allclose(imu.accel, np.tile(np.minimum(3.0 * up + 1.0, 10.0), (len(imu), 1)), atol=3 * ACCEL)


def test_noise_comes_before_the_converter() -> None:
    rounded = planted(
        "quantization", Stage.CONVERTER, lambda read, _: read.with_readings(np.round(read.gyro, 2), np.round(read.accel, 1))
    )
    imu = simulated(recording(resting()), [rounded], noises.SHEETS["adis16448"], RATE_HZ, 3).recording.imu
    np.testing.assert_allclose(imu.accel * 10.0, np.round(imu.accel * 10.0), atol=1e-9)
    assert len(np.unique(imu.accel[:, 0])) > 1


def test_a_shift_of_the_clock_takes_samples_later_and_leaves_out_those_beyond_the_motion() -> None:
    accelerating = poses(np.stack([T**3 / 6.0, 0 * T, 0 * T], axis=1), Rotation.identity(len(T)))
    ideal, late = (along(accelerating, acting).imu for acting in ([], [planted("shift", Stage.CLOCK, lambda t, _: t + 0.05)]))
    np.testing.assert_allclose(late.accel[:, 0], elapsed(late) + 0.05, atol=ACCEL)
    assert len(ideal) - len(late) == 10  # 0.05 s at 200 Hz: none is held at its last value
    half = simulated(recording(accelerating), [planted("shift", Stage.CLOCK, lambda t, _: t + 0.5 * T[-1])], NONE, RATE_HZ, 0)
    assert any("of the samples are left out: the clock takes them" in remark for remark in half.remarks)


def test_the_clock_and_the_sensor_know_of_no_holes() -> None:
    truth = resting()
    hole = (T > 2.8) & (T < 3.3)
    broken = Poses(truth.t_ns[~hole], truth.p_wb[~hole], truth.q_wb_wxyz[~hole])
    drift = planted(
        "drift", Stage.SENSOR, lambda read, _: read.with_readings(gyro=(read.stamp_s - read.stamp_s[0])[:, None] * np.ones(3))
    )
    out = along(broken, [drift])
    t = elapsed(out.imu)
    assert np.diff(t).max() > 0.5
    np.testing.assert_allclose(out.imu.gyro[:, 0], t - t[0], atol=1e-9)
    assert not ((t > 2.8) & (t < 3.3)).any()
    assert len(out.truth) < (~hole).sum()


def test_times_count_from_the_recordings_first_sample_where_that_is_of_this_motion() -> None:
    drift = planted("drift", Stage.SENSOR, lambda read, _: read.with_readings(gyro=read.stamp_s[:, None] * np.ones(3)))
    for start_ns, begins_s in ((START_NS - 700_000_000, -0.7), (START_NS - 10**18, None), (None, None)):
        imu = simulated(recording(resting()), [drift], NONE, RATE_HZ, 0, start_ns=start_ns).recording.imu
        since_s = elapsed(imu) - (elapsed(imu)[0] if begins_s is None else begins_s)
        np.testing.assert_allclose(imu.gyro[:, 0], since_s, atol=1e-6)


def test_a_temperature_comes_from_the_log_and_goes_into_the_new_one() -> None:
    (temperature,) = catalogue.effects(["temperature"])
    truth = resting()
    warming = Scalars(truth.t_ns, 20.0 + T[:, None], "degC")
    out = along(truth, [(temperature, np.array([0.1, 0, 0, 0, 0, 0.0]))], scalars={"/imu0/temperature": warming})
    t = elapsed(out.imu)
    np.testing.assert_allclose(out.imu.gyro[:, 0], 0.1 * (t - t.mean()), atol=1e-5)
    assert out.scalars["/imu0/temperature"] == warming
    with pytest.raises(DataError, match="temperature"):
        along(truth, [(temperature, np.zeros(6))])


# ── clocks, noise, truth ──


def test_stamps_are_whole_periods_on_the_clock_of_the_poses() -> None:
    imu = simulated(recording(turning()), [], NONE, 128.0, 0).recording.imu
    periods = (imu.t_ns - START_NS) * 1e-9 * 128.0
    np.testing.assert_allclose(periods, np.round(periods), atol=1e-6)
    assert (np.diff(np.round(periods)) == 1).all()


def test_white_noise_and_walk_have_their_stated_size() -> None:
    long = 300.0
    truth = poses(np.zeros((int(long * 50), 3)), Rotation.identity(int(long * 50)), 50.0)
    white = noises.Noise(gyro_density=(1e-3, 2e-3, 0.0), accel_density=(1e-2,) * 3, gyro_walk=(0.0,) * 3, accel_walk=(0.0,) * 3)
    imu = simulated(recording(truth), [], white, RATE_HZ, 1).recording.imu
    std = np.array([1e-3, 2e-3, 0.0]) * np.sqrt(RATE_HZ)
    np.testing.assert_allclose(imu.gyro.std(axis=0), std, rtol=0.02, atol=1e-5)  # 60000 samples: 0.3 per cent
    walk = msgspec.structs.replace(white, gyro_density=(0.0,) * 3, gyro_walk=(1e-3,) * 3)
    gyro = simulated(recording(truth), [], walk, RATE_HZ, 1).recording.imu.gyro
    steps = np.diff(gyro[::200], axis=0)  # after one second each: walk * sqrt(1 s)
    assert float(steps.std()) == pytest.approx(1e-3, rel=0.1)


def test_the_seed_alone_decides_the_noise() -> None:
    a, b, c = (simulated(recording(resting()), [], noises.SHEETS["bmi160"], RATE_HZ, seed).recording for seed in (7, 7, 8))
    assert a == b
    assert not np.array_equal(a.imu.gyro, c.imu.gyro)


def test_noise_that_is_not_known_is_said_to_be_missing() -> None:
    found = simulated(recording(resting()), [], noises.Noise(gyro_density=(1e-3,) * 3), RATE_HZ, 0)
    assert found.remarks == ("accel_density, gyro_walk, accel_walk not known in the noise file, and not simulated",)
    of_some = noises.Noise(gyro_density=(float("nan"), 1e-3, 1e-3), accel_density=(1e-3,) * 3, gyro_walk=(0.0,) * 3)
    found = simulated(recording(resting()), [], of_some, RATE_HZ, 0)
    assert found.remarks == ("gyro_density (x), accel_walk not known in the noise file, and not simulated",)
    assert (found.recording.imu.gyro.std(axis=0) > 1e-4).tolist() == [False, True, True]


def test_the_truth_is_copied_and_the_exact_motion_lies_beside_it() -> None:
    truth = circling()
    out = along(truth)
    own = out.truths["/ground_truth/pose"]
    assert own == truth.between(int(own.t_ns[0]), int(own.t_ns[-1]))
    exact = out.truths[MOTION_TOPIC]
    np.testing.assert_array_equal(exact.t_ns, out.imu.t_ns)
    t = elapsed(out.imu)
    assert exact.v_w is not None
    np.testing.assert_allclose(exact.p_wb[:, 0], 1.5 * np.cos(2.0 * t), atol=1e-6)
    np.testing.assert_allclose(exact.v_w[:, 1], 3.0 * np.cos(2.0 * t), atol=1e-5)


def test_several_stretches_are_read_as_one_sensor() -> None:
    felts = [
        f
        for part in (resting(), turning())
        for f in simulated(recording(part), [], NONE, RATE_HZ, 0).motion.ideal_motions(400.0)
    ]
    second = replace(felts[1], t_s=felts[1].t_s + 10.0)
    stamps = [felts[0].t_s[::2], second.t_s[::2]]
    out = simulate_stretches([felts[0], second], stamps, [])
    assert isinstance(out, SensorSamples)
    np.testing.assert_array_equal(out.stamp_s, np.concatenate(stamps))
    np.testing.assert_allclose(out.gyro[:, 2], np.where(out.stamp_s < 8.0, 0.0, 2.0), atol=GYRO)


# ── the log and the command ──


@pytest.fixture(scope="module")
def trajectory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A circle with a 128 Hz IMU that reads nothing."""
    path = tmp_path_factory.mktemp("trajectory") / "circle.mcap"
    t_ns = START_NS + np.round(np.arange(700) * 1e9 / 128.0).astype(np.int64)
    imu = Imu(t_ns, np.zeros((700, 3)), np.zeros((700, 3)))
    write(replace(recording(circling()), imu=imu, metadata={"source": {"dataset": "made up"}}), path)
    return path


LEVER = '[[effect]]\nname = "lever_arm"\n[effect.parameters.x]\nvalue = 0.1\nunit = "m"\n'


def test_the_log_says_how_it_was_made(trajectory: Path, tmp_path: Path) -> None:
    (tmp_path / "physics.toml").write_text(LEVER)
    found = simulate(trajectory, tmp_path / "sim.mcap", physics=tmp_path / "physics.toml", noise="bmi160", seed=5)
    back = read(tmp_path / "sim.mcap")
    assert back.imu == found.recording.imu
    assert dict(back.truths) == dict(found.recording.truths)
    said = back.metadata["imutool"]
    assert said["command"] == "simulate"
    assert said["seed"] == "5"
    assert float(said["rate_hz"]) == 128.0  # as the log's own IMU
    assert json.loads(said["physics"])["effect"][0]["parameters"]["x"]["value"] == 0.1
    assert json.loads(said["noise"])["name"] == "bmi160"
    assert back.metadata["source"] == {"dataset": "made up"}
    assert back.name == "sim"


def test_poses_alone_are_enough(tmp_path: Path) -> None:
    truth = circling()
    with LogWriter(tmp_path / "poses.mcap") as log:
        channel = log.channel("/mocap/pose", schemas.POSE)
        payload = encode_pose(truth.t_ns, truth.p_wb, truth.q_wb_wxyz, frame_id="world")
        from imutool.mcap_io.write import Series, chunks

        series = Series(
            channel, truth.t_ns, (truth.t_ns, truth.p_wb, truth.q_wb_wxyz), lambda *c: encode_pose(*c, frame_id="w")
        )
        assert len(payload) == len(truth)
        for chunk in chunks([series]):
            log.chunk(chunk)
    found = simulate(tmp_path / "poses.mcap", tmp_path / "sim.mcap")
    assert found.settings["rate_hz"] == 200.0
    np.testing.assert_allclose(found.recording.imu.gyro[:, 2], 2.0, atol=GYRO)
    with pytest.raises(LogError, match="/nowhere"):
        simulate(tmp_path / "poses.mcap", tmp_path / "sim2.mcap", truth="/nowhere")
    assert not (tmp_path / "sim2.mcap").exists()


def test_a_log_without_poses_is_refused(tmp_path: Path, trajectory: Path) -> None:
    write(replace(read(trajectory), truths={}), tmp_path / "imu.mcap")
    with pytest.raises(LogError, match="no poses"):
        simulate(tmp_path / "imu.mcap", tmp_path / "sim.mcap")


def test_positions_that_no_body_follows_bring_a_remark() -> None:
    """Without an IMU next to them nothing else shows that they are in millimetres."""
    metres = circling()
    millimetres = replace(metres, p_wb=1e3 * metres.p_wb, v_w=None)
    for truth, said in ((metres, 0), (millimetres, 1)):
        remarks = simulated(recording(truth), [], NONE, RATE_HZ, 0).remarks
        assert len([remark for remark in remarks if "in metres?" in remark]) == said


def test_less_than_two_seconds_are_refused() -> None:
    with pytest.raises(DataError, match=r"1\.\d+ s of the motion can be trusted"):
        along(circling().rows(slice(0, 400)))


@pytest.mark.parametrize("rate_hz", [0.0, 9.0, 1e5, float("nan")])
def test_an_absurd_rate_is_refused(rate_hz: float) -> None:
    with pytest.raises(ConfigError, match="rate_hz: a rate of"):
        simulated(recording(circling()), [], NONE, rate_hz, 0)


def test_a_negative_seed_is_refused() -> None:
    with pytest.raises(ConfigError, match="seed -1"):
        simulated(recording(circling()), [], NONE, RATE_HZ, -1)


def test_the_trajectory_is_never_overwritten(trajectory: Path) -> None:
    before = trajectory.read_bytes()
    with pytest.raises(ConfigError, match="the trajectory itself"):
        simulate(trajectory, trajectory, overwrite=True)
    assert trajectory.read_bytes() == before


def test_a_missing_trajectory_is_told_alike_where_out_exists(tmp_path: Path) -> None:
    (tmp_path / "out.mcap").touch()
    with pytest.raises(ConfigError, match=r"none\.mcap: cannot be opened"):
        simulate(tmp_path / "none.mcap", tmp_path / "out.mcap", overwrite=True)


def test_the_command_reports_and_refuses(imutool: Run, trajectory: Path, tmp_path: Path) -> None:
    (tmp_path / "physics.toml").write_text(LEVER)
    done = imutool(
        "simulate", trajectory, "sim.mcap", "--physics", "physics.toml", "--rate", "100", "--json", "-", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["schema"] == "imutool.simulation/1"
    assert report["samples"] == len(read(tmp_path / "sim.mcap").imu)
    assert report["rate_hz"] == 100.0
    again = imutool("simulate", trajectory, "sim.mcap", cwd=tmp_path)
    assert again.returncode == 3
    assert "--overwrite" in again.stderr
    (tmp_path / "wrong.toml").write_text(LEVER.replace("lever_arm", "lever_arn"))
    wrong = imutool("simulate", trajectory, "other.mcap", "--physics", "wrong.toml", cwd=tmp_path)
    assert wrong.returncode == 3
    assert "Did you mean 'lever_arm'?" in wrong.stderr
    noise = imutool("simulate", trajectory, "other.mcap", "--noise", "adis1644", cwd=tmp_path)
    assert noise.returncode == 3
    assert "Did you mean adis16448?" in noise.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["physics.toml", "sim.mcap", "wrong.toml"]


def test_an_ideal_simulation_needs_no_file() -> None:
    assert PhysicsFile().acting() == []
