"""Public functions behind `import imutool`, for paths, URLs and arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from imutool.errors import ConfigError
from imutool.file_location import Location, LogPath, location, several

Progress = Callable[[int, int], None]  # bytes done, bytes in all
NamedProgress = Callable[[int, int, str], None]  # steps done, steps in all, the current step
Init = str | Iterable[float]  # initial bias: the name of a method, or six numbers


def given_logs(logs: LogPath | Iterable[LogPath], parameter: str) -> list[Location]:
    """Files or objects of one log or several.

    Raises:
        ConfigError: none is given, or one is no path.
    """
    if places := [location(log) for log in several(logs)]:
        return places
    raise ConfigError("no log is given", where=parameter, expected="one or more")


def init_text(init: Init) -> str:
    """Initial bias as text: six numbers as `gx,gy,gz,ax,ay,az`.

    Raises:
        ConfigError: neither text nor numbers.
    """
    try:
        return init if isinstance(init, str) else ",".join(repr(float(number)) for number in init)
    except (TypeError, ValueError):
        kind = type(init).__name__
        raise ConfigError(f"of type {kind}", where="init", expected="the name of a method, or six numbers") from None
