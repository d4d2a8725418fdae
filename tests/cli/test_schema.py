"""Every `--json` report is valid against the schema that `imutool schema` prints, and so is every JSON file of a fleet."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pytest
from support.report_schema import assert_valid
from typer.testing import CliRunner

from imutool.cli import load
from imutool.cli.demo import write_asl
from imutool.mcap_io.write import write
from imutool.report import REPORTS, json_schema
from imutool.sensor.made_up_flight import flight

COMMANDS = [c.name or c.callback.__name__.replace("_", "-") for c in load().registered_commands if c.callback]
SILENT = {"schema", "new-converter"}  # commands without --json

# words of the command; {} is the folder of the logs, and a test runs in a folder of its own
LINES: dict[str, Sequence[str]] = {
    "info": ["info", "{}/flight_1.mcap"],
    "infos": ["info", "{}/flight_1.mcap", "{}/flight_2.mcap"],
    "noise": ["info", "{}/flight_1.mcap", "--noise"],
    "damage": ["info", "damaged.mcap"],
    "clean": ["clean", "{}/flight_1.mcap"],
    "clean-out": ["clean", "{}/flight_1.mcap", "out.mcap"],
    "convert": ["convert", "seq", "seq.mcap"],
    "export": ["export", "{}/flight_1.mcap", "out", "--format", "euroc"],
    "export-rosbag2": ["export", "{}/flight_1.mcap", "out", "--format", "rosbag2"],
    "repair": ["repair", "damaged.mcap", "out.mcap"],
    "debias": ["debias", "{}/flight_2.mcap", "out.mcap", "--clean", "--save-view", "out.rrd", "--report", "out.html"],
    "train": ["train", "short.mcap", "--method", "linear", "-o", "m.safetensors"],
    "evaluate": ["evaluate", "{}/flight_2.mcap", "--model", "static", "--aid", "stops,ground"],
    "view": ["view", "{}/flight_2.mcap", "--html", "out.html"],
    "live": ["live", "--from", "{}/flight_2.mcap", "--speed", "100", "--no-view"],
    "vio": ["vio", "{}/flight_2.mcap", "--model", "static", "--duration", "6", "--no-bias-states"],
    "simulate": ["simulate", "{}/flight_2.mcap", "sim.mcap", "--noise", "bmi160"],
    "audit": ["audit", "{}/flight_2.mcap"],
    "models": ["models"],
    "fleet-info": ["fleet", "info", "{}/flight_1.mcap", "out"],
    "fleet-diagnose": ["fleet", "diagnose", "{}/flight_1.mcap", "out", "--no-search"],
}
ELSEWHERE = {"demo", "diagnose", "conceal"}  # slow: their own tests call `assert_valid`


@pytest.fixture
def folder(tmp_path: Path, logs: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder with a raw sequence and a log cut short."""
    monkeypatch.chdir(tmp_path)
    write_asl(flight(1, duration_s=1.0), tmp_path / "seq")
    write(flight(1, duration_s=13.0, rate_hz=100.0), tmp_path / "short.mcap")
    raw = (logs / "flight_1.mcap").read_bytes()
    (tmp_path / "damaged.mcap").write_bytes(raw[: len(raw) // 2])
    return tmp_path


@pytest.mark.parametrize("words", LINES.values(), ids=LINES)
def test_a_report_is_valid_against_its_schema(folder: Path, logs: Path, words: Sequence[str]) -> None:
    done = CliRunner().invoke(load(), [*(word.format(logs) for word in words), "--json", "report.json"])
    assert done.exit_code in {0, 3}, done.output
    assert_valid(json.loads((folder / "report.json").read_text()))
    if words[0] == "fleet":
        for path in (folder / "out").rglob("*.json"):
            assert_valid(json.loads(path.read_text()))


def test_every_command_is_covered() -> None:
    assert set(COMMANDS) - SILENT == {words[0] for words in LINES.values()} - {"fleet"} | ELSEWHERE


def test_the_demo_is_valid_against_its_schema(demonstration: Path) -> None:
    assert_valid(json.loads((demonstration / "report.json").read_text()))


def test_schema_lists_the_reports_and_prints_the_schema_of_one() -> None:
    listed = CliRunner().invoke(load(), ["schema"])
    assert listed.stdout.split() == sorted(REPORTS)
    printed = CliRunner().invoke(load(), ["schema", "info"])
    assert json.loads(printed.stdout) == json_schema("info")
    assert CliRunner().invoke(load(), ["schema", "inof"]).exit_code == 3
