"""Rotations of a table: from matrices, the order of their columns, the unit of a gyro."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from imutool.array_types import Bool, Float64
from imutool.errors import DataError
from imutool.geometry import quaternion

from ._table_map import Entries
from ._table_text import Columns
from ._table_units import GYRO_SI, TIME_NS

SPAN_S, LONG_SPAN_S = 0.1, 0.3  # over which turns are compared; over the second, noise of the poses is a smaller part
MOST_SPANS, LEAST_S = 5.0, 10.0  # multiple of a span that has a gap in it, and the least time to compare
SURE, CLEARLY = 0.9, 0.25  # correlation of turns that are the same; share of what the other order leaves that the right one may
LIKELY, MOST_OFF = 0.6, 1.35  # correlation with poses that jump; ratio of turns in one unit, as the next is a factor of 57 away
ORTHOGONAL = 0.02  # what two printed decimals leave of R R^T = 1
NOT_UNIT, MOST_NOT_UNIT = 0.01, 0.1  # error of a quaternion's length, and the share of them that may have it
ORDERS = (0, 1, 2, 3), (3, 0, 1, 2)  # of w, x, y, z in an array: wxyz or xyzw


def of_matrices(matrices: Float64[np.ndarray, "n 3 3"], where: Path) -> Float64[np.ndarray, "n 4"]:
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
    if off.sum() > MOST_NOT_UNIT * (~missing).sum():  # these are no quaternions
        off[:] = False
    notes = [f"{topic}: {missing.sum()} samples without a pose are left out"] if missing.any() else []
    if off.any():
        row = int(np.argmax(off))
        said = f"{off.sum()} quaternions whose length is not 1 are left out, the first in row {row + 1}: {q_wxyz[row].tolist()}"
        notes.append(f"{topic}: {said}")
    return ~missing & ~off, notes


def order_by_motion(columns: Columns, entries: Entries, array: list[str], clock: tuple[str, str]) -> list[str]:
    """Columns w, x, y, z of an array that turns as the gyro does; empty where not certain."""
    values = np.stack([columns.values[column] for column in array], axis=1).astype(float)
    found = [_turns_alike(columns, entries, values[:, order], clock)[0] for order in ORDERS]
    best = int(np.argmax(found))
    return (
        [array[axis] for axis in ORDERS[best]]
        if found[best] > SURE and 1.0 - found[best] < CLEARLY * (1.0 - min(found))
        else []
    )


def unit_by_poses(columns: Columns, entries: Entries) -> str:
    """Unit in which the gyro turns as far as the poses; empty where none does."""
    if "quaternion_wxyz" not in entries:
        return ""
    q_wxyz = np.stack([columns.values[column] for column in entries["quaternion_wxyz"]], axis=1).astype(float)
    clock = str(entries["truth_time"]), str(entries["truth_time_unit"])
    for span_s in (SPAN_S, LONG_SPAN_S):
        correlation, ratio = _turns_alike(columns, entries, q_wxyz, clock, span_s)
        slope = correlation * ratio  # of the poses' turns by the gyro's: noise of the poses does not bias it
        near = [unit for unit, size in GYRO_SI.items() if 1.0 / MOST_OFF < slope / size < MOST_OFF]
        if correlation > LIKELY and near:
            return near[0]
    return ""


def _turns_alike(
    columns: Columns, entries: Entries, q_wxyz: Float64[np.ndarray, "n 4"], clock: tuple[str, str], span_s: float = SPAN_S
) -> tuple[float, float]:
    """Correlation of the poses' turns with the gyro's under the best rotation between them, and the ratio of their sizes."""
    names = [str(entries["time"]), *entries["gyro"]]
    if len({len(columns.values[name]) for name in names}) > 1:
        return 0.0, 0.0
    t, *gyro = (columns.values[name].astype(float) for name in names)
    t, at = t * TIME_NS[str(entries["time_unit"])] * 1e-9, columns.values[clock[0]].astype(float) * TIME_NS[clock[1]] * 1e-9
    t, rates = t[np.isfinite(t)], np.nan_to_num(np.stack(gyro, axis=1))[np.isfinite(t)]
    size = np.sqrt((q_wxyz**2).sum(axis=1))
    whole = np.isfinite(size) & (np.abs(size - 1.0) < 0.01) & (at >= t[0]) & (at <= t[-1])
    at, q = at[whole], q_wxyz[whole]
    step = max(1, round(span_s / max(float(np.median(np.diff(at))), 1e-9))) if len(at) > 1 else 1
    at, q = at[::step], q[::step]
    spans = np.diff(at)
    kept = (spans > 0.0) & (spans < MOST_SPANS * span_s)
    if spans[kept].sum() < LEAST_S:
        return 0.0, 0.0
    turned = quaternion.log(quaternion.multiply(quaternion.inverse(q[:-1]), q[1:]))[kept]
    angles = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (rates[1:] + rates[:-1]) * np.diff(t)[:, None], axis=0)])
    measured = np.diff(np.stack([np.interp(at, t, angle) for angle in angles.T], axis=1), axis=0)[kept]
    turned, measured = turned - turned.mean(axis=0), measured - measured.mean(axis=0)
    product = turned.T @ measured
    singular = np.linalg.svd(product, compute_uv=False)
    together = singular[0] + singular[1] + np.sign(np.linalg.det(product)) * singular[2]
    power = (turned**2).sum(), (measured**2).sum()
    return float(together / max(np.sqrt(power[0] * power[1]), 1e-30)), float(np.sqrt(power[0] / max(power[1], 1e-30)))
