"""Models on other units of their sensor's grade and on other grades: which do harm, and what verdict they get.

    python tests/bench/units.py [--method linear] [--set model.remainder=false] [--units 2] [--first 0]

Made-up sensors of several grades (`tests/support/switchings_on.py`), some units each. A model is trained on six logs of three
switchings-on of one unit. It is applied to logs of other switchings-on: of its own unit, of the other units, and of the other
grades. A model does harm where its AOE is more than half larger, and more than 0.3 degrees larger, than the smaller of that of
the raw samples and that of `static`. Only the samples are known to the verdict. The last lines name each
model that does harm and is said to fit: AOE of `static` and of the model, with its tilt and its heading, and the reason.
Gravity shows no heading.
"""

from __future__ import annotations

import argparse
import itertools
import logging
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1]))
from support.switchings_on import Switchings, log

import imutool
from imutool.config import load
from imutool.evaluation import evaluate
from imutool.inertial.strapdown import along_truth
from imutool.mcap_io.write import write
from imutool.training.run import train
from imutool.training.settings import settings_of

SIZES = ("scale", "misalignment_rad", "turn_on_rad_s", "turn_on_m_s2", "noise_rad_s_rthz")
GRADES = {  # orders of magnitude from data sheets
    "uncalibrated": (0.03, 0.02, 1e-2, 0.2, 2e-4),
    "consumer": (0.01, 0.005, 5e-3, 0.1, 1.2e-4),
    "industrial": (3e-3, 2e-3, 1e-3, 0.03, 7e-5),
    "tactical": (4e-4, 3e-4, 1e-4, 0.01, 2e-5),
}
TRAINING = (0, 0, 1, 1, 2, 2)  # switchings-on of the training logs
OWN, GRADE, OTHER = 6, 2, 1  # logs of a unit that its model is applied to, another one of the grade, one of another grade
HARM, HARM_DEG = 1.5, 0.3


class Unit(NamedTuple):
    """Unit of a grade: its model, and logs of other switchings-on."""

    grade: str
    model: Path
    tests: list[Path]


def main() -> None:
    """Print a row for each relation between model and log."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", default="linear")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--units", type=int, default=2)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    with tempfile.TemporaryDirectory() as folder:
        units = [
            made(Path(folder) / f"{grade}_{number}", grade, options.first + number, options.method, options.set)
            for grade, number in itertools.product(GRADES, range(options.units))
        ]
        rows = [
            (relation, *judged(model, path))
            for model, unit in itertools.product(units, units)
            for relation, path in applied(model, unit)
        ]
    print("| log of | does | logs | fits | doubtful | unfit |\n|---|---|---|---|---|---|")
    for relation, harm in itertools.product(("its own unit", "another unit of the grade", "another grade"), (False, True)):
        found = Counter(verdict for row_relation, row_harm, verdict, _ in rows if (row_relation, row_harm) == (relation, harm))
        counts = " | ".join(str(found[verdict]) for verdict in ("fits", "doubtful", "unfit"))
        print(f"| {relation} | {'harm' if harm else 'no harm'} | {found.total()} | {counts} |")
    print(*(missed for _, harm, verdict, missed in rows if harm and verdict == "fits"), sep="\n")


def made(folder: Path, grade: str, number: int, method: str, words: list[str]) -> Unit:
    """Unit of a grade with its logs, and a model trained on six of them."""
    folder.mkdir()
    seed = 100 * (10 * list(GRADES).index(grade) + number)
    kind = Switchings(sensor_seed=seed, rest_s=8.0, duration_s=60.0, **dict(zip(SIZES, GRADES[grade], strict=True)))
    training = [save(folder, seed + k, seed + switching, kind) for k, switching in enumerate(TRAINING)]
    tests = [save(folder, seed + 50 + k, seed + 50 + k, kind) for k in range(OWN)]
    model = folder / "model.safetensors"
    train(training, model, method=method, settings=load(settings_of(method), None, words))
    print(f"{grade} {number}", file=sys.stderr, flush=True)
    return Unit(grade, model, tests)


def save(folder: Path, seed: int, switching: int, kind: Switchings) -> Path:
    """Log on disk."""
    path = folder / f"{seed}.mcap"
    write(log(seed, switching, kind), path)
    return path


def applied(model: Unit, unit: Unit) -> list[tuple[str, Path]]:
    """Logs of a unit to which the model of another, or its own, is applied."""
    if model is unit:
        return [("its own unit", path) for path in unit.tests]
    if model.grade == unit.grade:
        return [("another unit of the grade", path) for path in unit.tests[:GRADE]]
    return [("another grade", path) for path in unit.tests[:OTHER]]


def judged(model: Unit, path: Path) -> tuple[bool, str, str]:
    """Whether a model does harm to a log, its verdict, and both in words."""
    raw, static, corrected = evaluate(path, models=["static", str(model.model)])
    minimum = min(raw["aoe_deg"], static["aoe_deg"])
    harm = corrected["aoe_deg"] > max(HARM * minimum, HARM_DEG + minimum)
    of_static, of_model = (in_words(path, each) for each in ("static", str(model.model)))
    words = f"{model.model.parent.name} on {path.parent.name}: {of_static}, {of_model}; {corrected['fit']['reasons'][0]}"
    return harm, corrected["fit"]["verdict"], words


def in_words(path: Path, model: str) -> str:
    """AOE of a log's integration with a model, and its tilt and its heading."""
    debiased = imutool.debias(imutool.read(path), model, force=True)
    estimate, truth, valid = along_truth(debiased.imu, imutool.read(path).truth, str(path))
    error = (
        Rotation.from_quat(estimate.q_wb_wxyz, scalar_first=True) * Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True).inv()
    )
    e = np.degrees(error.as_rotvec())[valid]
    aoe, tilt, heading = (float(np.sqrt((e[:, columns] ** 2).sum(axis=1).mean())) for columns in ([0, 1, 2], [0, 1], [2]))
    return f"{Path(model).stem} {aoe:.2f} ({tilt:.2f}, {heading:.2f})"


if __name__ == "__main__":
    main()
