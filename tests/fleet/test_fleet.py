"""Fleets, from their first log to their last: killed at any moment and begun again, each output is whole or absent."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from support.processes import SOON_S, below, lives, soon
from typer.testing import CliRunner

from imutool.cleaning import CleaningSettings
from imutool.cli import load
from imutool.cli.fleet import debias as debias_words
from imutool.debiasing import debias
from imutool.errors import ConfigError
from imutool.file_location import to_location
from imutool.fleet import engine as engines
from imutool.fleet.engine import Engine, ProcessEngine, RayEngine
from imutool.fleet.journal import NAME
from imutool.fleet.one_log import work
from imutool.fleet.run import Progress, run
from imutool.fleet.task import Result, Settings, Task, with_model_hash
from imutool.mcap_io.storage.source import sha256
from imutool.processes import system
from imutool.report import json_values

Workers = Callable[[], Engine]
HOSTILE = "robot <script>alert(1)<"  # a folder may be called so
INFO = Settings(command="info")
LOGS = 6  # of a fleet that is killed


@pytest.fixture
def settings(logs: Path) -> Settings:
    return with_model_hash(Settings(command="debias", model=str(logs / "linear.safetensors")))


def rows(out: Path) -> dict[str, dict[str, Any]]:
    return {Path(row["source"]).parent.name: row for row in pq.read_table(out / "fleet.parquet").to_pylist()}


def digests(out: Path) -> dict[str, str]:
    return {str(path.relative_to(out)): sha256(path) for path in sorted(out.rglob("*.mcap"))}


class Idle(ProcessEngine):
    """Workers that start and have nothing to do."""

    def run(self, *_: object, **__: object) -> Generator[Result]:
        raise AssertionError("no worker is needed")


def never() -> Engine:
    raise AssertionError("no worker is needed")


def test_one_bad_log_stops_no_other(fleet: Path, engine: Workers, settings: Settings, tmp_path: Path) -> None:
    (fleet / HOSTILE).mkdir()
    (fleet / HOSTILE / "log.mcap").write_bytes((fleet / "robot_a" / "log.mcap").read_bytes()[:60_000])
    (fleet / "robot_c").mkdir()
    (fleet / "robot_c" / "bell\a.mcap").write_bytes(b"")
    out, page = tmp_path / "out", tmp_path / "page.html"
    told: list[str] = []
    words: dict[str, Any] = {"tell": lambda done, total, words: told.append(words), "wording": str.upper}
    report = run(str(fleet), str(out), settings, engine, page=page, **words)
    assert report.progress.exit_code == 5
    assert dict(report.progress.statuses) == {"ok": 2, "failed": 2}
    found = rows(out)
    assert {name: row["status"] for name, row in found.items()} == {
        "robot_a": "ok",
        "robot_b": "ok",
        HOSTILE: "failed",
        "robot_c": "failed",
    }
    assert "nothing in it can be saved" in found[HOSTILE]["error"]
    assert len(found["robot_a"]["biases"][0]["gyro_rad_s"]) == 3
    assert sorted(digests(out)) == ["robot_a/log.mcap", "robot_b/log.mcap"]
    assert found["robot_b"]["target_sha256"] == digests(out)["robot_b/log.mcap"]
    assert any("running" in words for words in told)
    html = page.read_text()
    assert "<script" not in html
    assert "robot &lt;script&gt;alert(1)&lt;" in html
    assert "Of 4 logs 2 are whole; 2 failed." in html
    assert "NOTHING IN IT CAN BE SAVED" in html  # the command line's wording, as on the terminal
    _Whole().feed(html)
    assert json.dumps(json_values(report.summary()), allow_nan=False)


class _Whole(HTMLParser):
    """Every element of a page is closed, and none asks for anything from elsewhere."""

    VOID = ("meta", "br", "use", "path", "rect", "link")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert not [
            value for name, value in attrs if name in {"src", "href", "xlink:href"} and not (value or "").startswith("#")
        ]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.VOID:
            assert self.open.pop() == tag


def test_a_second_run_skips_all_and_a_changed_log_is_done_again(fleet: Path, settings: Settings, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(str(fleet), str(out), settings, Inline)
    before = {path: (path.stat().st_mtime_ns, path.stat().st_ino) for path in out.rglob("*.mcap")}
    with pytest.raises(ConfigError, match="`resume`"):
        run(str(fleet), str(out), settings, Idle)
    again = run(str(fleet), str(out), settings, Inline, resume=True)
    assert dict(again.progress.statuses) == {"skipped": 2}
    assert {row["earlier"] for row in rows(out).values()} == {"ok"}
    assert {path: (path.stat().st_mtime_ns, path.stat().st_ino) for path in out.rglob("*.mcap")} == before
    shutil.copy(fleet / "robot_a" / "log.mcap", fleet / "robot_b" / "log.mcap")
    changed = run(str(fleet), str(out), settings, Inline, resume=True)
    assert dict(changed.progress.statuses) == {"skipped": 1, "ok": 1}
    assert len(set(digests(out).values())) == 1


def test_a_run_that_begins_anew_and_is_interrupted_leaves_no_table_of_the_one_before(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    run(str(fleet), str(out), INFO, Inline)
    assert rows(out)

    def interrupted(*_: object) -> Iterator[Result]:
        raise KeyboardInterrupt

    monkeypatch.setattr(Inline, "run", interrupted)
    for words in ({"resume": True}, {"overwrite": True}):
        with pytest.raises(KeyboardInterrupt):
            run(str(fleet), str(out), INFO, Inline, **words)
        assert (out / "fleet.parquet").exists() == ("resume" in words)


def test_somebody_elses_file_stays(fleet: Path, tmp_path: Path) -> None:
    theirs = tmp_path / "out" / "robot_a" / "log.json"
    theirs.parent.mkdir(parents=True)
    theirs.write_text("theirs")
    report = run(str(fleet), str(tmp_path / "out"), INFO, Inline)
    assert (theirs.read_text(), dict(report.progress.statuses)) == ("theirs", {"failed": 1, "ok": 1})
    assert "the target exists" in report.not_whole[0].error
    assert dict(run(str(fleet), str(tmp_path / "out"), INFO, Inline, overwrite=True).progress.statuses) == {"ok": 2}
    assert theirs.read_text() != "theirs"


def test_a_target_of_which_every_note_was_hit_is_kept_and_with_overwrite_it_alone_is_done_again(
    fleet: Path, tmp_path: Path
) -> None:
    """Nothing says any more that the fleet wrote it; `resume` with `overwrite` goes on all the same."""
    out = tmp_path / "out"
    run(str(fleet), str(out), INFO, Inline)
    journal, before = out / NAME, sorted((path, path.read_bytes()) for path in out.rglob("*.json"))
    journal.write_bytes(journal.read_bytes().replace(b"robot_a", b"r\0b\0t_a"))
    kept = run(str(fleet), str(out), INFO, Inline, resume=True)
    assert dict(kept.progress.statuses) == {"failed": 1, "skipped": 1}
    assert "robot_a/log.json: the target exists" in kept.not_whole[0].error
    again = run(str(fleet), str(out), INFO, Inline, resume=True, overwrite=True)
    assert dict(again.progress.statuses) == {"ok": 1, "skipped": 1}
    assert sorted((path, path.read_bytes()) for path in out.rglob("*.json")) == before


@pytest.mark.parametrize("name", ["fleet.parquet", "fleet.json", "page.html"])
def test_a_table_or_page_that_no_fleet_wrote_stays(fleet: Path, tmp_path: Path, name: str) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / name).write_text("theirs")
    with pytest.raises(ConfigError, match=f"{name}: the target exists"):
        run(str(fleet), str(out), INFO, never, resume=True, page=out / "page.html")
    assert [(path.name, path.read_text()) for path in out.iterdir()] == [(name, "theirs")]


def test_without_a_log_nothing_is_begun(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match=r"no \.mcap log"):
        run(str(tmp_path / "empty"), str(tmp_path / "out"), INFO, never)
    assert not (tmp_path / "out").exists()


def test_more_memory_than_there_is_is_refused(ray_started: None) -> None:
    for engine in (ProcessEngine, lambda **limits: RayEngine("auto", **limits)):
        with pytest.raises(ConfigError, match=r"memory_bytes: 1073741824\.00 GiB"):
            engine(memory_bytes=1 << 60)


def test_there_are_as_many_workers_as_there_is_memory_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    limit = tmp_path / "memory.max"
    limit.write_text(f"{3 << 30}\n")
    monkeypatch.setattr(system, "CGROUP_LIMITS", (str(limit),))
    assert ProcessEngine(workers=8, memory_bytes=1 << 30).workers == 3
    assert ProcessEngine(workers=2, memory_bytes=1 << 30).workers == 2
    with pytest.raises(ConfigError, match=r"at most 3\.00 GiB"):
        ProcessEngine(memory_bytes=4 << 30)


def test_a_cluster_that_cannot_be_reached_is_told_without_its_secrets(
    monkeypatch: pytest.MonkeyPatch, ray_started: None, fleet: Path, tmp_path: Path
) -> None:
    import ray

    def init(address: str, **_: object) -> None:
        raise ConnectionAbortedError(f"grpc: {address}\nmuch more")

    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", init)
    monkeypatch.setattr(ray, "shutdown", lambda: None)  # the other tests' cluster goes on
    with pytest.raises(ConfigError, match=r"cannot be reached at auto \(grpc: auto\).*`address`"):
        RayEngine("auto")
    for address in ("ray://me:hush@127.0.0.1:1", "127.0.0.1:1"):
        with pytest.raises(ConfigError, match=r"address=.*127\.0\.0\.1:1: nothing answers") as error:
            run(str(fleet), str(tmp_path / "out"), INFO, partial(RayEngine, address))
        assert "hush" not in str(error.value)
        assert not (tmp_path / "out").exists()  # nothing to resume, and nothing to overwrite


def test_a_port_where_something_else_listens_is_refused_in_time(monkeypatch: pytest.MonkeyPatch, ray_started: None) -> None:
    import ray

    own = ray.get_runtime_context().gcs_address
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", lambda **_: None)
    monkeypatch.setattr(engines, "ANSWER_S", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        began = time.monotonic()
        with pytest.raises(ConfigError, match=r"nothing answers \(timed out\).*expected a Ray cluster"):
            RayEngine(f"127.0.0.1:{silent.getsockname()[1]}")
        assert time.monotonic() - began < SOON_S
    engine = RayEngine(own)  # a cluster's own port answers as it should
    assert engine.slots >= 1


@pytest.mark.parametrize("library", ["ray", "pyarrow"])
def test_without_a_library_the_message_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, library: str, fleet: Path, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ConfigError, match=rf"needs {library}, which is not .*: pip install 'imutool\[fleet\]'"):
        run(str(fleet), str(tmp_path / "out"), INFO, lambda: RayEngine("auto"))


def test_a_library_that_pages_need_is_named_with_their_option(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ConfigError, match="pages: matplotlib is not installed"):
        debias_words(pages=True)


def test_a_fleet_on_this_machine_opens_no_port(many: Path, engine: Workers, tmp_path: Path) -> None:
    listening: set[str] = set()
    before = set(below(os.getpid()))  # a cluster of other tests listens

    def look(done: int, total: int, words: str) -> None:
        ours = {f"socket:[{line[9]}]" for name in ("tcp", "tcp6") for line in _table(name) if line[3] == "0A"}
        listening.update(ours.intersection(link for pid in {*below(os.getpid())} - before for link in _links(pid)))

    run(str(many), str(tmp_path / "out"), INFO, engine, tell=look)
    assert listening == set()


def _table(name: str) -> list[list[str]]:
    return [line.split() for line in Path("/proc/net", name).read_text().splitlines()[1:]]


def _links(pid: int) -> Iterator[str]:
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        for link in Path("/proc", str(pid), "fd").iterdir():
            with contextlib.suppress(FileNotFoundError):
                yield str(link.readlink())


def test_a_cluster_makes_the_same_of_logs_as_this_machine(
    many: Path, ray_started: None, settings: Settings, tmp_path: Path, expected: dict[str, str]
) -> None:
    (many / "bad.mcap").write_bytes(b"no log")
    report = run(str(many), str(tmp_path / "out"), settings, lambda: RayEngine("auto", memory_bytes=1 << 28))
    assert dict(report.progress.statuses) == {"ok": LOGS, "failed": 1}
    assert digests(tmp_path / "out") == expected


@pytest.fixture
def many(tmp_path: Path, logs: Path) -> Path:
    """A fleet large enough to be killed in the middle."""
    folder = tmp_path / "many"
    folder.mkdir()
    for k in range(LOGS):
        shutil.copy(logs / f"flight_{1 + k % 2}.mcap", folder / f"log_{k}.mcap")
    return folder


@pytest.fixture(scope="module")
def expected(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What becomes of those logs, made one by one."""
    folder = tmp_path_factory.mktemp("expected")
    for k in range(LOGS):
        source = folder / "in" / f"log_{k}.mcap"
        source.parent.mkdir(exist_ok=True)
        shutil.copy(logs / f"flight_{1 + k % 2}.mcap", source)
        debias(source, folder / source.name, model=logs / "linear.safetensors", clean=CleaningSettings())
    return {path.name: sha256(path) for path in folder.glob("*.mcap")}


