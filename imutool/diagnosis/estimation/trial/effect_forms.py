"""Forms of effects that a diagnosis tries: orders, digital filters, shares, one sensor."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import replace

import numpy as np

from imutool.diagnosis.estimation.observability import LOW_PASSES, SHARED
from imutool.sensor.effect import Effect, Theta
from imutool.sensor.effects.gyro_dead_band import LOST, ZONE
from imutool.sensor.effects.gyro_hysteresis import MIN, SHARE, error_and_ideal, play
from imutool.sensor.effects.low_pass import ORDER, RATE, SMOOTHING, of_one
from imutool.sensor.effects.mount_resonance import DAMPER
from imutool.sensor.samples import IdealMotion, SensorSamples
from imutool.units import SENSORS

HIGHER = 0, 4  # orders that a diagnosis tries, in addition to the first and the second
WIDTHS = 0.3, 1.0  # of the motion's standard deviation, from where the fit of a share starts


def in_forms(found: Iterable[Effect], *, exact: bool) -> list[Effect]:
    """Effects in the forms that a diagnosis tries; an `exact` simulation shows more."""
    for forms in (_of_low_pass, _of_hysteresis, _of_dead_band, _of_resonance):
        found = [form for effect in found for form in forms(effect, exact=exact)]
    return [*found]


def low_pass_with(effect: Effect, names: Collection[str]) -> Effect:
    """A low-pass in the form with parameters of these names: digital, smoothing, or as it is."""
    if RATE.name in names:
        return digital(effect)
    return exponential(effect) if SMOOTHING.name in names else effect


def digital(of_analog: Effect) -> Effect:
    """The low-pass with the rate of a digital one."""
    return replace(of_analog, parameters=(*of_analog.parameters, RATE))


def exponential(of_analog: Effect) -> Effect:
    """The low-pass as exponential smoothing with its rate; of second order it smooths twice."""
    lagless, twice = of_analog.lagless, of_analog.name == LOW_PASSES[1]
    assert lagless is not None, "a low-pass has a lag"
    text = "y += (1 - exp(-2 pi f_c / smoothing_rate)) (x - y) at each sample x, y read in its place"
    poles = "y[k] = (p + q) y[k-1] - p q y[k-2] + (1 - p) (1 - q) x[k] at each sample k, read in its place, "
    poles += "p, q = exp(-2 pi f_c (zeta +- sqrt(zeta^2 - 1)) / smoothing_rate)"

    def full(theta: Theta) -> Theta:
        return np.array([*theta[:-1], RATE.null_value, *([] if twice else [ORDER.null_value]), theta[-1]])

    return replace(
        of_analog,
        equation=poles if twice else text,
        parameters=(*of_analog.parameters, SMOOTHING),
        forward=lambda motion, theta: of_analog.forward(motion, full(theta)),
        lagless=lambda motion, theta: lagless(motion, full(theta)),
    )


def _of_low_pass(effect: Effect, *, exact: bool) -> list[Effect]:
    """Forms of a low-pass: of each sensor, and with `exact` (a simulation) of another order."""
    if effect.lagless is None:
        return [effect]
    both, first_order = analog(effect), ORDER in effect.parameters
    each = [both, *(of_one(both, sensor) for sensor in SENSORS)]
    return [*each, *(of_order(form, order) for form in each for order in HIGHER if exact and first_order)]


def analog(effect: Effect) -> Effect:
    """A low-pass without the rate of a digital one, of its lowest order."""
    return _of_first(effect, sum(parameter not in (RATE, ORDER, SMOOTHING) for parameter in effect.parameters))


def _of_first(effect: Effect, count: int) -> Effect:
    """An effect of its first parameters alone; the others do nothing."""
    starts = effect.starts
    assert starts is not None, f"{effect.key} has starts"
    kept = effect.parameters[:count]
    return replace(effect, parameters=kept, starts=lambda motion, at: [theta[:count] for theta in starts(motion, at)])


def of_order(first: Effect, order: float) -> Effect:
    """An analog low-pass of another order."""
    lagless = first.lagless
    assert lagless is not None, "a low-pass has a lag"

    def full(theta: Theta) -> Theta:
        return np.array([theta[0], theta[1] if len(theta) > 1 else math.inf, order])

    return replace(
        first,
        variant=f"{first.variant} order {order:g}".strip(),
        constants=((ORDER, float(order)),),
        forward=lambda motion, theta: first.forward(motion, full(theta)),
        lagless=lambda motion, theta: lagless(motion, full(theta)),
    )


def _of_hysteresis(effect: Effect, *, exact: bool) -> list[Effect]:
    """A hysteresis of the whole reading, and with `exact` one of a share; another effect itself."""
    if SHARE not in effect.parameters:
        return [effect]
    (sensor,) = effect.sensors

    def of_share(motion: IdealMotion, samples: SensorSamples) -> list[Theta]:
        """Widths of the size of the motion, and the share that each explains best."""
        error, ideal = error_and_ideal("gyro" if sensor == "gyro" else "accel", motion, samples)
        widths = [factor * float(np.sqrt(ideal.var(axis=0).mean())) for factor in WIDTHS]
        behind = [play(ideal, width) - ideal for width in widths]
        lags = [(lag - lag.mean(axis=0)) for lag in behind]
        return [
            np.array([max(width, MIN * effect.plausible[0]), (error * lag).sum() / max((lag**2).sum(), 1e-300)])
            for width, lag in zip(widths, lags, strict=True)
        ]

    of_part = f"share of h(t) and the rest of the ideal reading, h as {effect.equation}"
    return [_of_first(effect, 1), *([replace(effect, variant=SHARED, equation=of_part, starts=of_share)] if exact else [])]


def _of_dead_band(effect: Effect, *, exact: bool) -> list[Effect]:
    """A dead band whose faster readings are whole, and with `exact` a dead zone; another effect itself."""
    if LOST not in effect.parameters:
        return [effect]
    starts = effect.starts
    assert starts is not None, "a dead band has starts"
    text = "gyro = omega where |omega| > width, else 0, on every axis"
    whole = replace(
        effect, equation=text, parameters=effect.parameters[:1], starts=lambda motion, at: [starts(motion, at)[0][:1]]
    )
    zone = replace(
        effect,
        equation="gyro = omega - width sign(omega) where |omega| > width, else 0, on every axis",
        variant=ZONE,
        constants=((LOST, LOST.plausible),),
        parameters=effect.parameters[:1],
        starts=lambda motion, at: [starts(motion, at)[1][:1]],
        forward=lambda samples, theta: effect.forward(samples, np.append(theta, LOST.plausible)),
        jumps=False,
    )
    return [whole, zone] if exact else [whole]


def _of_resonance(effect: Effect, *, exact: bool) -> list[Effect]:
    """A resonance with its damper on the base, and with `exact` at rest; another effect itself."""
    if DAMPER not in effect.parameters:
        return [effect]
    on_base = _of_first(effect, len(effect.parameters) - 1)
    at_rest = replace(
        on_base,
        variant="damper at rest",
        constants=((DAMPER, 0.0),),
        forward=lambda motion, theta: effect.forward(motion, np.append(theta, 0.0)),
    )
    return [on_base, at_rest] if exact else [on_base]
