"""Paths, URLs and lists of them as the public functions accept them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

from imutool.errors import ConfigError
from imutool.location import Location, to_location

LogPath: TypeAlias = str | Location


def location(path: LogPath) -> Location:
    """File or object of a path or URL.

    Raises:
        ConfigError: unknown store, missing package for it, or a password in the URL.
    """
    return to_location(path) if isinstance(path, str) else path


def local(path: LogPath, parameter: str) -> Path:
    """File on this machine.

    Raises:
        ConfigError: `path` is a URL.
    """
    found = location(path)
    if not isinstance(found, Path):
        raise ConfigError(f"{path} is in an object store", where=parameter, expected="a file on this machine")
    return found


def locals_of(paths: LogPath | Sequence[LogPath], parameter: str) -> list[Path]:
    """Files on this machine, of one path or of several.

    Raises:
        ConfigError: one of them is a URL.
    """
    several = paths if isinstance(paths, Sequence) and not isinstance(paths, str) else [paths]
    return [local(path, parameter) for path in several]