KILLER = """
import os, signal, sys, time
from pathlib import Path
out, killed = Path(sys.argv[1]), set()
while len(killed) < int(sys.argv[2]):
    for path in out.glob(".*.partial"):
        try:
            pid = int(path.name.split(".")[-3])
            if pid not in killed:
                os.kill(pid, signal.SIGKILL)
                killed.add(pid)
                print(path.name.split(".")[1])
                break
        except ProcessLookupError:
            pass
    time.sleep(0.001)
"""


@pytest.mark.parametrize("workers", [2, 1], ids=["with another", "alone"])
def test_a_killed_worker_takes_its_log_alone(
    many: Path, settings: Settings, tmp_path: Path, expected: dict[str, str], workers: int
) -> None:
    """Where another log may be the cause it costs no retry; where none can be, the log is given up after the last."""
    out = tmp_path / "out"
    killer = subprocess.Popen([sys.executable, "-c", KILLER, str(out), "1"], stdout=subprocess.PIPE, text=True)
    try:
        report = run(str(many), str(out), settings, lambda: ProcessEngine(workers=workers, retries=0))
        told, _ = killer.communicate(timeout=10)
    finally:
        killer.kill()
        killer.wait()
    assert told.startswith("log_")
    assert not list(out.glob(".*.partial"))
    statuses = dict(report.progress.statuses)
    if workers == 1:
        assert statuses == {"ok": LOGS - 1, "failed": 1}
        assert "its worker died, also where it ran alone (Killed)" in report.not_whole[0].error
        again = run(str(many), str(out), settings, Inline, resume=True)
        assert dict(again.progress.statuses) == {"skipped": LOGS - 1, "ok": 1}
    else:
        assert statuses == {"ok": LOGS}
    assert digests(out) == expected


