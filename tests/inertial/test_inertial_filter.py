"""The filter's algebra: errors go on and off, heading changes nothing, a backward pass is never less sure."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.inertial import inertial_filter
from imutool.inertial.inertial_filter import (
    BIAS,
    POSITION,
    SIZE,
    STOPPED,
    VELOCITY,
    FilterSettings,
    State,
    Step,
    motion_step,
    rest_step,
    smooth,
    update,
)
from imutool.inertial.inertial_filter import start as first_state
from imutool.inertial.preintegration import integrate

S = FilterSettings()
EXACT = 1e-10
WALK = np.array([1e-4] * 3 + [2e-3] * 3)
STD = np.array([3e-3] * 3 + [0.2] * 3 + [1e-3] * 3 + [0.03] * 3)


def start(heading: float = 0.0) -> State:
    x = first_state(np.array([0.5, -0.3, 9.7]), np.zeros(6), STD, S)
    turn = Rotation.from_euler("z", heading).as_matrix()
    return x._replace(R_wb=turn @ x.R_wb, v_w=turn @ x.v_w, p_wb=turn @ x.p_wb)


def steps(x: State, count: int = 20, seed: int = 0) -> list[Step]:
    """Motion, a stop, motion: samples that need not be a flight's."""
    rng = np.random.default_rng(seed)
    t = np.arange(101) / 200.0
    found = []
    for i in range(count):
        gyro, accel = 0.5 * rng.normal(size=(101, 3)), np.array([0.0, 0.5, 9.8]) + rng.normal(size=(101, 3))
        if i % 7 == 3:
            found.append(
                rest_step(x, np.concatenate([1e-3 * rng.normal(size=3), accel.mean(axis=0)]), np.full(3, 1e-8), 0.5, WALK, S)
            )
        else:
            found.append(
                motion_step(x, integrate(t, gyro - x.bias[:3], accel - x.bias[3:]), gyro[-1] - x.bias[:3], 0.0, WALK, S)
            )
        x = found[-1].after
    return found


def test_errors_go_on_and_come_off_again() -> None:
    rng = np.random.default_rng(0)
    x = steps(start())[-1].after
    e = 0.3 * rng.normal(size=SIZE)
    np.testing.assert_allclose(x.moved(e, x.P).minus(x), e, rtol=0, atol=EXACT)
    np.testing.assert_allclose(x.minus(x), 0.0, rtol=0, atol=EXACT)


