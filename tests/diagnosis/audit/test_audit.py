"""Wrong simulators are named by their fault, right ones are not accused; the motion is that of the bench, in closed form."""

from __future__ import annotations

import importlib
import json
import subprocess
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.benchmarks import benchmark
from support.report_schema import assert_valid
from support.seeds import seeds

from imutool.diagnosis.audit import audit, lines, simulator_faults, simulator_remarks
from imutool.diagnosis.audit.faults import FAULTS
from imutool.diagnosis.audit.motion import kinematic_fit, kinematics
from imutool.diagnosis.audit.motion_faults import motion_faults
from imutool.diagnosis.audit.noise import Expected, noise_faults
from imutool.diagnosis.audit.spectral_lines import spectral_lines
from imutool.diagnosis.diagnose import diagnose
from imutool.errors import DataError
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.encode import encode_imu, encode_transform
from imutool.mcap_io.file_writer import LogWriter
from imutool.mcap_io.write import Series, chunks, write
from imutool.noise.datasheet import Noise
from imutool.recording import Imu, Poses, Recording

bench = benchmark("audit")
DURATION_S = 16.0
Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.mark.parametrize("name", list(bench.FAULTS))
def test_a_fault_is_named_and_nothing_else(name: str) -> None:
    faults = simulator_faults(*bench.made(name, 5, 60.0 if name == "bias_never_walks" else DURATION_S))  # a walk takes time
    assert {fault.fault for fault in faults} == {name.partition(" ")[0]}


@pytest.mark.parametrize("seed", seeds(3))
def test_a_right_simulator_has_no_fault(seed: int) -> None:
    assert simulator_faults(*bench.made("null", seed, DURATION_S)) == []


@pytest.mark.parametrize(("step", "differences"), [(0.25, False), (1.0, True)])
def test_a_semi_implicit_integrator_makes_all_velocities_late_alike(step: float, differences: bool) -> None:
    """Only what the acceleration is late after the gyro is its own fault; `step` is in sample periods."""
    rng, period_s = np.random.default_rng(3), 1.0 / 240.0
    motion, t = bench.Motion.drawn(rng), np.arange(round(DURATION_S / period_s)) * period_s
    late_s = 0.5 * step * period_s  # of the velocities after the poses
    a_w = motion.position(t - late_s, 2)
    if differences:
        a_w = (motion.position(t - late_s, 1) - motion.position(t - late_s - period_s, 1)) / period_s
    samples = np.concatenate([motion.rate(t - late_s), motion.attitude(t).inv().apply(a_w - bench.G_W)], axis=1)
    samples += np.repeat([2e-3, 2e-2], 3) * rng.normal(size=samples.shape)
    faults = simulator_faults(bench._log(motion, t, samples), None, Noise())
    accused = {fault.signal: fault.parameters["delay"].value for fault in faults if fault.fault == "backward_difference"}
    assert len(accused) == len(faults)
    assert accused.get("accel", 0.0) == pytest.approx(0.5 * period_s * differences, rel=0.03)


@pytest.mark.parametrize("late", [0.2, -0.2, 0.1])
def test_a_delay_of_a_part_of_a_sample_period_is_a_step_of_the_physics(late: float) -> None:
    """It makes the attitude late, which no difference of rates or velocities does."""
    rng, period_s = np.random.default_rng(3), 1.0 / 200.0
    motion, t = bench.Motion.drawn(rng), np.arange(round(DURATION_S / period_s)) * period_s
    then = t - late * period_s
    samples = np.concatenate([motion.rate(then), motion.force(then)], axis=1)
    samples += np.repeat([1e-3, 1e-2], 3) * rng.normal(size=samples.shape)
    (fault,) = simulator_faults(bench._log(motion, t, samples), None, Noise())
    assert (fault.fault, fault.signal) == ("step_delay" if late > 0.0 else "early_stamps", "both")
    assert fault.parameters["delay"].value == pytest.approx(late * period_s, rel=0.03)


