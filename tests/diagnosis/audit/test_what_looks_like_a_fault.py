"""What looks like a fault of a simulator: impacts, digits, filters, folded motion; units, delays without noise."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, sosfilt, sosfilt_zi
from scipy.spatial.transform import Rotation
from support.benchmarks import benchmark

from imutool.config import build
from imutool.diagnosis.audit import audit, lines, motion, simulator_faults
from imutool.diagnosis.audit.axes import Matrix
from imutool.diagnosis.audit.bandwidth import max_filter_delay
from imutool.diagnosis.audit.faults import clear
from imutool.diagnosis.audit.motion import kinematic_fit, kinematics
from imutool.diagnosis.audit.motion_faults import timing_faults
from imutool.diagnosis.audit.noise import Expected, fast_noise, noise_faults
from imutool.diagnosis.result import Estimate
from imutool.mcap_io.write import write
from imutool.noise.datasheet import Noise
from imutool.recording import Imu
from imutool.units import SENSORS

bench = benchmark("audit")
DURATION_S = 16.0


@pytest.mark.parametrize(("gyro", "accel"), [(180.0 / np.pi, 1.0), (1.0, 1.0 / 9.80665), (180.0 / np.pi, 1.0 / 9.80665)])
def test_another_unit_is_named_and_then_the_rest_is_judged(gyro: float, accel: float) -> None:
    sim, _, _ = bench.made("transport_term", 5, DURATION_S)
    imu = replace(sim.imu, gyro=sim.imu.gyro * gyro, accel=sim.imu.accel * accel)
    faults = simulator_faults(replace(sim, imu=imu), None, Noise())
    scales = {fault.signal: fault.parameters["scale"].value for fault in faults if fault.fault == "wrong_unit"}
    assert scales == pytest.approx({s: by for s, by in (("gyro", gyro), ("accel", accel)) if by != 1.0})
    assert {fault.fault for fault in faults} == {"wrong_unit", "transport_term"}


def test_a_motionless_sensor_has_no_wrong_unit() -> None:
    sim, _, _ = bench.made("null", 5, DURATION_S)
    dead = replace(sim.imu, gyro=np.zeros_like(sim.imu.gyro), accel=np.zeros_like(sim.imu.accel))
    assert "wrong_unit" not in {fault.fault for fault in simulator_faults(replace(sim, imu=dead), None, Noise())}


@pytest.mark.parametrize("rate_hz", [200.0, 500.0])
def test_feet_that_strike_the_ground_are_no_noise(rate_hz: float) -> None:
    """Shocks at 55 Hz, two a second, that ring for 12 ms."""
    t, rng = np.arange(round(40.0 * rate_hz)) / rate_hz, np.random.default_rng(3)
    since = t % 0.5
    shocks = 8.0 * np.exp(-since / 0.012) * np.sin(2.0 * np.pi * 55.0 * since)
    x = shocks[:, None] + 0.02 * rng.normal(size=(len(t), 3))
    assert fast_noise(x, rate_hz) == pytest.approx(0.02 * np.ones(3), rel=0.15)


def test_digits_are_no_noise_density() -> None:
    """They add up to LSB / sqrt(12) to what a recording reads."""
    rng, lsb = np.random.default_rng(3), 3.5
    sim, real = rng.normal(size=(2, 6000, 6)) + 30.0 * np.sin(np.arange(6000) * 1e-2)[:, None]
    t_ns = (np.arange(6000) * 1e7).astype(np.int64)
    held = lsb * np.round(real / lsb)
    expected = Expected.of_recording(Imu(t_ns, np.ascontiguousarray(held[:, :3]), np.ascontiguousarray(held[:, 3:])))
    imu = Imu(t_ns, np.ascontiguousarray(sim[:, :3]), np.ascontiguousarray(sim[:, 3:]))
    faults, _ = noise_faults(imu, sim - 30.0 * np.sin(np.arange(6000) * 1e-2)[:, None], [expected])
    assert {fault.fault for fault in faults} == {"digits_absent"}


def test_a_noise_that_contradicts_sheet_and_recording_is_one_fault() -> None:
    sim, real = np.array([1.0, 3.0])[:, None, None] * np.random.default_rng(3).normal(size=(2, 6000, 6))
    t_ns = (np.arange(6000) * 1e7).astype(np.int64)
    references = [
        Expected(np.full(6, 0.2), np.full(6, 0.2), np.full(6, np.nan)),
        Expected.of_recording(Imu(t_ns, real[:, :3].copy(), real[:, 3:].copy())),
    ]
    faults, _ = noise_faults(Imu(t_ns, sim[:, :3].copy(), sim[:, 3:].copy()), sim, references)
    assert [(fault.fault, fault.signal) for fault in faults] == [("noise_density", "gyro"), ("noise_density", "accel")]
    assert [fault.parameters["expected"].value for fault in faults] == pytest.approx([3.0, 3.0], rel=0.05)


@pytest.mark.parametrize(("own", "vibration", "accused"), [(0.3, 1.0, False), (0.3, 0.0, True), (2.0, 1.0, True)])
def test_a_recording_that_vibrates_in_flight_refutes_no_smaller_noise(own: float, vibration: float, accused: bool) -> None:
    """Its calmest second shows at most the sensor's noise; a noise larger than in flight is refuted all the same."""
    rng, t_ns = np.random.default_rng(3), (np.arange(8000) * 5e6).astype(np.int64)
    flies = np.arange(8000) > 600
    level = np.where(flies, 1.0, 1.0 - 0.6 * vibration)[:, None]  # motors idle at first
    sim, real = own * rng.normal(size=(8000, 6)), level * rng.normal(size=(8000, 6))
    expected = Expected.of_recording(Imu(t_ns, real[:, :3].copy(), real[:, 3:].copy()))
    faults, _ = noise_faults(Imu(t_ns, sim[:, :3].copy(), sim[:, 3:].copy()), sim, [expected])
    assert {fault.fault for fault in faults} == ({"noise_density"} if accused else set())
    assert [expected.varies(sensor) for sensor in SENSORS] == [vibration > 0.0] * 2


