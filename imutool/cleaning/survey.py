"""Survey of a log's IMU: defects, messages to drop, and whether the log can be trusted."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np

from imutool import registry
from imutool.array_types import Bool, Float64
from imutool.cleaning.finding import Finding, FindingReport, Verdict, score, verdict
from imutool.cleaning.likelihood import axis_names
from imutool.cleaning.rule import GROUP, CleaningSettings, Rule, TopicSummary
from imutool.cleaning.rules.gaps import MISSING
from imutool.cleaning.samples import FrameCounts, Motion, Samples, batches_by_topic, blocks, counted_frames
from imutool.cleaning.truth import Truth, read_truth
from imutool.errors import LogError
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import RESTAMP, ImuBatch
from imutool.mcap_io.log import Log
from imutool.report import UNSET, Report, Section, UnsetType, json_values
from imutool.units import SENSORS

SCHEMA = "imutool.clean/1"
RECORDED = 20  # intervals of a finding that go into a log's metadata
FEWEST = 2  # samples that make a log


class UntrustedError(LogError):
    """The log's IMU cannot be cleaned without guessing."""


@dataclass(frozen=True, eq=False, repr=False)
class Survey:
    """Findings in one IMU, and the messages to leave out.

    Attributes:
        dropped: whether each message, in file order, is left out.
        scale: factors from the log's units to rad/s and m/s², gyro then accel.
        axes: signed permutations from the log's axes to right ones, gyro then accel; other than the identity only with `fix`.
        mount: signed permutation from the IMU's axes to the body of the poses.
        world: rotation of the poses' world after which z is up.
        position_unit: of the poses' positions.
        quaternions: what is wrong with those of the poses; empty where nothing is.
        pose_topic: topic of the poses, and `pose_delay_ns` by which they are late.
        surplus: bit-for-bit copies of other messages; to drop them costs nothing.
        reasons: why the log is not to be trusted; empty where it is.
    """

    log: str
    topic: str
    settings: CleaningSettings
    messages: int
    start_ns: int
    end_ns: int
    missing: int
    surplus: int
    dropped: Bool[np.ndarray, " n"]
    scale: Float64[np.ndarray, "6"]
    axes: Float64[np.ndarray, "2 3 3"]
    mount: Float64[np.ndarray, "3 3"]
    world: Float64[np.ndarray, "3 3"]
    position_unit: str
    quaternions: str
    pose_topic: str
    pose_delay_ns: int
    findings: tuple[Finding, ...]
    reasons: tuple[str, ...]

    def __repr__(self) -> str:
        found = ", ".join(dict.fromkeys(finding.rule for finding in self.findings)) or "nothing"
        return f"Survey({self.topic}: {self.verdict}, score {self.score:.3g}, {self.messages} messages; found {found})"

    @cached_property
    def valid(self) -> int:
        """Number of messages that the rules keep."""
        return self.messages - int(self.dropped.sum())

    @property
    def matrices(self) -> Float64[np.ndarray, "2 3 3"]:
        """Matrices that lead from the log's gyro and accel to rad/s and m/s² in right axes."""
        product: Float64[np.ndarray, "2 3 3"] = self.axes * self.scale.reshape(2, 1, 3)
        return product

    @property
    def clock_steps(self) -> list[str]:
        """Steps between the clocks of IMU and poses."""
        steps = (finding.what for finding in self.findings if "steps" in finding.values)
        return [f"{step}; no shift of all stamps corrects it" for step in steps]

    @property
    def score(self) -> float:
        """Quality from 0 to 1 (`imutool.cleaning.finding.score`)."""
        return score(self.messages - self.surplus, self.valid, self.missing, self.findings)

    @property
    def verdict(self) -> Verdict:
        """`good`, `usable` or `quarantine`."""
        return verdict(self.findings, self.reasons)

    def trusted(self) -> Survey:
        """Return the survey if the log is to be trusted, or the settings force its use.

        Raises:
            UntrustedError: the log is not to be trusted; the message gives the reasons.
        """
        if self.verdict != "quarantine" or self.settings.force:
            return self
        raise UntrustedError(
            f"cannot be trusted: {'; '.join(self.reasons)}",
            where=f"{self.log} {self.topic}",
            expected="a log whose IMU can be cleaned without guessing",
            fix="Look at it with `imutool clean LOG`. `imutool clean LOG OUT --force` cleans it all the same",
        )

    def report(self) -> SurveyReport:
        """Entry of the report."""
        return SurveyReport(
            topic=self.topic,
            verdict=self.verdict,
            score=round(self.score, 4),
            reasons=list(self.reasons),
            messages=self.messages,
            valid=self.valid,
            missing=self.missing,
            first_ns=self.start_ns,
            last_ns=self.end_ns,
            duration_s=(self.end_ns - self.start_ns) * 1e-9,
            scale={"gyro": float(self.scale[0]), "accel": float(self.scale[3])},
            axes={sensor: axis_names(P) for sensor, P in zip(SENSORS, self.axes, strict=True)},
            rules=self.settings.names(),
            findings=[finding.report(self.start_ns) for finding in self.findings],
        )

    def record(self) -> dict[str, str]:
        """Survey report as JSON text for a log's metadata.

        Each finding has at most `RECORDED` intervals.
        """
        values = json_values(self.report())
        findings = values.pop("findings")
        for finding in findings:
            finding["intervals_left_out"] += max(0, len(finding["intervals_ns"]) - RECORDED)
            del finding["intervals_s"], finding["intervals_ns"][RECORDED:]
        texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in values.items()}
        return {"schema": SCHEMA, **texts, "findings": json.dumps(findings)}


