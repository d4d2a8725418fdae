"""`imutool clean` and `debias --clean` as a person types them, on made-up and on real recordings that were spoiled."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.imu_defects import messages, repeated, survey, with_values, without, write_log

from imutool.cleaning import CleaningSettings
from imutool.cleaning.survey import raw_batches
from imutool.debiasing import debias
from imutool.errors import LogError
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.mcap_io.log import Log
from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight
from imutool.viewing.html import cleaning_page

Command = Callable[..., subprocess.CompletedProcess[str]]

SPIKES, NANS, AGAIN, GAP = [900, 1700, 2500], [1200, 1201], [300, 310, 320, 330], slice(3100, 3140)
SPOILED = {"spikes": 3, "not_finite": 2, "duplicates": 4, "gaps": 40}
TAKEN_OFF = {"gyro": 2e-3, "accel": 0.02}  # how far the bias taken off may differ for it: a few samples of thousands are gone


def spoil(batch: ImuBatch) -> ImuBatch:
    for row in SPIKES:
        batch = with_values(batch, row, row % 3, 40.0, add=True)
    batch = with_values(batch, NANS, 4, np.nan)
    return repeated(without(batch, GAP), AGAIN, 3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """whole.mcap, and the same log spoiled.mcap, unknown.mcap (a strange unit) and two.mcap (two IMUs, one of them spoiled)."""
    folder = tmp_path_factory.mktemp("clean")
    write(flight(1, duration_s=25.0), folder / "whole.mcap")
    made = messages(folder / "whole.mcap")
    write_log(spoil(made), folder / "spoiled.mcap", folder / "whole.mcap")
    write_log(made._replace(accel=13.0 * made.accel), folder / "unknown.mcap", folder / "whole.mcap")
    write_log(spoil(made), folder / "two.mcap", folder / "whole.mcap", topic="/imu1")
    return folder


def counts(report: dict[str, object]) -> dict[str, int]:
    (imu,) = report["imus"]  # type: ignore[misc]
    return {one["rule"]: one["count"] for one in imu["findings"]}


def test_without_out_it_says_what_is_wrong_and_writes_nothing(folder: Path, imutool: Command) -> None:
    before = sorted(folder.iterdir())
    done = imutool("clean", "spoiled.mcap", "--json", "-", cwd=folder)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["schema"] == "imutool.clean/1"
    assert counts(report) == SPOILED
    (imu,) = report["imus"]
    assert (imu["verdict"], imu["messages"], imu["valid"]) == ("usable", 5001 - 40 + 4, 5001 - 40 - 5)
    assert 0.8 < imu["score"] < 0.95
    assert sorted(folder.iterdir()) == before


def test_the_table_says_the_same_for_a_person(folder: Path, imutool: Command) -> None:
    done = imutool("clean", "spoiled.mcap", cwd=folder, env={"COLUMNS": "160"})
    lines = done.stdout.splitlines()
    assert lines[0].startswith("/imu0: usable, score 0.")
    for rule, count in SPOILED.items():
        assert any(line.split()[:2] == [rule, str(count)] for line in lines), done.stdout


def test_with_out_the_debiased_channel_is_the_clean_one_and_the_source_stays(
    folder: Path, imutool: Command, tmp_path: Path
) -> None:
    source, target = folder / "spoiled.mcap", tmp_path / "clean.mcap"
    before = source.read_bytes()
    done = imutool("clean", source, target, "--json", "report.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert source.read_bytes() == before
    report = json.loads((tmp_path / "report.json").read_text())
    assert counts(report) == SPOILED
    with Log(source) as raw, Log(target) as log:
        rows = {name: list(opened.rows(["/imu0"])) for name, opened in (("raw", raw), ("copy", log))}
        for (_, one), (_, other) in zip(rows["raw"], rows["copy"], strict=True):
            assert one.payload.tobytes() == other.payload.tobytes()
        clean = list(raw_batches(log, "/imu0/debiased"))
        assert (np.diff(np.concatenate([batch.stamp_ns for batch in clean])) > 0).all()
        assert all(np.isfinite(values).all() for batch in clean for values in (batch.gyro, batch.accel))
        metadata = log.metadata()["imutool_clean"]
        kept = {(int(t), int(s)) for batch in clean for t, s in zip(batch.log_time, batch.sequence, strict=True)}
    messages_of = [batch for _, rows_ in rows["raw"] for batch in raw_columns(rows_)]
    left = np.flatnonzero(~survey(source).dropped)
    assert kept == {messages_of[i] for i in left}
    assert len(kept) == report["imus"][0]["valid"]
    assert {one["rule"]: one["count"] for one in json.loads(metadata["findings"])} == SPOILED
    assert metadata["verdict"] == "usable"


def raw_columns(rows: object) -> list[tuple[int, int]]:
    """Log time and sequence of messages as they lie in the file."""
    return list(zip(map(int, rows.log_time), map(int, rows.sequence), strict=True))  # type: ignore[attr-defined]


@pytest.mark.parametrize("init", ["auto", "stationary", "truth", "prior", "0,0,0,0,0,0"])
def test_every_start_finds_in_the_spoiled_log_what_it_finds_in_the_whole_one(
    init: str, folder: Path, logs: Path, tmp_path: Path
) -> None:
    model = logs / "linear.safetensors"
    whole = debias(folder / "whole.mcap", tmp_path / "a.mcap", model=model, init=init)
    spoiled = debias(folder / "spoiled.mcap", tmp_path / "b.mcap", model=model, init=init, clean=CleaningSettings())
    a, b = whole.starts["/imu0"].rest, spoiled.starts["/imu0"].rest
    assert b[:3] == pytest.approx(a[:3], abs=TAKEN_OFF["gyro"])
    assert b[3:] == pytest.approx(a[3:], abs=TAKEN_OFF["accel"])


def test_smoothing_and_no_model_go_over_the_clean_samples_too(folder: Path, logs: Path, tmp_path: Path) -> None:
    smooth = debias(
        folder / "spoiled.mcap", tmp_path / "a.mcap", model=logs / "linear.safetensors", smooth=True, clean=CleaningSettings()
    )
    static = debias(folder / "spoiled.mcap", tmp_path / "b.mcap", clean=CleaningSettings())
    for report in (smooth, static):
        assert report.rewrite.added["/imu0/debiased"] == report.surveys["/imu0"].valid


def test_a_clean_log_is_debiased_as_without_cleaning(folder: Path, logs: Path, tmp_path: Path) -> None:
    model = logs / "linear.safetensors"
    debias(folder / "whole.mcap", tmp_path / "a.mcap", model=model)
    debias(folder / "whole.mcap", tmp_path / "b.mcap", model=model, clean=CleaningSettings())
    for topic in ("/imu0/debiased", "/imu0/bias"):
        found = []
        for name in ("a", "b"):
            with Log(tmp_path / f"{name}.mcap") as log:
                found.append([rows.payload.tobytes() for _, rows in log.rows([topic])])
        assert found[0] == found[1]


def test_debias_says_how_to_go_on_and_goes_on(folder: Path, imutool: Command, tmp_path: Path) -> None:
    refused = imutool("debias", folder / "spoiled.mcap", "out.mcap", cwd=tmp_path)
    assert refused.returncode == 5
    assert "imutool debias --clean" in refused.stderr
    done = imutool("debias", "--clean", folder / "spoiled.mcap", "out.mcap", "--json", "-", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert counts({"imus": json.loads(done.stdout)["clean"]}) == SPOILED


def test_what_cannot_be_trusted_is_left_alone_unless_forced(folder: Path, imutool: Command, tmp_path: Path) -> None:
    said = imutool("clean", folder / "unknown.mcap", cwd=tmp_path)
    assert said.returncode == 0
    assert "quarantine" in said.stdout
    assert "not to be trusted: the unit of accel is unknown" in said.stdout
    refused = imutool("clean", folder / "unknown.mcap", "out.mcap", cwd=tmp_path)
    assert refused.returncode == 5
    assert "the unit of accel is unknown" in refused.stderr
    assert "`imutool clean LOG OUT --force`" in refused.stderr  # --force of other commands is about the model
    assert list(tmp_path.iterdir()) == []
    forced = imutool("clean", folder / "unknown.mcap", "out.mcap", "--force", "--init", "0,0,0,0,0,0", cwd=tmp_path)
    assert forced.returncode == 0, forced.stderr
    with Log(tmp_path / "out.mcap") as log:
        assert log.metadata()["imutool_clean"]["verdict"] == "quarantine"


def test_a_log_with_two_imus_is_looked_at_whole_and_each_alone(folder: Path, imutool: Command, tmp_path: Path) -> None:
    done = imutool("clean", folder / "two.mcap", "--json", "-", cwd=tmp_path)
    by_topic = {imu["topic"]: imu for imu in json.loads(done.stdout)["imus"]}
    assert {topic: imu["verdict"] for topic, imu in by_topic.items()} == {"/imu0": "good", "/imu1": "usable"}
    with pytest.raises(LogError, match=r"IMU topics: /imu., /imu."):
        survey(folder / "two.mcap")


def test_the_page_holds_every_finding_and_asks_nobody_for_anything(folder: Path, imutool: Command, tmp_path: Path) -> None:
    done = imutool("clean", folder / "spoiled.mcap", "--report", "page.html", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "page.html").read_text()
    for rule, count in SPOILED.items():
        assert f'<td class="number">{rule}</td><td class="number">{count}</td>' in page
    found = survey(folder / "spoiled.mcap")
    whens = [finding.when(found.start_ns) for finding in found.findings]
    assert all(f'<div class="note">{when}</div>' in page for when in whens if when != "whole log")
    assert any("–" in when for when in whens)
    assert page.count("<rect") == 3 + 1 + 1 + 1  # spikes, and one interval each of what lies close together
    assert "http://" not in page
    assert "https://" not in page
    again = imutool("clean", folder / "spoiled.mcap", "--report", "page.html", cwd=tmp_path)
    assert again.returncode == 3


def test_a_page_escapes_what_comes_from_the_log(folder: Path) -> None:
    found = replace(survey(folder / "spoiled.mcap"), topic="/<script>alert(1)</script>", log="<b>\u202elog.mcap")
    page = cleaning_page.html([found])
    assert "<script>" not in page
    assert "<b>" not in page
    assert "\u202e" not in page


def test_a_page_says_yes_instead_of_true_and_a_unit_behind_its_number(folder: Path) -> None:
    found = survey(folder / "spoiled.mcap")
    rested = replace(found.findings[0], values={"at_rest": True, "longest_s": 0.5})
    assert "at rest yes, longest 0.5 s" in cleaning_page.html([replace(found, findings=(rested,))])


def test_a_page_names_dropped_samples_only_where_there_are_some(folder: Path) -> None:
    found = survey(folder / "spoiled.mcap")
    assert "leaves out the samples listed below as dropped" in cleaning_page.html([found])
    assert "dropped." not in cleaning_page.html([replace(found, dropped=np.zeros_like(found.dropped))])


def test_a_page_of_a_log_cleaned_with_force_does_not_deny_it(folder: Path) -> None:
    found = replace(survey(folder / "spoiled.mcap"), reasons=("nobody trusts it",))
    assert "it is not cleaned" in cleaning_page.html([found])
    forced = cleaning_page.html([replace(found, settings=CleaningSettings(force=True))])
    assert "it is not cleaned" not in forced
    assert "not trustworthy" in forced


def test_rules_are_named_and_a_wrong_name_suggests_the_nearest(folder: Path, imutool: Command) -> None:
    done = imutool("clean", "spoiled.mcap", "--rule", "spikes", "--json", "-", cwd=folder)
    assert counts(json.loads(done.stdout)) == {"spikes": 3}
    done = imutool("clean", "spoiled.mcap", "--no-rule", "spikes", "--json", "-", cwd=folder)
    assert "spikes" not in counts(json.loads(done.stdout))
    wrong = imutool("clean", "spoiled.mcap", "--rule", "spike", cwd=folder)
    assert (wrong.returncode, "Did you mean 'spikes'?" in wrong.stderr) == (3, True)
    both = imutool("clean", "spoiled.mcap", "--rule", "spikes", "--no-rule", "spikes", cwd=folder)
    assert both.returncode == 3
    for words in (["--force"], ["--init", "truth"]):
        idle = imutool("clean", "spoiled.mcap", *words, cwd=folder)
        assert (idle.returncode, f"{words[0]} needs OUT" in idle.stderr) == (3, True)


def test_findings_in_the_metadata_are_bounded(folder: Path, tmp_path: Path) -> None:
    made = messages(folder / "whole.mcap")
    rows = list(range(100, 4900, 10))
    write_log(with_values(made, rows, 0, np.nan), tmp_path / "many.mcap")
    record = survey(tmp_path / "many.mcap").record()
    assert sum(map(len, record.values())) < 20_000
    wide = with_values(made, list(range(100, 4900, 70)), 0, np.nan)
    write_log(wide, tmp_path / "wide.mcap")
    (one,) = json.loads(survey(tmp_path / "wide.mcap").record()["findings"])
    assert len(one["intervals_ns"]) + one["intervals_left_out"] == one["count"]
