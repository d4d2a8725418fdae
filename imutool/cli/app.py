"""Application, shared options and error handling of the commands."""

from __future__ import annotations

import inspect
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from inspect import Parameter
from pathlib import Path
from typing import Annotated, Any, NoReturn, get_args

import typer
from typer.core import TyperCommand
from typer.models import CommandFunctionType

from imutool import __version__, registry
from imutool.cli.overview import ABOUT, fitted, show
from imutool.cli.parameters import FOLDERS, Group, PlainValue, current, error_with_flags, flags, instead_of
from imutool.cli.terminal import log_to_stderr, plain, progress, say, stdout_for_one, tell_end, tell_error, write_json
from imutool.errors import INTERRUPTED, PIPE_CLOSED, ConfigError, ImutoolError, redact, was_interrupted
from imutool.file_location import first_bytes
from imutool.mcap_io.storage import output_conflicts
from imutool.mcap_io.storage.output_conflicts import OutputFile, check_outputs
from imutool.report import NamedProgress, Report

MAKE_ROOM = "Choose another place or make room"
FIXES = {FileNotFoundError: "Look whether it is still there", PermissionError: "See who may read it, or write there"}


class _Commands(Group):
    """Group of commands that reports an interrupt; typer would exit without a message."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the page of `imutool --help`."""
        show()

    def invoke(self, ctx: Any) -> Any:
        with caught():
            try:
                result = super().invoke(ctx)
            except Exception as error:  # a wrong command line repeats its words
                if hasattr(error, "format_message"):
                    error.message = redact(error.message)  # type: ignore[attr-defined]
                raise
            sys.stdout.flush()  # at the interpreter's end it would be too late to say anything
        return result


@contextmanager
def caught() -> Iterator[None]:
    """Turn every error into a message and an exit code; no other place catches."""
    try:
        yield
    except ImutoolError as error:
        _fail(str(error), error.exit_code)
    except KeyboardInterrupt as interrupt:
        tell_end("interrupted", interrupt)
        sys.exit(INTERRUPTED)
    except BrokenPipeError:
        _forget_stdout()
        sys.exit(PIPE_CLOSED)
    except OSError as error:
        if error.filename is None:  # then it is a stream, and stdout the only one we fill
            _forget_stdout()
        place = f"{error.filename}: " if error.filename else ""
        _fail(f"{place}{error.strerror or error}. {FIXES.get(type(error), MAKE_ROOM)}.", ConfigError.exit_code)
    except Exception as error:
        if was_interrupted(error):
            tell_end("interrupted", error)
            sys.exit(INTERRUPTED)
        raise


Written = partial(OutputFile, "", None)  # marks a parameter that names an output: its name and value come with a command


def written(function: Callable[..., Any]) -> dict[str, OutputFile]:
    """Outputs among the parameters of a command's function."""
    marks = {
        name: [mark for mark in get_args(parameter.annotation) if isinstance(mark, OutputFile)]
        for name, parameter in inspect.signature(function, eval_str=True).parameters.items()
    }
    return {name: found[0] for name, found in marks.items() if found}


