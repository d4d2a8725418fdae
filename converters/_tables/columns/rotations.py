"""Rotations of a table: from matrices and angles, their order, the unit of a gyro."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from imutool.array_types import Bool, Float64
from imutool.errors import DataError
from imutool.geometry import quaternion
from imutool.recording import interpolate

from ..text.delimited import Columns
from .map import Entries
from .units import ANGLE_SI, GYRO_SI, TIME_NS, are_unsigned_counts

SPAN_S, LONG_SPAN_S = 0.1, 0.3  # over which turns are compared; over the second, noise of the poses is a smaller part
MAX_SPANS, MIN_S = 5.0, 5.0  # multiple of a span that has a gap in it, and the least time to compare
MAX_S = 300.0  # of a longer table, those that turn most
SURE, CLEARLY = 0.9, 0.25  # correlation of turns that are the same; share of what the other order leaves that the right one may
LIKELY, MAX_OFF = 0.6, 1.35  # correlation with poses that jump; ratio of turns in one unit, as the next is a factor of 57 away
ORTHOGONAL = 0.02  # what two printed decimals leave of R R^T = 1
NOT_UNIT, MAX_NOT_UNIT = 0.01, 0.1  # error of a quaternion's length, and the share of them that may have it
ORDERS, ORDER_NAMES = ((0, 1, 2, 3), (3, 0, 1, 2)), ("wxyz", "xyzw")  # of w, x, y, z in an array
UP = np.cos(np.radians(25.0))  # of the mean force in a world whose z axis points up
INVERSE = np.array([1.0, -1.0, -1.0, -1.0])  # of a unit quaternion
EITHER_WAY = ", and the other way, too: the motion has too few axes to tell"
TURNS = {"quaternion_wxyz", "rotation_matrix", "roll_pitch_yaw"}  # entries of a map that name rotations
MAX_RAD = 2.0 * np.pi + 1e-3  # beyond which angles are degrees
SPANS_S = SPAN_S, LONG_SPAN_S, 1.0  # over which angles are compared, often rounded to 0.1 degrees, or of poses that jump
DELAYS_S = (*(sign * tenth / 10.0 for tenth in range(11) for sign in (1, -1)),)  # of a clock of the poses' own, none first
MAX_IN_ROWS_S = 0.2  # delay of poses in the rows of the IMU


def of_matrices(matrices: Float64[np.ndarray, "n 3 3"], where: Path | None = None) -> Float64[np.ndarray, "n 4"]:
    """Quaternions (wxyz) of rotation matrices; zeros of one that is missing.

    Raises:
        DataError: a matrix that does not rotate.
    """
    from scipy.spatial.transform import Rotation

    known = np.flatnonzero(np.isfinite(matrices).all(axis=(1, 2)) & matrices.any(axis=(1, 2)))
    R = matrices[known]
    off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    if len(wrong := known[(off > ORTHOGONAL) | (np.linalg.det(R) < 0.0)]):
        raise DataError(
            f"matrix {wrong[0] + 1} of rotation_matrix is no rotation: {(matrices[wrong[0]].round(3) + 0.0).tolist()}",
            where=where,
            expected="three right-handed, orthogonal rows of length 1",
            fix="Check the columns and their order",
        )
    q_wxyz = np.zeros((len(matrices), 4))
    q_wxyz[known] = quaternion.unit(Rotation.from_matrix(R).as_quat()[:, [3, 0, 1, 2]])
    return q_wxyz


def known_rotations(q_wxyz: Float64[np.ndarray, "n 4"], topic: str) -> tuple[Bool[np.ndarray, " n"], list[str]]:
    """Rows that hold a rotation, and notes on those without one or of another length."""
    length = np.linalg.norm(q_wxyz, axis=1)
    missing = ~(length > 0.0)
    off = ~missing & (np.abs(length - 1.0) > NOT_UNIT)
    if off.sum() > MAX_NOT_UNIT * (~missing).sum():  # these are no quaternions
        off[:] = False
    notes = [f"{topic}: {missing.sum()} samples without a pose are left out"] if missing.any() else []
    if off.any():
        row = int(np.argmax(off))
        note = f"{off.sum()} quaternions whose length is not 1 are left out, the first in row {row + 1}: {q_wxyz[row].tolist()}"
        notes.append(f"{topic}: {note}")
    return ~missing & ~off, notes


def order_by_motion(columns: Columns, entries: Entries, array: list[str], clock: tuple[str, str]) -> tuple[list[str], str]:
    """Columns w, x, y, z (some with a minus) that turn as the gyro, and their order in words.

    The inverse of the other order turns alike, in other frames. It counts where gravity is up in its world alone, or where
    gravity leaves it open and it alone turns about the gyro's own axes.
    """
    values = columns.side_by_side(array)
    candidates = [values[:, order] for order in ORDERS]
    best, is_shown = _way_by_motion(columns, entries, candidates, clock)
    if best is None:
        return [], ""
    at_s, other = seconds_of(columns, clock), 1 - best
    pair = candidates[best], candidates[other] * INVERSE
    for delay_s, turns in _trials(columns, entries, pair, clock):
        own, inverse = turns
        if min(own.correlation, inverse.correlation) > SURE:
            named = zip(pair, turns, strict=True)
            up = [up_share(columns, entries, way, at_s - delay_s, turn.turn) > UP for way, turn in named]
            is_own = inverse.same_axes > SURE and _is_clear(inverse.same_axes, own.same_axes)
            if up[1] > up[0] or (up[1] == up[0] and is_own):
                w, *xyz = (array[axis] for axis in ORDERS[other])
                return [w, *(f"-{column}" for column in xyz)], f"{ORDER_NAMES[other]}, from the world to the body"
            break
    return [array[axis] for axis in ORDERS[best]], ORDER_NAMES[best] + ("" if is_shown else EITHER_WAY)


def up_share(
    columns: Columns,
    entries: Entries,
    q_wxyz: Float64[np.ndarray, "n 4"],
    at_s: Float64[np.ndarray, " n"],
    turn: Float64[np.ndarray, "3 3"],
) -> float:
    """Share along +z of the mean specific force in the poses' world; `turn` is of their body."""
    force = columns.side_by_side(entries["accel"])
    t_s = seconds_of(columns, (str(entries["time"]), str(entries["time_unit"])))
    if len(t_s) != len(force):
        return 0.0
    known = np.isfinite(t_s) & np.isfinite(force).all(axis=1)
    at_poses = interpolate(at_s, t_s[known], force[known])
    unit = np.abs(np.linalg.norm(q_wxyz, axis=1) - 1.0) < NOT_UNIT
    mean = quaternion.rotate(q_wxyz[unit], at_poses[unit] @ turn.T).mean(axis=0)
    return float(mean[2] / np.linalg.norm(mean))


