"""A fleet as a Rerun catalog: a segment a log in layers, the worst logs by a query, served to this machine until Ctrl-C."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from support.report_schema import assert_valid

from imutool.debiasing import debias
from imutool.errors import ConfigError
from imutool.fleet import rerun_catalog, results
from imutool.fleet.one_log import UnitReport, write_json
from imutool.fleet.rerun_catalog import Catalog
from imutool.fleet.rerun_layers import FleetLog, build, layer_of, logs_of
from imutool.fleet.task import Imu, Parameter, Result

Imutool = Callable[..., subprocess.CompletedProcess[str]]
FINDING = {"effect": "lever_arm", "signal": "accel"}
PLACE = {"signal": "accel", "axes": ["x"], "intervals_s": [[2.0, 4.0]], "regime": "", "share": 0.8}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory, logs: Path) -> Path:
    """What a fleet writes that has debiased two logs."""
    folder, rows = tmp_path_factory.mktemp("catalog") / "out", []
    for name, score in (("flight_1", 0.9), ("flight_2", 0.4)):
        folder.mkdir(exist_ok=True)
        debias(logs / f"{name}.mcap", folder / f"{name}.mcap", model="static")
        imu = Imu("/imu0", "static", "rest", (0.01, 0.0, 0.0), (0.0, 0.1, 0.0))
        rows.append(Result(key=name, source=str(logs), target=f"{name}.mcap", status="ok", score=score, imus=(imu,)))
    results.write(rows, folder / results.NAME)
    return folder


@pytest.fixture
def diagnosed(tmp_path: Path, out: Path) -> Path:
    """What a fleet's diagnosis writes for one of them."""
    real = str(out / "flight_1.mcap")
    diagnosis = {"schema": "imutool.diagnosis/1", "real": [real], "located": [PLACE], "findings": [FINDING]}
    sizes = [Parameter("lever_arm", "x", 0.2, 0.01, "m")]
    write_json(UnitReport("robot_a", [[0.0] * 6], sizes, diagnosis), tmp_path / "flight_1.json")  # type: ignore[arg-type]
    row = Result(key="k", source=real, target="flight_1.json", status="ok", effects=("lever_arm",), robot="robot_a")
    results.write([row], tmp_path / results.NAME)
    return tmp_path


@pytest.mark.parametrize(
    ("entity", "layer"),
    [
        ("/imu/gyro/raw", "raw"),
        ("/imu/gyro/debiased", "debiased"),
        ("/world/gt/path", "raw"),
        ("/world/debiased/path", "debiased"),
        ("/bias/gyro/estimated", "debiased"),
        ("/bias/gyro/true", "raw"),
        ("/error/orientation/debiased/axes", "debiased"),
        ("/events/gap", "raw"),
        ("/events/finding", "diagnosis"),
        ("/diagnosis", "diagnosis"),
        ("/__properties/imutool", "raw"),
        ("/report", "raw"),
    ],
)
def test_an_entity_lies_in_one_layer(entity: str, layer: str) -> None:
    assert layer_of(entity) == layer


def test_a_segment_has_its_layers_and_a_query_finds_the_worst(out: Path, diagnosed: Path) -> None:
    cache = diagnosed / "cache"
    logs = logs_of([out, diagnosed])
    built = list(build(logs, cache, workers=2))
    assert {log.name: set(log.files) for log in built} == {
        "flight_1": {"raw", "debiased", "diagnosis"},
        "flight_2": {"raw", "debiased"},
    }
    written = {path: path.stat().st_mtime_ns for path in cache.glob("*.rrd")}
    assert list(build(logs, cache)) == sorted(built)  # a second time they are only found
    assert {path: path.stat().st_mtime_ns for path in cache.glob("*.rrd")} == written
    with Catalog(built, cache) as served:
        by, worst = served.worst(None, 10)
        assert by == "aoe"
        errors = [float(log.values["aoe_deg"]) for log in worst]
        assert len(errors) == 2
        assert errors == sorted(errors, reverse=True)
        assert [log.name for log in served.worst("aoe", 1)[1]] == [worst[0].name]
        (first, *_) = served.worst("effects", 10)[1]
        assert (first.name, first.layers, first.values["robot"]) == ("flight_1", ["raw", "debiased", "diagnosis"], "robot_a")
        scores = [log.values["score"] for log in served.worst("score", 10)[1]]
        assert scores == [0.4, 0.9]
        selected = served.dataset.filter_segments("flight_1").filter_contents(["/events/finding", "/imu/gyro/raw"])
        table = selected.reader(index="elapsed").to_arrow_table()
        assert table.num_rows >= 4000
        assert sum(cell is not None for cell in table["/events/finding:StateChange:state"].to_pylist()) >= 2
        with pytest.raises(ConfigError, match="cannot be used"):
            Catalog(built, cache, int(served.origin.rpartition(":")[2]))


