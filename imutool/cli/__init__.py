"""Command line: a file for each command; `load` imports the one that is asked for.

Results go to stdout; log lines and progress go to stderr.
"""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from io import TextIOWrapper
from types import FrameType
from typing import TYPE_CHECKING, NoReturn

from imutool.cli.overview import COMMANDS, MODULES, show

if TYPE_CHECKING:
    from imutool.cli.app import App

COMPLETION = "_IMUTOOL_COMPLETE"  # a shell asks for words; any command may be meant
HALF_MADE = "RecordingStream.__del__"  # of Rerun: it fails where a Ctrl-C ended the stream's __init__
WRONG_USAGE, INTERRUPTED = 2, 130
ENDS = {129: "SIGHUP", 143: "SIGTERM"}  # by what a shell reports of a program that the signal ended


def load(words: Sequence[str] = ()) -> App:
    """Application with the command that `words` ask for, or with all."""
    name = next((word for word in words if not word.startswith("-")), "")
    for module in (COMMANDS[name][0],) if name in COMMANDS else MODULES:
        import_module(f"imutool.cli.{module}")
    from imutool.cli.app import app

    return app


def main() -> None:
    """Entry point of the `imutool` command."""
    # Idle OpenMP threads would spin: on a busy machine with two processors, training took 87 s of their time instead of 11
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault(
        "OPENBLAS_NUM_THREADS", "1"
    )  # the matrices are small: `diagnose` takes a fifth less, and ends no later
    _end_by_signals()
    sys.unraisablehook = _unraisable
    gc.set_threshold(100_000)  # imports make objects that stay: the collector took a twelfth of a command's start
    atexit.register(gc.freeze)  # and at the end it would look at all of them again, which takes 45 ms of CPU
    words = sys.argv[1:]
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by who started us; an output file would get its number
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))
        stream = getattr(sys, name)
        if isinstance(stream, TextIOWrapper) and not stream.encoding.lower().startswith("utf"):
            stream.reconfigure(errors="replace")  # Windows' code page, into which it writes a file, has no root of Hz
    try:
        if words in ([], ["--help"]) and COMPLETION not in os.environ:
            _show()
            sys.exit(0 if words else WRONG_USAGE)
        app = load(() if COMPLETION in os.environ else words)
        from typer import Exit

        from imutool.cli.app import caught
        from imutool.cli.terminal import tell_end
        from imutool.errors import was_interrupted
    except BaseException as error:  # Ctrl-C before there is anybody who could catch it in style
        from imutool.errors import was_interrupted

        if not was_interrupted(error):
            _leave_pipe(error)
            if isinstance(error, SystemExit) and error.code in ENDS:
                print(f"error: ended by {ENDS[error.code]}. Nothing was begun.", file=sys.stderr)
            raise
        print("error: interrupted. Nothing was begun.", file=sys.stderr)
        sys.exit(INTERRUPTED)
    with caught():
        try:
            app()
        except SystemExit as end:
            if isinstance(end.__context__, Exit) and was_interrupted(end.__context__):
                raise KeyboardInterrupt from end  # before the command began or after its end, where typer ends without a word
            _leave_pipe(end)
            if end.code in ENDS:
                with suppress(OSError):  # the terminal has gone
                    tell_end(f"ended by {ENDS[end.code]}", end)
            raise


def _end_by_signals() -> None:
    """Handle SIGTERM and SIGHUP: temporary files and parts of uploads are removed first."""

    def end(number: int, frame: FrameType | None) -> NoReturn:
        if ENDS[128 + number] == "SIGHUP":  # a terminal sends it, and then its shell
            signal.signal(number, signal.SIG_IGN)
        sys.exit(128 + number)

    for name in ENDS.values():
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) is not signal.SIG_IGN:  # as nohup sets it
            signal.signal(getattr(signal, name), end)


def _show() -> None:
    """Print the help page; where it cannot be written, say so."""
    try:
        show()
    except OSError:
        from imutool.cli.app import caught  # the page itself does without

        with caught():
            raise


def _leave_pipe(error: BaseException) -> None:
    """End as a program that SIGPIPE ended, where the reader of a help page left: Rich ends with the code of a bug."""
    from imutool.errors import PIPE_CLOSED

    if isinstance(error.__context__, BrokenPipeError):
        sys.exit(PIPE_CLOSED)


def _unraisable(unraisable: sys.UnraisableHookArgs) -> None:
    from imutool.processes.system import repeat_swallowed  # every command would pay for it at its start

    if not repeat_swallowed(unraisable) and getattr(unraisable.object, "__qualname__", "") != HALF_MADE:
        sys.__unraisablehook__(unraisable)
