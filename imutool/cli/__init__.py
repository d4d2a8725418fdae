"""Command line: each command stands in a file of this room; `load` imports them.

Results go to stdout; log lines and progress go to stderr.
"""

from __future__ import annotations

import os
import signal
import sys
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from imutool.cli.app import App

MODULES = (
    "convert",
    "info",
    "repair",
    "train",
    "debias",
    "clean",
    "evaluate",
    "view",
    "live",
    "simulate",
    "diagnose",
    "fleet",
    "fleet_view",
    "shipped",
)
REPEAT_S = 0.01
INTERRUPTED, TERMINATED = 130, 143  # what a shell reports of a program that SIGTERM ended


def load() -> App:
    """Application with every command; the order is that of `--help`."""
    for name in MODULES:
        import_module(f"imutool.cli.{name}")
    from imutool.cli.app import app

    return app


def main() -> None:
    """Entry point of the `imutool` command."""
    # Idle OpenMP threads would spin: on a busy machine with two processors, training took 87 s of their time instead of 11
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # A scheduler's SIGTERM would end the process where it stands, with its temporary files and parts of uploads left behind
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    sys.unraisablehook = _unraisable
    try:
        app = load()
        from imutool.cli.app import caught
    except BaseException as error:  # Ctrl-C before there is anybody who could catch it in style
        from imutool.errors import was_interrupted

        if not was_interrupted(error):
            raise
        print("error: interrupted. Nothing was begun.", file=sys.stderr)
        sys.exit(INTERRUPTED)
    with caught():
        app()


def _unraisable(unraisable: sys.UnraisableHookArgs) -> None:
    """Repeat a Ctrl-C that came where nothing can be raised, as while an object is removed."""
    if unraisable.exc_type is KeyboardInterrupt:
        from threading import Timer

        Timer(REPEAT_S, signal.raise_signal, [signal.SIGINT]).start()
    else:
        sys.__unraisablehook__(unraisable)
