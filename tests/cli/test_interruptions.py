"""Every command under KILL, TERM, INT, a full disk, a locked folder, an input that changes, and two of the same at once.

After each: a message and its exit code or the system's, no traceback, inputs unchanged, and no partial file left by a run
that could still act; what KILL leaves, the next run on that target removes.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from unittest.mock import Mock

import pytest
from support.digests import digests
from support.forked import Forked
from support.processes import soon

from imutool.cli.app import _Commands, caught
from imutool.cli.demo import write_asl
from imutool.errors import ConfigError
from imutool.mcap_io.log import Log
from imutool.mcap_io.repair import repaired
from imutool.mcap_io.storage.local import MARK_PART, PARTIAL, remove_abandoned, temporary_path
from imutool.mcap_io.storage.source import Source
from imutool.mcap_io.storage.target import Target
from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight
from imutool.viewing.html import report

Run = Callable[..., subprocess.CompletedProcess[str]]

CONFIG, LOST, HUNG_UP, INTERRUPTED, TERMINATED, KILLED = 3, 3, 129, 130, 143, -signal.SIGKILL
WAIT_S, POLL_S, TRIES = 60.0, 0.002, 10
STILL_S = 0.05  # every process of a session has stood still by then
SOON_S, SLACK_S = 2.0, 3.0  # after SIGTERM, for a process and all its children; for a machine busy with other tests
DISK_BYTES = 1500  # less than any output here
BRIEF_S = 13.0  # of which three at rest
CHANGED_AT = 6  # read of the log: behind its summary, before its messages

# words of each command that writes a file, and the file; in.mcap is a log of 20 s, seq a raw sequence
WRITERS: dict[str, tuple[Sequence[str], str]] = {
    "convert": (["convert", "seq", "out.mcap"], "out.mcap"),
    "convert a log": (["convert", "in.mcap", "out.mcap"], "out.mcap"),
    "debias": (["debias", "in.mcap", "out.mcap"], "out.mcap"),
    "clean": (["clean", "in.mcap", "out.mcap"], "out.mcap"),
    "repair": (["repair", "in.mcap", "out.mcap"], "out.mcap"),
    "simulate": (["simulate", "in.mcap", "out.mcap"], "out.mcap"),
    "export": (["export", "in.mcap", "out", "--format", "rosbag2"], "out"),
    "view": (["view", "in.mcap", "--html", "out.html"], "out.html"),
    "save": (["view", "in.mcap", "--save", "out.rrd"], "out.rrd"),
    "train": (["train", "in.mcap", "--method", "linear", "-o", "out.safetensors"], "out.safetensors"),
    "trajectories": (["evaluate", "in.mcap", "--trajectories", "out"], "out"),
    "pictures": (["view", "in.mcap", "--png", "out"], "out"),
    "diagnose": (["diagnose", "in.mcap", "-o", "out", "--set", "search.rounds=1"], "out"),
    "conceal": (["conceal", "in.mcap", "out"], "out"),
    "live": (["live", "--from", "in.mcap", "--speed", "100", "--save", "out.rrd"], "out.rrd"),
}
RERUN = ("save", "live")  # their files are Rerun's: tests/test_bad_input.py


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, logs: Path) -> Path:
    folder = tmp_path_factory.mktemp("interruptions")
    write_asl(flight(3, duration_s=8.0), folder / "seq")
    shutil.copy(logs / "flight_1.mcap", folder / "in.mcap")
    return folder


@pytest.fixture
def tmp_path(on_disk: Path) -> Path:
    return on_disk


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(report, "PICTURES", report.PICTURES[:1])  # of a page: they take seconds, and come ahead of its file
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return tmp_path


@pytest.fixture
def brief(here: Path, name: str) -> Path:
    """As `here`, with logs that are quickly done: in.mcap just long enough for the command, and a shorter one."""
    write(flight(1, duration_s=0.4 * BRIEF_S, rate_hz=100.0), here / "short.mcap")
    (here / "in.mcap").unlink()
    write(flight(1, duration_s=26.0 if name == "conceal" else BRIEF_S, rate_hz=100.0), here / "in.mcap")
    return here


def partials(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if path.name.endswith(".partial")]


def installed(command: str, words: Sequence[str], cwd: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [command, *words, "-q"], cwd=cwd, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        text=True, start_new_session=True,
    )  # fmt: skip


def started(words: Sequence[str], cwd: Path) -> Forked:
    return Forked([*words, "-q"], cwd)


def stopped(process: Forked | subprocess.Popen[str], folder: Path, number: signal.Signals) -> tuple[int | None, str, float]:
    """Exit code, stderr and time to the end of a command that a signal hits while its partial file is there.

    The process stands still while this is looked at again. Code 0: the moment passed between two looks, and it ended.
    """
    deadline, hit = time.monotonic() + WAIT_S, False
    while process.poll() is None and not hit and time.monotonic() < deadline:
        if partials(folder):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGSTOP)
                time.sleep(STILL_S)
                if hit := bool(partials(folder)):
                    os.kill(process.pid, number)
                os.killpg(process.pid, signal.SIGCONT)
        time.sleep(POLL_S)
    began = time.monotonic()
    _, stderr = process.communicate(timeout=WAIT_S)
    return process.returncode, stderr, time.monotonic() - began


MOMENTS = [
    *((name, signal.SIGINT) for name in ("export", "save")),
    *((name, signal.SIGTERM) for name in ("convert", "debias", "save")),
    *((name, signal.SIGKILL) for name in ("convert", "debias", "export", "view")),
]  # Ctrl-C in convert, debias and train: tests/test_bad_input.py


@pytest.mark.parametrize(("name", "number"), MOMENTS, ids=lambda value: getattr(value, "name", value))
def test_a_signal_in_the_middle(here: Path, command: str, imutool: Run, name: str, number: signal.Signals) -> None:
    words, target = WRITERS[name]
    before = digests(here)
    for _ in range(TRIES):
        process = installed(command, words, here) if name in ("convert", *RERUN) else started(words, here)
        code, stderr, seconds = stopped(process, here, number)
        if code:
            break
        shutil.rmtree(here / target) if (here / target).is_dir() else (here / target).unlink()
    assert "Traceback" not in stderr
    assert code == CODES[number], stderr
    assert seconds < SOON_S + SLACK_S
    left = partials(here)
    if number != signal.SIGKILL:
        assert digests(here) == before
        return
    assert len(left) == 1
    assert PARTIAL.fullmatch(left[0])
    again = imutool(*words, "-q", cwd=here)
    assert again.returncode == 0, again.stderr
    assert partials(here) == []
    assert {name: digest for name, digest in digests(here).items() if name in before} == before


def session(pid: int) -> list[int]:
    """Living processes of a session."""
    members = []
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError):
            status = (entry / "stat").read_text().rpartition(")")[2].split()
            if int(status[3]) == pid and status[0] not in "ZX":
                members.append(int(entry.name))
    return members


def test_no_child_is_left_soon_after_sigterm(tmp_path: Path, command: str) -> None:
    for seed in range(3):
        write_asl(flight(seed, duration_s=30.0), tmp_path / "src" / f"s{seed}")
    process = installed(command, ["convert", "src", "out", "--workers", "2"], tmp_path)
    deadline = time.monotonic() + WAIT_S
    while len(session(process.pid)) < 3 and time.monotonic() < deadline:
        time.sleep(POLL_S)
    process.terminate()
    began = time.monotonic()
    while session(process.pid) and time.monotonic() - began < WAIT_S:
        time.sleep(POLL_S)
    assert time.monotonic() - began < SOON_S + SLACK_S
    assert "Traceback" not in process.communicate(timeout=WAIT_S)[1]
    assert process.returncode == TERMINATED
    assert all(path.suffix == ".mcap" for path in (tmp_path / "out").rglob("*"))


AT_WORK: dict[str, Sequence[str]] = {
    **{name: WRITERS[name][0] for name in ("train", "diagnose", "live")},
    "audit": ["audit", "in.mcap", "--json", "out.json"],
    "view --web": ["view", "in.mcap", "--web"],
}  # fleets: tests/fleet/test_fleet.py
CODES = {signal.SIGINT: INTERRUPTED, signal.SIGTERM: TERMINATED, signal.SIGHUP: HUNG_UP, signal.SIGKILL: KILLED}
HOW = {signal.SIGINT: "interrupted", signal.SIGTERM: "ended by SIGTERM", signal.SIGHUP: "ended by SIGHUP"}


def read_for_ever() -> None:
    def read(source: Source, offset: int, length: int) -> bytes:
        Path("reading").touch()
        while True:  # a signal that comes just before a sleep is handled after it
            time.sleep(STILL_S)

    Source._read = read  # type: ignore[method-assign]


@pytest.mark.parametrize("name", AT_WORK)
def test_a_signal_while_the_input_is_read(here: Path, name: str) -> None:
    """Runs at once, each with a signal of its own: the exit code is the signal's, a sentence says it, and nothing is left."""
    for number in CODES:
        (here / number.name).mkdir()
        shutil.copy(here / "in.mcap", here / number.name)
    before = digests(here)
    runs = {number: Forked([*AT_WORK[name], "-q"], here / number.name, read_for_ever) for number in CODES}
    for number, run in runs.items():
        soon((here / number.name / "reading").exists)
        run.send_signal(number)
        began = time.monotonic()
        _, stderr = run.communicate(timeout=WAIT_S)
        assert time.monotonic() - began < SOON_S + SLACK_S
        assert run.returncode == CODES[number], stderr
        assert stderr == (f"error: {HOW[number]}. Nothing half-written is left.\n" if number in HOW else "")
        soon(lambda pid=run.pid: not session(pid))  # the system ends the copies of one that is killed a moment later
        (here / number.name / "reading").unlink(missing_ok=True)
    assert {path: digest for path, digest in digests(here).items() if ".partial" not in path} == before


