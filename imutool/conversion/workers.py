"""Worker processes of a conversion: one log a job, with clean interrupts."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from imutool import registry
from imutool.config import toml
from imutool.conversion.correction_rounds import write_corrected
from imutool.conversion.corrections import Corrections
from imutool.conversion.message_writer import write_log
from imutool.conversion.shared_corrections import most_alike, shared
from imutool.conversion.user_labels import Labels
from imutool.errors import ConfigError, DataError, ImutoolError
from imutool.file_location import first_bytes
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.joined_imu import JOIN_VECTORS, unread_fix
from imutool.mcap_io.codec.records import MAGIC
from imutool.mcap_io.codec.reflection import Reflected
from imutool.mcap_io.log import Log
from imutool.mcap_io.storage.local import is_stream
from imutool.mcap_io.storage.target import copy_file, writing
from imutool.mcap_io.write import write
from imutool.processes.worker_pool import WorkerBugError, WorkerPool
from imutool.recording import Recording
from imutool.recording.message_log import MessageLog
from imutool.report import NamedProgress, Report, Section

GROUP = "imutool.converters"
SUFFIX = ".mcap"
MAP = "imutool/map"  # record of what a table's columns were taken for
SAME_COLUMNS = "its columns and units are taken for those of the other tables, which show them"
ORDER = "quaternion_wxyz"  # entry of that record
SAME_ORDER = "the order of its quaternions is that which most of the other tables show, as one program wrote them"


@dataclass(frozen=True)
class Job:
    """Job of a worker process: one log."""

    converter: str = ""
    sequence: Any = None  # the converter's own handle: has a `name`, and pickles
    target: Path = Path()
    compression: str = "zstd"
    images: bool = True
    overwrite: bool = False
    labels: Labels = field(default_factory=Labels)
    mapping: Path | Mapping[str, Any] | None = None  # what the columns of a table mean
    correct: tuple[str, ...] = ()  # `conventions`, `stamps`
    common: Corrections | None = None  # of the other logs of its setup
    note: str = ""  # on the job itself


class Failure(Section, frozen=True):
    """Failed sequence, with the reason."""

    name: str
    message: str


@dataclass(frozen=True)
class Outcome:
    """Outcome of a job: its error, or remarks on what was written."""

    error: ImutoolError | None = None
    notes: tuple[str, ...] = ()
    losses: tuple[str, ...] = ()
    corrections: Corrections = field(default_factory=Corrections)  # in one, without stamps
    mapping: Mapping[str, str] = field(default_factory=dict)  # of a table: what its columns were taken for


class ConvertReport(Report, frozen=True, tag="imutool.conversion/1"):
    """Written logs, in the order of the source, and failures."""

    written: list[Path]
    failures: list[Failure]
    notes: list[str]  # what is worth knowing about a log
    losses: list[str]  # what of a source is not in its log

    def add(self, target: Path, outcome: Outcome) -> None:
        """Enter a written log and the remarks on it."""
        self.written.append(target)
        self.notes.extend(f"{target.name}: {note}" for note in outcome.notes)
        self.losses.extend(f"{target.name}: {loss}" for loss in outcome.losses)

    def renamed(self, temporary: str, source: str) -> ConvertReport:
        """Report that names the source in place of the temporary folder."""
        failures = [Failure(failure.name, failure.message.replace(temporary, source)) for failure in self.failures]
        notes, losses = ([text.replace(temporary, source) for text in texts] for texts in (self.notes, self.losses))
        return ConvertReport(self.written, failures, notes, losses)


def run_jobs(jobs: Sequence[Job], of: int, workers: int, progress: NamedProgress) -> dict[int, Outcome]:
    """Outcomes of jobs by their numbers.

    `of` counts also sequences that cannot be read, and are no jobs. A log that lacks what most of the others show of their
    setup is converted once more, with that.
    """
    jobs, outcomes = [*jobs], dict(_run(jobs, of, workers, progress))
    for with_common in (_with_common_map, _with_common_order, _with_common_corrections):
        repeated = with_common(jobs, outcomes)
        numbers = [*repeated]
        for place, outcome in _run([*repeated.values()], len(repeated), workers, progress):
            if outcome.error is None:
                jobs[numbers[place]], outcomes[numbers[place]] = repeated[numbers[place]], outcome
    return outcomes


def _with_common_map(jobs: Sequence[Job], outcomes: Mapping[int, Outcome]) -> dict[int, Job]:
    """Jobs whose tables leave something open that most of the other tables show alike."""
    common = most_alike([outcome.mapping for outcome in outcomes.values() if outcome.mapping])
    if common is None:
        return {}
    asking = [n for n, outcome in outcomes.items() if isinstance(outcome.error, ConfigError) and jobs[n].mapping is None]
    return {n: replace(jobs[n], mapping=common, note=SAME_COLUMNS) for n in asking}


def _with_common_order(jobs: Sequence[Job], outcomes: Mapping[int, Outcome]) -> dict[int, Job]:
    """Jobs whose tables give quaternions in another order than most of the other tables with such columns."""
    alike: dict[frozenset[str], dict[int, str]] = {}
    for number, outcome in outcomes.items():
        if order := outcome.mapping.get(ORDER, ""):
            alike.setdefault(frozenset(column.lstrip("-") for column in order.split(", ")), {})[number] = order
    others = {
        number: common
        for orders in alike.values()
        if (common := most_alike([*orders.values()])) is not None
        for number, order in orders.items()
        if order != common
    }
    maps = {number: {**outcomes[number].mapping, ORDER: order} for number, order in others.items()}
    return {n: replace(jobs[n], mapping=mapping, note=SAME_ORDER, overwrite=True) for n, mapping in maps.items()}


def _with_common_corrections(jobs: Sequence[Job], outcomes: Mapping[int, Outcome]) -> dict[int, Job]:
    """Jobs whose logs lack a correction that most of the others share."""
    common, lacking = shared({n: outcome.corrections for n, outcome in outcomes.items() if outcome.error is None})
    return {n: replace(jobs[n], common=common, overwrite=True) for n in lacking}


def _run(jobs: Sequence[Job], of: int, workers: int, progress: NamedProgress) -> Iterator[tuple[int, Outcome]]:
    """Yield each job's number and outcome, as the jobs end."""
    each = min(workers, len(jobs))
    done = ((n, _convert_one(job)) for n, job in enumerate(jobs)) if each <= 1 else _run_in_processes(jobs, each)
    for count, (number, outcome) in enumerate(done, start=1):
        progress(of - len(jobs) + count, of, jobs[number].sequence.name)
        yield number, outcome


