"""Choose the bias model and the initial bias for an IMU of a log.

With a survey the samples are cleaned (`imutool.cleaning`). Memory does not grow with the log.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from imutool.array_types import Int64
from imutool.bias import static
from imutool.bias.log_binding import at_rate, bound, rows_without_drift, without_drift
from imutool.bias.model import BiasModel
from imutool.bias.model_file import shared_model, shipped, shipped_for
from imutool.bias_start import Fitness
from imutool.bias_start.bias_at_rest import UNUSUAL, at_rest, auto, over_all_rest, refuted_stops
from imutool.bias_start.bias_from_truth import from_truth, truth_seconds
from imutool.bias_start.bias_tracking import Samples
from imutool.bias_start.earlier_load import with_earlier_load
from imutool.bias_start.fitness import CHECKED_S, head, judge
from imutool.bias_start.initial_bias import (
    METHODS,
    InitialBias,
    NoRestError,
    bias_prior,
    from_numbers,
    model_samples,
    smoothed_start,
    tracked_from_prior,
    training_source,
)
from imutool.bias_start.stretches import Sieve, measured_rows
from imutool.cleaning import Survey, cleaned
from imutool.cleaning.samples import refuse_mixed
from imutool.cleaning.survey import raw_batches
from imutool.cleaning.truth import read_truth
from imutool.errors import ConfigError, DataError, LogError, ModelError
from imutool.file_location import Location, log_name
from imutool.inertial.stationary import CALM, Blocks, block_statistics, white_noise
from imutool.log_info.convention_report import contradictions, warn_of_conventions
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import longest_recording, read_recordings
from imutool.mcap_io.temperature import temperatures
from imutool.mcap_io.write import about_imu
from imutool.recording import Imu, Recording, nanoseconds, seconds

HEAD_S = 60.0  # start of a log that the search for the initial bias reads


def check_start(init: str, smooth: bool) -> None:
    """Refuse an unknown start, and smoothing with a given one: it estimates its own.

    Raises:
        ConfigError: an `init` that is none, or `smooth` with an `init` other than `auto`.
    """
    if init.startswith("truth:"):
        truth_seconds(init)
    elif init not in METHODS:
        from_numbers(init)
    if smooth and init != "auto":
        raise ConfigError(f"`smooth` with `init={init}`", where="smooth", expected="`init=auto`", fix="Give one of the two")


def find_initial_bias(init: str, model: BiasModel, recording: Recording) -> InitialBias:
    """Initial bias by the method that `init` names.

    Raises:
        ConfigError: an unknown method, or not six numbers.
        DataError: `stationary` on a log that does not start at rest, `truth` without truth at its start, or `auto` with an
            untrained model and no stationary stretch.
    """
    recording = replace(recording, imu=without_drift(model, measured_rows(recording.imu)))
    if init == "prior":
        return replace(tracked_from_prior(model, int(recording.imu.t_ns[0])), how=training_source(model), follows=None)
    if init == "truth" or init.startswith("truth:"):
        return from_truth(model, recording, truth_seconds(init))
    from_samples = {"stationary": at_rest, "auto": auto}.get(init)
    return from_numbers(init) if from_samples is None else from_samples(model, recording.imu)


def choose_imus(log: Log, imus: Sequence[str], given: Mapping[str, str | Path]) -> list[str]:
    """The IMUs to debias, each once.

    Raises:
        ConfigError: a model that none of them would use.
        LogError: none is named, and the log has not exactly one.
    """
    own = [topic for topic in given if topic]
    topics = list(dict.fromkeys(log.topic(name, (schemas.IMU,)).name for name in imus or own or [log.only_imu()]))
    for topic in own:
        if topic not in topics:
            raise ConfigError(
                f"a model for {topic}, which is not to be debiased",
                where="model",
                expected=", ".join(topics),
                fix=f"Add {topic} to `imus`, or leave the model out",
            )
    if "" in given and all(topic in given for topic in topics):
        raise ConfigError(
            f"{given['']} is for all IMUs without a model of their own, and each has one",
            where="model",
            fix="Leave it out, or name the other IMUs in `imus`",
        )
    return topics


def model_of_log(log: Log, topic: str) -> str | Path | None:
    """Model that a log's metadata name for an IMU; it ships, as anybody may write a log."""
    about = about_imu(log.metadata().get("imutool", {}), topic)
    name = about.get("model") if about.get("source_topic", topic) == topic else None  # that of another IMU
    if name == static.Model.method:
        return name
    return shipped(name, f"{log.path}, metadata imutool") if name else next(iter(shipped_for(about)), None)


