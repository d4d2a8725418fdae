"""The demo: every artefact is there and holds something, the model wins, and its numbers are computed."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imutool.cli import demo
from imutool.errors import ConfigError
from imutool.evaluation import evaluate
from imutool.mcap_io.log import Log
from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight

FLIGHT_SAMPLES = 12_001  # 60 s at 200 Hz, both ends included
SMALLEST_PICTURE = 20_000  # bytes; an empty figure of this size has under 10 kB
SMALLEST_RRD = 1_000_000
SAME = 1e-6  # another process may sum in another order


@pytest.fixture
def made(demonstration: Path) -> tuple[Path, dict[str, Any]]:
    """The folder in which the demo ran, and what it reported."""
    return demonstration, json.loads((demonstration / "report.json").read_text())


def figures(report: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {result["model"]: result for result in report["results"]}


def test_the_model_beats_raw_and_static_on_the_flight_it_has_not_seen(made: tuple[Path, dict[str, Any]]) -> None:
    found = figures(made[1])
    assert list(found) == ["raw", "static", "model"]
    assert found["model"]["aoe_deg"] < 0.5 * found["static"]["aoe_deg"] < found["static"]["aoe_deg"] < found["raw"]["aoe_deg"]
    assert found["model"]["velocity_rmse_m_s"] < found["raw"]["velocity_rmse_m_s"]


def test_each_step_is_said_and_the_figures_are_shown(made: tuple[Path, dict[str, Any]]) -> None:
    said = (made[0] / "stderr.txt").read_text().splitlines()
    assert [line[:2] for line in said if line[1:2] == "."] == ["1.", "2.", "3.", "4.", "5."]
    shown = (made[0] / "stdout.txt").read_text()
    for result in made[1]["results"]:
        assert f"{result['aoe_deg']:.2f}" in shown
    assert made[1]["png"] in shown
    assert made[1]["report"] in shown


def test_every_artefact_is_there_and_holds_something(made: tuple[Path, dict[str, Any]]) -> None:
    folder, report = made
    with Log(folder / report["debiased"]) as log:
        for topic in ("/imu0", "/imu0/debiased", "/imu0/bias/gyro", "/imu0/bias/accel"):
            assert log.topics[topic].count == FLIGHT_SAMPLES
        assert log.metadata()["imutool"]["method"] == "neural_ode"
    rrd, png = (folder / report["rrd"]).read_bytes(), (folder / report["png"]).read_bytes()
    assert rrd.startswith(b"RRF2")
    assert len(rrd) > SMALLEST_RRD
    assert png.startswith(b"\x89PNG")
    assert len(png) > SMALLEST_PICTURE
    page = (folder / report["report"]).read_text()
    shown = np.array(re.findall(r"\d+\.\d{9,}", page), float)  # of a path in memory; a report's path comes in blocks
    assert all(np.isclose(shown, result["aoe_deg"], rtol=1e-9, atol=0.0).any() for result in report["results"])
    assert len(list((folder / "demo-out" / "logs").glob("*.mcap"))) == 5
    assert not list(folder.rglob("*.checkpoint"))


def test_the_numbers_are_those_of_the_files_and_change_with_the_flight(
    made: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder, report = made
    again = evaluate(folder / report["log"], models=["static", folder / report["model"]])
    for one, reported in zip(again, report["results"], strict=True):
        for name in ("aoe_deg", "ape_m", "velocity_rmse_m_s"):
            assert one[name] == pytest.approx(reported[name], rel=SAME)
    write(demo.made_up(demo.TEST_SEED + 1), tmp_path / "other.mcap")
    other = figures({"results": evaluate(tmp_path / "other.mcap", models=["static", folder / report["model"]])})
    found = figures(report)
    for model in ("raw", "static", "model"):
        assert other[model]["aoe_deg"] != found[model]["aoe_deg"]
    assert other["model"]["aoe_deg"] < other["static"]["aoe_deg"]


def test_an_earlier_demo_stays_without_overwrite(made: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    before = sorted(made[0].rglob("*"))
    monkeypatch.setitem(sys.modules, "imutool.training.run", None)  # nothing is loaded for work that is refused
    with pytest.raises(ConfigError, match="overwrite"):
        demo.run(made[0] / "demo-out", lambda _: None)
    assert sorted(made[0].rglob("*")) == before


def test_a_missing_package_is_named_before_any_work_with_all_that_the_demo_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda module: None if module == "torch" else module)
    with pytest.raises(ConfigError, match=r"torch is not installed.*imutool\[train,view,report\]"):
        demo.run(tmp_path / "demo-out", lambda _: None)
    assert not (tmp_path / "demo-out").exists()


def test_raw_files_of_a_flight_convert_back_to_the_same_bits(tmp_path: Path) -> None:
    from imutool.converters import euroc

    recording = flight(7, duration_s=1.0)
    demo.write_asl(recording, tmp_path / "flight_7")
    (back,) = euroc.read(tmp_path / "flight_7")
    assert back.imu == recording.imu
    assert back.truth == recording.truth


def test_an_interrupted_training_advises_no_option_of_another_command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def interrupted(*args: Any, **options: Any) -> None:
        end = KeyboardInterrupt()
        end.add_note("the same command with `resume` goes on from there")
        raise end

    monkeypatch.setattr("imutool.training.run.train", interrupted)
    monkeypatch.setattr("imutool.conversion.run.convert", lambda *args, **options: None)
    monkeypatch.setattr(demo, "write_asl", lambda *args: None)
    with pytest.raises(KeyboardInterrupt, match=r"^$"):
        demo.run(tmp_path / "out", lambda line: None)
