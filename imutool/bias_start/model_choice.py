"""Which model an IMU of a log gets and where its rest bias starts: from the log's first minute, or from a pass over all of it.

Everything is read through a survey (`imutool.cleaning`) where there is one. Memory does not grow with the log.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from imutool.bias import static
from imutool.bias.io import check_rate, find_model
from imutool.bias.model import BiasModel
from imutool.bias_start.bias_tracking import Samples
from imutool.bias_start.initial_bias import InitialBias, NoRestError, find, over_all_rest, smoothed_start
from imutool.cleaning import Survey, cleaned
from imutool.errors import ConfigError, DataError, LogError, ModelError
from imutool.inertial.stationary import Blocks, block_statistics, white_noise
from imutool.location import Location
from imutool.mcap_io.batches import ImuBatch
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.recording import Imu, Recording, nanoseconds, seconds

HEAD_S = 60.0  # of a log, read to find the start: a constant, however long the log


def refuse_smooth(init: str, smooth: bool) -> None:
    """Smoothing finds the start by itself.

    Raises:
        ConfigError: it is asked for together with a start that is given.
    """
    if smooth and init != "auto":
        raise ConfigError(f"`smooth` with `init` {init}", where="smooth", expected="`init` auto", fix="Give one of the two")


def prepare(
    source: Location, topic: str, name: str | Path | None, init: str, smooth: bool, found: Survey | None
) -> tuple[BiasModel, InitialBias]:
    """Model and start for one IMU."""
    untrained = name is None or str(name) == static.Model.method
    head = _head(source, topic, init, found)
    if untrained and init == "auto" and not smooth:
        with Log(source) as log:
            batches = ((batch.stamp_ns, batch.gyro, batch.accel) for batch in _imu_batches(log, topic, found))
            return _estimate(block_statistics(batches, head.imu.period_s), source)
    rate_hz = 1.0 / head.imu.period_s
    model: BiasModel = static.Model() if name is None or untrained else find_model(name, rate_hz)
    if not untrained:
        check_rate(model, rate_hz, source)
    if smooth:
        with Log(source) as log:  # a first pass, in constant memory but for the track
            start = _smoothed(model, _batches(log, topic, found), source)
    else:
        start = find(init, model, head)
    return model, start if start.noise.any() else replace(start, noise=_noise(head.imu))


def smooth_in_memory(model: BiasModel, imu: Imu, where: str | Location) -> InitialBias:
    """The rest bias in time from all of some samples.

    Raises:
        DataError: too few samples.
        ModelError: an untrained model, and no rest to measure a bias on.
    """
    t_s = seconds(imu.t_ns, int(imu.t_ns[0]) if len(imu) else 0)
    return _smoothed(model, [(t_s, imu.gyro, imu.accel)], where)


def _smoothed(model: BiasModel, batches: Iterable[Samples], where: str | Location) -> InitialBias:
    try:
        return smoothed_start(model, batches, str(where))
    except NoRestError as error:
        raise _nothing_known(where) from error


def _imu_batches(log: Log, topic: str, found: Survey | None, end_ns: int | None = None) -> Iterator[ImuBatch]:
    """An IMU's messages: as they must be, or as a survey says they are clean."""
    return log.imu_batches(topic, end_ns=end_ns) if found is None else cleaned(log, found, end_ns)


def _batches(log: Log, topic: str, found: Survey | None) -> Iterator[Samples]:
    """An IMU's samples, with seconds since the first."""
    start_ns = None
    for batch in _imu_batches(log, topic, found):
        if len(batch.stamp_ns):
            start_ns = int(batch.stamp_ns[0]) if start_ns is None else start_ns
            yield seconds(batch.stamp_ns, start_ns), batch.gyro, batch.accel


def _head(source: Location, topic: str, init: str, found: Survey | None) -> Recording:
    """The first minute of a log; of its truth only what is asked for, since it may be no business of the IMU's."""
    with Log(source) as log:
        first = next((int(times.min()) for times in log.stamps(topic) if len(times)), None)
    end_ns = None if first is None else first + nanoseconds(HEAD_S)
    if init.partition(":")[0] == "truth" and found is None:
        return read(source, imu=topic, end_ns=end_ns)
    samples = _samples(source, topic, found, end_ns if found is None else found.start_ns + nanoseconds(HEAD_S))
    if init.partition(":")[0] == "truth":
        return read(source, imu=topic, end_ns=end_ns, samples=samples)
    return Recording(source.stem, samples, imu_topic=topic, source=str(source))


def _samples(source: Location, topic: str, found: Survey | None, end_ns: int | None = None) -> Imu:
    """The samples of one IMU, as a survey says they are clean where there is one; its end is then by stamp.

    Raises:
        LogError: fewer than two, or none that a recording could hold.
    """
    with Log(source) as log:
        batches = list(_imu_batches(log, topic, found, end_ns))
        count = sum(len(batch.stamp_ns) for batch in batches)
        if count < 2:
            raise LogError(f"{topic} holds {count} messages", where=source, expected="at least 2")
        with log.named(topic):
            return Imu(*(np.concatenate([getattr(batch, c) for batch in batches]) for c in ("stamp_ns", "gyro", "accel")))


def _noise(imu: Imu) -> Float64[np.ndarray, "6"]:
    """White noise of a sample, for a model that does not know it and a log that does not rest."""
    return white_noise(np.concatenate([imu.gyro, imu.accel], axis=1))


def estimate_at_rest(imu: Imu, where: str | Location) -> tuple[BiasModel, InitialBias]:
    """The static model with its bias: the mean over all time at rest, for a log nobody trained a model for.

    Raises:
        DataError: fewer than two samples.
        ModelError: the log never rests.
    """
    return _estimate(block_statistics([(imu.t_ns, imu.gyro, imu.accel)], imu.period_s), where)


def _estimate(blocks: Blocks, where: str | Location) -> tuple[BiasModel, InitialBias]:
    model = static.Model()
    try:
        return model, over_all_rest(model, blocks)
    except DataError as error:
        raise _nothing_known(where) from error


def _nothing_known(where: str | Location) -> ModelError:
    return ModelError(
        "no model given, and the log holds no stretch at rest to measure a static bias on",
        where=where,
        expected="`model`, or at least 1.5 s without motion",
        fix="Give `model` (imutool models lists those that ship), or train one with imutool train",
    )
