"""`imutool fleet`."""

from __future__ import annotations

import re
from typing import Annotated

import typer

from imutool.cli._app import Init, Json, Overwrite, Quiet, Smooth, Verbose, app
from imutool.errors import ConfigError
from imutool.terminal import progress, say, write_json

fleet = typer.Typer(
    name="fleet",
    help="The same for many logs: on all cores of this machine, or on a Ray cluster.",
    no_args_is_help=True,
    rich_markup_mode="rich",
)
app.add_typer(fleet)

UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}

Src = Annotated[str, typer.Argument(metavar="SRC", help="Folder, pattern, log or URL.")]
Out = Annotated[str, typer.Argument(metavar="OUT", help="Folder or URL; each log keeps its path from SRC.")]
Address = Annotated[str | None, typer.Option(help="Of a Ray cluster (or auto); without, this machine's cores.")]
Resume = Annotated[bool, typer.Option("--resume", help="Go on: what is done and still stands is skipped.")]
Recheck = Annotated[bool, typer.Option("--recheck", help="With --resume: read what is done again, whole.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Logs worked on at once; else one per core.")]
Memory = Annotated[str, typer.Option("--memory-per-task", metavar="SIZE", help="Set aside for each log, as 800M or 2G.")]
Retries = Annotated[int, typer.Option(min=0, help="How often a log is given to another worker when one dies.")]


@fleet.command(epilog="Example: [bold]imutool fleet debias logs/ clean/ --model euroc-adis16448-hybrid --resume[/]")
def debias(
    source: Src,
    out: Out,
    model: Annotated[str | None, typer.Option(help="Model file or a name that ships; else as each log's metadata say.")] = None,
    init: Init = "auto",
    smooth: Smooth = False,
    address: Address = None,
    resume: Resume = False,
    recheck: Recheck = False,
    workers: Workers = None,
    memory: Memory = "1G",
    retries: Retries = 3,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Debias every log."""
    from imutool.debias import refuse_smooth
    from imutool.fleet.models import settled
    from imutool.fleet.task import Settings

    refuse_smooth(init, smooth)
    _run(
        source, out, settled(Settings(command="debias", model=model, init=init, smooth=smooth)), address, resume, recheck,
        workers, memory, retries, overwrite, json_to, verbose, quiet
    )


@fleet.command(epilog="Example: [bold]imutool fleet info logs/ about/[/]")
def info(
    source: Src,
    out: Out,
    address: Address = None,
    resume: Resume = False,
    recheck: Recheck = False,
    workers: Workers = None,
    memory: Memory = "1G",
    retries: Retries = 3,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Say of every log what is in it, as `imutool info --json` does."""
    from imutool.fleet.task import Settings

    _run(source, out, Settings(command="info"), address, resume, recheck, workers, memory, retries, overwrite, json_to, verbose, quiet)


def _run(source, out, settings, address, resume, recheck, workers, memory, retries, overwrite, json_to, verbose, quiet) -> None:  # type: ignore
    from imutool.fleet.engine import Engine
    from imutool.fleet.run import run

    size = memory_bytes(memory)
    with progress("Fleet", verbose, quiet) as tell:
        report = run(
            source,
            out,
            settings,
            lambda: Engine(address, workers=workers, memory_bytes=size, retries=retries),
            resume=resume,
            overwrite=overwrite,
            recheck=recheck,
            tell=tell,
        )
    say(report.tally.words())
    raise typer.Exit(report.tally.exit_code)


def memory_bytes(text: str) -> int:
    """Bytes of `800M`, `2G` or `2GiB`.

    Raises:
        ConfigError: no such size.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)(?:i?B)?", text.strip(), re.IGNORECASE)
    if match is None:
        raise ConfigError(f"{text!r} is no size", where="--memory-per-task", expected="bytes, or a number with K, M, G or T")
    return int(float(match[1]) * UNITS[match[2].upper()])
