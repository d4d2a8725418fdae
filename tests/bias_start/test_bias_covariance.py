"""A covariance is that of the rest bias, and of the calibration as far as that is not a rest bias itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from imutool.bias import hybrid, linear, static
from imutool.bias_start import bias_covariance
from imutool.bias_start.bias_covariance import BiasEstimator, ExpectedDrift
from imutool.bias_start.bias_tracking import BiasTrajectory
from imutool.bias_start.initial_bias import InitialBias
from imutool.bias_start.prior_width import BiasPrior
from imutool.recording import Imu, Poses

RATE_HZ, SIZE = 200.0, 8000
SCALE_STD, G_STD = 2e-3, 1e-4  # of a share, and of rad/s per m/s²
REST = np.zeros(6)
STD = np.array([3e-4] * 3 + [2e-2] * 3)
KNOWN = BiasPrior(REST, STD, STD)
WAYS = {
    "held": InitialBias(REST, STD, "given"),
    "followed": InitialBias(REST, STD, "followed", follows=KNOWN),
    "smoothed": InitialBias(REST, STD, "smoothed", track=BiasTrajectory(np.zeros(1), REST[None], STD[None])),
}
SAME = 1e-10  # of float64 through a sum over all samples
MEAN_LEFT = 0.01  # of the variance: a mean so far over 40 turns is not quite zero

Samples = tuple[np.ndarray, np.ndarray, np.ndarray]


def model_of(*names: str) -> hybrid.Model:
    """Gyro effects of whose parameters nothing is known but a standard deviation."""
    std = {"gyro_scale": SCALE_STD, "gyro_g_sensitivity": G_STD}
    size = {"gyro_scale": 3, "gyro_g_sensitivity": 9}
    each = np.concatenate([np.full(size[name], std[name]) for name in names])
    tensors = {"theta_gyro": np.zeros(len(each)), "covariance_gyro": np.diag(each**2)}
    return hybrid.Model(hybrid.Config(gyro_effects=names, remainder=False), RATE_HZ, tensors)


@pytest.fixture
def turning() -> Samples:
    """40 turns to and fro about x, level, at rest in the first sample's direction of gravity."""
    t_s = np.arange(SIZE) / RATE_HZ
    gyro = np.zeros((SIZE, 3))
    gyro[:, 0] = 1.5 * np.sin(2 * np.pi * t_s)
    return t_s, gyro, np.tile([0.0, 0.0, 9.81], (SIZE, 1))


