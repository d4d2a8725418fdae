"""Poses that are turned against gyro and gravity for seconds, and follow the gyro from one sample to the next."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp
from support import planted

from imutool.diagnosis.diagnose import candidates_for
from imutool.diagnosis.estimation.model_selection import select_effects
from imutool.diagnosis.estimation.noise_estimate import whitened
from imutool.diagnosis.reference.coverage import align
from imutool.diagnosis.reference.errors import SMOOTHED, reference_errors, turned_reference
from imutool.diagnosis.result import Finding
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.diagnosis.summarize import vibration_above_band
from imutool.recording import Poses, seconds
from imutool.sensor import catalogue
from imutool.sensor.effects.vibration import line_p_value
from imutool.sensor.made_up_flight import flight

DURATION_S, SLOW_S = 90.0, 1.0
LINE_HZ, LINE_M, LINE_M_S2 = 17.0, 5e-5, 0.2
TURNED = np.array([-0.01, 0.02, 0.045])
SETTINGS = DiagnoseSettings()


@cache
def found(slow: float, fast: float) -> list[Finding]:
    """Findings of a log whose poses are turned by a share of TURNED in slow motion, and by another in fast motion."""
    felt = planted.rich(3, DURATION_S)
    rates = felt.gyro @ Rotation.from_rotvec(TURNED).as_matrix() - felt.gyro
    lagged = gaussian_filter1d(rates, SLOW_S * planted.RATE_HZ, axis=0)
    middle = 0.5 * (felt.gyro + slow * lagged + fast * (rates - lagged))
    steps = Rotation.from_rotvec((middle[1:] + middle[:-1]) / planted.RATE_HZ).as_matrix()
    R = [Rotation.from_matrix(felt.R_wb[0]).as_matrix() @ Rotation.from_rotvec(slow * TURNED).as_matrix()]
    for step in steps:
        R.append(R[-1] @ step)
    t_ns = planted.START_NS + np.round(felt.t_s * 1e9).astype(np.int64)
    path = planted.moving(3, DURATION_S)
    p_wb = path.poses(path.start_ns + np.round(felt.t_s * 1e9).astype(np.int64)).p_wb
    poses = Poses(t_ns, p_wb, Rotation.from_matrix(np.array(R)).as_quat(scalar_first=True))
    samples = planted.ideal(felt) + planted.noise(len(felt.t_s), 1) + planted.BIAS
    log = planted.recording("log", felt.t_s, samples, poses=poses)
    mount = catalogue.diagnosed(["mount_rotation"])
    logs = [whitened(pair, mount) for pair in align(log, None, None, SETTINGS)]
    return turned_reference(logs, ())


SMOOTHED_S = 0.015


@pytest.mark.parametrize("scale", [{}, {"gyro_scale": [0.01, -0.02, 0.015]}], ids=["alone", "beside a scale"])
def test_smoothed_poses_are_told_from_a_scale_by_the_frequency(scale: dict[str, list[float]]) -> None:
    felt = planted.shaken(2, DURATION_S)
    pair = planted.pair(felt, scale, 1)
    spread = SMOOTHED_S * felt.rate_hz
    gyro, accel = (gaussian_filter1d(column, spread, axis=0) for column in (felt.gyro, felt.accel))
    beside = replace(pair, band_hz=7.0, ideal=replace(felt, gyro=gyro, accel=accel))
    found = select_effects([planted.weighed(beside)], (*planted.catalogue(), SMOOTHED)).selected
    assert {one.effect.name for one in found} == {"reference_smoothing", *scale}
    told = {one.effect.name: one for one in found}
    smoothing, expected = told["reference_smoothing"], 0.5 * SMOOTHED_S**2
    assert np.all(smoothing.std < 0.1 * expected)
    assert np.all(np.abs(smoothing.theta - expected) < 4.0 * smoothing.std + 0.02 * expected)  # the rest: higher derivatives
    if scale:
        assert told["gyro_scale"].theta == pytest.approx(scale["gyro_scale"], abs=5e-4)


def test_poses_as_they_are_have_no_smoothing() -> None:
    pair = replace(planted.pair(planted.shaken(2, DURATION_S), {}, 1), band_hz=7.0)
    assert select_effects([planted.weighed(pair)], (*planted.catalogue(), SMOOTHED)).selected == ()


BLOWS_S, BLOW_HZ, BLOW_S = (14.2, 37.7, 61.1), 27.0, 0.04


@pytest.mark.parametrize("shaken", ["recording", "reference", "reference lost"])
def test_a_blow_is_no_error_of_the_reference_and_a_jump_or_a_lost_motion_of_it_is(shaken: str) -> None:
    """A blow is in the recording's own fast samples."""
    felt = planted.rich(3, DURATION_S)
    since = [np.where(felt.t_s >= at, felt.t_s - at, np.inf) for at in BLOWS_S]
    blow = sum(np.exp(-s / BLOW_S) * np.sin(2.0 * np.pi * BLOW_HZ * np.minimum(s, 9.0)) for s in since)
    blows = np.asarray(blow)[:, None] * [0.3, 0.5, 0.1, 4.0, 2.0, 20.0]
    pair = planted.pair(felt, {}, 1, added=blows if shaken == "recording" else None)
    if shaken == "reference":
        pair = replace(pair, ideal=replace(felt, gyro=felt.gyro + blows[:, :3], accel=felt.accel + blows[:, 3:]))
    if shaken == "reference lost":
        lost = np.any([(felt.t_s >= at) & (felt.t_s < at + 2.0) for at in BLOWS_S], axis=0)
        gyro, accel = (np.where(lost[:, None], x.mean(axis=0), x) for x in (felt.gyro, felt.accel))
        pair = replace(pair, ideal=replace(felt, gyro=gyro, accel=accel))
    findings, places = reference_errors([planted.weighed(pair)])
    assert [one.effect for one in findings] == ([] if shaken == "recording" else ["reference_error"])
    assert [one.signal for one in places] == ["gyro", "accel"]
    assert ("shocks" in places[0].regime) == (shaken == "recording")
    assert all(abs(a - at) < 0.5 for (a, _), at in zip(places[0].intervals_s, BLOWS_S, strict=True))