def test_an_audit_says_that_a_vibrating_recording_leaves_the_noise_open(tmp_path: Path) -> None:
    sim, _, _ = bench.made("null", 5, DURATION_S)
    flies = (np.arange(len(sim.imu)) > 600)[:, None]
    shaking = 0.05 * flies * np.random.default_rng(1).normal(size=(len(sim.imu), 3))
    write(sim, tmp_path / "sim.mcap")
    write(replace(sim, imu=replace(sim.imu, gyro=sim.imu.gyro + shaking)), tmp_path / "real.mcap")
    report = audit(tmp_path / "sim.mcap", tmp_path / "real.mcap")
    assert "noise_density" not in report.tested
    assert "gyro varies" in report.not_tested["noise_density"]


def test_a_frame_is_told_by_what_the_poses_follow() -> None:
    """A shaking above their band is as large as gravity, and a body that hardly leans shows its frame by a tenth of it."""
    rng, period_s = np.random.default_rng(3), 1.0 / 200.0
    motion = bench.Motion.drawn(rng)
    motion.angles[0, 1:] *= 0.05
    t = np.arange(round(DURATION_S / period_s)) * period_s
    shocks = 15.0 * np.sin(2.0 * np.pi * 71.0 * t)[:, None]
    force = motion.attitude(t).apply(motion.force(t)) + shocks
    samples = np.concatenate([motion.rate(t), force], axis=1) + np.repeat([1e-3, 1e-2], 3) * rng.normal(size=(len(t), 6))
    faults = simulator_faults(bench._log(motion, t, samples), None, Noise())
    assert ("world_frame", "accel") in {(fault.fault, fault.signal) for fault in faults}
    assert "coordinate_acceleration" not in {fault.fault for fault in faults}


