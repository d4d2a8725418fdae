"""Rotations of a table: from matrices, the order of their columns, the unit of a gyro."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from imutool.array_types import Float64
from imutool.errors import DataError
from imutool.geometry import quaternion

from ._table_map import Entries
from ._table_text import Columns
from ._table_units import GYRO_SI, TIME_NS

SPAN_S, LONGEST_SPAN_S = 0.1, 0.5  # over which turns are compared; a longer one has a gap in it
LEAST_SPANS = 100
SURE, CLEARLY = 0.9, 0.25  # correlation of turns that are the same; share of what the other order leaves that the right one may
MOST_OFF = 1.2  # ratio of the turns of the poses to those of a gyro in its unit
ORTHOGONAL = 0.02  # what two printed decimals leave of R R^T = 1
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
    correlation, ratio = _turns_alike(columns, entries, q_wxyz, (str(entries["truth_time"]), str(entries["truth_time_unit"])))
    near = (unit for unit, size in GYRO_SI.items() if 1.0 / MOST_OFF < ratio / size < MOST_OFF)
    return next(near, "") if correlation > SURE else ""


def _turns_alike(
    columns: Columns, entries: Entries, q_wxyz: Float64[np.ndarray, "n 4"], clock: tuple[str, str]
) -> tuple[float, float]:
    """Correlation of the poses' turns with the gyro's under the best rotation between them, and the ratio of their sizes."""
    names = [str(entries["time"]), *entries["gyro"]]
    if len({len(columns.values[name]) for name in names}) > 1:
        return 0.0, 0.0
    t, *gyro = (columns.values[name].astype(float) for name in names)
    t, at = t * TIME_NS[str(entries["time_unit"])] * 1e-9, columns.values[clock[0]].astype(float) * TIME_NS[clock[1]] * 1e-9
    rates = np.nan_to_num(np.stack(gyro, axis=1))
    size = np.sqrt((q_wxyz**2).sum(axis=1))
    whole = np.isfinite(size) & (np.abs(size - 1.0) < 0.01) & (at >= t[0]) & (at <= t[-1])
    at, q = at[whole], q_wxyz[whole]
    step = max(1, round(SPAN_S / max(float(np.median(np.diff(at))), 1e-9))) if len(at) > 1 else 1
    at, q = at[::step], q[::step]
    spans = np.diff(at)
    kept = (spans > 0.0) & (spans < LONGEST_SPAN_S)
    if kept.sum() < LEAST_SPANS:
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
