"""Where in a recording everything lives: one log at the root, several each under `run/LOG`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from imutool.viewing.model.run_data import RunData, Trace
from imutool.viewing.rerun.sdk import entity_path

Role = Literal["raw", "debiased"]
Scope = tuple[str, ...]  # the names above a tree of entities; none for the root


def scopes(logs: Sequence[RunData]) -> list[Scope]:
    """The scope of each log: the root for one, `run/NAME` for several, with a number where an earlier one has that name."""
    if len(logs) == 1:
        return [()]
    taken: list[Scope] = []
    for data in logs:
        name, number = data.name or "log", 2
        while ("run", name) in taken:
            name, number = f"{data.name or 'log'} ({number})", number + 1
        taken.append(("run", name))
    return taken


def scope_of(data: RunData, trace: Trace, scope: Scope) -> Scope:
    """The scope of a trace: its log's; of several models, each has one below it."""
    if trace.is_raw or len(data.models()) < 2:
        return scope
    return (*(scope or ("run",)), trace.name)


def role(trace: Trace) -> Role:
    """What a trace is called in an entity path."""
    return "raw" if trace.is_raw else "debiased"


def label(data: RunData, trace: Trace) -> str:
    """What a trace is called in a title: by its model's name where there are several, without the words they all begin with."""
    if trace.is_raw or len(data.models()) < 2:
        return role(trace)
    return trace.name[_shared([model.name for model in data.models()]) :] or trace.name


def _shared(names: Sequence[str]) -> int:
    """The letters of the words, each ended by a hyphen, that all names begin with."""
    shortest = min(map(len, names))
    same = next((k for k in range(shortest) if len({name[k] for name in names}) > 1), shortest)
    return names[0].rfind("-", 0, same) + 1


def path(scope: Scope, *parts: str) -> str:
    """An entity's path from the root; a part may hold any character."""
    return f"/{entity_path(*scope, *parts).removeprefix('/')}"


def of(data: RunData, trace: Trace, scope: Scope, *parts: str) -> str:
    """The path of an entity of one trace; `debiased` and `raw` stand for themselves among the parts."""
    return path(scope_of(data, trace, scope), *parts)
