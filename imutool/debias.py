"""A model at work: over a whole log, over a recording in memory, or one sample at a time; always the same numbers.

Causal throughout, unless `smooth` is asked for: the bias at a sample comes from that sample and earlier ones, once the start
is known (`imutool.turn_on`). Smoothing reads the log twice; of the first pass it keeps thirteen numbers for each half second.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from imutool import __version__
from imutool.bias import static
from imutool.bias._base import BiasModel, OneByOne, Stream, Vector6
from imutool.bias._file import check_rate, find_model, shipped_for
from imutool.certainty import Certainty
from imutool.config import plain
from imutool.errors import ConfigError, DataError, LogError, ModelError
from imutool.mcap_io import schema
from imutool.mcap_io.log import Clock, ImuBatch, Log
from imutool.mcap_io.read import read
from imutool.mcap_io.rewrite import Made, NewTopic, RewriteReport, rewrite, sha256
from imutool.place import Place
from imutool.recording import Imu, Recording, nanoseconds, seconds
from imutool.rest_track import Samples
from imutool.stationary import white_noise
from imutool.turn_on import NoRestError, TurnOn, find, following, over_all_rest
from imutool.turn_on import smooth as smooth_rest

HEAD_S = 60.0  # of a log, read to find the start: a constant, however long the log
SUFFIX = "/debiased"


class Debiased(NamedTuple):
    """Corrected samples and what was subtracted: gyro (rad/s), then accel (m/s²)."""

    imu: Imu
    bias: Float64[np.ndarray, "n 6"]


@dataclass(frozen=True)
class DebiasReport:
    """What was done to a log, one entry per IMU topic."""

    models: Mapping[str, str]
    starts: Mapping[str, TurnOn]
    rewrite: RewriteReport


def apply(model: BiasModel, start: TurnOn, imu: Imu) -> Debiased:
    """A model over samples in memory, from their first on."""
    bias = start.stream(model)(seconds(imu.t_ns, int(imu.t_ns[0])), imu.gyro, imu.accel)
    return Debiased(Imu(imu.t_ns, imu.gyro - bias[:, :3], imu.accel - bias[:, 3:]), bias)


class OnlineDebiaser:
    """One sample in, one corrected sample out: for a live node.

    The start is a rest bias from `imutool.turn_on`, for instance `at_rest` over the first seconds, or `prior`. Without one, it
    begins at the prior and is followed by what the samples show, as by `--init auto`.
    """

    def __init__(self, model: BiasModel, start: TurnOn | None = None) -> None:
        stream = (start or following(model)).stream(model)
        self._one, self._start_ns = stream.one if isinstance(stream, OneByOne) else _by_blocks(stream), -1

    def __call__(
        self, stamp_ns: int, gyro: Float64[np.ndarray, "3"], accel: Float64[np.ndarray, "3"]
    ) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"], Float64[np.ndarray, "6"]]:
        """Corrected angular rate (rad/s) and specific force (m/s²), and the bias that was subtracted."""
        if self._start_ns < 0:
            self._start_ns = stamp_ns
        u = np.concatenate((gyro, accel))
        bias = self._one((stamp_ns - self._start_ns) * 1e-9, u)
        clean = u - bias
        return clean[:3], clean[3:], bias


def _by_blocks(stream: Stream) -> Callable[[float, Vector6], Vector6]:
    """One sample as a block of one, for a stream that knows no shorter way."""

    def one(t_s: float, u: Vector6) -> Vector6:
        bias: Vector6 = stream(np.array([t_s]), u[None, :3], u[None, 3:])[0]
        return bias

    return one


class Debiaser:
    """The channels a log gains, computed batch by batch as the log is copied (`mcap_io.rewrite.Derived`)."""

    def __init__(self, source_topic: str, model: BiasModel, start: TurnOn) -> None:
        self.source_topic = source_topic
        self.topics: Sequence[NewTopic] = (
            NewTopic(f"{source_topic}{SUFFIX}", schema.IMU),
            NewTopic(f"{source_topic}/bias/gyro", schema.VECTOR3),
            NewTopic(f"{source_topic}/bias/accel", schema.VECTOR3),
            NewTopic(f"{source_topic}/bias", schema.TWIST),
        )
        self._stream, self._start_ns = start.stream(model), -1
        self._clock = Clock()
        self._certainty = Certainty(model, start, self._stream)
        noise = model.noise_std.detach().cpu().double().numpy()
        self._white = np.diag(np.where(noise > 0, noise, start.noise) ** 2)

    def __call__(self, batch: ImuBatch) -> Made:
        """Payloads of the corrected messages, of the two biases, and of both with their covariance.

        A corrected sample's covariance is that of its bias and the sensor's white noise.

        Raises:
            LogError: samples no model can take: NaN, or stamps that do not increase.
        """
        self._clock.take(batch)
        if self._start_ns < 0 and len(batch.stamp_ns):
            self._start_ns = int(batch.stamp_ns[0])
        t_s = seconds(batch.stamp_ns, self._start_ns)
        bias = self._stream(t_s, batch.gyro, batch.accel)
        unsure = self._certainty(t_s, batch.gyro, batch.accel)
        total = unsure + self._white
        corrected = schema.encode_imu(
            batch.stamp_ns,
            batch.gyro - bias[:, :3],
            batch.accel - bias[:, 3:],
            batch.frame_id,
            total[:, :3, :3].reshape(-1, 9),
            total[:, 3:, 3:].reshape(-1, 9),
        )
        payloads = (
            corrected,
            _vector(batch.stamp_ns, bias[:, :3], batch.frame_id),
            _vector(batch.stamp_ns, bias[:, 3:], batch.frame_id),
            schema.encode_twist(batch.stamp_ns, bias[:, :3], bias[:, 3:], unsure, batch.frame_id),
        )
        return Made(batch, payloads)


def debias(
    source: Place,
    target: Place,
    *,
    model: str | Path | None = None,
    imus: Sequence[str] = (),
    init: str = "auto",
    smooth: bool = False,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> DebiasReport:
    """Writes `target`: all of `source` unchanged, and beside each IMU its debiased samples and the bias taken off.

    Without a model: the one the log's metadata names, else the one that ships for its sensor, else the mean over time at rest.
    With `smooth` the start bias at every time comes from the whole log, also from what follows.

    Raises:
        ConfigError: source or target cannot be opened, `init` makes no sense, or `smooth` is asked for with another `init`.
        LogError: the log is damaged, has no such IMU, or is debiased already.
        ModelError: no model and no time at rest; a model for another rate; a damaged model file.
    """
    refuse_smooth(init, smooth)
    with Log(source) as log:
        topics = list(imus) or [_only_imu(log)]
        about = log.metadata().get("imutool", {})
    named = about.get("model") or shipped_for(about.get("sensor"), about.get("dataset"))
    derived, starts, models, records = [], {}, {}, {}
    origin = {"source_file": source.name, "source_sha256": sha256(source), "source_size": str(source.stat().st_size)}
    for topic in topics:
        chosen, start = _prepare(source, topic, model or named, init, smooth)
        derived.append(Debiaser(topic, chosen, start))
        starts[topic], models[topic] = start, str(chosen.card.get("name", chosen.method))
        records[topic] = _provenance(topic, chosen, start, init, smooth) | origin
    metadata = {"imutool" if len(records) == 1 else f"imutool{topic}": values for topic, values in records.items()}
    report = rewrite(source, target, derived, metadata=metadata, overwrite=overwrite, progress=progress)
    return DebiasReport(models, starts, report)


def refuse_smooth(init: str, smooth: bool) -> None:
    """Smoothing finds the start by itself.

    Raises:
        ConfigError: it is asked for together with a start that is given.
    """
    if smooth and init != "auto":
        raise ConfigError(f"--smooth with --init {init}", where="--smooth", expected="--init auto", fix="Give one of the two")


def estimate_at_rest(imu: Imu, where: str | Place) -> tuple[BiasModel, TurnOn]:
    """The static model with its bias: the mean over all time at rest, for a log nobody trained a model for.

    Raises:
        ModelError: the log never rests.
    """
    model = static.Model()
    try:
        return model, over_all_rest(model, imu)
    except DataError as error:
        raise _nothing_known(where) from error


def _nothing_known(where: str | Place) -> ModelError:
    return ModelError(
        "no model given, and the log holds no stretch at rest to measure a static bias on",
        where=where,
        expected="--model, or at least 1.5 s without motion",
        fix="Give --model (imutool models lists those that ship), or train one with imutool train",
    )


def _only_imu(log: Log) -> str:
    """The log's IMU, if there is one and only one."""
    found = log.imu_topics
    if len(found) != 1:
        listed = ", ".join(found) or "none"
        raise LogError(f"IMU topics: {listed}", where=log.path, expected="one", fix="Choose with --imu" if found else "")
    return found[0]


