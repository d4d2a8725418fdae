"""Checks that need no reference: dropped samples, quantization, saturation, stuck axes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from imutool.diagnosis.estimation import timestamps
from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.quantity import percent
from imutool.diagnosis.result import Diagnosis, Estimate, Finding, HeldOut
from imutool.inertial.stationary import white_noise
from imutool.recording import Recording, seconds
from imutool.sensor import catalogue
from imutool.sensor.samples import IdealMotion
from imutool.units import AXES, SENSORS, UNITS

SOME = 0.05  # of the samples of an axis at its limit, from which it is reported
BY_THEMSELVES = frozenset({"saturation", "quantization"})  # of the catalogue


def check_without_reference(real: Recording, path: str, why: str) -> Diagnosis:
    """Diagnosis without a reference: missing samples, quantization, saturation; `why` says why there is none.

    The constant bias is not known either (NaN).
    """
    stamp_s = seconds(real.imu.t_ns, int(real.imu.t_ns[0]))
    samples, none = np.concatenate([real.imu.gyro, real.imu.accel], axis=1), np.zeros(len(stamp_s), bool)
    pair = Pair(real.name, stamp_s, samples, none, none, felt=IdealMotion(stamp_s, *np.zeros((3, len(stamp_s), 3))))
    findings = [*timestamps.dropped([pair]), *timestamps.rounded([pair], white_noise(samples)), *_limits(pair)]
    told = f"{why.rstrip('.')}. Only what stamps and digits show by themselves could be asked"
    hidden = tuple(one.name for one in catalogue.diagnosed() if one.name not in BY_THEMSELVES)
    return Diagnosis((path,), None, (), tuple(findings), np.full((1, 6), np.nan), hidden, {}, (told,))


def _limits(pair: Pair) -> list[Finding]:
    """Saturation: samples that pile up at the largest value."""
    most = timestamps.limits(pair.real)
    if not most:
        return []
    told = {f"{signal}_limit": Estimate(value, 0.0, UNITS[signal]) for signal, value in most.items()}
    length = round(float(pair.stamp_s[-1] - pair.stamp_s[0]), 1)
    signal = next(iter(most)) if len(most) == 1 else "both"
    nothing = HeldOut(0.0, 0.0, "-", length)
    return [Finding("saturation", signal, 0.0, 0.0, 0.0, told, "readings pile up at +-limit", nothing)]


def unusable_axes(pair: Pair) -> list[str]:
    """Unusable axes of a log, with the reason."""
    stuck, clipped, ended, out = timestamps.stuck(pair.real), timestamps.clipped(pair.real).mean(axis=0), at_limit(pair), []
    for a in np.flatnonzero(stuck & ~ended):
        signal = SENSORS[a // 3]
        out.append(f"{signal} {AXES[a % 3]} reads {pair.real[0, a]:.4g} {UNITS[signal]} in every sample")
    for signal, most in timestamps.limits(pair.real).items():
        k = 3 * SENSORS.index(signal)
        share = ", ".join(f"{AXES[a - k]} in {percent(float(clipped[a]))}" for a in range(k, k + 3) if ended[a])
        if share:
            out.append(f"{signal} is at its limit of {most:.4g} {UNITS[signal]}: {share} of the samples")
    return out


def at_limit(pair: Pair) -> Bool[np.ndarray, "6"]:
    """Axes that are clipped in more than 5 % of the samples."""
    return np.asarray(timestamps.clipped(pair.real).mean(axis=0) > SOME)
