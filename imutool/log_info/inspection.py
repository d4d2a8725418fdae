"""Inspection of a log: clocks, IMU defects and noise, coverage by the truth.

Images are never unpacked; an IMU's columns are held in memory. Defects are counted where reading the log would stop at the
first: stamps that go back, repeated stamps, and values that are not finite.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from imutool.array_types import Bool, Float64, Int64
from imutool.cleaning import raw_batches
from imutool.cleaning.rule import TopicSummary
from imutool.cleaning.rules import not_finite, saturation
from imutool.cleaning.rules.gaps import PAUSE_NS, missing, pause_words
from imutool.cleaning.stamp_line import Stamps, distinct, read_stamps, restamped, usual_period
from imutool.cleaning.truth import Truth, read_truth
from imutool.file_location import Location, log_name
from imutool.inertial.stationary import rest_stretches
from imutool.log_info.convention_report import (
    QUATERNIONS,
    constant_sensors,
    convention_summary,
    convention_warnings,
    conventions,
    coverage,
    made_by_convert,
    transforms,
    truth_warnings,
)
from imutool.log_info.pose_imu_rotation import agreement
from imutool.log_info.report import Clock, ImuInfo, ImuNoise, Interval, LogInfo, TopicInfo, TruthInfo
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.reflection import LOG_TIME, Reflected
from imutool.mcap_io.log import Log
from imutool.mcap_io.recovery.recovered_log import RecoveredLog
from imutool.mcap_io.topics import DERIVED_KEY, Topic
from imutool.recording import LEAST_PERIOD_S, Imu
from imutool.recording.columns import clock_jumps, jump_warnings
from imutool.report import UNSET

UNUSUAL = 0.5  # share by which a period may differ from the median, to count for the rate
CALM_SHARE = 0.25  # of the resting windows, the calmest, that give the noise: motors may idle in the others
NOISE_WINDOW_S = 1.0
JOIN_VECTORS = "; imutool debias and others read a gyro's and an accelerometer's vectors as one: --imu gyro=TOPIC,accel=TOPIC"


def inspect(path: Location, *, check: bool = True, max_chunk: int | None = None) -> LogInfo:
    """Describe a log: topics, clocks, IMU defects and noise, coverage by the truth, warnings.

    The sound part of a damaged log is described, and `losses` lists the rest. Every chunk is read once; without `check` only
    chunks with IMU messages are read, and damage elsewhere may go unnoticed. A chunk of more
    than `max_chunk` bytes counts as lost.

    Raises:
        ConfigError: the file cannot be opened.
        LogError: the file is not an MCAP log, or nothing in it is sound.
    """
    with RecoveredLog(path, max_chunk=max_chunk) as log:
        return describe(log, check=check)


def describe(log: RecoveredLog, *, check: bool = True) -> LogInfo:
    """Reports the contents of a log that is open.

    Raises:
        LogError: nothing in it is sound.
    """
    if check:
        log.check()
    clocks = {name: _joined(log.stamps(name)) for name in log.topics}
    refused: list[str] = []
    true_poses = read_truth(log, lambda topic, error: refused.append(f"{topic}: {error.what}"))
    imus = [_imu(log, topic, true_poses) for topic in log.topics.values() if topic.schema_name == schemas.IMU]
    own = [imu for imu in imus if imu.derived_from is UNSET]
    imu_ns = clocks[own[0].topic] if own else np.empty(0, np.int64)
    truths = [
        coverage(pose, topic.pose_kind, stamp_ns, imu_ns)
        for topic in map(log.topics.__getitem__, log.pose_topics)
        for pose, stamp_ns in (
            transforms(log, topic.name) if topic.schema_name == schemas.TF else [(topic.name, clocks[topic.name])]
        )
    ]
    misread = any(found.subject == QUATERNIONS for imu in own[:1] for found in imu.conventions or ())
    if check and own and truths and log.topics[own[0].topic].is_read and not misread:  # such poses turn as no body does
        samples = sound_samples(log, own[0].topic)
        truths = [_against_gyro(log, truth, samples) for truth in truths]
    warnings = [f"{imu.topic}: {warning}" for imu in imus for warning in imu.warnings]
    vectors = log.with_schema((schemas.VECTOR3,))
    warnings += [*(truth_warnings(truths) if own else [f"no IMU topic{JOIN_VECTORS if len(vectors) > 1 else ''}"]), *refused]
    warnings += made_by_convert(log, has_imu=bool(own), has_poses=bool(truths))
    stamps = [clock for clock in clocks.values() if len(clock)]
    first, last = min((int(c.min()) for c in stamps), default=None), max((int(c.max()) for c in stamps), default=None)
    return LogInfo(
        log=log_name(log.path),
        path=str(log.path),
        bytes=log.path.stat().st_size,
        profile=log.index.header.profile,
        messages=sum(len(clock) for clock in clocks.values()),
        first_ns=first,
        last_ns=last,
        duration_s=None if first is None or last is None else (last - first) * 1e-9,
        topics=[_topic(topic, clocks[name]) for name, topic in log.topics.items()],
        imu=imus,
        truth=truths,
        metadata=sorted(log.metadata()),
        warnings=warnings,
        checked=check,
        losses=log.losses.plain(),
    )


def _joined(parts: Iterable[Int64[np.ndarray, " n"]]) -> Int64[np.ndarray, " m"]:
    return np.concatenate([np.empty(0, np.int64), *parts])


def _topic(topic: Topic, log_times: Int64[np.ndarray, " n"]) -> TopicInfo:
    schema = topic.own_schema or topic.schema_name
    return TopicInfo(topic.name, schema, topic.message_encoding, len(log_times), *_clock(log_times))


def _clock(t_ns: Int64[np.ndarray, " n"]) -> Clock:
    """Rate, jitter, largest gap and ends of the sorted times."""
    periods = np.diff(ordered := np.sort(t_ns))
    steady = periods[periods <= PAUSE_NS]  # that nobody recorded is no jitter
    known = len(periods) > 0
    median = float(np.median(periods)) if known else 0.0
    usual = periods[np.abs(periods - median) <= UNUSUAL * median]  # the median itself is coarse where times are whole ms
    return Clock(
        rate_hz=1e9 / float(usual.mean() if len(usual) else median) if median > 0 else None,  # none is near, of two that differ
        jitter_s=float(np.std(steady)) * 1e-9 if len(steady) else None,
        largest_gap_s=float(periods.max()) * 1e-9 if known else None,
        first_ns=int(ordered[0]) if len(ordered) else None,
        last_ns=int(ordered[-1]) if len(ordered) else None,
    )


def _times(topic: Topic) -> tuple[str, list[str]] | tuple[msgspec.UnsetType, msgspec.UnsetType]:
    """Field that stamps the samples, and the other times, where a message holds several; the log time where it holds none."""
    found = topic.reflected
    if not isinstance(found, Reflected) or (found.stamp and not found.other_stamps):
        return UNSET, UNSET
    if not found.stamp:
        return LOG_TIME, []
    used, *others = [".".join(map(str, path)) for path in (found.stamp[0][0], *found.other_stamps)]
    return used.removesuffix(f".{found.stamp[0][0][-1]}") if len(found.stamp) > 1 else used, others


def _imu(log: Log, topic: Topic, truth: Truth | None) -> ImuInfo:
    """Defects, rest and noise of an IMU; only a warning if its encoding is unknown."""
    derived_from = topic.metadata.get(DERIVED_KEY, UNSET)
    if not topic.is_read:
        warnings = [f"encoding {topic.message_encoding!r} is not read"]
        return ImuInfo(topic=topic.name, warnings=warnings, derived_from=derived_from)
    t_ns, gyro, accel = _columns(log, topic.name)
    finite = not_finite.measured(gyro) & not_finite.measured(accel)
    imu = _sound(t_ns, gyro, accel)
    later = np.maximum.accumulate(t_ns) if len(t_ns) else t_ns
    stamps = read_stamps(t_ns)
    counts = {
        "out_of_order": int((t_ns < later).sum()),
        "duplicated": len(t_ns) - len(distinct(t_ns)),
        "missing": _missing(distinct(restamped(t_ns) if stamps.batch > 1.0 or stamps.fraction else t_ns)),
        "not_finite": int((~finite).sum()),
        "saturated": int((_saturated(gyro[finite]) | _saturated(accel[finite])).sum()),
    }
    rest, whole = _rest(imu), convention_summary(imu, truth)
    used, others = _times(topic)
    return ImuInfo(
        topic=topic.name,
        warnings=_imu_warnings(counts, imu, whole, stamps, clock_jumps(t_ns)),
        conventions=conventions(whole) if len(imu) else UNSET,
        derived_from=derived_from,
        time=used,
        other_times=others,
        samples=len(t_ns),
        **_clock(t_ns)._asdict(),
        **counts,
        saturation_rule=saturation.RULE,
        stationary_s=rest.seconds,
        stationary=rest.stretches,
        accel_at_rest_m_s2=rest.accel_m_s2,
        noise=rest.noise,
    )


def sound_samples(log: Log, topic: str) -> Imu:
    """Finite samples of an IMU in time order, each stamp once."""
    return _sound(*_columns(log, topic))


def _columns(log: Log, topic: str) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Stamps, rates and accelerations of an IMU as recorded; they cannot be written, so that an `Imu` need not copy them."""
    stamps, rates, forces = [np.empty(0, np.int64)], [np.empty((0, 3))], [np.empty((0, 3))]
    for batch in raw_batches(log, topic):  # copies, as a batch holds whole messages
        stamps.append(batch.stamp_ns.copy())
        rates.append(batch.gyro.copy())
        forces.append(batch.accel.copy())
    gyro = np.concatenate(rates)
    rates.clear()
    t_ns, accel = np.concatenate(stamps), np.concatenate(forces)
    for column in (t_ns, gyro, accel):
        column.flags.writeable = False
    return t_ns, gyro, accel


