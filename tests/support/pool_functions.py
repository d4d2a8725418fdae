"""What workers are made to do in tests: a module of its own, which their processes import."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any


class Ending:
    """Gets SIGTERM while it is removed."""

    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.05)  # for the signal to arrive here


def follow(item: tuple[str, str]) -> str:
    """Does what the first word says; the second is a file that a line is added to first. Returns it."""
    what, path = item
    with Path(path).open("a") as file:
        file.write(f"{os.getpid()}\n")
    tries = len(Path(path).read_text().splitlines())
    if what == "bug":
        raise ValueError("two and two is five")
    if what == "crash" or (what == "crash once" and tries == 1):
        os.kill(os.getpid(), signal.SIGSEGV)
    if what == "killed" or (what == "killed once" and tries == 1):
        time.sleep(0.3)  # so that another one has begun
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "ended in a destructor":
        Ending()
        time.sleep(5.0)
    if what.startswith("last "):
        if what.endswith("against SIGTERM"):
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        time.sleep(float(what.split()[1]))
    return path


def end_at_first(item: tuple[int, Any]) -> Any:
    """Ends its process at the first sequence, and converts the others."""
    if item[0] == 0:
        os._exit(9)
    from imutool.conversion.workers import convert_numbered

    return convert_numbered(item)


def no_worker(item: object) -> object:
    """Cannot be found by a worker: the test takes it away."""
    return item
