"""Noise of an IMU: Allan deviation at rest, residuals against the truth in motion.

Rest has priority: there the samples hold only noise and vibration. A value that the log does not show stays unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from imutool.array_types import Float64
from imutool.config import build
from imutool.errors import DataError, LogError
from imutool.file_location import Location
from imutool.inertial.stationary import CALM, rest_stretches, white_noise
from imutool.log_info.imu_motion import in_si_units
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import longest_recording, read_recordings
from imutool.noise import allan
from imutool.noise import datasheet as noise
from imutool.noise.allan import Curve, Slopes
from imutool.noise.datasheet import UNITS, Noise
from imutool.processes.system import release_memory
from imutool.recording import Imu, Recording
from imutool.units import SENSORS, Sensor

KINDS = ("density", "walk", "instability")  # of each sensor, as `Noise` has them
SHORT = 2.5  # samples: over longer windows vibration averages out, and no longer bounds the residual from below
DEPENDENT_TRUTH = 0.2  # of a sample's white noise: an independent truth differs by more
EXPLAINED = 2.5  # times a sample's white noise: a larger residual comes from the truth or the calibration
MOSTLY = 0.9  # of a log
UNKNOWN: list[float | None] = [None] * 3
FINE: Mapping[Sensor, list[bool]] = {sensor: [False] * 3 for sensor in SENSORS}
WINDOWS_S: Mapping[Sensor, tuple[float, float]] = {"gyro": (1.0, 4.0), "accel": (0.5, 2.0)}  # of the calibration


@dataclass(frozen=True)
class CurveSource:
    """Allan curves of both sensors from one source, and their slopes."""

    how: str
    seconds: float
    curves: Mapping[Sensor, Curve]
    slopes: Mapping[Sensor, list[Slopes]]
    at_most: Mapping[Sensor, list[float | None]]  # upper bound of each sensor's density

    @classmethod
    def of(
        cls, how: str, seconds: float, curves: Mapping[Sensor, Curve], coarse: Mapping[Sensor, list[bool]] = FINE
    ) -> CurveSource:
        """Source with the slopes of its curves, but of axes with coarse digits."""
        slopes, at_most = {}, {}
        for sensor, curve in curves.items():
            wrong = coarse[sensor]
            slopes[sensor] = [Slopes() if wrong[axis] else found for axis, found in enumerate(allan.slopes(curve))]
            at_most[sensor] = [None if wrong[axis] else bound for axis, bound in enumerate(allan.density_bound(curve))]
        return cls(how, seconds, curves, slopes, at_most)

    def axes(self, sensor: Sensor, kind: str) -> list[float | None]:
        """Noise value of one kind, by axis."""
        return [slopes.seen.get(kind) for slopes in self.slopes[sensor]]


@dataclass(frozen=True)
class IdentifiedNoise:
    """Identified noise with its sources, bounds and remarks."""

    log: str
    topic: str
    noise: Noise
    at_most: Mapping[Sensor, list[float | None]]  # upper bound of each sensor's density from rest
    samples: Mapping[Sensor, Float64[np.ndarray, "3"]]  # density of each sensor from the differences of its samples
    at_rest: CurveSource | None
    in_motion: CurveSource | None
    remarks: list[str]


def identify(
    log: Location | Log, *, imu: str | None = None, truth: str | None = None, model: str | Path | None = None
) -> IdentifiedNoise:
    """Noise of one IMU of a log, which may be open: from rest, and with true poses from motion.

    In motion the samples are first corrected: by `model`, else by a matrix and a constant fitted to this log's own truth.

    Raises:
        DataError: the log neither rests nor has a usable truth.
        LogError, ConfigError, ModelError: the log or the model is not usable.
    """
    allan.library()
    if not isinstance(log, Log):
        with Log(log) as opened:
            return identify(opened, imu=imu, truth=truth, model=model)
    left_out: dict[str, LogError] = {}  # poses: samples at rest need none
    found = read_recordings(log, imu=imu, truth=truth, vectors=False, refused=None if truth else left_out.__setitem__)
    path, recording = log.path, longest_recording(found)
    if truth is None and recording.truths:
        recording = recording.with_truth(next(iter(recording.truths)))
    recording, remarks = in_si_units(recording)
    remarks += [f"{topic} is left out: {error.what}" for topic, error in left_out.items()]
    release_memory()
    rest = _at_rest(recording.imu, remarks)
    motion = None
    try:
        motion = _in_motion(recording, model, path, 0.0 if rest is None else rest.seconds)
    except DataError as error:
        remarks.append(f"in motion: {error.what}")
    period_s = allan.sample_period_s(recording.imu)
    samples = {sensor: CALM * white_noise(getattr(recording.imu, sensor), period_s) * np.sqrt(period_s) for sensor in SENSORS}
    at_most = dict.fromkeys(SENSORS, UNKNOWN) if rest is None else rest.at_most
    combined = _combine(rest, motion, samples, at_most, period_s, remarks)
    if rest is None and motion is None:
        what, fix = f"the log shows no noise: {'; '.join(remarks)}", "Record the sensor at rest, for hours to see its bias walk"
        raise DataError(what, where=path, expected="a stretch at rest, or true poses", fix=fix)
    return IdentifiedNoise(recording.name, recording.imu_topic, combined, at_most, samples, rest, motion, remarks)


def _at_rest(imu: Imu, remarks: list[str]) -> CurveSource | None:
    if not (stretches := rest_stretches(imu)):
        remarks.append("at rest: the log never rests")
        return None
    total_s, period_s = 1e-9 * sum(int(imu.t_ns[b - 1] - imu.t_ns[a]) for a, b in stretches), allan.sample_period_s(imu)
    parts = {sensor: [getattr(imu, sensor)[slice(*bounds)] for bounds in stretches] for sensor in SENSORS}
    curves = {sensor: allan.curve(parts[sensor], period_s) for sensor in SENSORS}
    coarse = {sensor: allan.coarse_axes(parts[sensor]) for sensor in SENSORS}
    source = CurveSource.of(f"{_duration(total_s)} at rest", total_s, curves, coarse)
    for sensor in SENSORS:
        remarks += [f"at rest: {text}" for text in allan.rest_remarks(sensor, source.slopes[sensor], coarse[sensor])]
        if all(walk is None for walk in source.axes(sensor, "walk")) and len(curves[sensor].tau_s):
            longest = float(curves[sensor].tau_s[-1])
            remarks.append(f"at rest: no bias walk of the {sensor} shows up to averages of {_duration(longest)}")
    return source


def _in_motion(recording: Recording, model: str | Path | None, path: Location, rest_s: float) -> CurveSource:
    """Allan deviation of the residuals against the truth.

    Raises:
        DataError: too little truth, or too little motion: a matrix fitted to rest explains the noise.
        ModelError: a model that does not fit this log.
    """
    if not recording.truths:
        raise DataError("the log has no true poses")
    if rest_s > MOSTLY * recording.imu.duration_s:
        raise DataError("the sensor rests nearly all the time")
    import imutool.training  # noqa: F401  refuses without PyTorch
    from imutool.noise.residual import curves

    corrected, by = _by_model(recording, model, path) if model is not None else _by_fit(recording)
    both = dict(zip(SENSORS, curves(corrected, recording.truth), strict=True))
    length_s, topic = recording.overlap().imu.duration_s, next(iter(recording.truths))
    return CurveSource.of(f"{_duration(length_s)} in motion against {topic}, {by}", length_s, both)


def _by_model(recording: Recording, model: str | Path, path: Location) -> tuple[Imu, str]:
    from imutool.evaluation import runs

    *_, last = runs(recording, [model], "auto", str(path))
    return last[1].imu, f"corrected by {last[0]}"


def _by_fit(recording: Recording) -> tuple[Imu, str]:
    """Samples corrected by a matrix and a constant fitted to this log's truth: a wrong scale is not noise.

    A large bias walk disturbs the matrix: a walk of 0.006 rad/s/sqrt(s) came out a third too large after this fit, and a tenth
    too large with the true matrix. Data sheets list a hundredth of that walk.
    """
    import torch

    from imutool.bias.networks import static
    from imutool.training.calibration import closed_form
    from imutool.training.training_windows import Pool

    pool = Pool.of([recording])
    release_memory()
    model = static.Network(rate_hz=pool.rate_hz).double()
    rest = torch.zeros(1, 6, dtype=torch.float64)
    matrices = []
    for k, sensor in enumerate(SENSORS):
        solution = closed_form.solve(model, sensor, pool, rest, WINDOWS_S[sensor], matrix=True, part="all")
        rest[:, 3 * k : 3 * k + 3] = solution.rest
        matrices.append(solution.W.numpy())
    del pool
    release_memory()
    columns = zip((recording.imu.gyro, recording.imu.accel), matrices, rest.numpy().reshape(2, 3), strict=True)
    corrected = [u - u @ W.T - constant for u, W, constant in columns]
    return Imu(recording.imu.t_ns, *corrected), "corrected by a matrix and a constant fitted to it"


def _combine(
    rest: CurveSource | None,
    motion: CurveSource | None,
    samples: Mapping[Sensor, Float64[np.ndarray, "3"]],
    at_most: Mapping[Sensor, list[float | None]],
    period_s: float,
    remarks: list[str],
) -> Noise:
    """Noise from rest, else from motion on axes where the residual is the sensor's own noise."""
    values: dict[str, list[float | None]] = dict.fromkeys(UNITS, UNKNOWN)
    sources: dict[str, str] = {}
    for sensor in SENSORS:
        accepted = [False] * 3
        if motion is not None:
            accepted = _well_determined(sensor, motion, samples[sensor], at_most[sensor], period_s, remarks)
        for kind in KINDS:
            name = f"{sensor}_{kind}"
            still = UNKNOWN if rest is None else rest.axes(sensor, kind)
            if rest is not None and kind == "density":  # a fit to vibration may exceed the upper bound by more than its error
                errors = [slopes.std.get(kind, 0.0) for slopes in rest.slopes[sensor]]
                bounds = zip(still, errors, at_most[sensor], strict=True)
                still = [s if s is None or b is None or s - std <= b else None for s, std, b in bounds]
            moving = UNKNOWN if motion is None or kind == "instability" else motion.axes(sensor, kind)
            values[name] = [s if s is not None else m if b else None for s, m, b in zip(still, moving, accepted, strict=True)]
            used = (rest, still != UNKNOWN), (motion, values[name] != still)
            if names := [source.how for source, is_used in used if source is not None and is_used]:
                sources[name] = "; ".join(names)
    return build(Noise, {**values, "sources": sources})


