"""Rigid motion that brings estimated positions nearest to the true ones, by their moments."""

from __future__ import annotations

import numpy as np

from imutool.array_types import Float64
from imutool.errors import NumericsError

# least singular value (m²): below it positions lie on a line for evo, and rotation about the line is free
FLAT = np.finfo(np.float64).eps
ROUNDED = 1e-12  # of the largest singular value: a straight path is off its line by rounding, to a millionth of its length

Points = Float64[np.ndarray, "n 3"]
Motion = tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]


def align(p: Points, p_target: Points) -> Motion | None:
    """Rotation and shift of the least-squares alignment of points.

    Umeyama 1991, eq. 40-42, scale 1.

    None if the points do not determine the rotation: fewer than two directions in their covariance.

    Raises:
        NumericsError: the covariance of the positions overflows.
    """
    moments = Moments()
    moments.add(p, p_target)
    return moments.motion()


class Moments:
    """Means and covariance of pairs of points that come in blocks.

    Chan, Golub and LeVeque 1983.
    """

    def __init__(self) -> None:
        self._count, self._centre, self._centre_target, self._products = 0, np.zeros(3), np.zeros(3), np.zeros((3, 3))

    def add(self, p: Points, p_target: Points) -> None:
        """Adds points and where they should be."""
        centre, centre_target = p.mean(axis=0), p_target.mean(axis=0)
        self._products += (p_target - centre_target).T @ (p - centre)
        off, off_target = centre - self._centre, centre_target - self._centre_target
        total = self._count + len(p)
        self._products += np.outer(off_target, off) * (self._count * len(p) / total)
        self._centre = self._centre + off * (len(p) / total)
        self._centre_target = self._centre_target + off_target * (len(p) / total)
        self._count = total

    def motion(self) -> Motion | None:
        """The alignment, as `align` of all points.

        Raises:
            NumericsError: the covariance of the positions overflows.
        """
        covariance = self._products / self._count
        if not np.isfinite(covariance).all():
            raise NumericsError("positions overflow when aligned", expected="positions within range", fix="Shorten the log")
        u, size, vt = np.linalg.svd(covariance)
        if np.count_nonzero(size > max(FLAT, ROUNDED * size[0])) < 2:
            return None
        mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])  # a rotation, not a reflection
        R = u @ mirror @ vt
        return R, self._centre_target - R @ self._centre
