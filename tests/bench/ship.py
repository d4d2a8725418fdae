"""Puts the models that ship into a folder, each with its card: python tests/bench/ship.py TABLES models/

TABLES is what `python examples/reproduce_tables.py DATA -o TABLES` left. Of the seeds of a method the one with the smallest
held-out error of the gyro ships: the test sequences have no say.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

from imutool.bias.model_file import header_of

PREFIX = {
    "adis16448": "euroc-adis16448",
    "bmi160": "tum_vi-bmi160",
    "fetch": "fetch",
    "fetch, axes corrected": "fetch_axes_corrected",
}
METHODS = ("linear", "conv", "neural_ode", "hybrid")
MAX_BYTES = 2_000_000
COMMAND = "imutool train {logs} -o {name}.safetensors --method {method} --seed {seed}"
LIMITS = (
    "This is the calibration of one unit: another sensor of the same type has another scale, misalignment and turn-on bias. It "
    "was trained and tested indoors, on runs of one to three minutes, at laboratory temperatures."
)


def main() -> None:
    """One line a model."""
    tables, target = map(Path, sys.argv[1:3])
    for data_set in ("euroc", "tumvi", "fetch"):
        for method in METHODS:
            found = sorted(tables.glob(f"{data_set}-{method}-[0-9].safetensors"))
            if not found:
                continue
            best = min(found, key=lambda path: float(header_of(path)["held_out"]["gyro"]["error"]))
            name = f"{PREFIX[header_of(best)['sensor']]}-{method}"
            if best.stat().st_size > MAX_BYTES:
                raise SystemExit(f"{best} has {best.stat().st_size} bytes, more than {MAX_BYTES}")
            shutil.copyfile(best, target / f"{name}.safetensors")
            rows = [row for path in found for row in json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))]
            (target / f"{name}.md").write_text(card(name, header_of(best), rows, len(found)), encoding="utf-8")
            print(f"{name}: seed {header_of(best)['training']['seed']} of {len(found)}, {best.stat().st_size} bytes")


def card(name: str, about: dict[str, Any], rows: list[dict[str, Any]], seeds: int) -> str:
    """The card: data, split, settings, command, figures, limits."""
    logs, seed = [log["name"] for log in about["logs"]], about["training"]["seed"]
    own = [row for row in rows if row["method"] == about["method"]]
    files = " ".join(f"{log}.mcap" for log in logs)
    whole = "" if about["training"].get("compare", True) else " --set compare=false"
    command = COMMAND.format(logs=files, name=name, method=about["method"], seed=seed) + whole
    lines = [
        f"# {name}",
        "",
        f"Method `{about['method']}`, sensor {about['sensor']}, data set {about['dataset']}, {about['rate_hz']:.1f} Hz.",
        "",
        f"- Trained on {', '.join(logs)}: the first 80 % of each log. The last 20 % chose between the end of the descent "
        f"and its closed-form start, and one of {seeds} seed(s).",
        f"- Settings: the defaults of imutool {about['imutool']}{whole and ' but `compare`'}, torch {about['torch']}, "
        f"seed {seed}.",
        f"- Command: `{command}`",
        f"- Held out: {about['held_out']['gyro']['error'] * 180 / np.pi:.3f}° (gyro, windows of up to 20 s), "
        f"{about['held_out']['accel']['error']:.3f} m/s (accelerometer, 5 s), with each log's constant solved for.",
    ]
    if physics := about.get("physics"):
        found = "; ".join(f"{sensor}: {', '.join(one['effects']) or 'none'}" for sensor, one in physics.items())
        lines.append(f"- Effects found: {found}. Their fit uses the whole logs; leaving logs out in turn chose them.")
    lines += ["", "| test sequence | start from truth: AOE ° / APE m | auto: AOE ° | smooth: AOE ° |", "|---|---|---|---|"]
    for log in dict.fromkeys(row["log"] for row in own):
        this = {row["start"]: row for row in own if row["log"] == log and row["seed"] == seed}
        truth = this["truth"]
        others = f"{this['auto']['aoe_deg']:.2f} | {this['smooth']['aoe_deg']:.2f}"
        lines.append(f"| {log} | {truth['aoe_deg']:.2f} / {truth['ape_m']:.0f} | {others} |")
    return "\n".join([*lines, "", LIMITS, ""])


if __name__ == "__main__":
    main()
