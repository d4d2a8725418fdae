"""A fleet from its first log to its last: what there is, what is done already, who does the rest, and what came of it."""

from __future__ import annotations

import hashlib
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from imutool.errors import ConfigError
from imutool.fleet import results
from imutool.fleet.engine import BUG, Engine
from imutool.fleet.journal import NAME as JOURNAL
from imutool.fleet.journal import Journal
from imutool.fleet.robots import Compared, compare
from imutool.fleet.sources import Found, find, leftovers, remove
from imutool.fleet.task import FINAL, Result, Settings, Source, Task
from imutool.fleet.work import called, page_name, write_json
from imutool.location import Location, to_location

LOST = 3  # something of a log was lost, or a log was quarantined
COMPARED = "fleet.json"
TITLE = b"<title>Fleet "
TOLD = 1000  # logs that are not whole, in JSON
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
        parts += [
            f"{self.statuses[name]} {name}" for name in ("skipped", "lost", "quarantined", "failed") if self.statuses[name]
        ]
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
    """What came of a fleet; `trouble` is of the logs that are not whole, the first thousand."""

    source: str
    out: Location
    command: str
    tally: Tally
    seconds: float
    trouble: tuple[Result, ...]
    compared: Compared | None

    def plain(self) -> dict[str, Any]:
        """As JSON has it."""
        told: dict[str, Any] = {
            "schema": "imutool.fleet/1",
            "command": self.command,
            "source": self.source,
            "output": str(self.out),
            "results": str(self.out / results.NAME),
            "logs": self.tally.logs,
            "statuses": dict(self.tally.statuses),
            "bytes": self.tally.bytes_done,
            "seconds": self.seconds,
            "mb_per_s": self.tally.bytes_worked / 1e6 / self.seconds,
            "exit_code": self.tally.exit_code,
            "not_whole": [
                {
                    "source": one.source,
                    "status": one.earlier or one.status,
                    "error": one.error,
                    "losses": list(one.losses),
                    "exit_code": one.exit_code,
                }
                for one in self.trouble
            ],
        }
        return told if self.compared is None else told | {"comparison": self.compared.plain()}


def run(
    source: str,
    out: str,
    settings: Settings,
    engine: Callable[[], Engine],
    *,
    resume: bool = False,
    overwrite: bool = False,
    recheck: bool = False,
    page: Location | None = None,
    tell: Tell = lambda done, total, words: None,
) -> FleetReport:
    """Does what `settings` say to every log of `source`, into `out`, and writes fleet.parquet there and the page where asked.

    Raises:
        ConfigError: no logs; an `out` that holds results already, or cannot be written; a page that exists (without `overwrite`
            or `resume`); no engine.
        KeyboardInterrupt: with a word on how to go on; nothing half-written is left.
    """
    began = time.perf_counter()
    results.arrow()  # before the work, not after
    target = _out(out)
    if not overwrite:
        _refuse_strangers(target, page if page is None or not (resume and _is_page(page)) else None)
    model = None if settings.model is None or not Path(settings.model).is_absolute() else _bytes(Path(settings.model))
    found = find(source, target, bags=settings.command == "repair")
    tally = Tally(len(found.logs) + len(found.refused), sum(one.size for one in found.logs))
    fleet = _Fleet(found, target, settings, overwrite, recheck)

    def tick(flying: int) -> None:
        tell(tally.bytes_done, tally.total_bytes, tally.words(flying))

    with Journal(target, settings, resume=resume, overwrite=overwrite) as journal:
        fleet.sweep()
        try:
            for result in fleet.hopeless(journal):
                journal.finish(result)
                tally.take(result)
            with engine() as workers, closing(workers.run(fleet.tasks(journal), tick, model)) as finished:
                for result in finished:
                    if result.status == "skipped":
                        fleet.skipped.add(result.key)
                    else:
                        journal.finish(result)
                    tally.take(result)
        except KeyboardInterrupt as interrupt:
            raise KeyboardInterrupt(f"{tally.words()}; go on with --resume") from interrupt
        finally:
            if tally.statuses.total() < tally.logs:  # workers have been killed
                fleet.sweep()
        return _told(fleet, journal, source, tally, began, page)


