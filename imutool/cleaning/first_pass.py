"""The first pass over a log's IMU: what is wrong with it, which messages to leave out, and whether to trust the rest."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from imutool import registry
from imutool.cleaning.finding import Finding
from imutool.cleaning.motion import Motion
from imutool.cleaning.rule import Rule, Whole
from imutool.cleaning.rules.gaps import MISSING
from imutool.cleaning.rules.non_monotonic import TimeBack, left_out
from imutool.cleaning.samples import Samples, blocks
from imutool.cleaning.score import Verdict, score, verdict
from imutool.cleaning.settings import GROUP, Rules
from imutool.cleaning.truth import Truth, read_truth
from imutool.errors import LogError
from imutool.location import Location
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.log import Log
from imutool.mcap_io.topics import ImuBatch

SCHEMA = "imutool.clean/1"
RECORDED = 20  # intervals of a finding that go into a log's metadata
FEWEST = 2  # samples that make a log


class UntrustedError(LogError):
    """A log whose IMU cannot be cleaned without guessing: it is left alone."""


@dataclass(frozen=True, eq=False)
class Survey:
    """What was found out about one IMU.

    Attributes:
        dropped: of every message, in file order, whether it is to be left out.
        scale: what gyro and accel are to be multiplied by.
        surplus: messages that are another one once more, bit for bit: to leave them out costs nothing.
        reasons: why the log is not to be trusted; none where it is.
    """

    log: str
    topic: str
    rules: Rules
    messages: int
    start_ns: int
    end_ns: int
    missing: int
    surplus: int
    dropped: Bool[np.ndarray, " n"]
    scale: Float64[np.ndarray, "6"]
    findings: tuple[Finding, ...]
    reasons: tuple[str, ...]

    @cached_property
    def valid(self) -> int:
        """The number of messages that are left."""
        return self.messages - int(self.dropped.sum())

    @property
    def score(self) -> float:
        """Quality from 0 to 1 (`imutool.cleaning.score`)."""
        return score(self.messages - self.surplus, self.valid, self.missing, self.findings)

    @property
    def verdict(self) -> Verdict:
        """`good`, `usable` or `quarantine`."""
        return verdict(self.findings, self.reasons)

    def trusted(self) -> Survey:
        """Itself, if the log is to be trusted or its rules say to use it all the same.

        Raises:
            UntrustedError: it is not; the message gives the reasons.
        """
        if self.verdict != "quarantine" or self.rules.force:
            return self
        raise UntrustedError(
            f"cannot be trusted: {'; '.join(self.reasons)}",
            where=f"{self.log} {self.topic}",
            expected="a log whose IMU can be cleaned without guessing",
            fix="It was left alone; look at it with imutool clean LOG, leave a rule out with --no-rule, or insist with --force",
        )

    def plain(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            "topic": self.topic,
            "verdict": self.verdict,
            "score": round(self.score, 4),
            "reasons": list(self.reasons),
            "messages": self.messages,
            "valid": self.valid,
            "missing": self.missing,
            "first_ns": self.start_ns,
            "last_ns": self.end_ns,
            "duration_s": (self.end_ns - self.start_ns) * 1e-9,
            "scale": {"gyro": float(self.scale[0]), "accel": float(self.scale[3])},
            "rules": self.rules.names(),
            "findings": [finding.plain(self.start_ns) for finding in self.findings],
        }

    def record(self) -> dict[str, str]:
        """For a log's metadata: what was found and done; of each finding at most `RECORDED` intervals."""
        report = self.plain()
        findings = report.pop("findings")
        for one in findings:
            one["intervals_left_out"] += max(0, len(one["intervals_ns"]) - RECORDED)
            del one["intervals_s"], one["intervals_ns"][RECORDED:]
        plain = {key: value if isinstance(value, str) else json.dumps(value) for key, value in report.items()}
        return {"schema": SCHEMA, **plain, "findings": json.dumps(findings)}