@pytest.mark.parametrize("up", [[0.1, 0.2, 9.8], [9.81, 0.0, 0.0], [0.0, 0.0, -9.81], [0.0, -9.0, -3.0]])
def test_level_puts_the_force_upright_without_a_heading(up: list[float]) -> None:
    x = first_state(np.array(up), np.zeros(6), STD, S)
    np.testing.assert_allclose(x.R_wb @ np.array(up) / np.linalg.norm(up), [0.0, 0.0, 1.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(x.R_wb @ x.R_wb.T, np.eye(3), rtol=0, atol=1e-12)


@pytest.mark.parametrize("heading", [0.4, 2.0, -3.0])
def test_biases_do_not_depend_on_the_heading(heading: float) -> None:
    """The tilt's first uncertainty is round, so the world may be turned about the vertical before or after."""
    one, other = steps(start())[-1].after, steps(start(heading))[-1].after
    np.testing.assert_allclose(other.bias, one.bias, rtol=0, atol=EXACT)
    np.testing.assert_allclose(other.ground, one.ground, rtol=0, atol=EXACT)
    np.testing.assert_allclose(other.P[9:, 9:], one.P[9:, 9:], rtol=0, atol=EXACT)
    turn = Rotation.from_euler("z", heading).as_matrix()
    np.testing.assert_allclose(other.R_wb, turn @ one.R_wb, rtol=0, atol=EXACT)


@pytest.mark.parametrize(("rate", "missing_s"), [(0.0, 0.0), (2.0, 0.0), (0.0, 0.01)])
def test_noise_of_the_samples_grows_as_white_noise_does_when_it_is_integrated(rate: float, missing_s: float) -> None:
    """From a state that is exact: angle and velocity by the time, position by its cube (a third, of which a quarter counts)."""
    x, T = start(), 0.5
    x = x._replace(P=np.zeros_like(x.P))
    gyro, accel = np.tile(rate * x.R_wb[2], (101, 1)), np.tile(9.81 * x.R_wb[2], (101, 1))  # level, it turns about the vertical
    P = motion_step(x, integrate(np.arange(101) / 200.0, gyro, accel), gyro[-1], missing_s, np.zeros(6), S).expected.P
    turn = S.gyro_density**2 * T + (S.gyro_scale * rate * T) ** 2 + (inertial_filter.MISSING_RAD_S * missing_s) ** 2
    push = S.accel_density**2 * T + (inertial_filter.MISSING_M_S2 * missing_s) ** 2
    np.testing.assert_allclose(P[:3, :3], turn * np.eye(3), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(P[VELOCITY, VELOCITY], push * np.eye(3), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(P[VELOCITY, POSITION], 0.5 * T * push * np.eye(3), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(np.diag(P[POSITION, POSITION]), 0.25 * T**2 * push, rtol=1e-6)
    assert np.diag(P)[9:].max() <= 1.01 * inertial_filter.MIN_VARIANCE


def test_heading_is_never_found_out() -> None:
    """A heading error shows in no measurement: as large as at the start whatever is measured."""
    x = start()
    P = x.P.copy()
    P[2, 2] = 1.0
    x = x._replace(P=P)
    assert steps(x)[-1].after.P[2, 2] > 1.0


@pytest.mark.parametrize("resting", [False, True])
def test_a_move_is_linear_in_the_error(resting: bool) -> None:
    """F against the integral itself: a small error before, and what it is after. Jr is first order in the turn of a step."""
    t = np.arange(101) / 200.0
    rng = np.random.default_rng(3)
    gyro, accel = 0.8 * rng.normal(size=3) + np.zeros((101, 3)), np.array([0.3, 0.1, 9.9]) + 0.2 * rng.normal(size=(101, 3))
    mean = np.concatenate([np.zeros(3), accel.mean(axis=0)])
    x = start(0.7).moved(np.concatenate([np.zeros(3), [0.8, -0.5, 0.3], [1.0, 2.0, -3.0], np.zeros(SIZE - 9)]), start().P)

    def step(y: State) -> Step:
        if resting:
            return rest_step(y, mean, np.full(3, 1e-8), 0.5, WALK, S)
        return motion_step(y, integrate(t, gyro - y.bias[:3], accel - y.bias[3:]), gyro[-1] - y.bias[:3], 0.0, WALK, S)

    F = step(x).F
    size = 1e-6
    for i in range(SIZE):
        e = np.zeros(SIZE)
        e[i] = size
        slope = (step(x.moved(e, x.P)).expected.minus(step(x.moved(-e, x.P)).expected)) / (2 * size)
        np.testing.assert_allclose(slope, F[:, i], rtol=0, atol=1e-4, err_msg=str(i))


def test_an_update_is_the_textbooks() -> None:
    x = steps(start())[-1].expected
    noise = np.full(3, 0.04)
    z = np.array([0.1, -0.2, 0.05])
    K = x.P @ STOPPED.T @ np.linalg.inv(STOPPED @ x.P @ STOPPED.T + np.diag(noise))
    got = update(x, STOPPED, z, noise)
    np.testing.assert_allclose(got.P, (np.eye(SIZE) - K @ STOPPED) @ x.P, rtol=0, atol=1e-9)
    np.testing.assert_allclose(got.bias, x.bias - (K @ z)[BIAS], rtol=0, atol=EXACT)


def test_the_backward_pass_ends_where_the_forward_one_does_and_is_nowhere_less_sure() -> None:
    forward = steps(start(), 40)
    states = smooth(forward)
    assert len(states) == 41
    np.testing.assert_array_equal(states[-1].bias, forward[-1].after.bias)
    for before, state in zip((step.before for step in forward), states, strict=False):
        slack = np.linalg.eigvalsh(before.P[9:, 9:] - state.P[9:, 9:])
        assert slack.min() > -1e-9
        assert np.linalg.eigvalsh(state.P).min() > -1e-12
    assert states[0].P[9, 9] < 0.9 * forward[0].before.P[9, 9]


def test_smoothing_a_linear_case_is_least_squares() -> None:
    """Only the rest: two stops show the same sum b + d with walks between; the answer of the normal equations."""
    x = start()
    mean = [np.array([1e-3, 0.0, 0.0, 0.5, -0.3, 9.7]), np.array([2e-3, 0.0, 0.0, 0.5, -0.3, 9.7])]
    found = []
    for one in mean:
        found.append(rest_step(x, one, np.full(3, 1e-8), 0.5, WALK, S))
        x = found[-1].after
    q, r = WALK[0] ** 2 * 0.5 + inertial_filter.MIN_VARIANCE, 1e-8 + S.rest_rad_s**2
    # unknown: b0, b1, b2 along x, and d
    A = np.array([[1, 0, 0, 0], [0, 0, 0, 1], [-1, 1, 0, 0], [0, -1, 1, 0], [0, 1, 0, 1], [0, 0, 1, 1]], float)
    y = np.array([0, 0, 0, 0, 1e-3, 2e-3])
    w = 1 / np.array([STD[0] ** 2, STD[6] ** 2 + 2 * inertial_filter.MIN_VARIANCE, q, q, r, r])
    covariance = np.linalg.inv(A.T @ (w[:, None] * A))
    solved = covariance @ (A.T @ (w * y))
    np.testing.assert_allclose([s.bias[0] for s in smooth(found)], solved[:3], rtol=1e-3)
    np.testing.assert_allclose([s.P[9, 9] for s in smooth(found)], np.diag(covariance)[:3], rtol=1e-3)
    np.testing.assert_allclose([s.P[9, 15] for s in smooth(found)], covariance[:3, 3], rtol=1e-3)


def test_a_stop_counts_in_full_however_fast_the_estimate() -> None:
    """At rest a large velocity is the filter's own error; in motion it may be the body's, and counts less."""
    x = start()._replace(v_w=np.array([30.0, 0.0, 0.0]), steady=np.zeros(6))
    P = x.P.copy()
    P[VELOCITY, VELOCITY] = np.eye(3)
    after = rest_step(x._replace(P=P), np.array([0.0, 0.0, 0.0, 0.5, -0.3, 9.7]), np.full(3, 1e-8), 0.5, WALK, S)
    assert np.diag(after.after.P[VELOCITY, VELOCITY]).max() < 1.01 * S.rest_m_s**2


def test_a_room_bounds_the_position() -> None:
    x = steps(start())[-1].after
    t = np.arange(101) / 200.0
    motion = integrate(t, np.full((101, 3), 0.2), np.tile([0.0, 0.5, 9.8], (101, 1)))
    free, inside = (motion_step(x, motion, np.full(3, 0.2), 0.0, WALK, s) for s in (S, FilterSettings(room_m=2.0)))
    assert inside.innovation is not None
    np.testing.assert_allclose(inside.innovation[0], free.after.p_wb, rtol=0, atol=EXACT)
    np.testing.assert_allclose(inside.innovation[1], free.after.P[POSITION, POSITION] + 4.0 * np.eye(3), rtol=0, atol=EXACT)
    assert np.linalg.norm(inside.after.p_wb) < np.linalg.norm(free.after.p_wb)
