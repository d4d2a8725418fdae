"""Worker processes of a conversion: one log a job, with clean interrupts."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from imutool import registry
from imutool.conversion.correction_rounds import write_corrected
from imutool.conversion.corrections import Corrections
from imutool.conversion.message_writer import write_log
from imutool.conversion.user_labels import Labels
from imutool.errors import ConfigError, DataError, ImutoolError
from imutool.mcap_io.log import Log
from imutool.mcap_io.storage.target import writing
from imutool.mcap_io.write import write
from imutool.processes.worker_pool import WorkerBugError, WorkerPool
from imutool.recording import Recording
from imutool.recording.message_log import MessageLog

GROUP = "imutool.converters"


@dataclass(frozen=True)
class Job:
    """Job of a worker process: one log."""

    converter: str
    sequence: Any  # the converter's own handle: has a `name`, and pickles
    target: Path = Path()
    compression: str = "zstd"
    images: bool = True
    overwrite: bool = False
    labels: Labels = field(default_factory=Labels)
    mapping: Path | Mapping[str, Any] | None = None  # what the columns of a table mean
    correct: tuple[str, ...] = ()  # `conventions`, `stamps`
    common: Corrections | None = None  # of the other logs of its setup


@dataclass(frozen=True)
class Outcome:
    """Outcome of a job: its error, or remarks on what was written."""

    error: ImutoolError | None = None
    notes: tuple[str, ...] = ()
    losses: tuple[str, ...] = ()
    corrections: Corrections = field(default_factory=Corrections)  # in one, without stamps


def run_jobs(jobs: Sequence[Job], workers: int) -> Iterator[tuple[int, Outcome]]:
    """Yield each job's number and outcome, as the jobs end."""
    if workers <= 1:
        for number, job in enumerate(jobs):
            yield number, _convert_one(job)
    else:
        yield from _run_in_processes(jobs, workers)


def _convert_one(job: Job) -> Outcome:
    try:
        module = registry.load(GROUP, job.converter)
        given = {} if job.mapping is None else {"mapping": job.mapping}
        if given and "mapping" not in inspect.signature(module.read_sequence).parameters:
            raise ConfigError(f"{job.converter} reads no tables", where="mapping", expected="a table")
        content = module.read_sequence(job.sequence, images=job.images, **given)
        return write_content(content, job)
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
    if job.correct:
        with writing(job.target):
            holder = TemporaryDirectory(prefix=".imutool-", dir=job.target.parent)
        with holder as folder:
            recorded = Path(folder) / job.target.name
            outcome = write_content(content, replace(job, target=recorded, correct=()))
            ways = job.correct, job.common
            notes, found = write_corrected(recorded, job.target, *ways, compression=job.compression, overwrite=job.overwrite)
            return replace(outcome, notes=(*outcome.notes, *notes), corrections=found)
    labelled = job.labels.put_on(content)
    if isinstance(labelled, Recording):
        write(labelled, job.target, compression=job.compression, overwrite=job.overwrite)
        return Outcome()
    write_log(labelled, job.target, compression=job.compression, overwrite=job.overwrite)
    with Log(job.target) as log:
        lacking = () if log.imu_topics else ("no topic is an IMU",)
    return Outcome(None, (*labelled.remarks.notes, *lacking), tuple(labelled.remarks.losses))


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
