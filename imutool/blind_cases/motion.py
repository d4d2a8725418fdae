"""Smooth motion through true poses, and the kinematics of an ideal sensor along it.

Position and quaternion are penalised B-splines (Eilers & Marx 1996: a difference penalty on the coefficients) of degree 5,
fitted robustly, so that outliers and gaps of a motion capture leave no jerk. The splines are the truth of a blind case by
definition; their distance from the recorded poses only decides how lifelike the motion is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded

from imutool.array_types import Float64, Vectors
from imutool.errors import DataError
from imutool.recording import GRAVITY_M_S2, Poses, seconds

DEGREE, KNOT_S = 5, 0.05
ROUNDS, OUTLIER = 5, 4.0  # of reweighting; a pose this many robust standard deviations away has no weight
SLOWEST_HZ, FASTEST_HZ = 2.0, 8.0  # between these the smoothing is cut off, according to the poses' noise
SPURIOUS = (0.1, 0.1)  # m/s² and rad/s²: how much of the second derivative may be the poses' noise
SHORTEST_S = 20.0
KEPT = 3  # vectors of times: those of a misfit, and the finer ones before a filter

Times = Float64[np.ndarray, " n"]
Knots = Float64[np.ndarray, " m"]


@dataclass(frozen=True, eq=False)
class Kinematics:
    """Rate omega (rad/s), derivative alpha, specific force f = R_wb^T (a_w - g_w), body frame."""

    t_s: Times
    omega: Vectors
    alpha: Vectors
    f: Vectors
    R_wb: Float64[np.ndarray, "n 3 3"]


@dataclass(frozen=True, eq=False)
class Motion:
    """Splines of position (m) and a multiple of q_wb (wxyz), valid from `first_s` to `last_s`."""

    position: BSpline
    quaternion: BSpline
    first_s: float
    last_s: float
    known: dict[bytes, Kinematics] = field(default_factory=dict, init=False, repr=False)

    def kinematics(self, t_s: Times) -> Kinematics:
        """Kinematics of the tracked point; times beyond the ends are held there.

        Those at the last few vectors of times are kept: hundreds of effects are tried at the same ones.
        """
        asked = np.asarray(t_s, dtype=np.float64).tobytes()
        found = self.known[asked] = self.known.pop(asked) if asked in self.known else self._kinematics(t_s)
        while len(self.known) > KEPT:
            self.known.pop(next(iter(self.known)))
        return found

    def _kinematics(self, t_s: Times) -> Kinematics:
        """R(Q) does not change with the length of Q: omega = 2 Im(Q* Q') / |Q|², and alpha is its derivative."""
        t = np.clip(t_s, self.first_s, self.last_s)
        q, dq, ddq = (self.quaternion(t, order) for order in range(3))
        length2 = np.sum(q * q, axis=1)[:, None]
        omega = 2.0 * _vector_part(q, dq) / length2
        alpha = (2.0 * _vector_part(q, ddq) - 2.0 * omega * np.sum(q * dq, axis=1)[:, None]) / length2
        R_wb = _matrix(q / np.sqrt(length2))
        up = np.array([0.0, 0.0, GRAVITY_M_S2])
        f = np.einsum("nji,nj->ni", R_wb, self.position(t, 2) + up)
        return Kinematics(np.asarray(t_s, dtype=np.float64), omega, alpha, f, R_wb)

    def pose(self, t_s: Times) -> tuple[Vectors, Float64[np.ndarray, "n 4"]]:
        """Position and unit quaternion (wxyz) at some times."""
        q_wxyz = self.quaternion(t_s)
        return np.asarray(self.position(t_s)), q_wxyz / np.linalg.norm(q_wxyz, axis=1, keepdims=True)


@dataclass(frozen=True, eq=False)
class Smoother:
    """True poses with the penalty and the robust weights of their splines."""

    t_s: Times
    p_wb: Vectors
    q_wb_wxyz: Float64[np.ndarray, "n 4"]
    penalty: tuple[float, float]
    weights: Mapping[str, Times] = field(default_factory=dict)

    def motion(self, without: tuple[tuple[float, float], ...] = ()) -> Motion:
        """Motion through the poses; those in the intervals `without` (s) are left out and bridged."""
        kept = np.ones(len(self.t_s), dtype=bool)
        for start, end in without:
            kept &= (self.t_s < start) | (self.t_s > end)
        knots = _knots(float(self.t_s[0]), float(self.t_s[-1]))
        fits = []
        for name, y, penalty in (("p", self.p_wb, self.penalty[0]), ("q", self.q_wb_wxyz, self.penalty[1])):
            fits.append(_solve(self.t_s, y, self.weights[name] * kept, knots, penalty))
        return Motion(fits[0], fits[1], float(self.t_s[0]), float(self.t_s[-1]))


def smoother(poses: Poses) -> Smoother:
    """Smoother of true poses.

    Continuous quaternions, penalty by their noise, no weight on outliers.

    Raises:
        DataError: fewer poses than 20 s of any motion capture give, or shorter than that.
    """
    if poses.duration_s < SHORTEST_S or len(poses) < 10 * SHORTEST_S:
        raise DataError(
            f"true poses: {len(poses)} over {poses.duration_s:.1f} s",
            expected=f"at least {SHORTEST_S:g} s, ten poses a second",
            fix="Choose a longer trajectory",
        )
    t = seconds(poses.t_ns, int(poses.t_ns[0]))
    q_wxyz = poses.q_wb_wxyz * _signs(poses.q_wb_wxyz)[:, None]
    knots = _knots(0.0, float(t[-1]))
    penalties, weights = [], {}
    for name, y, spurious in (("p", poses.p_wb, SPURIOUS[0]), ("q", q_wxyz, SPURIOUS[1] / 2.0)):  # |q'| is half the rate
        penalties.append(_penalty(t, y, spurious))
        weights[name] = _robust_weights(t, y, knots, penalties[-1])
    return Smoother(t, poses.p_wb, q_wxyz, (penalties[0], penalties[1]), weights)


def _penalty(t: Times, y: Float64[np.ndarray, "n k"], spurious: float) -> float:
    """Penalty that halves amplitudes at a frequency f, at which noise leaves `spurious` of second derivative.

    White noise of standard deviation s at rate r, cut off at f, gives s (2 pi f)² sqrt(2 f / (5 r)); third differences, whose
    variance is 20 s², tell s. Data weigh r a second, the penalty lambda (2 pi f h)^6 / h, h the knots' distance.
    """
    rate = 1.0 / float(np.median(np.diff(t)))
    noise = float(np.median(np.abs(np.diff(y, n=3, axis=0)))) / 0.6745 / np.sqrt(20.0) + 1e-9
    f_hz = (spurious / (noise * 4.0 * np.pi**2) * np.sqrt(2.5 * rate)) ** 0.4
    f_hz = float(np.clip(f_hz, SLOWEST_HZ, FASTEST_HZ))
    return rate * KNOT_S / (2.0 * np.pi * f_hz * KNOT_S) ** 6


def _robust_weights(t: Times, y: Float64[np.ndarray, "n k"], knots: Knots, penalty: float) -> Times:
    """Tukey's biweight: one near the smooth curve, falling to zero for outliers."""
    weights = np.ones(len(t))
    for _ in range(ROUNDS):
        away = np.linalg.norm(y - _solve(t, y, weights, knots, penalty)(t), axis=1)
        scale = float(np.median(away)) + 1e-7
        weights = np.clip(1.0 - (away / (OUTLIER * 2.0 * scale)) ** 2, 1e-6, 1.0) ** 2
    return weights


def _knots(first_s: float, last_s: float) -> Knots:
    inner = np.linspace(first_s, last_s, int(np.ceil((last_s - first_s) / KNOT_S)) + 1)
    step = inner[1] - inner[0]
    before = first_s - step * np.arange(DEGREE, 0, -1)
    return np.concatenate([before, inner, last_s + step * np.arange(1, DEGREE + 1)])


def _solve(t: Times, y: Float64[np.ndarray, "n k"], weights: Times, knots: Knots, penalty: float) -> BSpline:
    """The penalised least-squares spline: (B^T W B + lambda D^T D) c = B^T W y, D third differences, banded."""
    basis = BSpline.design_matrix(t, knots, DEGREE)
    weighted = basis.multiply(weights[:, None]).tocsr()
    normal = (basis.T @ weighted).todia()
    size = basis.shape[1]
    band = np.zeros((DEGREE + 1, size))
    for offset, row in zip(normal.offsets, normal.data, strict=True):
        if 0 <= offset <= DEGREE:
            band[DEGREE - offset] = row[:size]
    rows = np.convolve([1.0, -1.0], np.convolve([1.0, -1.0], [1.0, -1.0]))  # third difference
    for shift in range(4):
        products = rows[: 4 - shift] * rows[shift:]
        for k, product in enumerate(products):  # D^T D at (k + i, k + shift + i) for each difference i
            columns = np.arange(size - 3) + k + shift
            band[DEGREE - shift, columns] += penalty * product
    return BSpline(knots, solveh_banded(band, weighted.T @ y), DEGREE)


def _signs(q_wxyz: Float64[np.ndarray, "n 4"]) -> Times:
    """Signs that keep neighbours in one hemisphere."""
    return np.concatenate([[1.0], np.cumprod(np.where(np.sum(q_wxyz[1:] * q_wxyz[:-1], axis=1) < 0.0, -1.0, 1.0))])


def _vector_part(a: Float64[np.ndarray, "n 4"], b: Float64[np.ndarray, "n 4"]) -> Vectors:
    """Of the product of the conjugate of a with b."""
    out: Vectors = a[:, :1] * b[:, 1:] - b[:, :1] * a[:, 1:] - np.cross(a[:, 1:], b[:, 1:])
    return out


def _matrix(q_wxyz: Float64[np.ndarray, "n 4"]) -> Float64[np.ndarray, "n 3 3"]:
    """Rotation matrices of unit quaternions wxyz."""
    w, x, y, z = q_wxyz.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)