def _sound(t_ns: Int64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]) -> Imu:
    """Finite samples in time order, each stamp once."""
    finite = not_finite.measured(gyro) & not_finite.measured(accel)
    if finite.all() and (np.diff(t_ns) > 0).all():
        return Imu(t_ns, gyro, accel)
    ordered, first = np.unique(t_ns[finite], return_index=True)
    return Imu(ordered, gyro[finite][first], accel[finite][first])


def _missing(ordered_ns: Int64[np.ndarray, " n"]) -> int:
    """Number of samples that would fill the steps of at least 1.5 periods behind which the stamps stay late."""
    return int(missing(ordered_ns, usual_period(ordered_ns)).sum()) if len(ordered_ns) > 1 else 0


def _saturated(values: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Samples with an axis at the end of its range, by `saturation.RULE`."""
    x, y, z = (saturation.at_limit(axis) for axis in values.T)
    either: Bool[np.ndarray, " n"] = x | y | z
    return either


class _Rest(NamedTuple):
    seconds: float
    stretches: list[Interval]
    accel_m_s2: float | None
    noise: ImuNoise | None


def _rest(imu: Imu) -> _Rest:
    """Stationary stretches, the specific force there, and the noise."""
    stretches = rest_stretches(imu)
    samples = [slice(a, b) for a, b in stretches]
    weights = [b - a for a, b in stretches]
    norms = [float(np.linalg.norm(imu.accel[s].mean(axis=0))) for s in samples]
    return _Rest(
        seconds=float(sum(imu.t_ns[b - 1] - imu.t_ns[a] for a, b in stretches)) * 1e-9,
        stretches=[Interval(int(imu.t_ns[a]), int(imu.t_ns[b - 1])) for a, b in stretches],
        accel_m_s2=float(np.average(norms, weights=weights)) if stretches else None,
        noise=_noise(imu, samples),
    )


def _noise(imu: Imu, samples: list[slice]) -> ImuNoise | None:
    """Standard deviation and density by axis in the calmest quarter of the resting seconds.

    density = std * sqrt(period), the white noise that a sensor's data sheet or an ASL `sensor.yaml` states. Every other sample
    chooses the quarter and the rest gives the noise: seconds chosen by their own noise have up to 13 % less than the sensor.
    """
    if not samples:
        return None
    length = max(4, round(NOISE_WINDOW_S / imu.period_s))
    std = []
    for values in (imu.gyro, imu.accel):
        parts = [values[s][: (s.stop - s.start) // length * length].reshape(-1, length, 3) for s in samples]
        chosen_by, measured = (np.concatenate(parts)[:, first::2].var(axis=1, ddof=1) for first in (0, 1))
        calm = np.argsort(chosen_by.sum(axis=1))[: max(1, round(CALM_SHARE * len(measured)))]
        std.append(np.sqrt(measured[calm].mean(axis=0)))
    gyro, accel, root_s = *std, np.sqrt(imu.period_s)
    return ImuNoise(gyro.tolist(), (gyro * root_s).tolist(), accel.tolist(), (accel * root_s).tolist())


def _imu_warnings(
    counts: Mapping[str, int], imu: Imu, whole: TopicSummary, stamps: Stamps, jumps: Sequence[tuple[int, float]]
) -> list[str]:
    words = {
        "out_of_order": "out of order",
        "duplicated": "with a repeated stamp",
        "missing": "missing",
        "not_finite": "not finite, or beyond any sensor",
        "saturated": "saturated",
    }
    warnings = [f"{n} sample{'s' * (n != 1)} {text}" for key, text in words.items() if (n := counts[key])]
    warnings += [f"{text}; imutool convert LOG OUT --restamp corrects it" for text in stamps.faults]
    warnings += [*pause_words(imu.t_ns), *jump_warnings(jumps)]
    if len(imu) > 1 and imu.period_s < LEAST_PERIOD_S and not stamps.faults:
        warnings.append(f"{1.0 / imu.period_s:.3g} samples a second: the stamps are not in nanoseconds, or were never set")
    return [*warnings, *constant_sensors(imu), *convention_warnings(whole)] if len(imu) else [*warnings, "no samples"]


def _against_gyro(log: Log, truth: TruthInfo, imu: Imu) -> TruthInfo:
    """Report on poses with their agreement with the gyro, where both show motion."""
    poses = read_truth(log, topics=[truth.topic])
    found = None if poses is None else agreement(poses, imu)
    if found is None:
        return truth
    truth = msgspec.structs.replace(truth, **found.figures())
    deg, std_deg = (UNSET, UNSET) if found.turned is None else (values.tolist() for values in found.turned)
    return msgspec.structs.replace(truth, body_turned_deg=deg, body_turned_std_deg=std_deg)
