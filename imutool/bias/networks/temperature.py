"""Temperature of training logs: its range, its terms at each sample, the drift it made."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from imutool.array_types import Float64
from imutool.bias.temperature import Scale, channel_of, holding
from imutool.errors import ConfigError
from imutool.mcap_io.temperature import is_temperature
from imutool.recording import Recording, Scalars, seconds
from imutool.sensor.signals import TEMPERATURE_TERMS, Load, SignalFilter, Signals
from imutool.units import COLUMNS, Sensor

MIN_RANGE_K = 1.0  # over all logs: less tells nothing about a temperature
STEP_S = 10.0  # between two numbers of the drift, from which its walk is taken

logger = logging.getLogger(__name__)
Theta = Float64[np.ndarray, " p"]


def temperature_scale(recordings: Sequence[Recording], channel: str = "", *, wanted: bool = False) -> Scale | None:
    """Channel, range and mean terms of the temperature of training logs.

    None where not all have one, or where it does not vary.

    Raises:
        ConfigError: the settings name the channel, or want the drift, and there is none.
    """
    found = [channel_of(recording.scalars, recording.imu_topic, channel) for recording in recordings]
    known = [each for each in found if each is not None and channel in ("", each[0])]
    missing = ", ".join(recording.name for recording, each in zip(recordings, found, strict=True) if each not in known)
    if missing and (channel or wanted):
        fix = f"Name a channel that all logs have; {recordings[0].name} has {', '.join(recordings[0].scalars) or 'none'}"
        raise ConfigError(f"{channel or 'a temperature'} is not in {missing}", where="model.temperature", fix=fix)
    if missing:
        several = [name for name in recordings[0].scalars if is_temperature(name)]
        if known:
            logger.warning("the bias is not fitted to the temperature: these logs have none: %s", missing)
        elif len(several) > 1:
            what = f"each of {', '.join(several)} may be the IMU's, and the setting model.temperature names none"
            logger.warning("the bias is not fitted to the temperature: %s", what)
        return None
    seen = [_within(channel, recording) for (_, channel), recording in zip(known, recordings, strict=True)]
    low, high = min(float(T.min()) for T in seen), max(float(T.max()) for T in seen)
    if high - low < MIN_RANGE_K and not wanted:
        return None
    blank = Scale(known[0][0], 0.5 * (low + high), 0.5 * (high - low), np.zeros(TEMPERATURE_TERMS))
    rows = [temperature_terms(recording, blank) for recording in recordings]
    return blank._replace(mean=np.concatenate(rows).mean(axis=0))


def _within(channel: Scalars, recording: Recording) -> Float64[np.ndarray, " n"]:
    """Numbers of a channel that hold at some sample."""
    rows = holding(channel.t_ns, recording.imu.t_ns)
    return np.asarray(channel.values[rows[0] : rows[-1] + 1, 0])


def temperature_terms(recording: Recording, scale: Scale) -> Float64[np.ndarray, "n 12"]:
    """Terms of the temperature at each sample of a log that has one."""
    found = channel_of(recording.scalars, recording.imu_topic, scale.channel)
    assert found is not None, "the log has no temperature"
    return np.asarray(scale.terms(found[1])[holding(found[1].t_ns, recording.imu.t_ns)])


def log_signals(recording: Recording, rate_hz: float, scale: Scale | None, load: Load | None) -> Signals:
    """Signals of a whole log, with a load before it, and with the terms of its temperature."""
    imu = recording.imu
    found = SignalFilter(rate_hz, load=load)(seconds(imu.t_ns, int(imu.t_ns[0])), imu.gyro, imu.accel)
    return found if scale is None else Signals(found.t_s, found.columns, temperature_terms(recording, scale))


def online_signals(
    recordings: Sequence[Recording],
    counts: Sequence[int],
    rate_hz: float,
    scale: Scale | None,
    loads: Sequence[Load | None],
) -> Signals:
    """Signals of so many samples of each log from its first true pose on; filters start earlier."""
    parts: list[Signals] = []
    for recording, count, load in zip(recordings, counts, loads, strict=True):
        first = int(np.searchsorted(recording.imu.t_ns, recording.overlap().imu.t_ns[0]))
        parts.append(log_signals(recording, rate_hz, scale, load).rows(slice(first, first + count)))
    warm = None if scale is None else np.concatenate([part.temperature for part in parts if part.temperature is not None])
    return Signals(np.concatenate([part.t_s for part in parts]), np.concatenate([part.columns for part in parts]), warm)


def temperature_tensors(scale: Scale, recordings: Sequence[Recording], parameters: Mapping[Sensor, Theta]) -> dict[str, Tensor]:
    """Tensors of a scale, with the size of the drift in training and its walk in a second^1/2."""
    spread, walk = np.zeros(6), np.zeros(6)
    terms = [temperature_terms(recording, scale) for recording in recordings]
    for sensor, theta in parameters.items():
        K = theta.reshape(3, TEMPERATURE_TERMS).T
        drifts = [rows @ K for rows in terms]
        steps = [
            drift[stride:] - drift[:-stride]
            for drift, recording in zip(drifts, recordings, strict=True)
            for stride in [max(1, min(round(STEP_S / recording.imu.period_s), len(drift) - 1))]
        ]
        spread[COLUMNS[sensor]] = np.sqrt((np.concatenate(drifts) ** 2).mean(axis=0))
        walk[COLUMNS[sensor]] = np.sqrt((np.concatenate(steps) ** 2).mean(axis=0) / STEP_S)
    arrays = {"centre": [scale.centre], "units": [scale.half_range], "mean": scale.mean, "spread": spread, "walk": walk}
    return {name: torch.as_tensor(np.asarray(value)) for name, value in arrays.items()}
