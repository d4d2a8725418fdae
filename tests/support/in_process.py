"""The command line and scripts in the process of the tests: the same code, without a second for each start and its imports."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import runpy
import signal
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Literal


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


@functools.cache
def _main() -> Callable[[], object]:
    """`imutool.cli.main`. Each command is made once: a process that ran many tests has loaded all, and typer makes all anew."""
    import typer.main

    from imutool.cli import main

    typer.main.get_command_from_info = functools.cache(typer.main.get_command_from_info)
    return main


def run_command(words: list[str], cwd: Path, env: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    """What `imutool` in a process of its own would have printed, and its exit code; a bug is a traceback and 1."""
    return _run(_main(), ["imutool", *words], cwd, env, "default")


def run_script(line: list[str], cwd: Path) -> subprocess.CompletedProcess[str]:
    """As `run_command`, of a Python file with its words; a warning is an error."""
    return _run(lambda: runpy.run_path(line[0], run_name="__main__"), line, cwd, os.environ, "error")


def _run(
    main: Callable[[], object], line: list[str], cwd: Path, env: Mapping[str, str], on_warning: Literal["default", "error"]
) -> subprocess.CompletedProcess[str]:
    code: int | str | None = 0
    with tempfile.TemporaryFile("w+", encoding="utf-8") as out, tempfile.TemporaryFile("w+", encoding="utf-8") as err:
        with _restored(), warnings.catch_warnings(), Path(os.devnull).open() as nothing:
            warnings.simplefilter(on_warning)
            changed = dict(env)
            os.chdir(cwd)
            os.environ.clear()
            os.environ.update(changed)
            sys.stdin, sys.stdout, sys.stderr, sys.argv = nothing, out, err, line
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
        return subprocess.CompletedProcess(line, code or 0, out.read(), err.read())
