"""Calibration: effects that the training logs support, fitted by linear least squares.

Effects (`imutool.sensor.effects`) are shared by all logs; rest bias and tilt are each log's own.
Scale and misalignment need no evidence: their prior (`SensorPrior`) shrinks them as far as the motion does not show them.
Forward selection of the others: an effect is chosen by how well the other logs predict each log's long windows
(`imutool.training.calibration.normal_equations`), and refused where most logs do not agree or chance explains it.
A parameter that the motion does not show stays at its prior, and is named.

`hybrid` chooses effects on the training part, fits them to whole logs, and trains the neural ODE on what they leave.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import msgspec
import torch
from scipy.special import chdtri
from torch import Tensor

from imutool.array_types import Float
from imutool.bias import neural_ode, temperature
from imutool.bias.hybrid import Config
from imutool.bias.networks import hybrid
from imutool.bias.networks import neural_ode as ode_network
from imutool.bias.networks.network import BiasNetwork
from imutool.bias.networks.temperature import log_signals, temperature_scale, temperature_tensors
from imutool.config import build, plain
from imutool.recording import Imu, Recording
from imutool.sensor import catalogue
from imutool.sensor.linear_form import LinearForm
from imutool.sensor.signals import Load, Signals
from imutool.training.calibration.log_scatter import MIN_GAIN, widest
from imutool.training.calibration.normal_equations import FOLDS, Seen, Terms, folded, linearise
from imutool.training.calibration.shared_parameters import Problem, gain_of
from imutool.training.fit import Epoch, note
from imutool.training.log_signals import effects_turned_alike, loaded_signals, signals_of
from imutool.training.settings import LINEAR, SensorPrior, TrainSettings
from imutool.training.training_windows import Part, Pool
from imutool.units import SENSORS, Sensor

BY_CHANCE = 0.01  # probability of finding any effect where there is none
DRIFTS = dict.fromkeys(("gyro_warm_up", "gyro_rate_load", "gyro_force_load", *temperature.EFFECTS), 0.3)  # they look alike
CONTAINED = {"rate_curve": "gyro_scale"}  # a curve imitates a scale, which then needs evidence as any other effect
UNSEEN = 0.9  # of its prior's width: a parameter no narrower was not seen


@dataclass(frozen=True)
class Calibration:
    """Chosen effects, their parameters in order, and the covariance of these."""

    effects: tuple[str, ...]
    theta: Float[Tensor, " p"]
    covariance: Float[Tensor, "p p"]
    own: Float[Tensor, "logs o"]
    gains: Mapping[str, float]  # share of the loss that each took off logs without a part in its fit, in the order of choice
    unseen: tuple[str, ...]
    forms: tuple[LinearForm, ...]  # candidates
    problem: Problem  # of all candidates, on the part that they were chosen on
    named: bool  # by the settings


def calibrate(
    pool: Pool,
    sensor: Sensor,
    gyro: Float[Tensor, "n 3"],
    names: Sequence[str] | None = None,
    part: Part = "train",
    signals: Signals | None = None,
    own_prior: Float[Tensor, " o"] | None = None,
    sensors: SensorPrior | None = None,
) -> Calibration:
    """Fit the effects that the logs support, or those named.

    `gyro` is the debiased rate that carries the attitude under the accelerometer, and the gyro's own samples for the gyro.
    `signals` are those of every sample where the logs begin before the pool does, `own_prior` that of each log's nuisances
    where it is known. Few logs are cut in folds to choose effects on the training part; folds do not show how logs differ, and
    keep the widest.

    Raises:
        DataError: a log without a stretch of truth that is free of gaps.
        ConfigError: a name that no effect on the sensor has.
    """
    if names is None:
        also = () if signals is None or signals.temperature is None else (temperature.FORMS[sensor],)
        several = len(pool.names) > 1  # one log does not show whether a clock is the sensor's or that of its poses
        effects = tuple(form for form in catalogue.trained(sensor) + also if several or form.name != "clock_offset")
    else:
        effects = temperature.forms(sensor, names)
    cut = folded(pool) if part == "train" else pool
    signals = signals_of(pool) if signals is None else signals
    seen, terms = Seen(cut, sensor, gyro), partial(Terms.of, signals=signals, sensors=sensors or SensorPrior(), pool=cut)
    if own_prior is None and len(pool.names) < FOLDS:
        own_prior = widest(sensor, pool.t)
    every, gains = linearise(seen, terms(effects), part, own_prior), {}
    if names is None:
        gains = effects_beyond_chance(every, effects)
        if not DRIFTS.keys() & gains.keys() and any(effect.name in DRIFTS for effect in effects):
            # the point of linearisation has all candidates: without a drift it is as if there were none to choose
            effects = tuple(effect for effect in effects if effect.name not in DRIFTS)
            every = linearise(seen, terms(effects), part, own_prior)
            gains = effects_beyond_chance(every, effects)
    forms, problem = effects, every
    if names is None and len(gains) < len(effects):
        effects = tuple(effect for effect in effects if effect.name in gains)
        problem = linearise(seen, terms(effects), part, every.own_prior)
    theta, covariance = problem.solve_by_scatter(range(len(problem.theta)))
    own = problem.own_at(theta)
    return Calibration(
        tuple(effect.name for effect in effects),
        theta,
        covariance,
        own.reshape(len(pool.names), -1, own.shape[1]).mean(1),
        gains,
        _unseen(effects, problem, covariance),
        forms,
        every,
        names is not None,
    )


def parameter_columns(effects: Sequence[LinearForm], names: Sequence[str]) -> list[int]:
    """Columns of the parameters of some effects."""
    chosen = [effect.name in names for effect in effects for _ in effect.parameters]
    return [k for k, among in enumerate(chosen) if among]


def effects_beyond_chance(problem: Problem, effects: Sequence[LinearForm]) -> dict[str, float]:
    """Forward selection, by the gain on other logs; then scale and misalignment join.

    It stops where the best gain is small. A curve imitates a scale, and where logs turn one way only nothing tells them apart:
    then only a scale with evidence of its own joins.
    """
    gains: dict[str, float] = {}
    loss = problem.predicted([])
    while True:
        rejected = [effect.name for effect in effects if effect.name not in gains]
        tried = {name: problem.predicted(parameter_columns(effects, [*gains, name])) for name in rejected}
        enough = {name: new for name, new in tried.items() if gain_of(new, loss) >= DRIFTS.get(name, MIN_GAIN)}
        helped = {name: new for name, new in enough.items() if bool((new < loss).sum() > 0.5 * len(loss))}
        agreed = {name: new for name, new in helped.items() if _beyond_chance(problem, effects, [*gains, name])}
        best = max(agreed, key=lambda name: gain_of(agreed[name], loss), default="")
        if not best:
            break
        gains[best], loss = gain_of(agreed[best], loss), agreed[best]
    imitated = {CONTAINED[name] for name in gains if name in CONTAINED}
    for name in (form.name for form in effects if form.name in LINEAR[form.sensor] and form.name not in {*gains, *imitated}):
        new = problem.predicted(parameter_columns(effects, [*gains, name]))
        gains[name], loss = gain_of(new, loss), new
    return _likelier_drifts(problem, effects, gains)


def _likelier_drifts(problem: Problem, effects: Sequence[LinearForm], gains: Mapping[str, float]) -> dict[str, float]:
    """Gains with each drift in the place of one that predicts other logs worse, now that all other effects are known.

    Time and motion stand in for a temperature: one that the logs record takes their place unless it predicts worse.
    """
    chosen = dict(gains)
    for drift in [name for name in gains if name in DRIFTS]:
        kept = {name: gain for name, gain in gains.items() if name != drift}
        alone, loss = (problem.predicted(parameter_columns(effects, [*names])) for names in (kept, chosen))
        for name in (effect.name for effect in effects if effect.name in DRIFTS and effect.name not in gains):
            new = problem.predicted(parameter_columns(effects, [*kept, name]))
            minimum, maximum = (-MIN_GAIN, 0.0) if name in temperature.EFFECTS else (MIN_GAIN, 0.5 * len(loss))
            better = gain_of(new, loss) >= minimum and bool((new < loss).sum() > maximum)
            if better and gain_of(new, alone) >= DRIFTS[name] and _beyond_chance(problem, effects, [*kept, name]):
                chosen, loss = kept | {name: gain_of(new, alone)}, new
    return chosen


def _beyond_chance(problem: Problem, effects: Sequence[LinearForm], names: Sequence[str]) -> bool:
    """Wald's test of the last effect's parameters, corrected for the number of candidates.

    Where nothing is planted, theta.covariance^-1.theta has the expectation tr(1 - prior covariance), the number of parameters
    that the motion shows: these are its degrees of freedom. The test keeps out effects without evidence; the loss of other logs
    decides which come in.
    """
    columns = parameter_columns(effects, names)
    theta, covariance = problem.solve(columns)
    of_last = parameter_columns(effects, names[-1:])
    own = [k for k, column in enumerate(columns) if column in of_last]
    last, block = theta[columns][own], covariance[own][:, own]
    wald = problem.design_effect * float(last @ torch.linalg.solve(block, last))
    shown = float((1 - block.diagonal() * problem.prior[columns][own]).sum())
    return wald > float(chdtri(max(shown, 1.0), BY_CHANCE / len(effects)))


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
    scale: temperature.Scale | None
    loads: Sequence[Load | None]  # before each recording

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
        config = config_of(settings)
        scale = temperature_scale(recordings, config.temperature or "", wanted=bool(_warm(config)))
        model = hybrid.Network(msgspec.structs.replace(config, temperature=msgspec.UNSET), pool.rate_hz).double()
        signals, loads = loaded_signals(recordings, pool, scale, config.effects("gyro"), settings.sensors)
        gyro, fits = pool.gyro, {}
        model.take("accel", (), torch.zeros(0), torch.zeros(0, 0))  # until it is fitted
        for sensor in pool.sensors:
            report(note(f"looking for effects on the {sensor}"))
            chosen = calibrate(pool, sensor, gyro, config.effects(sensor), "train", signals, None, settings.sensors)
            whole = calibrate(pool, sensor, gyro, chosen.effects, "all", signals, chosen.problem.own_prior, settings.sensors)
            fits[sensor] = replace(whole, gains=chosen.gains, forms=chosen.forms, problem=chosen.problem, named=chosen.named)
            model.take(sensor, fits[sensor].effects, fits[sensor].theta, fits[sensor].covariance)
            if sensor == "gyro":
                error = torch.from_numpy(model.error("gyro", signals)).to(pool.gyro)
                gyro = pool.gyro - error - fits[sensor].own[pool.log, :3]
        if "accel" not in pool.sensors and config.effects("accel") is None:
            model.take("accel", *effects_turned_alike(fits["gyro"].effects, fits["gyro"].theta, fits["gyro"].covariance))
        if scale is not None and _warm(model.config):
            model.take_temperature(scale.channel, temperature_tensors(scale, recordings, model.temperature_theta()))
        return cls(model, fits, _corrected(model, recordings, scale, loads), scale, loads)

    def with_gyro_effects(self, recordings: Sequence[Recording], names: Sequence[str]) -> PhysicsFirst:
        """The same with some effects of the gyro alone, and recordings corrected for these."""
        fit = self.fits["gyro"]
        chosen = parameter_columns(temperature.forms("gyro", fit.effects), names)
        own = replace(fit, effects=tuple(names), theta=fit.theta[chosen], covariance=fit.covariance[chosen][:, chosen])
        self.model.take("gyro", names, own.theta, own.covariance)
        corrected = _corrected(self.model, recordings, self.scale, self.loads)
        return replace(self, fits=self.fits | {"gyro": own}, recordings=corrected)

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


def config_of(settings: TrainSettings) -> Config:
    """Model settings, their effects checked.

    Raises:
        ConfigError: an unknown setting or effect (the nearest is named), or an effect on the wrong sensor.
    """
    config = build(Config, settings.model, where="model settings of hybrid")
    for sensor in SENSORS:
        temperature.forms(sensor, config.effects(sensor) or ())
    return config


def _warm(config: Config) -> tuple[str, ...]:
    """Effects of the temperature among those of a model."""
    return tuple(name for sensor in SENSORS for name in config.effects(sensor) or () if name in temperature.EFFECTS)


def _corrected(
    model: hybrid.Network, recordings: Sequence[Recording], scale: temperature.Scale | None, loads: Sequence[Load | None]
) -> list[Recording]:
    """Recordings without what the effects add, of sensors that bore some loads before."""

    def corrected(recording: Recording, load: Load | None) -> Recording:
        imu, signals = recording.imu, log_signals(recording, model.rate_hz, scale, load)
        gyro, accel = imu.gyro - model.error("gyro", signals), imu.accel - model.error("accel", signals)
        return replace(recording, imu=Imu(imu.t_ns, gyro, accel))

    return [corrected(*pair) for pair in zip(recordings, loads, strict=True)]
