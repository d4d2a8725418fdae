"""Conventions of a log: units, axes and signs of the IMU, frames and clock of its poses.

Each answer is the best of a finite set of readings: 48 signed permutations of the axes, times the usual units, times the six
directions that may be up. A reading is taken where it beats every other by a likelihood ratio of `SURE` standard errors, where
it explains most of what is there to be explained, and where the motion turns about two axes at least. Else the answer is None:
rest, planar motion and level flight are no evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.cleaning.likelihood import BLOCKS_S, CLEARLY, FEWEST_BLOCKS, SURE, Choice, Reading, choose, signed_permutations
from imutool.cleaning.pose_delay import Delay, StepIntegral, pose_delay, usable
from imutool.cleaning.pose_quaternions import MISREAD, OTHER_WORLD, is_other_world, left_when_turned, read_right
from imutool.cleaning.position_unit import POSITIONS, Misfits, position_unit
from imutool.cleaning.samples import STEP_S, Motion, turns
from imutool.cleaning.truth import Truth, axis_of_gravity, best_rotation, force_in_world, rotation_deg, stays_level, turning
from imutool.cleaning.unit_evidence import RATES
from imutool.geometry import quaternion
from imutool.recording import GRAVITY_M_S2, interpolate
from imutool.recording.columns import median, quantile

SECOND_AXIS = 0.15  # of the rate about the main axis, that about the second at least: more than a tilted mount leaks
WINDOW, MAX_WINDOWS = 5, 600  # steps of 0.1 s over which the gyro must carry gravity along; windows evenly taken from a log
TURNING = 0.4  # of the turn of the liveliest tenth of the windows, that of a window that counts
STRAIGHT_DEG = 15.0  # three deviations above a rotation between gyro and poses that leaves no other order of the axes
MIN_MEAN_S = 10.0  # in which a vehicle that gains 10 m/s upwards changes the mean by a tenth of gravity
FASTEST_RAD_S = 70.0  # 4000 degrees a second: faster, a reading is in another unit


@dataclass(frozen=True)
class Conventions:
    """Conventions that a log's motion shows; None where it does not.

    Attributes:
        gyro, accel: against the poses, in the frame of their body.
        relative: the gyro against gravity as the accelerometer reads it.
        up: axis of the poses' world that points up, as `+z`.
        unit: of the poses' positions, metres unless the motion shows another.
        quaternions: what is wrong with those of the poses (`pose_quaternions`); then all else is of the poses without this.
        vertical_m_s2: mean specific force along the z of the poses' world, gravity where the IMU lies as their body does.
    """

    topic: str = ""
    gyro: Reading | None = None
    accel: Reading | None = None
    relative: Reading | None = None
    up: str | None = None
    delay: Delay | None = None  # of the poses
    unit: str = "m"
    quaternions: str = ""
    vertical_m_s2: float | None = None


def judge(motion: Motion, truth: Truth | None, accel_factor: float) -> Conventions:
    """Conventions of an IMU, from its motion and its poses; `accel_factor` leads to m/s²."""
    step, mean = motion.table()
    if len(step) < WINDOW:
        return Conventions()
    relative = _against_gravity(step, mean)
    if truth is None or motion.start_ns is None:
        return Conventions(relative=relative)
    delay = pose_delay(motion, truth)
    late_ns = 0 if delay is None else round(delay.seconds * 1e9)
    shifted, force, found = truth._replace(t_ns=truth.t_ns - late_ns), mean[:, 3:] * accel_factor, []
    for gyro, poses, what in _turns_against_poses(step, mean, motion.middle_ns, shifted):
        carried = relative
        if relative is None and gyro is not None and gyro.wrong and gyro.sole:
            carried = _against_gravity(step, mean, gyro.axes)
        forces = _force_at_poses(step, force, motion.middle_ns, poses)
        accel, up, unit, other = _accel_against_poses(forces, gyro, carried)
        conventions = Conventions(truth.topic, gyro, accel, carried, up, delay, unit, what or other, _mean_vertical(forces))
        turned = quaternion.rotate(forces.q_wb_wxyz, forces.f @ gyro.axes.T) if gyro is not None else forces.f[:0]
        level = len(turned) > 0 and axis_of_gravity(turned) == "+z"
        found.append((conventions, (up == "+z", accel is not None, level)))
    return max(found, key=lambda each: each[1])[0]  # of equals the first


def _excited(rate: Float64[np.ndarray, "n 3"]) -> bool:
    """Whether the motion turns about two axes at least."""
    _, second, main = np.linalg.eigvalsh(rate.T @ rate)
    return bool(second > SECOND_AXIS**2 * main)


def _rate_readings(fast: float) -> list[tuple[str, Float64[np.ndarray, "3 3"]]]:
    """Units under which a fast rate of the log is one of a sensor, each with every permutation."""
    units = [unit for unit, factor in RATES.items() if 0.02 < fast * factor < FASTEST_RAD_S]
    return [(unit, RATES[unit] * P) for unit in units for P in signed_permutations()]


def _reading(choice: Choice, readings: Sequence[tuple[str, Float64[np.ndarray, "3 3"]]]) -> Reading:
    unit, matrix = readings[choice.best]
    as_is = next(row for row, (name, M) in enumerate(readings) if name == unit and (RATES[unit] * np.eye(3) == M).all())
    return Reading(np.round(matrix / RATES[unit]), unit, choice.certain, *choice.misfit[[choice.best, as_is]].tolist())


def _against_gravity(
    step: Int64[np.ndarray, " m"], mean: Float64[np.ndarray, "m 6"], proposal: Float64[np.ndarray, "3 3"] | None = None
) -> Reading | None:
    """Reading of the gyro that carries gravity along: f(t) = R f(t + 0.5 s), up to the motion's own acceleration.

    With a proposal for its axes it is the choice between that and those of the log.

    Where a vehicle's thrust is what the accelerometer reads, it does not turn in the body, and a zero rate explains it best.
    """
    rate, first, last, number = _windows(step, mean)
    if not len(rate):
        return None
    readings = _rate_readings(float(quantile(np.linalg.norm(rate, axis=2).ravel(), 0.9)))
    if proposal is not None:
        readings = [(unit, M) for unit, M in readings if any((RATES[unit] * P == M).all() for P in (np.eye(3), proposal))]
    if not readings:
        return None
    choice = choose(_carried(rate, first, last, readings), number)
    if choice is None or choice.certain < SURE or not _excited(rate.reshape(-1, 3)):
        return None
    nothing = float(np.sqrt(median(((last - first) ** 2).sum(axis=1))))
    return _reading(choice, readings) if choice.misfit[choice.best] < CLEARLY * nothing else None


def _windows(
    step: Int64[np.ndarray, " m"], mean: Float64[np.ndarray, "m 6"]
) -> tuple[Float64[np.ndarray, "w n 3"], Float64[np.ndarray, "w 3"], Float64[np.ndarray, "w 3"], Int64[np.ndarray, " w"]]:
    """Windows that turn: their angular rates, the specific force at both ends, and the number of their block."""
    starts = np.arange(1, len(step) - WINDOW - 1)
    starts = starts[step[starts + WINDOW + 1] - step[starts - 1] == WINDOW + 2]
    rate = mean[:, :3] - quantile(mean[:, :3], 0.5)
    rows = starts[:, None] + np.arange(WINDOW + 1)
    turned = np.linalg.norm(rate[rows].sum(axis=1), axis=1)
    if not len(starts) or not turned.max() > 0:
        return np.zeros((0, WINDOW, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64)
    use = np.flatnonzero(turned > TURNING * quantile(turned, 0.9))
    starts = starts[use[:: max(1, -(-len(use) // MAX_WINDOWS))]]
    rows = starts[:, None] + np.arange(WINDOW + 1)
    smooth = (mean[:-2, 3:] + mean[1:-1, 3:] + mean[2:, 3:]) / 3.0
    between = 0.5 * (rate[rows[:, :-1]] + rate[rows[:, 1:]])
    return between, smooth[starts - 1], smooth[starts + WINDOW - 1], step[starts] // (4 * WINDOW)


def _carried(
    rate: Float64[np.ndarray, "w n 3"],
    first: Float64[np.ndarray, "w 3"],
    last: Float64[np.ndarray, "w 3"],
    readings: Sequence[tuple[str, Float64[np.ndarray, "3 3"]]],
) -> Float64[np.ndarray, "c w"]:
    """Length of the error of the specific force that each reading of the rates carries from a window's end to its start.

    A signed permutation P of a rate turns the rotation: exp(P w) = P exp(det(P) w) P^T.
    """
    P = np.array([matrix / RATES[unit] for unit, matrix in readings])
    units, proper = np.array([unit for unit, _ in readings]), np.linalg.det(P) > 0
    errors = np.empty((len(readings), len(rate)))
    for unit, rotates in dict.fromkeys(zip(units.tolist(), proper.tolist(), strict=True)):
        of, factor = P[alike := (units == unit) & (proper == rotates)], (1.0 if rotates else -1.0) * RATES[unit] * STEP_S
        q_wxyz = quaternion.exp(np.zeros((len(rate), 3)))
        for k in range(WINDOW):
            q_wxyz = quaternion.multiply(q_wxyz, quaternion.exp(factor * rate[:, k]))
        turned = quaternion.rotate(np.tile(q_wxyz, (len(of), 1)), (last @ of).reshape(-1, 3)).reshape(len(of), -1, 3)
        errors[alike] = np.linalg.norm(turned @ of.swapaxes(1, 2) - first, axis=2)
    return errors


def _turns_against_poses(
    step: Int64[np.ndarray, " m"], mean: Float64[np.ndarray, "m 6"], start_ns: int, truth: Truth
) -> Sequence[tuple[Reading | None, Truth, str]]:
    """Readings of the gyro against the poses, the poses, and what is wrong with their quaternions; the least turn first.

    Misread ones leave no gyro, or no sure axes that are those of the log, and otherwise fit it clearly better, turned at most.
    So do they with a body turned by any angle, as no order of axes fits 40°. Several fit alike, up to a turn of the world.
    """
    gyro = _gyro_against_poses(step, mean, start_ns, truth)
    if gyro is not None and gyro.sole and gyro.as_is:
        return [(gyro, truth, "")]
    fitting: list[tuple[Reading, Truth, str]] = []
    for what in MISREAD:
        other = truth._replace(q_wb_wxyz=read_right(what, truth.q_wb_wxyz))
        found = _gyro_against_poses(step, mean, start_ns, other)
        if found is not None and found.sole and (gyro is None or found.misfit < CLEARLY * gyro.misfit):
            rates = (_rates(step, mean, start_ns, each)[:2] for each in (other, truth))
            remaining = [left_when_turned(RATES[found.unit] * measured, true) for true, measured in rates]
            fitting += [(found, other, what)] * (remaining[0] < CLEARLY * remaining[1])
    fitting.sort(key=lambda each: -float(np.trace(each[0].axes)))
    return [each for each in fitting if np.linalg.det(each[0].axes) > 0.0] or [(gyro, truth, "")]


def _gyro_against_poses(
    step: Int64[np.ndarray, " m"], mean: Float64[np.ndarray, "m 6"], start_ns: int, truth: Truth
) -> Reading | None:
    """Reading of the gyro under which it is the rate of the poses."""
    true, measured, first_s, last_s = _rates(step, mean, start_ns, truth)
    readings = _rate_readings(float(quantile(np.linalg.norm(measured, axis=1), 0.9))) if len(true) else []
    if not readings:
        return None
    errors = np.stack([np.linalg.norm(true - measured @ M.T, axis=1) for _, M in readings])
    choice = choose(errors, (first_s / BLOCKS_S).astype(np.int64))
    lively = np.linalg.norm(true, axis=1) >= median(np.linalg.norm(true, axis=1))
    if choice is None or median(errors[choice.best][lively]) > CLEARLY * median(np.linalg.norm(true[lively], axis=1)):
        return None
    if choice.certain >= SURE and _excited(measured):
        return _reading(choice, readings)
    if truth.kind != "truth":
        return None
    nearest = _nearest(choice, readings)
    gyro = RATES[nearest.unit] * measured
    turned = rotation_deg(best_rotation(gyro, true), gyro, true, float(last_s[-1] - first_s[0]))
    small = turned is not None and np.linalg.norm(turned.deg) + 3.0 * turned.std_deg.max() < STRAIGHT_DEG
    return nearest._replace(straight=bool(small))


def _rates(
    step: Int64[np.ndarray, " m"], mean: Float64[np.ndarray, "m 6"], start_ns: int, truth: Truth
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Rates of the poses and of the gyro over the same times of turns, each without its median; the ends of these (s)."""
    first, last, rate = turning(truth)
    use, first_s, last_s = usable(first, last, start_ns, step)
    if not len(use):
        return rate[:0], rate[:0], first_s, last_s
    measured = StepIntegral.of(step, mean[:, :3]).between(first_s, last_s)
    rows = turns(rate := rate[use] - median(rate[use]))
    return rate[rows], measured[rows] - median(measured), first_s[rows], last_s[rows]