def _convert_one(job: Job) -> Outcome:
    try:
        module = registry.load(GROUP, job.converter)
        given = {} if job.mapping is None else {"mapping": job.mapping}
        if given and "mapping" not in inspect.signature(module.read_sequence).parameters:
            raise ConfigError(f"{job.converter} reads no tables", where="mapping", expected="a table")
        return write_content(module.read_sequence(job.sequence, images=job.images, **given), job)
    except DataError as error:
        known = error.where is not None and str(job.sequence.path) in error.where
        where = str(job.sequence) if error.where is None else f"{job.sequence}: {error.where}"
        return Outcome(error if known else type(error)(error.what, where=where, expected=error.expected, fix=error.fix))
    except ImutoolError as error:
        return Outcome(error)


def write_content(content: Recording | MessageLog, job: Job) -> Outcome:
    """Write what a converter has read, with the user's labels, corrected as the job says.

    Raises:
        ImutoolError: it cannot be written.
    """
    if is_stream(job.target):  # what is written is read again, which a stream does not allow
        with TemporaryDirectory() as folder:
            recorded = Path(folder) / job.target.with_suffix(SUFFIX).name
            outcome = write_content(content, replace(job, target=recorded))
            copy_file(recorded, job.target, overwrite=True)
            return outcome
    if job.correct:
        with writing(job.target):
            holder = TemporaryDirectory(prefix=".imutool-", dir=job.target.parent)
        with holder as folder:
            recorded = Path(folder) / job.target.name
            outcome = write_content(content, replace(job, target=recorded, correct=()))
            fixes = job.correct, job.common
            notes, found = write_corrected(recorded, job.target, *fixes, compression=job.compression, overwrite=job.overwrite)
            return replace(outcome, notes=(*outcome.notes, *notes), corrections=found)
    labelled = job.labels.put_on(content)
    if job.note and isinstance(labelled, MessageLog) and labelled.remarks.doubts:  # what others show does not hold here
        raise ConfigError(labelled.remarks.doubts[0], where=str(job.sequence))
    if isinstance(labelled, Recording):
        write(labelled, job.target, compression=job.compression, overwrite=job.overwrite)
        return Outcome(None, _said(labelled, "skipped", "repairs"), _said(labelled, "losses"))
    write_log(labelled, job.target, compression=job.compression, overwrite=job.overwrite)
    with Log(job.target) as log:
        every = {topic.message_encoding for topic in log.topics.values()}, {t.schema_encoding for t in log.topics.values()}
        unread = f". {fix}" if (fix := unread_fix(*every)) else ""
        joined = JOIN_VECTORS if len(log.with_schema((schemas.VECTOR3,))) > 1 else unread
        lacking = () if log.imu_topics else (f"no topic is an IMU{joined}",)
        own = {name: topic.reflected for name, topic in log.topics.items() if isinstance(topic.reflected, Reflected)}
    stated = [f"{name}: {found.units}, by the comments of its definition" for name, found in own.items() if found.units]
    stated += [f"{name}: {found.compensated}" for name, found in own.items() if found.compensated]
    notes = *filter(None, [job.note]), *labelled.remarks.notes, *stated, *lacking
    return Outcome(None, notes, tuple(labelled.remarks.losses), mapping=labelled.metadata.get(MAP, {}))


