"""The command line in processes of their own that need not import it: each is forked from one that has it in memory."""

from __future__ import annotations

import atexit
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from multiprocessing import get_context
from pathlib import Path

SERVER = get_context("forkserver")
SERVER.set_forkserver_preload(
    [
        *(
            f"imutool.cli.{name}"
            for name in ("app", "clean", "convert", "debias", "diagnose", "evaluate", "live", "train", "view")
        ),
        *("imutool.training.run", "imutool.diagnosis.diagnose", "imutool.diagnosis.audit", "imutool.exporting"),
        *("imutool.viewing.html.report", "matplotlib.backends.backend_svg", "imutool.viewing.rerun.viewer", "rerun"),
        *("scipy.optimize", "scipy.signal", "scipy.stats", "allantools", "imutool.conversion.run", "imutool.debiasing"),
    ]
)  # what the commands import as they go


class Forked:
    """As `subprocess.Popen` of a command in a session of its own, as far as tests need it: stderr alone is kept."""

    def __init__(self, words: Sequence[str], cwd: Path, before: Callable[[], None] | None = None) -> None:
        handle, name = tempfile.mkstemp()
        os.close(handle)
        self._stderr = Path(name)
        self._process = SERVER.Process(target=_run, args=(list(words), cwd, name, before))
        self._process.start()
        assert self._process.pid is not None
        self.pid: int = self._process.pid

    @property
    def returncode(self) -> int | None:
        """As the system has it: negative where a signal ended it."""
        return self._process.exitcode

    poll = returncode.fget

    def send_signal(self, number: signal.Signals) -> None:
        """Sends it to the process alone."""
        os.kill(self.pid, number)

    def communicate(self, timeout: float) -> tuple[None, str]:
        """Waits for its end, and gives what it wrote to stderr."""
        self._process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired("imutool", timeout)
        said = self._stderr.read_text(encoding="utf-8")
        self._stderr.unlink()
        return None, said


def _run(words: list[str], cwd: Path, stderr: str, before: Callable[[], None] | None) -> None:
    from imutool.cli import main

    os.setsid()
    os.chdir(cwd)
    nothing = os.open(os.devnull, os.O_RDWR)
    for place, file in enumerate((nothing, nothing, os.open(stderr, os.O_WRONLY))):
        os.dup2(file, place)
    sys.stdin, sys.argv = open(0, closefd=False), ["imutool", *words]  # noqa: SIM115
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests may run under nohup
    if before is not None:
        before()
    try:
        main()
    finally:
        atexit._run_exitfuncs()  # multiprocessing leaves them out
