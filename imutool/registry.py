"""Finds converters, bias models and effects: one file each, its name the key, or an entry point of another package."""

from __future__ import annotations

import ast
import difflib
import importlib
import importlib.util
import pkgutil
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

from imutool.errors import ConfigError

GROUPS = {
    "imutool.converters": "converters",
    "imutool.bias": "imutool.bias",
    "imutool.effects": "imutool.physics.effects",
    "imutool.clean": "imutool.clean.rules",
}


def names(group: str) -> list[str]:
    """The keys of a group, sorted, without importing any of them (so listing the bias models costs no torch)."""
    spec = importlib.util.find_spec(GROUPS[group])
    places = list(spec.submodule_search_locations or ()) if spec else []
    own = {module.name for module in pkgutil.iter_modules(places) if not module.name.startswith("_")}
    return sorted(own | {point.name for point in entry_points(group=group)})


def load(group: str, name: str) -> ModuleType:
    """The module behind a key.

    Raises:
        ConfigError: no such key; the message names the nearest.
    """
    known = names(group)
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        raise ConfigError(
            f"{name!r} is not known",
            where=group.removeprefix("imutool."),
            expected=f"one of {', '.join(known)}",
            fix=f"Did you mean {near[0]!r}?" if near else "",
        )
    for point in entry_points(group=group):
        if point.name == name:
            module = point.load()
            assert isinstance(module, ModuleType), f"entry point {group}:{name} must name a module"
            return module
    return importlib.import_module(f"{GROUPS[group]}.{name}")


def summary(group: str, name: str) -> str:
    """The first line of a module's docstring, read from its source so that it is not imported; empty where there is none."""
    outside = {point.name: point.module for point in entry_points(group=group)}
    try:
        spec = importlib.util.find_spec(outside.get(name, f"{GROUPS[group]}.{name}"))
    except ModuleNotFoundError:
        return ""
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return ""
    doc = ast.get_docstring(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))) or ""
    return doc.partition("\n")[0]