class SurveyReport(Section, frozen=True, kw_only=True):
    """A survey in JSON."""

    topic: str
    verdict: Verdict
    score: float
    reasons: list[str]
    messages: int
    valid: int
    missing: int
    first_ns: int
    last_ns: int
    duration_s: float
    scale: dict[str, float]
    axes: dict[str, str] | UnsetType = UNSET  # reports of 0.1.0 have none
    rules: list[str]
    findings: list[FindingReport]


class CleaningReport(Report, frozen=True, kw_only=True, tag=SCHEMA):
    """Report of `imutool clean`; with a new log also `output` and `added`, messages by topic."""

    log: str
    imus: list[SurveyReport]
    losses: dict[str, Any]
    output: str | UnsetType = UNSET
    added: dict[str, int] | UnsetType = UNSET


def look(log: Log, topic: str, settings: CleaningSettings | None = None) -> Survey:
    """Survey one IMU of an open log.

    Memory grows by about 6 kB for each second of the log (`tests/bench/clean.py`).

    Raises:
        ConfigError: a rule is not known.
        LogError: no such IMU topic, or damage.
    """
    name = log.topic(topic, (schemas.IMU,)).name  # of two joined topics that of their IMU
    return examine(lambda: raw_batches(log, name), read_truth(log), settings, where=str(log.path), topic=name)


def examine(
    each: Callable[[], Iterable[ImuBatch]],
    truth: Truth | None,
    settings: CleaningSettings | None = None,
    *,
    where: str = "",
    topic: str = "",
) -> Survey:
    """Survey messages from `each`; a log with a clock that was set is read twice.

    Raises:
        ConfigError: a rule is not known.
    """
    settings = settings or CleaningSettings()
    names = settings.names()
    stages, whole = _through(each(), truth, settings, {name: _rule(name)() for name in names})
    second = {name: stage.second_pass(whole.messages) for name, stage in stages.items()}
    if any(stage is not None for stage in second.values()):
        stages, whole = _through(each(), truth, settings, {name: second[name] or _rule(name)() for name in names})
    findings = tuple(finding for stage in stages.values() for finding in stage.findings(whole))
    dropped = np.zeros(whole.messages, bool)
    for stage in stages.values():
        for numbers in stage.dropped:
            dropped[numbers] = True
    missing = sum(finding.count for finding in findings if finding.rule == "gaps" and finding.what == MISSING)
    surplus = sum(finding.values["identical"] for finding in findings if finding.rule == "duplicates")
    reasons = tuple(_reasons(settings, whole, int(dropped.sum()) - surplus, findings))
    start_ns, end_ns = whole.motion.start_ns or 0, whole.motion.end_ns
    counts = whole.messages, start_ns, end_ns, missing, surplus
    pose_topic = "" if truth is None else truth.topic
    poses = whole.world, whole.position_unit, whole.quaternions, pose_topic, whole.pose_delay_ns
    return Survey(where, topic, settings, *counts, dropped, whole.scale, whole.axes, whole.mount, *poses, findings, reasons)


def _through(
    batches: Iterable[ImuBatch], truth: Truth | None, settings: CleaningSettings, rules: Mapping[str, Rule]
) -> tuple[dict[str, Rule], TopicSummary]:
    """Run the rules in their order, each on the samples that the rules before it left.

    The second value is the topic's totals.
    """
    stages = dict(sorted(rules.items(), key=lambda item: item[1].place))
    motion, messages, frames = Motion(), 0, FrameCounts()

    def received() -> Iterator[Samples]:
        nonlocal messages
        for samples in blocks(counted_frames(batches, frames)):
            messages += len(samples.number)
            yield samples

    stream: Iterable[Samples] = received()
    for stage in stages.values():
        stream = stage(stream)
    for samples in stream:
        motion.see(samples)
    return stages, TopicSummary(settings, messages, motion, truth, frames)


@cache
def _rule(name: str) -> type[Rule]:
    """Rule class in the file of that name."""
    module = registry.load(GROUP, name)
    own = (value for value in vars(module).values() if isinstance(value, type) and value.__module__ == module.__name__)
    return next(cls for cls in own if issubclass(cls, Rule))


def raw_batches(
    log: Log,
    topic: str,
    start_ns: int | None = None,
    end_ns: int | None = None,
    unreadable: Callable[[str], None] = lambda _: None,
) -> Iterator[ImuBatch]:
    """Messages of an IMU as recorded, in file order, with unchecked values; log times select.

    A message that is none of an IMU has NaN; `unreadable` is called with what is wrong with it.

    Raises:
        LogError: no such IMU topic, another encoding, or damage.
    """
    name = log.topic(topic, (schemas.IMU,)).name
    for _, batch in batches_by_topic(log, [name], start_ns, end_ns, lambda _, what: unreadable(what)):
        yield batch


def _reasons(settings: CleaningSettings, whole: TopicSummary, invalid: int, findings: Sequence[Finding]) -> Iterator[str]:
    """Reasons not to trust the log."""
    if whole.motion.samples < FEWEST:
        yield f"valid samples: {whole.motion.samples} of {whole.messages}"
        unusable = [f"{finding.count} {finding.what}" for finding in findings if finding.rule == "not_finite"]
        yield from unusable
        if whole.messages >= FEWEST and not whole.motion.end_ns and not unusable:
            yield f"the stamps were never set: {RESTAMP} takes the log times"
        return
    share = invalid / whole.messages
    if share > settings.max_invalid_share:
        yield f"{100 * share:.0f} % of the samples are invalid"
    yield from (finding.distrust for finding in findings if finding.distrust)
