"""What was planted in a log is an event at its time; the number of events is bounded, and what is not shown is counted."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.imu_defects import batch_of, late, repeated, with_values, without

from imutool.cleaning.survey import examine
from imutool.diagnosis_output import FINDINGS as WRITTEN
from imutool.errors import ConfigError, DataError
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.recording import Imu, Recording
from imutool.sensor.made_up_flight import flight
from imutool.viewing.model import events
from imutool.viewing.model.events import (
    FINDINGS,
    KIND_OF_RULE,
    KINDS,
    MAX_EVENTS_PER_KIND,
    MAX_TEXT_LENGTH,
    Event,
    events_within,
    finding_events,
    stop_events,
    survey_events,
    worst_error_events,
)
from imutool.viewing.model.trajectory_error import Errors


@pytest.fixture(scope="module")
def good() -> Recording:
    return flight(5, duration_s=30.0)


def found_in(batch: ImuBatch) -> tuple[list[Event], list[str]]:
    return survey_events(examine(lambda: [batch], None))


def test_every_rule_that_tells_a_time_has_a_kind_of_its_own() -> None:
    assert set(KIND_OF_RULE.values()) == set(KINDS) - {"stop", "worst", "finding"}


def test_a_good_log_has_no_event(good: Recording) -> None:
    assert found_in(batch_of(good.imu)) == ([], [])


@pytest.mark.parametrize("kind", ["gap", "out_of_order", "duplicate", "not_finite", "spike"])
def test_a_planted_defect_is_an_event_at_its_time(good: Recording, kind: str) -> None:
    batch, t_ns = batch_of(good.imu), good.imu.t_ns
    planted = {
        "gap": lambda: without(batch, slice(3000, 3200)),
        "out_of_order": lambda: late(batch, [3001], 3),
        "duplicate": lambda: repeated(batch, [3000]),
        "not_finite": lambda: with_values(batch, 3000, 0, np.nan),
        "spike": lambda: with_values(batch, 3000, 4, 500.0),
    }
    events, notes = found_in(planted[kind]())
    (event,) = events
    assert event.kind == kind
    assert notes == []
    assert int(t_ns[2995]) <= event.start_ns <= int(t_ns[3005])
    assert event.end_ns == (int(t_ns[3200]) if kind == "gap" else event.start_ns)
    assert "in the log" in event.text


def test_samples_apart_are_within_a_time_and_do_not_fill_it(good: Recording) -> None:
    """Of 16 samples at the end of their range it said that they are there for 2 s."""
    batch = batch_of(good.imu)
    for row in (3000, 3010):
        batch = with_values(batch, row, 0, np.nan)
    assert re.search(r" within 0\.05 s \(2 in the log\)", found_in(batch)[0][0].text)
    assert re.search(r" for 1\.01 s \(", found_in(without(batch_of(good.imu), slice(3000, 3200)))[0][0].text)


def test_what_is_found_without_a_time_is_a_sentence(good: Recording) -> None:
    batch = batch_of(good.imu)
    events, notes = found_in(batch._replace(gyro=np.rad2deg(batch.gyro), accel=batch.accel / 9.81))
    assert events == []
    assert any("accel" in note.lower() for note in notes)


def test_stops_are_where_the_body_stands(good: Recording) -> None:
    (stop,) = stop_events(good.imu)
    start_ns = int(good.imu.t_ns[0])
    assert stop.kind == "stop"
    assert stop.start_ns == start_ns
    assert (stop.end_ns - start_ns) * 1e-9 == pytest.approx(3.0, abs=1.0)  # still_s of the flight, which sets off gently
    assert stop_events(Imu(good.imu.t_ns[:1], good.imu.gyro[:1], good.imu.accel[:1])) == []


def test_the_worst_moment_is_that_of_the_largest_error_and_holes_are_none() -> None:
    t_ns = np.arange(5, dtype=np.int64) * 1000
    error = np.zeros((5, 3))
    error[3, 0], error[1, 2] = -7.0, 12_345.0
    hole = np.full((5, 3), np.nan)
    orientation, position = error.copy(), error.copy()
    orientation[1] = np.nan
    worst = list(worst_error_events("a model", Errors(t_ns, orientation, orientation, position)))
    assert [(event.kind, event.start_ns, event.end_ns) for event in worst] == [("worst", 3000, 3000), ("worst", 1000, 1000)]
    assert worst[0].text == "a model: largest orientation error, 7 deg"
    assert worst[1].text == "a model: largest position error, 12345 m"
    assert list(worst_error_events("none", Errors(t_ns, hole, hole, hole))) == []


def test_of_too_many_the_longest_are_kept_and_the_rest_counted() -> None:
    gaps = [Event("gap", 1000 * k, 1000 * k + k, "gap") for k in range(MAX_EVENTS_PER_KIND + 40)]
    kept, notes = events_within([Event("stop", 0, 10, "still"), *gaps], 0, 10**9)
    assert len(kept) == MAX_EVENTS_PER_KIND + 1
    assert min(event.end_ns - event.start_ns for event in kept if event.kind == "gap") == 40
    assert [event.start_ns for event in kept] == sorted(event.start_ns for event in kept)
    assert len(notes) == 1
    assert "40 are not" in notes[0]


def test_events_end_with_the_log_and_another_century_is_only_counted() -> None:
    events = [
        Event("gap", 50, 150, "at the start"),
        Event("gap", 900, 2000, "at the end"),
        Event("out_of_order", 4 * 10**18, 4 * 10**18, "in 2096"),
        Event("spike", 500, 500, "x" * 10_000),
    ]
    kept, notes = events_within(events, 100, 1000)
    assert [(event.start_ns, event.end_ns) for event in kept] == [(100, 150), (500, 500), (900, 1000)]
    assert len(kept[1].text) == MAX_TEXT_LENGTH
    assert notes == ("Events of kind out of order: 1 outside the log, not shown.",)


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


def test_findings_of_another_log_of_the_same_file_name_stay_there(tmp_path: Path) -> None:
    real = ["a/drive.mcap", "b/drive.mcap"]
    located = [{"signal": "gyro", "axes": [], "intervals_s": [], "regime": log, "share": None, "log": log} for log in real]
    events, notes = finding_events(folder(tmp_path, real=real, located=located), real[1], START_NS, END_NS)
    assert ([event.text.split(":")[0] for event in events], notes) == (["gyro, b/drive.mcap"], [])


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
    monkeypatch.setattr(events, "MAX_BYTES", 100)
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