def test_a_motion_beyond_half_of_the_rate_folds_and_is_no_line_of_the_sensor() -> None:
    """A thrust that is held: 163 Hz, read at 200 Hz, is a line at 37 Hz; the poses' 250 Hz fold it to 87 Hz."""
    lines = importlib.import_module("imutool.diagnosis.audit.spectral_lines")
    rng, f = np.random.default_rng(7), 163.0
    t, pose_t = np.arange(8000) / 200.0, np.arange(10000) / 250.0
    line = 0.3 * np.sin(2.0 * np.pi * f * t)[:, None] * np.ones(6)
    samples = line + 0.01 * rng.normal(size=line.shape)
    size = 0.3 * np.array([np.sinc(f / 250.0)] * 3 + [np.sinc(f / 250.0) ** 2] * 3)
    shown = np.sin(2.0 * np.pi * f * pose_t)[:, None] * size + 1e-4 * rng.normal(size=(len(pose_t), 6))
    assert lines.spectral_lines(samples, samples, 200.0, shown, 250.0) == []
    still = 1e-4 * rng.normal(size=shown.shape)
    assert {found.cause for found in lines.spectral_lines(samples, samples, 200.0, still, 250.0)} == {"sensor"}


@pytest.mark.parametrize(("order", "cut"), [(1, 0.2), (2, 0.12), (2, 0.2), (4, 0.2)])
def test_a_filter_that_the_noise_shows_may_be_late(order: int, cut: float) -> None:
    """A right simulator of a sensor of finite bandwidth is late by its filter, which is no step."""
    sim, _, _ = bench.made("null", 5, DURATION_S)
    samples = np.concatenate([sim.imu.gyro, sim.imu.accel], axis=1)
    samples += np.repeat([2e-3, 2e-2], 3) * np.random.default_rng(1).normal(size=samples.shape)
    low = sosfilt(butter(order, 2.0 * cut, output="sos"), samples - samples[0], axis=0) + samples[0]
    imu = Imu(sim.imu.t_ns, np.ascontiguousarray(low[:, :3]), np.ascontiguousarray(low[:, 3:]))
    assert simulator_faults(replace(sim, imu=imu), None, Noise()) == []
    rate_hz = 1.0 / sim.imu.period_s
    sheet = build(Noise, {f"{s}_density": (float(std / np.sqrt(rate_hz)),) * 3 for s, std in (("gyro", 2e-3), ("accel", 2e-2))})
    assert simulator_faults(replace(sim, imu=imu), None, sheet) == []
    white = np.random.default_rng(2).normal(size=(4000, 3))
    assert max_filter_delay(white, white) == 0.0


def test_what_grows_with_the_frequency_is_an_error_of_the_curve() -> None:
    """A delay is the same at every frequency; what grows with its square is what smoothing takes."""
    sim, _, _ = bench.made("null", 5, 60.0)
    k = replace(kinematics(sim), band_hz=12.0)
    k = replace(k, omega=k.omega + np.sin(2.0 * np.pi * np.array([7.0, 8.0, 9.0]) * k.t_s[:, None]))
    force = k.to_body(k.a_w + np.array([0.0, 0.0, 9.81]))
    turn = np.cross(k.omega, force)
    grows = -np.gradient(np.gradient(turn, k.period_s, axis=0), k.period_s, axis=0) / (2.0 * np.pi * 8.0) ** 2
    exact = replace(k, gyro=k.omega, accel=force + 1e-3 * np.random.default_rng(1).normal(size=force.shape))
    wrong = replace(exact, accel=exact.accel + 0.5 * k.period_s * grows)
    assert not clear(kinematic_fit(wrong).estimates["tau_f"])
    late = replace(exact, accel=exact.accel + 0.5 * k.period_s * turn)
    assert kinematic_fit(late).estimates["tau_f"].value == pytest.approx(0.5 * k.period_s, rel=0.05)


