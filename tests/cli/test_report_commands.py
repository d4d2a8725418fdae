"""The commands that leave a page: it holds their numbers, a link leads to it, and nothing is lost for its sake."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest
from support import diagnoses
from typer.testing import CliRunner, Result

from imutool import diagnosis_output
from imutool.cli import load
from imutool.cli.train import lines_of_choice
from imutool.errors import ConfigError, DataError, LogError, ModelError
from imutool.file_location import identity
from imutool.fleet import page as fleet_page
from imutool.fleet.one_log import work
from imutool.fleet.targets import is_current
from imutool.fleet.task import Result as Done
from imutool.fleet.task import Settings, Source, Task, with_model_hash
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.recording import Imu
from imutool.viewing.html import report, report_paths

HOSTILE = "a#b?<b>&'%41"


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(load(), [*map(str, words)])


@pytest.fixture(autouse=True)
def few_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are looked at in view/test_report.py; here one of them is enough."""
    monkeypatch.setattr(report, "PICTURES", (report_paths.paths,))


def test_a_full_disk_names_the_folder_of_a_diagnosis_and_no_temporary_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(d: object, folder: Path, *_: object) -> list[str]:
        raise ConfigError("cannot be written (No space left on device)", where=folder / "view.rrd")

    monkeypatch.setattr(diagnosis_output, "_make", full)
    with pytest.raises(ConfigError) as error:
        diagnosis_output.write(diagnoses.NOTHING, tmp_path / "found")
    assert error.value.where == str(tmp_path / "found" / "view.rrd")
    assert list(tmp_path.iterdir()) == []


def test_evaluate_writes_the_numbers_of_its_table(logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["--model", logs / "linear.safetensors", "--aid", "auto", "--report", "page.html", "--json", "said.json"]
    done = run("evaluate", logs / "flight_2.mcap", *words)
    assert done.exit_code == 0, done.output
    assert "Report: page.html" in done.stdout
    whole, drift = done.stdout.split("\n\n")[:2]
    assert ("aided" in whole, "expected" in drift, "aided" in drift) == (True, True, False)  # the windows use no aids
    page = (tmp_path / "page.html").read_text()
    results = json.loads((tmp_path / "said.json").read_text())["results"]
    drawn = [one for one in results if (one["model"], one["estimate"]) != ("raw", "aided")]
    assert [one["estimate"] for one in drawn] == ["integration", "integration", "aided"]
    for one in drawn:
        for name in ("aoe_deg", "ape_m", "ape_aligned_m", "velocity_rmse_m_s"):
            assert f'title="{one[name]!r}"' in page


def test_a_page_says_once_that_a_model_does_not_fit(logs: Path, tmp_path: Path) -> None:
    words = ["--model", "static", "--init", "0.3,0,0,0,0,0", "--report", tmp_path / "page.html"]
    done = run("evaluate", logs / "flight_2.mcap", *words)
    assert done.exit_code == 6, done.output  # as of `debias`, but the scores are there
    assert "the model 'static' does not fit this log" in done.stderr
    assert "static" in done.stdout
    assert len(re.findall("static is (?:unfit|doubtful)", (tmp_path / "page.html").read_text())) == 1


def test_debias_writes_a_page_of_the_new_log_and_refuses_before_the_work(logs: Path, tmp_path: Path) -> None:
    words = [logs / "flight_1.mcap", tmp_path / "out.mcap", "--model", logs / "linear.safetensors"]
    (tmp_path / "page.html").write_text("mine")
    refused = run("debias", *words, "--report", tmp_path / "page.html")
    assert refused.exit_code == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["page.html"]
    assert (tmp_path / "page.html").read_text() == "mine"
    done = run("debias", *words, "--report", tmp_path / "new.html", "--json", tmp_path / "said.json")
    assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "said.json").read_text())["report"] == str(tmp_path / "new.html")
    assert "in the log: linear" in (tmp_path / "new.html").read_text()


def test_a_page_of_the_logs_that_cannot_be_drawn_costs_no_diagnosis(tmp_path: Path) -> None:
    def look(folder: Path) -> list[object]:
        assert folder.name == "out"
        assert (folder / diagnosis_output.FINDINGS).is_file()
        raise DataError("too little truth")

    (remark,) = diagnosis_output.write(replace(diagnoses.NOTHING, traces=()), tmp_path / "out", logs=look)
    assert remark.startswith("log.html is left out: too little truth")
    assert "href" not in (tmp_path / "out" / diagnosis_output.REPORT).read_text()
    assert not (tmp_path / "out" / diagnosis_output.LOG).exists()
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.fixture
def task(logs: Path, tmp_path: Path) -> Task:
    """A log of a fleet, in a folder and of a name that no address may trip over."""
    log = logs / "flight_1.mcap"
    size, stamp = identity(log)
    settings = with_model_hash(Settings(command="debias", model=str(logs / "linear.safetensors"), pages=True))
    source = Source(str(log), f"{HOSTILE}/log.mcap", size, stamp)
    return Task(key="k", source=source, out=str(tmp_path / "out"), target=source.name, settings=settings)


