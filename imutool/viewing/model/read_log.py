"""Read a log for viewing: its IMU, also where it is unsound, and derived channels."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from imutool.cleaning import Cleaner, CleaningSettings, Survey
from imutool.cleaning import rows as rows_of
from imutool.cleaning.samples import BLOCK
from imutool.cleaning.survey import examine
from imutool.cleaning.truth import truth_of
from imutool.errors import DataError, LogError
from imutool.file_location import Location
from imutool.log_info.pose_imu_rotation import sparse_warnings
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import UNSET_FIX, ImuBatch, TwistColumns
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import joined_column, longest_recording, read_recordings
from imutool.mcap_io.recovery.losses import describe
from imutool.mcap_io.recovery.recovered_log import RecoveredLog
from imutool.mcap_io.temperature import with_temperatures
from imutool.mcap_io.topics import DERIVED_KEY
from imutool.recording import Imu, Recording
from imutool.recording.columns import clock_jumps, jump_warnings, longest_run
from imutool.viewing.model.run_data import IN_LOG, LogTimes, Run

MIN_SAMPLES = 2  # samples that make a log, and poses that make a trajectory
NO_SAMPLES = Imu(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class LogContents:
    """Contents of a log; `debiased` are the channels that imutool derived from this IMU.

    `survey` covers the messages as recorded; `notes` list what could not be read and what was left out. `opened` opens the
    log again, in the way it could be read.
    """

    recording: Recording
    logged: LogTimes
    debiased: tuple[Run, ...]
    survey: Survey
    metadata: Sequence[tuple[str, Mapping[str, str]]]
    notes: tuple[str, ...]
    opened: Callable[[Location], Log] = Log


def read_log(path: Location, *, imu: str | None = None, truth: str | None = None) -> LogContents:
    """Read a log for viewing.

    An IMU that no `Imu` can hold (stamps that repeat or go back, values that are not finite) is cleaned as `debias --clean`
    does, also where that would not trust it. Of one whose clock is set the longest stretch is shown. Of a damaged log the
    verified records are read. True poses that no `Poses` can hold are left out unless `truth` names them. The notes list each
    of these.

    Raises:
        ConfigError: the file cannot be opened.
        LogError: nothing can be recovered, no IMU, several without `imu` (unless one of them was debiased), fewer than two
            samples, no such topic.
    """
    notes: list[str] = []
    opened: Callable[[Location], Log] = Log
    try:
        contents = _read(Log(path), imu, truth, notes)
    except LogError:  # reading with recovery is slower; an error that is not damage comes again
        notes.clear()
        opened = RecoveredLog
        contents = _read(opened(path), imu, truth, notes)
    topic, derived, messages, biases_by_topic, rest, metadata = contents
    where = f"{path} {topic}"
    true = truth_of(rest)
    survey = examine(partial(_blocks, messages[topic]), true, CleaningSettings(), where=str(path), topic=topic)
    samples, logged, why = _sound_samples(messages[topic], survey, where)
    if why:
        text = f"{survey.messages - survey.valid} of {survey.messages} messages are left out"
        notes.append(f"{topic} cannot be shown as it was recorded ({why}); as by debias --clean, {text}.")
    notes += [f"{topic}: {warning}." for warning in jump_warnings(clock_jumps(samples.t_ns))]
    notes += [f"{warning[0].upper()}{warning[1:]}." for warning in ([] if true is None else sparse_warnings(true))]
    if survey.reasons:
        notes.append(f"{topic} cannot be trusted: {'; '.join(survey.reasons)}.")
    model, start = _model_and_start(metadata, topic)
    debiased = []
    for name in derived:
        run = _run(name, model, samples, messages[name], biases_by_topic)
        if run is None:
            notes.append(f"{name} is left out: its samples are not those of {topic}.")
        else:
            debiased.append(replace(run, start=start))
    shown = samples.rows(longest_run(samples.t_ns))
    if len(shown) < len(samples):
        shares = f"{len(shown)} of {len(samples)} samples, from {shown.t_ns[0]} to {shown.t_ns[-1]} ns"
        notes.append(f"Only the longest stretch of {topic} on one setting of its clock is shown: {shares}.")
        debiased = [run.between(int(shown.t_ns[0]), int(shown.t_ns[-1])) for run in debiased]
    return LogContents(replace(rest, imu=shown), logged, tuple(debiased), survey, metadata, tuple(notes), opened)


def _read(
    opened: Log, imu: str | None, truth: str | None, notes: list[str]
) -> tuple[str, list[str], dict[str, ImuBatch], dict[str, list[TwistColumns]], Recording, list[tuple[str, dict[str, str]]]]:
    """IMU topic and its derived ones, messages and biases as recorded, a recording of all else, and the metadata."""

    def refused(name: str, error: LogError) -> None:
        notes.append(f"The true poses on {name} are left out: {error.what}.")

    with opened as log:
        debiased = {t.metadata.get(DERIVED_KEY, "") for t in log.with_schema((schemas.IMU,))} & {*log.imu_topics}
        shown = debiased.pop() if imu is None and len(debiased) == 1 else imu  # of several IMUs the one that was debiased
        topic = log.only_imu() if shown is None else log.topic(shown, (schemas.IMU,)).name
        derived = [channel.name for channel in log.with_schema((schemas.IMU,)) if channel.metadata.get(DERIVED_KEY) == topic]
        biases = [channel.name for channel in log.with_schema((schemas.TWIST,)) if channel.metadata.get(DERIVED_KEY) == topic]
        messages, biases_by_topic = _messages(log, [topic, *derived], biases)
        found = read_recordings(
            log, imu=topic, truth=truth, samples=NO_SAMPLES, derived=False, refused=None if truth else refused
        )
        rest = longest_recording(with_temperatures(found, log))
        few = {} if truth else {name: len(poses) for name, poses in rest.truths.items() if len(poses) < MIN_SAMPLES}
        notes += [f"The true poses on {name} are left out: {count} of them are in the log." for name, count in few.items()]
        rest = replace(rest, truths={name: poses for name, poses in rest.truths.items() if name not in few})
        metadata = log.metadata_records()
        if isinstance(log, RecoveredLog):
            notes += [f"The log is damaged; {line}." for line in describe(log.losses.plain())]
    return topic, derived, messages, biases_by_topic, rest, metadata


def _messages(
    log: Log, imus: Sequence[str], biases: Sequence[str]
) -> tuple[dict[str, ImuBatch], dict[str, list[TwistColumns]]]:
    """Messages of some IMUs and biases, read in one pass."""
    samples: dict[str, list[ImuBatch]] = {name: [] for name in imus}
    biases_by_topic: dict[str, list[TwistColumns]] = {name: [] for name in biases}
    for topic, rows in log.rows([*imus, *biases]):
        with log.named(topic):
            if topic in samples:
                samples[topic] += log.topics[topic].decode_imu(rows)
            else:
                biases_by_topic[topic] += log.topics[topic].decode_twist(rows)
    return {name: _whole(samples.pop(name)) for name in imus}, biases_by_topic


def _whole(batches: list[ImuBatch]) -> ImuBatch:
    """Messages of an IMU as whole columns, which the samples share; the list is emptied."""
    none, frame_id = np.zeros(0, np.int64), batches[0].frame_id if batches else ""
    batches.append(ImuBatch(none, none, none.astype(np.uint32), none, np.zeros((0, 3)), np.zeros((0, 3)), ""))
    columns_of_batches = [list(column) for column in list(zip(*batches, strict=True))[:-1]]
    batches.clear()
    columns = [joined_column(columns_of_batches.pop(0)) for _ in range(len(columns_of_batches))]
    for column in columns:  # so that the samples need no copy
        column.flags.writeable = False
    return ImuBatch._make([*columns, frame_id])


def _blocks(messages: ImuBatch) -> Iterator[ImuBatch]:
    for first in range(0, len(messages.stamp_ns), BLOCK):
        yield rows_of(messages, slice(first, first + BLOCK))


def _sound_samples(messages: ImuBatch, survey: Survey, where: str) -> tuple[Imu, LogTimes, str]:
    """Samples with the log times of their messages: as recorded, or cleaned with the reason.

    Raises:
        LogError: fewer than two are left.
    """
    why = ""
    try:
        samples, logged = _columns(messages)
    except DataError as error:
        why = error.what
        samples, logged = _columns(Cleaner(survey)(messages))
    if len(samples) < MIN_SAMPLES:
        what, unset = f"has {len(samples)} samples that can be shown", survey.messages >= MIN_SAMPLES and not survey.end_ns
        raise LogError(what, where=where, expected=f"at least {MIN_SAMPLES}", fix=UNSET_FIX if unset else "")
    return samples, logged, why


def _columns(messages: ImuBatch) -> tuple[Imu, LogTimes]:
    stamp_ns = messages.stamp_ns
    return Imu(stamp_ns, messages.gyro, messages.accel), LogTimes(stamp_ns, messages.log_time)


def _model_and_start(metadata: Sequence[tuple[str, Mapping[str, str]]], topic: str) -> tuple[str, str]:
    """Model and `init` that `debias` recorded last for this IMU; empty where it recorded none."""
    ours = [values for name, values in metadata if name.startswith("imutool") and values.get("model")]
    named = [values for values in ours if values.get("source_topic", topic) == topic]
    return (named[-1]["model"], named[-1].get("init", "")) if named else ("", "")


def _run(
    name: str, model: str, raw: Imu, messages: ImuBatch, biases_by_topic: Mapping[str, Sequence[TwistColumns]]
) -> Run | None:
    """Debiased channel with bias and sigma from the log, else bias = raw - debiased per stamp."""
    try:
        imu, _ = _columns(messages)
    except DataError:
        return None
    called = f"{IN_LOG}{model}" if model else name.rpartition("/")[2]
    for parts in filter(None, biases_by_topic.values()):
        stamp_ns, angular, linear, variance = (np.concatenate(column) for column in list(zip(*parts, strict=True))[:4])
        sound = all(np.isfinite(column).all() for column in (angular, linear, variance)) and (variance >= 0.0).all()
        if sound and np.array_equal(stamp_ns, imu.t_ns):
            return Run(called, imu, angular, linear, np.sqrt(variance))
    rows = np.minimum(np.searchsorted(raw.t_ns, imu.t_ns), len(raw) - 1)
    if len(imu) < MIN_SAMPLES or not np.array_equal(raw.t_ns[rows], imu.t_ns):
        return None
    return Run(called, imu, raw.gyro[rows] - imu.gyro, raw.accel[rows] - imu.accel)