def body_by_motion(
    columns: Columns, entries: Entries, q_wxyz: Float64[np.ndarray, "n 4"], clock: tuple[str, str]
) -> Float64[np.ndarray, "3 3"]:
    """Rotation from the gyro's axes to the body of poses; none where both are one or not shown."""
    for _, (turn,) in _trials(columns, entries, [q_wxyz], clock):
        if turn.correlation > SURE:
            return np.eye(3) if turn.same_axes > SURE else turn.turn
    return np.eye(3)


def matrix_by_motion(columns: Columns, entries: Entries, nine: list[str], clock: tuple[str, str]) -> tuple[list[str], bool]:
    """Nine columns of a matrix or its transpose that turns as the gyro; whether it shows which."""
    candidates = nine, [nine[place] for place in (0, 3, 6, 1, 4, 7, 2, 5, 8)]
    turns = [rotations(columns, {"rotation_matrix": way}) for way in candidates]
    best, is_shown = _way_by_motion(columns, entries, turns, clock)
    return ([] if best is None else candidates[best]), is_shown


def _way_by_motion(
    columns: Columns, entries: Entries, candidates: Sequence[Float64[np.ndarray, "n 4"]], clock: tuple[str, str]
) -> tuple[int | None, bool]:
    """Which of two readings of a rotation turns as the gyro does, and whether motion shows it.

    A quaternion in the other order is the inverse rotation in other frames, as is the transpose of a matrix. Motion about one
    or two axes fits both. Then the reading that turns about the gyro's own axes counts, or else the first.
    """
    fits_both = False
    for delay_s, turns in _trials(columns, entries, candidates, clock):
        for found in ([turn.correlation for turn in turns], [turn.same_axes for turn in turns]):
            best = int(np.argmax(found))
            if found[best] > SURE and _is_clear(found[best], min(found)):
                return best, True
        fits_both = fits_both or (not delay_s and min(turn.correlation for turn in turns) > SURE)
    return (0 if fits_both else None), False