class Command(TyperCommand):
    """Command that refuses destructive outputs first, and whose errors name flags."""

    function: Callable[..., Any]  # what the command runs

    def get_params(self, ctx: Any) -> list[Any]:
        """Parameters with --help; they convert texts and paths by themselves."""
        return [PlainValue.into(parameter) for parameter in super().get_params(ctx)]

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help as the terminal has room."""
        super(Command, fitted(self)).format_help(ctx, formatter)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the words of the command line; an option that only other commands have is answered with this command's."""
        try:
            return super().parse_args(ctx, [*args])  # it takes them out one by one
        except Exception as error:  # click's own kinds of error are not exported by typer
            if hasattr(error, "possibilities"):
                error.possibilities = instead_of(getattr(error, "option_name", ""), self)
                files = (f"; the file of that name is ./{word}" for word in args if word[:1] == "-" and Path(word).exists())
                error.message += next(files, "")  # type: ignore[attr-defined]
            elif "extra argument" in getattr(error, "message", "") and self.name in ("debias", "repair"):
                error.message += f". imutool fleet {self.name} takes many logs"  # type: ignore[attr-defined]
            raise

    def invoke(self, ctx: Any) -> Any:
        """Run the command.

        Raises:
            ImutoolError: the command failed.
        """
        current.set(flag_of := flags(self))
        try:
            self._check(ctx.params, ctx.meta)
            with stdout_for_one({name: ctx.params[name] for name in written(type(self).function)}):
                return super().invoke(ctx)
        except ImutoolError as error:
            values = ctx.params.values()
            typed = {str(word) for value in values for word in (value if isinstance(value, (list, tuple)) else (value,))}
            raise error_with_flags(error, flag_of, typed) from error

    def _check(self, values: Mapping[str, Any], meta: Mapping[str, Any]) -> None:
        """Refuse outputs that would destroy something; on --resume a report of the run before may be replaced."""
        marks = written(type(self).function)
        places, resume = {name: values[name] for name in marks if values[name] != "-"}, bool(values.get("resume"))
        places |= {name: f"{place}/" for name, place in places.items() if isinstance(place, Path) and meta.get(FOLDERS + name)}
        wanted = [
            replace(marks[name], parameter=name, place=place, keeps=marks[name].keeps or (resume and self._is_report(place)))
            for name, place in places.items()
        ]
        check_outputs(wanted, [values[name] for name in values if name not in marks], overwrite=bool(values.get("overwrite")))

    def _is_report(self, place: str | Path | None) -> bool:
        """Whether a file is a JSON report of a run that --resume can go on with."""
        kind = b"training" if self.name == "train" else b"fleet"
        return b'"schema": "imutool.%s/' % kind in first_bytes(Path(place or ""), 200)  # the schema comes first


class App(typer.Typer):
    """Application whose commands are `Command`s."""

    def command(
        self, name: str | None = None, *, cls: type[TyperCommand] | None = None, **settings: Any
    ) -> Callable[[CommandFunctionType], CommandFunctionType]:
        """Register a function as a command."""

        def register(function: CommandFunctionType) -> CommandFunctionType:
            command = expanded(function)
            text = re.sub(r"(?<!\n)\n(?!\n)", " ", inspect.getdoc(function) or "")  # without the lines of the source
            kind = type("Command", (cls or Command,), {"function": staticmethod(command)})
            typer.Typer.command(self, name, cls=kind, **{"help": text, **settings})(command)
            return function

        return register


def listing(group: str, option: str) -> type[TyperCommand]:
    """Command class whose help lists the names of a plugin group, without an import."""

    class Listing(Command):
        values = (group, option)  # for the documentation

        def format_help(self, ctx: Any, formatter: Any) -> None:
            lines = [f"[bold]{name}[/]  {plain(registry.summary(group, name))}" for name in registry.names(group)]
            shown = copy(self)  # a second help must not list them twice
            shown.epilog = "\n\n".join([f"Values of {option}:", *lines, self.epilog or ""])
            super(Listing, shown).format_help(ctx, formatter)

    return Listing


app = App(
    name="imutool",
    help=ABOUT,
    cls=_Commands,
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    add_completion=True,
)

