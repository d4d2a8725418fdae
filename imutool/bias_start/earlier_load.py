"""Load that a sensor bore before its log began.

It counts where the bias drifts behind the load. A model learns such a drift from logs that begin with a cold sensor. A log may
begin later: the sensor has been on for an hour, or the log is a part of a longer one. The states of the drift then have a start
of their own. Here it is what the mean load of the log's first minutes would have left after a time T. The log itself tells T:
for each of some times the samples without the drift go through the filter that tracks the rest bias, and the likelihood of its
innovations weighs that time.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence

import numpy as np

from imutool.array_types import Float64, Vectors
from imutool.bias.model import BiasModel
from imutool.bias_start.bias_tracking import BiasFilter, FilteredBlock, Samples, filter_together, without_motion
from imutool.bias_start.fitness import head
from imutool.bias_start.initial_bias import bias_prior
from imutool.errors import ConfigError
from imutool.inertial.inertial_filter import STILL, FilterSettings
from imutool.inertial.innovations import Innovations, innovations
from imutool.sensor.signals import LOAD_TAU_S, LOADS, ON, Load, SignalFilter

# T: a few seconds also imitate what a model misses of a cold start; after the last the slowest state has settled
EARLIER_S = np.array([0.0, 16.0, 32.0, 64.0, 128.0, 512.0])
COLD = 0.5  # prior probability of T = 0; the others share the rest
PRIOR = np.array([COLD, *[(1.0 - COLD) / (len(EARLIER_S) - 1)] * (len(EARLIER_S) - 1)])
MIN_COLD = 0.2  # probability of T = 0, below which the start is not cold: a log that says nothing changes nothing


def with_earlier_load(model: BiasModel, batches: Iterable[Samples], first_ns: int | None = None) -> BiasModel:
    """Model whose drift begins where the log shows the sensor.

    It is the model itself if a cold start is likely enough (`MIN_COLD`), or if its earlier load is given. `batches` are
    seconds since the log's first sample, gyro and accel; as many count as for the fitness.
    """
    if not model.follows_load() or model.load_before is not None:
        return model
    samples = head(batches)
    if not len(samples[0]):
        return model
    loads = loads_after(model.rate_hz, samples)
    log_likelihood = _log_likelihood([after_load(model, load) for load in loads], samples, first_ns)
    weights = PRIOR * np.exp(log_likelihood - log_likelihood.max())
    weights /= weights.sum()
    if weights[0] >= MIN_COLD:
        return model
    return after_load(model, np.einsum("t,tkl->kl", weights, loads))


def switched_on_before(model: BiasModel, on_s: float) -> BiasModel:
    """Model of a sensor that was on for some seconds before its first sample.

    It bore no other load.

    Raises:
        ConfigError: a negative time, or no number.
    """
    if not 0.0 <= on_s < math.inf:
        raise ConfigError(f"{on_s!r}", where="on_s", expected="seconds, zero or more")
    if not model.follows_load():
        return model
    load = np.zeros((len(LOAD_TAU_S), LOADS))
    load[:, ON] = -np.expm1(-on_s / LOAD_TAU_S)
    return after_load(model, load)


def loads_after(rate_hz: float, samples: Samples) -> Float64[np.ndarray, "t 3 11"]:
    """Load after each of the times `EARLIER_S`, under the mean load of some samples.

    The mean load follows from the state z of its fastest filter: a step of z is its gain times the load without z.
    """
    z = SignalFilter(rate_hz)(*samples).load[:, 0]
    gain = -math.expm1(-1.0 / (rate_hz * LOAD_TAU_S[0]))
    mean = z.mean(axis=0) + z[-1] / (gain * len(z))
    return np.asarray(-np.expm1(-EARLIER_S[:, None] / LOAD_TAU_S)[..., None] * mean)


def after_load(model: BiasModel, load: Load | None) -> BiasModel:
    """Model of a sensor that bore a load before its first sample, or none; a copy."""
    out = copy.copy(model)
    out.load_before = load
    return out


def _log_likelihood(models: Sequence[BiasModel], samples: Samples, first_ns: int | None) -> Float64[np.ndarray, " t"]:
    """Log-likelihood, by model, of the rest bias, of the velocity and of what the gyro reads at rest."""
    prior = bias_prior(models[0], first_ns)
    without = [without_motion(model, samples, prior.mean) for model in models]
    found, out = filter_together([BiasFilter(prior, ahead=True) for _ in models], without), []
    for blocks, (t_s, rates, _) in zip(found, without, strict=True):
        in_motion = float(innovations(block.step for block in blocks).log_likelihood.sum())
        out.append(in_motion + _at_rest([block for block in blocks if block.resting], t_s, rates))
    return np.array(out)


def _at_rest(blocks: Sequence[FilteredBlock], t_s: Float64[np.ndarray, " n"], gyro: Vectors) -> float:
    """Log-likelihood of the mean rates of blocks at rest, where the gyro reads its bias."""
    missed, covariances = np.zeros((len(blocks), 3)), np.zeros((len(blocks), 3, 3))
    for k, block in enumerate(blocks):
        own, expected = gyro[np.searchsorted(t_s, block.start_s) : np.searchsorted(t_s, block.end_s)], block.step.expected
        missed[k] = own.mean(axis=0) - expected.rest_bias(True)[:3]
        noise = own.var(axis=0) / len(own) + FilterSettings().rest_rad_s ** 2
        covariances[k] = STILL @ expected.P @ STILL.T + np.diag(noise)
    return float(Innovations(missed, covariances).log_likelihood.sum())
