"""The effects there are: all that act on a sensor, or those a person names; and all that can be simulated."""

from __future__ import annotations

from collections.abc import Sequence

from imutool import registry
from imutool.errors import ConfigError
from imutool.sensor.effect import Effect
from imutool.sensor.linear_effect import LinearEffect
from imutool.units import Sensor

GROUP = "imutool.effects"


def known(sensor: Sensor) -> tuple[LinearEffect, ...]:
    """Every effect with a closed form that acts on a sensor, by name."""
    modules = registry.every(GROUP).values()
    return tuple(module.effect(sensor) for module in modules if sensor in getattr(module, "SENSORS", ()))


def named(sensor: Sensor, names: Sequence[str]) -> tuple[LinearEffect, ...]:
    """Some effects on a sensor, in the order of their names.

    Raises:
        ConfigError: an unknown name (the nearest is given), one that acts on the other sensor alone, or one given twice.
    """
    where, found = f"effects of the {sensor}", []
    for name in names:
        module = registry.load(GROUP, name)
        if sensor not in getattr(module, "SENSORS", ()):
            listed = ", ".join(effect.name for effect in known(sensor))
            raise ConfigError(f"{name} does not act on the {sensor}", where=where, expected=f"some of {listed}")
        found.append(module.effect(sensor))
    if len(set(names)) < len(names):
        raise ConfigError(f"{', '.join(names)}: one stands there twice", where=where, expected="each at most once")
    return tuple(found)


def physics(names: Sequence[str] | None = None) -> tuple[Effect, ...]:
    """Every effect that can be simulated, by name; or some, in the order of their names.

    Raises:
        ConfigError: an unknown name (the nearest is given), or that of an effect that is fitted alone and not simulated.
    """
    modules = list(registry.every(GROUP).values()) if names is None else [registry.load(GROUP, name) for name in names]
    found = tuple(module.EFFECT for module in modules if hasattr(module, "EFFECT"))
    if names is not None and len(found) < len(names):
        lacking = next(name for name, module in zip(names, modules, strict=True) if not hasattr(module, "EFFECT"))
        listed = ", ".join(one.name for one in physics())
        raise ConfigError(f"{lacking} cannot be simulated", where="effects", expected=f"some of {listed}")
    return found