@pytest.mark.parametrize("alike", [True, False], ids=["both sensors", "the accelerometer alone at its end"])
def test_poses_that_jump_have_a_wrong_interval_in_one_of_their_stretches(alike: bool) -> None:
    """Of several stretches nothing was said, nor where one sensor alone shows the rim of an interval."""
    felt, at_s, end_s = planted.rich(3, DURATION_S), 20.0, 22.0
    rows = (felt.t_s >= at_s) & (felt.t_s < end_s)
    wrong = np.where(rows[:, None], [0.3, -0.2, 0.4, 3.0, 2.0, -4.0], 0.0)
    if not alike:
        wrong[(felt.t_s >= end_s + 1.0) & (felt.t_s < end_s + 1.2), 3:] = 0.3
    pair = planted.pair(felt, {}, 1, added=wrong)
    parts = [felt.t_s < 0.5 * DURATION_S, felt.t_s > 0.5 * DURATION_S + 1.0]
    names = "stamp_s", "real", "fitted", "held_out"
    logs = [planted.weighed(replace(pair, **{name: getattr(pair, name)[part] for name in names})) for part in parts]
    (finding,), places = reference_errors(logs)
    assert finding.effect == "reference_error"
    assert places[0].intervals_s[0] == pytest.approx((at_s, end_s), abs=0.3)


