"""Aids of an IMU in a log: its barometer, and what is wrong with that.

A barometer is a `FluidPressure`, or a number that is named as a pressure or an altitude. With true poses its height must rise
as they do. Wheel odometry is that of `wheel_odometry`. The truth, an estimate and a command are never an aid.
"""

from __future__ import annotations

import logging
import re
from dataclasses import replace

import numpy as np

from imutool.array_types import Float64
from imutool.cleaning.likelihood import CLEARLY
from imutool.errors import DataError, LogError
from imutool.inertial.aids import AUTO, BAROMETER, GROUND, STOPS, WHEELS, Aids
from imutool.log_info.wheel_odometry import MAX_FACTOR, cover, find_wheels, rows_of_stretch, with_odometry
from imutool.mcap_io.codec.schemas import PRESSURE
from imutool.mcap_io.fields import numbers, numeric_fields, split
from imutool.mcap_io.log import Log
from imutool.recording import Recording, Scalars, seconds
from imutool.recording.message_log import named_kind

PRESSURE_UNITS = {"Pa": (1.5e4, 1.2e5), "hPa": (150.0, 1200.0), "kPa": (15.0, 120.0)}
SEA_PA, EXPONENT, FACTOR_M = 101_325.0, 0.190263, 44_330.8  # of the standard atmosphere, ISO 2533
HEIGHT_NAME = re.compile(r"pressure|baro|altitude|altimeter")
NO_HEIGHT = re.compile(
    r"diff|dynamic|airspeed|temp|ti?y?re|estimat|innov|bias|gps|gnss|navsat|global|setpoint|home|_id\b|count|ratio"
)

TYPES = {
    BAROMETER: "a FluidPressure, or a number that is named as a pressure or an altitude",
    WHEELS: "poses of the kind odometry, or a twist with a header",
}
ALTITUDES_M = (-500.0, 2e4)
STEP_S, LONGEST_S, LATE_S, FEWEST = 0.5, 5.0, 1.0, 20  # of heights that are compared with the true ones
FROZEN_S = 5.0
ALIKE = 0.8  # correlation of heights that are compared
SIGN = "Check its sign, and that z of the true poses is up"

logger = logging.getLogger(__name__)


def find_aids(log: Log, recording: Recording, asked: dict[str, str]) -> Aids:
    """Aids of a recording of a log, by kind and topic (`parse_aids`).

    With `auto` they are all that the log has, and one that cannot be used is left out with a warning.

    Raises:
        LogError: the log has no such aid; the message lists the topics that were looked at.
        DataError: it cannot be used: the truth itself, values of no pressure, a motion that does not show the mount.
    """
    wanted = dict.fromkeys((STOPS, BAROMETER, WHEELS), "") | asked if AUTO in asked else asked
    found = Aids({STOPS: ""} if STOPS in wanted else {})
    for kind, offered, read in ((BAROMETER, _barometers, _with_height), (WHEELS, find_wheels, with_odometry)):
        if kind not in wanted:
            continue
        names, looked_at = ([wanted[kind]], "") if wanted[kind] else offered(log, recording)
        if not names and kind in asked:
            what = f"no {kind} in this log; looked at {looked_at}"
            raise LogError(what, where=log.path, expected=TYPES[kind], fix="Name a topic, or leave this aid out")
        try:
            found = read(found, log, recording, names[0]) if names else found
        except (LogError, DataError) as error:
            if kind in asked:
                raise
            logger.warning("%s: the aid %s is left out: %s", recording.name, kind, error)
    if GROUND in wanted or found.odometry is not None:
        what = "vehicle frame of the odometry" if found.odometry else "x of the IMU is forward, levelled"
        found = replace(found, signals=found.signals | {GROUND: what})
    return found


def _with_height(found: Aids, log: Log, recording: Recording, signal: str) -> Aids:
    """Adds the height of a barometer."""
    if signal in log.topics and log.topics[signal].schema_name == PRESSURE:
        signal += ".fluid_pressure"
    topic, field = split(log, signal)
    t_ns, values = rows_of_stretch(recording.imu, *numbers(log, topic, (field,)))
    if len(t_ns) < 2:
        raise DataError(f"{signal} has {len(t_ns)} values while the IMU measures", where=recording.name, expected="two or more")
    values_m, unit = _height_m(values[:, 0], signal, "pressure" in f"{topic}.{field}".lower())
    height = Scalars(t_ns, values_m[:, None], "m")
    text = f"{unit}{_frozen(height)}{_beside_truth(height, recording, signal)}"
    words = f"{signal} ({text}){cover(recording.imu, t_ns)}"
    return replace(found, signals=found.signals | {BAROMETER: words}, height=height)


def _frozen(height: Scalars) -> str:
    """Words on a height that stands still for long."""
    changes = np.flatnonzero(np.diff(height.values[:, 0], prepend=np.nan, append=np.nan) != 0.0)
    longest_s = float(np.diff(height.t_ns[np.minimum(changes, len(height) - 1)]).max()) * 1e-9
    return f", unchanged for {longest_s:.0f} s" if longest_s > FROZEN_S else ""


