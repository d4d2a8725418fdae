"""Detectability of a misfit against noise, given the bias and similar effects.

For white Gaussian noise the information (Fisher) that samples hold on parameters is J^T J, J the signal's derivatives over the
noise; nuisances (a constant bias, another effect) are projected out of J. A misfit m that the noise hides half of the time has
|m|² = detectable_misfit(p): the noncentrality at which the chi-square test of p parameters, with one false alarm in a
thousand, has a power of one half.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2

from imutool.array_types import Float64, Rows6
from imutool.blind_cases.catalogue import AXES, CATALOGUE
from imutool.blind_cases.effects import ACCEL, GYRO, Model, Stage, Theta, Times
from imutool.blind_cases.envelope import Location, Marks, Rms
from imutool.blind_cases.scene import RATE_HZ, Acting, Scene

FALSE_ALARM, POWER = 1e-3, 0.5
DECIMATION = 4  # the misfit is slow against 200 Hz
STEP = 0.02  # of the plausible size, for derivatives
DISSIMILAR = {"vibration", "earth_rotation", "mount_resonance"}  # resemble nothing that a motion of some hertz does
SPECIAL_CASE_OF = {  # by definition
    "lever_arm": {"size_effect"},
    "clock_offset": {"clock_jump"},
    "gyro_scale": {"gyro_scale_asymmetry"},  # of an axis that never changes its sign
    "accel_scale": {"accel_scale_asymmetry"},
}

WINDOW_S = 1.0
CLEAR, NONE = 30.0, 5.0  # squared misfit over the noise in a window, or a column
SMALL_AXIS = (0.05, 0.01)  # of the strongest column: at least, at most
CONTRAST = 0.1  # of the windows show nothing, or the misfit has no location in time
MARKS = ".?#"  # nothing, doubtful, clear


def detectable_misfit(parameters: int) -> float:
    """Squared misfit over the noise at which an optimal test has a power of one half."""
    threshold = chi2.isf(FALSE_ALARM, parameters)
    return float(brentq(lambda nc: ncx2.sf(threshold, parameters, nc) - POWER, 1e-3, 10.0 * threshold))


@dataclass(frozen=True, eq=False)
class Detectability:
    """A scene with the tangents of every effect of the catalogue, as orthonormal columns.

    An effect with a parameter that is no amount has a set of columns for each of some values of it.
    """

    scene: Scene
    t_s: Times
    columns: dict[str, list[Float64[np.ndarray, "m _"]]]

    def whitened(self, misfit: Rows6) -> Float64[np.ndarray, " m"]:
        """Misfit over the noise, without its mean (a bias), scaled to all samples."""
        return np.asarray(((misfit - misfit.mean(axis=0)) / self.scene.sigma).ravel() * np.sqrt(DECIMATION))

    def misfit(self, acting: Acting) -> Float64[np.ndarray, " m"]:
        """Whitened misfit of some effects."""
        return self.whitened(self.scene.misfit(acting, self.t_s))

    def squared_misfit(self, acting: Acting) -> float:
        """Squared misfit over the noise."""
        return float(np.sum(self.misfit(acting) ** 2))

    def distinct_misfit(self, model: Model, theta: Theta) -> tuple[float, str]:
        """Squared misfit after a fit of the most similar other effect, and that effect's name."""
        misfit = self.misfit([(model, theta)])
        remaining = {"": float(misfit @ misfit)}
        for name, bases in self.columns.items():
            if name != model.name and name not in SPECIAL_CASE_OF.get(model.name, set()):
                remaining[name] = remaining[""] - max(float(np.sum((basis.T @ misfit) ** 2)) for basis in bases)
        nearest = min(remaining, key=lambda name: remaining[name])
        return remaining[nearest], nearest

    def misfit_beyond(self, effect: tuple[Model, Theta], other: tuple[Model, Theta]) -> float:
        """Squared misfit of one effect that the other cannot explain, whatever its parameters."""
        misfit = self.misfit([effect])
        own = self.misfit([other])[:, None]
        remaining = [float(misfit @ misfit)]
        for columns in self.columns.get(other[0].name, [own[:, :0]]):
            basis = np.linalg.qr(np.concatenate([own, columns], axis=1))[0]
            remaining.append(remaining[0] - float(np.sum((basis.T @ misfit) ** 2)))
        return min(remaining)


Seen = TypeVar("Seen", bound=Detectability)


def detectability(scene: Scene) -> Detectability:
    """Detectability of misfits in a scene, given every effect of the catalogue."""
    return with_catalogue(Detectability(scene, scene.t_s[::DECIMATION], {}))


