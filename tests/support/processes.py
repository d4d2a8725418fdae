"""Processes that tests have started, as the system sees them."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

SOON_S = 240.0  # a machine may be busy with other tests


def below(pid: int) -> list[int]:
    """A process and all it has started, as they are now."""
    parents: dict[int, list[int]] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except (FileNotFoundError, ProcessLookupError):
            continue
        parents.setdefault(parent, []).append(int(folder.name))
    family = [pid]
    for member in family:
        family += parents.get(member, [])
    return family


def lives(pid: int) -> bool:
    """Whether a process runs; one that has ended and that nobody has waited for does not."""
    try:
        return Path("/proc", str(pid), "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def soon(look: Callable[[], Any]) -> Any:
    """The first true answer of `look`."""
    end = time.monotonic() + SOON_S
    while time.monotonic() < end:
        if answer := look():
            return answer
        time.sleep(0.005)
    raise AssertionError("it took too long")
