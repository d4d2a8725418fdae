"""How late the truth is behind the gyro, under two rules of integration: `python tests/bench/truth_delay.py LOG...`.

Held: each sample holds until the next (Euler). Mean: a step sees the mean of its two ends (`imutool.inertial.windows`). A
truth that is late by tau adds omega_end tau - dR^T omega_start tau to the residual of a window; tau is fitted robustly over
windows of one second, each log's bias solved for first. Prints tau in ms and the median residual in degrees with tau taken out.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from torch import Tensor

from imutool.bias.networks.linear import Network
from imutool.geometry import so3
from imutool.inertial.windows import rotation_residual, whole_turn
from imutool.mcap_io.read import read
from imutool.training.calibration import closed_form
from imutool.training.training_windows import Pool

WINDOW_S = 1.0


def main() -> None:
    """One line a log."""
    print(f"{'log':20}{'held: ms':>10}{'deg':>8}{'mean: ms':>10}{'deg':>8}")
    for path in sys.argv[1:]:
        pool = Pool.of([read(Path(path))])
        rest = torch.zeros(1, 6, dtype=torch.float64)
        rest[:, :3] = closed_form.solve(Network().double(), "gyro", pool, rest, (1.0, 4.0), matrix=False, nuisances=False).rest
        n = pool.samples(WINDOW_S)
        first = pool.starts(n, "all", hop=n // 2)
        windows = pool.windows(first, n, rest.expand(len(first), 6))
        gyro = windows.segment.gyro - rest[:, None, :3]
        dR = windows.R_start.mT @ windows.R_end
        held = so3.log(whole_turn(gyro[:, :-1] * windows.dt[..., None]).mT @ dR)
        mean, _ = rotation_residual(gyro, windows.dt, dR)
        turn = gyro[:, -1] - (dR.mT @ gyro[:, 0, :, None])[..., 0]
        figures = [figure for e in (held, mean) for figure in delay(e.flatten(), turn.flatten())]
        print(f"{pool.names[0]:20}{figures[0]:10.2f}{figures[1]:8.4f}{figures[2]:10.2f}{figures[3]:8.4f}")


def delay(e: Tensor, turn: Tensor) -> tuple[float, float]:
    """Tau in ms by least absolute deviations (reweighted), and the median residual in degrees without it."""
    tau = torch.zeros((), dtype=e.dtype)
    for _ in range(20):
        weight = 1 / (e - tau * turn).abs().clamp_min(1e-6)
        tau = (weight * turn * e).sum() / (weight * turn * turn).sum()
    return float(1e3 * tau), float(torch.rad2deg((e - tau * turn).abs().median()))


if __name__ == "__main__":
    main()
