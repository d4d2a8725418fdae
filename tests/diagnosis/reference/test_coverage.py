"""A simulation along the recording's own measured poses is no better a reference than these poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from imutool.cleaning.rules.axes import TO_Z_UP
from imutool.diagnosis.compare_findings import is_of_simulation
from imutool.diagnosis.diagnose import candidates_for, diagnose
from imutool.diagnosis.estimation import timestamps
from imutool.diagnosis.estimation.jacobians import expected
from imutool.diagnosis.estimation.noise_estimate import whitened
from imutool.diagnosis.reference.conventions import with_common_conventions
from imutool.diagnosis.reference.coverage import align, align_all
from imutool.diagnosis.reference.taken_samples import batched, filled, new_samples, repeats
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.mcap_io.write import write
from imutool.noise import datasheet
from imutool.recording import GRAVITY_M_S2, Imu, Poses, Recording
from imutool.sensor.made_up_flight import flight
from imutool.sensor.simulate import TRUTH_TOPIC, simulated

DURATION_S, RATE_HZ = 40.0, 100.0
HELD_LEAVES = 1.1  # of what the whole simulation leaves: its noise is filtered out of half of the samples
MEASURED, EXACT = 1e-4, 0.0  # rad and m of a pose


def made(noise: float) -> Recording:
    """Flight whose poses have some noise."""
    return flight(4, duration_s=DURATION_S, rate_hz=RATE_HZ, truth_noise_rad=noise, truth_noise_m=noise)


def along(real: Recording, seed: int = 0) -> Recording:
    """Simulation along its poses."""
    return simulated(real, (), datasheet.read("adis16448"), RATE_HZ, seed).recording


def band_hz(real: Recording, sim: Recording) -> float | None:
    (pair,) = align(real, sim, None, DiagnoseSettings())
    assert pair.exact == (pair.band_hz is None)
    return pair.band_hz


def test_it_is_trusted_as_far_as_the_poses_are() -> None:
    real = made(MEASURED)
    (alone,) = align(real, None, None, DiagnoseSettings())
    assert alone.band_hz is not None
    assert band_hz(real, along(real)) == pytest.approx(alone.band_hz)
    assert band_hz(real, along(replace(real, truths={"/vicon": real.truth}))) == pytest.approx(alone.band_hz)


def test_orientations_alone_say_nothing_of_the_accelerometer() -> None:
    real = made(MEASURED)
    turned = replace(real.truth, p_wb=np.zeros_like(real.truth.p_wb), v_w=None)
    pairs, _ = align_all([replace(real, truths={TRUTH_TOPIC: turned})], None, None, DiagnoseSettings())
    assert [pair.axes.tolist() for pair in pairs] == [[True] * 3 + [False] * 3]


def test_of_recordings_that_are_too_long_together_the_first_parts_are_compared() -> None:
    """A diagnosis takes kilobytes for each sample, so that hours would take the memory of the machine."""
    real, settings = made(EXACT), DiagnoseSettings()
    half = msgspec.structs.replace(settings, alignment=msgspec.structs.replace(settings.alignment, max_samples=len(real.imu)))
    pairs, remarks = align_all([real, replace(real, name="again")], along(real), None, half)
    assert [float(pair.stamp_s[-1] - pair.stamp_s[0]) for pair in pairs] == pytest.approx([DURATION_S / 2] * 2, abs=0.2)
    assert {pair.log_start_ns for pair in pairs} == {int(real.imu.t_ns[0])}
    assert [remark.split(";")[0] for remark in remarks] == [
        f"{name}: only the first {DURATION_S / 2:.0f} s of {DURATION_S:.0f} s were compared" for name in (real.name, "again")
    ]
    (whole,), none = align_all([real], along(real), None, half)
    assert none == []
    assert len(whole.real) > 1.9 * len(pairs[0].real)


def test_a_bad_stretch_of_the_poses_says_nothing_of_the_others() -> None:
    real = made(MEASURED)
    poses = real.truth
    since_s = (poses.t_ns - poses.t_ns[0]) * 1e-9
    short = (since_s > 18.0) & (since_s < 20.0)
    shaken = poses.p_wb + short[:, None] * 0.05 * np.random.default_rng(2).normal(size=poses.p_wb.shape)
    seen = (since_s < 16.0) | short | (since_s > 22.0)
    real = replace(real, truths={TRUTH_TOPIC: replace(poses, p_wb=shaken).rows(seen)})
    bands = [[pair.band_hz for pair in align(real, sim, None, DiagnoseSettings())] for sim in (None, along(real))]
    assert len(bands[0]) == 2
    assert bands[1] == pytest.approx(bands[0])


def test_one_along_other_or_exact_poses_is_trusted_throughout() -> None:
    real = made(MEASURED)
    sim = along(real)
    moved = replace(sim.truth, p_wb=sim.truth.p_wb + MEASURED * np.random.default_rng(1).normal(size=sim.truth.p_wb.shape))
    assert band_hz(real, replace(sim, truths={TRUTH_TOPIC: moved})) is None
    exact = made(EXACT)
    assert band_hz(exact, along(exact)) is None
    assert band_hz(along(real, seed=1), sim) is None, "two simulations along one path"
    assert band_hz(replace(real, truths={}), sim) is None


def test_errors_of_its_poses_are_no_physics(tmp_path: Path) -> None:
    """In full band the poses' noise was a resonance of the mount at 4.6 Hz, and hid the accelerometer's scale."""
    real, sim = tmp_path / "real.mcap", tmp_path / "sim.mcap"
    recording = flight(2, duration_s=20.0, rate_hz=RATE_HZ)
    write(recording, real)
    write(simulated(recording, (), datasheet.read("none"), RATE_HZ, 1).recording, sim)
    found, alone = diagnose([real], sim), diagnose([real])
    assert {one.effect for one in found.findings} == {one.effect for one in alone.findings}
    assert {"gyro_scale", "gyro_misalignment", "accel_scale"} <= {one.effect for one in found.findings}
    assert {one.effect for one in found.findings}.isdisjoint({"mount_resonance", "lever_arm", "size_effect"})
    assert any("follows the recording's own poses" in remark for remark in found.remarks)
    assert all(closer.by == "second simulation" for closer in found.closer.values())


def test_splines_through_poses_take_nothing_of_a_motion_in_their_band() -> None:
    """Of what moves near its edge they took 0.5 per cent, which a quiet accelerometer tells from nothing."""
    rng, t_s = np.random.default_rng(0), np.arange(0.0, 120.0, 0.01)
    w, phase = 2.0 * np.pi * rng.uniform(0.1, 2.5, 60), rng.uniform(0.0, 2.0 * np.pi, 60)  # a boat in a chop
    heave = 0.2 * rng.normal(size=60) / (1.0 + w**2)
    wave, t_ns = np.sin(w * t_s[:, None] + phase), np.round(t_s * 1e9).astype(np.int64)
    accel = -wave @ (w**2 * heave)
    p_wb = np.outer(wave @ heave, [0.0, 0.0, 1.0]) + 2e-4 * rng.normal(size=(len(t_s), 3))
    turned = Rotation.from_rotvec(np.outer(wave @ heave[::-1], [1.0, 0.0, 0.0]))  # so that rotations are no smoother
    sensed = turned.inv().apply(np.outer(accel + GRAVITY_M_S2, [0.0, 0.0, 1.0]))
    measured = turned * Rotation.from_rotvec(4e-4 * rng.normal(size=(len(t_s), 3)))
    poses = Poses(t_ns, p_wb, measured.as_quat(scalar_first=True))
    real = Recording("boat", Imu(t_ns, np.zeros((len(t_s), 3)), sensed), truths={TRUTH_TOPIC: poses})
    (pair,) = align(real, None, None, DiagnoseSettings())
    assert pair.band_hz is not None
    band = butter(4, [0.8 * pair.band_hz, pair.band_hz], "bandpass", fs=100.0, output="sos")
    z = np.interp(pair.ideal.t_s, t_s, sensed[:, 2])
    one, other = (sosfiltfilt(band, x - GRAVITY_M_S2)[500:-500] for x in (z, pair.ideal.accel[:, 2]))
    assert one @ other / (one @ one) == pytest.approx(1.0, abs=3.5e-3)


@pytest.mark.parametrize("slow", [("gyro",), ("gyro", "accel")])
@pytest.mark.parametrize("times", [2, 3])
def test_a_topic_that_is_faster_than_its_sensor_is_read_at_the_rate_of_the_sensor(slow: tuple[str, ...], times: int) -> None:
    """A reading that is held is late by half of the samples that it is held for, which looks like a low-pass."""
    real = made(EXACT)
    imu, sim = along(real, 1).imu, along(real)
    last = np.arange(len(imu)) // times * times
    held = replace(imu, **{sensor: getattr(imu, sensor)[last] for sensor in slow})
    (pair,), remarks = align_all([replace(real, imu=held)], sim, None, DiagnoseSettings())
    assert pair.period_s == pytest.approx(times * imu.period_s)
    np.testing.assert_array_equal(pair.real[:, 3:], imu.accel[::times][: len(pair.real)])
    assert f"{np.count_nonzero(last != np.arange(len(imu)))} samples repeat gyro or accel of the one before" in remarks[0]
    stuck = imu.gyro.copy()
    stuck[1000:] = stuck[999]
    assert len(new_samples(replace(real, imu=replace(imu, gyro=stuck))).imu) == len(imu)


def test_a_simulation_that_holds_its_samples_is_read_where_its_physics_steps() -> None:
    """A simulation that is held for two samples is late by half of one, which looked like a clock and a mount."""
    real = made(EXACT)
    sim, recorded = along(real), replace(real, imu=along(real, 1).imu)
    last = np.arange(len(sim.imu)) // 2 * 2
    held = replace(sim, imu=replace(sim.imu, gyro=sim.imu.gyro[last], accel=sim.imu.accel[last]), truths={})
    (pair,), remarks = align_all([recorded], held, None, DiagnoseSettings())
    (whole,), none = align_all([recorded], replace(sim, truths={}), None, DiagnoseSettings())
    assert none == []
    assert f"{np.count_nonzero(last != np.arange(len(last)))} samples repeat gyro or accel of the one before" in remarks[0]
    left, minimum = ((one.real - expected(one, ()))[100:-100].std(axis=0) for one in (pair, whole))
    assert (left < HELD_LEAVES * minimum).all()


@pytest.mark.parametrize("turn", TO_Z_UP.values())
def test_poses_of_a_world_with_another_axis_up_are_turned(turn: np.ndarray) -> None:
    real = made(EXACT)
    real, poses, other = replace(real, imu=along(real, 1).imu), real.truth, Rotation.from_matrix(turn.T)
    q_wb = (other * Rotation.from_quat(poses.q_wb_wxyz.copy(), scalar_first=True)).as_quat(scalar_first=True)
    turned = replace(real, truths={TRUTH_TOPIC: Poses(poses.t_ns, poses.p_wb @ turn, q_wb)})
    ((pair,), _), ((same,), _) = (align_all([one], None, None, DiagnoseSettings()) for one in (turned, real))
    assert np.abs(expected(pair, ()) - expected(same, ())).max() < 0.01


def test_units_are_told_beside_the_poses_of_the_recording_too() -> None:
    real = made(EXACT)
    imu = along(real, 1).imu
    other = replace(real, imu=replace(imu, gyro=np.degrees(imu.gyro), accel=imu.accel / 9.80665))
    pairs, _ = align_all([other], None, None, DiagnoseSettings())
    (after,), found = with_common_conventions(pairs, "poses")
    assert [(one.effect, one.equation) for one in found] == [
        ("wrong_unit", "gyro = 57.2958 gyro of the poses"),
        ("wrong_unit", "accel = 0.101972 accel of the poses"),
    ]
    assert np.abs(after.real - expected(after, ())).max() < 1.0


def test_a_simulation_that_is_the_recording_itself_differs_by_what_was_added_to_it_alone() -> None:
    """Its digits and the jitter of its stamps set neither apart, though no noise hides them."""
    real = made(EXACT)
    imu, lsb = along(real, 1).imu, 1e-3
    t_ns = imu.t_ns + np.round(np.random.default_rng(1).normal(0.0, 3e5, len(imu))).astype(np.int64)
    sim = replace(real, truths={}, imu=Imu(t_ns, lsb * np.round(imu.gyro / lsb), lsb * np.round(imu.accel / lsb)))
    (pair,), _ = align_all([replace(sim, imu=replace(sim.imu, gyro=1.01 * sim.imu.gyro))], sim, None, DiagnoseSettings())
    model = expected(pair, ())
    assert np.abs(pair.real[:, :3] / 1.01 - model[:, :3]).max() < 1e-6
    assert np.abs(pair.real[:, 3:] - model[:, 3:]).max() < 1e-6
    (digits,) = timestamps.rounded([pair], np.zeros(6))
    assert is_of_simulation(digits, [pair])
    assert not is_of_simulation(digits, [replace(pair, sim_lsb=pair.sim_lsb / 2.0)])
    white = whitened(pair, candidates_for([pair])).whiten
    assert white.std == pytest.approx(lsb / np.sqrt(12.0), rel=0.2)


@pytest.mark.parametrize("with_simulation", [True, False])
def test_samples_stamped_in_batches_are_read_on_the_clock_of_the_sensor(with_simulation: bool) -> None:
    """A driver that reads five samples at a time stamps them together; every step between batches was a gap."""
    real, size = made(EXACT), 5
    imu = along(real, 1).imu
    count = len(imu) // size * size
    t_ns = np.repeat(imu.t_ns[:count][size - 1 :: size], size) + np.tile(np.arange(size) * 50_000, count // size)
    late = replace(real, imu=Imu(t_ns, imu.gyro[:count], imu.accel[:count]))
    (pair,), remarks = align_all([late], along(real) if with_simulation else None, None, DiagnoseSettings())
    assert pair.period_s == pytest.approx(1.0 / RATE_HZ, rel=1e-3)
    np.testing.assert_allclose(np.diff(pair.stamp_s), 1.0 / RATE_HZ, atol=1e-4)
    assert any(pair.fitted)
    assert any(pair.held_out)
    assert "stamps come in batches of about 5.0 samples" in remarks[0]
    (finding,) = batched([pair], [])
    assert finding.effect == "timestamp_jitter"
    assert finding.parameters["std"].value == pytest.approx(np.std(np.arange(size)) / RATE_HZ, rel=0.02)
    assert batched([pair], [finding]) == []


def test_a_sample_that_repeats_the_one_before_does_not_count() -> None:
    """One in fifty was late and the driver sent the last one again; digits coarser than the noise repeat by themselves."""
    real = made(EXACT)
    sim, rng, imu = along(real), np.random.default_rng(3), along(real, 1).imu
    again = np.flatnonzero(rng.random(len(imu)) < 0.02)[1:]
    gyro, accel = imu.gyro.copy(), imu.accel.copy()
    for x in (gyro, accel):
        x[again] = x[again - 1]
    again = np.flatnonzero((np.diff(gyro, axis=0) == 0).all(axis=1)) + 1
    (pair,), (remark,) = align_all([replace(real, imu=replace(imu, gyro=gyro, accel=accel))], sim, None, DiagnoseSettings())
    assert pair.known is not None
    np.testing.assert_array_equal(np.flatnonzero(repeats(pair.real)), again)
    assert not pair.known[again].any()
    assert pair.known.mean() > 0.97
    assert f"{len(again)} samples repeat the one before" in remark
    for digit in (0.5, 50.0):
        assert not repeats(np.round(pair.real / digit) * digit).any()


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_samples_with_which_a_gap_was_filled_do_not_count(dtype: type) -> None:
    """A straight line in ten gaps of twelve samples; digits coarser than the noise lie on lines by themselves."""
    real = made(EXACT)
    sim, imu = along(real), along(real, 1).imu
    columns, inside = np.concatenate([imu.gyro, imu.accel], axis=1), np.zeros(len(imu), bool)
    for start in range(200, 3200, 300):
        inside[start + 1 : start + 13] = True
    columns = np.stack([np.interp(imu.t_ns, imu.t_ns[~inside], column[~inside]) for column in columns.T], axis=1)
    columns = columns.astype(dtype).astype(np.float64)
    joined = replace(real, imu=Imu(imu.t_ns, columns[:, :3].copy(), columns[:, 3:].copy()))
    (pair,), (remark,) = align_all([joined], sim, None, DiagnoseSettings())
    assert pair.known is not None
    taken = imu.t_ns[:1] + np.round(pair.stamp_s * 1e9).astype(np.int64)
    np.testing.assert_array_equal(~pair.known.any(axis=1), np.isin(taken, imu.t_ns[inside]))
    assert f"{inside.sum()} samples lie on a straight line" in remark
    (whole,), none = align_all([replace(real, imu=imu)], sim, None, DiagnoseSettings())
    assert none == []
    assert not filled(whole.stamp_s, whole.real).any()
    assert not filled(pair.stamp_s, np.round(pair.real / 0.5) * 0.5).any()