def _said(recording: Recording, *names: str) -> tuple[str, ...]:
    """Sentences of a recording's records on what of its source is not in it, or otherwise."""
    records = (recording.metadata.get(f"imutool/{name}", {}) for name in names)
    return tuple(f"{place}: {what}" for record in records for place, what in record.items())


def _run_in_processes(jobs: Sequence[Job], workers: int) -> Iterator[tuple[int, Outcome]]:
    """Run jobs in processes; after an interrupt they remove what they have half written."""
    with WorkerPool(convert_numbered, workers) as pool:
        for done in pool.run(enumerate(jobs)):
            number, job = done.item
            if isinstance(done.error, WorkerBugError):
                done.error.add_note(done.error.trace)
                raise done.error
            why = f"its process died ({done.error}), perhaps for want of memory"
            died = DataError(why, where=str(job.sequence), fix="Use fewer `workers`")
            yield number, done.value if done.error is None else Outcome(died)


def convert_numbered(item: tuple[int, Job]) -> Outcome:
    """Convert a job with its number, in a worker process."""
    return _convert_one(item[1])


def check_targets(jobs: Sequence[Job], source: Path) -> None:
    """Refuse to overwrite a log, a source, or another log of the same run.

    Raises:
        ConfigError: a target is one of these.
    """
    jobs_by_target: dict[Path, Job] = {}
    for job in jobs:
        if (other := jobs_by_target.setdefault(job.target, job)) is not job:
            what = f"two sequences are named {job.sequence.name}: {other.sequence} and {job.sequence}"
            raise ConfigError(what, where="source", fix="Convert them one at a time")
        sources = getattr(job.sequence, "path", None), source if source.is_file() else None, *_other_files(job)
        if any(path is not None and _is_part_of(job.target, path) for path in sources):
            raise ConfigError("is the source itself", where=job.target, expected="another `out`")
        if is_stream(job.target):
            continue
        if job.target.exists() and not job.overwrite:
            raise ConfigError("exists", where=job.target, fix="Choose another `out`, or add `overwrite`")
        if (
            job.target.is_file()
            and job.target.suffix.lower() != SUFFIX
            and first_bytes(job.target, len(MAGIC)) not in (MAGIC, b"")
        ):
            fix = "One command converts one file, or a folder of them"  # a shell makes two words of *.csv
            raise ConfigError("exists and is no MCAP log", where=job.target, expected="another `out`", fix=fix)


def _other_files(job: Job) -> list[Path]:
    """Parts of a bag, the map, and the poses that it names; they are read only where a log may replace them."""
    if not job.target.exists():
        return []
    module = registry.load(GROUP, job.converter)
    parts: list[Path] = module.parts(job.sequence) if hasattr(module, "parts") else []
    if job.mapping is None:
        return parts
    own = [job.mapping] if isinstance(job.mapping, Path) else []
    entries = toml(job.mapping, "map of a table") if isinstance(job.mapping, Path) else job.mapping
    place = getattr(job.sequence, "path", job.target)
    poses = (place if place.is_dir() else place.parent) / str(entries.get("truth_file", ""))
    return [path for path in (*parts, *own, poses) if path.is_file()]


def _is_part_of(target: Path, source: Path) -> bool:
    """Whether a target is the source or one of its files.

    A log in the source's folder is not one of its files.
    """
    if not target.exists():
        return False
    inside = source.is_dir() and target.resolve().is_relative_to(source.resolve()) and target.suffix.lower() != SUFFIX
    return inside or target.samefile(source)
