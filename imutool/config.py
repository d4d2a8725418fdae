"""Typed settings of the rooms, read from TOML and `key=value` words."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from imutool.errors import ConfigError, did_you_mean


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base class of all settings, checked by msgspec.

    Names end in their unit (`window_s`); limits stand in `Annotated[..., msgspec.Meta()]`.
    """


S = TypeVar("S", bound=Settings)
NESTED = "nested too deeply"
WORDS = {
    "int": "an integer",
    "float": "a number",
    "str": "text",
    "bool": "true or false",
    "array": "a list",
    "object": "a table",
    "null": "nothing",
}
MAX_NESTED = 32  # tables and lists in each other; ours have five
MAX_BYTES = 1 << 20  # of a TOML file: a physics.toml of twenty curves has 50 kB, and a megabyte takes a second to parse


def load(cls: type[S], path: Path | None = None, overrides: Iterable[str] = ()) -> S:
    """Settings from a TOML file; `key=value` words (dots for tables) override it.

    Raises:
        ConfigError: file unreadable or not TOML, unknown key (the nearest is named), wrong type, out of range.
    """
    return build(cls, entries(overrides, "set", {} if path is None else toml(path, "settings")), where=path)


def entries(words: Iterable[str], parameter: str, values: dict[str, Any] | None = None) -> dict[str, Any]:
    """Values with those of `key=value` words (dots for tables), given as this parameter.

    Raises:
        ConfigError: a word sets nothing.
    """
    values = {} if values is None else values
    for word in words:
        _put(values, word, parameter)
    return values


def toml(path: Path, what: str) -> dict[str, Any]:
    """Values in a TOML file of settings, noise or physics; `what` names it in errors.

    Raises:
        ConfigError: file unreadable, not TOML, larger than a megabyte or nested without end.
    """
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
        if len(raw) > MAX_BYTES:
            raise ConfigError(
                f"{what} cannot be read (more than {MAX_BYTES} bytes)",
                where=path,
                expected=f"a TOML file of at most {MAX_BYTES} bytes",
                fix="Check the name of the file",
            )
        values = tomllib.loads(raw.decode())
    except OSError as error:
        raise ConfigError(f"{what} cannot be read ({error.strerror})", where=path, expected="a TOML file") from error
    except ValueError as error:  # no UTF-8, no TOML, or an integer of thousands of digits
        reason = "an integer has thousands of digits" if "integer string conversion" in str(error) else error
        raise ConfigError(f"{what} cannot be read ({reason})", where=path, expected="a TOML file") from error
    except RecursionError as error:
        raise ConfigError(f"{what} cannot be read ({NESTED})", where=path, expected="a TOML file") from error
    _refuse_nested(values, path, what)
    return values


def _refuse_nested(values: dict[str, Any], where: str | Path | None, what: str) -> None:
    """Refuse tables and lists deeper than any setting, which later steps could not walk through."""
    level: list[Any] = [values]
    for _ in range(MAX_NESTED):
        inner = [list(value.values()) if isinstance(value, dict) else value for value in level]
        level = [value for items in inner for value in items if isinstance(value, dict | list)]
        if not level:
            return
    raise ConfigError(f"{what} cannot be read ({NESTED})", where=where, expected=f"at most {MAX_NESTED} tables in each other")


def build(cls: type[S], values: dict[str, Any], where: str | Path | None = None) -> S:
    """Settings from plain values, as in TOML or in a model file's header.

    Raises:
        ConfigError: unknown key (the nearest is named), wrong type, out of range, not finite.
    """
    _refuse_nested(values, where or "settings", "settings")
    _refuse_unknown(cls, values, where)
    _refuse_infinite(values, where)
    try:
        return msgspec.convert(values, cls)
    except msgspec.ValidationError as error:
        raise _of_value(str(error), where, values) from error


def _of_value(reason: str, where: str | Path | None, values: Any) -> ConfigError:
    """Error of msgspec in our words: the setting, what it is in these values, and what was expected."""
    what, _, place = reason.rstrip(".").removesuffix(" - at `$`").partition(" - at `$.")
    place = place.rstrip("`")
    expected, got = "", ""
    if what.startswith("Expected "):
        expected, _, got = what.removeprefix("Expected ").partition(", got ")
        what = f"has {got} items" if got.isdigit() else f"is {_at(place, values)}{got or 'out of range'}"
    what, expected = (re.sub(r"`([\w |]+)`", _in_words, text) for text in (what, expected))
    return ConfigError(what, where=f"{where or 'settings'}{': ' * bool(place)}{place}", expected=expected)


def _at(place: str, values: Any) -> str:
    """Value at a place of msgspec, with a comma; nothing where the place hides a key, or is all values."""
    if not place or "[...]" in place:
        return ""
    for key, index in re.findall(r"([^.\[\]]+)|\[(\d+)\]", place):
        values = values[int(index) if index else key]
    return f"{values!r:.60}, "


def _in_words(types: re.Match[str]) -> str:
    return " or ".join(WORDS.get(name, f"`{name}`") for name in types[1].split(" | "))


def plain(settings: Settings) -> dict[str, Any]:
    """Settings as plain values, the inverse of `build`."""
    values = msgspec.to_builtins(settings)
    assert isinstance(values, dict)
    return values


def _put(values: dict[str, Any], word: str, parameter: str) -> None:
    """Put a `a.b=value` word into nested tables; the value is TOML, or else a string."""
    key, equals, text = word.partition("=")
    if not equals or not key:
        raise ConfigError(f"{word!r} sets nothing", where=parameter, expected="key=value")
    try:
        (value,) = tomllib.loads(f"value = {text}").values()
    except (ValueError, RecursionError):  # no TOML, more than one line of it, or nested too deeply to be any setting's
        value = text
    *tables, last = key.split(".")
    if len(tables) > MAX_NESTED:
        raise ConfigError(f"the key has {len(tables)} dots", where=parameter, expected="the name of a setting")
    for table in tables:
        values = values.setdefault(table, {})
        if not isinstance(values, dict):
            raise ConfigError(f"{table!r} is a value, not a table", where=f"{parameter}={word}")
    values[last] = value


def _refuse_unknown(cls: type[Settings], values: dict[str, Any], where: str | Path | None, prefix: str = "") -> None:
    """Refuse unknown keys at any depth, and name the nearest known key."""
    fields = {field.encode_name: field.type for field in msgspec.structs.fields(cls)}
    for key, value in values.items():
        if key not in fields:
            raise ConfigError(
                f"{prefix}{key} is not a setting",
                where=where or "settings",
                expected=f"one of {', '.join(sorted(fields))}",
                fix=did_you_mean(key, fields, f"{prefix}{{}}"),
            )
        inner = fields[key]
        if isinstance(value, dict) and isinstance(inner, type) and issubclass(inner, Settings):
            _refuse_unknown(inner, value, where, f"{prefix}{key}.")


def _refuse_infinite(value: Any, where: str | Path | None, place: str = "") -> None:
    """Refuse infinite and NaN values, which TOML can hold."""
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{place} is {value}", where=where or "settings", expected="a finite number")
    if isinstance(value, dict):
        for key, inner in value.items():
            _refuse_infinite(inner, where, f"{place}.{key}" if place else key)
    elif isinstance(value, list | tuple):
        for k, inner in enumerate(value):
            _refuse_infinite(inner, where, f"{place}[{k}]")
