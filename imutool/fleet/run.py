"""Run of a fleet: list the logs, skip finished ones, run the rest, write the results."""

from __future__ import annotations

import hashlib
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from imutool.errors import LOST, ConfigError, ImutoolError
from imutool.file_location import Location, exists, to_location
from imutool.fleet import page as pages
from imutool.fleet import results
from imutool.fleet.engine import BUG, Engine
from imutool.fleet.journal import NAME as JOURNAL
from imutool.fleet.journal import Journal
from imutool.fleet.one_log import write_json
from imutool.fleet.results import FleetSummary, LogProblem
from imutool.fleet.robots import Comparison, compare
from imutool.fleet.sources import Found, find, with_simulations
from imutool.fleet.targets import page_name, partial_files, refuse_own, remove_files, target_name
from imutool.fleet.task import FINAL, Result, Settings, Source, Task, failed
from imutool.report import UNSET, NamedProgress, silent

COMPARED = "fleet.json"
MAX_LISTED = 1000  # of the results with a problem, in JSON
Wording = Callable[[str], str]


@dataclass
class Progress:
    """Progress of a fleet: counts, bytes, exit codes."""

    logs: int
    total_bytes: int
    statuses: Counter[str] = field(default_factory=Counter)
    bytes_done: int = 0
    bytes_worked: int = 0
    codes: set[int] = field(default_factory=set)
    began: float = field(default_factory=time.perf_counter)

    def add(self, result: Result) -> None:
        """Count one more result."""
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
        """Exit code: 0 for intact logs, 1 for a bug, else the largest of failed and lost logs."""
        return BUG if BUG in self.codes else max(self.codes, default=0)

    def line(self, running: int = 0) -> str:
        """Progress line: `12 of 40 done, 1 failed, 2 running, 35 MB/s, 1:20 left`."""
        elapsed = time.perf_counter() - self.began
        parts = [f"{self.statuses.total() - self.statuses['failed']} of {self.logs} done"]
        parts += [
            f"{self.statuses[name]} {name}" for name in ("skipped", "lost", "quarantined", "failed") if self.statuses[name]
        ]
        parts += [f"{running} running"] if running else []
        if self.bytes_worked and elapsed > 0.0:
            speed = self.bytes_worked / elapsed
            parts.append(f"{speed / 1e6:.3g} MB/s")
            if running:
                minutes, seconds = divmod(round((self.total_bytes - self.bytes_done) / speed), 60)
                parts.append(f"{minutes}:{seconds:02d} left")
        return ", ".join(parts)


@dataclass(frozen=True)
class FleetReport:
    """Outcome of a fleet; `not_whole` holds the first 1000 results with a problem.

    `page_error` says why there is no page.
    """

    source: str
    out: Location
    command: str
    progress: Progress
    seconds: float
    not_whole: tuple[Result, ...]
    comparison: Comparison | None
    page_error: ImutoolError | None = None

    def summary(self) -> FleetSummary:
        """Summary in JSON."""
        progress = self.progress
        return FleetSummary(
            command=self.command,
            source=self.source,
            output=str(self.out),
            results=str(self.out / results.NAME),
            logs=progress.logs,
            statuses=dict(progress.statuses),
            bytes=progress.bytes_done,
            seconds=self.seconds,
            mb_per_s=progress.bytes_worked / 1e6 / self.seconds,
            exit_code=progress.exit_code,
            not_whole=[
                LogProblem(result.source, result.earlier or result.status, result.error, list(result.losses), result.exit_code)
                for result in self.not_whole
            ],
            comparison=UNSET if self.comparison is None else self.comparison.report(),
        )


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
    json_to: Location | None = None,
    tell: NamedProgress = silent,
    wording: Wording = str,
) -> FleetReport:
    """Run a command on every log of `source`; write the results and fleet.parquet to `out`.

    The caller writes the summary to `json_to`. The page shows errors in its `wording`.

    Raises:
        ConfigError: no logs, no engine, or an `out` that holds results or cannot be written; a page or `json_to` likewise.
        KeyboardInterrupt: its note says how to go on; no partial file is left.
    """
    began = time.perf_counter()
    results.arrow()  # before the work, not after
    target = _out(out)
    if not overwrite:
        _refuse_existing(target, None if page is None or (resume and pages.is_page(page)) else page)
    model = None if settings.model is None or not Path(settings.model).is_absolute() else _bytes(Path(settings.model))
    logs = find(source, target, bags=settings.command == "repair", once=settings.command == "diagnose")
    found = with_simulations(logs, settings.sim)
    progress = Progress(len(found.logs) + len(found.refused), sum(source.size for source in found.logs))
    fleet = _Fleet(found, target, settings, overwrite, recheck)
    refuse_own(target, fleet.names(), page=page, json_to=json_to)

    def tick(flying: int) -> None:
        tell(progress.bytes_done, progress.total_bytes, progress.line(flying))

    with engine() as workers, Journal(target, settings, resume=resume, overwrite=overwrite) as journal:  # workers first
        fleet.remove_partial()
        remove_files([] if resume else [target / results.NAME])  # it would tell of logs that are replaced now
        try:
            for result in fleet.refused(journal):
                journal.finish(result)
                progress.add(result)
            with workers, closing(workers.run(fleet.tasks(journal), tick, model)) as finished:
                for result in finished:
                    if result.status == "skipped":
                        fleet.skipped.add(result.key)
                    else:
                        journal.finish(result)
                    progress.add(result)
        except BaseException as error:  # workers have been killed
            with suppress(ConfigError):  # of a store that is gone: the first error is raised
                fleet.remove_partial()
            if isinstance(error, (KeyboardInterrupt, SystemExit)):
                error.add_note(f"{progress.line()}; go on with `resume`")
            raise
        if isinstance(target, Path):  # of workers that died; in a store another run may be at work
            fleet.remove_partial()
        return _report(fleet, journal, source, progress, began, page, wording)