def _well_determined(
    sensor: Sensor,
    motion: CurveSource,
    sample: Float64[np.ndarray, "3"],
    at_most: list[float | None],
    period_s: float,
    remarks: list[str],
) -> list[bool]:
    """Axes on which motion shows the sensor's own noise; remarks explain the others."""
    curve = motion.curves[sensor]
    shortest = curve.deviation[0] * np.sqrt(curve.tau_s[0])
    if curve.tau_s[0] < SHORT * period_s and float(np.median(shortest / np.maximum(sample, 1e-300))) < DEPENDENT_TRUTH:
        remarks.append(
            f"in motion: the truth follows the {sensor} more closely than the {sensor}'s own noise allows for independent "
            "truth: it was computed from the same samples, and does not show their noise"
        )
        return [False] * 3
    density = [np.inf if value is None else value for value in motion.axes(sensor, "density")]
    ratio = np.array(density) / np.maximum(sample, 1e-300)
    if (ratio > EXPLAINED).any():
        remarks.append(
            f"in motion: the {sensor}'s residual is larger than the noise of its samples explains; "
            "the rest comes from the truth or the calibration"
        )
    bounds = [np.inf if value is None else value for value in at_most]
    return [bool(r <= EXPLAINED and d <= bound) for r, d, bound in zip(ratio, density, bounds, strict=True)]