@pytest.mark.parametrize(
    ("periods", "accused"),
    [
        ({"tau_g": (0.0, 1e-3), "tau_a": (0.01, 0.04), "tau_f": (-0.42, 0.066)}, set()),  # an attitude alone is not late
        ({"tau_g": (0.51, 0.006), "tau_a": (-0.31, 0.04), "tau_f": (-0.02, 0.05)}, {("backward_difference", "gyro")}),
        ({"tau_g": (0.25, 1e-3), "tau_a": (0.747, 3e-3), "tau_f": (2e-3, 3e-3)}, {("backward_difference", "accel")}),
        ({"tau_g": (1.0, 1e-3), "tau_a": (1.0, 0.01), "tau_f": (0.9, 0.1)}, {("step_delay", "both")}),
        (
            {"tau_g": (0.0, 1e-3), "tau_a": (1.0, 1e-3), "tau_f": (2e-3, 3e-3)},
            {("backward_difference", "accel")},
        ),  # of positions
    ],
)
def test_delays_of_gyro_acceleration_and_attitude_are_weighed_together(
    periods: Mapping[str, tuple[float, float]], accused: set[tuple[str, str]]
) -> None:
    estimates = {name: Estimate(0.01 * value, 0.01 * std, "s") for name, (value, std) in periods.items()}
    assert {(fault.fault, fault.signal) for fault in timing_faults(estimates, 0.01, (0.0, 0.0))} == accused


@pytest.mark.parametrize(("fault", "steps"), [("step_delay", 1.0), ("step_delay", 4.0), ("backward_difference", 0.5)])
def test_a_delay_is_named_where_a_simulator_has_no_noise(fault: str, steps: float) -> None:
    """What a delay left of a motion was taken for the noise of a filter, and the delay for that of the filter."""
    motion, period_s = bench.Motion.drawn(np.random.default_rng(5)), 1.0 / 400.0
    t = np.arange(round(DURATION_S / period_s)) * period_s
    gyro, accel = motion.rate(t - steps * period_s), motion.force(t - steps * period_s)
    if fault == "backward_difference":
        gyro, accel = (motion.attitude(t - period_s).inv() * motion.attitude(t)).as_rotvec() / period_s, motion.force(t)
    (found,) = simulator_faults(bench._log(motion, t, np.concatenate([gyro, accel], axis=1)), None, Noise())
    assert found.fault == fault
    assert found.parameters["delay"].value == pytest.approx(steps * period_s, rel=0.02)


def test_a_filter_is_no_delay_with_noise_or_without() -> None:
    motion, t = bench.Motion.drawn(np.random.default_rng(3)), np.arange(8000) / 400.0
    ideal = np.concatenate([motion.rate(t), motion.force(t)], axis=1)
    sos = butter(2, 20.0, fs=400.0, output="sos")
    for noise in (0.0, 1.0):
        samples = ideal + noise * np.repeat([2e-3, 2e-2], 3) * np.random.default_rng(4).normal(size=ideal.shape)
        filtered, _ = sosfilt(sos, samples, axis=0, zi=sosfilt_zi(sos)[:, :, None] * samples[0])
        assert simulator_faults(bench._log(motion, t, filtered), None, Noise()) == []


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_motion_that_is_not_that_of_the_poses_is_told(sensor: str, tmp_path: Path) -> None:
    """It is no fault with a name, and was no fault at all."""
    motion, t = bench.Motion.drawn(np.random.default_rng(3)), np.arange(3200) / 200.0
    gyro, accel = motion.rate(t), motion.force(t)
    gyro, accel = (1.4 * gyro, accel) if sensor == "gyro" else (gyro, accel + np.abs(motion.force(t, 0.0)))
    write(bench._log(motion, t, np.concatenate([gyro, accel], axis=1)), tmp_path / "sim.mcap")
    report = audit(tmp_path / "sim.mcap")
    assert (report.faults, list(report.unexplained)) == ((), [sensor])
    assert any(f"the motion that the {sensor} reads differs by" in line for line in lines(report))


TURN_RAD = (0.15, -0.1, 0.2)
TURN = Rotation.from_rotvec(TURN_RAD).as_matrix()