def survey(path: Location, topic: str | None = None, rules: Rules | None = None) -> Survey:
    """Looks through one IMU of a log; memory grows by some 6 kB a second of it (`tests/bench/clean.py`).

    Raises:
        ConfigError: the file cannot be opened, or a rule is not known.
        LogError: no such IMU, several without `topic`, or a damaged log.
    """
    with Log(path) as log:
        return look(log, topic or log.only_imu(), rules)


def look(log: Log, topic: str, rules: Rules | None = None) -> Survey:
    """As `survey`, in a log that is open.

    Raises:
        ConfigError: a rule is not known.
        LogError: no such IMU topic, or damage.
    """
    return examine(lambda: raw_batches(log, topic), read_truth(log), rules, where=str(log.path), topic=topic)


def examine(
    each: Callable[[], Iterable[ImuBatch]], truth: Truth | None, rules: Rules | None = None, *, where: str = "", topic: str = ""
) -> Survey:
    """As `survey`, of messages that can be gone through again (a clock that was set is only known of in the end).

    Raises:
        ConfigError: a rule is not known.
    """
    rules = rules or Rules()
    stations, whole = _through(each(), truth, rules, None)
    clock = next((one for one in stations if isinstance(one, TimeBack)), None)
    if clock is not None and len(clock.epochs) > 1:
        stations, whole = _through(each(), truth, rules, left_out(clock.epochs, whole.messages))
    findings = tuple(finding for station in stations for finding in station.findings(whole))
    dropped = np.zeros(whole.messages, bool)
    for station in stations:
        for numbers in station.dropped:
            dropped[numbers] = True
    missing = sum(one.count for one in findings if one.rule == "gaps" and one.what == MISSING)
    surplus = sum(one.values["identical"] for one in findings if one.rule == "duplicates")
    reasons = tuple(_reasons(rules, whole, int(dropped.sum()) - surplus, findings))
    start_ns, end_ns = whole.motion.start_ns or 0, whole.motion.end_ns
    counts = whole.messages, start_ns, end_ns, missing, surplus
    return Survey(where, topic, rules, *counts, dropped, whole.scale, findings, reasons)


def _through(
    batches: Iterable[ImuBatch], truth: Truth | None, rules: Rules, skip: Sequence[tuple[int, int]] | None
) -> tuple[list[Rule], Whole]:
    """One pass: the rules, each having seen what those before it left, and what is known in the end."""
    stations = sorted((_make(name, skip) for name in rules.names()), key=lambda rule: rule.place)
    motion, counter = Motion(), _Counter()
    stream: Iterable[Samples] = counter(blocks(batches))
    for station in stations:
        stream = station(stream)
    for samples in stream:
        motion.see(samples)
    return stations, Whole(rules, counter.count, motion, truth)


def _make(name: str, skip: Sequence[tuple[int, int]] | None) -> Rule:
    """A rule by the name of its file."""
    kind = _kind(name)
    return TimeBack(skip) if kind is TimeBack else kind()


@cache
def _kind(name: str) -> type[Rule]:
    module = registry.load(GROUP, name)
    own = (one for one in vars(module).values() if isinstance(one, type) and one.__module__ == module.__name__)
    return next(one for one in own if issubclass(one, Rule))


class _Counter:
    """Counts what passes before any rule sees it."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, stream: Iterable[Samples]) -> Iterator[Samples]:
        for samples in stream:
            self.count += len(samples.number)
            yield samples


def raw_batches(log: Log, topic: str, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[ImuBatch]:
    """The messages of an IMU as they are, in file order: nothing is asked of their values.

    Raises:
        LogError: no such IMU topic, another encoding, or damage.
    """
    log.topic(topic, (schemas.IMU,))
    for _, rows in log.rows([topic], start_ns, end_ns):
        with log.named(topic):
            yield from log.topics[topic].decode_imu(rows)


def _reasons(rules: Rules, whole: Whole, invalid: int, findings: Sequence[Finding]) -> Iterator[str]:
    """Why not to trust the log."""
    if whole.motion.samples < FEWEST:
        yield f"{whole.motion.samples} of {whole.messages} samples are left"
        return
    share = invalid / whole.messages
    if share > rules.max_invalid_share:
        yield f"{100 * share:.0f} % of the samples are invalid"
    yield from (finding.distrust for finding in findings if finding.distrust)
