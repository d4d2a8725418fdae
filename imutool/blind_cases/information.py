"""How well a case could be seen: misfit against noise, after the bias and after what resembles it (Fisher's information).

For white Gaussian noise the information that samples hold on parameters is J^T J, J the signal's derivatives over the noise;
what cannot be told from nuisances (a constant bias, another effect) is taken out of J by projection. A misfit m that the noise
hides half of the time is one of |m|² = visible(p): the noncentrality at which the chi-square test of p parameters, with one
false alarm in a thousand, has a power of one half.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2

from imutool.blind_cases.effects import CATALOGUE, Model, Six, Stage, Theta, Times
from imutool.blind_cases.scene import POSE_RATE_HZ, RATE_HZ, Acting, Scene
from imutool.recording import GRAVITY_M_S2

FALSE_ALARM, POWER = 1e-3, 0.5
EVERY = 4  # sample that is looked at: the misfit is slow against 200 Hz
STEP = 0.02  # of the plausible size, for derivatives
UNLIKE = {"vibration", "earth_rotation", "mount_resonance"}  # resemble nothing that a motion of some hertz does
WITHIN = {"lever_arm": {"size_effect"}, "clock_offset": {"clock_jump"}}  # by definition a case of the other


def visible(parameters: int) -> float:
    """The squared misfit over the noise that an optimal test of so many parameters sees every second time."""
    threshold = chi2.isf(FALSE_ALARM, parameters)
    return float(brentq(lambda nc: ncx2.sf(threshold, parameters, nc) - POWER, 1e-3, 10.0 * threshold))


@dataclass(frozen=True, eq=False)
class Sight:
    """A scene with what every effect of the catalogue would do to it, as orthonormal columns beside the bias.

    An effect with a parameter that is no amount has one set of columns for each of some values of it. `pose_noise` (m, rad) is
    that of poses which stand in for the simulation, none where there is one.
    """

    scene: Scene
    t_s: Times
    columns: dict[str, list[Float64[np.ndarray, "m _"]]]
    pose_noise: tuple[float, float] | None = None

    def whitened(self, misfit: Six) -> Float64[np.ndarray, " m"]:
        """Over the noise, without what a bias explains, counted for all samples."""
        over = misfit - misfit.mean(axis=0)
        if self.pose_noise is None:
            return np.asarray((over / self.scene.sigma).ravel() * np.sqrt(EVERY))
        dt = EVERY / RATE_HZ
        power = poses_power(np.fft.rfftfreq(len(over), dt), self.scene.noise, self.pose_noise)
        return np.asarray(np.fft.irfft(np.fft.rfft(over, axis=0) * np.sqrt(dt / power), n=len(over), axis=0).ravel())

    def misfit(self, acting: Acting) -> Float64[np.ndarray, " m"]:
        """What some effects do."""
        return self.whitened(self.scene.misfit(acting, self.t_s))

    def seen(self, acting: Acting) -> float:
        """Squared misfit over the noise."""
        return float(np.sum(self.misfit(acting) ** 2))

    def told_apart(self, model: Model, theta: Theta) -> tuple[float, str]:
        """The squared misfit that is left once the most similar other effect has been fitted, and that effect's name."""
        misfit = self.misfit([(model, theta)])
        left = {"": float(misfit @ misfit)}
        for name, bases in self.columns.items():
            if name != model.name and name not in WITHIN.get(model.name, set()):
                left[name] = left[""] - max(float(np.sum((basis.T @ misfit) ** 2)) for basis in bases)
        nearest = min(left, key=lambda name: left[name])
        return left[nearest], nearest

    def beside(self, one: tuple[Model, Theta], other: tuple[Model, Theta]) -> float:
        """The squared misfit of one effect that the other could not take over, whatever its parameters."""
        misfit = self.misfit([one])
        own = self.misfit([other])[:, None]
        left = [float(misfit @ misfit)]
        for columns in self.columns.get(other[0].name, [own[:, :0]]):
            basis = np.linalg.qr(np.concatenate([own, columns], axis=1))[0]
            left.append(left[0] - float(np.sum((basis.T @ misfit) ** 2)))
        return min(left)


