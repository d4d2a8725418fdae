"""Quaternions in bulk are those of scipy, also where angles are small, half a turn, or exactly nothing."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from imutool.geometry import quaternion

ROUNDING = 1e-13  # some ten float64 operations on numbers of size one
SMALLEST = 1e-300
ANGLES = (0.0, 1e-300, 1e-160, 1e-12, 1e-8, 1e-6, 1e-3, 0.1, 1.0, 3.0, np.pi - 1e-9, np.pi)
COUNT = quaternion.ROWS_AT_ONCE + 500  # more than one block


@pytest.fixture(scope="module")
def turns() -> tuple[Rotation, Rotation]:
    return Rotation.random(COUNT, rng=np.random.default_rng(1)), Rotation.random(COUNT, rng=np.random.default_rng(2))


def wxyz(rotation: Rotation) -> np.ndarray:
    return np.ascontiguousarray(rotation.as_quat(scalar_first=True))


def same_turn(q: np.ndarray, rotation: Rotation) -> bool:
    return bool((quaternion.angle_between(q, wxyz(rotation)) < 10 * ROUNDING).all())


def test_products_inverses_and_turned_vectors_are_scipys(turns: tuple[Rotation, Rotation]) -> None:
    a, b = turns
    v = np.random.default_rng(3).normal(size=(COUNT, 3))
    assert same_turn(quaternion.multiply(wxyz(a), wxyz(b)), a * b)
    assert same_turn(quaternion.multiply(wxyz(a)[:1], wxyz(b)), a[0] * b)
    assert same_turn(quaternion.inverse(wxyz(a)), a.inv())
    np.testing.assert_allclose(quaternion.rotate(wxyz(a), v), a.apply(v), atol=ROUNDING)


@pytest.mark.parametrize("angle", ANGLES)
def test_log_undoes_exp_at_every_size(angle: float) -> None:
    axis = np.array([[0.6, -0.48, 0.64]])
    q = quaternion.exp(angle * axis)
    np.testing.assert_allclose(quaternion.length(q), 1.0, atol=ROUNDING)
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(quaternion.log(sign * q), angle * axis, rtol=1e-7, atol=SMALLEST)


def test_a_turn_of_more_than_half_is_told_the_short_way() -> None:
    q = quaternion.exp(np.array([[0.0, 0.0, 1.5 * np.pi]]))
    np.testing.assert_allclose(quaternion.log(q), [[0.0, 0.0, -0.5 * np.pi]], atol=ROUNDING)


@pytest.mark.parametrize("angle", ANGLES)
def test_the_angle_between_is_exact_where_a_dot_product_would_not_be(angle: float) -> None:
    a = wxyz(Rotation.identity(1))
    b = quaternion.exp(np.array([[angle, 0.0, 0.0]]))
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(quaternion.angle_between(a, sign * b), angle, rtol=1e-7, atol=1e-150)


def test_slerp_is_scipys_and_gives_its_ends_to_the_bit(turns: tuple[Rotation, Rotation]) -> None:
    a, b = wxyz(turns[0]), wxyz(turns[1])
    share = np.random.default_rng(5).uniform(size=COUNT)
    between = quaternion.slerp(a, b, share)
    np.testing.assert_allclose(quaternion.length(between), 1.0, atol=ROUNDING)
    for row in range(0, COUNT, 25):
        ends = Rotation.from_quat(np.stack([a[row], b[row]]), scalar_first=True)
        assert same_turn(between[row : row + 1], Slerp([0.0, 1.0], ends)([share[row]]))
    assert np.array_equal(quaternion.slerp(a, b, np.zeros(COUNT)), a)
    last = quaternion.slerp(a, b, np.ones(COUNT))
    assert np.array_equal(np.abs(last), np.abs(b))
    np.testing.assert_allclose(quaternion.slerp(a, a, share), a, atol=ROUNDING)


def test_roll_pitch_and_yaw_are_scipys_and_say_nothing_at_the_pole(turns: tuple[Rotation, Rotation]) -> None:
    a, _ = turns
    np.testing.assert_allclose(quaternion.roll_pitch_yaw(wxyz(a)), a.as_euler("ZYX")[:, ::-1], atol=1e-10)
    pole = Rotation.from_euler("ZYX", [[0.3, np.pi / 2, 0.0]])
    roll, pitch, yaw = quaternion.roll_pitch_yaw(wxyz(pole))[0]
    assert pitch == pytest.approx(np.pi / 2, abs=1e-7)
    assert np.isfinite([roll, yaw]).all()


@pytest.mark.parametrize(
    "xi", [[0, 0, 0], [1e-9, 0, 0], [0.3, -1.2, 0.7], [np.pi, 0, 0], [0, np.pi, 0], [0, 0, -3.14]], ids=str
)
def test_a_matrix_gives_its_quaternion_also_at_half_a_turn(xi: list[float]) -> None:
    turn = Rotation.from_rotvec(xi)
    (found,) = quaternion.of_matrix(turn.as_matrix())
    assert abs(abs(float(found @ turn.as_quat(scalar_first=True))) - 1.0) < 1e-12


def test_a_curve_between_rows_follows_a_turn_that_slerp_makes_too_small() -> None:
    """Poses at 10 Hz of a body that swings at 1.2 Hz, as a rider who pedals: the error falls with the cube of the step."""
    errors = {}
    for h in (0.1, 0.05):
        knots = np.arange(0.0, 10.0 + h / 2, h)
        at = np.linspace(1.0, 9.0, 4001)
        swing = [np.outer(np.sin(2 * np.pi * 1.2 * t), [0.3, -0.2, 0.1]) + np.outer(t, [0.0, 0.1, 0.4]) for t in (knots, at)]
        rows, exact = (Rotation.from_euler("xyz", angles) for angles in swing)
        after = np.clip(np.searchsorted(knots, at), 1, len(knots) - 1)
        share = (at - knots[after - 1]) / h
        for curved in (False, True):
            q = quaternion.between_rows(rows.as_quat(scalar_first=True), after, share, knots if curved else None)
            e = Rotation.from_quat(q, scalar_first=True) * exact.inv()
            errors[h, curved] = float(np.sqrt(np.mean(e.magnitude() ** 2)))
    assert errors[0.1, True] < 0.2 * errors[0.1, False]
    assert errors[0.1, True] / errors[0.05, True] > 2**2.9


def test_a_curve_passes_through_its_rows_and_straight_over_a_gap() -> None:
    t_s = np.array([0.0, 0.1, 0.2, 5.2, 5.3, 5.4])
    rows = Rotation.from_rotvec(np.outer(t_s, [0.1, 0.0, 0.3]))
    q = rows.as_quat(scalar_first=True)
    for share in (0.0, 0.5, 1.0):
        after = np.arange(1, len(t_s))
        between = quaternion.between_rows(q, after, np.full(len(after), share), t_s)
        exact = Rotation.from_rotvec(np.outer(t_s[:-1] + share * np.diff(t_s), [0.1, 0.0, 0.3]))
        assert (Rotation.from_quat(between, scalar_first=True) * exact.inv()).magnitude().max() < 1e-12
