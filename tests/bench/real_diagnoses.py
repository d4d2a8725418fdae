"""What real recordings conceal: `python tests/bench/real_diagnoses.py DATA --out OUT [--set fetch]`.

DATA holds euroc, tumvi and fetch, as their authors ship them or as logs (*.mcap). For every sequence, training and test, apart:
`imutool diagnose` as a person types it, and a fixed set of effects fitted whether they show or not (`diagnose.measured`). Then,
for each sensor: what comes up in all, most or one of the sequences, how far the parameters agree, and what the training
sequences' physics brings on the test sequences: rms against their own poses, and orientation by `evaluate`.

The training sequences' physics: effects that last (no bias, no stamps) and came up in at least half of them, fitted to each,
combined by their information, and kept where the sequences agree that they are not nothing. `--together` has `imutool diagnose`
search all the training sequences at once instead.

What is there already is not made again; --tables only tells what there is. Writes OUT/real.md (all values),
OUT/fragment.md (for docs/measurements/real-recordings.md) and OUT/real.png.
"""

from __future__ import annotations

import argparse
import json
import resource
import runpy
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from sensor_tables import (
    UNSEEN,
    Value,
    agreed,
    consistency,
    consistency_table,
    findings_table,
    gain_table,
    picture,
    together,
    values_table,
)

from imutool.api.logs import convert
from imutool.diagnosis.diagnose import EVERY_UNIT, candidates_for, effect_sizes
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.noise_estimate import whitened
from imutool.diagnosis.held_out import gains, with_constant
from imutool.diagnosis.reference.coverage import align, without_unusable
from imutool.diagnosis.reference.errors import SMOOTHED
from imutool.diagnosis.result import Closer
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.errors import ImutoolError
from imutool.evaluation import evaluate
from imutool.mcap_io.read import read as read_log
from imutool.sensor import physics_file
from imutool.sensor.physics_file import Entry, PhysicsFile
from imutool.sensor.physics_file import Value as Written

PAPER = runpy.run_path(str(Path(__file__).parents[2] / "examples/reproduce_tables.py"))
TRAIN: dict[str, tuple[str, ...]] = PAPER["TRAIN"]
TEST: dict[str, tuple[str, ...]] = PAPER["TEST"]
OTHER_TRUTH: dict[str, str] = PAPER["OTHER_TRUTH"]
FITTED = (*EVERY_UNIT, "gyro_delay")
MATRICES = ("gyro_scale", "gyro_misalignment", "accel_scale", "accel_misalignment", "lever_arm", "clock_offset", "gyro_delay")
# What a sensor keeps from one recording to the next; its clock is set anew, as its bias is.
LASTING = (
    *(name for name in MATRICES if name != "clock_offset"),
    *("mount_rotation", "size_effect", "gyro_g_sensitivity", "gyro_quadratic", "accel_quadratic"),
)
ABSENT = "not run yet"
SURE = 3.0  # sigmas, widened by the sequences' disagreement, from which on a number is carried over to other recordings
# true = M read - b: numbers of the data set's page, https://vision.in.tum.de/data/datasets/visual-inertial-dataset, as several
# public programs quote it; defined by equations 1 and 2 of Schubert et al., The TUM VI Benchmark, IROS 2018, arXiv 1804.06120.
TUM_VI = {
    "gyro": [[0.943611, 0.00148681, 0.000824366], [0.000369694, 1.09413, -0.00273521], [-0.00175252, 0.00834754, 1.01588]],
    "accel": [[1.00422, 0.0, 0.0], [-7.82123e-05, 1.00136, 0.0], [-0.0097745, -0.000976476, 0.970467]],
}


class Log(NamedTuple):
    """One sequence of a data set."""

    data_set: str
    path: Path

    @property
    def name(self) -> str:
        """Of the sequence."""
        return self.path.stem

    @property
    def test(self) -> bool:
        """Whether the paper keeps it for testing."""
        return self.name in TEST[self.data_set]


def published() -> dict[str, dict[str, float]]:
    """By data set and parameter, what its authors state: reading = M^-1 (true + b), scale and misalignment as ours are."""
    found = {}
    for sensor, matrix in TUM_VI.items():
        T = np.linalg.inv(np.array(matrix))
        for i, j in np.ndindex(3, 3):
            kind, axes = ("scale", "xyz"[i]) if i == j else ("misalignment", "xyz"[i] + "xyz"[j])
            found[f"{sensor}_{kind}.{axes}"] = float(T[i, i] - 1.0 if i == j else T[i, j] / T[i, i])
    return {"tumvi": found}


# ── what is run, and kept ──


