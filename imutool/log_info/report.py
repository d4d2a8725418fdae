"""Report of `imutool info`: topics, IMUs, truth and losses of a log."""

from __future__ import annotations

from typing import Any, NamedTuple

from imutool.report import UNSET, Report, Section, UnsetType


class Clock(NamedTuple):
    """Clock of a topic: rate, jitter, largest gap, first and last stamp.

    Null with fewer than two messages.
    """

    rate_hz: float | None
    jitter_s: float | None
    largest_gap_s: float | None
    first_ns: int | None
    last_ns: int | None


class TopicInfo(Section, frozen=True):
    """Topic with its clock, from the log times; null with too few messages.

    `rate_hz` is one over the median period, so that drop-outs do not lower it; `jitter_s` is the periods' standard deviation.
    """

    name: str
    type: str
    encoding: str
    count: int
    rate_hz: float | None
    jitter_s: float | None
    largest_gap_s: float | None
    first_ns: int | None
    last_ns: int | None


class Interval(Section, frozen=True):
    """Time interval, by the stamps of its first and last sample."""

    first_ns: int
    last_ns: int


class ImuNoise(Section, frozen=True):
    """White noise by axis at rest: std of a sample, and density = std * sqrt(period)."""

    gyro_std_rad_s: list[float]
    gyro_density: list[float]
    accel_std_m_s2: list[float]
    accel_density: list[float]
    gyro_density_unit: str = "rad/s/sqrt(Hz)"
    accel_density_unit: str = "m/s^2/sqrt(Hz)"


class Convention(Section, frozen=True):
    """Convention of an IMU or of its poses: what the motion shows, or why it shows nothing."""

    subject: str
    judged: bool
    evidence: str


class ImuInfo(Section, frozen=True, kw_only=True):
    """IMU topic: clock from the header stamps, defects, rest and noise.

    `time` is the field that stamps the samples and `other_times` those that do not, where the message holds several; it is `log
    time` where the message holds none. `time_unit` is that of a field without a unit, as the log times show it.
    `stated_units` are those that the comments of a driver's own definition state. Only warnings where its encoding is unknown.
    """

    topic: str
    warnings: list[str]
    derived_from: str | UnsetType = UNSET
    time: str | UnsetType = UNSET
    other_times: list[str] | UnsetType = UNSET
    time_unit: str | UnsetType = UNSET
    stated_units: str | UnsetType = UNSET
    samples: int | UnsetType = UNSET
    rate_hz: float | UnsetType | None = UNSET
    jitter_s: float | UnsetType | None = UNSET
    largest_gap_s: float | UnsetType | None = UNSET
    first_ns: int | UnsetType | None = UNSET
    last_ns: int | UnsetType | None = UNSET
    out_of_order: int | UnsetType = UNSET
    duplicated: int | UnsetType = UNSET
    missing: int | UnsetType = UNSET
    not_finite: int | UnsetType = UNSET
    saturated: int | UnsetType = UNSET
    saturation_rule: str | UnsetType = UNSET
    stationary_s: float | UnsetType = UNSET
    stationary: list[Interval] | UnsetType = UNSET
    accel_at_rest_m_s2: float | UnsetType | None = UNSET
    noise: ImuNoise | UnsetType | None = UNSET
    conventions: list[Convention] | UnsetType = UNSET


class TruthInfo(Section, frozen=True):
    """Topic of poses: what they are worth, and the share of IMU samples that they cover.

    `kind` is `truth`, `estimate`, `odometry` or `unknown`.
    """

    topic: str
    poses: int
    kind: str
    coverage: float = 0.0
    gaps: int = 0
    longest_gap_s: float = 0.0
    starts_after_s: float | UnsetType = UNSET
    ends_before_s: float | UnsetType = UNSET
    gyro_rms_rad_s: float | UnsetType = UNSET  # what the poses do not explain of the log's first gyro
    gyro_explained: float | UnsetType = UNSET  # share of its motion that they do, with their body turned to fit best
    gyro_reversed_axes: str | UnsetType = UNSET  # that read the opposite of the poses' rates, such as `y`
    gyro_explained_as_recorded: float | UnsetType = UNSET  # the same with their body as it is; below zero, they contradict it
    jumps: int | UnsetType = UNSET  # steps of a tenth of a second in which the poses turn and the gyro does not
    largest_jump_deg: float | UnsetType = UNSET
    body_turned_deg: list[float] | UnsetType = UNSET  # rotation vector from the poses' body to the gyro's axes
    body_turned_std_deg: list[float] | UnsetType = UNSET


class LogInfo(Report, frozen=True, kw_only=True, tag="imutool.info/1"):
    """Report of `imutool info` about one log."""

    log: str
    path: str
    bytes: int
    profile: str
    messages: int
    first_ns: int | None
    last_ns: int | None
    duration_s: float | None
    topics: list[TopicInfo]
    imu: list[ImuInfo]
    truth: list[TruthInfo]
    metadata: list[str]
    warnings: list[str]
    checked: bool
    losses: dict[str, Any]
    noise: dict[str, Any] | UnsetType = UNSET
    models: list[str] | UnsetType = UNSET  # that ship for the log's very unit, best first


class LogInfos(Report, frozen=True, tag="imutool.infos/1"):
    """Report of `imutool info` about several logs."""

    logs: list[LogInfo]
