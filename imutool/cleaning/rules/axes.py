"""Swapped or flipped axes: another signed permutation fits gravity or the poses better.

Only said, never mended. That both sensors are turned alike against the poses is a mount, and no defect. Of two sensors that
contradict one another gravity cannot say which has the wrong axes. And in level flight the specific force stays along the
thrust, so that gravity says nothing at all: then no turn of the gyro fits worse than every other.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from imutool.cleaning.finding import Finding
from imutool.cleaning.rule import Rule, TopicSummary
from imutool.cleaning.truth import feeling, turning
from imutool.recording import seconds

CLEARLY = 0.5  # of the misfit as it is, that of another reading at most; and of what there is to be explained
ALIKE = 1.3  # times the best misfit: readings that cannot be told from the best
POSES_APART_NS = 300_000_000
FEWEST_POSES, MOST_POSES = 10, 20_000  # evenly taken from a longer log
WINDOW = 20  # steps of 0.1 s over which the gyro must carry gravity along
MOST_WINDOWS = 400  # evenly taken from a longer log
LEAST_WINDOWS = 8
LEAST_TURN_RAD = 0.3  # over a window; less says nothing of axes


class Fit(NamedTuple):
    """Misfit of the 48 axis permutations, the identity first, and of a zero reading."""

    misfit: Float64[np.ndarray, "48"]
    nothing: float

    @property
    def explains(self) -> bool:
        """Whether any permutation fits better than a zero reading."""
        return float(self.misfit.min()) < CLEARLY * self.nothing

    @property
    def wrong(self) -> bool:
        """Whether another permutation fits clearly better than the identity and than zero."""
        return self.explains and float(self.misfit.min()) < CLEARLY * float(self.misfit[0])

    def within(self, times: float) -> Bool[np.ndarray, "48"]:
        """Permutations that fit nearly as well as the best."""
        return np.asarray(self.misfit <= times * self.misfit.min())


class Axes(Rule):
    """Rule for swapped or flipped axes; it runs after `units`.

    The poses decide where they can, else the other sensor does.
    """

    place = 130

    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """At most one for each sensor."""
        readings = signed_permutations()
        gyro, accel = _against_poses(whole, readings)
        fits = {name: fit for name, fit in (("gyro", gyro), ("accel", accel)) if fit is not None and fit.explains}
        wrong = {name: fit for name, fit in fits.items() if fit.wrong}
        turned = np.linalg.det(readings) > 0
        for fit in wrong.values():
            turned &= fit.within(1.0 / CLEARLY)
        if len(wrong) == 2 and turned.any():
            names = axis_names(readings[np.argmax(turned)])
            what = f"the body of the true poses is not the IMU's: its x, y, z seem to be the IMU's {names}"
            yield Finding("axes", "note", what, 3, values={"mount": names}, confidence=0.8)
            return
        for name, fit in wrong.items():  # where nothing is known of the other sensor, it may still be the mount
            yield _wrong(name, fit, readings, "the true poses", alone=len(fits) == 1)
        if "gyro" not in fits:
            beside = _against_gravity(whole, readings)
            if beside is not None and beside.wrong:
                yield _wrong("gyro", beside, readings, "gravity as accel reads it", alone=False)


def _wrong(sensor: str, fit: Fit, readings: Float64[np.ndarray, "48 3 3"], against: str, *, alone: bool) -> Finding:
    """Finding about wrong axes: of the equally good permutations the nearest to the identity."""
    alike = np.flatnonzero(fit.within(ALIKE))
    chosen = readings[alike[np.argmax(np.trace(readings[alike], axis1=1, axis2=2))]]
    names = axis_names(chosen)
    best, present = float(fit.misfit[alike].min()), float(fit.misfit[0])
    return Finding(
        "axes",
        "warning" if alone else "error",
        f"{sensor} contradicts {against}: its true x, y, z seem to be its {names}",
        int((np.abs(chosen - np.eye(3)).sum(axis=1) > 0).sum()),
        values={"sensor": sensor, "reading": names, "as_good": len(alike), "misfit": best, "misfit_as_is": present},
        confidence=0.5 if alone else 0.95 if len(alike) == 1 else 0.7,
        distrust="" if alone else f"the axes of {sensor} contradict {against}",
    )


def _against_poses(whole: TopicSummary, readings: Float64[np.ndarray, "48 3 3"]) -> tuple[Fit | None, Fit | None]:
    """Fits of gyro and accel to the true poses, in their body frame.

    The gyro is compared with the rate of the poses, the accel with gravity plus their acceleration.
    """
    step, raw = whole.motion.table()
    if whole.truth is None or len(step) < 2 or whole.motion.start_ns is None:
        return None, None
    t_s, mean = 0.1 * step + 0.05, raw * whole.scale

    def beside(
        at_ns: Int64[np.ndarray, " n"], apart_ns: Int64[np.ndarray, " n"], true: Float64[np.ndarray, "n 3"], k: int
    ) -> Fit | None:
        at_s = seconds(at_ns, int(whole.motion.start_ns or 0))
        use = np.flatnonzero((at_s > t_s[0]) & (at_s < t_s[-1]) & (apart_ns < POSES_APART_NS))
        if len(use) < FEWEST_POSES:
            return None
        use = use[:: -(-len(use) // MOST_POSES)]
        read = np.stack([np.interp(at_s[use], t_s, column) for column in mean[:, k : k + 3].T], axis=1)
        return _fit(true[use], read, readings)

    first, last, rate = turning(whole.truth)
    at_ns, force = feeling(whole.truth)
    mean[:, :3] -= np.median(mean[:, :3], axis=0)
    gyro = beside((first + last) // 2, last - first, rate - np.median(rate, axis=0), 0)
    return gyro, beside(at_ns, np.maximum(np.diff(first), np.diff(last)), force, 3)


def _fit(true: Float64[np.ndarray, "n 3"], read: Float64[np.ndarray, "n 3"], readings: Float64[np.ndarray, "48 3 3"]) -> Fit:
    misfit = [float(np.sqrt(np.median(((true - read @ P.T) ** 2).sum(axis=1)))) for P in readings]
    return Fit(np.array(misfit), float(np.sqrt(np.median((true**2).sum(axis=1)))))


def _against_gravity(whole: TopicSummary, readings: Float64[np.ndarray, "48 3 3"]) -> Fit | None:
    step, raw = whole.motion.table()
    misfit = tilt_misfit(step, raw * whole.scale, np.concatenate([readings, np.zeros((1, 3, 3))]))
    return None if misfit is None else Fit(misfit[:-1], float(misfit[-1]))


def signed_permutations() -> Float64[np.ndarray, "48 3 3"]:
    """Signed permutations of three axes: 24 rotations and 24 reflections, the identity first."""
    signed = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            P = np.zeros((3, 3))
            P[range(3), order] = signs
            signed.append(P)
    return np.stack(signed)


def axis_names(P: Float64[np.ndarray, "3 3"]) -> str:
    """Axis names of a signed permutation, as `+x +z -y`."""
    return " ".join(f"{'+' if row[np.argmax(np.abs(row))] > 0 else '-'}{'xyz'[int(np.argmax(np.abs(row)))]}" for row in P)


def tilt_misfit(
    step: Int64[np.ndarray, " m"], mean: Float64[np.ndarray, "m 6"], candidates: Float64[np.ndarray, "c 3 3"]
) -> Float64[np.ndarray, " c"] | None:
    """Gravity misfit (rad) of each candidate M: gyro rates M omega carry gravity for 2 s.

    In the frame of a window's start, the mean specific force of its first half and of its second are both gravity and what is
    left of the motion, whose velocity has bounds; the angle between them (rad), root median square over windows that turn.
    None where fewer than 8 windows turn by 0.3 rad.
    """
    gyro, accel = _windows(step, mean)
    if len(gyro) < LEAST_WINDOWS:
        return None
    return np.array([_misfit(gyro @ M.T, accel) for M in candidates])


def _windows(
    step: Int64[np.ndarray, " m"], mean: Float64[np.ndarray, "m 6"]
) -> tuple[Float64[np.ndarray, "w n 3"], Float64[np.ndarray, "w n 3"]]:
    """Angular rate and specific force in windows that turn and have no gap."""
    count = len(step) // WINDOW
    cut = mean[: count * WINDOW].reshape(count, WINDOW, 6)
    ends = step[: count * WINDOW].reshape(count, WINDOW)[:, [0, -1]]
    whole = ends[:, 1] - ends[:, 0] == WINDOW - 1
    rate = cut[..., :3] - np.median(mean[:, :3], axis=0) if len(mean) else cut[..., :3]
    turned = np.linalg.norm(rate, axis=2).sum(axis=1) * 0.1
    rows = np.flatnonzero(whole & (turned > LEAST_TURN_RAD))
    rows = rows[:: max(1, len(rows) // MOST_WINDOWS)]
    return rate[rows], cut[rows, :, 3:]


def _misfit(rate: Float64[np.ndarray, "w n 3"], accel: Float64[np.ndarray, "w n 3"]) -> float:
    from scipy.spatial.transform import Rotation

    R = Rotation.identity(len(rate))
    carried = np.empty_like(accel)
    for k in range(WINDOW):
        half = Rotation.from_rotvec(0.05 * rate[:, k])
        R = R * half
        carried[:, k] = R.apply(accel[:, k])
        R = R * half
    first, second = carried[:, : WINDOW // 2].mean(axis=1), carried[:, WINDOW // 2 :].mean(axis=1)
    size = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    cosine = np.einsum("ij,ij->i", first, second) / np.maximum(size, 1e-12)
    return float(np.sqrt(np.median(np.arccos(cosine.clip(-1.0, 1.0)) ** 2)))
