"""The noise of a diagnosis is what its findings leave: density, white part, spectrum, and how it comes and goes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter, welch
from support import diagnoses

from imutool.diagnosis.result import Traces
from imutool.diagnosis.to_sensor_files import to_noise_file

RATE_HZ, SECONDS, WHITE, SLOW = 200.0, 120, 0.3, 0.95  # share of the noise; pole of the rest


def test_the_noise_has_the_size_spectrum_and_levels_of_what_is_left() -> None:
    rng, n = np.random.default_rng(0), int(RATE_HZ * SECONDS)
    slow = lfilter([np.sqrt(1.0 - SLOW**2)], [1.0, -SLOW], rng.normal(size=(n, 6)), axis=0)
    level = np.repeat(rng.uniform(0.5, 1.5, SECONDS), int(RATE_HZ))[:, None]
    left = 0.02 * (WHITE * rng.normal(size=(n, 6)) + np.sqrt(1.0 - WHITE**2) * level * slow)
    after = rng.normal(size=(n, 6))
    trace = Traces("made", np.arange(n) / RATE_HZ, after + left, after, after, np.zeros(n, bool))
    noise = to_noise_file(replace(diagnoses.NOTHING, traces=(trace,)))
    assert noise is not None
    assert noise.colour is not None
    np.testing.assert_allclose(noise.values("gyro_density") * np.sqrt(RATE_HZ), left.std(axis=0)[:3], rtol=0.02)
    assert min(noise.colour.gyro_levels) < 0.7
    assert max(noise.colour.gyro_levels) > 1.3
    t_s = np.arange(4 * n) / RATE_HZ
    white = rng.normal(size=(len(t_s), 3))
    again = noise.colour.shaped(white, t_s, "gyro", rng) * left.std(axis=0)[:3]
    for k in range(3):
        (_, planted), (_, made) = (welch(x[:, k], RATE_HZ, nperseg=64) for x in (left, again))
        np.testing.assert_allclose(np.log(made[1:]), np.log(planted[1:]), atol=0.35)


def test_without_samples_there_is_no_noise() -> None:
    assert to_noise_file(replace(diagnoses.NOTHING, traces=())) is None
