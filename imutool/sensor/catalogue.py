"""Catalogue of effects: files of `imutool/sensor/effects`, and those of other packages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from imutool import registry
from imutool.errors import ConfigError
from imutool.sensor.effect import Effect
from imutool.sensor.linear_form import LinearForm, linear_form
from imutool.units import Sensor

GROUP = "imutool.effects"


def effects(names: Sequence[str] | None = None) -> tuple[Effect, ...]:
    """Every effect, by name; or some, in the order of their names.

    Raises:
        ConfigError: an unknown name (the nearest is given).
    """
    modules = registry.every(GROUP).values() if names is None else [registry.load(GROUP, name) for name in names]
    return tuple(module.EFFECT for module in modules)


def diagnosed(names: Sequence[str] | None = None) -> tuple[Effect, ...]:
    """Every effect that a diagnosis may find, by name; or some, in the order of their names.

    Raises:
        ConfigError: an unknown name (the nearest is given), or an effect that a diagnosis does not look for.
    """
    found = effects(names)
    refused = [effect.name for effect in found if not effect.diagnosed]
    if refused and names is not None:
        listed = ", ".join(effect.name for effect in diagnosed())
        raise ConfigError(f"{refused[0]} is not diagnosed", where="effects", expected=f"some of {listed}")
    return tuple(effect for effect in found if effect.diagnosed)


def trained(sensor: Sensor, names: Sequence[str] | None = None) -> tuple[LinearForm, ...]:
    """Linear forms on a sensor of every trained effect, or of some, in the order of names.

    Raises:
        ConfigError: an unknown name (the nearest is given), an effect without a linear form on the sensor, or a name twice.
    """
    found, where = effects(names), f"effects of the {sensor}"
    chosen = [effect for effect in found if effect.trained and sensor in effect.sensors]
    if names is not None and len(chosen) < len(found):
        refused = next(effect.name for effect in found if effect not in chosen)
        listed = ", ".join(form.name for form in trained(sensor))
        raise ConfigError(f"{refused} does not act on the {sensor}", where=where, expected=f"some of {listed}")
    if names is not None and len(set(names)) < len(names):
        raise ConfigError(f"{', '.join(names)}: a name occurs twice", where=where, expected="each at most once")
    return tuple(replace(linear_form(effect, sensor), recipe=(_form, (sensor, effect.name))) for effect in chosen)


def _form(sensor: Sensor, name: str) -> LinearForm:
    return trained(sensor, [name])[0]
