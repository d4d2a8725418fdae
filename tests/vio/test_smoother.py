"""The estimate is exact where its inputs are, finds a bias if it may, suffers from it if not, and says when it fails."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.errors import ConfigError, NumericsError
from imutool.inertial.strapdown import StartPose
from imutool.recording import Imu, Recording
from imutool.vio import smoother
from imutool.vio.camera import Frame
from imutool.vio.run import VioProblem, VioSettings, plan, score
from imutool.vio.smoother import Estimate, SmootherSettings

GYRO_BIAS = np.array([0.05, -0.02, 0.03])  # rad/s
ACCEL_BIAS = np.array([0.2, -0.1, 0.15])  # m/s²
# With perfect samples what is left is the pixels' noise: 30 tracks of 1 px at 0.5 to 12 m, over 10 s.
NOISY_DEG, NOISY_M = 0.6, 0.08
# Without pixel noise: the trapezoidal rule at 200 Hz, and true poses interpolated between 120 Hz.
EXACT_DEG, EXACT_M = 0.01, 1e-3
GYRO_FOUND, ACCEL_FOUND = 3e-3, 0.05  # rad/s, m/s²: after 10 s at the noise the smoother assumes


@pytest.fixture(scope="module")
def course(perfect: Recording) -> VioProblem:
    return plan(perfect, VioSettings())


def run(perfect: Recording, course: VioProblem, frames: Sequence[Frame] | None = None, **options: Any) -> Estimate:
    imu = options.pop("imu", perfect.imu)
    return smoother.estimate(
        imu.rows(course.rows),
        course.keyframes,
        course.frames if frames is None else frames,
        StartPose.of(course.true),
        options.pop("settings", SmootherSettings()),
        pixel_std=1.0,
        **({"bias_states": True} | options),
    )


def errors(found: Estimate, course: VioProblem) -> tuple[float, float]:
    """Largest error of attitude (degrees) and position (m)."""
    R_est, R_true = (Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True) for poses in (found.poses, course.true))
    turned = np.degrees((R_true.inv() * R_est).magnitude()).max()
    return float(turned), float(np.linalg.norm(found.poses.p_wb - course.true.p_wb, axis=1).max())


def shifted(imu: Imu) -> Imu:
    return Imu(imu.t_ns, imu.gyro + GYRO_BIAS, imu.accel + ACCEL_BIAS)


@pytest.mark.parametrize("bias_states", [True, False])
def test_perfect_samples_and_noisy_tracks_give_small_errors(perfect: Recording, course: VioProblem, bias_states: bool) -> None:
    turned, moved = errors(run(perfect, course, bias_states=bias_states), course)
    assert turned < NOISY_DEG
    assert moved < NOISY_M


def test_perfect_samples_and_exact_tracks_give_the_truth(perfect: Recording) -> None:
    exact = plan(perfect, VioSettings(pixel_noise=1e-9))
    found = run(perfect, exact)
    turned, moved = errors(found, exact)
    assert turned < EXACT_DEG
    assert moved < EXACT_M
    assert np.abs(found.bias).max() < 5e-3


@pytest.mark.parametrize("bias_states", [True, False])
def test_without_a_camera_it_is_dead_reckoning(perfect: Recording, course: VioProblem, bias_states: bool) -> None:
    """A perfect IMU alone follows the truth, a biased one leaves it by all of its bias: what is never seen is never found."""
    dark = [Frame(np.zeros(0, np.int64), np.zeros((0, 3)))] * len(course.frames)
    assert max(errors(run(perfect, course, dark, bias_states=bias_states), course)) < 0.02
    blind = run(perfect, course, dark, bias_states=bias_states, imu=shifted(perfect.imu))
    assert errors(blind, course)[0] > 15.0
    assert np.abs(blind.bias).max() < 1e-3


@pytest.mark.parametrize("disparity_px", [0.0, -0.5])
def test_a_track_at_infinity_is_put_far_away(perfect: Recording, course: VioProblem, disparity_px: float) -> None:
    """Noise makes its disparity zero or less, behind the camera."""
    dark = [Frame(np.zeros(0, np.int64), np.zeros((0, 3)))] * len(course.frames)
    far = Frame(np.array([7]), np.array([[400.0, 400.0 - disparity_px, 200.0]]))
    assert max(errors(run(perfect, course, [*dark[:3], far, *dark[4:]]), course)) < 0.02


def test_bias_states_find_a_wrong_bias_and_without_them_it_spoils_the_estimate(perfect: Recording, course: VioProblem) -> None:
    wrong = shifted(perfect.imu)
    on = run(perfect, course, imu=wrong)
    off = run(perfect, course, imu=wrong, bias_states=False)
    np.testing.assert_allclose(on.bias[-1, :3], GYRO_BIAS, atol=GYRO_FOUND)
    np.testing.assert_allclose(on.bias[-1, 3:], ACCEL_BIAS, atol=ACCEL_FOUND)
    assert not off.bias.any()
    turned_on, moved_on = errors(on, course)
    turned_off, moved_off = errors(off, course)
    assert turned_on < 2 * NOISY_DEG
    assert moved_on < 2 * NOISY_M
    assert turned_off > 5 * turned_on
    assert moved_off > 5 * moved_on


def test_the_same_input_gives_the_same_bits(perfect: Recording, course: VioProblem) -> None:
    first, again = run(perfect, course), run(perfect, course)
    assert first.poses == again.poses
    np.testing.assert_array_equal(first.bias, again.bias)


def test_an_impossible_imu_is_reported_with_its_time(perfect: Recording, course: VioProblem) -> None:
    thrown = Imu(perfect.imu.t_ns, perfect.imu.gyro, perfect.imu.accel + np.array([0.0, 400.0, 0.0]))
    dark = [Frame(np.zeros(0, np.int64), np.zeros((0, 3)))] * len(course.frames)
    with pytest.raises(NumericsError, match=r"diverged after 0\.25 s \(it claims 1\d\d m/s\)"):
        run(perfect, course, dark, imu=thrown, bias_states=False)


def test_what_gtsam_throws_is_an_error_of_ours(perfect: Recording, course: VioProblem, monkeypatch: pytest.MonkeyPatch) -> None:
    def throw(*_: Any) -> None:
        raise RuntimeError("\nIndeterminant linear system detected near\nvariable x7. Thrown when a linear system\nis odd.")

    monkeypatch.setattr(smoother._Run, "solve", throw)
    with pytest.raises(NumericsError, match=r"\(Indeterminant linear system detected near variable x7\)"):
        run(perfect, course)
    result = score(perfect.imu, course, VioSettings(), bias_states=True)
    assert "Indeterminant" in result["failed"]
    assert result["aoe_deg"] is None
    assert result["roe_deg"] is None


def test_a_longer_hole_than_the_lag_is_survived(perfect: Recording) -> None:
    """All states with a view of anything have left the smoother when the camera wakes up."""
    holed = plan(perfect, VioSettings(blackout_s=4.0, blackout_every_s=7.0))
    assert max(sum(not len(frame.tracks) for frame in holed.frames[k : k + 16]) for k in range(24)) == 16
    turned, moved = errors(run(perfect, holed), holed)
    assert turned < 2.0
    assert moved < 0.5


def test_a_missing_gtsam_is_said_with_the_extra_that_brings_it(
    perfect: Recording, course: VioProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(ConfigError, match=r"imutool\[vio\]"):
        run(perfect, course)


def test_progress_is_told_keyframe_by_keyframe(perfect: Recording, course: VioProblem) -> None:
    told: list[tuple[int, int]] = []
    short = course._replace(keyframes=course.keyframes[:5], true=course.true.rows(slice(5)), frames=course.frames[:5])
    run(perfect, short, progress=lambda done, total: told.append((done, total)))
    assert told == [(k, 5) for k in range(1, 6)]