def with_catalogue(seen: Seen) -> Seen:
    """Adds the tangents of every effect of the catalogue."""
    for name, model in CATALOGUE.items():
        sets = [[seen.misfit([(model, theta)]) for theta in together] for together in _small(model, seen.scene.duration_s)]
        if sets:
            seen.columns[name] = [_orthonormal(np.stack(tangents, axis=1)) for tangents in sets]
    return seen


def _small(model: Model, duration_s: float) -> list[list[Theta]]:
    """Small effects of one parameter each, once for each value of those that are no amounts."""
    if model.name in DISSIMILAR or model.stage > Stage.SENSOR:
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
    """Basis of the columns' span, each column with the same weight."""
    lengths = np.linalg.norm(columns, axis=0)
    left, singular, _ = np.linalg.svd(columns[:, lengths > 0.0] / lengths[lengths > 0.0], full_matrices=False)
    out: Float64[np.ndarray, "m q"] = left[:, singular > 1e-6]
    return out


def cramer_rao_bounds(scene: Scene, acting: Acting) -> list[Theta | None]:
    """Smallest standard deviations of unbiased estimates of the parameters (Cramér and Rao).

    The bias counts as unknown. All effects are estimated together. None for effects without a derivative; infinite where
    nothing can be seen.
    """
    looked = Detectability(scene, scene.t_s[::DECIMATION], {})
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
    bounds: list[Theta | None] = [np.full(len(theta), np.inf) if model.smooth else None for model, theta in acting]
    if columns:
        for (which, k), std in zip(places, _deviations(np.stack(columns, axis=1)), strict=True):
            of_model = bounds[which]
            if of_model is not None:
                of_model[k] = std
    return bounds


def _deviations(jacobian: Float64[np.ndarray, "m p"]) -> list[float]:
    """Square roots of the diagonal of (J^T J)^-1; infinite for parameters that J does not separate."""
    lengths = np.linalg.norm(jacobian, axis=0)
    _, singular, right = np.linalg.svd(jacobian / np.where(lengths > 0.0, lengths, 1.0), full_matrices=False)
    good = singular > 1e-7
    variance = np.sum((right[good] / singular[good, None]) ** 2, axis=0) / np.where(lengths > 0.0, lengths, 1.0) ** 2
    hidden = (np.sum(right[~good] ** 2, axis=0) > 1e-6) | (lengths == 0.0)
    return [float(np.inf if lost else np.sqrt(v)) for v, lost in zip(variance, hidden, strict=True)]


# ── where it can be seen ──


def location(misfit: Rows6, sigma: Theta) -> Location:
    """Marks of each second and axis by sensor, and whether the misfit has a location in time.

    `misfit`: real minus simulated samples without noise, at 200 Hz; `sigma`: the standard deviation of the noise, by column.
    """
    misfit = (misfit - np.median(misfit, axis=0)) / sigma  # the mean would be wrong wherever an effect is at work rarely
    per_window = round(WINDOW_S * RATE_HZ)
    count = len(misfit) // per_window
    windows = np.sum(misfit[: count * per_window].reshape(count, per_window, 6) ** 2, axis=1)
    columns = np.sum(misfit**2, axis=0)
    floor = np.maximum(np.array([NONE, CLEAR]), np.array(SMALL_AXIS)[::-1] * columns.max())
    marks = []
    for part in (GYRO, ACCEL):
        seconds = _marks(windows[:, part].sum(axis=1), NONE, CLEAR)
        axes = dict(zip(AXES, _marks(columns[part], float(floor[0]), float(floor[1])), strict=True))
        marks.append(Marks(seconds, axes, "#" in seconds and seconds.count(".") >= CONTRAST * count))
    return Location(WINDOW_S, *marks)


def achievable_rms(misfit: Rows6, sigma: Theta) -> dict[str, Rms]:
    """RMS of real minus simulated samples by sensor, bias removed: with misfit, and of noise."""
    misfit = misfit - misfit.mean(axis=0)
    found = {}
    for name, part in (("gyro", GYRO), ("accel", ACCEL)):
        noise = float(np.mean(sigma[part] ** 2))
        found[name] = Rms(float(np.sqrt(np.mean(misfit[:, part] ** 2) + noise)), float(np.sqrt(noise)))
    return found


def _marks(energy: np.ndarray, none: float, clear: float) -> str:
    return "".join(MARKS[(value >= none) + (value >= clear)] for value in energy.tolist())
