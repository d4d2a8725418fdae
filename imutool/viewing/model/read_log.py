"""What a log holds that can be looked at: its IMU, also where that is not sound, and what was derived from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from imutool.cleaning import Cleaner, CleaningSettings, Survey
from imutool.cleaning.first_pass import examine
from imutool.cleaning.truth import Truth, of_poses
from imutool.errors import DataError, LogError
from imutool.location import Location
from imutool.mcap_io.batches import ImuBatch
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import TwistColumns
from imutool.mcap_io.log import Log
from imutool.mcap_io.losses import told
from imutool.mcap_io.read import recording_in
from imutool.mcap_io.topics import DERIVED_KEY
from imutool.recording import Imu, Recording
from imutool.viewing.model.run_data import Logged, Run

FEWEST = 2  # samples that make a log
NONE = Imu(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class Recorded:
    """A log as it was read; `debiased` are the channels in it that imutool derived from this IMU.

    `survey` is of the messages as they are; `notes` say what could not be read, and what was left out for that.
    """

    recording: Recording
    logged: Logged
    debiased: tuple[Run, ...]
    survey: Survey
    metadata: Sequence[tuple[str, Mapping[str, str]]]
    notes: tuple[str, ...]


class _Read(NamedTuple):
    """What one pass over the log brings: messages as they are, and a recording of all but the IMU."""

    topic: str
    derived: list[str]
    batches: dict[str, list[ImuBatch]]
    beliefs: dict[str, list[TwistColumns]]
    rest: Recording
    metadata: list[tuple[str, dict[str, str]]]


def recorded(path: Location, *, imu: str | None = None, truth: str | None = None) -> Recorded:
    """Reads a log for looking at it.

    An IMU that cannot be held as it is (stamps that repeat or go back, values that are no numbers) is read as `debias --clean`
    would, also where that would not trust it; of a damaged log what can be proven. True poses that cannot be held are left out,
    unless they were asked for. The notes say each of these.

    Raises:
        ConfigError: the file cannot be opened.
        LogError: nothing in it can be saved, no IMU or several without `imu`, fewer than two samples, no such topic.
    """
    notes: list[str] = []
    try:
        found = _read(path, imu, truth, notes, salvage=False)
    except LogError:  # a sound log is read faster than one that nothing vouches for; what is no damage is refused again
        notes.clear()
        found = _read(path, imu, truth, notes, salvage=True)
    topic, derived, batches, beliefs, rest, metadata = found
    where = f"{path} {topic}"
    survey = examine(lambda: batches[topic], _true(rest), CleaningSettings(), where=str(path), topic=topic)
    samples, logged, why = _held(batches[topic], survey, where)
    if why:
        left = f"{survey.messages - survey.valid} of {survey.messages} messages are left out"
        notes.append(f"{topic} cannot be shown as it was recorded ({why}); as by debias --clean, {left}.")
    if survey.reasons:
        notes.append(f"{topic} cannot be trusted: {'; '.join(survey.reasons)}.")
    model = _model(metadata, topic)
    debiased = []
    for name in derived:
        run = _run(name, model, samples, batches[name], beliefs)
        if run is None:
            notes.append(f"{name} is left out: its samples are not those of {topic}.")
        else:
            debiased.append(run)
    return Recorded(replace(rest, imu=samples), logged, tuple(debiased), survey, metadata, tuple(notes))


def _read(path: Location, imu: str | None, truth: str | None, notes: list[str], *, salvage: bool) -> _Read:
    def refused(name: str, error: LogError) -> None:
        notes.append(f"The true poses on {name} are left out: {error.what}.")

    with Log(path, salvage=salvage) as log:
        topic = log.only_imu() if imu is None else log.topic(imu, (schemas.IMU,)).name
        derived = [one.name for one in log.with_schema((schemas.IMU,)) if one.metadata.get(DERIVED_KEY) == topic]
        biases = [one.name for one in log.with_schema((schemas.TWIST,)) if one.metadata.get(DERIVED_KEY) == topic]
        batches, beliefs = _messages(log, [topic, *derived], biases)
        rest = recording_in(log, imu=topic, truth=truth, samples=NONE, derived=False, refused=None if truth else refused)
        metadata = log.metadata_records()
        if log.losses is not None:
            notes += [f"The log is damaged; {line}." for line in told(log.losses.plain())]
    return _Read(topic, derived, batches, beliefs, rest, metadata)


def _messages(
    log: Log, imus: Sequence[str], biases: Sequence[str]
) -> tuple[dict[str, list[ImuBatch]], dict[str, list[TwistColumns]]]:
    """The messages of some IMUs and biases in one pass, as they are."""
    samples: dict[str, list[ImuBatch]] = {name: [] for name in imus}
    beliefs: dict[str, list[TwistColumns]] = {name: [] for name in biases}
    for topic, rows in log.rows([*imus, *biases]):
        with log.named(topic):
            if topic in samples:
                samples[topic] += log.decode_imu(topic, rows)
            else:
                beliefs[topic] += log.decode_twist(topic, rows)
    return samples, beliefs


def _true(recording: Recording) -> Truth | None:
    return next((of_poses(topic, poses) for topic, poses in recording.truths.items()), None)


def _held(batches: Sequence[ImuBatch], survey: Survey, where: str) -> tuple[Imu, Logged, str]:
    """The samples with the log times of their messages: as they are, or cleaned, and then why.

    Raises:
        LogError: fewer than two are left.
    """
    why = ""
    try:
        samples, logged = _columns(batches)
    except DataError as error:
        why = error.what
        samples, logged = _columns(list(map(Cleaner(survey), batches)))
    if len(samples) < FEWEST:
        raise LogError(f"has {len(samples)} samples that can be shown", where=where, expected=f"at least {FEWEST}")
    return samples, logged, why


def _columns(batches: Sequence[ImuBatch]) -> tuple[Imu, Logged]:
    stamp_ns = np.concatenate([np.zeros(0, np.int64), *(batch.stamp_ns for batch in batches)])
    log_ns = np.concatenate([np.zeros(0, np.int64), *(batch.log_time for batch in batches)])
    gyro, accel = (
        np.concatenate([np.zeros((0, 3)), *(getattr(batch, name) for batch in batches)]) for name in ("gyro", "accel")
    )
    return Imu(stamp_ns, gyro, accel), Logged(stamp_ns, log_ns)


def _model(metadata: Sequence[tuple[str, Mapping[str, str]]], topic: str) -> str:
    """The model that `debias` noted for this IMU last; empty where it noted none."""
    ours = [values for name, values in metadata if name.startswith("imutool") and values.get("model")]
    named = [values["model"] for values in ours if values.get("source_topic", topic) == topic]
    return named[-1] if named else ""


def _run(
    name: str, model: str, raw: Imu, batches: Sequence[ImuBatch], beliefs: Mapping[str, Sequence[TwistColumns]]
) -> Run | None:
    """A debiased channel with the bias and its certainty beside it in the log; else the bias by subtraction at equal stamps."""
    try:
        imu, _ = _columns(batches)
    except DataError:
        return None
    called = f"in the log: {model}" if model else name.rpartition("/")[2]
    for parts in filter(None, beliefs.values()):
        stamp_ns, angular, linear, variance = (np.concatenate(column) for column in list(zip(*parts, strict=True))[:4])
        sound = all(np.isfinite(column).all() for column in (angular, linear, variance)) and (variance >= 0.0).all()
        if sound and np.array_equal(stamp_ns, imu.t_ns):
            return Run(called, imu, angular, linear, np.sqrt(variance))
    rows = np.minimum(np.searchsorted(raw.t_ns, imu.t_ns), len(raw) - 1)
    if len(imu) < FEWEST or not np.array_equal(raw.t_ns[rows], imu.t_ns):
        return None
    return Run(called, imu, raw.gyro[rows] - imu.gyro, raw.accel[rows] - imu.accel)