ENDS = {
    "driver": (signal.SIGKILL, -signal.SIGKILL, ""),
    "terminated": (signal.SIGTERM, 143, "ended by SIGTERM"),
    "terminal closed": (signal.SIGHUP, 129, "ended by SIGHUP"),
    "Ctrl-C": (signal.SIGINT, 130, "interrupted"),
}
LEFT_S = 2.0


@pytest.mark.parametrize("end", ENDS)
def test_a_fleet_that_is_ended_goes_on_where_it_was(
    many: Path,
    command: str,
    logs: Path,
    tmp_path: Path,
    end: str,
    settings: Settings,
    expected: dict[str, str],
) -> None:
    out = tmp_path / "out"
    words = ["fleet", "debias", str(many), str(out), "--model", str(logs / "linear.safetensors"), "--workers", "1"]
    line = [command, *words, "--memory-per-task", "300M"]
    nohup = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests may run under it
    running = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    signal.signal(signal.SIGHUP, nohup)
    soon(lambda: len(list(out.glob("*.mcap"))) >= 2)
    family, began = below(running.pid), time.monotonic()
    assert len(family) == 2
    number, code, how = ENDS[end]
    running.send_signal(number)
    soon(lambda: not any(lives(pid) for pid in family[1:]))
    assert time.monotonic() - began < LEFT_S
    _, said = running.communicate(timeout=SOON_S)
    assert running.returncode == code, said
    assert re.search(rf"error: {how}\. \d of 6 done.*go on with --resume\.\n$" if how else "^$", said)
    if end != "driver":
        assert not list(out.glob(".*.partial"))
    done = len(list(out.glob("*.mcap")))
    assert done < LOGS
    kept = {path: path.stat().st_mtime_ns for path in out.glob("*.mcap")}
    with (out / NAME).open("ab") as journal:
        journal.write(b'{"line":"done","key":"to')  # as a driver does that is killed while it writes
    report = run(str(many), str(out), settings, Inline, resume=True)
    assert report.progress.statuses.total() == LOGS
    assert report.progress.statuses["skipped"] >= done - 1  # the last one may not have come into the journal
    assert report.progress.exit_code == 0
    assert digests(out) == expected
    assert sum(path.stat().st_mtime_ns != before for path, before in kept.items()) <= 1
    assert not list(out.glob(".*.partial"))