def choose_model_and_start(
    log: Log, topic: str, name: str | Path | None, init: str, smooth: bool, survey: Survey | None, force: bool
) -> tuple[BiasModel, InitialBias]:
    """Bias model and initial bias for one IMU of a log."""
    if survey is None and not force:
        refuse_mixed(raw_batches(log, topic), topic, log.path)
    untrained = name is None or str(name) == static.Model.method
    first_minute = _first_minute(log, topic, init, survey)
    period_s, start_ns = first_minute.imu.period_s, int(first_minute.imu.t_ns[0])
    if untrained and init == "auto" and not smooth:
        batches = ((t_ns, batch.gyro, batch.accel) for batch, t_ns in _imu_batches(log, topic, survey))
        return _estimate(block_statistics(batches, period_s), log.path)
    model: BiasModel = static.Model() if name is None or untrained else shared_model(name, 1.0 / period_s)
    model = at_rate(model, 1.0 / period_s, log.path, first_minute.imu.t_ns, force=force)
    if model.temperature_parameters():
        model = bound(model, temperatures(log), topic, start_ns, start_ns + _duration_ns(log, topic))
    model = with_earlier_load(model, _Batches(log, topic, survey, model), start_ns)
    if smooth:
        start = _smoothed(model, _Batches(log, topic, survey, model), log.path, start_ns)
    else:
        start = find_initial_bias(init, model, first_minute)
    if not start.noise.any():  # neither the model nor rest shows it
        samples = np.concatenate([first_minute.imu.gyro, first_minute.imu.accel], axis=1)
        start = replace(start, noise=CALM * white_noise(samples, period_s))
    return model, start


def bound_to(model: BiasModel, recording: Recording, where: str | Location = "", *, force: bool = False) -> BiasModel:
    """Model at a recording's rate, with the drifts by its temperature and by the load before.

    Raises:
        ModelError: as `at_rate`.
    """
    t_ns = recording.imu.t_ns
    model = at_rate(model, 1.0 / recording.imu.period_s, where or recording.name, t_ns, force=force)
    model = bound(model, recording.scalars, recording.imu_topic, int(t_ns[0]), int(t_ns[-1]))
    return with_earlier_load(model, [model_samples(model, recording.imu)], int(t_ns[0]))


def warn_of_log(log: Log, topic: str) -> list[str]:
    """Contradicted axes at the start of a log, after warnings of all units, axes and frames."""
    end_ns = _after(log, topic, CHECKED_S)
    samples, truth = _samples(log, topic, None, end_ns), read_truth(log, end_ns=end_ns)
    return contradictions(warn_of_conventions(samples, truth, f"{log.path} {topic}"))


def _after(log: Log, topic: str, length_s: float) -> int | None:
    """Log time so much after the first message of a topic; None without any."""
    first = next((int(times.min()) for times in log.stamps(topic) if len(times)), None)
    return None if first is None else first + nanoseconds(length_s)


def _duration_ns(log: Log, topic: str) -> int:
    """Log time from the first to the last block that may hold a topic."""
    blocks = [block for block in log.index.blocks if block.may_hold(log.channel_ids(topic))]
    return max((block.end_ns for block in blocks), default=0) - min((block.start_ns for block in blocks), default=0)


def fitness_in_log(log: Log, topic: str, model: BiasModel, start: InitialBias, survey: Survey | None) -> Fitness:
    """Fitness of a model, started in a log, for one of its IMUs."""
    return judge(model, start, _Batches(log, topic, survey, model), about_imu(log.metadata().get("imutool", {}), topic))


def fitness_in_memory(model: BiasModel, start: InitialBias, recording: Recording, wrong: Sequence[str]) -> Fitness:
    """Fitness of a model, started in a recording; `wrong` are its contradicted axes."""
    return judge(model, start, [model_samples(model, recording.imu)], recording.metadata.get("imutool", {})).beside(wrong)


def smooth_in_memory(model: BiasModel, imu: Imu, where: str | Location) -> InitialBias:
    """Smoothed rest bias in time from all samples.

    Raises:
        DataError: too few samples.
        ModelError: an untrained model, and no rest to measure a bias on.
    """
    return _smoothed(model, [model_samples(model, imu)], where, int(imu.t_ns[0]) if len(imu) else 0)


