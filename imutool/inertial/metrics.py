"""Error metrics of an estimated trajectory.

Plain dicts for JSON, with the unit in every key.

Definitions are the paper's (section "Evaluation Metric"), which are those of evo; a test compares with evo's command line.
Both trajectories have the same stamps, and a mask marks the rows with truth; other rows count nowhere. A figure that the
data do not determine is None (JSON null).

==================  ===================================================================================================
aoe_deg, ape_m      root mean square of the rotation angle and of the distance between estimate and truth, not aligned:
                    both start from the true pose, so all of the error is the estimate's (`evo_ape tum -r angle_deg`)
aoe_aligned_deg,    the same after the rigid motion of the estimate that brings its positions nearest to the true ones
ape_aligned_m       (Umeyama 1991, no scale; `evo_ape tum --align`)
velocity_rmse_m_s   root mean square of the velocity difference, not aligned
roe_deg, rpe_m      mean rotation angle and mean length of the difference of motions over stretches of 5, 10, 15 and
                    20 m of the true path (`evo_rpe tum -d D -u m --all_pairs --pairs_from_reference`)
==================  ===================================================================================================
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from imutool.array_types import Bool, Float64, Int64
from imutool.errors import DataError, NumericsError
from imutool.geometry import quaternion
from imutool.mcap_io.storage.target import Target, writing
from imutool.recording import Poses, seconds
from imutool.recording.columns import median

DISTANCES_M = (5.0, 10.0, 15.0, 20.0)
PAIR_TOLERANCE = 0.1  # relative tolerance of a pair's distance: evo's default
AT_ONCE = 1 << 13  # poses or pairs, so that their arrays stay in the cache
# least singular value (m²): below it positions lie on a line for evo, and rotation about the line is free
FLAT = np.finfo(np.float64).eps
FEWEST_WINDOWS, MOST_MISSED = 10, 4.0  # that show a delay of the poses; of the median error of windows, that of one that counts

Mask = Bool[np.ndarray, " n"]
Points = Float64[np.ndarray, "n 3"]
Quaternions = Float64[np.ndarray, "_ 4"]


def evaluate(estimate: Poses, truth: Poses, valid: Mask, distances_m: Sequence[float] = DISTANCES_M) -> dict[str, Any]:
    """Error metrics of the module's table, with `samples` (rows that count) and `duration_s`.

    The duration is from the first such row to the last.

    Raises:
        DataError: stamps differ, or no row is valid.
        NumericsError: a figure is not finite.
    """
    rows = _scored(estimate, truth, valid)
    stamps = rows[1].t_ns
    return {
        "samples": len(stamps),
        "duration_s": float(stamps[-1] - stamps[0]) * 1e-9,
        **absolute(estimate, truth, valid),
        **relative(estimate, truth, valid, distances_m),
    }


def absolute(estimate: Poses, truth: Poses, valid: Mask) -> dict[str, float | None]:
    """Absolute errors of orientation, position and velocity: AOE, APE, velocity RMSE.

    The aligned figures are None if positions (of either) do not span a plane, the velocity figure if a velocity is missing.
    Figures of position and velocity are None for a truth of orientations alone.

    Raises:
        DataError: stamps differ, or no row is valid.
        NumericsError: a figure is not finite.
    """
    estimate, truth = _scored(estimate, truth, valid)
    p_est, p_true, known = estimate.p_wb, truth.p_wb, truth.has_positions
    with np.errstate(over="ignore", invalid="ignore"):  # `_check_finite` checks the figures
        motion = align(p_est, p_true)
        aligned: tuple[float | None, float | None] = (None, None)
        if motion is not None:
            R, shift = motion
            aligned = (
                _rms(_turned_deg(estimate, truth, quaternion.of_matrix(R))),
                _rms(_apart(p_est @ R.T, shift, p_true)),
            )
        v_est, v_true = estimate.v_w, truth.v_w
        figures = {
            "aoe_deg": _rms(_turned_deg(estimate, truth)),
            "aoe_aligned_deg": aligned[0],
            "ape_m": _rms(p_est - p_true) if known else None,
            "ape_aligned_m": aligned[1],
            "velocity_rmse_m_s": None if v_est is None or v_true is None or not known else _rms(v_est - v_true),
        }
    _check_finite(figures)
    return figures


def relative(
    estimate: Poses, truth: Poses, valid: Mask, distances_m: Sequence[float] = DISTANCES_M
) -> dict[str, dict[str, float | None]]:
    """Relative errors `roe_deg` and `rpe_m`, keyed by the distance in metres ("5").

    None if the true path is too short.

    Raises:
        DataError: stamps differ, or no row is valid.
        NumericsError: a figure is not finite.
    """
    estimate, truth = _scored(estimate, truth, valid)
    # With C = R_true R_est^T, R_true,i^T (dp_true - C_i dp_est) is the difference of motions, and C_i C_j^T that of their
    # rotations in another frame: length and angle are the same, for a fraction of the products.
    C = np.empty((len(truth), 4))
    for rows, q, q_true in _units(estimate, truth):
        C[rows] = quaternion.multiply(q_true, quaternion.inverse(q))
    roe: dict[str, float | None] = {}
    rpe: dict[str, float | None] = {}
    for distance_m in distances_m:
        key = f"{distance_m:g}"
        i, j = pairs_by_distance(truth.p_wb, distance_m)
        if not len(i):
            roe[key] = rpe[key] = None
            continue
        apart_m = turned = 0.0
        for first in range(0, len(i), AT_ONCE):
            a, b = i[first : first + AT_ONCE], j[first : first + AT_ONCE]
            with np.errstate(over="ignore", invalid="ignore"):
                moved_est, moved_true = (poses.p_wb[b] - poses.p_wb[a] for poses in (estimate, truth))
                apart_m += float(quaternion.length(quaternion.rotate(C[a], moved_est) - moved_true).sum())
            turned += float(quaternion.angle_between(C[a], C[b]).sum())
        rpe[key], roe[key] = apart_m / len(i), float(np.degrees(turned / len(i)))
    _check_finite({f"rpe_m {k}": v for k, v in rpe.items()} | {f"roe_deg {k}": v for k, v in roe.items()})
    return {"roe_deg": roe, "rpe_m": rpe}


def align(p: Points, p_target: Points) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]] | None:
    """Rotation and shift of the least-squares alignment of points.

    Umeyama 1991, eq. 40-42, scale 1.

    None if the points do not determine the rotation: fewer than two directions in their covariance.

    Raises:
        NumericsError: the covariance of the positions overflows.
    """
    centre, centre_target = p.mean(axis=0), p_target.mean(axis=0)
    covariance = (p_target - centre_target).T @ (p - centre) / len(p)
    if not np.isfinite(covariance).all():
        raise NumericsError("positions overflow when aligned", expected="positions within range", fix="Shorten the log")
    u, size, vt = np.linalg.svd(covariance)
    if np.count_nonzero(size > FLAT) < 2:
        return None
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])  # a rotation, not a reflection
    R = u @ mirror @ vt
    return R, centre_target - R @ centre


def pairs_by_distance(
    p: Points, distance_m: float, tolerance: float = PAIR_TOLERANCE
) -> tuple[Int64[np.ndarray, " m"], Int64[np.ndarray, " m"]]:
    """Pairs (i, j): the later point j at `distance_m` from point i along the path.

    The distance may differ by a tolerance.

    The rule of evo's `--all_pairs`: of equally near points the first. Bisection applies because distance along a path only
    grows (evo searches every pair, minutes for 30 000 poses).
    """
    travelled = np.concatenate([[0.0], np.cumsum(quaternion.length(np.diff(p, axis=0)))])
    pairs, count = np.empty((2, max(len(p) - 1, 0)), np.int64), 0
    for first in range(0, len(p) - 1, AT_ONCE):
        i = np.arange(first, min(first + AT_ONCE, len(p) - 1))
        above = np.searchsorted(travelled, travelled[i] + distance_m, side="left")
        above = np.clip(above, i + 1, len(p) - 1)
        below = np.searchsorted(travelled, travelled[above - 1], side="left")  # first of the points that share that distance
        below = np.clip(below, i + 1, above)
        miss_above = np.abs(travelled[above] - travelled[i] - distance_m)
        miss_below = np.abs(travelled[below] - travelled[i] - distance_m)
        j = np.where(miss_below <= miss_above, below, above)
        near = np.minimum(miss_below, miss_above) <= distance_m * tolerance
        pairs[:, count : count + int(near.sum())] = i[near], j[near]
        count += int(near.sum())
    i, j = pairs[:, :count]
    return i, j


def pose_delay(path: Poses, truth: Poses, windows: Int64[np.ndarray, "m 2"]) -> tuple[float, float] | None:
    """Delay of the true poses (s) and its standard deviation, by windows; None for few of them.

    `path` is the integration of debiased samples on the stamps of `truth`. Where these are late by d, a window from one pose to
    another misses (w_last - w_first) d, with the angular rate w in the world, by first order. Windows of poses that jump do not
    count.
    """
    inner = windows[(windows[:, 0] > 0) & (windows[:, 1] < len(path) - 1)]
    if len(inner) < FEWEST_WINDOWS:
        return None
    first, last = inner.T
    turned = quaternion.multiply(quaternion.inverse(path.q_wb_wxyz[first]), path.q_wb_wxyz[last])
    error = quaternion.log(
        quaternion.multiply(quaternion.multiply(truth.q_wb_wxyz[first], turned), quaternion.inverse(truth.q_wb_wxyz[last]))
    )
    to_truth = quaternion.multiply(truth.q_wb_wxyz[first], quaternion.inverse(path.q_wb_wxyz[first]))
    t_s, rates = seconds(path.t_ns, int(path.t_ns[0])), []
    for row in (first, last):
        step = quaternion.multiply(path.q_wb_wxyz[row + 1], quaternion.inverse(path.q_wb_wxyz[row - 1]))
        rates.append(quaternion.log(step) / (t_s[row + 1] - t_s[row - 1])[:, None])
    miss = quaternion.rotate(to_truth, rates[1] - rates[0])
    size = quaternion.length(error)
    kept = size <= MOST_MISSED * median(size)
    error, miss = error[kept], miss[kept]
    power = max(float((miss**2).sum()), np.finfo(np.float64).tiny)
    delay_s = float((miss * error).sum()) / power
    variance = float(((error - delay_s * miss) ** 2).sum()) / (3 * len(error) - 1)
    return delay_s, float(np.sqrt(variance / power))


def write_tum(poses: Poses, path: Path, overwrite: bool = False) -> None:
    """Write `t x y z qx qy qz qw` lines (TUM RGB-D format).

    Stamps with nine decimals, exact numbers.

    Raises:
        ConfigError: the target exists and `overwrite` is false, or cannot be written.
    """
    columns = np.concatenate([poses.p_wb, poses.q_wb_wxyz[:, [1, 2, 3, 0]]], axis=1).tolist()
    stamps = (f"{'-' * (t < 0)}{abs(t) // 10**9}.{abs(t) % 10**9:09d}" for t in poses.t_ns.tolist())
    text = "".join(f"{stamp} {' '.join(map(repr, row))}\n" for stamp, row in zip(stamps, columns, strict=True))
    with Target(path, overwrite=overwrite) as target:
        target.write(text.encode("ascii"))


def write_trajectory(poses: Poses, folder: Path, log: str, name: str, overwrite: bool = False) -> None:
    """Write FOLDER/LOG_NAME.tum, as `write_tum`, and the folder."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    safe = re.sub(r"[^\w.+-]", "_", f"{log}_{name}").lstrip(".")  # names in a log are its writer's, and must not lead elsewhere
    write_tum(poses, folder / f"{safe}.tum", overwrite)


