"""The journal knows what is done, however it was cut off; nobody overwrites another's results by it."""

from __future__ import annotations

import os
import platform
import re
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imutool.errors import ConfigError
from imutool.file_location import Location, to_location
from imutool.fleet import journal as journals
from imutool.fleet.journal import NAME, Journal
from imutool.fleet.task import Result, Settings, Source

SETTINGS = Settings(command="debias", model="m", model_sha256="1")
OTHER = msgspec.structs.replace(SETTINGS, init="prior")


def result(key: str, **changes: Any) -> Result:
    return Result(key=key, source=f"/logs/{key}.mcap", target=f"{key}.mcap", status="ok", **changes)


def fill(out: Location, *keys: str) -> None:
    with Journal(out, SETTINGS) as journal:
        for key in keys:
            journal.begin(key, f"{key}.mcap")
            journal.finish(result(key, messages=7))


def test_what_was_finished_is_known_to_the_next_run(tmp_path: Path) -> None:
    fill(tmp_path, "a", "b")
    with Journal(tmp_path, SETTINGS, resume=True) as journal:
        assert journal.done("a") == result("a", messages=7)
        assert journal.done("c") is None
        assert journal.ours("b.mcap")
        assert not journal.ours("c.mcap")
        journal.finish(result("a", messages=8))
        assert journal.done("a") == result("a", messages=8)


def test_a_file_is_no_folder_of_a_fleet(tmp_path: Path) -> None:
    (out := tmp_path / "out").touch()
    with pytest.raises(ConfigError, match=f"^{re.escape(str(out))}: cannot be written .*; expected a folder as OUT"):
        fill(out, "a")


def test_a_journal_that_cannot_be_opened_is_named(tmp_path: Path) -> None:
    """As one that another user wrote, in a folder that all may write to."""
    (tmp_path / NAME).mkdir()
    with pytest.raises(ConfigError, match=f"^{re.escape(str(tmp_path / NAME))}: cannot be written"):
        fill(tmp_path, "a")


