"""What rings after shocks is named by the poles of the residual; noise, lines and drifts do not ring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, sosfilt
from support import planted

from imutool.diagnosis.estimation.jacobians import expected
from imutool.diagnosis.estimation.whitening import WhitenedImu, Whitener
from imutool.diagnosis.held_out import noise_floor, ringing, unexplained_residuals, with_effects
from imutool.diagnosis.result import Finding

SURE = 4.0


def found(added: np.ndarray, seed: int = 1) -> list[Finding]:
    """What rings in a recording whose accelerometer reads something more than an ideal one with noise."""
    pair = planted.pair(planted.rich(), seed=seed)
    real = pair.real.copy()
    real[:, 3:] += added
    log = planted.weighed(replace(pair, real=real))
    return ringing([log], [expected(pair, ())])


def shocks(f0: float, zeta: float, seed: int = 3) -> np.ndarray:
    """Free decays after shocks of every few seconds."""
    t_s, rng = planted.clock(), np.random.default_rng(seed)
    w, out, at_s = 2.0 * np.pi * f0, np.zeros((len(planted.clock()), 3)), 0.5
    while at_s < t_s[-1]:
        since = np.maximum(t_s - at_s, 0.0)
        decay = np.exp(-zeta * w * since) * np.sin(w * np.sqrt(1.0 - zeta**2) * since)
        out += np.outer(decay * (t_s >= at_s), rng.normal(0.0, 2.0, 3))
        at_s += rng.uniform(0.7, 2.5)
    return out


@pytest.mark.parametrize(("f0", "zeta"), [(18.1, 0.06), (7.0, 0.12), (30.0, 0.03)])
def test_a_mount_that_rings_after_shocks_is_named_with_frequency_and_damping(f0: float, zeta: float) -> None:
    (finding,) = found(shocks(f0, zeta))
    assert finding.effect == "mount_resonance"
    assert finding.share == 0.0  # no sample predicts it
    for name, true in (("f0", f0), ("zeta", zeta)):
        estimate = finding.parameters[name]
        assert abs(estimate.value - true) < SURE * estimate.std
        assert estimate.std < 0.2 * true


@pytest.mark.parametrize("seed", range(20))
def test_noise_does_not_ring(seed: int) -> None:
    assert found(np.zeros((len(planted.clock()), 3)), seed) == []


@pytest.mark.parametrize("seed", range(4))
def test_rotors_whose_speeds_wander_do_not_ring(seed: int) -> None:
    """Their spectrum has a peak as wide as that of a damped mount."""
    rng, t_s, added = np.random.default_rng(seed), planted.clock(), np.zeros((len(planted.clock()), 3))
    slow = butter(1, 1.0, fs=planted.RATE_HZ, output="sos")
    for hz in (16.7, 17.6, 18.5, 19.4):
        wander_hz = sosfilt(slow, rng.normal(size=len(t_s) + 500))[500:]
        turns = 2.0 * np.pi * np.cumsum(hz + wander_hz / wander_hz.std()) / planted.RATE_HZ
        added += 0.5 * np.cos(turns[:, None] + rng.uniform(0.0, 6.0, 3))
    assert found(added) == []


def test_what_an_axis_reads_at_its_limit_does_not_ring() -> None:
    """Such samples are no measurement, though those of the other axes are."""
    pair, beyond = planted.pair(planted.rich()), np.zeros((len(planted.clock()), 6))
    beyond[:, 3:] = shocks(7.0, 0.12)
    log = planted.weighed(replace(pair, real=pair.real + beyond, known=np.abs(beyond) < 0.1))
    assert ringing([log], [expected(pair, ())]) == []


def test_no_noise_is_larger_than_what_is_left() -> None:
    """It is measured before the effects are known, and what a filter takes at high frequencies counted."""
    pair = planted.pair(planted.rich())
    log = WhitenedImu(pair, Whitener(np.ones((6, 1)), 5.0 * planted.NOISE))
    left = unexplained_residuals([log], [with_effects(pair, ())], noise_floor([log]))
    for signal, true in zip(("gyro", "accel"), planted.NOISE[[0, 3]], strict=True):
        assert left[signal].white
        assert left[signal].noise_floor == left[signal].rms < 1.2 * true


def test_a_line_a_drift_and_motion_that_is_left_do_not_ring() -> None:
    t_s, rng = planted.clock(), np.random.default_rng(5)
    walk = np.cumsum(0.02 * rng.normal(size=(len(t_s), 3)), axis=0)
    for added in (
        np.sin(2.0 * np.pi * 17.0 * t_s)[:, None] * np.ones(3),
        walk,
        0.1 * planted.rich().accel,
        planted.rich().gyro,
    ):
        assert found(added) == []
