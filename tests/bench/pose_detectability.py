"""Detectability of a blind case from poses alone: power of the poses' own noise instead of a simulation's.

Used by `diagnose.py --no-sim`, which counts only the cases that poses show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from imutool.array_types import Rows6
from imutool.blind_cases import LONGEST_S, POSE_NOISE, plan, random_case
from imutool.blind_cases.detectability import DECIMATION, Detectability, with_catalogue
from imutool.blind_cases.effects import Stage
from imutool.blind_cases.envelope import ConcealedTruth
from imutool.blind_cases.scene import POSE_RATE_HZ, RATE_HZ, Scene
from imutool.errors import DataError
from imutool.mcap_io.read import read
from imutool.recording import GRAVITY_M_S2

CLOSE = 0.9  # as near to the wanted misfit as `random_case.sized` comes


@dataclass(frozen=True, eq=False)
class PoseDetectability(Detectability):
    """Detectability against poses with white noise `pose_noise` (m, rad)."""

    pose_noise: tuple[float, float] = POSE_NOISE

    def whitened(self, misfit: Rows6) -> Float64[np.ndarray, " m"]:
        """Misfit over the noise of sensor and differentiated poses, without its mean, scaled to all samples."""
        centred = misfit - misfit.mean(axis=0)
        dt = DECIMATION / RATE_HZ
        power = pose_noise_power(np.fft.rfftfreq(len(centred), dt), self.scene.noise, self.pose_noise)
        return np.asarray(np.fft.irfft(np.fft.rfft(centred, axis=0) * np.sqrt(dt / power), n=len(centred), axis=0).ravel())


def pose_noise_power(
    f_hz: Float64[np.ndarray, " f"], noise: Float64[np.ndarray, "6"], pose_noise: tuple[float, float]
) -> Float64[np.ndarray, "f 6"]:
    """Power density (two-sided, per Hz) of a sensor's noise and of white poses: differentiated, and as a tilt of gravity."""
    sensor, omega = noise**2 / RATE_HZ, (2.0 * np.pi * f_hz)[:, None] * np.ones(3)
    p, q = (std**2 / POSE_RATE_HZ for std in pose_noise)
    return np.asarray(sensor + np.concatenate([omega**2 * q, omega**4 * p + GRAVITY_M_S2**2 * q], axis=1))


def beside_poses(scene: Scene, pose_noise: tuple[float, float] = POSE_NOISE) -> PoseDetectability:
    """Detectability of misfits in a scene against noisy poses."""
    return with_catalogue(PoseDetectability(scene, scene.t_s[::DECIMATION], {}, pose_noise))


def is_detectable(seen: Detectability, concealed: random_case.Concealed) -> bool:
    """Whether everything in a case is as clear as `draw` asks; stamps, digits and lost poses always are."""
    effects = [(m, theta) for m, theta in concealed.acting if m.stage != Stage.STAMPS and m.name not in random_case.FIXED_SMALL]
    for model, theta in effects:
        clear = seen.distinct_misfit(model, theta)[0] >= random_case.wanted_misfit(model) * CLOSE
        if not clear or (concealed.kind == "unknown" and not random_case.has_no_name(seen, model, theta)):
            return False
    return len(effects) < 2 or random_case.distinct(seen, effects[0], effects[1])


def detectable_from_poses(trajectory: Path, truth: ConcealedTruth, effects: Sequence[str] = ()) -> bool:
    """Whether poses alone show an opened case, made of this trajectory with these `effects` asked for.

    The case is planned again by its seed.

    Raises:
        DataError: another trajectory, or other effects, than the case was made with.
    """
    planned = plan(read(trajectory), truth.seed, truth.kind, truth.size, truth.noise, effects, LONGEST_S)
    if [model.name for model, _ in planned.concealed.acting] != [effect.effect for effect in truth.effects]:
        raise DataError("the case was not made of this", where=trajectory, expected=truth.trajectory)
    return is_detectable(beside_poses(planned.scene), planned.concealed)
