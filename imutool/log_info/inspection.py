"""Inspection of a log: clocks, IMU defects and noise, coverage by the truth.

Images are never unpacked, and an IMU is read in blocks. Defects are counted where reading the log would stop at the first:
stamps that go back, repeated stamps, and values that are not finite.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec import UnsetType

from imutool.array_types import Float64
from imutool.cleaning.rules import saturation
from imutool.cleaning.rules.gaps import pause_words
from imutool.cleaning.rules.stuck import Stuck
from imutool.cleaning.truth import Truth, read_truth
from imutool.file_location import Location, log_name
from imutool.inertial.stationary import Batch, Blocks, block_statistics, resting_blocks
from imutool.log_info.clock import clocks, in_blocks
from imutool.log_info.convention_report import QUATERNIONS, convention_warnings, conventions, lean_warnings, truth_warnings
from imutool.log_info.imu_motion import ImuMotion
from imutool.log_info.imu_samples import ImuSamples, read_imus
from imutool.log_info.pose_coverage import coverage, transforms
from imutool.log_info.pose_imu_rotation import Agreement, sparse_warnings
from imutool.log_info.report import ImuInfo, ImuNoise, Interval, LogInfo, TopicInfo, TruthInfo
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.joined_imu import JOIN_VECTORS
from imutool.mcap_io.codec.reflection import LOG_TIME, Reflected
from imutool.mcap_io.log import Log
from imutool.mcap_io.recovery.recovered_log import RecoveredLog
from imutool.mcap_io.topics import DERIVED_KEY, Topic
from imutool.recording import MIN_PERIOD_S
from imutool.recording.columns import jump_warnings
from imutool.report import UNSET

CALM_SHARE = 0.25  # of the resting windows, the calmest, that give the noise: motors may idle in the others
NOISE_WINDOW_S = 1.0
CONVERTIBLE = {  # messages of which `convert` makes others
    "nav_msgs/msg/Path": "poses",
    "px4_msgs/msg/VehicleOdometry": "poses",
    "px4_msgs/msg/VehicleImu": "an IMU",
    "px4_msgs/msg/SensorGyro": "an IMU",
}


def inspect(path: Location, *, check: bool = True, max_chunk: int | None = None) -> LogInfo:
    """Describe a log: topics, clocks, IMU defects and noise, coverage by the truth, warnings.

    The sound part of a damaged log is described, and `losses` lists the rest. Each chunk is unpacked once to check it, and once
    more if it holds IMU messages; without `check` only these are, and damage elsewhere may go unnoticed. A chunk of more than
    `max_chunk` bytes counts as lost.

    Raises:
        ConfigError: the file cannot be opened.
        LogError: the file is not an MCAP log, or nothing in it is sound.
    """
    with RecoveredLog(path, max_chunk=max_chunk) as log:
        return describe(log, check=check)


def describe(log: RecoveredLog, *, check: bool) -> LogInfo:
    """Reports the contents of a log that is open.

    Raises:
        LogError: nothing in it is sound.
    """
    if check:
        log.check()
    counts = {topic.name: topic.count for topic in log.topics.values()}
    topics = [
        TopicInfo(topic.name, topic.own_schema or topic.schema_name, topic.message_encoding, count, *clock)
        for topic, (count, clock) in zip(log.topics.values(), clocks(log.stamps_of, counts), strict=True)
    ]
    refused: list[str] = []
    true_poses = read_truth(log, lambda topic, error: refused.append(f"{topic}: {error.what}"))
    every = log.with_schema((schemas.IMU,))
    own = next((topic for topic in every if not topic.is_derived), None)
    truths = [*_coverages(log, own)]
    turns = {truth.topic: _poses(log, truth.topic, true_poses) for truth in truths if check and own and own.is_read}
    imus, found = list[ImuInfo](), dict[str, Agreement | None]()
    samples = read_imus(log, [topic.name for topic in every if topic.is_read])
    for topic in every:
        info, agreements = _imu(topic, next(samples) if topic.is_read else None, true_poses, turns if topic is own else {})
        imus, found = [*imus, info], found | agreements
    truths = [_against_gyro(truth, found.get(truth.topic)) for truth in truths]
    warnings = [f"{imu.topic}: {warning}" for imu in imus for warning in imu.warnings]
    vectors = log.with_schema((schemas.VECTOR3,))
    warnings += [*(truth_warnings(truths) if own else [f"no IMU topic{JOIN_VECTORS if len(vectors) > 1 else ''}"]), *refused]
    warnings += [] if own is None or true_poses is None else sparse_warnings(true_poses)
    warnings += _made_by_convert(log, has_imu=own is not None, has_poses=bool(truths))
    first = min((topic.first_ns for topic in topics if topic.first_ns is not None), default=None)
    last = max((topic.last_ns for topic in topics if topic.last_ns is not None), default=None)
    return LogInfo(
        log=log_name(log.path),
        path=str(log.path),
        bytes=log.path.stat().st_size,
        profile=log.index.header.profile,
        messages=sum(topic.count for topic in log.topics.values() if not topic.recorded_on),
        first_ns=first,
        last_ns=last,
        duration_s=None if first is None or last is None else (last - first) * 1e-9,
        topics=topics,
        imu=imus,
        truth=truths,
        metadata=sorted(log.metadata()),
        warnings=warnings,
        checked=check,
        losses=log.losses.plain(),
    )


def _made_by_convert(log: Log, *, has_imu: bool, has_poses: bool) -> list[str]:
    """Hints at topics of which `convert` makes an IMU or poses, where the log has none."""
    lacking = {"poses": not has_poses, "an IMU": not has_imu}
    made = {topic.name: CONVERTIBLE.get(topic.own_schema or topic.schema_name, "") for topic in log.topics.values()}
    return [f"imutool convert LOG OUT makes {what} of {name}" for name, what in made.items() if lacking.get(what)]


def _coverages(log: Log, imu: Topic | None) -> Iterator[TruthInfo]:
    """Coverage of the IMU by the poses of each topic, and of each transform."""
    for topic in map(log.topics.__getitem__, log.pose_topics):
        own = [(topic.name, np.concatenate([np.empty(0, np.int64), *log.stamps(topic.name)]))]
        for name, stamp_ns in transforms(log, topic.name) if topic.schema_name == schemas.TF else own:
            yield coverage(
                name, topic.pose_kind, stamp_ns, (part for _, part in in_blocks(log.stamps_of([imu.name]))) if imu else ()
            )


def _poses(log: Log, topic: str, known: Truth | None) -> Truth | None:
    return known if known is not None and known.topic == topic else read_truth(log, topics=[topic])


def _times(topic: Topic) -> tuple[str | UnsetType, list[str] | UnsetType, str | UnsetType]:
    """Field that stamps the samples, the other times, and its unit, where messages leave them open; else the log time."""
    found = topic.reflected
    if not isinstance(found, Reflected) or (found.stamp and not found.other_stamps and not found.stamp_unit):
        return UNSET, UNSET, UNSET
    others = [".".join(map(str, path)) for path in found.other_stamps]
    return found.stamp_path if found.stamp else LOG_TIME, others, found.stamp_unit or UNSET


def _imu(
    topic: Topic, imu: ImuSamples | None, truth: Truth | None, poses: Mapping[str, Truth | None]
) -> tuple[ImuInfo, dict[str, Agreement | None]]:
    """Defects, rest and noise of an IMU, and its agreement with poses; only a warning if its encoding is unknown."""
    derived_from = topic.metadata.get(DERIVED_KEY, UNSET)
    if imu is None:
        warnings = [f"encoding {topic.message_encoding!r} is not read"]
        return ImuInfo(topic=topic.name, warnings=warnings, derived_from=derived_from), {}
    motion = ImuMotion(imu.sound.steps.median(), poses)

    stuck = Stuck()

    def seen() -> Iterator[Batch]:
        for samples in stuck(imu.counted()):
            motion.see(samples)
            yield samples.stamp_ns, samples.values[:, :3], samples.values[:, 3:]

    rest = _rest(imu, block_statistics(seen(), imu.period_s or 1.0))
    whole = motion.summary(truth)
    used, others, unit = _times(topic)
    found = conventions(whole) if len(imu) else []
    of_motion = [*motion.constant_sensors(), *convention_warnings(whole)] if len(imu) else ["no samples"]
    of_stuck = [f"{finding.count} {finding.what}" for finding in stuck.findings(whole) if finding.action == "dropped"]
    of_motion = of_motion or lean_warnings(motion, whole)
    reflected = topic.reflected if isinstance(topic.reflected, Reflected) else None
    of_fields = [reflected.compensated] if reflected and reflected.compensated else []
    misread = any(entry.subject == QUATERNIONS for entry in found)  # such poses turn as no body does
    return ImuInfo(
        topic=topic.name,
        warnings=[*_imu_warnings(imu), *of_stuck, *of_motion, *of_fields],
        conventions=found if len(imu) else UNSET,
        derived_from=derived_from,
        time=used,
        other_times=others,
        time_unit=unit,
        stated_units=(reflected.units if reflected else "") or UNSET,
        samples=imu.recorded.count,
        **imu.recorded.clock()._asdict(),
        **imu.counts,
        saturation_rule=saturation.RULE,
        stationary_s=rest.seconds,
        stationary=rest.stretches,
        accel_at_rest_m_s2=rest.accel_m_s2,
        noise=rest.noise,
    ), {} if misread else {name: turns.agreement() for name, turns in motion.turns.items()}


class _Rest(NamedTuple):
    seconds: float
    stretches: list[Interval]
    accel_m_s2: float | None
    noise: ImuNoise | None


def _rest(imu: ImuSamples, blocks: Blocks) -> _Rest:
    """Stationary stretches, the specific force there, and the noise."""
    found = resting_blocks(blocks)
    stretches = [Interval(int(blocks.first_ns[a]), int(blocks.last_ns[b - 1])) for a, b in found]
    norms = [float(np.linalg.norm(blocks.mean[a:b, 3:].mean(axis=0))) for a, b in found]
    return _Rest(
        seconds=float(sum(stretch.last_ns - stretch.first_ns for stretch in stretches)) * 1e-9,
        stretches=stretches,
        accel_m_s2=float(np.average(norms, weights=[b - a for a, b in found])) if found else None,
        noise=_noise(imu, stretches) if found else None,
    )


def _noise(imu: ImuSamples, stretches: list[Interval]) -> ImuNoise:
    """Standard deviation and density by axis in the calmest quarter of the resting seconds.

    density = std * sqrt(period), the white noise that a sensor's data sheet or an ASL `sensor.yaml` states. Every other sample
    chooses the quarter and the rest gives the noise: seconds chosen by their own noise have up to 13 % less than the sensor.
    """
    length, std = max(4, round(NOISE_WINDOW_S / imu.period_s)), []
    chosen_by, measured = (np.concatenate(column) for column in zip(*_variances(imu, stretches, length), strict=True))
    for axes in (slice(3), slice(3, 6)):
        calm = np.argsort(chosen_by[:, axes].sum(axis=1))[: max(1, round(CALM_SHARE * len(measured)))]
        std.append(np.sqrt(measured[calm, axes].mean(axis=0)))
    rate_hz = imu.sound.clock().rate_hz or 1.0 / imu.period_s  # a median of whole milliseconds errs
    gyro, accel, root_s = *std, 1.0 / np.sqrt(rate_hz)
    return ImuNoise(gyro.tolist(), (gyro * root_s).tolist(), accel.tolist(), (accel * root_s).tolist())


def _variances(
    imu: ImuSamples, stretches: list[Interval], length: int
) -> Iterator[tuple[Float64[np.ndarray, "w 6"], Float64[np.ndarray, "w 6"]]]:
    """Variances of every other sample, and of the others, in windows from the start of each stretch."""
    current, waiting = -1, np.zeros((0, 6))
    for stretch, values in imu.within(stretches):
        waiting = np.concatenate([waiting, values]) if stretch == current else values
        current, count = stretch, len(waiting) // length
        windows = waiting[: count * length].reshape(-1, length, 6)
        waiting = waiting[count * length :]
        yield windows[:, 0::2].var(axis=1, ddof=1), windows[:, 1::2].var(axis=1, ddof=1)


def _imu_warnings(imu: ImuSamples) -> list[str]:
    """Warnings about the messages and the stamps of an IMU."""
    words = {
        "out_of_order": "out of order",
        "duplicated": "with a repeated stamp",
        "missing": "missing",
        "not_finite": "not finite, or beyond any sensor",
        "saturated": "saturated",
    }
    warnings = [f"{n} sample{'s' * (n != 1)} {text}" for key, text in words.items() if (n := imu.counts[key])]
    warnings += imu.unreadable
    if imu.unsorted:
        warnings.append("the messages are not in order of their log time; imutool convert LOG OUT puts them in order")
    warnings += [f"{text}; imutool convert LOG OUT --restamp corrects it" for text in imu.stamps.faults]
    warnings += [*imu.frames.words(), *pause_words(imu.sound.long_ns), *jump_warnings(imu.jumps)]
    if len(imu) > 1 and imu.period_s < MIN_PERIOD_S and not imu.stamps.faults:
        warnings.append(f"{1.0 / imu.period_s:.3g} samples a second: the stamps are not in nanoseconds, or were never set")
    return warnings


def _against_gyro(truth: TruthInfo, found: Agreement | None) -> TruthInfo:
    """Report on poses with their agreement with the gyro, where both show motion."""
    if found is None:
        return truth
    truth = msgspec.structs.replace(truth, **found.figures())
    deg, std_deg = (UNSET, UNSET) if found.turned is None else (values.tolist() for values in found.turned)
    return msgspec.structs.replace(truth, body_turned_deg=deg, body_turned_std_deg=std_deg)
