"""Calibration: effects that the training logs support, fitted by linear least squares.

Effects (`imutool.sensor.effects`) are shared by all logs; rest bias and tilt are each log's own.
Forward selection: an effect is chosen by how well the other logs predict each log's long windows
(`imutool.training.normal_equations`), and refused where most logs do not agree or chance explains it. A parameter that the
motion does not show stays at its prior, and is named.

`hybrid` is trained in this order: effects are chosen on the training part and fitted to whole logs, then the neural ODE is
trained on recordings corrected for them. The model keeps the ODE if it lowers the held-out error of either sensor by
`LEAST_ODE_GAIN`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
import torch
from jaxtyping import Float
from scipy.stats import chi2
from torch import Tensor

from imutool.bias import neural_ode
from imutool.bias.hybrid import Config
from imutool.bias.networks import hybrid
from imutool.bias.networks import neural_ode as ode_network
from imutool.bias.networks.network import BiasNetwork
from imutool.config import build, plain
from imutool.errors import ConfigError
from imutool.recording import Imu, Recording, seconds
from imutool.sensor import catalogue, physics_file
from imutool.sensor.linear_form import LinearForm
from imutool.sensor.signals import SignalFilter, Signals
from imutool.training.closed_form import CORRELATED, widest
from imutool.training.fit import Epoch, note
from imutool.training.normal_equations import Problem, Seen, linearise
from imutool.training.segments import Part, Pool
from imutool.training.settings import TrainSettings
from imutool.units import SENSORS, Sensor

BY_CHANCE = 0.01  # probability of finding any effect where there is none
REPEATED = 3.0  # windows that hold a sample's noise, from Wald's statistic of made-up logs without effects
LEAST_GAIN = 0.03  # of the judged loss, for an effect to be worth its parameters
FOLDS = 3  # parts of a log where there are fewer logs than this
LEAST_ODE_GAIN = 0.03  # of the held-out error, for an ODE to be worth its weights
UNSEEN = 0.9  # of its prior's width: a parameter no narrower was not seen


@dataclass(frozen=True)
class Calibration:
    """Chosen effects, their parameters in order, and the covariance of these.

    gains: share of the loss that each effect took off logs that had no part in its fit, in the order of choice.
    """

    effects: tuple[str, ...]
    theta: Float[Tensor, " p"]
    covariance: Float[Tensor, "p p"]
    rest: Float[Tensor, "logs 3"]
    gains: Mapping[str, float]
    unseen: tuple[str, ...]
    forms: tuple[LinearForm, ...]  # candidates
    problem: Problem  # of all candidates, on the part that they were chosen on
    named: bool  # by the settings


def signals_of(pool: Pool) -> Signals:
    """Signals of all logs, end to end; filters start at each log's first sample in the pool."""
    parts = []
    for log in range(len(pool.names)):
        rows = pool.log == log
        t, gyro, accel = (x[rows].cpu().double().numpy() for x in (pool.t, pool.gyro, pool.accel))
        parts.append(SignalFilter(pool.rate_hz)(t, gyro, accel))
    return Signals(np.concatenate([part.t_s for part in parts]), np.concatenate([part.columns for part in parts]))


def calibrate(
    pool: Pool,
    sensor: Sensor,
    gyro: Float[Tensor, "n 3"],
    names: Sequence[str] | None = None,
    part: Part = "train",
    signals: Signals | None = None,
    own_prior: Float[Tensor, " o"] | None = None,
) -> Calibration:
    """Fit the effects that the logs support, or those named.

    `gyro` is the debiased rate that carries the attitude under the accelerometer, and the gyro's own samples for the gyro.
    `signals` are those of every sample where the logs begin before the pool does, `own_prior` that of each log's nuisances
    where it is known. Parts of a log do not show how logs differ, and keep the widest.

    Raises:
        DataError: a log without a stretch of truth that is free of gaps.
        ConfigError: a name that no effect on the sensor has.
    """
    effects = catalogue.trained(sensor, names)
    seen = Seen(folded(pool, part), sensor, signals_of(pool) if signals is None else signals, gyro)
    if own_prior is None and len(pool.names) < FOLDS:
        own_prior = widest(sensor, pool.t)
    every, gains = linearise(seen, effects, part, own_prior), {}
    forms, problem = effects, every
    if names is None:
        gains = effects_beyond_chance(problem, effects)
        if len(gains) < len(effects):
            effects = tuple(effect for effect in effects if effect.name in gains)
            problem = linearise(seen, effects, part, every.own_prior)
    theta, covariance = problem.solve(range(len(problem.theta)))
    rest = problem.own_at(theta)[:, :3]
    return Calibration(
        tuple(effect.name for effect in effects),
        theta,
        covariance,
        rest.reshape(len(pool.names), -1, 3).mean(1),
        gains,
        _unseen(effects, problem, covariance),
        forms,
        every,
        names is not None,
    )


