"""Errors that the user can act on, sorted by what to do; each has an exit code.

::

    ImutoolError
    ├── ConfigError    3   edit the command line or the settings file
    │   └── UsageError 2   correct the command line
    ├── DataError      4   look at the data
    ├── LogError       5   look at the log
    ├── ModelError     6   choose another model
    └── NumericsError  7   change the step, the window or the rate

An interrupt exits with 130; anything else is a bug and shows its traceback with 1.
`imutool.cli.main` is the one place that catches.

The library names its parameters as Python does: plain in `where` (``where="init"``, ``where="imu, noise"``), in backquotes in
a sentence (``fix="Give `model`"``, ``expected="`init=prior`"``). The command line shows its flags in their place: ``--init``,
``--model``, ``--init prior`` (`imutool.cli.parameters`). No other module knows flags.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import partial
from importlib import import_module
from typing import Any, ClassVar

INTERRUPTED = 130  # exit code after Ctrl-C
PIPE_CLOSED = 141  # what a shell reports of a program that SIGPIPE ended
LOST = 3  # exit code of work that was done, with something of a log lost or a log quarantined
# A path keeps one slash of a URL's two. What follows ? or # is a query of http, and of a store if it assigns something
URL_LOGIN = re.compile(
    r"(\b(?!az:|abfs:)[a-z][a-z0-9+.-]*:/{1,2}|\b(?:az|abfs):/{1,2}(?=[^/\s?#]*:))[^/\s?#]*@", re.IGNORECASE
)  # CONTAINER@ACCOUNT is not secret
URL_TAIL = re.compile(
    r"(\b(?:https?:/{1,2}[^\s?#'\"]*[?#]|[a-z][a-z0-9]*:/{1,2}[^\s?#'\"]*[?#](?=[\w.-]+=)))[^\s'\"]+", re.IGNORECASE
)
SECRET = re.compile(r"((?:signature|sig|token|credential|password|secret)=)[^&\s\"']+", re.IGNORECASE)


class ImutoolError(Exception):
    """Error with four parts: place, problem, expectation, fix.

    Secrets in the URLs of a message are replaced by ***.

    Args:
        what: what happened, with the wrong value.
        where: the file or URL, optionally with a line (``data.csv:17``), the topic, the setting, or the parameter.
        expected: what would have been right, as the end of "expected ...".
        fix: what the user can do, as a sentence without its full stop.
    """

    exit_code: ClassVar[int] = 1

    def __init__(self, what: str, *, where: object = None, expected: str = "", fix: str = "") -> None:
        self.what, self.where = redact(what), None if where is None else redact(str(where))  # text crosses process borders
        self.expected, self.fix = redact(expected), redact(fix)
        super().__init__(str(self))

    def __str__(self) -> str:
        place = f"{self.where}: " if self.where is not None else ""
        expected = f"; expected {self.expected}" if self.expected else ""
        fix = f" {self.fix}{'' if self.fix.endswith('?') else '.'}" if self.fix else ""
        return f"{place}{self.what}{expected}.{fix}"

    def at(self, where: object) -> ImutoolError:
        """Error with its place filled in, by a caller that has the name of the file."""
        return self if self.where is not None else self.replaced(where=where)

    def replaced(self, **parts: Any) -> ImutoolError:
        """Error of the same class with some parts replaced."""
        own = {"what": self.what, "where": self.where, "expected": self.expected, "fix": self.fix}
        return type(self)(**{**own, **parts})

    def renamed(self, names: Mapping[str, str]) -> ImutoolError:
        """Error with other names of places in its text, such as that of a file whose temporary one it is about."""
        texts = [self.what, self.where or "", self.expected, self.fix]
        for place, name in names.items():
            texts = [text.replace(place, name) for text in texts]
        what, where, expected, fix = texts
        return type(self)(what, where=where or None, expected=expected, fix=fix)

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle with keyword arguments: errors of worker processes return to the parent."""
        return partial(type(self), self.what, where=self.where, expected=self.expected, fix=self.fix), ()


class ConfigError(ImutoolError):
    """A parameter, a settings file or a place of a file cannot be used."""

    exit_code = 3


class UsageError(ConfigError):
    """The command line is wrong in itself, such as an output whose suffix does not fit."""

    exit_code = 2


def not_installed(package: str, extra: str, *, where: object, user: str = "", error: ImportError | None = None) -> ConfigError:
    """Error of a missing package, with the extra that brings it.

    `user` is what needs the package, `error` why an installed one cannot be imported.
    """
    why = "" if error is None or isinstance(error, ModuleNotFoundError) else f" ({error})"
    what = f"{user} needs {package}, which is not installed" if user else f"{package} is not installed"
    return ConfigError(what + why, where=where, fix=f"Install it with: pip install 'imutool[{extra}]'")


def required(module: str, extra: str, *, package: str = "", where: object = None, user: str = "") -> Any:
    """Import a module of an optional package.

    Raises:
        ConfigError: it cannot be imported (`not_installed`).
    """
    top = module.partition(".")[0]
    try:
        import_module(top)
        return import_module(module)
    except ImportError as error:
        raise not_installed(package or top, extra, where=where, user=user, error=error) from error


class DataError(ImutoolError):
    """The source data contradict themselves or their format."""

    exit_code = 4


class LogError(ImutoolError):
    """An MCAP log cannot be read, or lacks the requested data."""

    exit_code = 5


class ModelError(ImutoolError):
    """A model file is damaged, or was made for another sensor, rate or version."""

    exit_code = 6


class NumericsError(ImutoolError):
    """A computation left the range in which its result is valid."""

    exit_code = 7


def redact(text: str) -> str:
    """Text without users, passwords, queries, fragments and signatures of the URLs in it."""
    if "://" in text or ":/" in text:
        text = URL_TAIL.sub(r"\1***", URL_LOGIN.sub(r"\1***@", text))
    return SECRET.sub(r"\1***", text) if "=" in text else text


def did_you_mean(word: str, known: Iterable[str], shown: str = "{}") -> str:
    """Question that names the known word nearest to a wrong one; empty if none is near."""
    import difflib

    near = difflib.get_close_matches(word, known, n=1)
    return f"Did you mean {shown.format(near[0])}?" if near else ""


def was_interrupted(error: BaseException | None) -> bool:
    """Whether an error came of Ctrl-C; an interrupted import may raise an ImportError."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None
