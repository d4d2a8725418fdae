"""Dynamics of jointed arms, identified from a simulation's own efforts and motion.

Inverse dynamics are linear in the inertial parameters (Atkeson, An, Hollerbach, Estimation of inertial parameters of
manipulator loads and links, IJRR 5, 1986). `chain_columns` holds for hinges with parallel axes, in absolute angles
phi_i = sum of +-q_j, j <= i, of the links: D_i (kg m²) of a link, H_ij = conj(P_i) A_j (kg m²) between two, A_i (kg m)
against gravity, with P_i the vector of a link in its own plane as a complex number. `general_columns` holds for other arms:
accelerations, products of velocities and gravity, each times sines and cosines of sums of angles.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from imutool.array_types import Complex128, Float64
from imutool.sensor.robot_effects.signal_samples import Column, Columns, State

GRAVITY_M_S2 = 9.81
MOST_JOINTS = 7
MOST_COMBINED = 3  # joints up to which all sums of angles are tried
RIDGE = 1e-9
WELL_DETERMINED = 0.02  # of the efforts' size that a fit may leave
STEEP = 0.01  # of a velocity's size, within which its sign turns


@dataclass(frozen=True)
class Dynamics:
    """Efforts of an arm as a function of its motion (`q0`, `dq0`, `ddq0`, ...).

    `signs` are those of the angles of a chain of parallel hinges, empty for any other arm; `left` is the standard deviation
    of what the fit did not explain, by joint.
    """

    joints: int
    signs: tuple[int, ...]
    coefficients: Float64[np.ndarray, "_ _"]
    left: tuple[float, ...]

    def __call__(self, state: State) -> Columns:
        """Efforts of all joints."""
        if self.signs:
            columns = np.concatenate([chain_columns(state, self.signs), own_columns(state, self.joints)], axis=2)
            return np.asarray(columns @ self.coefficients[0])
        return np.stack([general_columns(state, self.joints, k) @ self.coefficients[k] for k in range(self.joints)], axis=1)

    @property
    def links(self) -> tuple[complex, ...]:
        """Vectors from each joint to the next (m); none where gravity shows no lengths."""
        n = self.joints
        if not self.signs:
            return ()
        D, H, A = unpacked(self.coefficients[0], n)
        size = float(np.sqrt(np.abs(D).max()))
        if abs(A[-1]) * np.sqrt(GRAVITY_M_S2) < 0.02 * size:
            return ()
        return tuple(np.conj(H[i, n - 1] / A[-1]) for i in range(n - 1))


def unpacked(
    theta: Float64[np.ndarray, " _"], n: int
) -> tuple[Float64[np.ndarray, " _"], Complex128[np.ndarray, "_ _"], Complex128[np.ndarray, " _"]]:
    """D, H and A of a chain from its coefficients; H and A are complex."""
    H, at = np.zeros((n, n), complex), n
    for i in range(n):
        for j in range(i + 1, n):
            H[i, j] = theta[at] + 1j * theta[at + 1]
            at += 2
    A = theta[at : at + 2 * n : 2] + 1j * theta[at + 1 : at + 2 * n : 2]
    return theta[:n], H, A


def mass_coefficients(mass: float, links: Sequence[complex]) -> Float64[np.ndarray, " _"]:
    """Coefficients that a point mass adds at the end of some links."""
    n = len(links)
    pairs = [mass * np.conj(links[i]) * links[j] for i in range(n) for j in range(i + 1, n)]
    out = [mass * abs(link) ** 2 for link in links]
    return np.array([*out, *(part for z in [*pairs, *(mass * link for link in links)] for part in (z.real, z.imag))])


def chain_columns(state: State, signs: Sequence[int]) -> Float64[np.ndarray, "_ _ _"]:
    """Efforts of a chain of parallel hinges for each coefficient: rows, joints, coefficients."""
    n = len(signs)
    phi, dphi, ddphi = (
        np.cumsum([sign * state[f"{kind}{k}"] for k, sign in enumerate(signs)], axis=0) for kind in ("q", "dq", "ddq")
    )
    out: list[dict[int, Column]] = [{i: ddphi[i]} for i in range(n)]
    for i in range(n):
        for j in range(i + 1, n):
            angle = phi[j] - phi[i]
            for c, slope in ((np.cos(angle), -np.sin(angle)), (-np.sin(angle), -np.cos(angle))):
                out.append({i: c * ddphi[j] + slope * dphi[j] ** 2, j: c * ddphi[i] - slope * dphi[i] ** 2})
    for i in range(n):
        out += [{i: GRAVITY_M_S2 * np.cos(phi[i])}, {i: -GRAVITY_M_S2 * np.sin(phi[i])}]
    columns = np.zeros((len(phi[0]), n, len(out)))
    for p, rows in enumerate(out):
        for i, row in rows.items():
            for k in range(i + 1):  # a torque about an absolute angle acts on every joint before it
                columns[:, k, p] += signs[k] * row
    return columns


def own_columns(state: State, n: int) -> Float64[np.ndarray, "_ _ _"]:
    """Rotor inertia, damping, friction and a constant of each joint."""
    columns = np.zeros((len(state["q0"]), n, 4 * n))
    for k in range(n):
        for j, row in enumerate(_own(state, k)):
            columns[:, k, 4 * k + j] = row
    return columns


def _own(state: State, k: int) -> Iterator[Column]:
    velocity = state[f"dq{k}"]
    yield state[f"ddq{k}"]
    yield velocity
    yield np.clip(state[f"v{k}"] / max(STEEP * float(np.std(velocity)), 1e-12), -1.0, 1.0)
    yield np.ones(len(velocity))


def general_columns(state: State, n: int, joint: int) -> Float64[np.ndarray, "_ _"]:
    """Terms of the effort of one joint of any arm."""
    rows = [np.ones(len(state["q0"]))]
    for weights in _sums(n):
        angle = np.sum([w * state[f"q{k}"] for k, w in enumerate(weights)], axis=0)
        rows += [np.cos(angle), np.sin(angle)]
    trig = np.stack(rows, axis=1)
    velocities = [state[f"dq{i}"] * state[f"dq{j}"] for i in range(n) for j in range(i, n)]
    factors = [np.ones(len(trig)), *(state[f"ddq{k}"] for k in range(n)), *velocities]
    own = np.stack(list(_own(state, joint))[1:3], axis=1)
    return np.concatenate([trig * factor[:, None] for factor in factors] + [own], axis=1)


def _sums(n: int) -> Iterator[tuple[int, ...]]:
    """Sums of angles, each up to its sign."""
    if n > MOST_COMBINED:
        yield from (tuple(int(first <= k <= last) for k in range(n)) for first in range(n) for last in range(first, n))
        return
    for weights in product((0, 1, -1), repeat=n):
        if any(weights) and next(w for w in weights if w) > 0:
            yield weights
    yield from (tuple(2 * (k == j) for k in range(n)) for j in range(n))


def identified(state: State, efforts: Columns) -> Dynamics | None:
    """Dynamics of a simulated arm; None where its efforts follow from no motion."""
    n, size = efforts.shape[1], np.maximum(efforts.std(axis=0), 1e-12)
    if n > MOST_JOINTS:
        return None
    best: Dynamics | None = None
    for tail in product((1, -1), repeat=n - 1):
        columns = np.concatenate([chain_columns(state, (1, *tail)), own_columns(state, n)], axis=2)
        theta = _solved((columns / size[:, None]).reshape(-1, columns.shape[2]), (efforts / size).ravel())
        left = (efforts - columns @ theta).std(axis=0)
        if (left < WELL_DETERMINED * size).all() and (best is None or (left / size).max() < max(best.left / size)):
            best = Dynamics(n, (1, *tail), theta[None], tuple(left.tolist()))
    if best is not None:
        return best
    each = [general_columns(state, n, k) for k in range(n)]
    solved = [_solved(columns, efforts[:, k]) for k, columns in enumerate(each)]
    left = np.array(
        [(efforts[:, k] - columns @ theta).std() for k, (columns, theta) in enumerate(zip(each, solved, strict=True))]
    )
    return Dynamics(n, (), np.stack(solved), tuple(left.tolist())) if (left < WELL_DETERMINED * size).all() else None


def _solved(A: Float64[np.ndarray, "m p"], b: Float64[np.ndarray, " m"]) -> Float64[np.ndarray, " p"]:
    """Least squares with a small ridge on columns of equal length."""
    length = np.maximum(np.linalg.norm(A, axis=0), 1e-12)
    A = A / length
    return np.asarray(np.linalg.solve(A.T @ A + RIDGE * np.eye(A.shape[1]), A.T @ b) / length)
