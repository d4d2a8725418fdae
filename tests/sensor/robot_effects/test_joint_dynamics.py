"""Dynamics of an arm that are learnt from its motion, whatever the order of its joints in a log."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from scipy.optimize import least_squares

from imutool.sensor.robot_effects.joint_dynamics import Dynamics, following, identified
from imutool.sensor.robot_effects.planar_chain import chain_columns, mass_coefficients
from imutool.sensor.robot_effects.spatial_chain import SpatialChain

SIGNS = (1, 1, -1)
CLOSE = 1e-4  # of the efforts: the ridge of the fit
T = np.arange(3000) / 100.0


def motion(seed: int, joints: int = 3) -> dict[str, np.ndarray]:
    """Angles, speeds and accelerations of sums of cosines."""
    rng, out = np.random.default_rng(seed), {}
    for k in range(joints):
        w, p = rng.uniform(0.5, 4.0, 6), rng.uniform(0.0, 6.0, 6)
        phase = np.outer(T, w) + p
        out[f"q{k}"] = 0.6 * np.sin(phase).sum(axis=1)
        out[f"dq{k}"] = out[f"v{k}"] = 0.6 * (w * np.cos(phase)).sum(axis=1)
        out[f"ddq{k}"] = -0.6 * (w**2 * np.sin(phase)).sum(axis=1)
    return out


def logged(state: dict[str, np.ndarray], order: tuple[int, ...]) -> dict[str, np.ndarray]:
    """The state with joint `order[n]` of the arm at place n of the log."""
    return {f"{kind}{n}": state[f"{kind}{k}"] for n, k in enumerate(order) for kind in ("q", "dq", "ddq", "v")}


def efforts(state: dict[str, np.ndarray]) -> np.ndarray:
    """Three links of 0.4, 0.3 and 0.2 m with a mass at the end of each."""
    links = (0.4 + 0j, 0.3 + 0j, 0.2 + 0j)
    each = [np.array(mass_coefficients(mass, [*links[: k + 1], *[0j] * (2 - k)])) for k, mass in enumerate((3.0, 2.0, 1.0))]
    return np.asarray(chain_columns(state, SIGNS) @ np.sum(each, axis=0))


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_a_chain_is_found_in_any_order_of_its_joints(order: tuple[int, ...]) -> None:
    """Logs sort joints by the alphabet; the base carries the largest effort."""
    own, other = motion(1), motion(2)
    found = identified(logged(own, order), efforts(own)[:, order])
    assert found is not None
    assert found.signs == SIGNS
    assert np.abs(np.abs(found.links) - (0.4, 0.3)).max() < CLOSE
    wanted = efforts(other)[:, order]
    assert np.abs(found(logged(other, order)) - wanted).max() < CLOSE * np.abs(wanted).max()


def test_a_gripper_follows_from_no_motion_and_the_arm_does() -> None:
    """It holds what it has: its effort steps, its finger hardly moves."""
    own = motion(1)
    finger = motion(7)
    own |= {f"{kind}3": 0.01 * finger[f"{kind}0"] for kind in ("q", "dq", "ddq", "v")}
    held = 5.0 * np.sign(np.sin(0.3 * T) + 0.2)
    every = np.column_stack([efforts(own), held])
    assert identified(own, every) is None
    assert following(own, every) == [0, 1, 2]


def test_a_joint_about_an_upright_axis_feels_no_rounding_of_its_angle() -> None:
    """Gravity about it is zero but for rounding errors, which are no column to fit with."""
    own, arm = motion(5), SpatialChain(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]))
    upper = arm.of_link(np.array([0.4, 0.0, 0.0]), 1)
    tip = upper + arm.of_link(np.array([0.3, 0.0, 0.02]))
    S, A = 2.0 * np.outer(upper, upper) + np.outer(tip, tip), 2.0 * upper + tip
    found = identified(own, arm.efforts(arm.moved(own), S, A))
    assert found is not None
    turned = found({**own, "q0": own["q0"] + 1e-6}) - found(own)
    assert np.abs(turned).max() < 1e-7


def test_any_other_arm_is_the_sum_of_its_factors() -> None:
    """Two hinges across each other: a centrifugal term and a pendulum."""
    own, other = motion(3, 2), motion(4, 2)

    def torques(s: dict[str, np.ndarray]) -> np.ndarray:
        turned = (1.0 + np.cos(s["q1"]) ** 2) * s["ddq0"] - np.sin(2.0 * s["q1"]) * s["dq0"] * s["dq1"]
        return np.stack([turned, s["ddq1"] + 0.5 * np.sin(2.0 * s["q1"]) * s["dq0"] ** 2 + 5.0 * np.cos(s["q1"])], axis=1)

    found = identified(own, torques(own))
    assert isinstance(found, Dynamics)
    assert not found.signs
    assert np.abs(found(other) - torques(other)).max() < CLOSE * np.abs(torques(other)).max()


@pytest.mark.parametrize("wrist", [(1.0, 0.0, 0.0), (0.8, 0.0, 0.6)])
def test_axes_that_point_anywhere_are_found_and_hold_at_another_motion(wrist: tuple[float, ...]) -> None:
    """A shoulder, an elbow and a wrist across each other, with their lengths."""
    own, other = motion(5), motion(6)
    arm = SpatialChain(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], wrist]))
    theta = np.zeros(arm.moments)
    upper, tip = arm.of_link(np.array([0.0, 0.0, 0.4]), 1), arm.of_link(np.array([0.0, 0.1, 0.2]))
    S, A = (
        sum(m * f for m, f in each)
        for each in (
            [(2.0, np.outer(upper, upper)), (1.0, np.outer(upper + tip, upper + tip))],
            [(2.0, upper), (1.0, upper + tip)],
        )
    )
    theta[:] = np.append(np.asarray(S)[np.triu_indices(6)], A)
    found = identified(own, arm.columns(own) @ theta)
    assert found is not None
    assert found.spatial is not None
    wanted = arm.columns(other) @ theta
    assert np.abs(found(other) - wanted).max() < CLOSE * np.abs(wanted).max()
    assert np.allclose(wanted, arm.efforts(arm.moved(other), *arm.unpacked(theta)))
    lengths, unknown = arm.origin(theta)
    assert unknown.shape[1] == 0
    of_place = np.stack([arm.of_link(axis) for axis in np.eye(3)], axis=1)
    place, left, *_ = np.linalg.lstsq(
        of_place, upper + tip - lengths, rcond=None
    )  # its zero along the last axis may be another
    assert np.allclose(left, 0.0)
    if wrist[2] == 0.0:
        assert np.allclose(place, [0.0, 0.1, 0.2])
    more, moved = upper + tip, arm.moved(other)
    added = arm.efforts(moved, 0.5 * np.outer(more, more), 0.5 * more)
    masses = Dynamics(3, (), theta[None], (0.0,) * 3, (0, 1, 2), arm).loaded(other)
    assert np.allclose(masses(np.array([0.5, *place])), added)
    points = [masses(np.array([0.5 / 6.0, *(place + 0.06 * out), 0.0])) for out in (*np.eye(3), *-np.eye(3))]
    assert np.allclose(masses(np.array([0.5, *place, 0.5 * 0.06**2 / 1.5])), sum(points))


def test_a_load_on_a_chain_of_parallel_hinges_has_an_inertia_of_its_own() -> None:
    """Four points about a centre are a mass there and its inertia."""
    own = motion(1)
    dynamics = identified(own, efforts(own))
    assert dynamics is not None
    masses, place = dynamics.loaded(own), np.array([0.1, 0.05])
    points = [masses(np.array([0.2, *(place + out), 0.0])) for out in ([0.06, 0.0], [-0.06, 0.0], [0.0, 0.06], [0.0, -0.06])]
    assert np.allclose(masses(np.array([0.8, *place, 0.8 * 0.06**2])), sum(points))


def test_a_payload_shows_the_lengths_that_a_light_wrist_hides() -> None:
    """The last link hangs in its own axis, as a flange does, so that its own weight turns no joint."""
    own = motion(8, 4)
    axes = np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    arm = SpatialChain(axes)
    upper = arm.of_link(np.array([0.4, 0.0, 0.0]), 0)
    fore = upper + arm.of_link(np.array([0.3, 0.1, 0.0]), 1)
    flange = fore + arm.of_link(np.array([0.05, 0.0, 0.1]), 2)
    points = [(2.0, upper), (1.0, fore), (0.5, flange)]
    S = sum(m * np.outer(u, u) for m, u in points)
    A = sum(m * u for m, u in points)
    theta = np.append(np.asarray(S)[np.triu_indices(8)], A)
    dynamics = Dynamics(4, (), theta[None], (0.0,) * 4, (0, 1, 2, 3), arm)
    assert dynamics.reach is not None
    assert dynamics.offsets > 0
    at, masses = flange + arm.of_link(np.array([0.1, 0.0, 0.0])), dynamics.loaded(own)
    wanted = arm.efforts(arm.moved(own), 0.7 * np.outer(at, at), 0.7 * at)

    def left(x: np.ndarray) -> np.ndarray:
        return np.asarray((masses(x) - wanted).ravel()[::50])

    found = least_squares(left, np.append([0.3, 0.05, 0.05, 0.05], np.zeros(dynamics.offsets)))
    assert found.x[0] == pytest.approx(0.7, rel=CLOSE)
    assert np.abs(found.x[1:3]).max() == pytest.approx(0.1, rel=CLOSE)
