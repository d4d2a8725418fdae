"""How well `imutool diagnose` does on sealed cases: `python tests/bench/diagnose.py --trajectories LOG... --out DIR`.

Cases (--cases 200) are dealt from a deck that holds every effect of the catalogue at three sizes, pairs, forms without a name,
driven ones and nothing at all, in proportion whatever their number; motions take turns, and one that does not show what was
asked for passes it on to the next. Each case is concealed, diagnosed by the command itself, opened and scored: one JSON line
a case in DIR/cases.jsonl, one Markdown table at the end (`--table` prints that of the lines there are).

--resume goes on where it stopped; --again diagnoses the cases that are there anew, for whoever works on the estimator, and its
lines say so. --no-sim gives diagnose the recording alone, against its own poses; sizes are drawn for a simulation, so the table
then parts the cases that poses with their noise show to an optimal test, as clearly as a simulation has to, from the others.
--mujoco takes cases of the second generator. --only null deals cases of that kind alone, --only uncalibrated such as are not in
the deck, of five errors of calibration each. Do not choose settings of the estimator by cases on trajectories that are kept
for testing.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import shutil
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from imutool.blind_cases import OPENED, conceal, open_case
from imutool.blind_cases.catalogue import CATALOGUE, FORMS
from imutool.blind_cases.envelope import to_truth
from imutool.blind_cases.random_case import SIZES
from imutool.errors import DataError, ImutoolError

PAIRS, DRIVEN, NOTHING = 36, 15, 20  # in the deck, next to one of each effect and form at each size
NAVIGATION = {"earth_rotation"}  # shown to no other grade
FOUND = "found"


class Task(NamedTuple):
    """A case to be made."""

    kind: str
    size: str
    effects: tuple[str, ...]


def deck() -> list[Task]:
    """One of everything."""
    tasks = [Task("single", size, (name,)) for name, size in product(CATALOGUE, SIZES)]
    tasks += [Task("unknown", size, (name,)) for name, size in product(FORMS, SIZES)]
    tasks += [Task("pair", SIZES[k % 3], ()) for k in range(PAIRS)]
    tasks += [Task("driven", SIZES[k % 3], ()) for k in range(DRIVEN)]
    tasks += [Task("null", "middle", ()) for _ in range(NOTHING)]
    return tasks


MANY = [Task("uncalibrated", size, ()) for size in SIZES[:2]]  # dealt alone


def dealt(cases: int, seed: int, only: str = "") -> list[Task]:
    """So many of the deck (again and again), shuffled so that any first part has the kinds in proportion."""
    rng = np.random.default_rng(seed)
    out: list[Task] = []
    while len(out) < cases:
        placed = []
        tasks = MANY if only == MANY[0].kind else [task for task in deck() if only in ("", task.kind)]
        for kind in sorted({task.kind for task in tasks}):
            mine = [task for task in tasks if task.kind == kind]
            order = rng.permutation(len(mine))
            placed += [((k + rng.uniform()) / len(mine), mine[which]) for k, which in enumerate(order)]
        out += [task for _, task in sorted(placed, key=lambda pair: pair[0])]
    return out[:cases]


def make(task: Task, trajectories: Sequence[Path], folder: Path, seed: int, turn: int) -> Path | None:
    """The trajectory on which the case was concealed, the first after `turn` that shows it; None where none does."""
    for k in range(len(trajectories)):
        trajectory = trajectories[(turn + k) % len(trajectories)]
        noise = "navigation" if NAVIGATION & set(task.effects) else "any"
        try:
            conceal(trajectory, folder, seed=seed, kind=task.kind, size=task.size, noise=noise, effects=task.effects)
        except DataError:
            continue
        return trajectory
    return None


def diagnose(folder: Path, with_sim: bool) -> tuple[Path, float, str]:
    """The findings of the command, its seconds, and what it said if it failed."""
    import typer

    from imutool.cli import load

    out = folder / (FOUND if with_sim else f"{FOUND}_alone")
    line = ["diagnose", str(folder / "real.mcap"), "-o", str(out)]
    line += ["--sim", str(folder / "sim.mcap")] if with_sim else []
    said, began = io.StringIO(), time.perf_counter()
    command = typer.main.get_command(load())
    failed = ""
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            code = command.main(args=line, standalone_mode=False)
            failed = f"exit {code}: {said.getvalue()[-300:]}" if code else ""
        except SystemExit as stop:
            failed = f"exit {stop.code}: {said.getvalue()[-300:]}" if stop.code else ""
        except Exception as error:  # noqa: BLE001  # a bug of the estimator costs it this case, not the benchmark
            failed = f"bug: {error!r}"
    return out / "findings.json", time.perf_counter() - began, failed


def shown(line: dict[str, Any], task: Task, trajectories: Sequence[Path]) -> bool | None:
    """Whether poses alone show an opened case; unknown without its trajectory."""
    from pose_detectability import detectable_from_poses

    truth = to_truth(line["truth"], Path("findings.json"))
    made_of = [path for path in trajectories if path.stem == truth.trajectory]
    return detectable_from_poses(made_of[0], truth, task.effects) if made_of else None


def one(number: int, folder: Path, task: Task, options: argparse.Namespace) -> dict[str, Any]:
    """Diagnosed, opened and scored."""
    with_sim = not options.no_sim
    findings, took, failed = diagnose(folder, with_sim)
    line: dict[str, Any] = {"case": number, **task._asdict(), "seconds": took, "failed": failed}
    if not failed:
        try:
            line |= msgspec.to_builtins(open_case(folder, findings))
            if options.no_sim:
                line["shown"] = shown(line, task, options.trajectories)
        except ImutoolError as error:
            line["failed"] = str(error)
    if line["failed"]:  # no answer is a wrong one, whatever was concealed
        unknown = ["?"] * {"null": 0, "pair": 2}.get(task.kind, 1)
        line |= {"detected": False, "right": False, "hits": [], "found": [], "concealed": list(task.effects) or unknown}
    if line["kind"] == "single":
        line["effects"] = line["concealed"]
    return line


def run(options: argparse.Namespace) -> list[dict[str, Any]]:
    """All cases, one line each in the file as soon as it is known."""
    lines_at = options.out / "cases.jsonl"
    options.out.mkdir(parents=True, exist_ok=True)
    done = {line["case"]: line for line in read_lines(lines_at)} if options.resume or options.table else {}
    if lines_at.exists() and not (options.resume or options.table or options.again):
        sys.exit(f"{lines_at} exists; use --resume, --again, --table or another folder")
    if options.again:
        lines_at.unlink(missing_ok=True)
    for number, task in enumerate(dealt(options.cases, options.seed, options.only)):
        if number in done or options.table:
            continue
        folder = options.out / f"{number:04d}"
        line = _made(number, task, folder, options)
        if line is None:
            line = one(number, folder, task, options)
        line["again"] = bool(options.again)
        done[number] = line
        with lines_at.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
        print(
            f"{number:4d} {task.kind:8s} {task.size:7s} {line.get('concealed')} -> {line.get('found')} {line['failed']}",
            flush=True,
        )
    return [done[number] for number in sorted(done)]


def _made(number: int, task: Task, folder: Path, options: argparse.Namespace) -> dict[str, Any] | None:
    """Conceals the case unless it is there; a line of its own where no motion shows it."""
    if (folder / "envelope.json").exists():
        if options.again:  # only what this benchmark itself wrote there
            (folder / OPENED).unlink(missing_ok=True)
            for stale in (FOUND, f"{FOUND}_alone"):
                shutil.rmtree(folder / stale, ignore_errors=True)
        return None
    if options.mujoco:
        from mujoco_cases import conceal_mujoco

        conceal_mujoco(folder, seed=options.seed * 100_003 + number, kind="null" if options.only == "null" else None)
        return None
    if make(task, options.trajectories, folder, options.seed * 100_003 + number, number) is None:
        return {"case": number, **task._asdict(), "failed": "no motion shows it", "seconds": 0.0, "hidden": True}
    return None


def read_lines(path: Path) -> Iterator[dict[str, Any]]:
    """The lines of earlier cases."""
    if path.exists():
        for text in path.read_text(encoding="utf-8").splitlines():
            yield json.loads(text)


# ── the table ──


def percent(values: Iterable[bool | float | None]) -> str:
    """The mean of what is known, in per cent."""
    known = [float(value) for value in values if value is not None]
    return f"{100.0 * np.mean(known):.0f} %" if known else "–"


def row(name: str, lines: Sequence[dict[str, Any]]) -> list[str]:
    """One row: of some cases."""
    parameters = [p for line in lines for p in line.get("parameters", [])]
    sigmas = np.array([p["sigmas"] for p in parameters if p["sigmas"] is not None])
    off = [p["percent"] for p in parameters]
    hits = sum(len(line.get("hits", [])) for line in lines)
    found = sum(len(line.get("found", [])) for line in lines)
    hidden = sum(len(line.get("concealed", [])) for line in lines)
    spread = 0.5 * float(np.diff(np.percentile(sigmas, [15.87, 84.13]))[0]) if len(sigmas) > 2 else None
    return [
        name,
        str(len(lines)),
        percent(line.get("detected", False) for line in lines),
        percent(line.get("right", False) for line in lines),
        f"{100 * hits / found:.0f} %" if found else "–",
        f"{100 * hits / hidden:.0f} %" if hidden else "–",
        percent(bool(line.get("wrong")) for line in lines),
        percent(line["place"]["f1"] for line in lines if line.get("place")),
        percent(abs(s) <= 3.0 for s in sigmas),
        f"{spread:.2f}" if spread is not None else "–",
        f"{np.median(off):.2g} %" if off else "–",
        percent(line.get("gain") for line in lines),
        f"{np.median([line['seconds'] for line in lines]):.1f}" if lines else "–",
    ]


HEAD = (
    *("cases", "n", "detected", "names right", "precision", "recall", "with a wrong name", "place F1"),
    *("within 3 sigmas", "spread of z", "error (median)", "gain", "s"),
)


def table(lines: Sequence[dict[str, Any]]) -> str:
    """Markdown: kinds by size, then single effects."""
    seen = [line for line in lines if not line.get("hidden")]
    rows = [row("all", seen)]
    for kind in ("single", "pair", "driven", "unknown", "null"):
        for size in SIZES if kind != "null" else ("middle",):
            mine = [line for line in seen if (line["kind"], line["size"]) == (kind, size)]
            rows += [row(kind if kind == "null" else f"{kind}, {size}", mine)]
    for name, told in (("shown by the poses", True), ("not shown by the poses", False)):
        rows += [row(name, [line for line in seen if line.get("shown") is told])]
    singles = [line for line in seen if line["kind"] == "single" and line["effects"]]
    for name in sorted({line["effects"][0] for line in singles}):
        rows += [row(name, [line for line in singles if line["effects"][0] == name])]
    text = ["| " + " | ".join(HEAD) + " |", "|" + "---|" * len(HEAD)]
    text += ["| " + " | ".join(cells) + " |" for cells in rows if cells[1] != "0"]
    failed = [line for line in seen if line["failed"]]
    hidden = [f"{'+'.join(line['effects'])} {line['kind']} {line['size']}" for line in lines if line.get("hidden")]
    text.append(f"\n{len(failed)} cases failed: {sorted({line['failed'][:100] for line in failed})[:5]}")
    text.append(f"{len(hidden)} were shown by no motion: {', '.join(sorted(hidden))}")
    return "\n".join(text)


def main() -> None:
    """Runs, or shows what has run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--trajectories", type=Path, nargs="+", default=[])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", default="", choices=["", "single", "pair", "driven", "unknown", "null", "uncalibrated"])
    for name in ("--no-sim", "--resume", "--again", "--table", "--mujoco", "--only-conceal"):
        parser.add_argument(name, action="store_true")
    options = parser.parse_args()
    if options.only_conceal:
        for number, task in enumerate(dealt(options.cases, options.seed, options.only)):
            _made(number, task, options.out / f"{number:04d}", options)
        return
    print(table(run(options)))


if __name__ == "__main__":
    main()