@pytest.mark.parametrize("frame", ["body", "world"])
def test_poses_without_positions_show_the_gyro_alone(tmp_path: Path, frame: str) -> None:
    """Zeros stand for the positions: a body that swings about a point a metre away would have a lever arm of a metre."""
    rng, period_s = np.random.default_rng(3), 1.0 / 200.0
    motion, t = bench.Motion.drawn(rng), np.arange(round(DURATION_S / period_s)) * period_s
    omega, arm = motion.rate(t), np.array([0.8, -0.6, 0.1])
    swing = np.cross(np.gradient(omega, t, axis=0), arm) + np.cross(omega, np.cross(omega, arm))
    rates = omega if frame == "body" else motion.attitude(t).apply(omega)
    samples = np.concatenate([rates, motion.attitude(t).inv().apply(-bench.G_W) + swing], axis=1)
    samples += np.repeat([1e-3, 1e-2], 3) * rng.normal(size=samples.shape)
    sim = bench._log(motion, t, samples)
    ((topic, poses),) = sim.truths.items()
    write(replace(sim, truths={topic: Poses(poses.t_ns, 0.0 * poses.p_wb, poses.q_wb_wxyz)}), tmp_path / "sim.mcap")
    report = audit(tmp_path / "sim.mcap")
    assert [(f.fault, f.signal) for f in report.faults] == ([("world_frame", "gyro")] if frame == "world" else [])
    assert report.not_tested["lever_arm"].startswith("the poses have no positions")
    assert "accel" not in report.unexplained


def test_what_poses_do_not_follow_is_no_lever_arm() -> None:
    """A foot that strikes the ground shakes the body about another point, faster than smoothed poses show."""
    sim, _, _ = bench.made("null", 5, DURATION_S)
    k = kinematics(sim)
    t_s = np.arange(len(k.t_s)) * k.period_s
    shaken = 30.0 * np.sin(2.0 * np.pi * 0.4 / k.period_s * t_s)[:, None] * np.array([1.0, -0.5, 0.7])
    fit = kinematic_fit(replace(k, alpha=k.alpha + shaken, accel=k.accel + np.cross(shaken, [0.05, 0.1, 0.0])))
    assert motion_faults(k, fit) == []


def test_a_body_that_lies_still_for_most_of_a_log_is_judged_by_its_motion() -> None:
    """An impact cuts the log: the longer part is rest."""
    rng, period_s = np.random.default_rng(8), 1.0 / 200.0
    motion = bench.Motion.drawn(rng)
    moving, rest = (np.arange(round(length_s / period_s)) * period_s for length_s in (12.0, 20.0))
    samples = np.concatenate([motion.attitude(moving).apply(motion.rate(moving)), motion.force(moving)], axis=1)
    end = motion.attitude(moving[-1:])
    still = np.tile(np.concatenate([np.zeros((1, 3)), end.inv().apply(-bench.G_W[None])], axis=1), (len(rest), 1))
    t_ns = (np.concatenate([moving, rest + moving[-1] + 0.5]) * 1e9).astype(np.int64)
    q = np.concatenate(
        [motion.attitude(moving).as_quat(scalar_first=True), np.tile(end.as_quat(scalar_first=True), (len(rest), 1))]
    )
    p = np.concatenate([motion.position(moving), np.tile(motion.position(moving[-1:]), (len(rest), 1))])
    values = np.concatenate([samples, still])
    values += np.repeat([1e-3, 1e-2], 3) * rng.normal(size=values.shape)
    imu = Imu(t_ns, np.ascontiguousarray(values[:, :3]), np.ascontiguousarray(values[:, 3:]))
    faults = simulator_faults(Recording("fallen", imu, truths={"/pose": Poses(t_ns, p, q)}), None, Noise())
    assert {fault.fault for fault in faults} == {"world_frame"}