def test_poses_that_are_turned_against_slow_motion_alone_are_wrong_by_that_rotation() -> None:
    (wrong,) = found(1.0, 0.0)
    assert wrong.effect == "reference_error"
    for value, axis in zip(TURNED, "xyz", strict=True):
        estimate = wrong.parameters[f"turned_{axis}"]
        assert abs(estimate.value - value) < max(4.0 * estimate.std, 0.1 * np.abs(TURNED).max())


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_right_poses_and_a_mount_that_is_turned_are_no_error_of_the_reference(share: float) -> None:
    assert found(share, share) == []


@pytest.mark.parametrize(
    ("in_poses", "in_samples", "named"),
    [(LINE_M, 0.0, False), (0.0, LINE_M_S2, True), (-LINE_M_S2 / (2.0 * np.pi * LINE_HZ) ** 2, LINE_M_S2, False)],
    ids=["poses", "sensor", "body, whose poses are smoothed"],
)
def test_a_line_that_the_poses_have_is_no_vibration_of_the_sensor(in_poses: float, in_samples: float, named: bool) -> None:
    """Above the band in which poses are trusted, as of a camera."""
    real = flight(3, duration_s=40.0, rate_hz=100.0, truth_noise_rad=1e-5, truth_noise_m=1e-5)
    since_s, pose_s = (seconds(t_ns, int(real.imu.t_ns[0])) for t_ns in (real.imu.t_ns, real.truth.t_ns))
    line, shaken = (np.sin(2.0 * np.pi * LINE_HZ * t_s)[:, None] * [1.0, -0.5, 0.7] for t_s in (since_s, pose_s))
    attitude = Slerp(pose_s, Rotation.from_quat(real.truth.q_wb_wxyz, scalar_first=True))(np.clip(since_s, *pose_s[[0, -1]]))
    accel = real.imu.accel + in_samples * attitude.apply(line, inverse=True)
    poses = replace(real.truth, p_wb=real.truth.p_wb + in_poses * shaken)
    real = replace(real, imu=replace(real.imu, accel=accel), truths={"/pose": poses})
    logs = [whitened(pair, candidates_for([pair])) for pair in align(real, None, None, SETTINGS)]
    found = vibration_above_band(logs, ())
    assert [one.effect for one in found] == (["vibration"] if named else [])
    assert all(one.parameters["f"].value == pytest.approx(LINE_HZ, abs=0.01) for one in found)


def test_coloured_noise_has_no_line() -> None:
    """It is as strong at one frequency as the line is at its own, but no stronger than around it."""
    rng, t_s = np.random.default_rng(5), np.arange(6000) / 100.0
    coloured = gaussian_filter1d(rng.normal(size=(6000, 6)), 3.0, axis=0)
    frequency = np.fft.rfftfreq(6000, 0.01)
    strongest = float(frequency[5 + np.argmax((np.abs(np.fft.rfft(coloured, axis=0)) ** 2).sum(axis=1)[5:])])
    assert line_p_value(coloured, 100.0, strongest) > SETTINGS.search.false_discovery_rate
    line = coloured + 0.05 * np.sin(2.0 * np.pi * 12.3 * t_s)[:, None]
    assert line_p_value(line, 100.0, 12.3) < 1e-9


def test_a_motion_that_ends_at_a_frequency_has_no_line_there() -> None:
    """Beyond 9 Hz there is noise alone, of which any frequency of the motion stands out."""
    rng, hz = np.random.default_rng(6), np.fft.rfftfreq(6000, 0.01)
    spectrum = (rng.normal(size=(len(hz), 6)) + 1j * rng.normal(size=(len(hz), 6))) * np.where(hz < 9.0, 1.0, 1e-3)[:, None]
    motion = np.fft.irfft(spectrum, 6000, axis=0)
    near = hz[(hz > 8.6) & (hz < 9.0)]
    assert min(line_p_value(motion, 100.0, float(at)) for at in near) > SETTINGS.search.false_discovery_rate
    line = motion + 0.2 * motion.std() * np.sin(2.0 * np.pi * 8.9 * np.arange(6000) / 100.0)[:, None]
    assert line_p_value(line, 100.0, 8.9) < 1e-9