def test_the_command_says_what_came_of_it(fleet: Path, tmp_path: Path) -> None:
    (fleet / "bad.mcap").write_bytes(b"no log")
    words = ["fleet", "info", str(fleet), str(tmp_path / "out"), "--report", str(tmp_path / "page.html"), "-q"]
    done = CliRunner().invoke(load(), words)
    assert done.exit_code == 5
    assert "failed" in done.stdout
    assert str(fleet / "bad.mcap") in done.stdout
    assert (tmp_path / "page.html").is_file()
    done = CliRunner().invoke(load(), [*words, "--resume", "--json", "-"])
    report = json.loads(done.stdout)
    assert (report["schema"], report["statuses"]) == ("imutool.fleet/1", {"failed": 1, "skipped": 2})
    assert report["not_whole"][0]["source"] == str(fleet / "bad.mcap")


def test_a_page_that_cannot_be_written_hides_nothing_that_was_done(fleet: Path, tmp_path: Path) -> None:
    (fleet / "bad.mcap").write_bytes(b"no log")
    words = ["fleet", "info", str(fleet), str(tmp_path / "out"), "--report", "/proc/page.html"]  # root makes no file there
    done = CliRunner().invoke(load(), [*words, "--json", str(tmp_path / "fleet.json")])
    assert done.exit_code == 3
    assert f"{fleet / 'bad.mcap'}: " in done.stdout
    assert "2 of 3 done, 1 failed" in done.stdout
    assert "page.html" not in done.stdout
    assert re.search(r"/proc/page.html: cannot be written .*, and go on with --resume", done.stderr)
    assert json.loads((tmp_path / "fleet.json").read_text())["logs"] == 3


