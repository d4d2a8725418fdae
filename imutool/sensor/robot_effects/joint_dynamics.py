"""Dynamics of jointed arms, identified from a simulation's own efforts and motion.

Inverse dynamics are linear in the inertial parameters (Atkeson, An, Hollerbach, Estimation of inertial parameters of
manipulator loads and links, IJRR 5, 1986). `chain_columns` holds for hinges with parallel axes, `SpatialChain` for hinges whose
axes point anywhere. `general_factors` holds for other arms of few joints: accelerations, products of velocities and gravity,
each times sines and cosines of sums of angles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.recording import GRAVITY_M_S2
from imutool.sensor.effect import Theta
from imutool.sensor.robot_effects.planar_chain import chain_columns, mass_coefficients, unpacked
from imutool.sensor.robot_effects.signal_samples import Column, Columns, State
from imutool.sensor.robot_effects.spatial_chain import Axes, SpatialChain, searched

MAX_JOINTS = 7
MAX_COMBINED = 3  # joints up to which all sums of angles are tried
RIDGE = 1e-9
ROUNDED = 1e-6  # of the longest column: one that ought to be zero, as gravity about an upright axis, holds rounding errors
SCREENED = 1000  # samples that refute a wrong set of signs
SEARCHED = 250  # samples that tell axes apart
MAX_OFFSETS = 3  # lengths of an arm that a payload alone may show
WELL_DETERMINED = 0.02  # of the efforts' size that a fit may leave
STEEP = 0.01  # of a velocity's size, within which its sign turns


@dataclass(frozen=True)
class Dynamics:
    """Efforts of an arm as a function of its motion (`q0`, `dq0`, `ddq0`, ...)."""

    joints: int
    signs: tuple[int, ...]  # of the angles of a chain of parallel hinges, empty for any other arm
    coefficients: Float64[np.ndarray, "_ _"]
    residual_std: tuple[float, ...]  # of the fit, by joint
    order: tuple[int, ...]  # joints from base to tip; a log may differ
    spatial: SpatialChain | None = None  # axes of another chain of hinges

    def __call__(self, state: State) -> Columns:
        """Efforts of all joints."""
        n, in_order = self.joints, _in_order(state, self.order)
        if self.signs:
            columns = np.concatenate([chain_columns(in_order, self.signs), own_columns(in_order, n)], axis=2)
            efforts = np.asarray(columns @ self.coefficients[0])
        elif self.spatial is not None:
            theta = self.coefficients[0]
            efforts = self.spatial.efforts(self.spatial.moved(in_order), *self.spatial.unpacked(theta))
            for k, own in enumerate(theta[self.spatial.moments :].reshape(n, -1)):
                efforts[:, k] += sum(c * row for c, row in zip(own, _own(in_order, k), strict=True))
        else:
            trig, factors = general_factors(in_order, n)
            weights = self.coefficients[:, :-2].reshape(n * factors.shape[1], trig.shape[1])
            efforts = ((trig @ weights.T).reshape(len(trig), n, -1) * factors[:, None, :]).sum(axis=2)
            for k in range(n):
                efforts[:, k] += np.stack(_rates(in_order, k), axis=1) @ self.coefficients[k, -2:]
        return np.asarray(efforts[:, np.argsort(self.order)])

    def loaded(self, state: State) -> Callable[[Theta], Columns]:
        """Efforts that a mass on the last link adds, by its mass and place, the `offsets` of the joints before.

        Last comes its inertia about its own centre; a point has none.
        """
        in_order, sorted_ = _in_order(state, self.order), np.argsort(self.order)
        if self.spatial is None:
            columns, links = chain_columns(in_order, self.signs)[:, sorted_], self.links
            return lambda theta: (
                columns @ mass_coefficients(theta[0], [*links, complex(theta[1], theta[2])], float(theta[3:].sum()))
            )
        chain, moved = self.spatial, self.spatial.moved(in_order)
        origin, unknown = chain.origin(self.coefficients[0])
        about = np.stack([chain.of_link(axis) for axis in np.eye(3)], axis=1)
        spread = 0.5 * about @ about.T  # an inertia alike about all axes is that of half of it along each

        def added(theta: Theta) -> Columns:
            offsets, inertia = np.split(theta[4:], [unknown.shape[1]])
            at = origin + chain.of_link(theta[1:4]) + unknown @ offsets
            return chain.efforts(moved, theta[0] * np.outer(at, at) + inertia.sum() * spread, theta[0] * at)[:, sorted_]

        return added

    @property
    def offsets(self) -> int:
        """Lengths of a chain across each other that its own weight does not show, where it has a payload."""
        return 0 if self.spatial is None else self.spatial.origin(self.coefficients[0])[1].shape[1]

    @property
    def reach(self) -> float | None:
        """Mean length of a link (m), zero where there is one joint; None where gravity shows no lengths."""
        if self.spatial is None:
            return float(np.mean(np.abs(self.links))) if self.links else 0.0 if self.signs and self.joints == 1 else None
        reach = float(np.linalg.norm(self.spatial.origin(self.coefficients[0])[0])) / np.sqrt(self.joints)
        return reach if self.offsets <= MAX_OFFSETS else None

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


def _rates(state: State, k: int) -> list[Column]:
    """Damping and friction of one joint."""
    return list(_own(state, k))[1:3]


def _in_order(state: State, order: Sequence[int]) -> State:
    """State of the joints from base to tip."""
    return {f"{kind}{n}": state[f"{kind}{k}"] for n, k in enumerate(order) for kind in ("q", "dq", "ddq", "v")}


def general_factors(state: State, n: int) -> tuple[Float64[np.ndarray, "_ t"], Float64[np.ndarray, "_ f"]]:
    """Sines and cosines of sums of angles, and their factors, for the effort of any arm."""
    rows = [np.ones(len(state["q0"]))]
    for weights in _sums(n):
        angle = np.sum([w * state[f"q{k}"] for k, w in enumerate(weights)], axis=0)
        rows += [np.cos(angle), np.sin(angle)]
    velocities = [state[f"dq{i}"] * state[f"dq{j}"] for i in range(n) for j in range(i, n)]
    factors = [np.ones(len(rows[0])), *(state[f"ddq{k}"] for k in range(n)), *velocities]
    return np.stack(rows, axis=1), np.stack(factors, axis=1)


def _sums(n: int) -> Iterator[tuple[int, ...]]:
    """Sums of angles, each up to its sign."""
    if n > MAX_COMBINED:
        yield from (tuple(int(first <= k <= last) for k in range(n)) for first in range(n) for last in range(first, n))
        return
    for weights in product((0, 1, -1), repeat=n):
        if any(weights) and next(w for w in weights if w) > 0:
            yield weights
    yield from (tuple(2 * (k == j) for k in range(n)) for j in range(n))


def identified(state: State, efforts: Columns, near: Dynamics | None = None) -> Dynamics | None:
    """Dynamics of a simulated arm; None where its efforts follow from no motion.

    The joints are tried in the order of the log, and in that of their efforts: a base carries what a tip does. `near` are the
    dynamics at nearly the same motion.
    """
    n, size = efforts.shape[1], np.maximum(efforts.std(axis=0), 1e-12)
    if n > MAX_JOINTS:
        return None
    if near is not None and near.spatial is not None:
        order = near.order
        return _spatial(near.spatial, _in_order(state, order), efforts[:, order], size[list(order)], order)
    orders = dict.fromkeys((tuple(range(n)), tuple(np.argsort(-size).tolist())))

    def found(find: Callable[..., Dynamics | None]) -> Iterator[Dynamics]:
        each = (find(_in_order(state, order), efforts[:, order], size[list(order)], order) for order in orders)
        yield from (dynamics for dynamics in each if dynamics is not None)

    chains = list(found(_chain))
    if chains:
        return min(chains, key=lambda chain: max(np.array(chain.residual_std) / size))
    return next((dynamics for find in (_hinges, _general) for dynamics in found(find)), None)


def _hinges(state: State, efforts: Columns, size: Float64[np.ndarray, " n"], order: tuple[int, ...]) -> Dynamics | None:
    """A chain of hinges across each other, in its order."""
    if len(order) == 1:
        return None
    every = max(1, len(efforts) // SEARCHED)
    few, wanted = {name: values[::every] for name, values in state.items()}, efforts[::every]
    own = own_columns(few, len(order))

    def residual(axes: Axes) -> Float64[np.ndarray, " _"]:
        return np.asarray((_fitted(SpatialChain(axes).columns(few), own, wanted, size)[1] / size).ravel())

    axes = searched(len(order), residual, WELL_DETERMINED)
    return None if axes is None else _spatial(SpatialChain(axes), state, efforts, size, order)


def _spatial(
    chain: SpatialChain, state: State, efforts: Columns, size: Float64[np.ndarray, " n"], order: tuple[int, ...]
) -> Dynamics | None:
    """A chain of hinges with known axes."""
    theta, residual = _fitted(chain.columns(state), own_columns(state, len(order)), efforts, size)
    residual_std = residual.std(axis=0)
    well = (residual_std < WELL_DETERMINED * size).all()
    return Dynamics(len(order), (), theta[None], _by_joint(residual_std, order), order, chain) if well else None


def _fitted(
    columns: Float64[np.ndarray, "_ _ _"], own: Float64[np.ndarray, "_ _ _"], efforts: Columns, size: Float64[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, " p"], Columns]:
    """Coefficients that all joints share, and what they leave of the efforts."""
    columns = np.concatenate([columns, own], axis=2)
    theta = _solved((columns / size[:, None]).reshape(-1, columns.shape[2]), (efforts / size).ravel()[:, None])[:, 0]
    return theta, np.asarray(efforts - columns @ theta)


def _chain(state: State, efforts: Columns, size: Float64[np.ndarray, " n"], order: tuple[int, ...]) -> Dynamics | None:
    """A chain of parallel hinges, in its order."""
    n, best = len(order), None
    few = {name: values[:: max(1, len(efforts) // SCREENED)] for name, values in state.items()}
    sets = [(few, efforts[:: max(1, len(efforts) // SCREENED)]), (state, efforts)]  # most signs fail in a few samples
    for tail in product((1, -1), repeat=n - 1):
        for motion, wanted in sets:
            theta, residual = _fitted(chain_columns(motion, (1, *tail)), own_columns(motion, n), wanted, size)
            residual_std = residual.std(axis=0)
            if (residual_std > WELL_DETERMINED * size).any():
                break
        else:
            if best is None or (residual_std / size).max() < best[0]:
                best = (residual_std / size).max(), (1, *tail), theta[None], residual_std
    return None if best is None else Dynamics(n, best[1], best[2], _by_joint(best[3], order), order)


def following(state: State, efforts: Columns) -> list[int]:
    """Joints whose efforts follow from the motion of all joints."""
    if efforts.shape[1] > MAX_JOINTS:
        return []
    residual_std = _general_fit(state, efforts)[1]
    return np.flatnonzero(residual_std < WELL_DETERMINED * np.maximum(efforts.std(axis=0), 1e-12)).tolist()


def _general(state: State, efforts: Columns, size: Float64[np.ndarray, " n"], order: tuple[int, ...]) -> Dynamics | None:
    """Any other arm, its joints from base to tip; of more joints the sums of angles are too many to be tried."""
    if len(order) > MAX_COMBINED:
        return None
    theta, residual_std = _general_fit(state, efforts)
    well = (residual_std < WELL_DETERMINED * size).all()
    return Dynamics(len(order), (), theta, _by_joint(residual_std, order), order) if well else None


def _general_fit(state: State, efforts: Columns) -> tuple[Float64[np.ndarray, "n p"], Float64[np.ndarray, " n"]]:
    """Coefficients by joint, and what they leave of the efforts."""
    n = efforts.shape[1]
    trig, factors = general_factors(state, n)
    common = (factors[:, :, None] * trig[:, None, :]).reshape(len(trig), -1)
    rates = [column for k in range(n) for column in _rates(state, k)]
    columns, own = np.concatenate([common, np.stack(rates, axis=1)], axis=1), np.arange(2)
    kept = [np.concatenate([np.arange(common.shape[1]), common.shape[1] + 2 * k + own]) for k in range(n)]
    theta = _solved_each(columns, efforts, kept)
    return theta, np.array([(efforts[:, k] - columns[:, kept[k]] @ theta[k]).std() for k in range(n)])


def _by_joint(values: Float64[np.ndarray, " n"], order: tuple[int, ...]) -> tuple[float, ...]:
    """Values of joints from base to tip, in the order of the log."""
    return tuple(values[np.argsort(order)].tolist())


def _solved(A: Float64[np.ndarray, "m p"], b: Float64[np.ndarray, "m k"]) -> Float64[np.ndarray, "p k"]:
    """Least squares with a small ridge on columns of equal length."""
    return _solved_each(A, b, [np.arange(A.shape[1])] * b.shape[1]).T


def _solved_each(
    A: Float64[np.ndarray, "m p"], b: Float64[np.ndarray, "m k"], kept: Sequence[Int64[np.ndarray, " q"]]
) -> Float64[np.ndarray, "k q"]:
    """Least squares of each right side on some of the columns."""
    length = np.linalg.norm(A, axis=0)
    length = np.maximum(length, max(ROUNDED * float(length.max()), 1e-300))
    gram, sides = A.T @ A / np.outer(length, length), A.T @ b / length[:, None]
    ridge = RIDGE * np.eye(len(kept[0]))
    solved = [np.linalg.solve(gram[np.ix_(k, k)] + ridge, side[k]) / length[k] for k, side in zip(kept, sides.T, strict=True)]
    return np.stack(solved)
