"""Candidate models of a training, from all logs or from all but one.

A candidate has the parameters, the prior of the rest bias and the statistics that its own effects give. A left-out model is one
Gauss-Newton step from the fit of all logs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from imutool.array_types import Float
from imutool.bias.hybrid import Config
from imutool.bias.model import BiasModel
from imutool.bias.networks import hybrid, static
from imutool.bias.networks.network import BiasNetwork
from imutool.bias.networks.temperature import temperature_tensors
from imutool.bias.temperature import Scale
from imutool.training.bias_spread import store_statistics, turn_on_prior
from imutool.training.calibration.effect_selection import (
    Calibration,
    effects_beyond_chance,
    parameter_columns,
)
from imutool.training.calibration.filter_settings import filter_settings
from imutool.training.calibration.log_scatter import MIN_GAIN
from imutool.training.calibration.shared_parameters import gain_of
from imutool.training.log_signals import effects_turned_alike
from imutool.training.settings import LINEAR, TrainSettings
from imutool.training.training_windows import Pool, without_motion
from imutool.units import COLUMNS, Sensor

CANDIDATES = ("constant", "linear", "effects")  # from the simplest
PARTS_GAIN = 0.3  # of the loss: false effects take up to 0.21 off parts of one log of EuRoC, FETCH's curve 0.6 and more


def known(fit: Calibration, candidate: str, sensor: Sensor) -> bool:
    """Whether a fit has the parameters of a candidate."""
    return candidate != "linear" or set(LINEAR[sensor]) <= {form.name for form in fit.forms}


def effects_of(fit: Calibration, sensor: Sensor, candidate: str) -> tuple[str, ...]:
    """Effects of a candidate from all logs."""
    return {"constant": (), "linear": LINEAR[sensor], "effects": fit.effects}[candidate]


def best_predicted(fit: Calibration, sensor: Sensor, candidates: Sequence[str]) -> str:
    """Candidate that predicts the windows of each part of a log best, from the other parts.

    Parts show one motion, so only a gain of `PARTS_GAIN` over a constant counts.
    """
    columns = {candidate: parameter_columns(fit.forms, effects_of(fit, sensor, candidate)) for candidate in candidates}
    best, *others = candidates
    constant = loss = fit.problem.predicted(columns[best])
    for candidate in others:
        new = fit.problem.predicted(columns[candidate])
        if gain_of(new, constant) >= PARTS_GAIN and gain_of(new, loss) >= MIN_GAIN:
            best, loss = candidate, new
    return best


def left_out_effects(fit: Calibration, candidate: str, sensor: Sensor, index: int) -> tuple[str, ...]:
    """Effects of a candidate; those that the other logs support are found anew without the log."""
    if candidate != "effects" or fit.named:
        return effects_of(fit, sensor, candidate)
    gains = effects_beyond_chance(fit.problem.without(index), fit.forms)
    return tuple(form.name for form in fit.forms if form.name in gains)


def with_statistics(
    fits: Mapping[Sensor, Calibration], pool: Pool, trained: BiasNetwork, candidate: str, settings: TrainSettings
) -> BiasNetwork:
    """Network with a candidate's own statistics, from what its effects leave of all logs.

    What no effect explains makes the bias at rest differ from that in motion, and a start from the truth uncertain.
    """
    names = {sensor: effects_of(fit, sensor, candidate) for sensor, fit in fits.items()}
    if all(set(names[sensor]) == set(fit.effects) for sensor, fit in fits.items()):
        return trained
    network, biases = _solved(fits, pool, names)
    rest = pool.t.new_zeros(len(pool.names), 6)
    for sensor, of_sensor in biases.items():
        rest[:, COLUMNS[sensor]] = of_sensor.reshape(len(rest), -1, 3).mean(1)
    out = static.Network().double().to(rest)
    store_statistics(out, without_motion(network, pool), rest, settings.window_s)
    return out


def left_out_model(
    fits: Mapping[Sensor, Calibration],
    pool: Pool,
    statistics: BiasNetwork,
    effects: Mapping[Sensor, Sequence[str]],
    index: int,
    scale: Scale | None,
) -> BiasModel:
    """Model of a candidate's effects, with its prior of the rest bias, from all logs but one.

    `statistics` has those of all logs, `scale` is that of the logs' temperature.
    """
    network, biases = _solved(fits, pool, effects, index)
    rest = [np.delete(of_sensor.cpu().numpy(), index, axis=0) for of_sensor in biases.values()]
    if scale is not None and network.temperature_theta():
        network.take_temperature(scale.channel, temperature_tensors(scale, [], {}))
    for name, value in statistics.named_buffers(recurse=False):
        getattr(network, name).copy_(value)
    spans = [span for span in pool.spans_ns for _ in range(len(fits["gyro"].problem.own) // len(pool.names))]
    unknown = [np.full_like(rest[0], np.nan)] * (2 - len(rest))
    turn_on = turn_on_prior(np.concatenate([*rest, *unknown], axis=1), spans[:index] + spans[index + 1 :])
    network.prior_mean.copy_(torch.from_numpy(turn_on.mean))
    network.prior_std.copy_(torch.from_numpy(turn_on.std))
    model = network.frozen()
    model.card = {"logs": [{}] * (len(spans) - 1), **turn_on.card(), **filter_settings(model, pool)}
    return model


def left_out_covariance(fit: Calibration, sensor: Sensor) -> Float[torch.Tensor, "p p"]:
    """Covariance about zero of the scale and misalignment that a constant bias leaves out.

    It is that about the solution, and the square of the solution.
    """
    columns = parameter_columns(fit.forms, LINEAR[sensor])
    theta, covariance = fit.problem.solve_by_scatter(columns)
    return covariance + torch.outer(theta[columns], theta[columns])


def simpler_effects(fits: Mapping[Sensor, Calibration], kept: Mapping[Sensor, str]) -> dict[str, tuple[str, ...]]:
    """Settings of `hybrid` with the effects of the candidates kept, where they differ."""
    effects: dict[str, tuple[str, ...]] = {}
    for sensor, fit in fits.items():
        names = effects_of(fit, sensor, kept[sensor])
        if not fit.named and set(names) != set(fit.effects):
            effects[f"{sensor}_effects"] = names
    return effects


def _solved(
    fits: Mapping[Sensor, Calibration], pool: Pool, effects: Mapping[Sensor, Sequence[str]], without: int | None = None
) -> tuple[hybrid.Network, dict[Sensor, Float[torch.Tensor, "logs 3"]]]:
    """Network with some effects from all logs but one, and each log's rest bias."""
    network, biases = hybrid.Network(Config(remainder=False), pool.rate_hz).double(), {}
    for sensor, fit in fits.items():
        columns = parameter_columns(fit.forms, effects[sensor])
        theta, covariance = fit.problem.solve_by_scatter(columns, without)
        network.take(sensor, effects[sensor], theta[columns], covariance)
        biases[sensor] = fit.problem.own_at(theta)[:, :3]
        if sensor == "gyro" and "accel" not in fits:
            network.take("accel", *effects_turned_alike(effects[sensor], theta[columns], covariance))
    return network, biases
