"""Efforts of a chain of parallel hinges, linear in the moments of its links.

Links have absolute angles phi_i = sum of +-q_j, j <= i. Efforts are linear in D_i (kg m²) of a link, H_ij = conj(P_i) A_j
(kg m²) between two, and A_i (kg m) against gravity, with P_i the vector of a link in its own plane as a complex number.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from imutool.array_types import Complex128, Float64
from imutool.recording import GRAVITY_M_S2
from imutool.sensor.robot_effects.signal_samples import Column, State


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


def mass_coefficients(mass: float, links: Sequence[complex], inertia: float = 0.0) -> Float64[np.ndarray, " _"]:
    """Coefficients that a mass adds at the end of some links, with its own inertia."""
    n = len(links)
    pairs = [mass * np.conj(links[i]) * links[j] for i in range(n) for j in range(i + 1, n)]
    out = [mass * abs(link) ** 2 for link in links]
    out[-1] += inertia
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
