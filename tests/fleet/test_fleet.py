"""Fleets on Ray, from their first log to their last: killed at any moment and begun again, each output is whole or absent."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from imutool.cleaning import CleaningSettings
from imutool.cli import load
from imutool.debiasing import debias
from imutool.errors import ConfigError
from imutool.fleet.engine import Engine
from imutool.fleet.journal import NAME
from imutool.fleet.run import Progress, run
from imutool.fleet.task import Result, Settings, Task, with_model_hash
from imutool.fleet.work import work
from imutool.location import to_location
from imutool.mcap_io.storage.source import sha256
from imutool.report import json_values

Workers = Callable[[], Engine]
SOON_S = 60.0
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


def never() -> Engine:
    raise AssertionError("no worker is needed")


def test_one_bad_log_stops_no_other(fleet: Path, engine: Workers, settings: Settings, tmp_path: Path) -> None:
    (fleet / HOSTILE).mkdir()
    (fleet / HOSTILE / "log.mcap").write_bytes((fleet / "robot_a" / "log.mcap").read_bytes()[:60_000])
    (fleet / "robot_c").mkdir()
    (fleet / "robot_c" / "bell\a.mcap").write_bytes(b"")
    out, page = tmp_path / "out", tmp_path / "page.html"
    told: list[str] = []
    report = run(str(fleet), str(out), settings, engine, page=page, tell=lambda done, total, words: told.append(words))
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


def test_a_second_run_skips_all_and_a_changed_log_is_done_again(
    fleet: Path, engine: Workers, settings: Settings, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    run(str(fleet), str(out), settings, engine)
    before = {path: (path.stat().st_mtime_ns, path.stat().st_ino) for path in out.rglob("*.mcap")}
    with pytest.raises(ConfigError, match="`resume`"):
        run(str(fleet), str(out), settings, never)
    again = run(str(fleet), str(out), settings, engine, resume=True)
    assert dict(again.progress.statuses) == {"skipped": 2}
    assert {row["earlier"] for row in rows(out).values()} == {"ok"}
    assert {path: (path.stat().st_mtime_ns, path.stat().st_ino) for path in out.rglob("*.mcap")} == before
    shutil.copy(fleet / "robot_a" / "log.mcap", fleet / "robot_b" / "log.mcap")
    changed = run(str(fleet), str(out), settings, engine, resume=True)
    assert dict(changed.progress.statuses) == {"skipped": 1, "ok": 1}
    assert len(set(digests(out).values())) == 1


def test_somebody_elses_file_stays(fleet: Path, engine: Workers, tmp_path: Path) -> None:
    theirs = tmp_path / "out" / "robot_a" / "log.json"
    theirs.parent.mkdir(parents=True)
    theirs.write_text("theirs")
    report = run(str(fleet), str(tmp_path / "out"), INFO, engine)
    assert (theirs.read_text(), dict(report.progress.statuses)) == ("theirs", {"failed": 1, "ok": 1})
    assert "the target exists" in report.not_whole[0].error
    assert dict(run(str(fleet), str(tmp_path / "out"), INFO, engine, overwrite=True).progress.statuses) == {"ok": 2}
    assert theirs.read_text() != "theirs"


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
    with Engine(memory_bytes=1 << 60) as engine, pytest.raises(ConfigError, match=r"memory_bytes: 1073741824\.00 GiB"):
        engine.refuse_too_much()


def test_where_ray_cannot_start_the_message_says_what_to_do(monkeypatch: pytest.MonkeyPatch, ray_started: None) -> None:
    import ray

    def init(**_: object) -> None:
        raise RuntimeError("bind: Operation not permitted\nmuch more")

    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", init)
    monkeypatch.setattr(ray, "shutdown", lambda: None)  # the other tests' workers go on
    with pytest.raises(ConfigError, match=r"cannot be started on this machine \(bind: Operation not permitted\).*`address`"):
        Engine()
    with pytest.raises(ConfigError, match=r"address=127\.0\.0\.1:1: no answer"):
        Engine("127.0.0.1:1")


@pytest.mark.parametrize("library", ["ray", "pyarrow"])
def test_without_a_library_the_message_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, library: str, fleet: Path, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ConfigError, match=rf"needs {library}, which is not installed. pip install 'imutool\[fleet\]'"):
        run(str(fleet), str(tmp_path / "out"), INFO, Engine)


def test_workers_listen_on_loopback_alone(ray_started: None) -> None:
    ours = {f"socket:[{line[9]}]": line[1] for name in ("tcp", "tcp6") for line in _table(name) if line[3] == "0A"}
    heard = [ours[link] for pid in _below(os.getpid()) for link in _links(pid) if link in ours]
    assert heard
    assert {address.partition(":")[0] for address in heard} <= {"0100007F", "0000000000000000FFFF00000100007F"}


def _table(name: str) -> list[list[str]]:
    return [line.split() for line in Path("/proc/net", name).read_text().splitlines()[1:]]


def _links(pid: int) -> Iterator[str]:
    for link in Path("/proc", str(pid), "fd").iterdir():
        try:
            yield str(link.readlink())
        except FileNotFoundError:
            continue


def _below(pid: int) -> list[int]:
    """A process and all it has started, as they are now."""
    parents: dict[int, list[int]] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except (FileNotFoundError, ProcessLookupError):
            continue
        parents.setdefault(parent, []).append(int(folder.name))
    found = [pid]
    for one in found:
        found += parents.get(one, [])
    return found


def _raylet(pid: int) -> int:
    """The process of Ray below ours that gives work to workers."""
    return next(one for one in _below(pid) if b"raylet/raylet\0" in Path("/proc", str(one), "cmdline").read_bytes())


def _soon(found: Callable[[], Any]) -> Any:
    """What is found, as soon as it is."""
    end = time.monotonic() + SOON_S
    while time.monotonic() < end:
        if there := found():
            return there
        time.sleep(0.005)
    raise AssertionError("it took too long")


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
import os, re, signal, sys, time
from pathlib import Path
out, killed = Path(sys.argv[1]), 0
while not killed:
    for path in out.glob(".*.partial"):
        try:
            os.kill(int(path.name.split(".")[-3]), signal.SIGKILL)
            killed += 1
            print(path.name)
            break
        except ProcessLookupError:
            pass
    time.sleep(0.001)
"""


