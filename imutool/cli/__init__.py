"""Command line: each command is a file that is imported here.

Results go to stdout; log lines and progress go to stderr.
"""

from __future__ import annotations

import os
import signal
import sys

from imutool.cli import (
    clean,
    conceal,
    convert,
    debias,
    diagnose,
    evaluate,
    fleet,
    info,
    repair,
    shipped,
    simulate,
    train,
    view,
    vio,
)
from imutool.cli.app import app, caught

COMMANDS = (
    convert,
    info,
    repair,
    train,
    debias,
    clean,
    evaluate,
    view,
    vio,
    simulate,
    diagnose,
    conceal,
    fleet,
    shipped,
)


TERMINATED = 143  # what a shell reports of a program that SIGTERM ended


def main() -> None:
    """Entry point of the `imutool` command."""
    # Idle OpenMP threads would spin: on a busy machine with two processors, training took 87 s of their time instead of 11
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # A scheduler's SIGTERM would end the process where it stands, with its temporary files and parts of uploads left behind
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    with caught():
        app()
