"""Names and summaries of all commands: the page of `imutool --help`, without their imports."""

from __future__ import annotations

import re
from collections.abc import Mapping
from copy import copy
from shutil import get_terminal_size
from typing import Any

NARROW = 80  # columns: with fewer, the tables of a command's help cut the names of options
# A test compares names and texts with the commands themselves. The order is that of the page.
COMMANDS: Mapping[str, tuple[str, str]] = {  # by name: the module, and the first line of the command's help
    "convert": ("convert", "Convert any recording with an IMU to MCAP; the format is recognised."),
    "info": ("info", "Report the topics, quality and damage of a log; with --noise, also its IMU noise."),
    "train": ("train", "Train a bias model on logs of one sensor with true poses."),
    "debias": ("debias", "Write a log with a debiased IMU topic; all other messages stay unchanged."),
    "clean": ("clean", "Find the defects of a log's IMU, and say whether the log can be trusted."),
    "repair": ("clean", "Save the intact messages of a damaged log or ROS 1 bag, and report the losses."),
    "fleet": ("fleet_view", "Process many logs on all cores of this machine, or on a Ray cluster."),
    "evaluate": ("evaluate", "Integrate the IMU from the true start, raw and debiased, and compare it with the truth."),
    "vio": ("evaluate", "Score a visual-inertial estimate on the log's IMU, raw and with each model."),
    "export": ("convert", "Write a log as a EuRoC or rosbag2 folder, or a diagnosed sensor for a simulator."),
    "view": ("view", "Show truth, raw and debiased: in the Rerun viewer, in a browser, or as files."),
    "live": ("live", "Debias a stream of samples as it comes, show it, and measure the delay."),
    "simulate": ("simulate", "Simulate an IMU, with a sensor's physics and noise."),
    "diagnose": ("diagnose", "Find physics that a simulation leaves out, by comparison with a recording."),
    "audit": ("diagnose", "Find the errors of a simulator's IMU, without a recording."),
    "conceal": ("simulate", "Make a sealed blind case, or open one and score the findings."),
    "models": ("models", "List the models that ship: method, sensor, data set and rate."),
    "schema": ("models", "Print the JSON Schema of a report, or list the reports."),
    "new-converter": ("convert", "Write a template of a converter, with a test, as a package of its own."),
    "demo": ("demo", "Run a demo without download: convert, train, debias, evaluate, view."),
}
MODULES = tuple(dict.fromkeys(module for module, _ in COMMANDS.values()))
ABOUT = "Convert IMU recordings to MCAP, train bias models, debias logs, diagnose and view them."
OPTIONS = {
    "--version": "Print the version.",
    "--install-completion": "Install completion for the current shell.",
    "--show-completion": "Show completion for the current shell, to copy it or customize the installation.",
    "--help": "Show this message and exit.",
}


def fitted(command: Any) -> Any:
    """Copy of a command for its help: without tables and markup in a narrow terminal."""
    shown = copy(command)
    if get_terminal_size().columns < NARROW:
        shown.rich_markup_mode, shown.epilog = None, re.sub(r"\[(bold|/)\]", "", command.epilog or "")
    return shown


def show() -> None:
    """Print the page: typer's own takes twice as long to import as this one takes in all."""
    from rich import box
    from rich.console import Console
    from rich.padding import Padding
    from rich.panel import Panel
    from rich.table import Table

    out = Console(highlight=False)
    out.print("\n [yellow]Usage:[/] [bold]imutool \\[OPTIONS] COMMAND \\[ARGS]...[/]\n")
    out.print(Padding(ABOUT, (0, 1, 1, 1)))
    for title, rows in (("Options", OPTIONS), ("Commands", {name: text for name, (_, text) in COMMANDS.items()})):
        grid = Table(box=None, show_header=False, padding=(0, 2, 0, 0), pad_edge=False)
        grid.add_column(style="bold cyan", no_wrap=True)
        grid.add_column()
        for row in rows.items():
            grid.add_row(*row)
        out.print(Panel(grid, title=title, title_align="left", border_style="dim", box=box.ROUNDED))
    out.print()
