"""Blind cases of robots: how many effects are named, how many falsely, and how far their parameters are off.

    python tests/bench/robot_cases.py /tmp/robots --count 40

Each case is drawn by `tests/support/robot_cases`, diagnosed as by `imutool diagnose real.mcap --sim sim.mcap`, and
compared with its truth. An unnamed case counts as right where the form of the equation is right.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.robot_cases.cases import EFFECTS, ROBOTS, UNNAMED, conceal_robot

from imutool.diagnosis.diagnose import diagnose

DEVIATIONS = 3.0


def plan(count: int, seed: int, only: str = "") -> list[tuple[int, str, str, str]]:
    """Cases in turn: each effect alone, then pairs, unnamed ones and none; `count` of those with `only` in their words."""
    turn = [(robot, "single", name) for robot in ROBOTS for name in EFFECTS[robot]]
    turn += [("arm", "unnamed", form) for form in UNNAMED] + [
        (robot, kind, "") for kind in ("pair", "none") for robot in ROBOTS
    ]
    wanted = [k for k, words in enumerate(turn) if only in " ".join(words)]
    rounds = range(-(-count // len(wanted))) if wanted else ()
    return [(seed + r * len(turn) + k, *turn[k]) for r in rounds for k in wanted][:count]


def _is_ripple(finding: Any, effect: dict[str, Any]) -> bool:
    """Whether a form without a name is found as the gear ripple that it is: sin(3 q) has three waves a turn."""
    per_turn = finding.parameters.get("per_turn")
    if finding.effect != "gear_ripple" or finding.signal != effect["column"] or per_turn is None:
        return False
    return "sin(3 position[0])" in effect["parameters"] and abs(per_turn.value - 3.0) <= DEVIATIONS * per_turn.std


def compared(folder: Path) -> dict[str, Any]:
    """What a diagnosis of a case makes of its truth."""
    truth = json.loads((folder / "truth.json").read_text())
    began = time.perf_counter()
    d = diagnose([folder / "real.mcap"], folder / "sim.mcap")
    rest, named, values = list(d.findings), 0, []
    for effect in truth["effects"]:
        match = next((f for f in rest if (f.effect, f.signal) == (effect["effect"], effect["column"])), None)
        if match is None and effect["effect"] == "unknown":
            match = next((f for f in rest if _is_ripple(f, effect)), None)
            named += match is not None
        if match is None:
            continue
        rest.remove(match)
        if match.effect == "gear_ripple" and effect["effect"] == "unknown":
            continue
        if effect["effect"] == "unknown":
            right = match.variable in effect["parameters"]
            named += right
            if not right:
                rest.append(match)
            continue
        named += 1
        for name, value in effect["parameters"].items():
            estimate = match.parameters.get(name)
            if estimate is not None:
                values.append((name, value, estimate.value, estimate.std))
    return {
        "case": f"{truth['robot']} {truth['kind']} {[(e['effect'], e['column']) for e in truth['effects']]}",
        "kind": truth["kind"],
        "effects": len(truth["effects"]),
        "named": named,
        "false": [(f.effect, f.signal, f.variable, round(f.share, 5)) for f in rest],
        "values": values,
        "inside": sum(abs(estimate - value) <= DEVIATIONS * std for _, value, estimate, std in values),
        "seconds": round(time.perf_counter() - began, 1),
        "remarks": list(d.remarks),
    }


def main() -> None:
    """Draw, diagnose, count."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="part of robot, kind or effect")
    options = parser.parse_args()
    total: Counter[str] = Counter()
    for seed, robot, kind, effect in plan(options.count, options.seed, options.only):
        folder = options.folder / f"{seed:04d}_{robot}_{kind}"
        if not (folder / "truth.json").exists():
            conceal_robot(folder, seed, robot, kind, effect)
        result = compared(folder)
        print(json.dumps(result), flush=True)
        total.update(cases=1, effects=result["effects"], named=result["named"], false=len(result["false"]))
        total.update(values=len(result["values"]), inside=result["inside"], clean=not result["false"])
    print(json.dumps(total))


if __name__ == "__main__":
    main()
