"""The command line run in the process of the tests: the same `main`, without a second for each start and its imports."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path


@contextlib.contextmanager
def _restored() -> Iterator[None]:
    """What a process changes of itself is as before afterwards."""
    root, ours = logging.getLogger(), logging.getLogger("imutool")
    streams, argv, cwd, environment = (sys.stdin, sys.stdout, sys.stderr), sys.argv, Path.cwd(), dict(os.environ)
    handlers, levels = root.handlers[:], (root.level, ours.level)
    signals = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        sys.stdin, sys.stdout, sys.stderr = streams
        sys.argv = argv
        os.chdir(cwd)
        os.environ.clear()
        os.environ.update(environment)
        root.handlers[:] = handlers
        root.setLevel(levels[0])
        ours.setLevel(levels[1])
        for number, handler in signals.items():
            signal.signal(number, handler)


def run_command(words: list[str], cwd: Path, env: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    """What a process of its own would have printed, and its exit code; a bug is a traceback and 1."""
    from imutool.cli import main

    code: int | str | None = 0
    with tempfile.TemporaryFile("w+", encoding="utf-8") as out, tempfile.TemporaryFile("w+", encoding="utf-8") as err:
        with _restored(), warnings.catch_warnings(), Path(os.devnull).open() as nothing:
            warnings.simplefilter("default")
            os.chdir(cwd)
            os.environ.clear()
            os.environ.update(env)
            sys.stdin, sys.stdout, sys.stderr, sys.argv = nothing, out, err, ["imutool", *words]
            try:
                main()
            except SystemExit as end:
                code = end.code
            except Exception:  # noqa: BLE001  (what the interpreter does with it)
                traceback.print_exc()
                code = 1
            if isinstance(code, str):
                print(code, file=err)
                code = 1
        for stream in (out, err):
            stream.seek(0)
        return subprocess.CompletedProcess(["imutool", *words], code or 0, out.read(), err.read())