def _smoothed(model: BiasModel, batches: Iterable[Samples], where: str | Location, first_ns: int) -> InitialBias:
    before = bias_prior(model, first_ns)
    try:
        start = smoothed_start(model, batches, before, str(where))
        unusual = np.linalg.norm((start.rest - before.mean)[:3] / before.std[:3]) > UNUSUAL
        if not (model.card and unusual and refuted_stops(head(batches), model)):
            return start
        start = smoothed_start(model, batches, replace(before, stops=False), str(where))
    except NoRestError as error:
        raise _no_start(where) from error
    return replace(start, how=f"{start.how}; its stops are steady turns")


def _imu_batches(
    log: Log, topic: str, survey: Survey | None, end_ns: int | None = None
) -> Iterator[tuple[ImuBatch, Int64[np.ndarray, " n"]]]:
    """Measured samples and their times (ns) on a `StretchClock`, cleaned where there is a survey."""
    sieve = Sieve(f"{log.path} {topic}")
    for batch in raw_batches(log, topic, end_ns=end_ns) if survey is None else cleaned(log, survey, end_ns):
        with log.named(topic):
            found = sieve(batch)
        yield found
    sieve.refuse_nothing()


@dataclass(frozen=True)
class _Batches:
    """IMU samples with seconds since the first, without the model's drift, read from the log each time."""

    log: Log
    topic: str
    survey: Survey | None
    model: BiasModel

    def __iter__(self) -> Iterator[Samples]:
        start_ns = None
        for batch, t_ns in _imu_batches(self.log, self.topic, self.survey):
            if len(t_ns):
                start_ns = int(t_ns[0]) if start_ns is None else start_ns
                gyro, accel = rows_without_drift(self.model, batch.stamp_ns, batch.gyro, batch.accel)
                yield seconds(t_ns, start_ns), gyro, accel


def _first_minute(log: Log, topic: str, init: str, survey: Survey | None) -> Recording:
    """First minute of a log, with truth only where `init` asks for it."""
    end_ns = _after(log, topic, HEAD_S)
    samples = _samples(log, topic, survey, end_ns if survey is None else survey.start_ns + nanoseconds(HEAD_S))
    if init.partition(":")[0] == "truth":
        return longest_recording(read_recordings(log, imu=topic, end_ns=end_ns, samples=samples))
    return Recording(log_name(log.path), samples, imu_topic=topic, source=str(log.path))


def _samples(log: Log, topic: str, survey: Survey | None, end_ns: int | None) -> Imu:
    """Samples of one IMU; with a survey they are cleaned, and `end_ns` refers to stamps."""
    batches = list(_imu_batches(log, topic, survey, end_ns))
    count = sum(len(t_ns) for _, t_ns in batches)
    if count < 2:
        raise LogError(f"{topic} holds {count} messages", where=log.path, expected="at least 2")
    gyro, accel = (np.concatenate([getattr(batch, column) for batch, _ in batches]) for column in ("gyro", "accel"))
    with log.named(topic):
        return Imu(np.concatenate([t_ns for _, t_ns in batches]), gyro, accel)


def estimate_at_rest(imu: Imu, where: str | Location) -> tuple[BiasModel, InitialBias]:
    """Static model and the mean bias over all rest, for a log without a model.

    Raises:
        DataError: fewer than two samples.
        ModelError: the log never rests.
    """
    kept = measured_rows(imu)
    if len(kept) < 2:  # raw counts, for instance
        raise DataError(f"{len(kept)} of {len(imu)} samples are a measurement", where=where, fix="See imutool info LOG")
    return _estimate(block_statistics([(kept.t_ns, kept.gyro, kept.accel)], kept.period_s), where)


def _estimate(blocks: Blocks, where: str | Location) -> tuple[BiasModel, InitialBias]:
    try:
        return (model := static.Model()), over_all_rest(model, blocks)
    except DataError as error:
        raise _no_start(where) from error


def _no_start(where: str | Location) -> ModelError:
    return ModelError(
        "the log holds no stretch at rest to measure a static bias on",
        where=where,
        expected="a trained `model`, or at least 1.5 s without motion",
        fix="Give `model` (imutool models lists those that ship), or train one with imutool train; true poses show the bias, "
        "too: `init` truth; if imutool info finds other units, correct them first with imutool convert LOG OUT --fix",
    )
