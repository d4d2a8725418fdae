"""Conversion of data sets to MCAP: find the sequences, choose a converter, write the logs.

Sequences convert in worker processes, one log a sequence; a sequence that fails is reported and the others go on.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from pathlib import Path, PurePosixPath
from types import ModuleType
from typing import Any

from imutool import registry
from imutool.conversion.unread_formats import blamed, is_pointer, left_out_below, nothing_found, pointers_in
from imutool.conversion.workers import (
    GROUP,
    SUFFIX,
    ConvertReport,
    Failure,
    Job,
    check_targets,
    run_jobs,
    write_content,
)
from imutool.errors import ConfigError, DataError, ImutoolError, did_you_mean
from imutool.file_location import local
from imutool.mcap_io.storage.local import is_stream, removed_if_empty
from imutool.processes.system import processors
from imutool.recording import Recording
from imutool.recording.message_log import MessageLog
from imutool.report import NamedProgress, silent

AUTO = "auto"


@dataclass
class _Sequences:
    """Recognised sequences of a source, and the others with their errors."""

    jobs: list[Job] = field(default_factory=list)
    errors: list[tuple[str, ImutoolError]] = field(default_factory=list)
    places: list[str] = field(default_factory=list)  # of both
    empty: list[str] = field(default_factory=list)  # packed files without a sequence

    def add(self, unpacked: _Sequences, packed: Any) -> None:
        """Take in the sequences and errors of packed files."""
        self.jobs += unpacked.jobs
        self.errors += [*unpacked.errors, *packed.errors]
        inside = [Path(place) for place in unpacked.places]
        parts = [place for place in packed.places.values() if place.is_file() and place.parent in inside]  # as of a bag
        self.empty = [
            n for n, place in packed.places.items() if not any(path.is_relative_to(place) for path in (*inside, *parts))
        ]

    def names(self) -> list[str]:
        return [job.sequence.name for job in self.jobs] + [name for name, _ in self.errors]


def convert(
    source: Path,
    out: str | Path,
    template: Job,
    *,
    format: str = AUTO,
    sequences: Sequence[str] = (),
    workers: int | None = None,
    progress: NamedProgress = silent,
) -> ConvertReport:
    """Convert one sequence to the file `out`, or several to the folder, as `imutool.convert`.

    `template` is what the job of each sequence has in common; `out` with a slash at its end is a folder.

    Raises:
        DataError: no converter recognises anything in the source.
        ConfigError: unknown format or sequence, a pipe, two of one name, a target that exists or cannot be made.
        ImutoolError: the only sequence there is (or was asked for) failed; of several, failures go to the report.
    """
    if format != AUTO and not hasattr(module := registry.load(GROUP, format, "format"), "sequences"):
        return _from_stream(module, source, out, sequences, replace(template, converter=format), progress)
    if is_stream(source) and not source.is_file():  # its reader would wait, and a converter reads it more than once
        raise ConfigError("is a pipe or a device", where=source, expected="a file or a folder", fix="Write it to a file first")
    if is_pointer(source):
        raise nothing_found(source, packed=False)
    found = _find(source, format, Path(out))
    if found.names() and not source.is_dir():
        return _convert_found(found, source, out, sequences, template, workers, progress)
    unpack = next(module.unpacked for _, module in _converters(AUTO) if hasattr(module, "unpacked"))
    with unpack(source, Path(out), found.places) as packed:
        if packed.root is not None:
            found.add(_find(packed.content, format, Path(out)), packed)
        if not found.names():
            error = nothing_found(packed.content, packed=packed.root is not None)
            advice = error.fix or "Leave `format` out: then the recording is recognised"
            raise error if format == AUTO else error.replaced(expected=f"a recording of the format {format}", fix=advice)
        report = _convert_found(found, source, out, sequences, template, workers, progress)
        report.losses.extend(left_out_below(packed.content))
    if packed.root is None:
        return report
    names = [name for name in packed.places if name not in found.empty] if source.is_dir() else [source.name]
    report.notes[:0] = [f"{name}: it is packed, and was unpacked into a temporary folder" for name in names]
    report.notes.extend(f"{name}: it is packed, and nothing in it shows that it is a recording" for name in found.empty)
    return report.renamed(str(packed.root), str(source))


def _convert_found(
    source_sequences: _Sequences,
    source: Path,
    out: str | Path,
    sequences: Sequence[str],
    template: Job,
    workers: int | None,
    progress: NamedProgress,
) -> ConvertReport:
    """Write a log of each sequence, or of those asked for."""
    if sequences:
        source_sequences = _only(source_sequences, sequences)
    names = source_sequences.names()
    with removed_if_empty(Path(out).parent), removed_if_empty(Path(out)):
        targets = _targets([job.sequence.name for job in source_sequences.jobs], out, many=len(names) > 1)
        jobs = [
            replace(template, converter=job.converter, sequence=job.sequence, target=target)
            for job, target in zip(source_sequences.jobs, targets, strict=True)
        ]
        if len(names) == 1 and source_sequences.errors:
            raise blamed(source_sequences.errors[0][1], pointers_in(source))
        check_targets(jobs, source)
        outcomes = run_jobs(jobs, len(names), _worker_count(workers, len(jobs)), progress)
    failed = [(jobs[n].sequence.name, outcome.error) for n, outcome in sorted(outcomes.items()) if outcome.error is not None]
    errors = [*source_sequences.errors, *failed]
    pointers = pointers_in(source) if errors else []
    if len(names) == 1 and failed:
        raise blamed(failed[0][1], pointers)
    report = ConvertReport([], [Failure(name, str(blamed(error, pointers))) for name, error in errors], [], [])
    for number, outcome in sorted(outcomes.items()):
        if outcome.error is None:
            report.add(jobs[number].target, outcome)
    return report


def _find(source: Path, format: str, out: Path) -> _Sequences:
    """Find every sequence of the source, with its converter; of its own logs none below `out`.

    Raises:
        ConfigError: a sequence is claimed twice.
    """
    claims: dict[str, list[Job]] = {}
    errors: dict[str, tuple[str, ImutoolError]] = {}
    for key, module in _converters(format):
        for sequence in module.sequences(source):
            claimed = claims.setdefault(str(sequence), [])
            if claimed and is_general(module):
                continue  # a data set's own converter knows more
            try:
                if format != AUTO or is_general(module) or module.recognises(sequence):
                    claimed.append(Job(key, sequence))
                elif not claimed:
                    reason = DataError("no converter recognises it", where=str(sequence), fix="Choose one with `format`")
                    errors.setdefault(str(sequence), (sequence.name, reason))
            except ImutoolError as error:
                errors[str(sequence)] = (sequence.name, error)
    if not claims and source.is_dir():  # logs of its own are sources where nothing else is, as for `fix`
        found = ((key, m.own_logs(source)) for key, m in _converters(format) if hasattr(m, "own_logs"))
        outside = ((key, log) for key, own in found for log in own if not log.path.resolve().is_relative_to(out.resolve()))
        claims = {str(log): [Job(key, log)] for key, log in outside}
    for place, jobs in claims.items():
        if len(jobs) > 1:
            keys = " and ".join(job.converter for job in jobs)
            raise ConfigError(f"is recognised as {keys}", where=place, fix="Choose one with `format`")
    return _Sequences(
        _told_apart([job for jobs in claims.values() for job in jobs], source),
        [error for place, error in errors.items() if not claims[place]],
        [*claims, *errors],
    )


def _told_apart(jobs: list[Job], source: Path) -> list[Job]:
    """The jobs, whose sequences have their folders in front of a name that several have: `path_1_IMU`, `path_2_IMU`."""
    count = Counter(job.sequence.name for job in jobs)
    return [job if count[job.sequence.name] == 1 else _with_folders(job, source) for job in jobs]


def _with_folders(job: Job, source: Path) -> Job:
    """The job with its folders in front; a file that is named as its folder gets its own name back."""
    name, inside, folder = job.sequence.name, job.sequence.inside, source.resolve()
    path = job.sequence.path.parent.resolve() / job.sequence.path.name  # which may be a link out of the folder
    below = path.relative_to(folder).parts if path.is_relative_to(folder) else ()
    stem = path.stem if below and inside and not name.startswith(path.stem) else ""
    folders = [*below[:-1], *filter(None, [stem]), *PurePosixPath(inside).parts[:-1]]
    name = path.stem if not inside and below[-2:-1] == (name,) and path.is_file() else name
    return replace(job, sequence=replace(job.sequence, name="_".join([*folders, name])))


def _converters(format: str) -> list[tuple[str, ModuleType]]:
    """Converters that find sequences by themselves, those of data sets first."""
    keys = registry.names(GROUP) if format == AUTO else [format]
    modules = [(key, registry.load(GROUP, key)) for key in keys]
    return sorted(((key, m) for key, m in modules if hasattr(m, "sequences")), key=lambda item: is_general(item[1]))


def is_general(module: ModuleType) -> bool:
    """Whether a converter reads a file format, whatever data set it is from."""
    return bool(getattr(module, "GENERAL", False))


def _only(source_sequences: _Sequences, wanted: Sequence[str]) -> _Sequences:
    """Requested sequences.

    Raises:
        ConfigError: a sequence is not in the source; the message names the nearest.
    """
    names = source_sequences.names()
    for name in wanted:
        if name not in names:
            expected, fix = f"one of {', '.join(sorted(names))}", did_you_mean(name, names, "{!r}")
            raise ConfigError(f"{name!r} is not in the source", where="sequences", expected=expected, fix=fix)
    return _Sequences(
        [job for job in source_sequences.jobs if job.sequence.name in wanted],
        [(name, error) for name, error in source_sequences.errors if name in wanted],
    )


def _targets(names: Sequence[str], out: str | Path, *, many: bool) -> list[Path]:
    """Target of each log; missing folders are made. A text that ends with a slash names a folder.

    Raises:
        ConfigError: several logs but `out` names a file, it is a URL or a stream, or a folder cannot be made.
    """
    slash, out = str(out).endswith(("/", os.sep)), local(str(out), "out")
    if many and (out.suffix.lower() == SUFFIX or out.is_file() or is_stream(out)):
        some = ", ".join([*names[:3], *["..."][: len(names) > 3]])
        raise ConfigError(f"several sequences do not fit into one file ({some})", where=out, expected="a folder")
    into_folder = many or slash or out.is_dir()
    folder = out if into_folder else out.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot be made ({error.strerror})", where=folder, expected="a writable place") from error
    return [out / f"{name}{SUFFIX}" if into_folder else out for name in names]


def _worker_count(workers: int | None, jobs: int) -> int:
    if workers is not None and workers < 1:
        raise ConfigError(f"workers is {workers}", expected="at least 1")
    return min(jobs, processors() if workers is None else workers)


def _from_stream(
    module: ModuleType,
    source: Path,
    out: str | Path,
    wanted: Sequence[str],
    template: Job,
    progress: NamedProgress,
) -> ConvertReport:
    """Convert one after the other, with a converter that only has `read`.

    The first failure ends the conversion.
    """
    recordings: Iterator[Recording | MessageLog] = (r for r in module.read(source) if not wanted or r.name in wanted)
    first = list(islice(recordings, 2))
    if not first:
        raise DataError("no sequence found", where=source, expected=" or ".join(wanted) or "at least one")
    report = ConvertReport([], [], [], [])
    for recording in chain(first, recordings):
        (target,) = _targets([recording.name], out, many=len(first) > 1)
        if target in report.written:
            what, fix = f"two sequences are named {recording.name}", "Its converter has to tell them apart"
            raise ConfigError(what, where=source, fix=fix)
        check_targets([job := replace(template, sequence=recording, target=target)], source)
        kept = replace(recording, frames={}) if isinstance(recording, Recording) and not template.images else recording
        report.add(target, write_content(kept, job))
        progress(len(report.written), len(report.written), recording.name)
    missing = set(wanted) - {path.stem for path in report.written} if len(first) > 1 else set(wanted) - {first[0].name}
    report.failures.extend(Failure(name, f"{source}: holds no such sequence") for name in sorted(missing))
    return report
