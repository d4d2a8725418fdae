"""Wrong simulators are named by their fault, right ones are not accused; the motion is that of the bench, in closed form."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.report_schema import assert_valid
from support.seeds import seeds

from imutool.diagnosis.audit import simulator_faults, simulator_remarks
from imutool.diagnosis.audit.faults import FAULTS
from imutool.mcap_io.write import write

PATH = Path(__file__).parents[2] / "bench" / "audit.py"
SPEC = importlib.util.spec_from_file_location("audit_bench", PATH)
assert SPEC is not None
assert SPEC.loader is not None
bench: Any = importlib.util.module_from_spec(SPEC)
sys.modules["audit_bench"] = bench
SPEC.loader.exec_module(bench)
DURATION_S = 16.0
Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.mark.parametrize("name", list(bench.FAULTS))
def test_a_fault_is_named_and_nothing_else(name: str) -> None:
    faults = simulator_faults(*bench.made(name, 5, 60.0 if name == "bias_never_walks" else DURATION_S))  # a walk takes time
    assert {fault.fault for fault in faults} == {name.partition(" ")[0]}


@pytest.mark.parametrize("seed", seeds(3))
def test_a_right_simulator_has_no_fault(seed: int) -> None:
    assert simulator_faults(*bench.made("null", seed, DURATION_S)) == []


def test_a_diagnosis_says_what_the_simulation_does_wrong() -> None:
    sim, _, _ = bench.made("coordinate_acceleration", 2, DURATION_S)
    (remark,) = simulator_remarks(sim)
    assert remark == (
        "The simulation is wrong by itself: The accel reads the acceleration without gravity, not the specific force "
        "(coordinate_acceleration)"
    )
    assert simulator_remarks(replace(sim, truths={})) == []


def test_every_fault_cites_the_thread_of_a_simulator() -> None:
    assert all(fault.source.startswith("https://github.com/") and fault.equation for fault in FAULTS.values())


def test_the_command_says_the_fault_its_equation_and_its_source(tmp_path: Path, imutool: Command) -> None:
    sim, _, _ = bench.made("transport_term", 1, DURATION_S)
    write(sim, tmp_path / "sim.mcap")
    said = imutool("audit", "sim.mcap", cwd=tmp_path)
    assert said.stdout.startswith("1 fault of the simulator found:\n")
    assert "transport_term: The accel is the derivative of the velocity in the body frame" in said.stdout
    assert "they need a recording (--real)." in said.stdout
    report = json.loads(imutool("audit", "sim.mcap", "--json", "-", cwd=tmp_path).stdout)
    assert_valid(report)
    assert report["faults"][0]["parameters"]["missing"]["value"] == pytest.approx(1.0, abs=0.1)
