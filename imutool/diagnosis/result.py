"""Report of a diagnosis: located misfits, findings, biases, unexplained residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from imutool.array_types import Bool, Float64, Rows6
from imutool.file_location import Location
from imutool.recording import Poses
from imutool.report import UNSET, Report, Section, UnsetType
from imutool.units import ASCII_UNITS

SCHEMA = "imutool.diagnosis/1"
MIN_MISFIT = 0.1  # of the noise's power: with less misfit than that, a share of it means nothing
CONVENTIONS = frozenset({"wrong_unit", "permuted_axes", "left_handed"})  # effects that are no physics

Kind = Literal["catalogue", "driven", "unknown"]
Extent = Literal["regime", "everywhere", "intermittent"]
if TYPE_CHECKING:
    Number = float
else:
    Number = float | None  # a number in memory; null in JSON where it is infinite or not a number


class Located(Section, frozen=True, omit_defaults=True):
    """Location of a misfit: axes of a signal, intervals (s from the log's start) and regime.

    `share` is the part of the signal's misfit above the noise that lies there; `p_value` is that of noise alone.
    `log` is the path of the log where there are several; `reason` says why an unusable axis is no measurement. `extent`: the
    misfit lies in the `regime`, `everywhere` (perhaps most of it in one regime), or comes and goes without one.
    """

    signal: str
    axes: tuple[str, ...]
    intervals_s: tuple[tuple[float, float], ...]
    regime: str
    share: Number
    p_value: Number
    log: str = ""
    reason: str = ""
    extent: Extent = "regime"


class Estimate(Section, frozen=True):
    """Parameter value with its standard deviation."""

    value: Number
    std: Number
    unit: str


class HeldOut(Section, frozen=True):
    """Root mean square residual on held-out time, before and after the effect was modelled."""

    rms_before: Number
    rms_after: Number
    unit: str
    seconds: Number


class Closer(HeldOut, frozen=True):
    """Held-out residual before and after all findings."""

    share: float | None = None  # of the misfit's power that is removed; None without a misfit
    by: Literal["second simulation", "computed"] = "computed"  # what gave the residual after

    @classmethod
    def computed(cls, held_out: HeldOut, noise_floor: float) -> Closer:
        """Share of the misfit above a noise of this root mean square that was removed."""
        misfit = held_out.rms_before**2 - noise_floor**2
        share = None
        if misfit > MIN_MISFIT * noise_floor**2:
            share = max(-1.0, min(1.0, (held_out.rms_before**2 - held_out.rms_after**2) / misfit))
        return cls(held_out.rms_before, held_out.rms_after, held_out.unit, held_out.seconds, share)


class Curve(Section, frozen=True):
    """Curve of an unknown effect over one variable, about its mean, with one standard deviation.

    `y` and `band` have a column for each axis. No motion separates the `mean` from a bias, so it stands by itself.
    """

    variable: str
    unit: str
    x: tuple[float, ...]
    y: tuple[tuple[float, ...], ...]
    band: tuple[tuple[Number, ...], ...]
    mean: float = 0.0

    @classmethod
    def of_arrays(
        cls,
        variable: str,
        unit: str,
        x: Float64[np.ndarray, " k"],
        y: Float64[np.ndarray, "k axes"],
        band: Float64[np.ndarray, "k axes"],
        mean: float = 0.0,
    ) -> Curve:
        """Curve from numpy arrays."""
        y_rows, band_rows = (tuple(tuple(row) for row in values.tolist()) for values in (y, band))
        return cls(variable, unit, tuple(x.tolist()), y_rows, band_rows, mean)


class Finding(Section, frozen=True, omit_defaults=True):
    """Effect that separates the recording from the simulation, with its parameters and its gain.

    Attributes:
        effect: a name of the catalogue, `driven` or `unknown`.
        share: the part of the signal's misfit above the noise that it removes on held-out time.
        similar: other effects that would do as well.
        kind: `driven` follows the channel `driver`; `unknown` is a `curve` of `variable`, or a term `variable`, on `axis`.
        onset_s: when it sets in (s from the start of the log).
        python: an equation without a name as Python, where it has one.
    """

    effect: str
    signal: str
    share: Number
    p_value: Number
    false_discovery_rate: Number
    parameters: Mapping[str, Estimate]
    equation: str
    held_out: HeldOut
    driver: str = ""
    similar: tuple[str, ...] = ()
    curve: Curve | None = None
    kind: Kind = "catalogue"
    axis: str | None = None
    variable: str = ""
    onset_s: float | None = None
    python: str = ""


class Unexplained(Section, frozen=True):
    """Residual of a signal after all findings: root mean square, noise, whiteness, p-value."""

    rms: Number
    noise_floor: Number
    white: bool
    p_value: Number = 1.0


class Bias(Section, frozen=True):
    """Constant bias of one log (rad/s, m/s²); None where it is not known."""

    gyro: tuple[float, ...] | None
    accel: tuple[float, ...] | None


class Compared(Section, frozen=True):
    """One figure before the physics was added, and after."""

    figure: str
    before: float
    after: float
    unit: str


class ClosedLoop(Section, frozen=True):
    """What is left when the physics that was found is simulated.

    Attributes:
        log: the last simulation; `rounds` were made, each with what the one before it missed.
        mismatch: whether a second diagnosis still finds a difference; `findings` are its names.
        compared: figures before and after: misfit by signal, band and time, integrated rotation and path, the user's metric.
    """

    log: str
    mismatch: bool
    findings: tuple[str, ...]
    compared: tuple[Compared, ...]
    rounds: int = 1


class DiagnosisReport(Report, frozen=True, tag=SCHEMA):
    """Findings of a diagnosis as JSON (`imutool.diagnosis/1`).

    Attributes:
        mismatch: null where nothing could be compared and no sample shows a defect; `remarks` say why.
        bias: of the first log; `biases` has one for each log.
        unexplained: `SIGNAL_rms` of each signal, `noise_floor` by signal, and whether all residuals are `white`.
        imus: rotation, lever arm and clock of the log's other IMUs against this one, by topic.
    """

    real: tuple[str, ...]
    sim: str | None
    mismatch: bool | None
    located: tuple[Located, ...]
    findings: tuple[Finding, ...]
    bias: Bias
    biases: tuple[Bias, ...]
    not_identifiable: tuple[str, ...]
    unexplained: Mapping[str, Number | bool | dict[str, Number]]
    closer: Mapping[str, Closer]
    remarks: tuple[str, ...]
    closed: ClosedLoop | UnsetType = UNSET
    imus: Mapping[str, Mapping[str, Estimate]] | UnsetType = UNSET


@dataclass(frozen=True, eq=False)
class Traces:
    """Samples of one log for figures: recorded and expected gyro (rad/s) and accel (m/s²)."""

    log: str
    t_s: Float64[np.ndarray, " n"]
    real: Rows6
    before: Rows6  # the simulation and a constant bias
    after: Rows6  # with the findings modelled
    held_out: Bool[np.ndarray, " n"]
    truth: Poses | None = None  # at these samples
    ideal: Rows6 | None = None  # an ideal sensor's samples
    band_hz: float | None = None  # the expected signal is known below this frequency
    path: str = ""  # of the log, as in `Diagnosis.real`


@dataclass(frozen=True, eq=False)
class SignalTraces:
    """Samples of another signal for figures: recorded, expected before and after, held-out rows."""

    t_s: Float64[np.ndarray, " n"]
    real: Float64[np.ndarray, " n"]
    before: Float64[np.ndarray, " n"]
    after: Float64[np.ndarray, " n"]
    held_out: Bool[np.ndarray, " n"]
    unit: str


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Result of `diagnose`: findings, strongest first, places, a bias for each log, and traces."""

    real: tuple[str, ...]
    sim: str | None
    located: tuple[Located, ...]
    findings: tuple[Finding, ...]
    bias: Float64[np.ndarray, "logs 6"]
    not_identifiable: tuple[str, ...]
    unexplained: Mapping[str, Unexplained]
    remarks: tuple[str, ...] = ()
    closer: Mapping[str, Closer] = field(default_factory=dict)  # by signal
    traces: tuple[Traces, ...] = field(default=(), repr=False)
    signals: Mapping[str, SignalTraces] = field(default_factory=dict, repr=False)  # by TOPIC.field
    caveat: str = ""  # what the reference cannot show by its origin, as it goes on after a semicolon
    closed: ClosedLoop | None = None
    imus: Mapping[str, Mapping[str, Estimate]] = field(default_factory=dict)  # other IMUs of the log, by topic
    start_ns: int | None = None  # of the first log, on the clock of the simulation: times count from it

    def __repr__(self) -> str:
        found = ", ".join(f"{f.effect} ({f.signal}, {f.share:.0%})" for f in self.findings)
        unnamed = {True: "no name", False: "a constant bias at most", None: "nothing could be compared"}[self.mismatch]
        return f"<diagnosis of {', '.join(self.real)}: {found or unnamed}>"

    @classmethod
    def without_imu(cls, reals: Sequence[Location], sim: Location) -> Diagnosis:
        """A diagnosis to which only other signals are added."""
        return cls(tuple(map(str, reals)), str(sim), (), (), np.full((len(reals), 6), np.nan), (), {})

    @property
    def mismatch(self) -> bool | None:
        """Whether more than a constant bias and noise separates the two; None where nothing could be compared."""
        differs = bool(self.findings or self.located)
        return differs if differs or self.unexplained else None

    @property
    def report(self) -> DiagnosisReport:
        """The JSON report; a sensor whose axes are all unusable has null residuals."""
        biases = tuple(_bias(row) for row in self.bias)
        return DiagnosisReport(
            real=self.real,
            sim=self.sim,
            mismatch=self.mismatch,
            located=self.located,
            findings=self.findings,
            bias=biases[0],
            biases=biases,
            not_identifiable=self.not_identifiable,
            unexplained=_unexplained(self.unexplained),
            closer=self.closer,
            remarks=self.remarks,
            closed=UNSET if self.closed is None else self.closed,
            imus=self.imus or UNSET,
        )


def _bias(values: Float64[np.ndarray, "6"]) -> Bias:
    return Bias(*(tuple(part.tolist()) if np.isfinite(part).all() else None for part in (values[:3], values[3:])))


def _unexplained(residuals: Mapping[str, Unexplained]) -> dict[str, float | bool | dict[str, float]]:
    by_signal = dict.fromkeys(ASCII_UNITS, Unexplained(np.nan, np.nan, white=True)) | dict(residuals)  # null in JSON
    return {
        **{f"{signal}_rms": residual.rms for signal, residual in by_signal.items()},
        "noise_floor": {signal: residual.noise_floor for signal, residual in by_signal.items()},
        "white": all(residual.white for residual in residuals.values()) if residuals else np.nan,
    }
