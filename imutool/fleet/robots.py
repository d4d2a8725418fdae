"""Comparison of many robots with one kind of sensor: shared parameters, and outliers.

Each log gives each parameter with its standard deviation; the logs of a robot are pooled with inverse-variance weights. A
robot's value x is compared with the median m of all robots and the robust spread s between them (Qn of Rousseeuw and Croux
1993, section 3: breakdown point 50 %, twice as efficient as the median absolute deviation):

    z = (x - m) / sqrt(s^2 + std^2)

s itself comes from a few robots: z is compared with Student's t with 0.7 (n - 1) degrees of freedom (0.7: the efficiency of Qn
among a few dozen). An effect counts with its most deviating parameter; its p-value is multiplied by the number of
parameters (Bonferroni). An outlier has a false discovery rate (Benjamini and Hochberg 1995) below a limit.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from imutool.array_types import Float64
from imutool.diagnosis.result import Estimate
from imutool.diagnosis.wording.quantity import value as value_text
from imutool.errors import ConfigError
from imutool.file_location import Location
from imutool.fleet.task import Parameter, Result
from imutool.mcap_io.log import Log
from imutool.report import Report

QN, MAD = 2.2219, 1.4826  # what makes them the standard deviation of normal numbers
QN_OF_FEW = {2: 0.399, 3: 0.994, 4: 0.512, 5: 0.844, 6: 0.611, 7: 0.857, 8: 0.669, 9: 0.872}  # Croux and Rousseeuw 1992
MANY = 1000  # robots, above which the median absolute deviation is sure enough; Qn takes every pair
EFFICIENCY = 0.7
FALSE_DISCOVERY = 0.01
FEWEST = 5  # robots: fewer do not show an outlier
SMALLEST = 0.01  # of the median uncertainty: a spread of nothing at all is rounding


class SharedParameter(NamedTuple):
    """Parameter over all robots: median, robust spread, and number of robots."""

    label: str
    unit: str
    middle: float
    spread: float
    robots: int

    @property
    def text(self) -> str:
        """Median and spread as text: `0.13 ± 0.19 %`."""
        return value_text(Estimate(self.middle, self.spread, self.unit))


class Outlier(NamedTuple):
    """Outlier: a robot with another effect than the others, by its most deviating parameter."""

    robot: str
    effect: str
    parameter: str
    value: float
    std: float
    middle: float
    spread: float
    unit: str
    sigma: float
    p_value: float
    false_discovery_rate: float

    @property
    def label(self) -> str:
        """Effect and parameter, in words."""
        return label(self.effect, self.parameter)

    @property
    def here(self) -> str:
        """Value of this robot."""
        return value_text(Estimate(self.value, self.std, self.unit))

    @property
    def others(self) -> str:
        """Median and spread of the others."""
        return value_text(Estimate(self.middle, self.spread, self.unit))

    @property
    def sentence(self) -> str:
        """Sentence: `robot 12: mount rotation phi x 2.1 ± 0.1° against ... of the others, 9 sigma`."""
        return f"{self.robot}: {self.label} {self.here} against {self.others} of the others, {self.sigma:.1f} sigma"


@dataclass(frozen=True)
class Comparison:
    """Shared parameters of all robots, and the outliers, the clearest first."""

    robots: int
    logs: int
    shared: tuple[SharedParameter, ...]
    outliers: tuple[Outlier, ...]
    effects: Mapping[str, tuple[str, ...]]  # found by a search beyond what all are compared by: on which robots

    @property
    def summary(self) -> str:
        """Summary in one sentence."""
        if self.robots < FEWEST:
            return f"{self.robots} robots are too few to tell which is unlike the others; {FEWEST} or more are needed."
        odd = len({outlier.robot for outlier in self.outliers})
        count = f"{odd} of {self.robots} robots {'is' if odd == 1 else 'are'}" if odd else f"None of {self.robots} robots is"
        return f"{count} unlike the others (false discovery rate below {FALSE_DISCOVERY:.0%}, {self.logs} logs)."

    def report(self) -> FleetDiagnosis:
        """Report of the comparison."""
        return FleetDiagnosis(
            robots=self.robots,
            logs=self.logs,
            summary=self.summary,
            false_discovery_rate=FALSE_DISCOVERY,
            outliers=[outlier._asdict() | {"sentence": outlier.sentence} for outlier in self.outliers],
            shared=[parameter._asdict() for parameter in self.shared],
            effects={name: list(robots) for name, robots in self.effects.items()},
        )


class FleetDiagnosis(Report, frozen=True, kw_only=True, tag="imutool.fleet-diagnosis/1"):
    """Comparison of robots; `effects` maps further effects that a search found to robots."""

    robots: int
    logs: int
    summary: str
    false_discovery_rate: float
    outliers: list[dict[str, Any]]
    shared: list[dict[str, Any]]
    effects: dict[str, list[str]]


def label(effect: str, parameter: str) -> str:
    """Effect and parameter, in words."""
    return f"{effect} {parameter}".replace("_", " ")


def compare(results: Iterable[Result]) -> Comparison:
    """Compare robots by the parameters of their logs; failed logs are left out."""
    logs: dict[str, list[Result]] = {}
    for result in results:
        if result.parameters:
            logs.setdefault(result.robot, []).append(result)
    pooled = {robot: _pooled([result.parameters for result in own]) for robot, own in sorted(logs.items())}
    units = {(p.effect, p.name): p.unit for own in logs.values() for result in own for p in result.parameters}
    names = list(units)
    values = np.array([[pooled[robot].get(name, (np.nan, np.nan)) for name in names] for robot in pooled])
    values = values.reshape(len(pooled), len(names), 2)  # also where every log has failed
    x, std = values[..., 0], values[..., 1]
    shared: list[SharedParameter] = []
    outliers: list[Outlier] = []
    for k, name in enumerate(names):
        finite = np.isfinite(x[:, k])
        middle, spread = _robust(x[finite, k])
        shared.append(SharedParameter(label(*name), units[name], middle, spread, int(finite.sum())))
    if len(pooled) >= FEWEST:
        outliers = _outliers(list(pooled), names, units, x, std)
    beyond: dict[str, set[str]] = {}
    for robot, own in logs.items():
        for effect in {effect for result in own for effect in result.effects or ()} - {effect for effect, _ in names}:
            beyond.setdefault(effect, set()).add(robot)
    return Comparison(
        len(pooled),
        sum(map(len, logs.values())),
        tuple(shared),
        tuple(outliers),
        {effect: tuple(sorted(robots)) for effect, robots in sorted(beyond.items())},
    )


def _pooled(logs: Sequence[Sequence[Parameter]]) -> dict[tuple[str, str], tuple[float, float]]:
    """Inverse-variance mean of each parameter over a robot's logs.

    Disagreement between the logs enlarges its uncertainty.
    """
    columns: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for parameters in logs:
        for parameter in parameters:
            if np.isfinite(parameter.value) and np.isfinite(parameter.std) and parameter.std > 0.0:
                columns.setdefault((parameter.effect, parameter.name), []).append((parameter.value, parameter.std))
    pooled = {}
    for name, pairs in columns.items():
        value, std = np.array(pairs).T
        weight = 1.0 / std**2
        mean = float((weight * value).sum() / weight.sum())
        own = 1.0 / weight.sum()
        among = 0.0 if len(pairs) < 2 else float((weight * (value - mean) ** 2).sum() / weight.sum() / (len(pairs) - 1))
        pooled[name] = (mean, float(np.sqrt(max(own, among))))
    return pooled


def _robust(x: Float64[np.ndarray, " n"]) -> tuple[float, float]:
    """Median and robust standard deviation; 0 for fewer than two."""
    n = len(x)
    if not n:
        return float("nan"), float("nan")
    middle = float(np.median(x))
    if n < 2 or n > MANY:
        return middle, float(MAD * np.median(np.abs(x - middle)))
    half = n // 2 + 1
    distance = np.abs(x[:, None] - x[None, :])[np.triu_indices(n, 1)]
    k = half * (half - 1) // 2 - 1
    correction = QN_OF_FEW.get(n, n / (n + (1.4 if n % 2 else 3.8)))
    return middle, float(QN * correction * np.partition(distance, k)[k])


def _outliers(
    robots: Sequence[str],
    names: Sequence[tuple[str, str]],
    units: Mapping[tuple[str, str], str],
    x: Float64[np.ndarray, "robots names"],
    std: Float64[np.ndarray, "robots names"],
) -> list[Outlier]:
    """Outliers within the false discovery rate, the clearest first.

    Each is the most deviating parameter of a robot's effect.
    """
    from scipy.special import stdtr

    tested: list[Outlier] = []
    known = [(np.isfinite(column), *_robust(column[np.isfinite(column)])) for column in x.T]
    for r, robot in enumerate(robots):
        by_effect: dict[str, list[Outlier]] = {}
        for k, (effect, parameter) in enumerate(names):
            finite, middle, spread = known[k]
            n = int(finite.sum())
            if not finite[r] or n < FEWEST:
                continue
            spread = max(spread, SMALLEST * float(np.median(std[finite, k])))
            sigma = float(abs(x[r, k] - middle) / np.hypot(std[r, k], spread))
            p = 2.0 * float(stdtr(EFFICIENCY * (n - 1), -sigma))
            own = float(x[r, k]), float(std[r, k])
            outlier = Outlier(robot, effect, parameter, *own, middle, spread, units[effect, parameter], sigma, p, 1.0)
            by_effect.setdefault(effect, []).append(outlier)
        for several in by_effect.values():
            clearest = min(several, key=lambda outlier: outlier.p_value)
            tested.append(clearest._replace(p_value=min(1.0, clearest.p_value * len(several))))
    tested.sort(key=lambda outlier: outlier.p_value)
    rates = np.array([outlier.p_value * len(tested) / (k + 1) for k, outlier in enumerate(tested)])
    rates = np.minimum.accumulate(rates[::-1])[::-1]
    ranked = [outlier._replace(false_discovery_rate=float(rate)) for outlier, rate in zip(tested, rates, strict=True)]
    return sorted(
        (outlier for outlier in ranked if outlier.false_discovery_rate <= FALSE_DISCOVERY), key=lambda outlier: -outlier.sigma
    )


def robot_of(name: str, pattern: str | None, log: Location) -> str:
    """Robot name of a log: from the log's name, its metadata, or its folder.

    `pattern` is a regular expression or `metadata:RECORD.KEY`; None takes the folder.

    Raises:
        ConfigError: the pattern is invalid, or does not match.
    """
    fits = robot_pattern(pattern)
    if fits is None:
        folder, _, file = name.rpartition("/")
        return folder or re.sub(r"(?i)\.mcap$", "", file)
    if isinstance(fits, str):
        record, _, key = fits.rpartition(".")
        with Log(log) as opened:
            found = opened.metadata().get(record, {}).get(key, "")
        if not found:
            raise ConfigError(f"has no {key!r} in its metadata {record!r}", where=log)
        return found
    match = fits.search(name)
    texts = () if match is None else match.groups("") or (match[0],)
    found = next(filter(None, texts), "")  # of several groups, as in (a)|(b), the first that takes part
    if not found:
        raise ConfigError(f"`robot_from` {fits.pattern!r} matches nothing in {name}")
    return found


def robot_pattern(pattern: str | None) -> re.Pattern[str] | str | None:
    """Regular expression on names, or RECORD.KEY of metadata.

    Raises:
        ConfigError: the pattern is neither.
    """
    if pattern is None:
        return None
    if pattern.startswith("metadata:"):
        if "." not in pattern:
            raise ConfigError(f"{pattern!r} names no metadata", where="robot_from", expected="metadata:RECORD.KEY")
        return pattern.removeprefix("metadata:")
    try:
        return re.compile(pattern)
    except re.error as error:
        raise ConfigError(f"{pattern!r} is not a regular expression ({error})", where="robot_from") from error