def angles_by_motion(columns: Columns, entries: Entries, three: list[str], clock: tuple[str, str]) -> Entries:
    """Entries of roll, pitch and yaw that turn as the gyro does; empty where not certain.

    A yaw that counts the other way has a minus. Two signs that change together are another body and world, no other turn.
    """
    candidates: dict[tuple[str, str], Entries] = {
        (unit, yaw): {"roll_pitch_yaw": [*three[:2], yaw + three[2]], "roll_pitch_yaw_unit": unit}
        for unit, yaw in product(_angle_units(columns, three), ("", "-"))
    }
    turned = [rotations(columns, named) for named in candidates.values()]
    size = GYRO_SI.get(str(entries.get("gyro_unit", "")), 0.0)
    for _, turns in _trials(columns, entries, turned, clock):
        found = {}
        for way, turn in zip(candidates, turns, strict=True):
            is_alike = not size or 1.0 / MAX_OFF < turn.slope / size < MAX_OFF
            found[way] = turn.correlation if is_alike else 0.0
        unit, yaw = max(found, key=lambda way: found[way])
        best, other_unit = found[unit, yaw], max((r for (u, _), r in found.items() if u != unit), default=0.0)
        if best > SURE and _is_clear(best, other_unit):
            return candidates[unit, "-" if _is_clear(found[unit, "-"], found[unit, ""]) else ""]
    return {}


def _trials(
    columns: Columns, entries: Entries, candidates: Sequence[Float64[np.ndarray, "n 4"]], clock: tuple[str, str]
) -> Iterator[tuple[float, list[_Alike]]]:
    """Delays between poses and gyro, the smallest first, and how far each candidate then turns as the gyro.

    Delays are less in rows of the IMU, which may be of another device.
    """
    gyro, at_s = _GyroTurns.of(columns, entries), seconds_of(columns, clock)
    delays = (delay_s for delay_s in DELAYS_S if clock[0] != entries["time"] or abs(delay_s) <= MAX_IN_ROWS_S)
    for delay_s, span_s in product(delays, SPANS_S):
        yield delay_s, [_turns_alike(gyro, way, at_s - delay_s, span_s) for way in candidates]


def _is_clear(correlation: float, other: float) -> bool:
    """Whether a correlation leaves much less than another."""
    return 1.0 - correlation < CLEARLY * (1.0 - other)


def _angle_units(columns: Columns, three: list[str]) -> list[str]:
    """Units that angles may have: the stated one, degrees beyond a turn, else either."""
    texts = [column.rpartition("/")[2].lower() + columns.units.get(column, "").lower() for column in three]
    stated = {unit for unit, word in (("deg", "deg|°"), ("rad", "rad")) if all(re.search(word, text) for text in texts)}
    values = columns.side_by_side(three)
    if len(stated) == 1:
        return [*stated]
    return ["rad", "deg"] if np.isfinite(values).any() and np.nanmax(np.abs(values)) < MAX_RAD else ["deg"]


def unit_by_poses(columns: Columns, entries: Entries) -> str:
    """Unit in which the gyro turns as far as the poses; empty where none does."""
    if not entries.keys() & TURNS or are_unsigned_counts(columns.side_by_side(entries["gyro"])):  # with a zero of their own
        return ""
    q_wxyz, gyro = rotations(columns, entries), _GyroTurns.of(columns, entries)
    at_s = seconds_of(columns, (str(entries["truth_time"]), str(entries["truth_time_unit"])))
    for span_s in (SPAN_S, LONG_SPAN_S):
        turn = _turns_alike(gyro, q_wxyz, at_s, span_s)
        near = [unit for unit, size in GYRO_SI.items() if 1.0 / MAX_OFF < turn.slope / size < MAX_OFF]
        if turn.correlation > LIKELY and near:
            return near[0]
    return ""


def rotations(columns: Columns, entries: Entries) -> Float64[np.ndarray, "n 4"]:
    """Quaternions (wxyz) of the columns that the entries name."""
    if "roll_pitch_yaw" in entries:
        angles = columns.side_by_side(entries["roll_pitch_yaw"])
        return quaternion.of_roll_pitch_yaw(angles * ANGLE_SI[str(entries["roll_pitch_yaw_unit"])])
    if "rotation_matrix" in entries:
        matrices = columns.side_by_side(entries["rotation_matrix"]).reshape(-1, 3, 3)
        is_rotation = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) < ORTHOGONAL
        is_rotation &= np.linalg.det(np.where(is_rotation[:, None, None], matrices, 0.0)) > 0.0
        return of_matrices(np.where(is_rotation[:, None, None], matrices, 0.0))
    return columns.side_by_side(entries["quaternion_wxyz"])


