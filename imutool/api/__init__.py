"""Public functions behind `import imutool`, for paths, URLs and arrays."""

from __future__ import annotations

import functools
import inspect
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from itertools import chain, count
from numbers import Integral, Real
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast

from imutool.errors import ConfigError, ImutoolError
from imutool.file_location import Location, LogPath, location, refuse_twins, several

if TYPE_CHECKING:
    from imutool.recording import Recording

LONGEST_NAME = 200  # bytes of the name of a file for a recording
Init = str | Iterable[float]  # initial bias: the name of a method, or six numbers
Function = TypeVar("Function", bound=Callable[..., Any])


class GivenLogs(NamedTuple):
    """Files or objects of logs; names of those that are recordings, by the place of their file."""

    places: list[Location]
    names: dict[str, str]


class _Kind(NamedTuple):
    """Kind of value by its name in an annotation."""

    words: str
    accepts: Callable[[object], bool]


def _is_flag(value: object) -> bool:
    return isinstance(value, bool) or type(value).__name__ in ("bool", "bool_")  # numpy's, which may not be imported


def _are_texts(value: object) -> bool:
    return isinstance(value, Iterable) and (isinstance(value, Iterator) or all(isinstance(item, str) for item in value))


KINDS = {
    "str": _Kind("text", lambda value: isinstance(value, str)),
    "Path": _Kind("a path", lambda value: isinstance(value, os.PathLike) or hasattr(type(value), "fs")),
    "int": _Kind("an integer", lambda value: isinstance(value, Integral) and not _is_flag(value)),
    "float": _Kind("a number", lambda value: isinstance(value, Real) and not _is_flag(value)),
    "bool": _Kind("True or False", _is_flag),
    "Sequence[str]": _Kind("a list of texts", _are_texts),
    "Mapping[str, Any]": _Kind("a dictionary", lambda value: isinstance(value, Mapping)),
    "Progress": _Kind("a function", callable),
    "NamedProgress": _Kind("a function", callable),
    "None": _Kind("None", lambda value: value is None),
}


def checked(function: Function) -> Function:
    """Public function that refuses values of another kind than its annotations name.

    Of simple annotations alone, such as `int | None`. A number of numpy's becomes one of Python's.
    """
    named = {name: str(hint).split(" | ") for name, hint in function.__annotations__.items() if name != "return"}
    kinds = {name: [KINDS[word] for word in words] for name, words in named.items() if set(words) <= set(KINDS)}
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        try:
            bound = signature.bind(*args, **options)
        except TypeError:
            return function(*args, **options)  # Python's own error names the function
        for name, value in bound.arguments.items():
            if name in kinds and not any(kind.accepts(value) for kind in kinds[name]):
                expected = " or ".join(kind.words for kind in kinds[name])
                raise ConfigError(f"is of type {type(value).__name__}", where=name, expected=expected)
            if name in kinds and getattr(value, "shape", None) == ():  # a number or text of numpy's
                bound.arguments[name] = value.item()
        return function(*bound.args, **bound.kwargs)

    return cast(Function, call)


@contextmanager
def given_logs(
    logs: LogPath | Recording | Iterable[LogPath | Recording], parameter: str, *, minimum: int = 1
) -> Iterator[GivenLogs]:
    """Files or objects of one log or several; a recording is a file while they are used.

    No error names such a file.

    Raises:
        ConfigError: none is given, one is given twice, or one is neither a path nor a recording.
        DataError: a recording without samples, or of a rate that is none.
    """
    from imutool.mcap_io.write import write
    from imutool.recording import Recording

    places, names, written = list[Location](), dict[str, str](), set[int]()
    with ExitStack() as folders:
        for log in several(logs):
            if isinstance(log, Recording):
                log.imu.check_rate(log.name)
                samples = hash((log.imu.t_ns.tobytes(), log.imu.gyro.tobytes(), log.imu.accel.tobytes()))
                if samples in written:
                    raise ConfigError(f"the samples of {log.name} are given twice", where=parameter, expected="each log once")
                written.add(samples)
                folder = folders.enter_context(TemporaryDirectory(prefix="imutool-"))
                name = _distinct(_file_name(log.name) or parameter, {*names.values()})
                places.append(Path(folder) / f"{name}.mcap")
                names[str(places[-1])] = name
                write(log, places[-1])
            else:
                places.append(location(log))
        if len(places) < minimum:
            raise ConfigError("no log is given", where=parameter, expected="one or more")
        refuse_twins(places, parameter)
        try:
            yield GivenLogs(places, names)
        except ImutoolError as error:
            raise error.renamed(names) from error.__cause__


def _file_name(name: str) -> str:
    """Name of a recording as a file can have it on every system."""
    return re.sub(r"[^\w ()+.-]", "_", name).encode()[:LONGEST_NAME].decode(errors="ignore").strip(" .")


def _distinct(name: str, taken: set[str]) -> str:
    return next(each for each in chain([name], (f"{name} ({number})" for number in count(2))) if each not in taken)


def init_text(init: Init) -> str:
    """Initial bias as text: six numbers as `gx,gy,gz,ax,ay,az`.

    Raises:
        ConfigError: neither text nor numbers.
    """
    try:
        return init if isinstance(init, str) else ",".join(repr(float(number)) for number in init)
    except (TypeError, ValueError):
        kind = type(init).__name__
        raise ConfigError(f"is of type {kind}", where="init", expected="the name of a method, or six numbers") from None
