"""`imutool repair`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from imutool.cli._app import LOST, Json, Overwrite, Quiet, Verbose, app
from imutool.terminal import progress, say, tell_losses, write_json


class Damaged(StrEnum):
    """What becomes of bytes that are damaged."""

    drop = "drop"
    keep = "keep"


@app.command(
    epilog="Example: [bold]imutool repair crashed.mcap saved.mcap[/]. Exit code 0: the log was whole; 3: something is lost."
)
def repair(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A damaged MCAP log.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="The log with everything in it that is sound.")],
    damaged: Annotated[
        Damaged, typer.Option(help="Damaged stretches: drop them, or keep their bytes as attachments.")
    ] = Damaged.drop,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Save what is sound in a damaged log: cut short, overwritten, unfinished, joined; say what is lost."""
    from imutool.mcap_io.salvage import repair as run

    with progress("Repairing", verbose, quiet) as tell:
        report = run(
            source, target, damaged=damaged.value, overwrite=overwrite, progress=lambda done, total: tell(done, total, "")
        )
    result = {
        "schema": "imutool.repair/1",
        "output": str(target),
        "whole": report.whole,
        "messages": dict(report.messages),
        "chunks": report.chunks,
        "kept": report.kept,
        "losses": report.losses.plain(),
    }
    if not write_json(result, json_to):
        tell_losses(report.losses.plain())
        counts = ", ".join(f"{count} on {topic}" for topic, count in report.messages.items()) or "no message"
        state = "the log was whole" if report.whole else "saved"
        say(f"{target}: {state}, {counts}")
    if report.losses:
        raise typer.Exit(LOST)