class _GyroTurns(NamedTuple):
    """Angles to which the gyro's rates add up, in its unit times seconds."""

    t_s: Float64[np.ndarray, " n"]
    angles: Float64[np.ndarray, "n 3"]

    @classmethod
    def of(cls, columns: Columns, entries: Entries) -> _GyroTurns:
        """Angles over the `MAX_S` seconds that turn most; none without a time for each rate."""
        names = [str(entries["time"]), *entries["gyro"]]
        if len({len(columns.values[columns.unsigned(name)]) for name in names}) > 1:
            return cls(np.zeros(0), np.zeros((0, 3)))
        t, rates = columns.values[names[0]].astype(float), columns.side_by_side(names[1:])
        known = np.isfinite(t)
        t, rates = t[known] * TIME_NS[str(entries["time_unit"])] * 1e-9, np.where(np.isfinite(rates), rates, 0.0)[known]
        if len(t) and t[-1] - t[0] > MAX_S and (np.diff(t) >= 0.0).all():
            ends, power = np.searchsorted(t, t + MAX_S), np.cumsum((rates**2).sum(axis=1))
            start = int(np.argmax(power[ends - 1] - power))
            t, rates = t[start : ends[start]], rates[start : ends[start]]
        steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(t)[:, None]
        return cls(t, np.concatenate([np.zeros((min(len(t), 1), 3)), np.cumsum(steps, axis=0)]))


class _Alike(NamedTuple):
    """Turns of poses and of the gyro."""

    correlation: float  # under the best rotation between poses and gyro
    slope: float  # of the poses' turns by the gyro's, which noise of the poses does not bias
    same_axes: float  # correlation without a rotation
    turn: Float64[np.ndarray, "3 3"]  # that rotation, from the gyro to the body of the poses


def _turns_alike(
    gyro: _GyroTurns, q_wxyz: Float64[np.ndarray, "n 4"], at_s: Float64[np.ndarray, " n"], span_s: float
) -> _Alike:
    """How far the poses turn as the gyro does; a correlation of zero where they share too little time."""
    if not len(gyro.t_s):
        return _Alike(0.0, 0.0, 0.0, np.eye(3))
    inside = (at_s >= gyro.t_s[0]) & (at_s <= gyro.t_s[-1])
    at, q = at_s[inside], q_wxyz[inside]
    size = np.sqrt((q**2).sum(axis=1))
    whole = np.isfinite(size) & (np.abs(size - 1.0) < 0.01)
    at, q = at[whole], q[whole]
    step = max(1, round(span_s / max(float(np.median(np.diff(at))), 1e-9))) if len(at) > 1 else 1
    at, q = at[::step], q[::step]
    spans = np.diff(at)
    kept = (spans > 0.0) & (spans < MAX_SPANS * span_s)
    if spans[kept].sum() < MIN_S:
        return _Alike(0.0, 0.0, 0.0, np.eye(3))
    turned = quaternion.log(quaternion.multiply(quaternion.inverse(q[:-1]), q[1:]))[kept]
    measured = np.diff(interpolate(at, gyro.t_s, gyro.angles), axis=0)[kept]
    turned, measured = turned - turned.mean(axis=0), measured - measured.mean(axis=0)
    product = turned.T @ measured
    left, singular, right = np.linalg.svd(product)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(product))])
    power = (turned**2).sum(), (measured**2).sum()
    size = max(np.sqrt(power[0] * power[1]), 1e-30)
    correlation, ratio = singular @ signs / size, np.sqrt(power[0] / max(power[1], 1e-30))
    return _Alike(float(correlation), float(correlation * ratio), float(np.trace(product) / size), left * signs @ right)


def seconds_of(columns: Columns, clock: tuple[str, str]) -> Float64[np.ndarray, " n"]:
    """Times of a column in s."""
    return np.asarray(columns.values[clock[0]].astype(float) * TIME_NS[clock[1]] * 1e-9)