@pytest.mark.parametrize(("share", "accused"), [(0.0, True), (0.5, False), (1.0, False)])
def test_a_bias_that_walks_less_than_the_data_sheet_says_does_walk(share: float, accused: bool) -> None:
    rng, rate_hz, density = np.random.default_rng(4), 100.0, 2e-3
    own, walk = density * np.sqrt(rate_hz), 8.0 * np.pi * density / 60.0
    white = own * rng.normal(size=(6000, 6))
    drift = share * walk / np.sqrt(rate_hz) * np.cumsum(rng.normal(size=white.shape), axis=0)
    imu = Imu((np.arange(6000) * 1e7).astype(np.int64), white[:, :3] + drift[:, :3], white[:, 3:] + drift[:, 3:])
    faults, _ = noise_faults(imu, white + drift, [Expected(np.full(6, density), np.full(6, density), np.full(6, walk))])
    assert {fault.fault for fault in faults} == ({"bias_never_walks"} if accused else set())


def test_a_diagnosis_says_what_the_simulation_does_wrong() -> None:
    sim, _, _ = bench.made("coordinate_acceleration", 2, DURATION_S)
    (remark,) = simulator_remarks(sim)
    assert remark == (
        "The simulation is wrong by itself: The accel reads the acceleration without gravity, not the specific force "
        "(coordinate_acceleration)"
    )
    assert simulator_remarks(replace(sim, truths={})) == []


def test_every_fault_cites_the_thread_of_a_simulator() -> None:
    assert all(fault.source.startswith("https://github.com/") and fault.equation for fault in FAULTS.values())


def test_the_command_says_the_fault_its_equation_and_its_source(tmp_path: Path, imutool: Command) -> None:
    sim, _, _ = bench.made("transport_term", 1, DURATION_S)
    write(sim, tmp_path / "sim.mcap")
    said = imutool("audit", "sim.mcap", cwd=tmp_path)
    assert said.stdout.startswith("1 fault of the simulator found:\n")
    assert "transport_term: The accel is the derivative of the velocity in the body frame" in said.stdout
    assert "they need a recording (--real)." in said.stdout
    report = json.loads(imutool("audit", "sim.mcap", "--json", "-", cwd=tmp_path).stdout)
    assert_valid(report)
    assert report["faults"][0]["parameters"]["missing"]["value"] == pytest.approx(1.0, abs=0.1)


