"""The noise of the IMU in a log: at rest by its Allan deviation, in motion by what is left against the truth.

Rest is believed before motion: there, nothing but the sensor (and what shakes it) is in the samples. What the log cannot show
is left unknown, and the report says why.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from imutool.config import build
from imutool.errors import DataError
from imutool.inertial.stationary import rest_stretches, white_noise
from imutool.location import Location
from imutool.mcap_io.read import read
from imutool.noise import allan
from imutool.noise import datasheet as noise
from imutool.noise.allan import Curve, Slopes
from imutool.noise.datasheet import UNITS, Noise
from imutool.recording import Imu, Recording

Sensor = Literal["gyro", "accel"]
SENSORS: tuple[Sensor, Sensor] = ("gyro", "accel")
KINDS = ("density", "walk", "instability")  # of each sensor, as `Noise` has them
VIBRATES = 2.0  # times the white variance at shorter averaging times: more than any filter or misfit
SURE = 10.0  # differences worth this many independent ones bound a density from above
CHANCE = 0.002  # that one averaging time puts the bound too low
SHORT = 2.5  # samples: over longer windows a vibration of the samples averages out, and is no measure of what must be left
MADE_FROM_IT = 0.25  # of a sample's white noise: an independent truth disagrees by more than that
EXPLAINED = 3.0  # times a sample's white noise: what is above comes from the truth or the calibration
UNKNOWN: list[float | None] = [None] * 3
WINDOWS_S: Mapping[Sensor, tuple[float, float]] = {
    "gyro": (1.0, 4.0),
    "accel": (0.5, 2.0),
}  # for the calibration on the log itself


@dataclass(frozen=True)
class CurveSource:
    """One way of seeing the noise: over how many seconds, in words, the curve of each sensor, and what its slopes say."""

    how: str
    seconds: float
    curves: Mapping[Sensor, Curve]
    slopes: Mapping[Sensor, list[Slopes]]

    @classmethod
    def of(cls, how: str, seconds: float, curves: Mapping[Sensor, Curve]) -> CurveSource:
        """The sight with its slopes read off."""
        return cls(how, seconds, curves, {sensor: allan.slopes(curve) for sensor, curve in curves.items()})

    def axes(self, sensor: Sensor, kind: str) -> list[float | None]:
        """What was seen, by axis."""
        return [one.seen.get(kind) for one in self.slopes[sensor]]


@dataclass(frozen=True)
class IdentifiedNoise:
    """The noise, with what it was read from and what has to be said about it."""

    log: str
    topic: str
    noise: Noise
    at_most: Mapping[Sensor, list[float | None]]  # density of each sensor, as rest bounds it from above
    samples: Mapping[
        Sensor, Float64[np.ndarray, "3"]
    ]  # density of each sensor as the second differences of its samples have it
    at_rest: CurveSource | None
    in_motion: CurveSource | None
    remarks: list[str]


def identify(
    path: Location, *, imu: str | None = None, truth: str | None = None, model: str | Path | None = None
) -> IdentifiedNoise:
    """The noise of one IMU of a log, from its time at rest and, where there is truth, from its motion.

    In motion the samples are first corrected: by `model`, else by a matrix and a constant fitted to this log's own truth.

    Raises:
        DataError: the log neither rests nor has a truth that shows anything.
        LogError, ConfigError, ModelError: the log or the model cannot be used.
    """
    allan.library()
    recording = read(path, imu=imu, truth=truth)
    if truth is None and recording.truths:
        recording = recording.with_truth(next(iter(recording.truths)))
    remarks: list[str] = []
    rest = _at_rest(recording.imu, remarks)
    motion = None
    if recording.truths:
        try:
            motion = _in_motion(recording, model, path)
        except DataError as error:
            remarks.append(f"in motion: {error.what}")
    else:
        remarks.append("in motion: the log has no true poses")
    samples = {
        sensor: white_noise(u) * np.sqrt(recording.imu.period_s)
        for sensor, u in zip(SENSORS, _columns(recording.imu), strict=True)
    }
    at_most = {sensor: _bound(rest.curves[sensor]) if rest is not None else UNKNOWN for sensor in SENSORS}
    found = _combine(rest, motion, samples, at_most, recording.imu.period_s, remarks)
    if rest is None and motion is None:
        raise DataError(
            "the log shows no noise: " + "; ".join(remarks),
            where=path,
            expected="a stretch at rest, or true poses",
            fix="Record the sensor at rest, for hours if its bias walk is wanted",
        )
    return IdentifiedNoise(recording.name, recording.imu_topic, found, at_most, samples, rest, motion, remarks)


def _at_rest(imu: Imu, remarks: list[str]) -> CurveSource | None:
    found = rest_stretches(imu)
    if not found:
        remarks.append("at rest: the log never rests")
        return None
    lengths = [float(imu.t_ns[b - 1] - imu.t_ns[a]) * 1e-9 for a, b in found]
    curves = {
        sensor: allan.curve([u[a:b] for a, b in found], imu.period_s) for sensor, u in zip(SENSORS, _columns(imu), strict=True)
    }
    sight = CurveSource.of(f"{_duration(sum(lengths))} at rest", sum(lengths), curves)
    for sensor in SENSORS:
        shaken = ["xyz"[axis] for axis, one in enumerate(sight.slopes[sensor]) if _vibrates(one)]
        if shaken:
            remarks.append(
                f"at rest: the {sensor}'s deviation on {', '.join(shaken)} does not fall as tau^-1/2 from the shortest times "
                "on: something vibrates (idling motors?), and what is read there is no data-sheet noise"
            )
        if all(walk is None for walk in sight.axes(sensor, "walk")) and len(curves[sensor].tau_s):
            longest = float(curves[sensor].tau_s[-1])
            remarks.append(f"at rest: no bias walk of the {sensor} shows up to averages of {_duration(longest)}")
    return sight


def _vibrates(one: Slopes) -> bool:
    return one.excess > VIBRATES or "quantisation" in one.seen or not one.powers


def _in_motion(recording: Recording, model: str | Path | None, path: Location) -> CurveSource:
    """Deviation of what is left of the samples against the truth.

    Raises:
        DataError: too little truth.
        ModelError: a model that cannot be used with this log.
    """
    from imutool.noise.residual import curves

    corrected, by = _by_model(recording, model, path) if model is not None else _by_fit(recording)
    both = dict(zip(SENSORS, curves(corrected, recording.truth), strict=True))
    seconds = recording.overlap().imu.duration_s
    topic = next(iter(recording.truths))
    return CurveSource.of(f"{_duration(seconds)} in motion against {topic}, {by}", seconds, both)


def _by_model(recording: Recording, model: str | Path, path: Location) -> tuple[Imu, str]:
    from imutool.evaluation import runs

    *_, last = runs(recording, [model], "auto", str(path))
    return last[1].imu, f"corrected by {last[0]}"


def _by_fit(recording: Recording) -> tuple[Imu, str]:
    """Samples less the matrix and the constant that this log's truth asks for: a wrong scale is no noise.

    A bias that walks far bends the matrix too: a walk of 0.006 rad/s/sqrt(s) was read a third too large after this fit, and a
    tenth with the true matrix. Data sheets have a hundredth of it.
    """
    import torch

    from imutool.bias import static
    from imutool.training import closed_form
    from imutool.training.segments import Pool

    pool = Pool.of([recording])
    known = static.Model(rate_hz=pool.rate_hz).double()
    rest = torch.zeros(1, 6, dtype=torch.float64)
    corrected = []
    for column, (sensor, u) in enumerate(zip(SENSORS, _columns(recording.imu), strict=True)):
        solution = closed_form.solve(known, sensor, pool, rest, WINDOWS_S[sensor], matrix=True, part="all")
        rest[:, 3 * column : 3 * column + 3] = solution.rest
        corrected.append(u - u @ solution.W.numpy().T - solution.rest.numpy())
    return Imu(recording.imu.t_ns, *corrected), "corrected by a matrix and a constant fitted to it"


def _combine(
    rest: CurveSource | None,
    motion: CurveSource | None,
    samples: Mapping[Sensor, Float64[np.ndarray, "3"]],
    at_most: Mapping[Sensor, list[float | None]],
    period_s: float,
    remarks: list[str],
) -> Noise:
    """The noise from both sights, rest first; from motion only on axes on which it shows the sensor alone."""
    values: dict[str, list[float | None]] = dict.fromkeys(UNITS, UNKNOWN)
    sources: dict[str, str] = {}
    for sensor in SENSORS:
        believed = (
            [False] * 3
            if motion is None
            else _well_determined(sensor, motion, samples[sensor], at_most[sensor], period_s, remarks)
        )
        for kind in KINDS:
            name = f"{sensor}_{kind}"
            still = UNKNOWN if rest is None else rest.axes(sensor, kind)
            if kind == "density":  # a fit to vibration may claim more than the least that was seen
                still = [s if s is None or b is None or s <= b else None for s, b in zip(still, at_most[sensor], strict=True)]
            moving = UNKNOWN if motion is None or kind == "instability" else motion.axes(sensor, kind)
            values[name] = [s if s is not None else m if b else None for s, m, b in zip(still, moving, believed, strict=True)]
            used = (rest, still != UNKNOWN), (motion, values[name] != still)
            if ways := [sight.how for sight, is_used in used if sight is not None and is_used]:
                sources[name] = "; ".join(ways)
    return build(Noise, {**values, "sources": sources})


def _well_determined(
    sensor: Sensor,
    motion: CurveSource,
    sample: Float64[np.ndarray, "3"],
    at_most: list[float | None],
    period_s: float,
    remarks: list[str],
) -> list[bool]:
    """Axes on which motion shows the sensor's own noise, and words about those on which it does not."""
    curve = motion.curves[sensor]
    shortest = curve.deviation[0] * np.sqrt(curve.tau_s[0])
    if curve.tau_s[0] < SHORT * period_s and float(np.median(shortest / np.maximum(sample, 1e-300))) < MADE_FROM_IT:
        remarks.append(
            f"in motion: the truth follows the {sensor} more closely than the {sensor}'s own noise lets an independent one: "
            "it was made from it, and shows nothing of it"
        )
        return [False] * 3
    density = [np.inf if value is None else value for value in motion.axes(sensor, "density")]
    ratio = np.array(density) / np.maximum(sample, 1e-300)
    if (ratio > EXPLAINED).any():
        remarks.append(
            f"in motion: more of the {sensor}'s error is left than the noise of its samples explains; "
            "it is the truth's, or the calibration's"
        )
    bounds = [np.inf if value is None else value for value in at_most]
    return [bool(r <= EXPLAINED and d <= bound) for r, d, bound in zip(ratio, density, bounds, strict=True)]


