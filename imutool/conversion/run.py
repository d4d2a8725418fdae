"""Conversion of data sets to MCAP: find the sequences, choose a converter, write the logs.

Sequences convert in worker processes, one log a sequence; a sequence that fails is reported and the others go on.
A script that calls `convert` with several workers needs the usual `if __name__ == "__main__":` (processes are spawned).
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from pathlib import Path
from types import ModuleType

from imutool import registry
from imutool.conversion.workers import GROUP, Job, run_jobs
from imutool.errors import ConfigError, DataError, ImutoolError
from imutool.mcap_io.write import write
from imutool.recording import Recording

AUTO = "auto"
SUFFIX = ".mcap"
Progress = Callable[[int, int, str], None]  # sequences done, sequences in all, the name of the one that just ended


@dataclass(frozen=True)
class Failure:
    """Failed sequence, with the reason."""

    name: str
    message: str


@dataclass(frozen=True)
class ConvertReport:
    """Written logs, in the order of the source, and failures."""

    written: list[Path] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)


@dataclass
class _Found:
    """Recognised sequences of a source, and the others with their errors."""

    jobs: list[Job] = field(default_factory=list)
    errors: list[tuple[str, ImutoolError]] = field(default_factory=list)

    def names(self) -> list[str]:
        return [job.sequence.name for job in self.jobs] + [name for name, _ in self.errors]


def convert(
    source: Path,
    out: Path,
    *,
    format: str = AUTO,
    sequences: Sequence[str] = (),
    compression: str = "zstd",
    images: bool = True,
    overwrite: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
) -> ConvertReport:
    """Convert one sequence to the file `out`, or several sequences to the folder `out`.

    `workers` is the number of processes, by default one a processor; with 1, or for one sequence, all happens here.

    Raises:
        DataError: no converter recognises anything in the source.
        ConfigError: unknown format or sequence, two sequences of one name, a target that exists, is a source, or cannot
            be made.
        ImutoolError: the only sequence there is (or was asked for) failed; of several, failures go to the report.
    """
    if format != AUTO and not hasattr(module := registry.load(GROUP, format), "sequences"):
        return _from_stream(module, source, out, sequences, compression, images, overwrite, progress)
    found = _find(source, format)
    if sequences:
        found = _only(found, sequences)
    names = found.names()
    targets = _targets([job.sequence.name for job in found.jobs], out, many=len(names) > 1)
    jobs = [
        replace(job, target=target, compression=compression, images=images, overwrite=overwrite)
        for job, target in zip(found.jobs, targets, strict=True)
    ]
    if len(names) == 1 and found.errors:
        raise found.errors[0][1]
    _check_targets(jobs)
    outcomes: dict[int, ImutoolError | None] = {}
    done = len(found.errors)
    for number, error in run_jobs(jobs, _worker_count(workers, len(jobs))):
        outcomes[number] = error
        done += 1
        if progress is not None:
            progress(done, len(names), jobs[number].sequence.name)
    failed = [(jobs[n].sequence.name, error) for n, error in sorted(outcomes.items()) if error is not None]
    if len(names) == 1 and failed:
        raise failed[0][1]
    return ConvertReport(
        written=[jobs[n].target for n, error in sorted(outcomes.items()) if error is None],
        failures=[Failure(name, str(error)) for name, error in [*found.errors, *failed]],
    )


def _find(source: Path, format: str) -> _Found:
    """Find every sequence of the source, with its converter.

    Raises:
        DataError: there is none.
        ConfigError: a sequence is claimed twice.
    """
    claims: dict[str, list[Job]] = {}
    errors: dict[str, tuple[str, ImutoolError]] = {}
    for key in registry.names(GROUP) if format == AUTO else [format]:
        module = registry.load(GROUP, key)
        if not hasattr(module, "sequences"):
            continue  # reads, but recognises nothing: only on request
        for sequence in module.sequences(source):
            mine = claims.setdefault(str(sequence), [])
            try:
                if format != AUTO or module.recognises(sequence):
                    mine.append(Job(key, sequence))
                elif not mine:
                    reason = DataError("no converter recognises it", where=str(sequence), fix="Choose one with `format`")
                    errors.setdefault(str(sequence), (sequence.name, reason))
            except ImutoolError as error:
                errors[str(sequence)] = (sequence.name, error)
    if not claims:
        raise DataError(
            "no sequence found",
            where=source,
            expected="a folder with mav0/imu0/data.csv, a .zip, .tar or .tar.gz of one, a ROS 1 .bag, or a folder of these",
        )
    for place, jobs in claims.items():
        if len(jobs) > 1:
            keys = " and ".join(job.converter for job in jobs)
            raise ConfigError(f"is recognised as {keys}", where=place, fix="Choose one with `format`")
    return _Found(
        [job for jobs in claims.values() for job in jobs],
        [error for place, error in errors.items() if not claims[place]],
    )


def _only(found: _Found, wanted: Sequence[str]) -> _Found:
    """Requested sequences.

    Raises:
        ConfigError: a sequence is not in the source; the message names the nearest.
    """
    known = found.names()
    for name in wanted:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            raise ConfigError(
                f"{name!r} is not in the source",
                where="sequences",
                expected=f"one of {', '.join(sorted(known))}",
                fix=f"Did you mean {near[0]!r}?" if near else "",
            )
    return _Found(
        [job for job in found.jobs if job.sequence.name in wanted],
        [(name, error) for name, error in found.errors if name in wanted],
    )


def _targets(names: Sequence[str], out: Path, *, many: bool) -> list[Path]:
    """Target of each log; missing folders are made.

    Raises:
        ConfigError: several logs but `out` names a file, or a folder cannot be made.
    """
    if many and (out.suffix == SUFFIX or out.is_file()):
        raise ConfigError("several sequences do not fit into one file", where=out, expected="a folder")
    into_folder = many or out.is_dir()
    folder = out if into_folder else out.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot be made ({error.strerror})", where=folder, expected="a writable place") from error
    return [out / f"{name}{SUFFIX}" if into_folder else out for name in names]


def _check_targets(jobs: Sequence[Job]) -> None:
    """Refuse to overwrite a log, a source, or another log of the same run."""
    seen: dict[Path, Job] = {}
    for job in jobs:
        if (other := seen.setdefault(job.target, job)) is not job:
            raise ConfigError(
                f"two sequences are named {job.sequence.name}: {other.sequence} and {job.sequence}",
                where="source",
                fix="Convert them one at a time",
            )
        path = getattr(job.sequence, "path", None)
        if path is not None and _is_part_of(job.target, path):
            raise ConfigError("is the source itself", where=job.target, expected="another `out`")
        if job.target.exists() and not job.overwrite:
            raise ConfigError("exists", where=job.target, fix="Choose another `out`, or add `overwrite`")


def _is_part_of(target: Path, source: Path) -> bool:
    """Whether a target is the source or one of its files.

    A log in the source's folder is not one of its files.
    """
    if not target.exists():
        return False
    inside = source.is_dir() and target.resolve().is_relative_to(source.resolve()) and target.suffix != SUFFIX
    return inside or target.samefile(source)


def _worker_count(workers: int | None, jobs: int) -> int:
    if workers is not None and workers < 1:
        raise ConfigError(f"workers is {workers}", expected="at least 1")
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(jobs, processors if workers is None else workers)


def _from_stream(
    module: ModuleType,
    source: Path,
    out: Path,
    wanted: Sequence[str],
    compression: str,
    images: bool,
    overwrite: bool,
    progress: Progress | None,
) -> ConvertReport:
    """Convert one after the other, with a converter that only has `read`.

    The first failure ends the conversion.
    """
    recordings: Iterable[Recording] = (r for r in module.read(source) if not wanted or r.name in wanted)
    recordings = iter(recordings)
    first = list(islice(recordings, 2))
    if not first:
        raise DataError("no sequence found", where=source, expected=" or ".join(wanted) or "at least one")
    report = ConvertReport()
    for recording in chain(first, recordings):
        (target,) = _targets([recording.name], out, many=len(first) > 1)
        kept = recording if images else replace(recording, frames={})
        write(kept, target, compression=compression, overwrite=overwrite)
        report.written.append(target)
        if progress is not None:
            progress(len(report.written), len(report.written), recording.name)
    missing = set(wanted) - {path.stem for path in report.written} if len(first) > 1 else set(wanted) - {first[0].name}
    report.failures.extend(Failure(name, f"{source}: holds no such sequence") for name in sorted(missing))
    return report