Logs = Annotated[list[Path], typer.Argument(metavar="LOG", help="MCAP logs.")]
LogUrls = Annotated[list[str], typer.Argument(metavar="LOG", help="MCAP logs: files or URLs such as s3://bucket/log.mcap.")]
Models = Annotated[
    list[str] | None, typer.Option("--model", help="Model file, physics.toml, a name that ships, or static. Repeatable.")
]
Init = Annotated[
    str, typer.Option(help="Initial bias: auto, stationary, prior, truth, truth:SECONDS, or gx,gy,gz,ax,ay,az (rad/s, m/s²).")
]
Smooth = Annotated[bool, typer.Option("--smooth", help="Use the whole log for each sample's bias: more accurate, not causal.")]
Aid = Annotated[
    str | None,
    typer.Option(
        metavar="KIND,...",
        help="Also show the smoothed path with stops, barometer, odometry, ground; auto: all that the log has.",
    ),
]
Imu = Annotated[str | None, typer.Option(help="IMU topic, where a log has several; gyro=TOPIC,accel=TOPIC joins two.")]
Imus = Annotated[
    list[str] | None,
    typer.Option("--imu", help="IMU topic, where a log has several; gyro=TOPIC,accel=TOPIC joins two. Repeatable."),
]
Truth = Annotated[str | None, typer.Option(help="Topic of the true poses, where a log has several.")]
JSON, HTML = Written(output_conflicts.JSON), Written(output_conflicts.HTML)
PNG, TOML = Written(output_conflicts.PNG), Written(output_conflicts.TOML)
RRD, MODEL, LOG = (Written(suffixes) for suffixes in (output_conflicts.RRD, output_conflicts.MODEL, output_conflicts.LOG))
Json = Annotated[str | None, typer.Option("--json", metavar="FILE|-", help="Write the report as JSON; - is stdout."), JSON]
ReportPage = Annotated[
    Path | None, typer.Option(metavar="F.html", help="Write an HTML page with figures, paths, errors and spectra."), HTML
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")]
Set = Annotated[list[str] | None, typer.Option("--set", metavar="key=value", help="Change one setting. Repeatable.")]
MaxChunk = Annotated[
    int | None, typer.Option(min=1, metavar="BYTES", help="Largest chunk to unpack into memory (default: 268435456).")
]
Verbose = Annotated[bool, typer.Option("-v", "--verbose", help="Print more.")]
Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Print only results and errors.")]


@dataclass(frozen=True)
class Common:
    """Options at the end of nearly every command: its parameter `common` stands for them."""

    overwrite: Overwrite = False
    json_to: Json = None
    verbose: Verbose = False
    quiet: Quiet = False

    def progress(self, what: str) -> AbstractContextManager[NamedProgress]:
        """Progress bar on stderr."""
        return progress(what, self.verbose, self.quiet)

    def write(self, report: Report, *, replace: bool = False) -> bool:
        """Write the report where `--json` says; True if stdout holds it."""
        return write_json(report, self.json_to, overwrite=self.overwrite or replace)


COMMON = Common()


def expanded(function: Callable[..., Any]) -> Callable[..., Any]:
    """Function of a command with the options that `common` stands for."""
    own = inspect.signature(function, eval_str=True).parameters
    if "common" not in own:
        return function
    shared = inspect.signature(Common, eval_str=True).parameters

    def command(**words: Any) -> Any:
        common = Common(**{name: words.pop(name) for name in shared})
        log_to_stderr(common.verbose, common.quiet)
        return function(**words, common=common)

    options = [*(option for name, option in own.items() if name != "common"), *shared.values()]
    return with_options(command, options, function)


def with_options(command: Callable[..., Any], options: Iterable[Parameter], named: Callable[..., Any]) -> Callable[..., Any]:
    """Function with these options and another's name and help, for typer."""
    as_words = [option.replace(kind=Parameter.KEYWORD_ONLY) for option in options]
    command.__module__, command.__name__, command.__doc__ = named.__module__, named.__name__, named.__doc__
    command.__signature__ = inspect.Signature(as_words)  # type: ignore[attr-defined]
    command.__annotations__ = {option.name: option.annotation for option in as_words}
    return command


def _fail(message: str, code: int) -> NoReturn:
    tell_error(message)
    sys.exit(code)


def _forget_stdout() -> None:
    """Point stdout at /dev/null: flushing a closed pipe at exit then raises nothing."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _version(show: bool) -> None:
    if show:
        say(f"imutool {__version__}")
        raise typer.Exit


@app.callback()
def options(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Options of imutool itself."""
