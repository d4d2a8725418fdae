"""One module knows what systems do differently; nothing else uses what only some have."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import imutool
from imutool.mcap_io.storage.system import lock

ROOT = Path(imutool.__file__).parents[1]
ALONE = ROOT / "imutool" / "mcap_io" / "storage" / "system.py"
POSIX_MODULES = {"fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "posix", "syslog"}
POSIX_NAMES = {
    "os": {
        *("fork", "forkpty", "sync", "sysconf", "getuid", "geteuid", "getgid", "killpg", "setsid", "getpgid", "mkfifo", "nice"),
        *("chown", "lchown", "pread", "pwrite", "posix_fadvise", "posix_fallocate", "sendfile", "copy_file_range", "statvfs"),
        *("sched_getaffinity", "wait3", "wait4", "WNOHANG", "O_DIRECTORY", "O_NONBLOCK", "fchmod", "getloadavg", "pipe2"),
    },
    "signal": {"SIGKILL", "SIGALRM", "SIGHUP", "SIGPIPE", "SIGUSR1", "SIGCHLD", "setitimer", "alarm", "pause", "pthread_kill"},
}
SOURCES = sorted(path for folder in ("imutool", "converters") for path in (ROOT / folder).rglob("*.py") if path != ALONE)


def of_posix_alone(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        where = f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}: "
        if isinstance(node, ast.Import):
            yield from (where + alias.name for alias in node.names if alias.name in POSIX_MODULES)
        elif isinstance(node, ast.ImportFrom) and (node.module in POSIX_MODULES or node.module in POSIX_NAMES):
            names = {alias.name for alias in node.names}
            yield from (where + name for name in names & POSIX_NAMES.get(node.module or "", names))
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if node.attr in POSIX_NAMES.get(node.value.id, ()):
                yield f"{where}{node.value.id}.{node.attr}"
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith("/dev/shm"):
            yield where + node.value
        elif isinstance(node, ast.keyword) and node.arg in {"pass_fds", "preexec_fn"}:
            yield f"{where}{node.arg}="


def test_no_other_module_uses_what_only_posix_has() -> None:
    assert [use for path in SOURCES for use in of_posix_alone(path)] == []
    assert {use.rpartition(" ")[2] for use in of_posix_alone(ALONE)} >= {"fcntl", "resource", "os.sysconf"}


WITHOUT = """
import os, pathlib, signal, sys
for name in ("fcntl", "resource"):
    sys.modules[name] = None
for name in ("sysconf", "getuid", "sched_getaffinity", "copy_file_range", "sendfile", "fork", "killpg"):
    delattr(os, name)
real = pathlib.Path.read_text
pathlib.Path.read_text = lambda self, *a, **k: real(pathlib.Path("nowhere") if str(self).startswith("/") else self, *a, **k)
from imutool.mcap_io.storage import system
from imutool.mcap_io.storage.source import Source
from imutool.mcap_io.storage.target import Target
assert system.processors() >= 1
assert system.memory_bytes() > 1 << 40
assert system.peak_bytes() == 0
assert system.user()
pathlib.Path("a").write_bytes(bytes(range(256)) * 99)
with Target(pathlib.Path("b")) as target:
    target.copy(Source(pathlib.Path("a")), 100, 20_000)
assert pathlib.Path("b").read_bytes() == pathlib.Path("a").read_bytes()[100:20_000]
with open("b", "a+b") as file:
    assert system.lock(file)
import imutool.fleet.run, imutool.fleet.engine, imutool.processes.worker_pool
"""


def test_each_function_answers_where_the_system_lacks_what_it_asks_for(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("closed", [False, True])
def test_a_locked_file_is_refused_to_others_until_it_is_closed(tmp_path: Path, closed: bool) -> None:
    code = "import sys; from imutool.mcap_io.storage.system import lock; sys.exit(0 if lock(open('file', 'a+b')) else 9)"
    with (tmp_path / "file").open("a+b") as file:
        assert lock(file)
        if closed:
            file.close()
        assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False).returncode == (0 if closed else 9)