def poses_power(
    f_hz: Float64[np.ndarray, " f"], noise: Float64[np.ndarray, "6"], pose_noise: tuple[float, float]
) -> Float64[np.ndarray, "f 6"]:
    """Power density (two-sided, per Hz) of a sensor's noise and of white poses: differentiated, and as a tilt of gravity."""
    sensor, omega = noise**2 / RATE_HZ, (2.0 * np.pi * f_hz)[:, None] * np.ones(3)
    p, q = (one**2 / POSE_RATE_HZ for one in pose_noise)
    return np.asarray(sensor + np.concatenate([omega**2 * q, omega**4 * p + GRAVITY_M_S2**2 * q], axis=1))


def sight(scene: Scene, pose_noise: tuple[float, float] | None = None) -> Sight:
    """The scene, looked at beside a simulation, or beside poses with white noise (m, rad)."""
    t_s = scene.t_s[::EVERY]
    out = Sight(scene, t_s, {}, pose_noise)
    for name, model in CATALOGUE.items():
        sets = [[out.misfit([(model, theta)]) for theta in together] for together in _small(model, scene.duration_s)]
        if sets:
            out.columns[name] = [_orthonormal(np.stack(tangents, axis=1)) for tangents in sets]
    return out


def _small(model: Model, duration_s: float) -> list[list[Theta]]:
    """Small effects of one parameter each, once for each value of those that are no amounts."""
    if model.name in UNLIKE or model.stage > Stage.SENSOR:
        return []
    if model.name == "low_pass":
        return [[np.array([f_c])] for f_c in (3.0, 6.0, 12.0, 25.0, 50.0, 100.0)]
    shapes = [model.plausible]
    if not model.amounts.all():
        shapes = [np.where(model.amounts, model.plausible, part * duration_s) for part in (0.1, 0.25, 0.4, 0.6)]
    found: list[list[Theta]] = []
    for shape in shapes:
        found.append([])
        for k in np.flatnonzero(model.amounts):
            single = np.where(model.amounts, 0.0, shape)
            single[k] = STEP * shape[k]
            found[-1].append(single)
    return found


def _orthonormal(columns: Float64[np.ndarray, "m p"]) -> Float64[np.ndarray, "m q"]:
    """A basis of what the columns span, each counted for as much as any other."""
    lengths = np.linalg.norm(columns, axis=0)
    scaled = columns[:, lengths > 0.0] / lengths[lengths > 0.0]
    left, singular, _ = np.linalg.svd(scaled, full_matrices=False)
    out: Float64[np.ndarray, "m q"] = left[:, singular > 1e-6]
    return out


def bounds(scene: Scene, acting: Acting) -> list[Theta | None]:
    """The smallest standard deviation that unbiased estimates of the parameters can have (Cramér and Rao), bias unknown.

    All effects are estimated together. None for effects that have no derivative; infinite where nothing can be seen.
    """
    looked = Sight(scene, scene.t_s[::EVERY], {})
    acting = list(acting)
    columns, places = [], []
    for which, (model, theta) in enumerate(acting):
        if not model.smooth:
            continue
        for k in range(len(theta)):
            step = 1e-3 * max(abs(float(theta[k])), model.plausible[k] * 1e-2)
            pair = []
            for sign in (1.0, -1.0):
                moved = theta.copy()
                moved[k] += sign * step
                pair.append(looked.misfit([*acting[:which], (model, moved), *acting[which + 1 :]]))
            columns.append((pair[0] - pair[1]) / (2.0 * step))
            places.append((which, k))
    found: list[Theta | None] = [np.full(len(theta), np.inf) if model.smooth else None for model, theta in acting]
    if columns:
        for (which, k), std in zip(places, _deviations(np.stack(columns, axis=1)), strict=True):
            one = found[which]
            if one is not None:
                one[k] = std
    return found


def _deviations(jacobian: Float64[np.ndarray, "m p"]) -> list[float]:
    """Square roots of the diagonal of (J^T J)^-1; infinite for what J does not see or sees in one combination only."""
    lengths = np.linalg.norm(jacobian, axis=0)
    scaled = jacobian / np.where(lengths > 0.0, lengths, 1.0)
    _, singular, right = np.linalg.svd(scaled, full_matrices=False)
    good = singular > 1e-7
    variance = np.sum((right[good] / singular[good, None]) ** 2, axis=0) / np.where(lengths > 0.0, lengths, 1.0) ** 2
    hidden = (np.sum(right[~good] ** 2, axis=0) > 1e-6) | (lengths == 0.0)
    return [float(np.inf if lost else np.sqrt(v)) for v, lost in zip(variance, hidden, strict=True)]
