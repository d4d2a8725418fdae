"""Flags for parameter names: the library's `init` is --init in errors and messages."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Mapping
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import Any

from typer import BadParameter
from typer.core import TyperGroup

from imutool.errors import ConfigError, ImutoolError
from imutool.file_location import location

# The library's name of a parameter, and this command line's where it is another.
ALIASES = {
    "bias": ("method",),
    "check": ("verify", "quick"),
    "damage": ("damaged",),
    "folder": ("folder", "target"),
    "imus": ("imu",),
    "kinds": ("kind",),
    "mapping": ("map_",),
    "memory_bytes": ("memory",),
    "models": ("model",),
    "out": ("target", "folder", "model"),
    "overrides": ("set_",),
    "page": ("report",),
    "pattern": ("robot_from",),
    "rate_hz": ("rate",),
    "real": ("reals",),
    "robots": ("robot_from",),
    "rules": ("rule",),
    "sequences": ("sequence",),
    "settings": ("set_", "config"),  # those of a file name the file
    "signals": ("signal",),
    "skip_rules": ("no_rule",),
}
# What a user types whom another command, or another tool, has taught; and what serves that purpose, if a command has it.
TAUGHT_ELSEWHERE = (
    (("--output", "--out", "-o"), ("--output", "OUT")),
    (("--report", "--html", "--page", "--png"), ("--report", "--html", "--png", "--output")),
    (("--force", "--yes", "-f", "-y"), ("--overwrite",)),
    (("--start",), ("--init",)),
    (("--topic",), ("--imu",)),
    (("--jobs", "-j"), ("--workers",)),
)
VALUES = {"imu": "TOPIC", "truth": "TOPIC", "int": "N", "int range": "N", "float range": "NUMBER", "path": "FILE"}
FOLDERS = "imutool.folder."  # begins the key in a context of whether a parameter's word ends in a slash
LIKE = 0.75  # of a misspelt option to the one that is meant, by difflib
current: ContextVar[Mapping[str, str]] = ContextVar("flags of the command that runs", default={})  # noqa: B039  never changed
QUOTED = re.compile(r"`([a-z_]+)(?:=([^`]*))?`")
PLACE = re.compile(r"([a-z_]+)(?:=(\S*))?")


def flags(command: Any) -> dict[str, str]:
    """Flags of a click command by the library's parameter names.

    The flag of an argument is its word in the usage.
    """
    own = {parameter.name: _flag(parameter) for parameter in command.params}
    flag_of = {name.rstrip("_"): flag for name, flag in own.items()}
    for name, others in ALIASES.items():
        flag = next((own[other] for other in others if other in own), None)
        if flag is not None:
            flag_of.setdefault(name, flag)
    return flag_of


def value_of(parameter: Any) -> str:
    """Word for the value of an option in a help; empty for a flag and for an argument."""
    if parameter.param_type_name == "argument" or parameter.is_flag:
        return ""
    kind = parameter.display_type(None).strip("<>").removeprefix("list[").removesuffix("]")
    own = parameter.name.strip("_").upper() if kind == "str" else kind
    return str(parameter.metavar or VALUES.get(parameter.name if kind == "str" else kind, own))


def instead_of(option: str, command: Any) -> list[str]:
    """Options of a click command that serve the purpose of one that it lacks."""
    from difflib import get_close_matches  # every command would pay for it at its start

    own = [_flag(parameter) for parameter in command.params]
    meant = [word for typed, answers in TAUGHT_ELSEWHERE if option in typed for word in answers if word in own]
    return ["OUT as a word without a flag" if word == "OUT" else word for word in meant] or get_close_matches(
        option, own, cutoff=LIKE
    )


def _flag(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return str(parameter.metavar or parameter.name.upper()).removesuffix("...")
    return str(max(parameter.opts, key=len))


def with_flags(text: str, flag_of: Mapping[str, str] | None = None) -> str:
    """Text with flags for backquoted parameters; other words stay.

    By default the flags are those of the running command.
    """
    flag_of = current.get() if flag_of is None else flag_of
    return QUOTED.sub(lambda match: _shown(match[1], match[2], flag_of) or match[0], text)


def _shown(name: str, value: str | None, flag_of: Mapping[str, str]) -> str | None:
    """Flag and value: `init=prior` is --init prior, `smooth=True` is --smooth.

    `images=False` is --no-images.
    """
    if value == "False":
        return flag_of.get(f"no_{name}")
    flag = flag_of.get(name)
    return flag if flag is None or value in {None, "True"} else f"{flag} {str(value).strip(chr(34))}"


def error_with_flags(error: ImutoolError, flag_of: Mapping[str, str], typed: Collection[str] = ()) -> ImutoolError:
    """Error with flags for parameters; what was typed stays, also if it reads like a parameter."""
    where = error.where
    if where is not None and where not in typed:
        names, colon, setting = where.partition(": ")  # of `settings: steps` the setting stays
        parts = [PLACE.fullmatch(part) for part in names.split(", ")]
        shown = [None if part is None else _shown(part[1], part[2], flag_of) for part in parts]
        if None not in shown:
            where = ", ".join(map(str, shown)) + colon + setting
    what, expected, fix = (with_flags(text, flag_of) for text in (error.what, error.expected, error.fix))
    return error.replaced(what=what, where=where, expected=expected, fix=fix)


def _of_url(text: str) -> Path:
    """File that a URL names, where only files are taken, and no stream."""
    place = location(text)
    if not isinstance(place, Path):
        raise ConfigError("is in an object store", where=text, expected="a file on this machine")
    return place


class PlainValue:
    """Conversion of texts, paths and defaults without pydantic.

    Typer's conversion serves everything else; its import of pydantic takes 0.2 s of CPU.
    """

    def __init__(self, annotation: object, otherwise: Callable[[], Any]) -> None:
        kinds: dict[object, Callable[[str], object]] = {str: str, list[str]: str, Path: Path, list[Path]: Path}
        self._kind, self._otherwise = kinds.get(annotation), otherwise

    def coerce(self, value: Any, param: Any, ctx: Any) -> Any:
        """Value of a parameter, as typer's `RuntimeParam.coerce`."""
        several = param.multiple or param.nargs == -1
        if value is None:
            return () if several else None
        if self._kind is None and value == param.default:
            return value
        words = value if isinstance(value, list | tuple) else [value]
        if "" in words and value != param.default:  # as a path it would be this folder, and as a model none
            raise BadParameter("an empty word; a variable of the shell may not be set", ctx=ctx, param=param)
        unreadable = self._kind is Path and any(Path(word).exists() and not os.access(word, os.R_OK) for word in words)
        if self._kind is None or unreadable or not all(isinstance(word, str | Path) for word in words):
            return self._otherwise().coerce(value, param=param, ctx=ctx)
        ctx.meta[f"{FOLDERS}{param.name}"] = any(str(word).endswith(("/", os.sep)) for word in words)  # a Path does not
        special = [self._kind is Path and ("://" in str(word) or word == "-") for word in words]
        found = [_of_url(word) if other else self._kind(word) for word, other in zip(words, special, strict=True)]
        return found if several else found[0]

    @staticmethod
    def into(parameter: Any) -> Any:
        """The parameter with this conversion, where typer converts values this way."""
        if getattr(parameter, "display_type", None):  # in the help: Typer's own names Python's types, also of a flag
            parameter.display_type_rich = lambda ctx: value_of(parameter)
        otherwise, described = getattr(parameter, "get_runtime_param", None), getattr(parameter, "type_descriptor", None)
        if otherwise is not None and described is not None and not isinstance(otherwise, partial):
            parameter.get_runtime_param = partial(PlainValue, described.annotation, otherwise)
        return parameter


class Group(TyperGroup):
    """Group of commands whose own options need no pydantic."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Parameters with --help; they convert texts and paths by themselves."""
        return [PlainValue.into(parameter) for parameter in super().get_params(ctx)]