def test_a_path_that_is_no_utf_8_is_told(fleet: Path, tmp_path: Path) -> None:
    odd = tmp_path / os.fsdecode(b"\xff")
    odd.symlink_to(fleet)
    for source, settings in ((odd, INFO), (fleet, Settings(command="diagnose", sim=str(odd)))):
        with pytest.raises(ConfigError, match="are no UTF-8"):
            run(str(source), str(tmp_path / "out"), settings, Inline)
    assert not list((tmp_path / "out").rglob("*.json"))


@pytest.mark.parametrize(
    ("words", "code", "why"),
    [
        (["--memory-per-task", "much"], 3, "'much' is not a size"),
        (["--model", "none"], 6, "no model 'none'"),
        (["--smooth", "--init", "prior"], 3, "--smooth with --init prior"),
    ],
    ids=["memory", "model", "smooth"],
)
def test_a_wrong_word_is_told_before_anything_is_begun(
    fleet: Path, tmp_path: Path, words: list[str], code: int, why: str
) -> None:
    done = CliRunner().invoke(load(), ["fleet", "debias", str(fleet), str(tmp_path / "out"), *words])
    assert done.exit_code == code
    assert why in done.stderr
    assert not (tmp_path / "out").exists()


def test_an_out_that_would_be_forgotten_is_refused(fleet: Path) -> None:
    with pytest.raises(ConfigError, match="memory of one process"):
        run(str(fleet), "memory://out", Settings(command="info"), Inline)


def test_a_page_without_a_folder_is_refused_before_the_work(fleet: Path, tmp_path: Path) -> None:
    words = ["fleet", "info", str(fleet), str(tmp_path / "out"), "--report", str(tmp_path / "none" / "page.html")]
    assert CliRunner().invoke(load(), words).exit_code == ConfigError.exit_code
    assert not (tmp_path / "out").exists()


