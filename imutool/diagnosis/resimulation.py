"""Resimulation with the physics that was found: how much closer to the recording it comes.

Nothing of the search is used but its answer, as physics.toml says it, fitted without the time that it is compared on. The
simulation's own poses become a smooth motion as `imutool simulate` makes it, the effects act on that, and samples are taken at
the recording's stamps, without noise. Times count from the recording's start, as those of the findings do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import msgspec
import numpy as np
from jaxtyping import Float64

from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.estimation.jacobians import expected
from imutool.diagnosis.estimation.whitening import WhitenedImu
from imutool.diagnosis.held_out import gains, noise_floor, with_constant
from imutool.diagnosis.result import Closer
from imutool.errors import DataError
from imutool.recording import Recording
from imutool.sensor.effect import Acting, simulate_stretches
from imutool.sensor.physics_file import PhysicsFile
from imutool.sensor.samples import IdealMotion
from imutool.sensor.simulate import MOTION_HZ
from imutool.sensor.trajectory import smooth_motion

AS_GOOD = 0.3  # of the noise: how far a simulation along the poses may be from the one that was given, and still stand for it
MOST_OF_IT = 0.8  # of the held-out samples that the poses have to cover


def resimulate(logs: Sequence[WhitenedImu], sim: Recording, physics: PhysicsFile) -> Mapping[str, Closer]:
    """Gain of a second simulation with some physics by signal, on held-out time.

    Raises:
        DataError: the simulation has no poses that stand for its samples, or they cover too little of a log.
        ImutoolError: its poses are no motion, or the physics cannot act on it.
    """
    if not sim.truths:
        raise DataError("it has no poses", where=sim.name, expected="poses to simulate along")
    motion = smooth_motion(sim.truth)
    rate_hz = 1.0 / sim.imu.period_s
    ideals = motion.ideal_motions(rate_hz * max(1, int(np.ceil(MOTION_HZ / rate_hz))))
    acting = physics.acting()
    covered, before, after = [], [], []
    for log in logs:
        on_its_clock = [_on_clock_of(one, motion.start_ns, log.pair) for one in ideals]
        plain, simulated = (_read(log.pair, on_its_clock, effects) for effects in ((), acting))
        finite = np.isfinite(plain).all(axis=1) & np.isfinite(simulated).all(axis=1)
        pair = replace(log.pair, fitted=log.pair.fitted & finite, held_out=log.pair.held_out & finite)
        if pair.held_out.sum() < MOST_OF_IT * log.pair.held_out.sum():
            raise DataError("its poses cover too little of the recording", where=sim.name)
        covered.append(WhitenedImu(pair, log.whiten))
        before.append(with_constant(pair, expected(pair, ())))
        after.append(with_constant(pair, simulated))
        _refuse_unlike(covered[-1], before[-1], with_constant(pair, plain), sim)
    return {
        signal: msgspec.structs.replace(one, by="second simulation") for signal, one in gains(covered, before, after).items()
    }


def _on_clock_of(ideal: IdealMotion, start_ns: int, pair: Pair) -> IdealMotion:
    """On the recording's clock, with its channels."""
    first_ns = pair.start_ns - round(float(pair.stamp_s[0]) * 1e9)
    t_s = ideal.t_s + (start_ns - first_ns) * 1e-9 - pair.aligned_s
    channels = {name: np.interp(t_s, pair.ideal.t_s, values) for name, values in pair.ideal.channels.items()}
    return replace(ideal, t_s=t_s, channels=channels)


def _read(pair: Pair, ideals: Sequence[IdealMotion], acting: Acting) -> Float64[np.ndarray, "n 6"]:
    """What the second simulation reads at the recording's stamps; NaN where it has no motion."""
    stamps = [pair.stamp_s[(pair.stamp_s >= one.t_s[0]) & (pair.stamp_s <= one.t_s[-1])] for one in ideals]
    samples = simulate_stretches(ideals, stamps, acting)
    out = np.full(pair.real.shape, np.nan)
    out[np.searchsorted(pair.stamp_s, samples.stamp_s)] = np.concatenate([samples.gyro, samples.accel], axis=1)
    return out


def _refuse_unlike(
    log: WhitenedImu, given: Float64[np.ndarray, "n 6"], plain: Float64[np.ndarray, "n 6"], sim: Recording
) -> None:
    """Refuse poses so coarse or noisy that they give another simulation than the given one.

    Raises:
        DataError: so it is here.
    """
    rows = log.pair.held_out
    off = np.sqrt(((given - plain)[rows] ** 2).mean(axis=0))
    if (off > AS_GOOD * noise_floor([log])).any():
        raise DataError("a simulation along its poses is not the simulation that was given", where=sim.name)
