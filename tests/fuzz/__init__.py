"""Seeded search for inputs that break a promise of imutool.

Each module of this package makes broken inputs of one kind and judges the answers. It has one function,
`problems(rng, folder)`: it draws one input from `rng`, writes it into the empty `folder`, runs imutool in this process and
yields a sentence for each broken promise. An exception that leaves it is a problem too, as are more than `BUDGET_S` CPU
seconds, `HANG_S` on the clock, and `ROOM_BYTES` of memory. `python tests/bench/fuzz.py KIND --seed SEED --case N` runs one
case again.
"""

from __future__ import annotations

import importlib
import pkgutil
import random
import resource
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import CompletedProcess

from support.log_damage import in_time

BUDGET_S = 20.0  # CPU time for one case; most take milliseconds
HANG_S = 120.0  # on the clock, on a machine busy with other things
ROOM_BYTES = 1 << 30  # of address space above that at the start of a case
EXIT_CODES = (0, 2, 3, 4, 5, 6, 7)

Problems = Callable[[random.Random, Path], Iterator[str]]


class TooLong(BaseException):
    """A case did not end in time; no `except Exception` takes it."""


def kinds() -> list[str]:
    """Names of the generators: the modules of this package."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__) if not module.name.startswith(("test_", "_")))


def run_case(kind: str, seed: str, number: int) -> list[str]:
    """Problems of one case, each with its name and the line that runs it again."""
    problems: Problems = importlib.import_module(f"{__name__}.{kind}").problems
    rng = random.Random(f"{kind} {seed} {number}")
    found, began = list[str](), time.process_time()
    with tempfile.TemporaryDirectory(prefix="imutool-fuzz-", dir=_quick_folder()) as folder:
        try:
            with warnings.catch_warnings(), bounded():
                warnings.simplefilter("error")
                found.extend(problems(rng, Path(folder)))
        except TooLong:
            found.append(f"not done after {HANG_S:.0f} s")
        except Exception:  # noqa: BLE001  # any that leaves a case is what is sought
            found.append(traceback.format_exc(limit=-6))
    if (taken_s := time.process_time() - began) > BUDGET_S:
        found.append(f"took {taken_s:.0f} CPU seconds")
    return [
        f"{kind} {number}: {what}\n  again: python tests/bench/fuzz.py {kind} --seed {seed} --case {number}" for what in found
    ]


def hunt(kind: str, seed: str, seconds: float) -> Iterator[list[str]]:
    """Problems of case after case until the time is over; at least one case."""
    end, number = time.monotonic() + seconds, 0
    while number == 0 or time.monotonic() < end:
        yield run_case(kind, seed, number)
        number += 1


@contextmanager
def bounded() -> Iterator[None]:
    """Ends what takes too long, and refuses memory beyond `ROOM_BYTES`."""
    limits = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + ROOM_BYTES, limits[1]))
    try:
        with in_time(HANG_S, TooLong):
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)


def command(folder: Path, *words: str) -> CompletedProcess[str]:
    """What a command answers, run in this process in the folder of a case."""
    import os

    from support.in_process import run_command

    return run_command(list(words), folder, {**os.environ, "COLUMNS": "80"})


def outside_contract(done: CompletedProcess[str], codes: tuple[int, ...] = EXIT_CODES) -> Iterator[str]:
    """What is wrong with an answer: a traceback, or another exit code than the contract allows."""
    words = " ".join(done.args[1:])
    if "Traceback" in done.stderr:
        yield f"{words}: {done.stderr[-1500:]}"
    elif done.returncode not in codes:
        yield f"{words}: exit code {done.returncode}: {done.stderr[-300:]}"


def _quick_folder() -> str | None:
    return "/dev/shm" if Path("/dev/shm").is_dir() else None