def _nearest(choice: Choice, readings: Sequence[tuple[str, Float64[np.ndarray, "3 3"]]]) -> Reading:
    """The reading nearest to the log's axes among those that fit about as well as the best; it is no proposal."""
    close = np.flatnonzero(choice.misfit < choice.misfit.min() / CLEARLY).tolist()
    good = [row for row in close if readings[row][0] == readings[choice.best][0]]
    nearest = max(good, key=lambda row: float(np.trace(readings[row][1])), default=choice.best)
    return _reading(choice._replace(best=nearest), readings)._replace(sole=False)


class _Forces(NamedTuple):
    """Times of the poses that have samples, their orientation and acceleration, and the specific force there."""

    t_s: Float64[np.ndarray, " n"]
    q_wb_wxyz: Float64[np.ndarray, "n 4"]
    a_w: Float64[np.ndarray, "n 3"]
    f: Float64[np.ndarray, "n 3"]


def _force_at_poses(step: Int64[np.ndarray, " m"], accel: Float64[np.ndarray, "m 3"], start_ns: int, truth: Truth) -> _Forces:
    at_ns, q_wb_wxyz, a_w = force_in_world(truth)
    use, first_s, _ = usable(at_ns, at_ns + 1, start_ns, step)
    return _Forces(first_s, q_wb_wxyz[use], a_w[use], interpolate(first_s, STEP_S * (step + 0.5), accel))