def _scored(estimate: Poses, truth: Poses, valid: Mask) -> tuple[Poses, Poses]:
    """Both trajectories at the rows that count."""
    if not np.array_equal(estimate.t_ns, truth.t_ns) or len(valid) != len(truth):
        raise DataError(
            f"an estimate of {len(estimate)}, a truth of {len(truth)} poses and a mask of {len(valid)} do not match",
            expected="the same stamps (Poses.at)",
        )
    if not valid.any():
        raise DataError("no stamp of the estimate has truth", expected="an overlap")
    return (estimate, truth) if valid.all() else (estimate.rows(valid), truth.rows(valid))


def _units(estimate: Poses, truth: Poses) -> Iterator[tuple[slice, Quaternions, Quaternions]]:
    """Rows of a block and their unit orientations; the six decimals of a file would count as an angle."""
    for first in range(0, len(truth), AT_ONCE):
        rows = slice(first, first + AT_ONCE)
        yield rows, quaternion.unit(estimate.q_wb_wxyz[rows]), quaternion.unit(truth.q_wb_wxyz[rows])


def _turned_deg(estimate: Poses, truth: Poses, turn: Float64[np.ndarray, "1 4"] | None = None) -> Float64[np.ndarray, " n"]:
    """Angles between the orientations of two trajectories, of which the first may be turned."""
    out = np.empty(len(truth))
    for rows, q, q_true in _units(estimate, truth):
        out[rows] = np.degrees(quaternion.angle_between(q if turn is None else quaternion.multiply(turn, q), q_true))
    return out


def _apart(p: Points, shift: Float64[np.ndarray, "3"], p_true: Points) -> Points:
    """Distances of points, which are overwritten, after a shift."""
    p += shift
    p -= p_true
    return p


def _rms(errors: Float64[np.ndarray, " n *k"]) -> float:
    """Root mean square over rows of the length of each row."""
    return float(np.sqrt((errors**2).reshape(len(errors), -1).sum(axis=1).mean()))


def _check_finite(figures: dict[str, float | None]) -> None:
    for name, value in figures.items():
        if value is not None and not np.isfinite(value):
            raise NumericsError(f"{name} is {value}", expected="a finite error", fix="The estimate diverged: check its inputs")