def _bound(curve: Curve) -> list[float | None]:
    """The least that deviation * sqrt(tau) comes to, by axis, at the end of its confidence: white noise cannot be more."""
    from scipy.special import gammaincinv

    sure = curve.freedom >= SURE
    if not sure.any():
        return UNKNOWN
    freedom = curve.freedom[sure]
    stretch = np.sqrt(freedom / (2.0 * gammaincinv(freedom / 2.0, CHANCE)))  # the quantile of chi²
    seen = curve.deviation[sure] * (np.sqrt(curve.tau_s[sure]) * stretch)[:, None]
    return [float(value) for value in seen.min(axis=0)]


def _columns(imu: Imu) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    return imu.gyro, imu.accel


def _duration(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds >= 5400 else f"{seconds / 60:.1f} min" if seconds >= 90 else f"{seconds:.3g} s"


def plain(found: IdentifiedNoise) -> dict[str, Any]:
    """Everything found as plain JSON values: null is what the log cannot show."""
    report: dict[str, Any] = {"imu": found.topic, **noise.plain(found.noise)}
    report["at_most"] = {f"{sensor}_density": axes for sensor, axes in found.at_most.items()}
    report["samples"] = {f"{sensor}_density": axes.tolist() for sensor, axes in found.samples.items()}
    for name, sight in (("at_rest", found.at_rest), ("in_motion", found.in_motion)):
        report[name] = None if sight is None else _plain_sight(sight)
    return {**report, "remarks": list(found.remarks)}


def _plain_sight(sight: CurveSource) -> dict[str, Any]:
    report: dict[str, Any] = {"how": sight.how, "seconds": sight.seconds}
    for sensor in SENSORS:
        curve = sight.curves[sensor]
        report[sensor] = {
            **{kind: sight.axes(sensor, kind) for kind in KINDS},
            **{f"{kind}_std": [one.std.get(kind) for one in sight.slopes[sensor]] for kind in KINDS},
            "holds_from_s": [one.from_s if one.powers else None for one in sight.slopes[sensor]],
            "tau_s": curve.tau_s.tolist(),
            "deviation": curve.deviation.tolist(),
        }
    return report


def rows(found: IdentifiedNoise) -> list[tuple[str, ...]]:
    """What was found as rows of text for a table, the first its header."""
    table: list[tuple[str, ...]] = [("noise", "x", "y", "z", "unit", "source")]
    for name, unit in UNITS.items():
        table.append((name, *map(_number, getattr(found.noise, name)), unit, found.noise.sources.get(name, "not seen")))
    for sensor in SENSORS:
        name, unit = f"{sensor}_density", UNITS[f"{sensor}_density"]
        if found.at_rest is not None and None in getattr(found.noise, name):
            table.append((f"{name} at most", *map(_number, found.at_most[sensor]), unit, found.at_rest.how))
        table.append((f"{name} of samples", *map(_number, found.samples[sensor]), unit, "second differences of the samples"))
        for kind in ("density", "walk"):
            axes = UNKNOWN if found.in_motion is None else found.in_motion.axes(sensor, kind)
            if found.in_motion is not None and axes != UNKNOWN:
                name = f"{sensor}_{kind}"
                table.append((f"{name} in motion", *map(_number, axes), UNITS[name], found.in_motion.how))
    return table


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.2e}"