def _told(fleet: _Fleet, journal: Journal, source: str, tally: Tally, began: float, page: Location | None) -> FleetReport:
    """Everything that is made of the results: read from the journal as often as it takes, never held."""
    settings, out = fleet.settings, fleet.out
    results.write(fleet.results(journal), out / results.NAME)
    compared = None
    if settings.command == "diagnose":
        compared = compare(fleet.results(journal))
        write_json(compared.plain(), out / COMPARED)
    seconds = time.perf_counter() - began
    if page is not None:
        from imutool.fleet import page as pages

        every = fleet.results(journal)
        pages.write(every, settings, page, out=out, seconds=seconds, source=source, compared=compared, overwrite=True)
    trouble = (one for one in fleet.results(journal) if (one.earlier or one.status) != "ok")
    first = tuple(one for one, _ in zip(trouble, range(TOLD), strict=False))
    return FleetReport(source, out, settings.command, tally, seconds, first, compared)


class _Fleet:
    """What is to be done, made up as it is asked for: a million logs are a million small tuples, not tasks."""

    def __init__(self, found: Found, out: Location, settings: Settings, overwrite: bool, recheck: bool) -> None:
        self.found, self.out, self.settings = found, out, settings
        self._overwrite, self._recheck = overwrite, recheck
        self.skipped: set[str] = set()

    def sweep(self) -> None:
        """Removes what was half-written when somebody was killed."""
        names = [self._name(one) for one in self.found.logs]
        pages = [page_name(name) for name in names] if self.settings.pages else []
        remove(leftovers(self.out, [*names, *pages]))

    def hopeless(self, journal: Journal) -> Iterator[Result]:
        """Logs that cannot be taken, and those for which somebody else's file is in the way."""
        for where, why in self.found.refused:
            yield Result(key=_key(where), source=where, target="", status="failed", error=why, exit_code=ConfigError.exit_code)
        for one in self.found.logs:
            if self._taken(one, journal):
                error = ConfigError(
                    "the target exists", where=self.out / self._name(one), fix="Choose another OUT, or add --overwrite"
                )
                yield Result(
                    key=one.key(self.settings),
                    source=one.place,
                    target="",
                    status="failed",
                    source_bytes=one.size,
                    error=str(error),
                    exit_code=error.exit_code,
                )

    def tasks(self, journal: Journal) -> Iterator[Task]:
        """The others; each is begun in the journal as it is taken."""
        for one in self.found.logs:
            if self._taken(one, journal):
                continue
            key, name = one.key(self.settings), self._name(one)
            done = journal.done(key)
            journal.begin(key, name)
            yield Task(
                key=key,
                source=one,
                out=str(self.out),
                target=name,
                settings=self.settings,
                done=done if done is not None and done.status in FINAL else None,
                recheck=self._recheck,
            )

    def results(self, journal: Journal) -> Iterator[Result]:
        """What became of every log, in order of their names; those that were refused come last."""
        keys = [one.key(self.settings) for one in self.found.logs] + [_key(where) for where, _ in self.found.refused]
        for key in keys:
            result = journal.done(key)
            if result is not None and key in self.skipped:
                yield msgspec.structs.replace(result, status="skipped", earlier=result.status)
            elif result is not None:
                yield result

    def _name(self, source: Source) -> str:
        """What the result of a log is called below OUT."""
        return called(source.name, self.settings.command)

    def _taken(self, source: Source, journal: Journal) -> bool:
        name = self._name(source)
        return not (self._overwrite or journal.ours(name)) and (self.out / name).exists()


def _refuse_strangers(out: Location, page: Location | None) -> None:
    """Refuses to write over what no fleet has written.

    Raises:
        ConfigError: the page exists, or a table or comparison in an OUT that no fleet has begun.
    """
    if page is not None and page.exists():
        raise ConfigError("the target exists", where=page, fix="Choose another --report, or add --overwrite")
    for name in (results.NAME, COMPARED):
        if not (out / JOURNAL).exists() and (out / name).exists():
            raise ConfigError("the target exists", where=out / name, fix="Choose another OUT, or add --overwrite")


def _is_page(path: Location) -> bool:
    """Whether a file is a page about a fleet."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return TITLE in file.read(4096)


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror})", where=path) from error


def _key(where: str) -> str:
    """What a log is filed under that cannot be taken."""
    return hashlib.sha256(where.encode()).hexdigest()


def _out(text: str) -> Location:
    out = to_location(text)
    return out.absolute() if isinstance(out, Path) else out
