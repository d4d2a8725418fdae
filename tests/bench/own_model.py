"""Whether the bias filter and its smoother know how sure they are, on logs drawn from the filter's own model.

    python tests/bench/own_model.py [--runs 100] [--stops]

Biases, offset at rest, walk, pivot, mean velocity, first pose and all noise are drawn from what the filter assumes
(`FilterSettings`, `STD`, `USUAL_WALK`), and the velocity at the end of each half second from its bound. So its ellipsoids must
hold 68, 95 and 99.7 % of the errors, whatever real sensors do: else the filter has an error. What the made-up sensors of
`consistency.py` miss beyond that is a difference between them and the model. A third row has the variances alone, as the
trajectory of `--smooth` keeps them.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from imutool.array_types import Float64
from imutool.bias_start.prior_width import USUAL_WALK
from imutool.geometry import quaternion
from imutool.inertial import inertial_filter
from imutool.inertial.inertial_filter import BIAS, SIZE, FilterSettings, State, Step
from imutool.inertial.kinematics import G_W
from imutool.inertial.preintegration import integrate
from imutool.recording import GRAVITY_M_S2

S = FilterSettings()
STD = np.array([2e-3] * 3 + [0.05] * 3 + [1e-4] * 3 + [0.03] * 3)  # of the bias in motion, and of its offset at rest
BLOCK_S, SAMPLES, LENGTH_S = 0.5, 50, 60.0
STOPS_S = (0.0, 8.0), (30.0, 35.0)
WHITE = 1e-3  # rad/s: of a sample at rest
SHARES = (0.68, 0.95, 0.997)
TIMES_S = np.arange(1.0, LENGTH_S, 6.0)


class Drawn(NamedTuple):
    """Filter steps of a log, and its true bias before each of them."""

    steps: list[Step]
    bias: Float64[np.ndarray, "m 6"]


def main() -> None:
    """Shares of the errors within the ellipsoids, of the gyro's bias and of both biases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100, help="logs of a minute")
    parser.add_argument("--stops", action="store_true", help="each log has two stops")
    options = parser.parse_args()
    squares: dict[tuple[str, int], list[float]] = defaultdict(list)
    for seed in range(options.runs):
        log = drawn(np.random.default_rng([seed, 7]), STOPS_S if options.stops else ())
        smoothed, rows = inertial_filter.smooth(log.steps), (TIMES_S / BLOCK_S).astype(int)
        for row in rows:
            forward, later = log.steps[row].before, smoothed[row]
            alone = np.diag(np.diag(later.P[BIAS, BIAS]))
            found = ("filter", forward, forward.P[BIAS, BIAS]), ("smoother", later, later.P[BIAS, BIAS])
            for what, state, P in (*found, ("its variances", later, alone)):
                e = state.bias - log.bias[row]
                for k in (3, 6):
                    squares[what, k].append(float(e[:k] @ np.linalg.solve(P[:k, :k], e[:k])))
    for (what, k), found_squares in squares.items():
        held = " / ".join(f"{100 * (np.array(found_squares) <= chi2.ppf(share, k)).mean():.0f}" for share in SHARES)
        print(f"{what:14}{'gyro' if k == 3 else 'both':6}{held} %  of {len(found_squares)}, {options.runs} logs")


def drawn(rng: np.random.Generator, stops: tuple[tuple[float, float], ...]) -> Drawn:
    """A log of the filter's own model, filtered."""
    P = np.diag(np.concatenate([np.zeros(9), STD, np.repeat([S.pivot_m, S.speed_m_s], 3)]) ** 2)
    P[0, 0] = P[1, 1] = (S.start_m_s2**2 + STD[3] ** 2) / GRAVITY_M_S2**2
    P[3:6, 3:6] = S.speed_m_s**2 * np.eye(3)
    steady = np.repeat([S.pivot_m, S.speed_m_s], 3) * rng.normal(size=6)
    R = Rotation.from_euler("ZYX", [0.0, *0.4 * rng.normal(size=2)]).as_matrix()
    bias, offset = np.split(STD * rng.normal(size=12), 2)
    truth = State(R, S.speed_m_s * rng.normal(size=3), np.zeros(3), bias, offset, steady, P)
    x, steps, biases = truth.moved(np.sqrt(np.diag(P)) * rng.normal(size=SIZE), P), [], []
    for times_s, rate in rates(rng):
        resting = any(begin <= times_s[0] < end for begin, end in stops)
        u, truth = moved(truth, times_s, 0.0 * rate if resting else rate, resting, rng)
        steps.append(filtered(x, times_s, u, resting))
        biases.append(truth.bias)
        walked = USUAL_WALK * np.sqrt(BLOCK_S) * rng.normal(size=6)
        x, truth = steps[-1].after, truth._replace(bias=truth.bias + walked)
    return Drawn(steps, np.array(biases))