def calibrated(model: hybrid.Model, way: str, samples: Samples, blocks: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """The covariance, and what of it is the rest bias's."""
    found: list[tuple[np.ndarray, np.ndarray]] = []
    both = [BiasEstimator(model, WAYS[way]) for _ in range(2)]
    for rows in np.array_split(np.arange(SIZE), blocks):
        some = tuple(x[rows] for x in samples)
        found.append((both[0](*some).covariance, both[1].parts(*some).rest))
    return np.concatenate([a for a, _ in found]), np.concatenate([b for _, b in found])


def test_a_bias_that_is_held_gets_all_that_the_fit_left_open(turning: Samples) -> None:
    total, rest = calibrated(model_of("gyro_scale", "gyro_g_sensitivity"), "held", turning)
    expected = np.zeros((SIZE, 3))
    expected[:, 0] = (SCALE_STD * turning[1][:, 0]) ** 2
    expected += (G_STD * 9.81) ** 2
    np.testing.assert_allclose(np.diagonal(total - rest, axis1=1, axis2=2)[:, :3], expected, rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("way", ["followed", "smoothed"])
def test_what_stays_the_same_is_a_rest_bias_and_counts_once(turning: Samples, way: str) -> None:
    total, rest = calibrated(model_of("gyro_g_sensitivity"), way, turning)
    np.testing.assert_allclose(total, rest, rtol=0, atol=SAME * (G_STD * 9.81) ** 2)


@pytest.mark.parametrize("way", ["followed", "smoothed"])
def test_what_goes_with_the_motion_counts_whole(turning: Samples, way: str) -> None:
    total, rest = calibrated(model_of("gyro_scale"), way, turning)
    late = slice(SIZE // 2, None)  # the mean so far has become small
    share = np.mean((total - rest)[late, 0, 0]) / np.mean((SCALE_STD * turning[1][late, 0]) ** 2)
    assert abs(share - 1) < MEAN_LEFT


@pytest.mark.parametrize("way", WAYS)
def test_blocks_change_nothing(turning: Samples, way: str) -> None:
    model = model_of("gyro_scale", "gyro_g_sensitivity")
    whole, _ = calibrated(model, way, turning)
    parts, _ = calibrated(model, way, turning, blocks=37)
    np.testing.assert_allclose(parts, whole, rtol=1e-9, atol=SAME * (G_STD * 9.81) ** 2)


@pytest.mark.parametrize("gap_s", [100.0, 1e6])
def test_a_held_bias_walks_through_a_gap_as_far_as_switchings_on_differ(gap_s: float) -> None:
    """By q T, and no further than to the prior's variance; a start that is less sure than the prior stays so."""
    walk_std, prior_std = np.repeat([1e-5, 1e-4], 3), np.repeat([1e-3, 1e-2], 3)
    model = linear.Model(linear.Config(), RATE_HZ, {"walk_std": walk_std, "prior_std": prior_std})
    t_s = np.array([0.0, 0.005, gap_s, gap_s + 0.005])
    rest = BiasEstimator(model, WAYS["held"]).parts(t_s, np.zeros((4, 3)), np.tile([0.0, 0.0, 9.81], (4, 1))).rest
    grown = np.clip(STD**2 + walk_std**2 * gap_s, None, np.maximum(STD, prior_std) ** 2)
    for row, expected in zip(rest, (STD**2, STD**2, grown, grown), strict=True):
        np.testing.assert_allclose(row, np.diag(expected), rtol=0.02)


@pytest.mark.parametrize("way", WAYS)
def test_the_bias_of_an_estimate_is_that_of_the_stream(turning: Samples, way: str) -> None:
    model = model_of("gyro_scale")
    estimated = BiasEstimator(model, WAYS[way])(*turning)
    assert np.array_equal(estimated.bias, WAYS[way].stream(model)(*turning))


def test_static_is_as_sure_in_motion_as_a_sensor_nobody_calibrated(turning: Samples) -> None:
    estimator, model = BiasEstimator(static.Model(), WAYS["held"]), static.Model()
    t_s, gyro, accel = turning
    tilted = accel.copy()
    tilted[SIZE // 2 :] = [9.81, 0.0, 0.0]
    total = estimator(t_s, gyro, tilted).covariance
    rest = BiasEstimator(model, WAYS["held"]).parts(t_s, gyro, tilted).rest
    added = np.sqrt(np.diagonal(total - rest, axis1=1, axis2=2))
    np.testing.assert_allclose(added[:, :3], static.CALIBRATION_STD * np.abs(gyro[:, :1]) * np.ones(3), atol=1e-9)
    np.testing.assert_allclose(added[: SIZE // 2, 3:], 0.0, atol=1e-9)
    np.testing.assert_allclose(added[SIZE // 2 :, 3:], static.CALIBRATION_STD * 9.81 * np.sqrt(2.0), rtol=1e-6)


@pytest.mark.parametrize("lost", [slice(0), slice(100, 107), slice(1000, 1003), slice(1995, None)])
def test_a_body_at_rest_is_expected_to_drift_as_a_constant_bias_makes_it(lost: slice) -> None:
    """Attitude by s t, velocity by s t and, where gravity is tilted, by g s t^2 / 2; samples may be no measurement."""
    count, length_s = 2001, 5.0
    accel = np.tile([0.0, 0.0, 9.81], (count, 1))
    accel[lost] = 0.0
    imu = Imu(np.arange(count) * 5_000_000, np.zeros((count, 3)), accel)
    still = Poses(imu.t_ns, np.zeros((count, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), np.zeros((count, 3)))
    windows = np.array([[0, 1000], [1000, 2000]])
    found = ExpectedDrift(static.Model(), WAYS["held"], imu)(still, windows).diagonal(axis1=1, axis2=2)
    tilted = (9.81 * STD[:3] * length_s**2 / 2) ** 2 * [1.0, 1.0, 0.0]
    for variances in found:
        np.testing.assert_allclose(variances[:3], (STD[:3] * length_s) ** 2, rtol=0.02)
        np.testing.assert_allclose(variances[3:], (STD[3:] * length_s) ** 2 + tilted, rtol=0.03)


def test_a_window_of_which_nothing_was_measured_expects_nothing() -> None:
    imu = Imu(np.arange(2001) * 5_000_000, np.zeros((2001, 3)), np.tile([0.0, 0.0, 9.81], (2001, 1)))
    imu = replace(imu, accel=np.where(np.arange(2001)[:, None] < 1100, 0.0, imu.accel))
    still = Poses(imu.t_ns, np.zeros((2001, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (2001, 1)), np.zeros((2001, 3)))
    lost, half = ExpectedDrift(static.Model(), WAYS["held"], imu)(still, np.array([[0, 1000], [1000, 2000]]))
    assert not lost.any()
    assert half.any()


def test_what_a_window_expects_does_not_depend_on_how_the_samples_before_it_came(
    turning: Samples, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As one window, or passed in parts: the mean of a calibration's errors counts each sample once."""
    monkeypatch.setattr(bias_covariance, "PASSED_AT_ONCE", 30)
    t_s, gyro, accel = turning
    imu = Imu((1e9 * t_s).astype(np.int64), gyro, accel)
    path = Poses(imu.t_ns, np.zeros((SIZE, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (SIZE, 1)), np.zeros((SIZE, 3)))
    passed, seen = (
        ExpectedDrift(model_of("gyro_scale"), WAYS["followed"], imu)(path, np.array(windows))[-1]
        for windows in ([[100, 150]], [[0, 100], [100, 150]])
    )
    np.testing.assert_allclose(passed, seen, rtol=1e-9)
