"""A diagnosis is marked where it acts, in the log it is of; a file that is none is refused with its name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from imutool.diagnosis_output import FINDINGS as WRITTEN
from imutool.errors import ConfigError, DataError
from imutool.viewing.model import findings
from imutool.viewing.model.events import MAX_EVENTS_PER_KIND
from imutool.viewing.model.findings import FINDINGS, finding_events

START_NS, END_NS = 1_700_000_000_000_000_000, 1_700_000_060_000_000_000
DIAGNOSIS: dict[str, Any] = {
    "schema": "imutool.diagnosis/1",
    "real": ["/somewhere/else/drive.mcap", "second.mcap"],
    "sim": None,
    "mismatch": True,
    "located": [
        {"signal": "accel", "axes": ["x", "y"], "intervals_s": [[12.0, 48.5], [50, 51]], "regime": "fast", "share": 0.83},
        {"signal": "gyro", "axes": ["z"], "intervals_s": [], "regime": "", "share": None, "p_value": 0.0},
    ],
    "findings": [
        {"effect": "lever_arm", "signal": "accel", "share": 0.7},
        {"effect": "driven", "signal": "both", "driver": "/motor.data"},
    ],
}


def folder(at: Path, **changes: object) -> Path:
    (at / FINDINGS).write_text(json.dumps(DIAGNOSIS | changes))
    return at


def test_the_file_is_the_one_that_is_written() -> None:
    assert FINDINGS == WRITTEN


def test_findings_act_where_they_were_located(tmp_path: Path) -> None:
    events, notes = finding_events(folder(tmp_path), "drive.mcap", START_NS, END_NS)
    assert notes == []
    assert {event.kind for event in events} == {"finding"}
    assert [(event.start_ns - START_NS, event.end_ns - START_NS) for event in events] == [
        (12_000_000_000, 48_500_000_000),
        (50_000_000_000, 51_000_000_000),
        (0, 60_000_000_000),  # no interval: everywhere
    ]
    assert events[0].text == "accel x, y, fast, 83 % of its misfit: lever_arm, driven (/motor.data)"
    assert events[2].text == "gyro z: driven (/motor.data)"


def test_findings_without_a_place_are_told(tmp_path: Path) -> None:
    events, notes = finding_events(folder(tmp_path, located=[]), "drive.mcap", START_NS, END_NS)
    assert events == []
    assert [note.split(",")[0] for note in notes] == ["Diagnosis: lever_arm on accel", "Diagnosis: driven on both"]


@pytest.mark.parametrize("log", ["second.mcap", "other.mcap"])
def test_another_log_than_the_first_is_not_marked_and_says_so(tmp_path: Path, log: str) -> None:
    events, notes = finding_events(folder(tmp_path), log, START_NS, END_NS)
    assert events == []
    assert "drive.mcap" in notes[0]
    assert log in notes[0]


HOSTILE = {
    "empty": b"",
    "no JSON": b"not json",
    "not text": b"\xff\xfe\x00",
    "a list": b"[" * 100_000,
    "another schema": b'{"schema": "imutool.evaluation/1", "real": []}',
    "no log": b'{"schema": "imutool.diagnosis/1"}',
    "nested": b'{"schema": "imutool.diagnosis/1", "real": [], "x": ' + b"[" * 100_000 + b"]" * 100_000 + b"}",
    "infinite": b'{"schema": "imutool.diagnosis/1", "real": [], "located": [{"signal": "a", "intervals_s": [[0, 1e999]]}]}',
    "eternal": b'{"schema": "imutool.diagnosis/1", "real": [], "located": [{"signal": "a", "intervals_s": [[0, 1e300]]}]}',
    "a half interval": b'{"schema": "imutool.diagnosis/1", "real": [], "located": [{"signal": "a", "intervals_s": [[1]]}]}',
}


@pytest.mark.parametrize("content", HOSTILE.values(), ids=HOSTILE.keys())
def test_what_is_no_diagnosis_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / FINDINGS).write_bytes(content)
    with pytest.raises(DataError, match="findings"):
        finding_events(tmp_path, "drive.mcap", START_NS, END_NS)


def test_a_huge_file_is_refused_before_it_is_understood(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(findings, "MAX_BYTES", 100)
    with pytest.raises(DataError, match="longer than 100 bytes"):
        finding_events(folder(tmp_path), "drive.mcap", START_NS, END_NS)


def test_a_folder_without_one_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="diagnose -o"):
        finding_events(tmp_path / "nowhere", "drive.mcap", START_NS, END_NS)


def test_thousands_of_stretches_are_bounded(tmp_path: Path) -> None:
    place = {"signal": "gyro", "intervals_s": [[k * 1e-3, k * 1e-3] for k in range(5000)]}
    events, notes = finding_events(folder(tmp_path, located=[place]), "drive.mcap", START_NS, END_NS)
    assert len(events) == MAX_EVENTS_PER_KIND
    assert notes[0].endswith(f"{5000 - MAX_EVENTS_PER_KIND} shorter stretches are not marked.")
