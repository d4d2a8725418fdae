"""Quantities with their uncertainty as text: rounded, in a readable unit."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from imutool.diagnosis.result import Estimate, Finding
from imutool.units import AXES, with_superscripts

SHOWN = 3  # numbers of one quantity; a matrix has up to nine
VAGUE = 10.0  # times the least deviation of a course: from here on a time shows too little to count in its span
DRIFTS = frozenset({"gyro_bias_drift", "accel_bias_drift"})
RATES = {"rad/s": "rad/s²", "m/s²": "m/s³"}  # unit of a rate, by that of an amplitude
RAISED = ("⁰", "¹", "²", "³", "⁴", "⁵", "⁶", "⁷", "⁸", "⁹")

# A quantity of a unit is shown in the first step that it is not too small for: (from, size of the step, its symbol).
STEPS: Mapping[str, tuple[tuple[float, float, str], ...]] = {
    "s": ((0.5, 1.0, "s"), (5e-4, 1e-3, "ms"), (0.0, 1e-6, "µs")),
    "m": ((0.02, 1.0, "m"), (0.0, 1e-3, "mm")),
    "rad": ((0.0, math.pi / 180.0, "°"),),
    "-": ((1.0, 1.0, ""), (1e-3, 1e-2, "%"), (0.0, 1e-6, "ppm")),
    "rad/s": ((0.02, 1.0, "rad/s"), (0.0, 1e-3, "mrad/s")),
    "m/s²": ((0.02, 1.0, "m/s²"), (0.0, 1e-3, "mm/s²")),
}
PLAIN_FROM, PLAIN_BELOW = 1e-2, 1e5  # outside, a power of ten is taken out in front


@dataclass(frozen=True)
class Quantity:
    """Parameters of one vector, matrix or course in time, with a label."""

    label: str
    axes: tuple[str, ...]
    estimates: tuple[Estimate, ...]

    def __str__(self) -> str:
        """`12.4 ± 0.3 ms`, `(0.213, -0.051, 0.120) ± 0.004 m`, the clearest three of many, or the span of a course."""
        if len(self.estimates) == 1:
            return value(self.estimates[0])
        if self.axes[0].startswith("at "):
            sure = [e for e in self.estimates if e.std <= VAGUE * min(other.std for other in self.estimates)]
            minimum, maximum = (value(extreme(sure, key=lambda e: e.value)) for extreme in (min, max))
            return f"{minimum} to {maximum}"
        if self.axes == AXES:
            return vector(self.estimates)
        clearest = sorted(range(len(self.axes)), key=lambda k: -_clearness(self.estimates[k]))[:SHOWN]
        shown = [k for k in range(len(self.axes)) if k in clearest]
        text = vector([self.estimates[k] for k in shown], [self.axes[k] for k in shown])
        more = len(self.axes) - len(shown)
        return f"{text} and {more} more" if more else text

    @property
    def labelled(self) -> str:
        """With its label before it, if it has one: `cut-off 12.0 ± 0.3 Hz`."""
        return f"{self.label} {self}".strip()

    @property
    def sign(self) -> float:
        """Of the first of them."""
        return math.copysign(1.0, self.estimates[0].value)

    @property
    def size(self) -> str:
        """As `str`, without the sign."""
        return str(Quantity(self.label, self.axes, tuple(Estimate(abs(e.value), e.std, e.unit) for e in self.estimates)))


def stated_parameters(finding: Finding) -> Mapping[str, Estimate]:
    """Parameters as sentences state them.

    Of a drift whose time constant the log does not show, only the rate is stated.
    """
    tau = finding.parameters.get("tau") if finding.effect in DRIFTS else None
    if tau is None or tau.std <= tau.value:
        return finding.parameters
    amplitudes = {key: a for key, a in finding.parameters.items() if key != "tau"}
    return {key: Estimate(a.value / tau.value, a.std / tau.value, RATES[a.unit]) for key, a in amplitudes.items()}


def grouped(estimates: Mapping[str, Estimate]) -> list[Quantity]:
    """Quantities of parameters, those of one vector or matrix together.

    `x`, `y`, `z` (or `tilt_x`, `tilt_y`; `xy`, `yx`; `at_0`, `at_30`) of a unit are one quantity.

    What is infinite is left out: a limit or a cut-off that is never reached.
    """
    taken: dict[tuple[str, str], list[str]] = {}
    for key, estimate in estimates.items():
        if math.isinf(estimate.value):
            continue
        match = re.fullmatch(r"(?P<stem>.*?)[._]?(?:[xyz][._]?[xyz]|[xyz]|(?<=^at_)\d+)", key)
        taken.setdefault((match["stem"] if match else key, estimate.unit), []).append(key)
    out = []
    for (stem, _), keys in taken.items():
        if len(keys) == 1:  # a word that only ends like an axis, such as `frequency`
            out.append(Quantity(keys[0], (keys[0],), (estimates[keys[0]],)))
        else:
            axes = tuple(key[len(stem) :].lstrip("._") for key in keys)
            times = axes[0].isdigit()
            axes = tuple(f"at {axis} s:" for axis in axes) if times else axes
            out.append(Quantity("" if times else stem, axes, tuple(estimates[key] for key in keys)))
    return out


def distinguished(estimates: Mapping[str, Estimate]) -> tuple[dict[str, Estimate], list[str]]:
    """Estimates larger than their standard deviation, and the names of the others."""
    small = [name for name, e in estimates.items() if math.isfinite(e.std) and abs(e.value) < e.std]
    return {name: estimate for name, estimate in estimates.items() if name not in small}, small


def value(estimate: Estimate) -> str:
    """Text of an estimate, `12.4 ± 0.3 ms`, rounded to the uncertainty; four digits if zero."""
    size, unit = _step([estimate])
    number, band, factor = _numbers([estimate], size)
    text = f"{number[0]} ± {band[0]}" if band[0] else number[0]
    if factor:
        text = f"({text}) {factor}" if band[0] else f"{text} {factor}"
    unknown = "" if math.isfinite(estimate.std) else " (uncertainty unknown)"
    return _with(text, unit) + unknown


def vector(several: Sequence[Estimate], labels: Sequence[str] = ()) -> str:
    """Text of a vector, `(0.213, -0.051, 0.120) ± 0.004 m`; labels come before the numbers."""
    size, unit = _step(several)
    numbers, bands, factor = _numbers(several, size)
    if labels:
        numbers = [f"{label} {number}" for label, number in zip(labels, numbers, strict=True)]
    text = f"({', '.join(numbers)})"
    if all(bands):
        text += f" ± {bands[0]}" if len(set(bands)) == 1 else f" ± ({', '.join(bands)})"
    if factor:
        text = f"[{text}] {factor}"
    unknown = "" if all(math.isfinite(estimate.std) for estimate in several) else " (uncertainty unknown)"
    return _with(text, unit) + unknown


def each(several: Sequence[Estimate], labels: Sequence[str]) -> tuple[list[str], str]:
    """`xx 1.4 ± 0.2` of each, and the unit (with its power of ten) that all share."""
    size, unit = _step(several)
    numbers, bands, factor = _numbers(several, size)
    entries = [
        f"{label} {number} ± {band}" if band else f"{label} {number}"
        for label, number, band in zip(labels, numbers, bands, strict=True)
    ]
    return entries, " ".join(part for part in (factor, unit) if part)


def symbol(unit: str) -> str:
    """A unit as people write it: `m/s²`, and nothing for none."""
    return "" if unit in {"-", "1", ""} else with_superscripts(unit)


def percent(share: float) -> str:
    """`63 %`; never a 0 or 100 that it is not."""
    if math.isnan(share):
        return "an unknown share"
    if 0.0 < share < 0.005:
        return "less than 1 %" if share >= 1e-3 else "less than 0.1 %"
    return "more than 99 %" if 0.995 < share < 1.0 else f"{100.0 * share:.0f} %"


def _clearness(estimate: Estimate) -> float:
    """How many standard deviations it is from zero."""
    return abs(estimate.value) / estimate.std if estimate.std > 0.0 else math.inf


def _step(several: Sequence[Estimate]) -> tuple[float, str]:
    """The size of the unit that suits the largest of them, and its symbol."""
    unit = symbol(several[0].unit)
    largest = max(abs(estimate.value) for estimate in several)
    if largest == 0.0 or not math.isfinite(largest):
        largest = max((estimate.std for estimate in several if math.isfinite(estimate.std)), default=0.0)
    if largest == 0.0:  # a form, such as an order
        return 1.0, unit
    for minimum, size, name in STEPS.get(unit or "-", ()):
        if largest >= minimum:
            return size, name
    return 1.0, unit


def _numbers(several: Sequence[Estimate], size: float) -> tuple[list[str], list[str], str]:
    """Values and uncertainties as text, rounded, and the power of ten taken out in front."""
    values = [estimate.value / size for estimate in several]
    bands = [estimate.std / size for estimate in several]
    largest = max((abs(v) for v in [*values, *bands] if math.isfinite(v)), default=0.0)
    power = 0 if largest == 0.0 or PLAIN_FROM <= largest < PLAIN_BELOW else 3 * math.floor(math.log10(largest) / 3.0)
    values, bands = [v / 10.0**power for v in values], [b / 10.0**power for b in bands]
    factor = f"× 10{_raised(power)}" if power else ""
    if not all(math.isfinite(b) and b > 0.0 for b in bands):
        return [f"{v:.4g}" for v in values], [""] * len(values), factor
    places = [_decimals(b) for b in bands]
    return (
        [_fixed(*pair) for pair in zip(values, places, strict=True)],
        [_fixed(*p) for p in zip(bands, places, strict=True)],
        factor,
    )


def _decimals(std: float) -> int:
    """Decimals of an uncertainty: its first digit, and the second if the first is a one."""
    exponent = math.floor(math.log10(std))
    lead = std / 10.0**exponent
    if lead >= 9.5:
        return -exponent  # rounds to ten: two digits of it
    return -exponent + 1 if lead < 1.95 else -exponent


def _fixed(number: float, places: int) -> str:
    text = f"{round(number, places):.{max(places, 0)}f}"
    return text.removeprefix("-") if float(text) == 0.0 else text  # no minus zero


def _raised(power: int) -> str:
    return ("⁻" if power < 0 else "") + "".join(RAISED[int(digit)] for digit in str(abs(power)))


def _with(text: str, unit: str) -> str:
    return f"{text}{'' if unit in {'', '°'} else ' '}{unit}"
