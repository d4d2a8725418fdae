"""Registry of converters, bias models, effects and rules: one file or entry point each."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import pkgutil
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from imutool.errors import ConfigError, did_you_mean

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUPS = {
    "imutool.converters": "imutool.converters",
    "imutool.bias": "imutool.bias",
    "imutool.networks": "imutool.bias.networks",
    "imutool.effects": "imutool.sensor.effects",
    "imutool.clean": "imutool.cleaning.rules",
}
NOT_PLUGINS = {
    "imutool.bias": frozenset(
        {"effects_stream", "model", "model_file", "networks", "neural_stream", "physics", "temperature", "log_binding"}
    ),
    "imutool.networks": frozenset({"network", "ode", "paper_ode", "perceptron", "temperature", "threads"}),
}


def names(group: str) -> list[str]:
    """Sorted keys of a group, without an import: a list of bias models needs no torch."""
    return sorted(_own(group) | _outside(group).keys())


def entry_points(*, group: str) -> Iterable[EntryPoint]:
    """Entry points of a group; most commands ask for none, and the import takes 15 ms."""
    from importlib.metadata import entry_points as installed

    return installed(group=group)


def _outside(group: str) -> Mapping[str, EntryPoint]:
    """Entry points of other packages by key."""
    return _listed(entry_points, group, tuple(sys.path))


@cache
def _listed(list_points: Callable[..., Iterable[EntryPoint]], group: str, path: tuple[str, ...]) -> Mapping[str, EntryPoint]:
    """Entry points of a group: once a process, since each listing reads a file of every installed package."""
    return {point.name: point for point in list_points(group=group)}


@cache
def _own(group: str) -> frozenset[str]:
    """Keys of the files in this package: its folders are listed once a process."""
    spec = importlib.util.find_spec(GROUPS[group])
    places = list(spec.submodule_search_locations or ()) if spec else []
    found = frozenset(module.name for module in pkgutil.iter_modules(places) if not module.name.startswith("_"))
    return found - NOT_PLUGINS.get(group, frozenset())


def load(group: str, name: str, where: str = "") -> ModuleType:
    """Module of a key; a file of this package comes first, and then no other package is asked.

    `where` is the parameter that names the key.

    Raises:
        ConfigError: no such key; the message names the nearest.
    """
    if name in _own(group):
        return importlib.import_module(f"{GROUPS[group]}.{name}")
    if name not in (points := _outside(group)):
        known = names(group)
        raise ConfigError(
            f"{name!r} is not known",
            where=where or group.removeprefix("imutool."),
            expected=f"one of {', '.join(known)}",
            fix=did_you_mean(name, known, "{!r}"),
        )
    module = points[name].load()
    assert isinstance(module, ModuleType), f"entry point {group}:{name} must name a module"
    return module


def every(group: str) -> dict[str, ModuleType]:
    """Modules of a group by key, sorted."""
    return {name: load(group, name) for name in names(group)}


def summary(group: str, name: str) -> str:
    """First line of a module's docstring, without an import; empty if there is none."""
    try:
        own = name in _own(group)
        spec = importlib.util.find_spec(f"{GROUPS[group]}.{name}" if own else _outside(group)[name].module)
    except ModuleNotFoundError:
        return ""
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return ""
    return (ast.get_docstring(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))) or "").partition("\n")[0]