def _prepare(source: Place, topic: str, name: str | Path | None, init: str, smooth: bool) -> tuple[BiasModel, TurnOn]:
    """Model and start for one IMU."""
    untrained = name is None or str(name) == static.Model.method
    if untrained and init == "auto" and not smooth:
        return estimate_at_rest(_samples(source, topic), source)
    head = _head(source, topic, init)
    rate_hz = 1.0 / head.imu.period_s
    model: BiasModel = static.Model() if name is None or untrained else find_model(name, rate_hz)
    if not untrained:
        check_rate(model, rate_hz, source)
    if smooth:
        with Log(source) as log:  # a first pass, in constant memory but for the track
            start = _smoothed(model, _batches(log, topic), source)
    else:
        start = find(init, model, head)
    return model, start if start.noise.any() else replace(start, noise=_noise(head.imu))


def smooth_in_memory(model: BiasModel, imu: Imu, where: str | Place) -> TurnOn:
    """The rest bias in time from all of some samples.

    Raises:
        DataError: too few samples.
        ModelError: an untrained model, and no rest to measure a bias on.
    """
    t_s = seconds(imu.t_ns, int(imu.t_ns[0]) if len(imu) else 0)
    return _smoothed(model, [(t_s, imu.gyro, imu.accel)], where)


