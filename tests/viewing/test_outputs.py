"""All ways to look that are asked for are taken, contradictions refused before any work, and each way said."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from imutool.errors import ConfigError, DataError
from imutool.mcap_io.write import write
from imutool.recording import Recording
from imutool.viewing import outputs
from imutool.viewing.html.report import file_name
from imutool.viewing.model.load_view import build
from imutool.viewing.model.run_data import Run, RunData
from imutool.viewing.outputs import Outputs, RequestedOutputs, cursor_s


@pytest.mark.parametrize(
    ("asked", "what"),
    [
        (RequestedOutputs(connect="1", web=True), "`connect` and `web`"),
        (RequestedOutputs(port=9090), "without `web`"),
        (RequestedOutputs(save=Path("a.rrd"), at="worst"), "no cursor"),
        (RequestedOutputs(html=Path("a.html"), at="1"), "no cursor"),
    ],
)
def test_contradictions_are_refused_before_any_work(asked: RequestedOutputs, what: str) -> None:
    with pytest.raises(ConfigError, match=what):
        Outputs(asked)


@pytest.fixture
def report(monkeypatch: pytest.MonkeyPatch) -> None:
    """The page and the pictures have tests of their own; here it counts that they are asked for."""

    def write_page(logs: Sequence[RunData], path: Path, *, overwrite: bool) -> None:
        path.write_text(" ".join(data.name for data in logs), encoding="utf-8")

    def write_pngs(data: RunData, folder: Path, *, overwrite: bool) -> list[Path]:
        return [folder / f"{data.name}-paths.png"]

    monkeypatch.setattr(outputs.report, "write_page", write_page)
    monkeypatch.setattr(outputs.report, "write_pngs", write_pngs)


def test_files_and_pages_are_made_together_and_each_is_said(data: RunData, tmp_path: Path, report: None) -> None:
    asked = RequestedOutputs(save=tmp_path / "a.rrd", html=tmp_path / "a.html", png=tmp_path / "p")
    with Outputs(asked) as chosen:
        shown = chosen.show([data])
    assert [one.how for one in shown] == ["html", "png", "rrd"]
    assert (tmp_path / "a.html").read_text(encoding="utf-8") == "flight_3"
    assert (tmp_path / "a.rrd").stat().st_size > 1000
    assert shown[1].said == f"Drew {tmp_path / 'p' / 'flight_3-paths.png'}"
    assert all(one.place in one.said for one in shown)


@pytest.mark.parametrize("name", ["flight 1", "flight_1" * 20])
def test_pictures_of_two_logs_of_one_name_have_two_names(data: RunData, tmp_path: Path, report: None, name: str) -> None:
    """As of a raw log and the debiased one of it; the second one's took the place of the first one's."""
    twins = [replace(data, name=name), replace(data, name=name.replace(" ", "_"))]
    with Outputs(RequestedOutputs(png=tmp_path)) as views:
        first, second = views.show(twins)
    assert first.said == f"Drew {tmp_path / name}-paths.png"
    assert file_name(second.said.removeprefix(f"Drew {tmp_path}/")) != file_name(first.said.removeprefix(f"Drew {tmp_path}/"))


def test_without_rerun_a_page_is_written_here_and_said(
    data: RunData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, report: None
) -> None:
    there = outputs.find_spec
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(outputs, "find_spec", lambda name: None if name == "rerun" else there(name))
    with Outputs(RequestedOutputs()) as chosen:
        (shown,) = chosen.show([data])
    assert (shown.how, shown.place) == ("html", "flight_3.html")
    assert "not installed (pip install 'imutool[view]')" in shown.said
    assert (tmp_path / "flight_3.html").read_text(encoding="utf-8") == "flight_3"
    monkeypatch.setattr(outputs, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"imutool\[view,report\]"):  # before a log is read
        Outputs(RequestedOutputs())


def test_what_needs_rerun_is_refused_without_it_before_any_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    for asked in (
        RequestedOutputs(save=Path("a")),
        RequestedOutputs(connect="1"),
        RequestedOutputs(web=True),
        RequestedOutputs(export_web=Path("a")),
    ):
        with pytest.raises(ConfigError, match=r"pip install 'imutool\[view\]'"):
            Outputs(asked)


def test_the_cursor_starts_at_a_time_or_at_the_worst_error_of_a_model(
    data: RunData, recording: Recording, runs: list[Run]
) -> None:
    assert cursor_s([data], "1.25") == 1.25
    peaks = {}
    for trace in data.models():
        assert trace.errors is not None
        total = trace.errors.orientation_total_deg
        peaks[float(np.nanmax(total))] = float(data.elapsed_s(trace.errors.t_ns)[int(np.nanargmax(total))])
    assert cursor_s([data], "worst") == peaks[max(peaks)]
    for at, error, what in (("soon", ConfigError, "soon"), ("-1", DataError, "outside"), ("nan", DataError, "outside")):
        with pytest.raises(error, match=what):
            cursor_s([data], at)
    blind = build(Recording(imu=recording.imu, imu_topic=recording.imu_topic, name="blind", truths={}, scalars={}), runs[:1])
    with pytest.raises(DataError, match="no log has truth"):
        cursor_s([blind], "worst")


def test_the_command_says_in_json_what_it_wrote(
    recording: Recording, tmp_path: Path, imutool: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    write(recording, tmp_path / "log.mcap")
    done = imutool("view", "log.mcap", "--save", "a.rrd", "--json", "-", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert (told["schema"], told["logs"]) == ("imutool.view/1", ["log.mcap"])
    assert [(one["how"], one["place"]) for one in told["shown"]] == [("rrd", "a.rrd")]
    assert told["rerun"].startswith("0.41.")


def test_where_nobody_listens_a_file_is_saved_and_the_command_fails_all_the_same(
    recording: Recording, tmp_path: Path, imutool: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    write(recording, tmp_path / "log.mcap")
    done = imutool("view", "log.mcap", "--connect", "127.0.0.1:1", cwd=tmp_path, apart=True)
    assert done.returncode == ConfigError.exit_code
    before, after = done.stderr.splitlines()  # the log is read, and at the end
    assert (before.split(": ")[0], after.split(": ")[0]) == ("warning", "error")
    assert "nothing listens there" in before
    assert before.endswith("an .rrd is saved in its place")
    assert after.endswith("or use --save.")
    assert done.stdout == "Saved flight_3.rrd. Open with: rerun flight_3.rrd\n"
    assert {path.name for path in tmp_path.iterdir()} == {"log.mcap", "flight_3.rrd"}


def test_what_is_no_address_is_refused_before_anything_is_read_or_written(
    tmp_path: Path, imutool: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    refused = imutool("view", "no-such.mcap", "--connect", "http://127.0.0.1:1", "--html", "a.html", cwd=tmp_path)
    assert refused.returncode == ConfigError.exit_code
    assert "HOST:PORT" in refused.stderr
    assert list(tmp_path.iterdir()) == []
