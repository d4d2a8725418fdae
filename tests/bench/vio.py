"""What debiasing is worth to a visual-inertial estimate: `python tests/bench/vio.py LOG... --model MODEL... [--blackout S]`.

Real IMU, simulated tracks (`imutool.vio`), raw and with each model, with bias states and without. Each figure is the mean over
`--seeds` draws of landmarks and pixel noise, with its spread: one draw says little, for the noise of the tracks alone moves the
AOE by tenths of a degree. Next to it the VIO column of the paper's table V (OpenVINS on the real images), where it has one.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import msgspec
import numpy as np

from imutool.config import load
from imutool.vio.run import VioSettings, vio

# AOE in degrees / APE in m with VIO: raw, linear, M.B. (conv), proposed (neural_ode); the raw IMU of TUM-VI failed.
PUBLISHED = {
    "MH_02_easy": "1.73/0.30  0.86/0.19  1.41/0.21  1.01/0.22",
    "MH_04_difficult": "2.07/0.43  0.95/0.82  1.52/1.16  0.65/0.31",
    "V1_01_easy": "1.83/0.12  1.83/0.11  1.20/0.10  1.44/0.11",
    "V1_03_difficult": "2.82/0.11  1.16/0.11  1.67/0.16  0.85/0.12",
    "V2_02_medium": "1.87/0.15  2.26/0.16  2.16/0.16  2.60/0.16",
    "room2": "failed  10.04/0.39  9.80/0.32  5.08/0.35",
    "room4": "failed  2.56/0.22  9.58/0.23  2.52/0.11",
    "room6": "failed  1.55/0.10  8.92/0.15  3.04/0.05",
}
FIGURES = ("AOE °", "APE m", "ROE ° 5 m", "RPE m 5 m", "ROE ° 20 m", "RPE m 20 m")


def main() -> None:
    """One line a log, model and choice of bias states."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG")
    parser.add_argument("--model", action="append", default=[])
    parser.add_argument("--init", default="auto")
    parser.add_argument("--truth")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--blackout", type=float, default=0.0, metavar="S")
    parser.add_argument("--set", action="append", default=[], metavar="key=value")
    given = parser.parse_args()
    settings = load(VioSettings, None, [*given.set, f"blackout_s={given.blackout}"])
    print(f"{'log':16} {'model':22} {'bias':4} {'fail':>4}" + "".join(f"{name:>15}" for name in FIGURES) + f"{'CPU s':>7}")
    for log in given.logs:
        found: dict[tuple[str, bool], list[dict[str, Any]]] = {}
        name = log.stem
        for seed in range(given.seeds):
            drawn = msgspec.structs.replace(settings, seed=seed)
            for one in vio(log, models=given.model, init=given.init, truth=given.truth, settings=drawn):
                found.setdefault((one["model"], one["bias_states"]), []).append(one)
                name = one["log"]
        for (model, states), results in found.items():
            print(line(name, model, states, results), flush=True)
        if name in PUBLISHED and not given.blackout:
            print(f"{name:16} published, AOE / APE of raw, linear, conv, neural_ode: {PUBLISHED[name]}")


def line(log: str, model: str, states: bool, results: list[dict[str, Any]]) -> str:
    """Means and spreads over the seeds that did not fail, and how many did."""
    good = [one for one in results if not one["failed"]]
    columns: list[Iterable[float | None]] = [
        [one["aoe_deg"] for one in good],
        [one["ape_m"] for one in good],
        *([one[kind][metres] for one in good] for metres in ("5", "20") for kind in ("roe_deg", "rpe_m")),
    ]
    cpu_s = float(np.mean([one["cpu_s"] for one in results]))
    cells = "".join(f"{spread(column):>15}" for column in columns)
    return f"{log:16} {model:22} {'on' if states else 'off':4} {len(results) - len(good):>4}{cells}{cpu_s:7.1f}"


def spread(values: Iterable[float | None]) -> str:
    """Mean and standard deviation, of one value that alone; a dash where there is none."""
    known = np.array([value for value in values if value is not None], dtype=np.float64)
    if not len(known):
        return "–"
    return f"{known.mean():.3f}" + (f" ± {known.std(ddof=1):.3f}" if len(known) > 1 else "")


if __name__ == "__main__":
    main()