def test_a_full_disk_is_told_with_the_journal_and_what_to_do(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    told = re.escape(f"{tmp_path / NAME}: cannot be written (File too large). Make room, and go on with `resume`")
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4000, before[1]))
        with pytest.raises(ConfigError, match=told):
            fill(tmp_path, *map(str, range(100)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (tmp_path / NAME).read_bytes().endswith(b"}\n")
    with Journal(tmp_path, SETTINGS, resume=True) as journal:
        assert journal.ours("0.mcap")


def test_a_folder_that_is_moved_away_ends_the_run(tmp_path: Path) -> None:
    """The workers made it anew, and the run ended well with half of its logs elsewhere."""
    with Journal(tmp_path / "out", SETTINGS) as journal:
        journal.begin("a", "a.mcap")
        (tmp_path / "out").rename(tmp_path / "moved")
        (tmp_path / "out").mkdir()
        with pytest.raises(ConfigError, match="is gone: OUT was moved or removed"):
            journal.finish(result("a"))


def test_cut_off_anywhere_the_journal_knows_all_whole_lines(tmp_path: Path) -> None:
    fill(tmp_path, "a", "b")
    whole = (tmp_path / NAME).read_bytes()
    first, last = whole.index(b'"messages":7') + 1, len(whole)
    second = whole.index(b"\n", whole.index(b'"messages":7', first))  # the end of the line, without which it is whole
    ends = [at + k for at, byte in enumerate(whole, 1) if byte == 10 for k in (-1, 0, 1)]
    for cut in sorted({*range(whole.index(b"\n") + 1, last, 23), *(at for at in ends if at <= last)} - {*range(ends[1])}):
        (tmp_path / NAME).write_bytes(whole[:cut])
        with Journal(tmp_path, SETTINGS, resume=True) as journal:
            known = [key for key in "ab" if journal.done(key)]
            assert known == (["a", "b"] if cut >= second else ["a"] if cut >= whole.index(b"\n", first) else [])
            journal.finish(result("c"))
        with Journal(tmp_path, SETTINGS, resume=True) as journal:
            assert journal.done("c") == result("c")


def test_a_line_that_cannot_be_read_costs_that_log_alone(tmp_path: Path) -> None:
    fill(tmp_path, "a", "b")
    lines = (tmp_path / NAME).read_bytes().splitlines(keepends=True)
    lines[2] = b"\x00" * 40 + b"\n"
    (tmp_path / NAME).write_bytes(b"".join(lines))
    with Journal(tmp_path, SETTINGS, resume=True) as journal:
        assert (journal.done("a"), journal.done("b")) == (None, result("b", messages=7))
        assert journal.ours("a.mcap")


KEYS = [f"log_{k:02d}" for k in range(80)]


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the journal of 80 finished logs."""
    folder = tmp_path_factory.mktemp("journal")
    fill(folder, *KEYS)
    (folder / "whole").write_bytes((folder / NAME).read_bytes())
    return folder


@given(at=st.integers(0, 10**6), at_end=st.booleans(), size=st.sampled_from([1, 2, 40, 900, 5000]), new=st.binary(min_size=1))
@settings(max_examples=80, deadline=None)
def test_after_random_bytes_only_what_they_hit_is_done_again(
    filled: Path, at: int, at_end: bool, size: int, new: bytes
) -> None:
    """Anywhere, of any length, also over the ends of lines and over the line that says with which settings it was begun."""
    whole = (filled / "whole").read_bytes()
    ends = [at for at, byte in enumerate(whole) if byte == 10]
    raw, at = bytearray(whole), ends[at % len(ends)] if at_end else at % len(whole)
    raw[at : at + size] = (new * size)[: min(size, len(raw) - at)]
    (filled / NAME).write_bytes(raw)
    changed = [k for k in range(at, min(at + size, len(whole))) if raw[k] != whole[k]]
    spared = set()
    with Journal(filled, SETTINGS, resume=True) as journal:
        for key in KEYS:
            line = whole.index(b'{"line":"done","key":"%s"' % key.encode())
            if not any(line <= k < whole.index(b"\n", line) for k in changed):
                spared.add(key)
        assert {key for key in KEYS if journal.done(key) == result(key, messages=7)} == spared
        assert {key for key in KEYS if journal.done(key)} == spared
        if at + size < ends[-2]:  # else the last note that a target is ours goes as well
            near = size > 2000  # a hole that takes both notes of a target, 32 logs apart
            assert near or all(journal.ours(f"{key}.mcap") for key in KEYS)


def test_a_changed_digit_in_a_line_is_seen(tmp_path: Path) -> None:
    fill(tmp_path, "a", "b")
    (tmp_path / NAME).write_bytes((tmp_path / NAME).read_bytes().replace(b'"messages":7', b'"messages":8', 1))
    with Journal(tmp_path, SETTINGS, resume=True) as journal:
        assert (journal.done("a"), journal.done("b")) == (None, result("b", messages=7))


def test_a_line_that_has_lost_its_crc_does_not_count(tmp_path: Path) -> None:
    """Spaces over the CRC and the entries before it leave JSON that says something else."""
    fill(tmp_path, "a", "b")
    journal, whole = tmp_path / NAME, (tmp_path / NAME).read_bytes()
    hit = re.search(rb'"messages":7(.*?),"crc":"[0-9a-f]{8}"(?=\}\n)', whole)
    assert hit is not None
    journal.write_bytes(whole[: hit.start(1)] + b" " * (hit.end() - hit.start(1)) + whole[hit.end() :])
    with Journal(tmp_path, SETTINGS, resume=True) as read:
        assert (read.done("a"), read.done("b")) == (None, result("b", messages=7))


def test_a_run_that_has_lost_its_crc_and_the_end_of_its_digest_does_not_count(tmp_path: Path) -> None:
    fill(tmp_path, "a", "b")
    journal, whole = tmp_path / NAME, (tmp_path / NAME).read_bytes()
    begun, end = whole.index(b'"digest":"') + 30, whole.index(b'"}\n', whole.index(b'"key":"a"'))
    journal.write_bytes(whole[:begun] + "\u0080".encode() * 20 + whole[end:])
    with Journal(tmp_path, SETTINGS, resume=True) as read:
        assert read.done("b") == result("b", messages=7)


def test_without_the_line_of_its_run_the_second_note_of_targets_tells_the_settings(tmp_path: Path) -> None:
    fill(tmp_path, "a")
    lines = (tmp_path / NAME).read_bytes().splitlines(keepends=True)
    (tmp_path / NAME).write_bytes(b"".join(line for line in lines if not line.startswith(b'{"line":"run"')))
    with pytest.raises(ConfigError, match="other settings"):
        Journal(tmp_path, OTHER, resume=True)
    with Journal(tmp_path, SETTINGS, resume=True) as journal:
        assert journal.done("a") == result("a", messages=7)


def test_lines_of_an_earlier_version_count(tmp_path: Path) -> None:
    fill(tmp_path, "a")
    (tmp_path / NAME).write_bytes(re.sub(rb',"crc":"[0-9a-f]{8}"', b"", (tmp_path / NAME).read_bytes()))
    with Journal(tmp_path, SETTINGS, resume=True) as journal:
        assert journal.done("a") == result("a", messages=7)


def test_results_that_are_there_are_not_begun_anew_without_a_word(tmp_path: Path) -> None:
    fill(tmp_path, "a")
    before = (tmp_path / NAME).read_bytes()
    with pytest.raises(ConfigError, match="Go on with `resume`"):
        Journal(tmp_path, SETTINGS)
    with pytest.raises(ConfigError, match=r"other settings \(init 'auto', now 'prior'\)"):
        Journal(tmp_path, OTHER, resume=True)
    with pytest.raises(ConfigError, match=r"other settings \(another content of the model\)"):
        Journal(tmp_path, msgspec.structs.replace(SETTINGS, model_sha256="2"), resume=True)
    assert (tmp_path / NAME).read_bytes() == before


def test_overwrite_begins_anew_and_knows_its_own_targets(tmp_path: Path) -> None:
    fill(tmp_path, "a")
    with Journal(tmp_path, OTHER, overwrite=True) as journal:
        assert journal.done("a") is None
        assert journal.ours("a.mcap")
    with Journal(tmp_path, OTHER, resume=True) as journal:  # killed before it began anything
        assert journal.done("a") is None
        assert journal.ours("a.mcap")


def test_two_at_once_are_refused(tmp_path: Path) -> None:
    line = f"from imutool.fleet.journal import *; Journal(Path({str(tmp_path)!r}), Settings(command='info'), resume=True)"
    with Journal(tmp_path, SETTINGS):
        done = subprocess.run([sys.executable, "-c", line], capture_output=True, text=True, timeout=60, check=False)
    assert f"another run is at work here (process {os.getpid()} of {platform.node()})" in done.stderr


def test_a_key_is_of_the_content_the_model_and_the_settings() -> None:
    one = Source("/logs/a.mcap", "a.mcap", 5, "1")
    others = [
        one.key(OTHER),
        one.key(msgspec.structs.replace(SETTINGS, model_sha256="2")),
        msgspec.structs.replace(one, size=6).key(SETTINGS),
        msgspec.structs.replace(one, stamp="2").key(SETTINGS),
        msgspec.structs.replace(one, place="/logs/b.mcap").key(SETTINGS),
    ]
    assert len({one.key(SETTINGS), *others}) == 6
    assert msgspec.structs.replace(one, name="b/a.mcap").key(SETTINGS) == one.key(SETTINGS)


def test_in_a_store_it_lies_in_pieces(store: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journals, "PIECE_BYTES", 1000)
    out = to_location("s3://fleet/out")
    fill(out, *"abcdef")
    pieces = len(store.keys())
    assert pieces > 2
    with pytest.raises(ConfigError, match="Go on with `resume`"):
        Journal(out, SETTINGS)
    with Journal(out, SETTINGS, resume=True) as journal:
        assert journal.done("f") == result("f", messages=7)
        assert journal.ours("a.mcap")
    assert len(store.keys()) == pieces + 1
    with Journal(out, OTHER, overwrite=True) as journal:
        assert journal.done("f") is None


def test_of_two_runs_that_go_on_at_once_in_a_store_neither_loses_a_line(store: Any) -> None:
    out = to_location("s3://fleet/out")
    fill(out, "a")
    with Journal(out, SETTINGS, resume=True) as one, Journal(out, SETTINGS, resume=True) as other:
        for journal, key in ((one, "b"), (other, "c"), (one, "d")):
            journal.begin(key, f"{key}.mcap")
            journal.finish(result(key))
    with Journal(out, SETTINGS, resume=True) as journal:
        assert all(journal.done(key) is not None for key in "abcd")
        assert all(journal.ours(f"{key}.mcap") for key in "abcd")