def _smoothed(model: BiasModel, batches: Iterable[Samples], where: str | Place) -> TurnOn:
    try:
        return smooth_rest(model, batches, str(where))
    except NoRestError as error:
        raise _nothing_known(where) from error


def _batches(log: Log, topic: str) -> Iterator[Samples]:
    """An IMU's samples, with seconds since the first."""
    start_ns = None
    for batch in log.imu_batches(topic):
        if len(batch.stamp_ns):
            start_ns = int(batch.stamp_ns[0]) if start_ns is None else start_ns
            yield seconds(batch.stamp_ns, start_ns), batch.gyro, batch.accel


def _head(source: Place, topic: str, init: str) -> Recording:
    """The first minute of a log; of its truth only what is asked for, since it may be no business of the IMU's."""
    with Log(source) as log:
        first = next((int(times.min()) for times in log.stamps(topic) if len(times)), None)
    end_ns = None if first is None else first + nanoseconds(HEAD_S)
    if init.partition(":")[0] == "truth":
        return read(source, imu=topic, end_ns=end_ns)
    return Recording(source.stem, _samples(source, topic, end_ns), imu_topic=topic, source=str(source))


def _samples(source: Place, topic: str, end_ns: int | None = None) -> Imu:
    """The samples of one IMU.

    Raises:
        LogError: fewer than two, or none that a recording could hold.
    """
    with Log(source) as log:
        batches = list(log.imu_batches(topic, end_ns=end_ns))
        count = sum(len(batch.stamp_ns) for batch in batches)
        if count < 2:
            raise LogError(f"{topic} holds {count} messages", where=source, expected="at least 2")
        with log.named(topic):
            return Imu(*(np.concatenate([getattr(batch, c) for batch in batches]) for c in ("stamp_ns", "gyro", "accel")))


def _noise(imu: Imu) -> Float64[np.ndarray, "6"]:
    """White noise of a sample, for a model that does not know it and a log that does not rest."""
    return white_noise(np.concatenate([imu.gyro, imu.accel], axis=1))


def _provenance(topic: str, model: BiasModel, start: TurnOn, init: str, smooth: bool) -> dict[str, str]:
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
        # without a model: the mean over all rest, also later
        "causal": "false" if smooth or (init == "auto" and model.method == static.Model.method) else "true",
    }


def _vector(stamp_ns: Int64[np.ndarray, " n"], values: Float64[np.ndarray, "n 3"], frame_id: str) -> UInt8[np.ndarray, "n L"]:
    return schema.encode_vector3(stamp_ns, np.ascontiguousarray(values), frame_id)
