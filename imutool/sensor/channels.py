"""Channels of a log that may drive a sensor: numeric fields of messages of any kind.

Left out are poses and IMUs, constants, enumerations, counters and clocks, covariances, stamps, copies of another channel, and
what the reference or imutool itself brings: a ground truth's bias estimate explains a misfit without being its cause.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from imutool.array_types import Float64
from imutool.file_location import Location
from imutool.mcap_io.codec.schemas import IMU, TF
from imutool.mcap_io.fields import Fields, others
from imutool.mcap_io.log import Log
from imutool.recording import Recording, Scalars, seconds
from imutool.sensor.effect import Acting
from imutool.sensor.physics_file_terms import DRIVEN
from imutool.units import AXES

MAX_READ, MAX_TRIED = 200, 6  # fields of a log that are read, and those that become channels
MIN_MESSAGES = 5
MIN_COVERAGE = 0.5  # of the IMU's time
MAX_STATES = 16  # distinct whole numbers of an enumeration
CLOCK_CORRELATION = 0.9999  # with time, of a rising number that only counts
COPY_CORRELATION = 0.9999  # with another channel
LISTED = 12
REFERENCE_WORDS = ("ground_truth", "groundtruth")


@dataclass(frozen=True)
class Channels:
    """Recording with its channels; names of the fields that were added, and not tried."""

    recording: Recording
    added: tuple[str, ...]
    untried: tuple[str, ...]

    @property
    def remark(self) -> str:
        """Sentence on the fields that were tried as causes, empty where there are none."""
        if not self.added:
            return ""
        text = f"Tried as causes, in addition to the log's scalar topics: {', '.join(self.added)}"
        if self.untried:
            shown = ", ".join(self.untried[:LISTED])
            more = f" and {len(self.untried) - LISTED} more" if len(self.untried) > LISTED else ""
            text += f"; not tried, for at most {MAX_TRIED} are: {shown}{more}"
        return text


def with_channels(recording: Recording, path: Location) -> Channels:
    """Recording with all channels that may drive its sensor, as TOPIC or TOPIC.field.

    Raises:
        ConfigError, LogError: the log cannot be opened, or is damaged.
    """
    scalars = {topic: values for topic, values in recording.scalars.items() if not brought_by_reference(topic, recording)}
    with Log(path) as log:
        moved = {topic.name for topic in log.with_schema((IMU, TF))} | set(log.pose_topics)
        brought = {name for name in log.topics if brought_by_reference(name, recording)}
    fields = others(path, "", MAX_READ, skip={*moved, *brought, *recording.scalars, *recording.truths})
    varying = {name: field for name, field in fields.items() if _may_drive(field, recording)}
    names = sorted(varying, key=lambda name: "temperature" not in name.lower())  # a sort keeps the log's order otherwise
    added, untried = _distinct(names, varying, scalars, recording)
    new = {name: Scalars(varying[name].t_ns, varying[name].values[:, None], varying[name].unit) for name in added}
    return Channels(replace(recording, scalars={**scalars, **new}), added, untried)


def needs_channels(acting: Acting) -> bool:
    """Whether an effect follows another number of the log, such as a temperature."""
    return any(effect.needs or effect.name == DRIVEN for effect, _ in acting)


def brought_by_reference(topic: str, recording: Recording) -> bool:
    """Whether a topic belongs to a truth of the recording, or was computed from its IMU."""
    folders = {truth.rpartition("/")[0] for truth in recording.truths} - {"", "/"}
    computed = (f"{recording.imu_topic}/debiased", f"{recording.imu_topic}/bias/") if recording.imu_topic else ()
    return (
        topic in recording.truths
        or any(topic.startswith(f"{folder}/") for folder in folders)
        or topic.startswith(computed)
        or any(word in topic.lower() for word in REFERENCE_WORDS)
    )


def _may_drive(field: Fields, recording: Recording) -> bool:
    """Whether a field varies as a physical quantity does, over most of the recording."""
    imu, values = recording.imu, field.values
    covered = min(field.t_ns[-1], imu.t_ns[-1]) - max(field.t_ns[0], imu.t_ns[0])
    if len(field) < MIN_MESSAGES or covered < MIN_COVERAGE * (imu.t_ns[-1] - imu.t_ns[0]):
        return False
    return len(np.unique(values)) == 2 or is_quantity(field)  # two values are a switch, which may drive


def is_quantity(field: Fields) -> bool:
    """Whether a number is a quantity: no enumeration, counter or clock."""
    values = field.values
    if bool((values == np.rint(values)).all()) and len(np.unique(values)) <= MAX_STATES:
        return False
    rising = bool((np.diff(values) >= 0.0).all())
    return not (rising and _correlation(seconds(field.t_ns, int(field.t_ns[0])), values) > CLOCK_CORRELATION)


def _distinct(
    names: Iterable[str], fields: Mapping[str, Fields], scalars: Mapping[str, Scalars], recording: Recording
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of fields that are no copies: the first few, and the others."""
    t_ns = recording.imu.t_ns
    start_ns = int(t_ns[0])
    at_s = seconds(t_ns, start_ns)
    kept = [np.interp(at_s, seconds(own.t_ns, start_ns), row) for own in scalars.values() for row in own.values.T if len(own)]
    added, untried = list[str](), list[str]()
    for name in names:
        if len(added) == MAX_TRIED:
            untried.append(name)
            continue
        column = np.interp(at_s, seconds(fields[name].t_ns, start_ns), fields[name].values)
        if all(abs(_correlation(column, other)) < COPY_CORRELATION for other in kept):
            added.append(name)
            kept.append(column)
    return tuple(added), tuple(untried)


def _correlation(a: Float64[np.ndarray, " n"], b: Float64[np.ndarray, " n"]) -> float:
    """Correlation coefficient, 0 where one of the two is constant."""
    a, b = a - a.mean(), b - b.mean()
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / size if size > 0.0 else 0.0


def channels_at(
    recording: Recording, t_s: Float64[np.ndarray, " n"], start_ns: int, min_messages: int = 1
) -> dict[str, Float64[np.ndarray, " n"]]:
    """Scalar channels of a log at seconds from `start_ns`, interpolated, by topic or `topic.x`."""
    out = {}
    for topic, scalars in recording.scalars.items():
        if len(scalars) >= min_messages:
            own_s, width = seconds(scalars.t_ns, start_ns), scalars.values.shape[1]
            for axis, column in zip(AXES, scalars.values.T, strict=False):
                out[topic if width == 1 else f"{topic}.{axis}"] = np.interp(t_s, own_s, column)
    return out
