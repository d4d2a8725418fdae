"""The command line: parse, call, print. Results go to stdout; log lines and progress to stderr; one place catches.

A command is a file, and being imported here is what makes it one.
"""

from __future__ import annotations

import os

from imutool.cli import (
    conceal,
    convert,
    debias,
    demo,
    diagnose,
    evaluate,
    export,
    fleet,
    info,
    models,
    simulate,
    train,
    view,
    vio,
)
from imutool.cli._app import app, caught

COMMANDS = (convert, info, train, debias, evaluate, view, export, vio, simulate, diagnose, conceal, models, demo, fleet)


def main() -> None:
    """Entry point of the `imutool` command."""
    # Idle OpenMP threads would spin: on a busy machine with two processors, training took 87 s of their time instead of 11
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with caught():
        app()