def test_rest_repeats_no_samples_and_a_burst_is_no_line() -> None:
    t, rng = np.arange(6000) / 100.0, np.random.default_rng(4)
    moves = np.sin(2 * np.pi * 0.7 * np.maximum(t - 30.0, 0.0))[:, None] * np.ones(6)
    imu = Imu((t * 1e9).astype(np.int64), moves[:, :3], moves[:, 3:])
    assert noise_faults(imu, moves + 1e-3 * rng.normal(size=moves.shape), []) == ([], [])
    held = moves[np.arange(len(t)) // 2 * 2]
    faults, _ = noise_faults(Imu(imu.t_ns, held[:, :3], held[:, 3:]), held, [])
    assert [fault.fault for fault in faults] == ["repeated_samples"]
    burst = 0.01 * (np.sin(2 * np.pi * 31.0 * t) * np.exp(-((t - 40.0) ** 2) / 8.0))[:, None] * np.ones(6)
    shaken = burst + 1e-4 * rng.normal(size=burst.shape)
    assert spectral_lines(shaken, shaken, 100.0, np.zeros((len(t), 6)), 100.0) == []
    lasting = 0.01 * np.sin(2 * np.pi * 31.0 * t)[:, None] + 1e-4 * rng.normal(size=burst.shape)
    assert {line.cause for line in spectral_lines(lasting, lasting, 100.0, np.zeros((len(t), 6)), 100.0)} == {"sensor"}


@pytest.mark.parametrize("moves", [True, False])
def test_a_line_is_a_fault_where_the_body_does_not_move_with_it(moves: bool) -> None:
    """A rotor of 37 Hz: its force shakes the body, and the poses with it."""
    rng = np.random.default_rng(7)
    still, t = bench.Motion.drawn(rng), np.arange(16 * 200) / 200.0
    p = still.p.copy()
    p[0, :, 3], p[1, :, 3] = 1.0 / (2.0 * np.pi * 37.0) ** 2, 37.0
    shaken = bench.Motion(p, still.angles)
    samples = np.concatenate([shaken.rate(t), shaken.force(t)], axis=1)
    noise = np.repeat([1e-3, 1e-2], 3) * rng.normal(size=samples.shape)
    log = bench._log(shaken if moves else bench.Motion(p * (p[1] < 30.0), still.angles), t, samples + noise)
    assert {fault.fault for fault in simulator_faults(log, None, Noise())} == (set() if moves else {"step_lines"})


def test_poses_too_slow_to_show_a_line_leave_its_cause_open(tmp_path: Path) -> None:
    sim, _, _ = bench.made("step_lines", 5, DURATION_S)
    every = round(0.02 / sim.imu.period_s)
    slow = Poses(sim.truth.t_ns[::every], sim.truth.p_wb[::every], sim.truth.q_wb_wxyz[::every])
    write(replace(sim, truths={"/ground_truth/pose": slow}), tmp_path / "sim.mcap")
    report = audit(tmp_path / "sim.mcap")
    assert report.faults == ()
    assert "Hz (accel)" in report.not_tested["step_lines"]
    assert "step_lines" not in report.tested
    slower = Poses(slow.t_ns[::6], slow.p_wb[::6], slow.q_wb_wxyz[::6])
    write(replace(sim, truths={"/ground_truth/pose": slower}), tmp_path / "slower.mcap")
    with pytest.raises(DataError, match=r"slower\.mcap: no stretch of the"):
        audit(tmp_path / "slower.mcap")


@pytest.mark.parametrize(
    ("told", "spoil"),
    [
        ("are in mm and not in m", lambda poses: replace(poses, p_wb=1e3 * poses.p_wb)),
        ("have their w in the place of x", lambda poses: replace(poses, q_wb_wxyz=poses.q_wb_wxyz[:, [3, 0, 1, 2]])),
    ],
)
def test_poses_in_mm_or_with_misread_quaternions_are_no_fault_of_the_imu(
    told: str, spoil: Callable[[Poses], Poses], tmp_path: Path
) -> None:
    """Of those in mm it said that the accelerometer holds gravity alone, of these that it is left-handed and in the world."""
    sim, _, _ = bench.made("none", 1000, DURATION_S)
    write(replace(sim, truths={"/ground_truth/pose": spoil(sim.truth)}), tmp_path / "sim.mcap")
    with pytest.raises(DataError, match=f"{told}.*imutool convert LOG OUT --fix"):
        audit(tmp_path / "sim.mcap")


def test_gravity_left_out_is_found_in_the_plane_too() -> None:
    """There a bias would explain it as well."""
    sim, _, _ = bench.made("null", 3, DURATION_S)
    yaw = Rotation.from_quat(sim.truth.q_wb_wxyz, scalar_first=True).as_euler("ZYX")[:, 0]
    level = Poses(
        sim.truth.t_ns, sim.truth.p_wb * [1.0, 1.0, 0.0], Rotation.from_euler("Z", yaw[:, None]).as_quat(scalar_first=True)
    )
    k = kinematics(replace(sim, truths={"/pose": level}))
    coordinate = k.to_body(k.a_w)
    flat = replace(k, gyro=k.omega, accel=coordinate)
    assert {fault.fault for fault in motion_faults(flat, kinematic_fit(flat))} == {"coordinate_acceleration"}
    right = replace(flat, accel=coordinate + np.array([0.05, -0.1, 9.91]))
    assert motion_faults(right, kinematic_fit(right)) == []


def written(path: Path, sim: Recording, world: str, body: Poses, mount: Poses, topic: str = "/tf") -> None:
    """A simulator's log in ROS 2: its IMU, /tf of the body, /tf_static of the sensor."""
    with LogWriter(path) as log:
        imu = (sim.imu.t_ns, sim.imu.gyro, sim.imu.accel)
        series = [Series(log.channel("/imu", schemas.IMU), imu[0], imu, partial(encode_imu, frame_id="imu_link"))]
        for name, poses, frames in ((topic, body, (world, "base")), ("/tf_static", mount, ("base", "imu_link"))):
            encode = partial(encode_transform, frame_id=frames[0], child_frame_id=frames[1])
            columns = (poses.t_ns, poses.p_wb, poses.q_wb_wxyz)
            series.append(Series(log.channel(name, schemas.TF), poses.t_ns, columns, encode))
        for chunk in chunks(series):
            log.chunk(chunk)


@pytest.mark.parametrize(("world", "accused"), [("world", set()), ("odom_ned", set()), ("map", {"gravity_sign"})])
def test_poses_on_tf_a_stated_mount_and_a_world_named_ned_are_right(tmp_path: Path, world: str, accused: set[str]) -> None:
    sim, _, _ = bench.made("null", 3, DURATION_S)
    R_bs, arm = Rotation.from_euler("xyz", [170.0, 5.0, 90.0], degrees=True), np.array([0.1, -0.2, 0.05])
    R_wb = Rotation.from_quat(sim.truth.q_wb_wxyz, scalar_first=True) * R_bs.inv()
    p_wb, turned = sim.truth.p_wb - R_wb.apply(arm), Rotation.identity()
    if world != "world":
        turned = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    body = Poses(sim.truth.t_ns, turned.apply(p_wb), (turned * R_wb).as_quat(scalar_first=True))
    mount = Poses(sim.imu.t_ns[:1], arm[None], R_bs.as_quat(scalar_first=True)[None])
    written(tmp_path / "sim.mcap", sim, world, body, mount)
    report = audit(tmp_path / "sim.mcap")
    assert {fault.fault for fault in report.faults} == accused
    assert ("odom_ned" in "\n".join(lines(report))) == bool(accused)


def test_a_diagnosis_reads_the_simulation_as_the_audit_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its poses are those of the sensor, by the stated mount, in a world whose z is up."""
    sim, _, _ = bench.made("null", 3, DURATION_S)
    write(sim, tmp_path / "real.mcap")
    mount = Poses(sim.imu.t_ns[:1], np.array([[0.1, -0.2, 0.05]]), np.array([[1.0, 0.0, 0.0, 0.0]]))
    body = Poses(sim.truth.t_ns, sim.truth.p_wb, sim.truth.q_wb_wxyz)
    written(tmp_path / "sim.mcap", sim, "odom_ned", body, mount)
    given = list[Recording]()

    def aligned(recordings: object, simulated: Recording, *_: object) -> None:
        given.append(simulated)
        raise NotImplementedError

    module = importlib.import_module("imutool.diagnosis.diagnose")
    monkeypatch.setattr(module, "is_another_motion", lambda *_: False)
    monkeypatch.setattr(module, "align_all", aligned)
    with pytest.raises(NotImplementedError):
        diagnose([tmp_path / "real.mcap"], tmp_path / "sim.mcap")
    (simulated,) = given
    moved = Rotation.from_quat(sim.truth.q_wb_wxyz, scalar_first=True).apply([0.1, -0.2, 0.05]) + sim.truth.p_wb
    assert np.allclose(simulated.truth.p_wb, moved[:, [1, 0, 2]] * [1.0, 1.0, -1.0])


def test_a_recordings_stated_mount_moves_its_poses_and_is_what_the_simulation_lacks(tmp_path: Path) -> None:
    sim, _, _ = bench.made("null", 3, DURATION_S)
    R_bs, arm = Rotation.from_euler("xyz", [40.0, 5.0, 70.0], degrees=True), np.array([0.1, -0.2, 0.05])
    R_wb = Rotation.from_quat(sim.truth.q_wb_wxyz, scalar_first=True) * R_bs.inv()
    body = Poses(sim.truth.t_ns, sim.truth.p_wb - R_wb.apply(arm), R_wb.as_quat(scalar_first=True))
    mount = Poses(sim.imu.t_ns[:1], arm[None], R_bs.as_quat(scalar_first=True)[None])
    write(sim, tmp_path / "sim.mcap")
    written(tmp_path / "real.mcap", sim, "world", body, mount, "/ground_truth/tf")
    (fault,) = audit(tmp_path / "sim.mcap", tmp_path / "real.mcap").faults
    assert fault.fault == "body_centre"
    found = np.array([fault.parameters[axis].value for axis in "xyz"])
    assert np.allclose(found, R_bs.inv().apply(arm), atol=0.01)
