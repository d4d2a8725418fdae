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
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from imutool.array_types import Bool
from imutool.errors import DataError, NumericsError
from imutool.inertial.scoring.absolute_errors import AbsoluteErrors
from imutool.inertial.scoring.path_blocks import AT_ONCE, PathBlock, PathBlocks
from imutool.inertial.scoring.relative_errors import RelativeErrors
from imutool.mcap_io.storage.target import Target, writing
from imutool.recording import Poses

DISTANCES_M = (5.0, 10.0, 15.0, 20.0)

Mask = Bool[np.ndarray, " n"]
Figures = dict[str, float | None]


def evaluate(estimate: Poses, truth: Poses, valid: Mask, distances_m: Sequence[float] = DISTANCES_M) -> dict[str, Any]:
    """Error metrics of the module's table, with `samples` (rows that count) and `duration_s`.

    The duration is from the first such row to the last.

    Raises:
        DataError: stamps differ, or no row is valid.
        NumericsError: a figure is not finite.
    """
    return evaluate_blocks(_blocks_of(estimate, truth, valid), distances_m)


def evaluate_blocks(blocks: PathBlocks, distances_m: Sequence[float] = DISTANCES_M) -> dict[str, Any]:
    """Error metrics as `evaluate`, of a path in blocks, which comes twice for the alignment."""
    sums, pairs = AbsoluteErrors(), RelativeErrors(distances_m)
    for estimate, truth in map(PathBlock.scored, blocks()):
        sums.add(estimate, truth)
        pairs.add(estimate, truth)
    figures = _finite(sums.figures(blocks))  # a path that diverged has no finite APE, whatever its relative errors
    duration_s = float(sums.last_ns - sums.first_ns) * 1e-9
    return {"samples": sums.count, "duration_s": duration_s, **figures, **pairs.figures()}


def absolute(estimate: Poses, truth: Poses, valid: Mask) -> Figures:
    """Absolute errors of orientation, position and velocity: AOE, APE, velocity RMSE.

    The aligned figures are None if positions (of either) do not span a plane, the velocity figure if a velocity is missing.
    Figures of position and velocity are None for a truth of orientations alone.

    Raises:
        DataError: stamps differ, or no row is valid.
        NumericsError: a figure is not finite.
    """
    return absolute_blocks(_blocks_of(estimate, truth, valid))


def absolute_blocks(blocks: PathBlocks) -> Figures:
    """Absolute errors as `absolute`, of a path in blocks."""
    sums = AbsoluteErrors()
    for estimate, truth in map(PathBlock.scored, blocks()):
        sums.add(estimate, truth)
    return _finite(sums.figures(blocks))


def write_tum(parts: Iterable[Poses], path: Path, overwrite: bool = False) -> None:
    """Write `t x y z qx qy qz qw` lines (TUM RGB-D format) of poses in blocks.

    Stamps with nine decimals, exact numbers.

    Raises:
        ConfigError: the target exists and `overwrite` is false, or cannot be written.
    """
    with Target(path, overwrite=overwrite) as target:
        for poses in parts:
            columns = np.concatenate([poses.p_wb, poses.q_wb_wxyz[:, [1, 2, 3, 0]]], axis=1).tolist()
            stamps = (f"{'-' * (t < 0)}{abs(t) // 10**9}.{abs(t) % 10**9:09d}" for t in poses.t_ns.tolist())
            text = "".join(f"{stamp} {' '.join(map(repr, row))}\n" for stamp, row in zip(stamps, columns, strict=True))
            target.write(text.encode("ascii"))


def write_trajectory(parts: Iterable[Poses], folder: Path, log: str, name: str, overwrite: bool) -> None:
    """Write FOLDER/LOG_NAME.tum, as `write_tum`, and the folder."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    safe = re.sub(r"[^\w.+-]", "_", f"{log}_{name}").lstrip(".")  # names in a log are its writer's, and must not lead elsewhere
    write_tum(parts, folder / f"{safe}.tum", overwrite)


def _blocks_of(estimate: Poses, truth: Poses, valid: Mask) -> PathBlocks:
    """A path in memory in blocks, of the rows that count."""

    def blocks() -> Iterator[PathBlock]:
        path, true = PathBlock(estimate, truth, valid).scored()
        if not len(true):
            raise DataError("no stamp of the estimate has truth", expected="an overlap")
        for first in range(0, len(true), AT_ONCE):
            rows = slice(first, first + AT_ONCE)
            part = true.rows(rows)
            yield PathBlock(path.rows(rows), part, np.ones(len(part), bool))

    return blocks


def _finite(figures: Figures) -> Figures:
    """The figures; NumericsError of one that is not finite."""
    for name, value in figures.items():
        if value is not None and not np.isfinite(value):
            raise NumericsError(f"{name} is {value}", expected="a finite error", fix="The estimate diverged: check its inputs")
    return figures