def test_a_target_outside_its_fleet_is_refused(tmp_path: Path) -> None:
    results.write([Result(key="k", source="a.mcap", target="../a.mcap", status="ok")], tmp_path / results.NAME)
    with pytest.raises(ConfigError, match=r"\.\./a\.mcap"):
        logs_of([tmp_path])


def test_the_debiased_log_is_shown_whatever_other_fleets_say_of_it(tmp_path: Path, out: Path) -> None:
    """A diagnosis without a search, as `fleet info`, took the source, and the debiased layer was lost."""
    quick = Result(key="k", source=str(out / "raw.mcap"), target="flight_1.json", status="ok", robot="robot_a")
    (tmp_path / "flight_1.json").write_text("{}")
    results.write([quick], tmp_path / results.NAME)
    for folders in ([out, tmp_path], [tmp_path, out]):
        log = next(log for log in logs_of(folders) if log.name == "flight_1")
        assert (log.place, log.facts["robot"], log.facts["score"]) == (str(out / "flight_1.mcap"), "robot_a", 0.9)


def test_what_cannot_be_shown_is_named(tmp_path: Path, out: Path) -> None:
    (log,) = build([FleetLog("gone", str(tmp_path / "gone.mcap"), "")], tmp_path / "cache")
    assert not log.files
    assert "gone.mcap" in log.trouble
    with pytest.raises(ConfigError, match=r"no such file.*fleet debias"):
        logs_of([tmp_path])


def test_the_command_lists_the_worst(out: Path, imutool: Imutool) -> None:
    listed = imutool("fleet", "view", str(out), "--list", "--worst", "1", "--json", "-", cwd=out.parent)
    assert listed.returncode == 0, listed.stderr
    report = json.loads(listed.stdout)
    assert_valid(report)
    assert (report["segments"], len(report["worst"]), report["by"], report["not_shown"]) == (2, 1, "aoe", [])


@pytest.mark.parametrize("web", [[], ["--web"]])
def test_the_command_serves_until_it_is_interrupted(out: Path, command: str, web: list[str]) -> None:
    words = [command, "fleet", "view", str(out), "--quiet", *web]
    env = {name: value for name, value in os.environ.items() if name not in {"DISPLAY", "WAYLAND_DISPLAY"}}
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=env) as process:
        assert process.stdout is not None
        lines: list[str] = []
        while not lines or "Ctrl-C ends it" not in lines[-1]:
            lines.append(process.stdout.readline())
            assert lines[-1], lines
        url = re.search(r"rerun\+http://127\.0\.0\.1:\d+", "".join(lines))
        try:
            assert url is not None
            from rerun.catalog import CatalogClient

            assert sorted(CatalogClient(url[0]).get_dataset(rerun_catalog.DATASET).segment_ids()) == ["flight_1", "flight_2"]
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0


@pytest.mark.parametrize(("words", "code"), [(["--by", "beauty"], 3), (["--port", "0"], 2), (["--worst", "0"], 2)])
def test_a_wrong_option_is_refused_before_the_work(out: Path, imutool: Imutool, words: list[str], code: int) -> None:
    refused = imutool("fleet", "view", str(out), *words, cwd=out.parent)
    assert refused.returncode == code
    assert words[0] in refused.stderr
