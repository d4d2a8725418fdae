"""`imutool convert`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from imutool.cli.app import Json, Overwrite, Quiet, Verbose, app, listing
from imutool.cli.terminal import progress, say, tell_error, write_json
from imutool.errors import DataError


class Compression(StrEnum):
    """How chunks of a log are packed."""

    zstd = "zstd"
    lz4 = "lz4"
    none = "none"


@app.command(
    cls=listing("imutool.converters", "--format"), epilog="Example: [bold]imutool convert MH_04_difficult.zip MH_04.mcap[/]"
)
def convert(
    source: Annotated[Path, typer.Argument(help="Sequence folder, .zip, .tar, .tar.gz, .bag, or a folder of them.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="A file for one sequence, a folder for many.")],
    format: Annotated[str, typer.Option(help="auto, or one of those listed below.")] = "auto",
    sequence: Annotated[list[str] | None, typer.Option(help="Convert only this one. Repeatable.")] = None,
    compression: Annotated[Compression, typer.Option(help="How chunks are packed.")] = Compression.zstd,
    no_images: Annotated[bool, typer.Option("--no-images", help="Leave camera frames out.")] = False,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; by default one a processor.")] = None,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Convert a data set to MCAP logs, one a sequence."""
    from imutool.conversion import convert as run

    with progress("Converting", verbose, quiet) as tell:
        report = run(
            source,
            target,
            format=format,
            sequences=sequence or (),
            compression=compression.value,
            images=not no_images,
            overwrite=overwrite,
            workers=workers,
            progress=tell,
        )
    failures = [{"name": failure.name, "message": failure.message} for failure in report.failures]
    result = {"schema": "imutool.conversion/1", "written": [str(path) for path in report.written], "failures": failures}
    if not write_json(result, json_to):
        for path in report.written:
            say(str(path))
    for failure in report.failures:
        tell_error(failure.message)
    if report.failures:
        raise typer.Exit(DataError.exit_code)