def as_under_nohup() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    read_for_ever()


def test_a_closed_terminal_does_not_end_what_nohup_began(here: Path) -> None:
    run = Forked(["info", "in.mcap"], here, as_under_nohup)
    soon((here / "reading").exists)
    run.send_signal(signal.SIGHUP)
    run.send_signal(signal.SIGTERM)
    run.communicate(timeout=WAIT_S)
    assert run.returncode == TERMINATED


IMPORTED_FIRST = ("imutool.cli.parameters", "typer.core", "rich.console", "imutool.cli.app", "imutool.report")


@pytest.mark.parametrize("module", IMPORTED_FIRST)
def test_ctrl_c_while_modules_are_imported_is_an_interrupt(tmp_path: Path, command: str, module: str) -> None:
    """Python says on stderr what it has imported."""
    line = [sys.executable, "-X", "importtime", command, "info", "nowhere.mcap"]
    said = ""
    with subprocess.Popen(line, cwd=tmp_path, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        for text in process.stderr:
            said += text
            if text.endswith(f" {module}\n"):
                process.send_signal(signal.SIGINT)
                break
        said += process.stderr.read()
    assert process.returncode == INTERRUPTED, said[-500:]
    words = [text for text in said.splitlines() if not text.startswith("import time:")]
    assert words[-1].startswith("error: interrupted.")
    assert "Traceback" not in said


def ctrl_c_in_typer() -> None:
    """Typer turns one that reaches it into an exit code alone."""
    setattr(_Commands, "make_context", Mock(side_effect=KeyboardInterrupt))  # noqa: B010


def test_ctrl_c_before_a_command_begins(tmp_path: Path) -> None:
    run = Forked(["info", "nowhere.mcap"], tmp_path, ctrl_c_in_typer)
    _, stderr = run.communicate(timeout=WAIT_S)
    assert run.returncode == INTERRUPTED
    assert stderr.splitlines() == ["error: interrupted. Nothing half-written is left."]


def test_a_second_ctrl_c_that_cuts_the_clean_up_short_does_not_end_in_a_promise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    target = Target(tmp_path / "out.json")  # while something refers to it, only `abandon` removes its file

    def interrupted() -> None:
        with caught(), target:
            target.write(b"{")
            raise KeyboardInterrupt

    monkeypatch.setattr(Target, "abandon", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(SystemExit):
        interrupted()
    assert len(partials(tmp_path)) == 1
    assert "error: interrupted. A file of the name *.partial may be left; " in capsys.readouterr().err


# ── a full disk, a locked folder ──


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[], contextlib.AbstractContextManager[None]]:
    """Within it the system refuses files beyond some size, as a full disk does; Python would leave half-written bytecode."""

    @contextlib.contextmanager
    def full() -> Iterator[None]:
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        monkeypatch.setattr(sys, "dont_write_bytecode", True)
        resource.setrlimit(resource.RLIMIT_FSIZE, (DISK_BYTES, limits[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    return full


@pytest.mark.parametrize("name", [name for name in WRITERS if name not in RERUN])
def test_a_full_disk_leaves_nothing(
    brief: Path, imutool: Run, full_disk: Callable[[], contextlib.AbstractContextManager[None]], name: str
) -> None:
    before = digests(brief)
    words, _ = WRITERS[name]
    with full_disk():
        done = imutool(*words, "-q", cwd=brief)
    assert done.returncode == CONFIG, done.stderr
    assert "cannot be written (File too large)" in done.stderr
    assert digests(brief) == before


@pytest.mark.parametrize("words", [["demo", "-o", "out"], ["new-converter", "mine", "-o", "out"]], ids=lambda words: words[0])
def test_a_full_disk_leaves_no_part_of_a_text(
    tmp_path: Path, imutool: Run, full_disk: Callable[[], contextlib.AbstractContextManager[None]], words: list[str]
) -> None:
    with full_disk():
        done = imutool(*words, cwd=tmp_path)
    assert done.returncode == CONFIG, done.stderr
    assert "cannot be written (File too large)" in done.stderr
    assert digests(tmp_path) == {}


@pytest.mark.parametrize("name", WRITERS)
def test_a_locked_folder_is_refused(brief: Path, imutool: Run, name: str) -> None:
    """Not even root makes a file in /proc."""
    words, target = WRITERS[name]
    locked = [f"/proc/{target}" if word == target else word for word in words]
    before = digests(brief)
    done = imutool(*locked, "-q", cwd=brief)
    assert done.returncode == CONFIG, done.stderr
    assert f"/proc/{target}" in done.stderr
    assert digests(brief) == before


# ── an input that changes, two runs at once ──


def change_input(source: Path, change: str) -> None:
    if change == "grows":
        with source.open("ab") as file:
            file.write(b"\0" * 100_000)
    elif change == "vanishes":
        source.unlink()
    else:
        os.truncate(source, source.stat().st_size // 2)


@pytest.mark.parametrize("change", ["grows", "vanishes", "is cut"])
@pytest.mark.parametrize("name", ["convert a log", "debias", "repair", "export"])
def test_an_input_that_changes_while_it_is_read(here: Path, name: str, change: str) -> None:
    """The output is whole and of the bytes that were there, or there is none and a message says why."""
    words, target = WRITERS[name]
    process = started(words, here)
    deadline = time.monotonic() + WAIT_S
    while process.poll() is None and not partials(here) and time.monotonic() < deadline:
        time.sleep(POLL_S)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGSTOP)
    change_input(here / "in.mcap", change)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGCONT)
    _, stderr = process.communicate(timeout=WAIT_S)
    assert "Traceback" not in stderr
    assert process.returncode in {0, 3, 4, 5}, stderr
    assert partials(here) == []
    if process.returncode == 0 or (name == "repair" and process.returncode == LOST):
        logs = [here / target] if (here / target).is_file() else list((here / target).glob("*.mcap"))
        for path in logs:
            with Log(path) as log:
                assert log.topics["/imu0"].count == 4001 or process.returncode == LOST
                log.check()  # raises where a CRC is wrong
    else:
        assert stderr.startswith("error: ")
        assert not (here / target).exists()


READERS: dict[str, tuple[Sequence[str], str]] = {
    **{name: case for name, case in WRITERS.items() if name not in ("convert", "convert a log", "pictures")},
    "info": (["info", "in.mcap", "--json", "out.json"], "out.json"),
    "audit": (["audit", "in.mcap", "--json", "out.json"], "out.json"),
}


@pytest.mark.parametrize("change", ["grows", "vanishes", "is cut"])
@pytest.mark.parametrize("name", READERS)
def test_an_input_that_changes_at_a_read(
    brief: Path, imutool: Run, monkeypatch: pytest.MonkeyPatch, name: str, change: str
) -> None:
    """As above for every command, in this process, at one of its first reads."""
    words, target = READERS[name]
    source, read, reads = brief / "in.mcap", Source._read, itertools.count(1)

    def changing(self: Source, offset: int, length: int) -> bytes:
        if self.path.name == source.name and next(reads) == CHANGED_AT:
            change_input(source, change)
        return read(self, offset, length)

    monkeypatch.setattr(Source, "_read", changing)
    done = imutool(*words, cwd=brief)
    assert next(reads) > CHANGED_AT
    assert "Traceback" not in done.stderr
    assert done.returncode in {0, 3, 4, 5}, done.stderr
    assert partials(brief) == []
    assert (brief / target).exists() or (done.returncode and "error: " in done.stderr)


@pytest.mark.parametrize("name", ["convert", "debias", "view", "train", "diagnose", "live"])
def test_of_two_runs_at_once_to_one_target_one_wins(brief: Path, name: str) -> None:
    words, target = WRITERS[name]
    words = words if name == "train" else [word.replace("in.mcap", "short.mcap") for word in words]
    runs = [started(words, brief) for _ in range(2)]
    said = [run.communicate(timeout=WAIT_S)[1] for run in runs]
    assert sorted(run.returncode for run in runs) == [0, CONFIG], said
    (loser,) = (text for run, text in zip(runs, said, strict=True) if run.returncode)
    assert re.search("exists. |holds a diagnosis already", loser)
    assert (brief / target).stat().st_size > DISK_BYTES or name == "train" or (brief / target / "findings.json").exists()
    assert partials(brief) == []


def commit(target: Target, errors: list[ConfigError]) -> None:
    target.write(b"whole")
    try:
        target.commit()
    except ConfigError as error:
        errors.append(error)


def test_of_two_writers_that_end_together_one_is_refused(tmp_path: Path) -> None:
    """Both have looked whether the target exists before either puts its file there."""
    for _ in range(20):
        targets = [Target(tmp_path / "out") for _ in range(2)]
        errors: list[ConfigError] = []
        threads = [threading.Thread(target=commit, args=[target, errors]) for target in targets]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(errors) == 1
        assert [path.name for path in tmp_path.iterdir()] == ["out"]
        (tmp_path / "out").unlink()


# ── whose partial files are removed ──


def renamed(path: Path, pid: int, part: int | None, digits: str = "") -> Path:
    """A temporary name of another process, with a part of its mark (machine, boot, start) changed."""
    match = PARTIAL.fullmatch(path.name)
    assert match is not None
    mark = match["mark"]
    if part is not None:
        mark = mark[: part * MARK_PART] + (digits or "0" * MARK_PART) + mark[(part + 1) * MARK_PART :]
    return path.with_name(f".{match['name']}.{pid}.{mark}.partial")


def test_partial_files_are_removed_by_the_rule_alone(tmp_path: Path) -> None:
    place = tmp_path / "out.mcap"
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    mine = temporary_path(place)
    gone = renamed(mine, ended.pid, None)
    reused = renamed(mine, os.getppid(), 2)  # the number lives, under a process that started at another time
    folder = renamed(mine, ended.pid, 2, "abcdef")
    elsewhere, of_another_name = renamed(mine, ended.pid, 0), Path(str(gone).replace("out.mcap", "other.mcap"))
    old, fresh = renamed(mine, ended.pid, 1), renamed(mine, ended.pid + 1, 1)  # of an earlier boot
    foreign = tmp_path / ".out.mcap.12.0123abcd.partial"
    for path in (mine, gone, reused, elsewhere, of_another_name, old, fresh, foreign):
        path.write_text("half")
    folder.mkdir()
    os.utime(old, (1e9, 1e9))  # before this machine started
    remove_abandoned(place)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {path.name for path in (mine, elsewhere, of_another_name, fresh, foreign)}


def test_the_copy_of_a_damaged_log_is_a_partial_file_of_the_target(tmp_path: Path) -> None:
    """No later run removed a copy that a killed debias left, as large as the log."""
    write(flight(1, duration_s=BRIEF_S), tmp_path / "in.mcap")
    os.truncate(tmp_path / "in.mcap", (tmp_path / "in.mcap").stat().st_size // 2)
    with repaired(tmp_path / "in.mcap", tmp_path / "out.mcap", None) as saved:
        assert saved is not None
        copy, _ = saved
        assert isinstance(copy, Path)
        for partial in (copy, temporary_path(copy)):  # when complete, and while it is written
            found = PARTIAL.fullmatch(partial.name)
            assert found is not None
            assert found["name"] == "out.mcap"


def test_a_living_process_keeps_its_partial_file(tmp_path: Path) -> None:
    code = (
        "import sys, pathlib; from imutool.mcap_io.storage.target import Target\n"
        "t = Target(pathlib.Path('out')); print('open', flush=True); sys.stdin.read()"
    )
    line = [sys.executable, "-c", code]
    with subprocess.Popen(line, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "open\n"
        with Target(tmp_path / "out") as target:
            target.write(b"ours")
        assert len(partials(tmp_path)) == 1
        other.kill()
        other.wait()
    with Target(tmp_path / "out", overwrite=True) as target:
        target.write(b"ours again")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_long_name_can_be_written(tmp_path: Path) -> None:
    name = "ü" * 120 + ".mcap"
    with Target(tmp_path / name) as target:
        target.write(b"whole")
    assert [path.name for path in tmp_path.iterdir()] == [name]


REMOVED = """
import os, sys, time
from imutool import cli

class Removed:
    def __del__(self):
        os.kill(os.getpid(), NUMBER)
        time.sleep(0.05)  # for the signal to arrive here

def show():
    Removed()
    time.sleep(WAIT_S)
    print("went on")

cli.show, sys.argv = show, ["imutool"]
cli.main()
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, INTERRUPTED), (signal.SIGTERM, TERMINATED)])
def test_an_end_that_a_destructor_swallows_comes_again(number: signal.Signals, code: int) -> None:
    source = REMOVED.replace("NUMBER", str(int(number))).replace("WAIT_S", str(WAIT_S))
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, timeout=0.5 * WAIT_S, check=False)
    assert (done.returncode, done.stdout) == (code, "")
    assert "Traceback" not in done.stderr