def _report(
    fleet: _Fleet, journal: Journal, source: str, progress: Progress, began: float, page: Location | None, wording: Wording
) -> FleetReport:
    """Write table, comparison and page from the results in the journal, read one by one."""
    settings, out = fleet.settings, fleet.out
    results.write(fleet.results(journal), out / results.NAME)
    comparison = compare(fleet.results(journal)) if settings.command == "diagnose" else None
    if comparison is not None:
        write_json(comparison.report(), out / COMPARED)
    seconds, page_error = time.perf_counter() - began, None
    if page is not None:
        every = (msgspec.structs.replace(result, error=wording(result.error)) for result in fleet.results(journal))
        try:
            pages.write(every, settings, page, out=out, seconds=seconds, source=source, comparison=comparison, overwrite=True)
        except ConfigError as error:  # the logs are done: what came of them is told first
            page_error = error.replaced(fix=f"{error.fix}, and go on with `resume`")
    not_whole = (result for result in fleet.results(journal) if (result.earlier or result.status) != "ok")
    first = tuple(result for result, _ in zip(not_whole, range(MAX_LISTED), strict=False))
    return FleetReport(source, out, settings.command, progress, seconds, first, comparison, page_error)


class _Fleet:
    """Logs and tasks of a fleet; tasks are made one at a time for up to a million logs."""

    def __init__(self, found: Found, out: Location, settings: Settings, overwrite: bool, recheck: bool) -> None:
        self.found, self.out, self.settings = found, out, settings
        self._overwrite, self._recheck = overwrite, recheck
        self.skipped: set[str] = set()

    def remove_partial(self) -> None:
        """Remove the partial files of a killed run."""
        remove_files(partial_files(self.out, self.names()))

    def names(self) -> list[str]:
        """Names below OUT of all results, of their pages, and of what compares them."""
        names = [self._name(source) for source in self.found.logs]
        pages = [page_name(name) for name in names] if self.settings.pages else []
        return [*names, *pages, *([COMPARED] if self.settings.command == "diagnose" else [])]

    def refused(self, journal: Journal) -> Iterator[Result]:
        """Results of refused logs: an unusable name, or a target that no fleet has written."""
        for where, why in self.found.refused:
            yield Result(key=_key(where), source=where, target="", status="failed", error=why, exit_code=ConfigError.exit_code)
        for source in self.found.logs:
            if self._blocked(source, journal):
                error = ConfigError(
                    "the target exists", where=self.out / self._name(source), fix="Choose another `out`, or add `overwrite`"
                )
                yield failed(source.key(self.settings), source, str(error), error.exit_code)

    def tasks(self, journal: Journal) -> Iterator[Task]:
        """Tasks of the other logs; the journal notes each before it starts."""
        for source in self.found.logs:
            if self._blocked(source, journal):
                continue
            key, name = source.key(self.settings), self._name(source)
            done = journal.done(key)
            journal.begin(key, name)
            yield Task(
                key=key,
                source=source,
                out=str(self.out),
                target=name,
                settings=self.settings,
                done=done if done is not None and done.status in FINAL else None,
                recheck=self._recheck,
            )

    def results(self, journal: Journal) -> Iterator[Result]:
        """Results of all logs, sorted by name; refused logs come last."""
        keys = [source.key(self.settings) for source in self.found.logs] + [_key(where) for where, _ in self.found.refused]
        for key in keys:
            result = journal.done(key)
            if result is not None and key in self.skipped:
                yield msgspec.structs.replace(result, status="skipped", earlier=result.status)
            elif result is not None:
                yield result

    def _name(self, source: Source) -> str:
        """Name of a log's target below OUT."""
        return target_name(source.name, self.settings.command)

    def _blocked(self, source: Source, journal: Journal) -> bool:
        name = self._name(source)
        return not (self._overwrite or journal.ours(name)) and exists(self.out / name)


def _refuse_existing(out: Location, page: Location | None) -> None:
    """Refuse to replace a file that no fleet has written.

    Raises:
        ConfigError: the page exists, or a table or comparison in an OUT that no fleet has begun.
    """
    if page is not None and exists(page):
        raise ConfigError("the target exists", where=page, fix="Choose another `page`, or add `overwrite`")
    for name in (results.NAME, COMPARED):
        if not exists(out / JOURNAL) and exists(out / name):
            raise ConfigError("the target exists", where=out / name, fix="Choose another `out`, or add `overwrite`")


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror})", where=path) from error


def _key(where: str) -> str:
    return hashlib.sha256(where.encode()).hexdigest()


def _out(text: str) -> Location:
    out = to_location(text)
    if isinstance(out, Path):
        return out.absolute()
    if out.protocol == "memory":
        raise ConfigError("is the memory of one process, which ends with it", where=text, expected="a folder, or a store's URL")
    return out