def test_page_and_report_may_lie_in_an_out_that_is_not_there_yet(fleet: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["--report", str(out / "page.html"), "--json", str(out / "report.json")]
    assert CliRunner().invoke(load(), ["fleet", "info", str(fleet), str(out), *words]).exit_code == 0
    assert {"page.html", "report.json"} <= {path.name for path in out.iterdir()}


@pytest.mark.parametrize(
    ("command", "option", "name"),
    [
        ("info", "--json", "robot_a/log.json"),
        ("debias --pages", "--report", "robot_a/log.html"),
        ("diagnose --no-search", "--json", "fleet.json"),
    ],
)
def test_the_summary_and_the_page_cannot_take_the_place_of_a_result(
    fleet: Path, tmp_path: Path, command: str, option: str, name: str
) -> None:
    """The page did; the summary was refused after all the work, and on --resume it did, too."""
    (tmp_path / "link").symlink_to(tmp_path / "out")
    (tmp_path / "out" / "robot_a").mkdir(parents=True)
    words = ["fleet", *command.split(), str(fleet), str(tmp_path / "out"), option, str(tmp_path / "link" / name)]
    done = CliRunner().invoke(load(), words)
    assert done.exit_code == ConfigError.exit_code
    assert f"{tmp_path}/out/{name}: {option} would replace a file of the fleet's own" in done.stderr
    assert not (tmp_path / "out" / NAME).exists()


def test_resume_replaces_only_the_summary_of_a_fleet(fleet: Path, tmp_path: Path) -> None:
    """It replaced any report of imutool, such as the findings of a diagnosis."""
    precious = tmp_path / "findings.json"
    precious.write_text('{\n  "schema": "imutool.diagnosis/1"')
    words = ["fleet", "info", str(fleet), str(tmp_path / "out"), "--resume", "--json", str(precious)]
    done = CliRunner().invoke(load(), words)
    assert done.exit_code == ConfigError.exit_code
    assert "findings.json: the target exists" in done.stderr
    precious.unlink()
    assert CliRunner().invoke(load(), words).exit_code == 0
    assert CliRunner().invoke(load(), words).exit_code == 0


class Inline:
    """The work done here and now: for what has nothing to do with workers."""

    def __enter__(self) -> Inline:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing was started."""

    def run(self, tasks: Iterable[Task], tick: Callable[[int], None], model: bytes | None) -> Generator[Result]:
        for task in tasks:
            tick(1)
            yield work(task, model)


def test_a_fleet_in_a_store_is_that_of_a_folder(fleet: Path, store: Any, settings: Settings, tmp_path: Path) -> None:
    for path in fleet.rglob("*.mcap"):
        store.put(f"logs/{path.relative_to(fleet)}", path.read_bytes())
    left = "out/robot_a/.log.mcap.12.0123abcd.partial"
    run("s3://fleet/logs", "s3://fleet/out", settings, Inline, page=to_location("s3://fleet/out.html"))
    store.put(left, b"half")
    again = run("s3://fleet/logs", "s3://fleet/out", settings, Inline, resume=True, recheck=True)
    assert dict(again.progress.statuses) == {"skipped": 2}
    keys = store.keys()
    assert left not in keys
    assert {"out.html", "out/fleet.parquet"} <= set(keys)
    assert any(key.startswith("out/fleet.journal/00000000") for key in keys)
    assert store.uploads() == []
    run(str(fleet), str(tmp_path / "out"), settings, Inline)
    for name in digests(tmp_path / "out"):
        assert store.get(f"out/{name}") == (tmp_path / "out" / name).read_bytes()
    assert store.secret.encode() not in b"".join(store.get(key) for key in keys if "fleet." in key)
    store.client.delete_object(Bucket="fleet", Key="out/robot_b/log.mcap")
    assert dict(run("s3://fleet/logs", "s3://fleet/out", settings, Inline, resume=True).progress.statuses) == {
        "skipped": 1,
        "ok": 1,
    }


def test_an_exit_code_tells_the_worst() -> None:
    def ended(*results: tuple[str, int, str | None]) -> int:
        progress = Progress(len(results), 0)
        for status, code, earlier in results:
            progress.add(Result(key="", source="", target="", status=status, exit_code=code, earlier=earlier))
        return progress.exit_code

    assert ended(("ok", 0, None), ("skipped", 0, "ok")) == 0
    assert ended(("ok", 0, None), ("skipped", 0, "lost")) == 3
    assert ended(("quarantined", 5, None), ("ok", 0, None)) == 3
    assert ended(("lost", 0, None), ("failed", 5, None), ("failed", 4, None)) == 5
    assert ended(("failed", 7, None), ("failed", 1, None)) == 1


def test_a_warning_of_a_task_does_not_reach_the_terminal(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Without any handler `logging` says that there is none."""
    alone = logging.getLogger("alone")
    monkeypatch.setattr(alone, "propagate", False)
    monkeypatch.setattr(logging, "lastResort", logging.lastResort)
    monkeypatch.setattr(engines, "work", lambda task, model: alone.warning("accel reads 11.5"))
    with warnings.catch_warnings():
        engines._work_quietly(None, None)  # type: ignore[arg-type]  # the task is not looked at
    assert capfd.readouterr().err == ""