@pytest.mark.parametrize(
    ("scale", "gravity", "axes", "expected"),
    [
        (1.3, 1.0, TURN, {("other_clock", "both"), ("turned_axes", "gyro"), ("turned_axes", "accel")}),
        (1.0, -1.0, TURN, {("gravity_sign", "accel"), ("turned_axes", "gyro"), ("turned_axes", "accel")}),
        (1.3, 2.0, np.eye(3), {("other_clock", "both"), ("gravity_doubled", "accel")}),
        (
            1.0,
            1.0,
            TURN @ np.diag([1.0, -1.0, 1.0]),
            {("left_handed", "both"), ("turned_axes", "gyro"), ("turned_axes", "accel")},
        ),
    ],
)
def test_two_faults_of_axes_clock_and_gravity_are_both_named(
    scale: float, gravity: float, axes: Matrix, expected: set[tuple[str, str]]
) -> None:
    motion, t = bench.Motion.drawn(np.random.default_rng(5)), np.arange(3200) / 200.0
    force = scale**2 * motion.force(t, 0.0) + motion.force(t, gravity) - motion.force(t, 0.0)
    samples = np.concatenate([scale * motion.rate(t) @ axes.T, force @ axes.T], axis=1)
    faults = simulator_faults(bench._log(motion, t, samples), None, Noise())
    assert {(fault.fault, fault.signal) for fault in faults} == expected
    turns = [[fault.parameters[axis].value for axis in "xyz"] for fault in faults if fault.fault == "turned_axes"]
    assert turns == [pytest.approx(TURN_RAD, abs=0.01)] * len(turns)


def test_the_deviation_of_a_turn_knows_what_holds_it_back() -> None:
    """Without noise it was a thousandth of the error."""
    motion, t = bench.Motion.drawn(np.random.default_rng(5)), np.arange(3200) / 200.0
    samples = np.concatenate([motion.rate(t) @ TURN.T, motion.force(t) @ TURN.T], axis=1)
    faults = simulator_faults(bench._log(motion, t, samples), None, Noise())
    assert faults
    for fault in faults:
        off = [abs(fault.parameters[a].value - true) / fault.parameters[a].std for a, true in zip("xyz", TURN_RAD, strict=True)]
        assert max(off) < 4.0


@pytest.mark.parametrize(("seed", "turns", "moves"), [(7, 1.0, 0.02), (6, 1.0, 0.02), (6, 0.3, 0.05)])
def test_misalignment_is_no_lever_arm_and_a_planar_motion_shows_no_turn(seed: int, turns: float, moves: float) -> None:
    rng, t = np.random.default_rng(seed), np.arange(3200) / 100.0
    motion = bench.Motion.drawn(rng)
    motion.angles[0] *= 0.3
    motion.angles[1] *= turns
    motion.p[0] *= moves
    small = Rotation.from_rotvec([0.02, 0.025, -0.02]).as_matrix() @ np.diag([1.02, 0.98, 1.01])
    noise = np.repeat([1e-3, 1e-2], 3) * rng.normal(size=(len(t), 6))
    samples = np.concatenate([motion.rate(t), motion.force(t) @ small.T], axis=1) + noise
    assert simulator_faults(bench._log(motion, t, samples), None, Noise()) == []
    motion.angles[0, 1:] = motion.p[0, 2] = 0.0
    gyro = motion.rate(t) @ Rotation.from_rotvec([0.02, 0.025, 0.0]).as_matrix().T
    sim = bench._log(motion, t, np.concatenate([gyro, motion.force(t)], axis=1))
    assert simulator_faults(sim, None, Noise()) == []


def test_digits_of_a_slow_motion_repeat_no_samples() -> None:
    t = np.arange(6000) / 200.0
    slow = np.sin(0.3 * t)[:, None] * np.ones(6)
    x = 5e-3 * np.round(slow / 5e-3)
    imu = Imu((t * 1e9).astype(np.int64), np.ascontiguousarray(x[:, :3]), np.ascontiguousarray(x[:, 3:]))
    assert noise_faults(imu, x - slow, []) == ([], [])


def test_a_band_that_holds_next_to_nothing_contradicts_no_two_that_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a quadruped that trots the slowest held one line, and told 8.6 ms of the acceleration: stamps were called early."""
    k = kinematics(bench.made("null", 5, DURATION_S)[0])
    bands = iter([(-2e-4, 1e-4), (0.0, 4e-5), (-8.6e-3, 8e-4)])
    monkeypatch.setattr(motion, "_in_band", lambda *_: tuple(np.full(4, value) for value in next(bands)))
    (tau,), (std,), _ = motion._solved(k, k.accel, k.j_w[:, :, None], np.zeros(1), np.zeros((len(k.t_s), 3, 0)))
    assert abs(tau) < 3.0 * std < 1e-3