def kept(path: Path, make: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
    """What an earlier run found, or what is made now; an answer that could not be had is one as well."""
    if not path.exists():
        spent = _cpu_s()
        try:
            found = make(*arguments)
        except ImutoolError as error:
            found = {"failed": str(error)}
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"cpu_s": round(_cpu_s() - spent, 1), **found}, indent=1) + "\n", encoding="utf-8")
        print(f"{path}: {json.loads(path.read_text(encoding='utf-8'))['cpu_s']} CPU s", flush=True)
    values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return values


def _cpu_s() -> float:
    """Of this process and those that it waited for."""
    return time.process_time() + sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])


def diagnosed(logs: Sequence[Path], words: Sequence[str] = ()) -> dict[str, Any]:
    """What the command says."""
    command = [sys.executable, "-m", "imutool", "diagnose", *map(str, logs), "--quiet", "--json", "-", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return {"failed": done.stderr.strip()[-500:]}
    told: dict[str, Any] = json.loads(done.stdout)
    return told


def fixed(log: Path, effects: Sequence[str], truth: str | None = None) -> dict[str, Any]:
    """Effects fitted together to one sequence: parameters with deviations, and their information."""
    found = effect_sizes(log, truth=truth, effects=(*effects, SMOOTHED.name))
    values = {
        f"{physics.name}.{number.name}": [float(value), float(s), number.unit, float(number.plausible)]
        for physics, theta in found.chosen
        for number, value, s in zip(physics.parameters, theta, found.std[physics.name], strict=True)
    }
    return {"values": values, "information": found.information.tolist()}


def as_values(told: Mapping[str, Any]) -> dict[str, Value]:
    """As `fixed` kept them."""
    return {name: Value(*row) for name, row in told["values"].items()}


# ── from the training sequences to the test sequences ──


def learned(fits: Sequence[Mapping[str, Any]]) -> tuple[PhysicsFile, list[str]]:
    """The physics that some sequences agree on, and its parameters that were left out.

    A parameter stays if the sequences that show it agree, within `SURE` deviations, that it is not nothing.
    """
    names = list(dict.fromkeys(name for one in fits for name in one["values"]))
    thetas, informations = np.zeros((len(fits), len(names))), np.zeros((len(fits), len(names), len(names)))
    for k, one in enumerate(fits):  # what a motion does not show, it says nothing of
        at = [names.index(name) for name in one["values"]]
        thetas[k, at], informations[k][np.ix_(at, at)] = [row[0] for row in one["values"].values()], one["information"]
    mean, covariance = together(list(thetas), list(informations))
    entries: dict[str, dict[str, Written]] = {}
    left = []
    for k, name in enumerate(names):
        values = [Value(*one["values"][name]) for one in fits if name in one["values"]]
        told = consistency([(one.value, one.std) for one in values if one.seen])
        std = max(float(np.sqrt(covariance[k, k])), told.std)  # slow errors of the poses show between logs alone
        if told.count < 0.5 * len(fits) or abs(mean[k]) < SURE * std or abs(mean[k]) > UNSEEN * values[0].plausible:
            left.append(name)
            continue
        effect, _, parameter = name.partition(".")
        entries.setdefault(effect, {})[parameter] = Written(value=float(mean[k]), std=std, unit=values[0].unit)
    of_sensor = ((effect, values) for effect, values in entries.items() if effect != SMOOTHED.name)
    return PhysicsFile(effect=tuple(Entry(name=effect, parameters=values) for effect, values in of_sensor)), left


def as_file(values: Mapping[str, float]) -> PhysicsFile:
    """Plain numbers by effect and parameter."""
    entries: dict[str, dict[str, Written]] = {}
    for name, value in values.items():
        effect, _, parameter = name.partition(".")
        entries.setdefault(effect, {})[parameter] = Written(value=value, unit="-")
    return PhysicsFile(effect=tuple(Entry(name=effect, parameters=row) for effect, row in entries.items()))


def residual_to_truth(real: Path, chosen: Chosen = ()) -> dict[str, Closer]:
    """Residual of a whole recording against its own true poses, by signal, without and with effects.

    The best constant of its own is in both; compared is as far up in frequency as the poses are known.

    Raises:
        ConfigError, LogError, DataError: as `diagnose`.
    """
    settings = DiagnoseSettings()
    aligned = align(read_log(real, imu=None), None, None, settings)
    pairs = [*map(without_unusable, aligned)]
    candidates = candidates_for(pairs)
    logs = []
    for log in (whitened(pair, candidates) for pair in pairs):
        unseen = replace(log.pair, fitted=np.zeros_like(log.pair.fitted), held_out=log.pair.fitted | log.pair.held_out)
        logs.append(replace(log, pair=unseen))
    before, after = ([with_constant(log.pair, expected(log.pair, effects)) for log in logs] for effects in ((), chosen))
    return gains(logs, before, after)


def gained(log: Log, physics: Path) -> dict[str, Any]:
    """What the physics of other sequences brings on this one: rms against its own poses, and the orientation it integrates to.

    A bias alone and the physics both start from the truth's first fifteen seconds and keep that bias: no stop or gravity helps.
    """
    chosen = tuple(physics_file.read(physics).acting(where=physics))
    told: dict[str, Any] = {
        signal: {"before": one.rms_before, "after": one.rms_after, "unit": one.unit}
        for signal, one in residual_to_truth(log.path, chosen).items()
    }
    told["orientation"] = {"raw": {}, "static": {}, "physics": {}}
    for name, model in (("static", "static"), ("physics", physics)):
        raw, started = evaluate(log.path, models=[model], init="truth", truth=OTHER_TRUTH.get(log.name))
        start = ",".join(f"{b:.9g}" for b in (*started["gyro_bias"], *started["accel_bias"]))
        (held,) = evaluate(log.path, models=[model], init=start, truth=OTHER_TRUTH.get(log.name))[1:]
        for key, one in (("raw", raw), (name, held)):
            told["orientation"][key] = {"aoe_deg": one["aoe_deg"], "roe_deg": one["roe_deg"]["5"]}
    return told


class Sensor:
    """What is known of one sensor, made or read from the folder; `only` some sequences are run, or all."""

    def __init__(self, data_set: str, logs: Sequence[Log], out: Path, options: argparse.Namespace) -> None:
        self.data_set, self.logs, self.out, self.options = data_set, logs, out, options
        self.only = options.sequences or [log.name for log in logs]
        self.effects = dict.fromkeys((FITTED, MATRICES) if data_set in published() else (FITTED,))

    def run(self) -> None:
        """Every sequence apart; then the training sequences' physics on the test sequences."""
        for log in (one for one in self.logs if one.name in self.only):
            kept(self.out / "diagnoses" / f"{log.name}.json", diagnosed, [log.path])
            for effects in self.effects:
                kept(self._fixed(log, effects), fixed, log.path, effects)
            if log.name in OTHER_TRUTH:
                kept(self._fixed(log, FITTED, "_other"), fixed, log.path, FITTED, OTHER_TRUTH[log.name])
        for name, physics in self.physics().items():
            for log in self.tests:
                kept(self.out / "gain" / name / f"{log.name}.json", gained, log, physics)

    @property
    def tests(self) -> list[Log]:
        """Sequences kept for testing."""
        return [log for log in self.logs if log.test]

    def _fixed(self, log: Log, effects: Sequence[str], suffix: str = "") -> Path:
        kind = "measured" if effects == FITTED else "matrices"
        return self.out / kind / f"{log.name}{suffix}.json"

    def physics(self) -> dict[str, Path]:
        """What the training sequences showed, where they agree on something; and what the authors of the data state."""
        paths = {name: self.out / "physics" / f"{name}.toml" for name in (self.data_set, f"{self.data_set}_published")}
        file = None if paths[self.data_set].exists() or self.options.tables else self._learned()
        for name, one in ((self.data_set, file), (f"{self.data_set}_published", as_file(published().get(self.data_set, {})))):
            if one is not None and one.effect and not paths[name].exists():
                paths[name].parent.mkdir(parents=True, exist_ok=True)
                physics_file.write(one, paths[name])
        return {name: path for name, path in paths.items() if path.exists()}

    def _learned(self) -> PhysicsFile | None:
        """From the training sequences alone, once all of them have been diagnosed."""
        training = [log for log in self.logs if not log.test]
        if not all((self.out / "diagnoses" / f"{log.name}.json").exists() for log in training):
            return None
        if self.options.together:
            folder = self.out / "together" / self.data_set
            kept(folder.with_suffix(".json"), diagnosed, [log.path for log in training], ["-o", str(folder)])
            found = physics_file.read(folder / "physics.toml")  # with the bias of the first log, which is no other log's
            return PhysicsFile(effect=found.effect, unknown=found.unknown, term=found.term)
        told = {log.name: self._told("diagnoses", log) for log in training}
        effects = agreed({name: _names(one) for name, one in told.items() if "failed" not in one}, LASTING)
        if not effects:
            return None
        fits = [kept(self.out / "agreed" / f"{log.name}.json", fixed, log.path, effects) for log in training]
        file, left = learned([one for one in fits if "failed" not in one])
        print(f"{self.data_set}: of {', '.join(effects)} without {', '.join(left) or 'nothing'}", flush=True)
        return file

    def _told(self, kind: str, log: Log) -> dict[str, Any]:
        path = self.out / kind / f"{log.name}.json"
        told: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"failed": ABSENT}
        return told

    # ── what it says ──

    def effect_sizes(self, kind: str = "measured") -> dict[str, dict[str, Value]]:
        """The fixed set by sequence."""
        told = {log.name: self._told(kind, log) for log in self.logs}
        return {name: as_values(one) for name, one in told.items() if "failed" not in one}

    def fragment(self) -> Iterable[str]:
        """Tables for a reader of the documentation."""
        told = {log.name: self._told("diagnoses", log) for log in self.logs}
        failed = {name: one["failed"] for name, one in told.items() if "failed" in one}
        sound = {name: one for name, one in told.items() if name not in failed}
        spent = [one["cpu_s"] for one in sound.values()]
        yield f"### {self.data_set}"
        if sound:
            yield f"{len(sound)} sequences, {np.median(spent):.0f} CPU s each (median; {min(spent):.0f} to {max(spent):.0f})."
            yield findings_table(sound)
        yield from (f"{name}: no answer ({why})" for name, why in failed.items())
        for effects in self.effects:
            kind = "measured" if effects == FITTED else "matrices"
            if rows := self.effect_sizes(kind):
                yield consistency_table(rows, published().get(self.data_set) if kind == "matrices" else None)
        gains = {
            f"{log.name}, {told_by}": self._told(f"gain/{name}", log)
            for log in self.tests
            for name, told_by in ((self.data_set, "as learned"), (f"{self.data_set}_published", "as published"))
        }
        if shown := {name: one for name, one in gains.items() if "failed" not in one}:
            yield gain_table(shown)
        yield from (
            f"{name}: no answer ({one['failed']})" for name, one in gains.items() if one.get("failed", ABSENT) != ABSENT
        )

    def values(self) -> Iterable[str]:
        """Every value of every sequence."""
        yield f"## {self.data_set}"
        for effects in self.effects:
            yield values_table(self.effect_sizes("measured" if effects == FITTED else "matrices"))
        for log in self.logs:
            if log.name in OTHER_TRUTH and (self._fixed(log, FITTED, "_other")).exists():
                one = json.loads(self._fixed(log, FITTED, "_other").read_text(encoding="utf-8"))
                yield f"{log.name} beside {OTHER_TRUTH[log.name]}:"
                yield values_table({"distributed": self.effect_sizes()[log.name], "recomputed": as_values(one)})
        for log in self.logs:
            told = self._told("diagnoses", log)
            yield f"**{log.name}** ({told.get('cpu_s', '–')} CPU s): {_said(told)}"


