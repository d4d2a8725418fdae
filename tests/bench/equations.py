"""Physics without a name, against pysindy on the same cases: `python tests/bench/equations.py DIR [--seed S] [--each N]`.

An arm has one term that no catalogue names, in N draws of each of six forms. `imutool diagnose` and pysindy's STLSQ (de Silva
et al., PySINDy, JOSS 2020) answer from the same efforts, angles, speeds and accelerations: recorded less simulated at the
recorded motion. pysindy's library holds the true form (powers and products to the third degree, |v|, v|v|, sines, and the
scaled forms on a grid that holds the true scale); its threshold is the one that predicts a held-out third best. An answer is
right if it has the true form and no other term. Needs pysindy, which is no dependency of the project. PySR runs in
Julia, which it downloads: it is not compared.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float64

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.robot_cases.cases import UNNAMED, conceal_robot

from imutool.diagnosis.diagnose import diagnose
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.diagnosis.signals.aligned_signal import aligned
from imutool.diagnosis.signals.pairing import paired

COLUMN = "/joint_states.effort[0]"
THRESHOLDS = np.geomspace(1e-3, 1.0, 16)  # of the term's coefficient
SCALES = (0.5, 1.0, 2.0)
SAME = {"sin(3 position[0])": "gear_ripple"}  # under its name
NAMES = {"q0": "position[0]", "q1": "position[1]", "dq0": "velocity[0]", "dq1": "velocity[1]", "ddq0": "acceleration[0]"}


def by_imutool(folder: Path, form: str) -> bool:
    """Whether the one finding has the form."""
    found = diagnose([folder / "real.mcap"], folder / "sim.mcap").findings
    names = {form, SAME.get(form, form)}
    return [finding.signal for finding in found] == [COLUMN] and bool({found[0].variable, found[0].effect} & names)


def library(state: dict[str, Float64[np.ndarray, " n"]]) -> dict[str, Float64[np.ndarray, " n"]]:
    """Columns by their form."""
    out = {"1": np.ones(len(next(iter(state.values()))))}
    for name, v in state.items():
        out |= {name: v, f"{name}^2": v**2, f"{name}^3": v**3, f"|{name}|": np.abs(v), f"{name} |{name}|": v * np.abs(v)}
        out |= {f"1/(1 + ({name}/s)^2) s={s}": 1.0 / (1.0 + (v / s) ** 2) for s in SCALES}
        if name.startswith("position"):
            out |= {f"{f.__name__}({k} {name})": f(k * v) for f in (np.sin, np.cos) for k in range(1, 6)}
    names = list(state)
    out |= {f"{a} {b}": state[a] * state[b] for i, a in enumerate(names) for b in names[i + 1 :]}
    return out


def by_pysindy(folder: Path, form: str) -> tuple[bool, list[str]]:
    """Whether STLSQ keeps the form alone, and what it keeps."""
    import pysindy

    settings = DiagnoseSettings()
    (pair,) = [pair for pair in paired(folder / "real.mcap", folder / "sim.mcap").pairs if pair.kind == "efforts"]
    signal = aligned(pair, {}, settings)
    target = (signal.real - signal.sampled.x)[:, :1]
    columns = library({NAMES[name]: values for name, values in signal.sampled.state.items() if name in NAMES})
    theta = np.stack(list(columns.values()), axis=1)
    scale = theta.std(axis=0) + (theta.std(axis=0) == 0.0)
    train = np.arange(len(theta)) % 600 < 400  # blocks, as the motion is correlated
    best: tuple[float, list[str]] = (np.inf, [])
    for threshold in THRESHOLDS * target.std():
        optimizer = pysindy.STLSQ(threshold=threshold, alpha=1e-6)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            optimizer.fit(theta[train] / scale, target[train])
        coefficients = optimizer.coef_.ravel()
        error = float(np.mean((theta[~train] / scale @ coefficients - target[~train, 0]) ** 2))
        kept = [name for name, c in zip(columns, coefficients, strict=True) if c != 0.0 and name != "1"]
        if error < best[0]:
            best = error, kept
    return [name.partition(" s=")[0] for name in best[1]] == [form], best[1]


def main() -> None:
    """A line for each case, and the counts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--each", type=int, default=2)
    options = parser.parse_args()
    counts = np.zeros(2, int)
    for k, form in enumerate([*UNNAMED] * options.each):
        folder = options.folder / f"{options.seed + k:04d}"
        if not (folder / "truth.json").exists():
            conceal_robot(folder, options.seed + k, "arm", "unnamed", form)
        (theirs, kept), ours = by_pysindy(folder, form), by_imutool(folder, form)
        counts += [ours, theirs]
        print(
            f"{form}: imutool {'right' if ours else 'wrong'}, pysindy {'right' if theirs else 'wrong'} {kept[:6]}", flush=True
        )
    print(f"of {options.each * len(UNNAMED)}: imutool {counts[0]}, pysindy {counts[1]}")


if __name__ == "__main__":
    main()