def rates(rng: np.random.Generator) -> Iterator[tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]]:
    """Times and smooth true rates of each block, both of its ends included."""
    knot_s = 0.35
    knots = 0.8 * rng.normal(size=(round(LENGTH_S / knot_s) + 10, 3))
    rate = BSpline((np.arange(len(knots) + 4) - 4) * knot_s, knots, 3)
    for begin_s in np.arange(0.0, LENGTH_S, BLOCK_S):
        times_s = begin_s + np.linspace(0.0, BLOCK_S, SAMPLES + 1)
        yield times_s, rate(times_s)


def moved(
    truth: State, t_s: Float64[np.ndarray, " n"], rate: Float64[np.ndarray, "n 3"], resting: bool, rng: np.random.Generator
) -> tuple[Float64[np.ndarray, "n 6"], State]:
    """Samples of a block with their noise, and the true state after it; its last velocity is drawn."""
    step = quaternion.exp(0.5 * (rate[1:] + rate[:-1]) * np.diff(t_s)[:, None])
    turned = quaternion.matrix(np.concatenate([[[1.0, 0.0, 0.0, 0.0]], quaternion.running_product(step)]))
    R = truth.R_wb @ turned
    push = np.interp(t_s - t_s[0], [0.0, BLOCK_S / 2, BLOCK_S], [0.0, 2.0 / BLOCK_S, 0.0])[:, None]
    if resting:
        v = S.rest_m_s * rng.normal(size=3)
    else:
        noise = np.sqrt(2.0 * S.speed_m_s**2 * S.speed_correlation_s / BLOCK_S) * rng.normal(size=3)
        v = noise - R[-1] @ np.cross(rate[-10:].mean(axis=0), truth.steady[:3]) + R[-1] @ truth.steady[3:]
    gained = v - truth.v_w
    for _ in range(2):  # what the trapezoidal rule makes of the push
        force = np.einsum("nji,nj->ni", R, push * gained - G_W)
        motion = integrate(t_s, rate, force)
        reached = truth.v_w + G_W * BLOCK_S + truth.R_wb @ motion.v
        gained = gained + v - reached
    p = truth.p_wb + truth.v_w * BLOCK_S + 0.5 * BLOCK_S**2 * G_W + truth.R_wb @ motion.p
    bias = truth.rest_bias(resting)
    accel = force + bias[3:] + S.accel_density / np.sqrt(BLOCK_S) * rng.normal(size=3)
    if resting:
        gyro = rate + bias[:3] + S.rest_rad_s * rng.normal(size=3) + WHITE * rng.normal(size=rate.shape)
    else:
        variance = S.gyro_density**2 * BLOCK_S + (S.gyro_scale * motion.turned_rad) ** 2
        gyro = rate + bias[:3] + np.sqrt(variance) / BLOCK_S * rng.normal(size=3)
    return np.concatenate([gyro, accel], axis=1), truth._replace(R_wb=R[-1], v_w=reached, p_wb=p)


def filtered(x: State, t_s: Float64[np.ndarray, " n"], u: Float64[np.ndarray, "n 6"], resting: bool) -> Step:
    """Filter step over a block."""
    if resting:
        variance = u[:-1, :3].var(axis=0) / SAMPLES
        return inertial_filter.rest_step(x, u[:-1].mean(axis=0), variance, BLOCK_S, USUAL_WALK, S)
    gyro, accel = u[:, :3] - x.bias[:3], u[:, 3:] - x.bias[3:]
    return inertial_filter.motion_step(x, integrate(t_s, gyro, accel), gyro[-10:].mean(axis=0), 0.0, USUAL_WALK, S)


if __name__ == "__main__":
    main()
