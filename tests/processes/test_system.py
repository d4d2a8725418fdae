"""The module that knows what systems do differently answers where a system lacks what it asks for."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from imutool.processes.system import lock

WITHOUT = """
import os, pathlib, signal, sys
for name in ("fcntl", "resource"):
    sys.modules[name] = None
for name in ("sysconf", "getuid", "sched_getaffinity", "copy_file_range", "sendfile", "fork", "killpg"):
    delattr(os, name)
real = pathlib.Path.read_text
pathlib.Path.read_text = lambda self, *a, **k: real(pathlib.Path("nowhere") if str(self).startswith("/") else self, *a, **k)
from imutool.processes import system
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
    code = "import sys; from imutool.processes.system import lock; sys.exit(0 if lock(open('file', 'a+b')) else 9)"
    with (tmp_path / "file").open("a+b") as file:
        assert lock(file)
        if closed:
            file.close()
        assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False).returncode == (0 if closed else 9)