def _beside_truth(height: Scalars, recording: Recording, signal: str) -> str:
    """Words on a height that is late, by the true one.

    Raises:
        DataError: it falls where the true one rises, or changes by another factor.
    """
    truth = recording.truth if recording.truths and recording.truth.has_positions else None
    if truth is None or len(truth) < FEWEST:
        return ""
    t_s, true_s = (seconds(t_ns, int(recording.imu.t_ns[0])) for t_ns in (height.t_ns, truth.t_ns))
    at_s = np.arange(max(t_s[0], true_s[0]) + LONGEST_S, min(t_s[-1], true_s[-1]) - LONGEST_S, STEP_S)
    if len(at_s) < FEWEST:
        return ""
    true = _about_line(_smooth(at_s, true_s, truth.p_wb[:, 2]))
    lags_s = np.arange(-LONGEST_S, LONGEST_S + 1e-9, STEP_S)
    each = [_about_line(_smooth(at_s + lag_s, t_s, height.values[:, 0])) for lag_s in lags_s]
    alike = np.array([float(h @ true) / max(float(np.sqrt((h @ h) * (true @ true))), np.finfo(float).tiny) for h in each])
    best = int(np.argmax(np.abs(alike)))
    if abs(alike[best]) < ALIKE:
        return ""
    factor = float(each[best] @ true) / float(true @ true)
    if alike[best] < 0.0:
        raise DataError(f"{signal} falls where the true height rises", expected="a height or pressure of the air", fix=SIGN)
    if not 1.0 / MAX_FACTOR < factor < MAX_FACTOR:
        raise DataError(f"{signal} changes by {factor:.3g} times the true height", expected="metres, or a pressure of the air")
    late_s = float(lags_s[best])
    remaining = (1.0 - alike[best] ** 2) / max(1.0 - float(alike[len(lags_s) // 2]) ** 2, np.finfo(float).tiny)
    if abs(late_s) < LATE_S or remaining > CLEARLY:
        return ""
    return f", {abs(late_s):.1f} s {'late' if late_s > 0 else 'early'} by the true height"


def _smooth(
    at_s: Float64[np.ndarray, " n"], t_s: Float64[np.ndarray, " m"], values: Float64[np.ndarray, " m"]
) -> Float64[np.ndarray, " n"]:
    """Means of values, over `STEP_S` about each time."""
    whole = np.concatenate([[0.0], np.cumsum(np.diff(t_s) * (values[1:] + values[:-1]) / 2.0)])
    ends = np.interp(np.stack([at_s - STEP_S / 2.0, at_s + STEP_S / 2.0]), t_s, whole)
    return np.asarray((ends[1] - ends[0]) / STEP_S)


def _about_line(values: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Values about the line that fits them: a barometer drifts."""
    x = np.linspace(-1.0, 1.0, len(values))
    about = values - values.mean()
    return np.asarray(about - x * float(about @ x) / float(x @ x))


def _barometers(log: Log, recording: Recording) -> tuple[list[str], str]:
    """Pressures and barometric altitudes, FluidPressure first, then by their number of messages; and what was looked at."""
    ranked, looked_at = list[tuple[bool, int, bool, str]](), list[str]()
    for topic in log.topics.values():
        named = f"{topic.name} {topic.schema_name}".lower()
        if not topic.count or topic.is_derived or not HEIGHT_NAME.search(f"{named} {_definition(log, topic.name)}"):
            continue  # the first message of no other topic is looked at
        looked_at.append(f"{topic.name} ({topic.schema_name})")
        if NO_HEIGHT.search(named) or named_kind(topic.name, "") in ("truth", "estimate"):
            continue
        try:
            fields = numeric_fields(log, topic.name, long=False)
        except LogError:
            continue
        for field in ["fluid_pressure"] if topic.schema_name == PRESSURE else fields:
            text = named if field == "data" else field
            if HEIGHT_NAME.search(text) and not NO_HEIGHT.search(text):
                ranked.append((topic.schema_name != PRESSURE, -topic.count, "pressure" not in field, f"{topic.name}.{field}"))
    return [name for *_, name in sorted(ranked)], ", ".join(looked_at) or "types and names, of which none is of a pressure"


def _definition(log: Log, name: str) -> str:
    """Text of the schema of a topic, in small letters."""
    schemas = (log.index.schemas.get(channel.schema_id) for channel in log.index.channels.values() if channel.topic == name)
    return "".join(schema.data.decode("utf-8", "replace").lower() for schema in schemas if schema)


def _height_m(values: Float64[np.ndarray, " n"], signal: str, is_pressure: bool) -> tuple[Float64[np.ndarray, " n"], str]:
    """Height above the first value, and the unit of the values."""
    minimum, maximum = float(values.min()), float(values.max())
    if not is_pressure:
        if minimum < ALTITUDES_M[0] or maximum > ALTITUDES_M[1]:
            raise DataError(f"{signal} is from {minimum:g} to {maximum:g}", expected="an altitude in m")
        return values - values[0], "m"
    for unit, (low, high) in PRESSURE_UNITS.items():
        if low <= minimum and maximum <= high:
            height = FACTOR_M * (1.0 - (values * (PRESSURE_UNITS["Pa"][0] / low) / SEA_PA) ** EXPONENT)
            return height - height[0], unit
    raise DataError(f"{signal} is from {minimum:g} to {maximum:g}", expected="the air's pressure in Pa, hPa or kPa")
