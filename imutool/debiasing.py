"""Debias a log: copy it and add debiased samples, biases and their covariance.

Causal, unless `smooth` is asked for: the bias at a sample comes from that sample and earlier ones, once the start is known
(`imutool.bias_start.initial_bias`). Smoothing reads the log twice, and keeps thirteen numbers for each half second.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from imutool import __version__
from imutool.array_types import Float64
from imutool.bias import static
from imutool.bias.log_binding import rows_without_drift, with_drift
from imutool.bias.model import BiasModel
from imutool.bias_start import DEBIASED_BY, SUFFIX, Fitness, model_choice
from imutool.bias_start.bias_covariance import BiasEstimator
from imutool.bias_start.initial_bias import InitialBias
from imutool.bias_start.stretches import Sieve
from imutool.cleaning import Cleaner, CleaningSettings, Survey, look
from imutool.config import plain
from imutool.errors import ConfigError, LogError, ModelError
from imutool.file_location import Location, identity
from imutool.mcap_io import Verified
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.mcap_io.codec.encode import encode_imu, encode_twist, encode_vector3
from imutool.mcap_io.log import Log
from imutool.mcap_io.passthrough.added_topics import DerivedBatch, NewTopic, check_new_topics
from imutool.mcap_io.passthrough.source_digest import SourceDigest
from imutool.mcap_io.recovery.losses import Losses
from imutool.mcap_io.recovery.recovered_log import RecoveredLog
from imutool.mcap_io.repair import repaired
from imutool.mcap_io.rewrite import RewriteReport, Values, rewrite
from imutool.mcap_io.verify import check_mode
from imutool.recording import seconds
from imutool.report import Progress, json_values, silent

CLEAN_RECORD = "imutool_clean"
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class DebiasReport:
    """Models, initial biases, copy and losses of a debiased log, per IMU topic."""

    models: Mapping[str, str]
    starts: Mapping[str, InitialBias]
    rewrite: RewriteReport
    losses: Losses  # of a damaged source; empty as far as it was looked at (`check`)
    surveys: Mapping[str, Survey]  # of what was cleaned
    sieves: Mapping[str, Sieve]  # samples that are no measurement, and jumps of the clock
    fits: Mapping[str, Fitness]  # of the model for this log

    @property
    def lossy(self) -> bool:
        """Whether messages are missing: of a damaged source, or samples that are no measurement."""
        return bool(self.losses) or any(sieve.left_out for sieve in self.sieves.values())


class DebiasedBlock(NamedTuple):
    """Consecutive samples of one IMU as they are debiased: gyro (rad/s), then accel (m/s²)."""

    topic: str
    batch: ImuBatch  # raw
    bias: Float64[np.ndarray, "n 6"]  # what is subtracted
    std: Float64[np.ndarray, "n 6"]  # one standard deviation of it


ENCODINGS = ("own", "cdr")  # of the new IMU topic
BlockCallback = Callable[[DebiasedBlock], None]


def new_topics(source_topic: str) -> Sequence[NewTopic]:
    """Topics that an IMU gains: its debiased samples and what was subtracted."""
    schema_of = {SUFFIX: schemas.IMU, "/bias/gyro": schemas.VECTOR3, "/bias/accel": schemas.VECTOR3, "/bias": schemas.TWIST}
    return [NewTopic(f"{source_topic}{suffix}", schema) for suffix, schema in schema_of.items()]


class Debiaser:
    """Debiased topics of one IMU, computed by batches during the copy (`DerivedTopics`).

    With a survey the samples are cleaned first. `watch` is called with every batch.
    """

    def __init__(
        self,
        source_topic: str,
        model: BiasModel,
        start: InitialBias,
        found: Survey | None = None,
        watch: BlockCallback | None = None,
    ) -> None:
        self.source_topic, self._watch = source_topic, watch
        self._clean = None if found is None else Cleaner(found)
        self.topics = new_topics(source_topic)
        self._estimator, self._model = BiasEstimator(model, start), model
        self._start_ns: int | None = None
        self.sieve = Sieve(source_topic)
        self._white = np.diag(np.where(model.noise_std > 0, model.noise_std, start.noise) ** 2)

    def __call__(self, batch: ImuBatch) -> DerivedBatch:
        """Payloads of the corrected messages, of the two biases, and of both with their covariance.

        A corrected sample's covariance is that of its bias and the sensor's white noise.

        Raises:
            LogError: stamps that repeat or go back a little.
        """
        if self._clean is not None:
            batch = self._clean(batch)
        batch, t_ns = self.sieve(batch)
        self._start_ns = int(t_ns[0]) if self._start_ns is None and len(t_ns) else self._start_ns
        t_s = seconds(t_ns, self._start_ns or 0)
        gyro, accel = rows_without_drift(self._model, batch.stamp_ns, batch.gyro, batch.accel)
        bias, covariance = with_drift(self._model, batch.stamp_ns, *self._estimator(t_s, gyro, accel))
        if not (np.isfinite(bias).all() and np.isfinite(covariance).all()):
            raise ModelError("the model gives a bias that is not finite", where=self.source_topic, fix="Choose another `model`")
        total = covariance + self._white
        corrected = encode_imu(
            batch.stamp_ns,
            batch.gyro - bias[:, :3],
            batch.accel - bias[:, 3:],
            batch.frame_id,
            total[:, :3, :3].reshape(-1, 9),
            total[:, 3:, 3:].reshape(-1, 9),
        )
        payloads = (
            corrected,
            encode_vector3(batch.stamp_ns, np.ascontiguousarray(bias[:, :3]), batch.frame_id),
            encode_vector3(batch.stamp_ns, np.ascontiguousarray(bias[:, 3:]), batch.frame_id),
            encode_twist(batch.stamp_ns, bias[:, :3], bias[:, 3:], covariance, batch.frame_id),
        )
        if self._watch is not None and len(batch.stamp_ns):
            self._watch(DebiasedBlock(self.source_topic, batch, bias, np.sqrt(covariance.diagonal(axis1=1, axis2=2))))
        return DerivedBatch(batch, payloads)


def debias(
    source: Location,
    target: Location | None,
    *,
    model: str | Path | Mapping[str, str | Path] | None = None,
    imus: Sequence[str] = (),
    init: str = "auto",
    smooth: bool = False,
    check: str = "imu",
    max_chunk: int | None = None,
    clean: CleaningSettings | None = None,
    force: bool = False,
    overwrite: bool = False,
    encoding: str = "own",
    progress: Progress = silent,
    watch: BlockCallback | None = None,
) -> DebiasReport:
    """Writes `target`: all of `source`, and for each IMU its debiased samples and the bias.

    One model serves every IMU, or each has its own by topic, "" being that of all others. An IMU without one gets the one the
    log's metadata names, else the one that ships for its very sensor, else the mean at rest. The IMUs are those in `imus`, else
    those with a model of their own, else the log's only one. With `smooth` the initial bias comes from the whole log.
    Without a target the log itself is replaced; `check` is that of `mcap_io.rewrite`. The intact part of a damaged log is
    debiased from a repaired copy next to the target (`mcap_io.repair`), and `losses` lists the rest; it is not replaced. With
    `clean` a first pass finds samples to leave out or convert (`imutool.cleaning`); the record `imutool_clean` lists them.
    The new IMU has the type and encoding of its source, or with `encoding` "cdr" those of ROS 2.
    A chunk of more than `max_chunk` bytes is not read. A model that does not fit (`fitness`) is used only with `force`.
    `watch` is called with every batch of debiased samples, again when the copy of a damaged log is debiased.

    Raises:
        ConfigError: a file cannot be opened, or options contradict each other.
        LogError: nothing can be saved, no such IMU, one debiased already, damaged and its own target, or not to be trusted.
        ModelError: no model and no time at rest; a model for another rate, or one that does not fit; a damaged model file.
    """
    model_choice.check_start(init, smooth)
    check_mode(check)
    if encoding not in ENCODINGS:
        raise ConfigError(f"{encoding!r}", where="encoding", expected=" or ".join(ENCODINGS))
    options = _Options(model, imus, init, smooth, clean, check, force, overwrite, encoding, watch)
    refusal: LogError | None = None
    opened: tuple[int, str] | None = None
    try:
        if (log := _open_intact(source, max_chunk)) is not None:
            with log:
                opened = log.index.source.identity
                return _debias(log, source, Losses(), target, options, progress)
    except LogError as error:  # damage inside a chunk shows only here
        if opened is not None and identity(source) != opened:  # no damage: it is still being written
            raise
        refusal = error
    with repaired(source, target or source, max_chunk) as saved:
        if saved is None:
            assert refusal is not None, "an intact log was debiased, or refused"
            raise refusal
        if target is None:
            raise LogError("the log is damaged", where=source, fix="Give a target: in place, the damaged part would be gone")
        copy, losses = saved
        with Log(copy, max_chunk=max_chunk) as log:
            return _debias(log, source, losses, target, options, progress)


def _open_intact(source: Location, max_chunk: int | None) -> Log | None:
    """The log, opened; None where opening it shows damage."""
    with RecoveredLog(source, max_chunk=max_chunk) as log:
        return log.strict() if log.losses.intact else None


@dataclass(frozen=True)
class _Options:
    """The arguments of `debias`."""

    model: str | Path | Mapping[str, str | Path] | None
    imus: Sequence[str]
    init: str
    smooth: bool
    clean: CleaningSettings | None
    check: str
    force: bool
    overwrite: bool
    encoding: str
    watch: BlockCallback | None


def _debias(
    log: Log,
    source: Location,
    losses: Losses,
    target: Location | None,
    options: _Options,
    progress: Progress,
) -> DebiasReport:
    """Debiases an open log: the source itself, or the repaired copy of a damaged one."""
    given = dict(options.model) if isinstance(options.model, Mapping) else {} if options.model is None else {"": options.model}
    topics = model_choice.choose_imus(log, options.imus, given)
    check_new_topics(log, {topic: new_topics(topic) for topic in topics})
    by = log.metadata().get("imutool", {}).get(DEBIASED_BY)
    done = [f"by {by}"] if by else [f"as {name}" for name in topics if name in log.topics and log.topics[name].is_derived]
    if done and not options.force:
        raise LogError(f"its IMU is debiased already, {done[0]}", where=source, fix="Start from the raw log, or set `force`")
    log.keep(topics)
    surveys = {} if options.clean is None else {topic: look(log, topic, options.clean).trusted() for topic in topics}
    derived, starts, models, records, fits = [], {}, {}, {}, {}
    with SourceDigest(log.index, source) as digest:
        for topic in topics:
            named, survey = given.get(topic, given.get("")), surveys.get(topic)
            name = model_choice.model_of_log(log, topic) if named is None else named
            wrong = model_choice.warn_of_log(log, topic) if survey is None else []
            how = (options.init, options.smooth, survey, options.force)
            chosen, start = model_choice.choose_model_and_start(log, topic, name, *how)
            derived.append(Debiaser(topic, chosen, start, survey, options.watch))
            starts[topic], models[topic] = start, str(chosen.card.get("name", chosen.method))
            fit = model_choice.fitness_in_log(log, topic, chosen, start, survey).beside(wrong)
            fits[topic] = fit.report(models[topic], topic, force=options.force)
            records[topic] = _provenance(topic, chosen, start, options.init, options.smooth)
        sieves = {debiaser.source_topic: debiaser.sieve for debiaser in derived}

        def metadata(verified: Verified) -> Values:
            origin = {"source_file": source.name, "source_size": str(source.stat().st_size), **digest.result()}
            origin["verified"] = json.dumps(json_values(verified))
            entries = {_record_name("imutool", t, records): v | origin | sieves[t].record() for t, v in records.items()}
            return entries | {_record_name(CLEAN_RECORD, topic, records): found.record() for topic, found in surveys.items()}

        writing = {"overwrite": options.overwrite, "own_encoding": options.encoding == "own"}
        report = rewrite(log, target, derived, metadata=metadata, check=options.check, progress=progress, **writing)
    for topic, sieve in sieves.items():
        for text in sieve.warnings():
            logger.warning("%s %s: %s", source, topic, text)
    losses.unchecked_in = losses.unchecked_in or {0: report.unchecked}
    return DebiasReport(models, starts, report, losses, surveys, sieves, fits)


def _record_name(name: str, topic: str, records: Mapping[str, object]) -> str:
    """The name of a metadata record: with its topic where there are several IMUs."""
    return f"{name}{topic}" if len(records) > 1 else name


def _provenance(topic: str, model: BiasModel, start: InitialBias, init: str, smooth: bool) -> dict[str, str]:
    untrained = init == "auto" and model.method == static.Model.method
    return {
        "version": __version__,
        "command": "debias",
        "source_topic": topic,
        "model": str(model.card.get("name", model.method)),
        "model_sha256": str(model.card.get("sha256", "")),
        "method": model.method,
        "settings": json.dumps(plain(model.config)),
        "init": init,
        "init_how": start.how,
        "rest": json.dumps(start.rest.tolist()),
        "rest_std": json.dumps(start.std.tolist()),
        "smooth": "true" if smooth else "false",
        **({"temperature": model.log_drift.name} if model.log_drift else {}),
        # without a model: the mean over all rest, also later; an earlier load follows from the first two minutes
        "causal": "false" if smooth or model.load_before is not None or untrained else "true",
    }
