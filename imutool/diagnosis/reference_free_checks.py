"""What a recording says of itself, where nothing says what it should have read: stamps, digits and limits."""

from __future__ import annotations

import numpy as np

from imutool.diagnosis.estimation import timestamps
from imutool.diagnosis.estimation.alignment import Pair
from imutool.diagnosis.result import Diagnosis, Estimate, Finding, HeldOut
from imutool.inertial.stationary import white_noise
from imutool.recording import Recording, seconds
from imutool.sensor import catalogue
from imutool.sensor.samples import IdealMotion
from imutool.units import UNITS

BY_THEMSELVES = frozenset({"saturation", "quantization"})  # of the catalogue


def by_samples(real: Recording, path: str, why: str) -> Diagnosis:
    """Missing samples, coarse digits and a limit that is reached; all else cannot be told, for the reason that is given.

    The constant bias is not known either (NaN).
    """
    stamp_s = seconds(real.imu.t_ns, int(real.imu.t_ns[0]))
    samples, none = np.concatenate([real.imu.gyro, real.imu.accel], axis=1), np.zeros(len(stamp_s), bool)
    pair = Pair(real.name, IdealMotion(stamp_s, *np.zeros((3, len(stamp_s), 3))), stamp_s, samples, none, none)
    findings = [*timestamps.dropped([pair]), *timestamps.rounded([pair], white_noise(samples)), *_limits(pair)]
    told = f"{why.rstrip('.')}. Only what stamps and digits show by themselves could be asked"
    hidden = tuple(one.name for one in catalogue.diagnosed() if one.name not in BY_THEMSELVES)
    return Diagnosis((path,), None, (), tuple(findings), np.full((1, 6), np.nan), hidden, {}, (told,))


def _limits(pair: Pair) -> list[Finding]:
    """Readings that come again and again at the largest of all."""
    most = timestamps.limits(pair.real)
    if not most:
        return []
    told = {f"{signal}_limit": Estimate(value, 0.0, UNITS[signal]) for signal, value in most.items()}
    length = round(float(pair.stamp_s[-1] - pair.stamp_s[0]), 1)
    signal = next(iter(most)) if len(most) == 1 else "both"
    nothing = HeldOut(0.0, 0.0, "-", length)
    return [Finding("saturation", signal, 0.0, 0.0, 0.0, told, "readings pile up at +-limit", nothing)]
