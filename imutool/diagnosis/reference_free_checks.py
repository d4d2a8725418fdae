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
    """Diagnosis without a reference, for the reason `why`: gaps, quantization, saturation.

    The constant bias is not known either (NaN).
    """
    stamp_s = seconds(real.imu.t_ns, int(real.imu.t_ns[0]))
    samples, no_rows = np.concatenate([real.imu.gyro, real.imu.accel], axis=1), np.zeros(len(stamp_s), bool)
    pair = Pair(real.name, stamp_s, samples, no_rows, no_rows, ideal=IdealMotion(stamp_s, *np.zeros((3, len(stamp_s), 3))))
    findings = [*timestamps.dropped([pair]), *timestamps.rounded([pair], white_noise(samples)), *_limits(pair)]
    remark = f"{why.rstrip('.')}. Only what stamps and digits show by themselves could be asked"
    hidden = tuple(effect.name for effect in catalogue.diagnosed() if effect.name not in BY_THEMSELVES)
    return Diagnosis((path,), None, (), tuple(findings), np.full((1, 6), np.nan), hidden, {}, (remark,))


def _limits(pair: Pair) -> list[Finding]:
    """Saturation: samples that pile up at the largest value."""
    limits = timestamps.limits(pair.real)
    if not limits:
        return []
    parameters = {f"{signal}_limit": Estimate(value, 0.0, UNITS[signal]) for signal, value in limits.items()}
    length = round(float(pair.stamp_s[-1] - pair.stamp_s[0]), 1)
    signal = next(iter(limits)) if len(limits) == 1 else "both"
    held_out = HeldOut(0.0, 0.0, "-", length)
    return [Finding("saturation", signal, 0.0, 0.0, 0.0, parameters, "readings pile up at +-limit", held_out)]


def unusable_axes(pair: Pair) -> list[str]:
    """Unusable axes of a log, with the reason."""
    stuck, clipped, saturated, out = timestamps.stuck(pair.real), timestamps.clipped(pair.real).mean(axis=0), at_limit(pair), []
    for a in np.flatnonzero(stuck & ~saturated):
        signal = SENSORS[a // 3]
        out.append(f"{signal} {AXES[a % 3]} reads {pair.real[0, a]:.4g} {UNITS[signal]} in every sample")
    for signal, most in timestamps.limits(pair.real).items():
        k = 3 * SENSORS.index(signal)
        share = ", ".join(f"{AXES[a - k]} in {percent(float(clipped[a]))}" for a in range(k, k + 3) if saturated[a])
        if share:
            out.append(f"{signal} is at its limit of {most:.4g} {UNITS[signal]}: {share} of the samples")
    return out


def at_limit(pair: Pair) -> Bool[np.ndarray, "6"]:
    """Axes that are clipped in more than 5 % of the samples."""
    return np.asarray(timestamps.clipped(pair.real).mean(axis=0) > SOME)