@pytest.mark.parametrize("retries", [3, 0], ids=["retried", "given up"])
def test_a_killed_worker_takes_its_log_alone(
    many: Path, ray_started: None, settings: Settings, tmp_path: Path, expected: dict[str, str], retries: int
) -> None:
    out = tmp_path / "out"
    killer = subprocess.Popen([sys.executable, "-c", KILLER, str(out)], stdout=subprocess.PIPE, text=True)
    try:
        report = run(str(many), str(out), settings, lambda: Engine(workers=2, memory_bytes=1 << 28, retries=retries))
        told, _ = killer.communicate(timeout=10)
    finally:
        killer.kill()
        killer.wait()
    assert told.count("partial") == 1
    statuses = dict(report.progress.statuses)
    if retries:
        assert statuses == {"ok": LOGS}
    else:
        assert statuses == {"ok": LOGS - 1, "failed": 1}
        assert "its worker died" in report.not_whole[0].error
        statuses = dict(run(str(many), str(out), settings, lambda: Engine(workers=2), resume=True).progress.statuses)
        assert statuses == {"skipped": LOGS - 1, "ok": 1}
    assert digests(out) == expected
    assert not list(out.glob(".*.partial"))


@pytest.mark.parametrize("end", ["driver", "Ray", "Ctrl-C"])
def test_a_fleet_that_is_ended_goes_on_where_it_was(
    many: Path,
    command: str,
    logs: Path,
    tmp_path: Path,
    end: str,
    engine: Workers,
    settings: Settings,
    expected: dict[str, str],
) -> None:
    out = tmp_path / "out"
    words = ["fleet", "debias", str(many), str(out), "--model", str(logs / "linear.safetensors"), "--workers", "1"]
    line = [command, *words, "--memory-per-task", "300M"]
    running = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    _soon(lambda: len(list(out.glob("*.mcap"))) >= 2)
    if end == "Ctrl-C":
        os.killpg(running.pid, signal.SIGINT)
    else:
        os.kill(running.pid if end == "driver" else _raylet(running.pid), signal.SIGKILL)
    _, said = running.communicate(timeout=SOON_S)
    codes = {"driver": {-signal.SIGKILL}, "Ray": {ConfigError.exit_code, 1}, "Ctrl-C": {130}}
    assert running.returncode in codes[end], said
    if running.returncode in (ConfigError.exit_code, 130):  # Ray, robbed of its own, may end the process before it says a word
        assert not list(out.glob(".*.partial"))
        said_so = r"interrupted\. \d of 6 done.*go on with --resume" if end == "Ctrl-C" else r"error: .*Go on with --resume\."
        assert re.search(said_so, said)
    done = len(list(out.glob("*.mcap")))
    assert done < LOGS
    kept = {path: path.stat().st_mtime_ns for path in out.glob("*.mcap")}
    with (out / NAME).open("ab") as journal:
        journal.write(b'{"line":"done","key":"to')  # as a driver does that is killed while it writes
    report = run(str(many), str(out), settings, engine, resume=True)
    assert report.progress.statuses.total() == LOGS
    assert report.progress.statuses["skipped"] >= done - 1  # the last one may not have come into the journal
    assert report.progress.exit_code == 0
    assert digests(out) == expected
    assert sum(path.stat().st_mtime_ns != before for path, before in kept.items()) <= 1
    assert not list(out.glob(".*.partial"))


def test_the_command_says_what_came_of_it(fleet: Path, tmp_path: Path, ray_started: None) -> None:
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
    assert {"out.html", "out/fleet.parquet", "out/fleet.journal/00000000.jsonl"} <= set(keys)
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