def test_a_fleet_leaves_a_page_beside_each_log_and_its_summary_leads_there(task: Task, tmp_path: Path) -> None:
    done = work(task)
    assert done.status == "ok", done.error
    there = tmp_path / "out" / HOSTILE / "log.html"
    assert done.page == f"{HOSTILE}/log.html"
    assert "linear (in the log) cuts the orientation error" in done.page_says
    assert is_current(done, there.with_suffix(".mcap"))
    summary = tmp_path / "pages" / "summary.html"
    summary.parent.mkdir()
    fleet_page.write([done], task.settings, summary, out=tmp_path / "out", seconds=1.0, source="logs")
    content = summary.read_text()
    (link,) = re.findall(r'<a href="([^"]*)"', content)
    assert (summary.parent / unquote(link)).resolve() == there
    assert not set("#?<'") & set(link)
    assert "linear (in the log) cuts the orientation error" in content
    there.unlink()
    assert not is_current(done, there.with_suffix(".mcap")), "a page that is gone is made again"


def test_a_fleet_replaces_its_own_page_and_nobody_elses(task: Task, tmp_path: Path) -> None:
    there = tmp_path / "out" / HOSTILE / "log.html"
    there.parent.mkdir(parents=True)
    there.write_text("mine")
    done = work(task)
    assert done.status == "ok"
    assert done.page == ""
    assert any("no page: " in warning and "no fleet has written it" in warning for warning in done.warnings)
    assert there.read_text() == "mine"
    assert "<h2>Logs</h2>" not in fleet_page.html([done], task.settings, seconds=1.0, source="logs")


def test_without_pages_a_summary_leads_nowhere() -> None:
    done = Done(key="k", source="a.mcap", target="a.mcap", status="ok")
    assert "<a " not in fleet_page.html([done], Settings(command="debias"), seconds=1.0, source="logs")


def test_evaluate_scores_the_other_models_and_names_the_one_that_does_not_apply(logs: Path, tmp_path: Path) -> None:
    flown = read(logs / "flight_2.mcap")
    shaken = 0.5 * np.sin(np.arange(len(flown.imu)) / 20.0)[:, None]
    write(replace(flown, imu=Imu(flown.imu.t_ns, flown.imu.gyro + shaken, flown.imu.accel)), tmp_path / "restless.mcap")
    words = ["--model", "static", "--model", logs / "linear.safetensors", "--json", tmp_path / "said.json"]
    done = run("evaluate", tmp_path / "restless.mcap", *words)
    assert done.exit_code == ModelError.exit_code, done.output
    results = json.loads((tmp_path / "said.json").read_text())["results"]
    assert [row["model"] for row in results] == ["raw", "linear"]
    assert "the model static is not scored" in done.output


@pytest.mark.parametrize(("command", "page"), [("info", None), ("evaluate", "--report"), ("view", "--html")])
def test_of_several_logs_the_sound_ones_are_reported_and_the_other_one_is_named(
    logs: Path, tmp_path: Path, command: str, page: str | None
) -> None:
    none, out = tmp_path / "none.mcap", tmp_path / "out"
    none.write_text("hello")
    more = [] if page is None else [page, out.with_suffix(".html")]
    done = run(command, none, logs / "flight_1.mcap", *more, "--json", out.with_suffix(".json"))
    assert (done.exit_code, "none.mcap: this is not an MCAP log" in done.stderr) == (LogError.exit_code, True)
    found = json.loads(out.with_suffix(".json").read_text())
    assert len(found.get("logs", found.get("results", []))) == 1
    assert page is None or out.with_suffix(".html").exists()


@pytest.mark.parametrize("kept", ["kept", "dropped"])
def test_training_tells_whether_the_neural_ode_is_in_the_model_and_what_it_changes(kept: str) -> None:
    def errors(gyro: float, accel: float) -> dict[str, Any]:
        return {"gyro": {"error": gyro, "unit": "rad"}, "accel": {"error": accel, "unit": "m/s"}}

    card = {
        "physics": {"gyro": {"effects": []}, "accel": {"effects": ["accel_scale"]}},
        "held_out": errors(8.84e-4, 0.068) if kept == "kept" else errors(8.76e-4, 0.0781),
        "compared": {"effects": errors(8.76e-4, 0.0781), "effects and neural_ode": errors(8.84e-4, 0.068)},
    }
    assert lines_of_choice(card) == [
        "gyro: no effect",
        "accel: accel_scale",
        f"neural ODE {kept}: held-out error of gyro 0.000876 to 0.000884 rad, of accel 0.0781 to 0.068 m/s",
    ]
    unchanged = {"effects": errors(8.76e-4, 0.0781), "effects and neural_ode": errors(8.76e-4, 0.0781)}
    (line,) = lines_of_choice({"held_out": errors(8.76e-4, 0.0781), "compared": unchanged})
    assert line.startswith("neural ODE dropped")
    alone = {"compared": {"effects": errors(8.76e-4, 0.0781)}, "logs": [{}]}
    assert lines_of_choice(alone) == ["no neural ODE: one log shows only what fits its own motion"]
    assert lines_of_choice({}) == []
    network = {"held_out": {"gyro": {"error": 8.76e-4, "closed_form": 9.1e-4, "unit": "rad"}}}
    (line,) = lines_of_choice(network)
    assert line == "held-out error, from the closed form to the network: gyro 0.00091 to 0.000876 rad"
    (line,) = lines_of_choice(network | {"method": "conv", "left_out": {"kept": {"gyro": "linear"}}})
    assert line == "no network for gyro: left-out logs do not confirm it; --set compare=false keeps it"
    assert lines_of_choice(network | {"method": "conv", "left_out": {"kept": {"gyro": "conv"}}}) == lines_of_choice(network)
