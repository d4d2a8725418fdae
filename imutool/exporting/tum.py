"""Trajectories in the format of TUM RGB-D, which evo and other tools read."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from imutool.mcap_io.storage.target import Target, writing
from imutool.recording import Poses


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


def write_trajectory(folder: Path, log: str, overwrite: bool, name: str, parts: Iterable[Poses]) -> None:
    """Write FOLDER/LOG_NAME.tum, as `write_tum`, and the folder."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    safe = re.sub(r"[^\w.+-]", "_", f"{log}_{name}").lstrip(".")  # names in a log are its writer's, and must not lead elsewhere
    write_tum(parts, folder / f"{safe}.tum", overwrite)