def _mean_vertical(forces: _Forces) -> float | None:
    """Mean specific force along the z of the poses; their own acceleration has no mean worth naming over `MIN_MEAN_S`."""
    if not len(forces.f) or forces.t_s[-1] - forces.t_s[0] < MIN_MEAN_S:
        return None
    return float(quaternion.rotate(forces.q_wb_wxyz, forces.f)[:, 2].mean())


def _accel_against_poses(
    forces: _Forces, gyro: Reading | None, relative: Reading | None
) -> tuple[Reading | None, str | None, str, str]:
    """Axes of the accelerometer by the poses, their axis that is up, unit of positions, and `OTHER_WORLD` or nothing.

    a_w + g up = R_wb axes f. Without acceleration, or in noise, (axes, up) and (-axes, -up) fit alike: the up of right axes.
    """
    first_s, q_wb_wxyz, a_w, f = forces
    if len(f) < FEWEST_BLOCKS:
        return None, None, "m", ""
    ups = np.concatenate([np.eye(3)[2:], -np.eye(3)[2:], np.eye(3)[:2], -np.eye(3)[:2]])
    every = signed_permutations()
    if gyro is not None and gyro.sole and relative is not None:  # axes that agree with the gyro's, up to the sign of gravity
        agreed = np.linalg.det(gyro.axes) * gyro.axes @ relative.axes.T * np.linalg.det(relative.axes)
        every = np.stack([agreed, -agreed])
    readings = [(P, up) for P in every for up in ups]
    turned = np.stack([quaternion.rotate(q_wb_wxyz, f @ P.T) for P in every])
    blocks, misfits = (first_s / BLOCKS_S).astype(np.int64), Misfits(a_w, turned, GRAVITY_M_S2 * ups)
    unit = position_unit(misfits, blocks)
    misfits = misfits._replace(a_w=POSITIONS[unit] * misfits.a_w)
    a_w, choice = misfits.a_w, choose(misfits.sizes(1.0), blocks)
    straight = gyro is not None and gyro.as_is and (gyro.sole or gyro.straight)
    misfit = np.zeros((0, 3)) if choice is None else misfits.of(1.0, choice.best)
    if straight and is_other_world(f, q_wb_wxyz, a_w, misfit, blocks):
        return None, None, unit, OTHER_WORLD
    contradicted = relative is not None and relative.wrong  # then the mean force is in other axes than the gyro's
    in_mean = axis_of_gravity(quaternion.rotate(q_wb_wxyz, f)) if straight and not contradicted else None
    if choice is None or choice.misfit[choice.best] > CLEARLY * GRAVITY_M_S2:
        return None, in_mean, unit, ""
    rows = sorted(np.flatnonzero(choice.alike).tolist(), key=lambda row: row != choice.best)
    if contradicted and gyro is not None and gyro.sole:  # a mirrored accel in a world z down fits alike
        rows = [row for row in rows if np.linalg.det(readings[row][0]) > 0.0 and readings[row][1][2] > 0.0] or rows
    P, up = readings[rows[0]]
    if straight and up[2] < 0.0 and (np.diag([1, 1, -1]) == P).all() and stays_level(q_wb_wxyz):  # mirrored, it fits alike
        return None, in_mean, unit, ""
    as_is = float(np.sqrt(median(np.sum((a_w + GRAVITY_M_S2 * ups[0] - quaternion.rotate(q_wb_wxyz, f)) ** 2, axis=1))))
    one_axes, one_up = (all((readings[row][part] == readings[rows[0]][part]).all() for row in rows) for part in (0, 1))
    found = Reading(P, "m/s^2", choice.certain, float(choice.misfit[rows[0]]), as_is) if one_axes else None
    named = axis_of_gravity(GRAVITY_M_S2 * up[None]) if one_up else in_mean
    if not straight and (gyro is None or not gyro.sole):  # without turns about two axes a proposal has no evidence
        return found if found is not None and found.as_is else None, named if named == "+z" else None, unit, ""
    return found, named, unit, ""