def _names(told: Mapping[str, Any]) -> list[str]:
    return [finding["effect"] for finding in told["findings"]]


def _said(told: Mapping[str, Any]) -> str:
    """Findings in a line."""
    if "failed" in told:
        return str(told["failed"])
    parts = []
    for one in told["findings"]:
        numbers = ", ".join(
            f"{name} {p['value']:.4g} ± {p['std']:.2g}" for name, p in one["parameters"].items() if p["value"] is not None
        )
        parts.append(f"{one['effect']} ({one['signal']}, {100 * one['share']:.0f} %: {numbers})")
    return "; ".join(parts) or "nothing"


def logs_of(data: Path, out: Path, data_set: str) -> list[Log]:
    """The logs of a data set, converted where there are none yet; training sequences first."""
    folder = data / data_set
    if not any(folder.glob("*.mcap")):
        made = out / "logs" / data_set
        if not made.exists():
            convert(folder, made)
        folder = made
    logs = [Log(data_set, path) for path in sorted(folder.glob("*.mcap"))]
    return sorted((log for log in logs if log.name in (*TRAIN[data_set], *TEST[data_set])), key=lambda log: log.test)


def main() -> None:
    """Runs, or tells what has run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--set", dest="sets", action="append", choices=sorted(TRAIN), help="data set; default all")
    parser.add_argument("--sequence", dest="sequences", action="append", help="run this one alone; default all")
    parser.add_argument("--together", action="store_true", help="search all training sequences at once")
    parser.add_argument("--tables", action="store_true", help="only tell what there is")
    options = parser.parse_args()
    sensors = []
    for data_set in options.sets or ("fetch", "tumvi", "euroc"):
        sensors.append(Sensor(data_set, logs_of(options.data, options.out, data_set), options.out, options))
        if not options.tables:
            sensors[-1].run()
    options.out.mkdir(parents=True, exist_ok=True)
    fragment = "\n\n".join(text for sensor in sensors for text in sensor.fragment())
    (options.out / "fragment.md").write_text(f"<!-- real -->\n{fragment}\n<!-- end -->\n", encoding="utf-8")
    (options.out / "real.md").write_text("\n\n".join(text for one in sensors for text in one.values()) + "\n", encoding="utf-8")
    seen = {one.data_set: one.effect_sizes() for one in sensors}
    picture(
        {name: rows for name, rows in seen.items() if rows},
        [log.name for one in sensors for log in one.tests],
        options.out / "real.png",
        published(),
    )
    print(fragment)


if __name__ == "__main__":
    main()