def folded(pool: Pool, part: Part) -> Pool:
    """Pool with each log cut in equal folds where there are too few logs."""
    if len(pool.names) >= FOLDS:
        return pool
    counts = torch.ones_like(pool.held_out) if part == "all" else pool.held_out == (part == "held_out")
    length = torch.bincount(pool.log, weights=counts.to(pool.t)).long()
    before = torch.cumsum(length, 0) - length
    index = (torch.cumsum(counts, 0) - 1 - before[pool.log]).clamp(min=0)  # within the part; the others are not used
    log = pool.log * FOLDS + (index * FOLDS // length.clamp(min=1)[pool.log]).clamp(max=FOLDS - 1)
    names = tuple(f"{n} {k + 1}/{FOLDS}" for n in pool.names for k in range(FOLDS))
    return replace(pool, names=names, log=log, floors=pool.floors.repeat_interleave(FOLDS, dim=0))


def parameter_columns(effects: Sequence[LinearForm], names: Sequence[str]) -> list[int]:
    """Columns of the parameters of some effects."""
    of = [effect.name for effect in effects for _ in effect.parameters]
    return [k for k, name in enumerate(of) if name in names]


def effects_beyond_chance(problem: Problem, effects: Sequence[LinearForm]) -> dict[str, float]:
    """Forward selection, by the gain on other logs; stops where the best gain is small."""
    gains: dict[str, float] = {}
    loss = problem.predicted([])
    while True:
        left = [effect.name for effect in effects if effect.name not in gains]
        tried = {name: problem.predicted(parameter_columns(effects, [*gains, name])) for name in left}
        helped = {name: new for name, new in tried.items() if bool((new < loss).sum() > 0.5 * len(loss))}
        agreed = {name: new for name, new in helped.items() if _beyond_chance(problem, effects, [*gains, name])}
        if not agreed:
            return gains
        best = min(agreed, key=lambda name: float(agreed[name].sum()))
        gain = 1 - float(agreed[best].sum() / loss.sum())
        if gain < LEAST_GAIN:
            return gains
        gains[best], loss = gain, agreed[best]


def _beyond_chance(problem: Problem, effects: Sequence[LinearForm], names: Sequence[str]) -> bool:
    """Wald's test of the last effect's parameters, corrected for the number of candidates.

    Where nothing is planted, theta.covariance^-1.theta has the expectation tr(1 - prior covariance), the number of parameters
    that the motion shows: these are its degrees of freedom. The test keeps out effects without evidence; the loss of other logs
    decides which come in.
    """
    columns = parameter_columns(effects, names)
    theta, covariance = problem.solve(columns)
    own = [k for k, column in enumerate(columns) if column in parameter_columns(effects, names[-1:])]
    last, block = theta[columns][own], covariance[own][:, own]
    wald = CORRELATED / REPEATED * float(last @ torch.linalg.solve(block, last))
    shown = float((1 - block.diagonal() * problem.prior[columns][own]).sum())
    return wald > float(chi2.isf(BY_CHANCE / len(effects), max(shown, 1.0)))


def _unseen(effects: Sequence[LinearForm], problem: Problem, covariance: Float[Tensor, "p p"]) -> tuple[str, ...]:
    """Parameters whose standard deviation is that of their prior: the motion does not show them."""
    names = [f"{effect.name}.{parameter.name}" for effect in effects for parameter in effect.parameters]
    share = (covariance.diagonal() * problem.prior).sqrt()
    return tuple(name for name, s in zip(names, share, strict=True) if float(s) > UNSEEN)


@dataclass(frozen=True)
class PhysicsFirst:
    """Hybrid model with fitted effects, and the recordings corrected for them."""

    model: hybrid.Network
    fits: dict[Sensor, Calibration]
    recordings: list[Recording]

    @classmethod
    def of(
        cls, recordings: Sequence[Recording], settings: TrainSettings, device: str, report: Callable[[Epoch], None]
    ) -> PhysicsFirst:
        """Fit the effects of the gyro, then of the accelerometer.

        Raises:
            DataError: no truth, too little of it, or different rates.
            ConfigError: unknown settings, or an effect that is not known.
        """
        pool = Pool.of(recordings, device=device, floors=settings.pose_floors)
        torch.manual_seed(settings.seed)
        model = hybrid.Network(config_of(settings), pool.rate_hz).double()
        signals, fits = _online_signals(recordings, pool), {}
        gyro = pool.gyro
        for sensor in SENSORS:
            report(note(f"looking for effects on the {sensor}"))
            chosen = calibrate(pool, sensor, gyro, model.config.effects(sensor), "train", signals)
            whole = calibrate(pool, sensor, gyro, chosen.effects, "all", signals, chosen.problem.own_prior)
            of_choice = ("gains", "forms", "problem", "named")
            fits[sensor] = replace(whole, **{name: getattr(chosen, name) for name in of_choice})
            model.take(sensor, fits[sensor].effects, fits[sensor].theta, fits[sensor].covariance)
            if sensor == "gyro":
                error = torch.from_numpy(model.error("gyro", signals)).to(pool.gyro)
                gyro = pool.gyro - error - fits[sensor].rest[pool.log]
        return cls(model, fits, _without(model, recordings))

    def ode_settings(self, settings: TrainSettings) -> TrainSettings:
        """Settings of the ODE's own training."""
        ode: neural_ode.Config = self.model.config.ode
        return msgspec.structs.replace(settings, model=plain(ode))

    def finish(self, learnt: BiasNetwork) -> hybrid.Network:
        """Complete model with the trained ODE, or without one where a constant was enough."""
        model = self.model
        if isinstance(learnt, ode_network.Network):
            assert model.ode is not None
            model.ode.load_state_dict(learnt.state_dict())
        else:
            model.drop_remainder()
        for name, value in learnt.named_buffers(recurse=False):
            getattr(model, name).copy_(value)
        return model


def settings_for(physics: Path) -> tuple[list[str], tuple[str, ...]]:
    """Settings for `hybrid` with the effects of a physics.toml, and names that it cannot have.

    Their parameters are fitted anew to the logs. Effects that it cannot have, or without a name, are left to the neural ODE.

    Raises:
        ConfigError: the file cannot be read, or names no effect that `hybrid` can have.
    """
    names = tuple(dict.fromkeys(entry.name for entry in physics_file.read(physics).effect))
    by_sensor = {sensor: [form.name for form in catalogue.trained(sensor) if form.name in names] for sensor in SENSORS}
    taken = {name for some in by_sensor.values() for name in some}
    if not taken:
        raise ConfigError("no effect that a bias model can correct", where=physics, expected="for instance gyro_scale")
    words = [f"model.{sensor}_effects={json.dumps(some)}" for sensor, some in by_sensor.items()]
    return words, tuple(name for name in names if name not in taken)


def helps(before: dict[Sensor, float], after: dict[Sensor, float]) -> bool:
    """Whether a descent lowers one held-out error enough and does not raise the other."""
    gains = [1 - after[sensor] / before[sensor] for sensor in SENSORS]
    return max(gains) >= LEAST_ODE_GAIN and min(gains) > -LEAST_ODE_GAIN


def config_of(settings: TrainSettings) -> Config:
    """Model settings, their effects checked.

    Raises:
        ConfigError: an unknown setting or effect (the nearest is named), or an effect on the wrong sensor.
    """
    config = build(Config, settings.model, where="model settings of hybrid")
    catalogue.trained("gyro", config.gyro_effects or ())
    catalogue.trained("accel", config.accel_effects or ())
    return config


def _online_signals(recordings: Sequence[Recording], pool: Pool) -> Signals:
    """Signals of a pool's samples as online: filters and time start where the log does."""
    parts: list[Signals] = []
    for recording, count in zip(recordings, torch.bincount(pool.log).tolist(), strict=True):
        first = int(np.searchsorted(recording.imu.t_ns, recording.overlap().imu.t_ns[0]))
        parts.append(_signals(recording.imu, pool.rate_hz).rows(slice(first, first + count)))
    return Signals(np.concatenate([part.t_s for part in parts]), np.concatenate([part.columns for part in parts]))


def _signals(imu: Imu, rate_hz: float) -> Signals:
    return SignalFilter(rate_hz)(seconds(imu.t_ns, int(imu.t_ns[0])), imu.gyro, imu.accel)


def _without(model: hybrid.Network, recordings: Sequence[Recording]) -> list[Recording]:
    """Recordings corrected for the model's effects."""
    return [replace(recording, imu=_corrected(model, recording.imu)) for recording in recordings]


def _corrected(model: hybrid.Network, imu: Imu) -> Imu:
    signals = _signals(imu, model.rate_hz)
    return Imu(imu.t_ns, imu.gyro - model.error("gyro", signals), imu.accel - model.error("accel", signals))


def described(fits: dict[Sensor, Calibration]) -> Iterator[tuple[str, dict[str, object]]]:
    """Entries of a model card: effects, gains on logs left out of the fit, unseen parameters."""
    for sensor, fitted in fits.items():
        yield sensor, {"effects": list(fitted.effects), "gains": dict(fitted.gains), "unseen": list(fitted.unseen)}
