"""A fleet from its first log to its last: what there is, what is done already, who does the rest, and what came of it."""

from __future__ import annotations

import contextlib
import hashlib
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from imutool.errors import ConfigError
from imutool.fleet.engine import BUG, Engine
from imutool.fleet.journal import Journal
from imutool.fleet.sources import Found, find, leftovers
from imutool.fleet.task import FINAL, Result, Settings, Source, Task
from imutool.fleet.work import SUFFIX
from imutool.place import Place, place

LOST = 3  # something of a log was lost, or a log was quarantined
Tell = Callable[[int, int, str], None]


@dataclass
class Tally:
    """How far a fleet is."""

    logs: int
    total_bytes: int
    statuses: Counter[str] = field(default_factory=Counter)
    bytes_done: int = 0
    bytes_worked: int = 0
    codes: set[int] = field(default_factory=set)
    began: float = field(default_factory=time.perf_counter)

    def take(self, result: Result) -> None:
        """Counts one more."""
        self.statuses[result.status] += 1
        self.bytes_done += result.source_bytes
        if result.status != "skipped":
            self.bytes_worked += result.source_bytes
        if result.status == "failed":
            self.codes.add(result.exit_code)
        if {result.status, result.earlier} & {"lost", "quarantined"}:
            self.codes.add(LOST)

    @property
    def exit_code(self) -> int:
        """0: every log whole; a bug above all, then the largest code of the logs that failed, then 3 for what was lost."""
        return BUG if BUG in self.codes else max(self.codes, default=0)

    def words(self, running: int = 0) -> str:
        """`12 of 40 done, 1 failed, 2 running, 35 MB/s, 1:20 left`."""
        elapsed = time.perf_counter() - self.began
        parts = [f"{self.statuses.total()} of {self.logs} done"]
        parts += [f"{self.statuses[name]} {name}" for name in ("skipped", "lost", "quarantined", "failed") if self.statuses[name]]
        if running:
            parts.append(f"{running} running")
        if self.bytes_worked and elapsed > 0.0:
            speed = self.bytes_worked / elapsed
            parts.append(f"{speed / 1e6:.3g} MB/s")
            if running:
                minutes, seconds = divmod(round((self.total_bytes - self.bytes_done) / speed), 60)
                parts.append(f"{minutes}:{seconds:02d} left")
        return ", ".join(parts)


@dataclass(frozen=True)
class FleetReport:
    """What came of a fleet."""

    out: Place
    tally: Tally
    seconds: float


def run(
    source: str,
    out: str,
    settings: Settings,
    engine: Callable[[], Engine],
    *,
    resume: bool = False,
    overwrite: bool = False,
    recheck: bool = False,
    tell: Tell = lambda done, total, words: None,
) -> FleetReport:
    """Does what `settings` say to every log of `source`, into `out`.

    Raises:
        ConfigError: no logs; an `out` that holds results already; no engine.
        KeyboardInterrupt: with a word on how to go on; nothing half-written is left.
    """
    began = time.perf_counter()
    target = _out(out)
    found = find(source, target)
    tally = Tally(len(found.logs) + len(found.refused), sum(one.size for one in found.logs))
    tasks = _Tasks(found, target, settings, overwrite, recheck)
    with Journal(Path(target), settings, resume=resume, overwrite=overwrite) as journal:
        for path in leftovers(Path(target), [tasks.name(one) for one in found.logs]):
            with contextlib.suppress(FileNotFoundError):
                path.unlink()
        try:
            for result in tasks.hopeless(journal):
                journal.finish(result)
                tally.take(result)
            with engine() as workers:
                for result in workers.run(tasks(journal), lambda flying: tell(tally.bytes_done, tally.total_bytes, tally.words(flying))):
                    if result.status != "skipped":
                        journal.finish(result)
                    tally.take(result)
        except KeyboardInterrupt as interrupt:
            raise KeyboardInterrupt(f"{tally.words()}; go on with --resume") from interrupt
        finally:
            if tally.statuses.total() < tally.logs:
                for path in leftovers(Path(target), [tasks.name(one) for one in found.logs]):
                    with contextlib.suppress(FileNotFoundError):
                        path.unlink()
    return FleetReport(target, tally, time.perf_counter() - began)


class _Tasks:
    """What is to be done, made up as it is asked for: a million logs are a million small tuples, not tasks."""

    def __init__(self, found: Found, out: Place, settings: Settings, overwrite: bool, recheck: bool) -> None:
        self.found, self.out, self.settings = found, out, settings
        self.overwrite, self.recheck = overwrite, recheck

    def name(self, source: Source) -> str:
        """What the result of a log is called below OUT."""
        return source.name.removesuffix(".mcap") + SUFFIX[self.settings.command]

    def hopeless(self, journal: Journal) -> Iterator[Result]:
        """Logs that cannot be taken, and those for which somebody else's file is in the way."""
        for where, why in self.found.refused:
            key = hashlib.sha256(where.encode()).hexdigest()
            yield Result(key=key, source=where, target="", status="failed", error=why, exit_code=ConfigError.exit_code)
        for one in self.found.logs:
            if self._taken(one, journal):
                error = ConfigError("the target exists", where=self.out / self.name(one), fix="Choose another OUT, or add --overwrite")
                yield Result(
                    key=one.key(self.settings),
                    source=one.place,
                    target="",
                    status="failed",
                    source_bytes=one.size,
                    error=str(error),
                    exit_code=error.exit_code,
                )

    def __call__(self, journal: Journal) -> Iterator[Task]:
        """The others; each is begun in the journal as it is taken."""
        for one in self.found.logs:
            if self._taken(one, journal):
                continue
            key, name = one.key(self.settings), self.name(one)
            done = journal.done(key)
            journal.begin(key, name)
            yield Task(
                key=key,
                source=one,
                out=str(self.out),
                target=name,
                settings=self.settings,
                done=done if done is not None and done.status in FINAL else None,
                recheck=self.recheck,
            )

    def _taken(self, source: Source, journal: Journal) -> bool:
        name = self.name(source)
        return not (self.overwrite or journal.ours(name)) and (self.out / name).exists()


def _out(text: str) -> Place:
    out = place(text)
    return out.absolute() if isinstance(out, Path) else out