def _duration(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds >= 5400 else f"{seconds / 60:.1f} min" if seconds >= 90 else f"{seconds:.3g} s"


def plain(identified: IdentifiedNoise) -> dict[str, Any]:
    """Identified noise as plain JSON values; null where the log does not show it."""
    report: dict[str, Any] = {"imu": identified.topic, **noise.plain(identified.noise)}
    report["at_most"] = {f"{sensor}_density": axes for sensor, axes in identified.at_most.items()}
    report["samples"] = {f"{sensor}_density": axes.tolist() for sensor, axes in identified.samples.items()}
    for name, source in (("at_rest", identified.at_rest), ("in_motion", identified.in_motion)):
        report[name] = None if source is None else _plain_source(source)
    return {**report, "remarks": list(identified.remarks)}


def _plain_source(source: CurveSource) -> dict[str, Any]:
    report: dict[str, Any] = {"how": source.how, "seconds": source.seconds}
    for sensor in SENSORS:
        curve = source.curves[sensor]
        report[sensor] = {
            **{kind: source.axes(sensor, kind) for kind in KINDS},
            **{f"{kind}_std": [slopes.std.get(kind) for slopes in source.slopes[sensor]] for kind in KINDS},
            "holds_from_s": [slopes.from_s if slopes.powers else None for slopes in source.slopes[sensor]],
            "tau_s": curve.tau_s.tolist(),
            "deviation": curve.deviation.tolist(),
        }
    return report


def rows(identified: IdentifiedNoise) -> list[tuple[str, ...]]:
    """Identified noise as rows of text for a table, the first its header."""
    table: list[tuple[str, ...]] = [("noise", "x", "y", "z", "unit", "source")]
    for name, unit in UNITS.items():
        source = identified.noise.sources.get(name, "not seen")
        table.append((name, *map(_number, getattr(identified.noise, name)), unit, source))
    motion = identified.in_motion
    for sensor in SENSORS:
        name, unit = f"{sensor}_density", UNITS[f"{sensor}_density"]
        if identified.at_rest is not None and None in getattr(identified.noise, name):
            table.append((f"{name} at most", *map(_number, identified.at_most[sensor]), unit, identified.at_rest.how))
        differences = map(_number, identified.samples[sensor])
        table.append((f"{name} of samples", *differences, unit, "differences while the samples are calm"))
        if motion is not None:
            axes = {f"{sensor}_{kind}": motion.axes(sensor, kind) for kind in ("density", "walk")}
            table += [(f"{n} in motion", *map(_number, v), UNITS[n], motion.how) for n, v in axes.items() if v != UNKNOWN]
    return table


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.2e}"
