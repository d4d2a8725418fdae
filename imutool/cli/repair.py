"""`imutool repair`."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any

import typer

from imutool.cli.app import LOST, Json, MaxChunk, Overwrite, Quiet, Verbose, Written, app
from imutool.cli.terminal import progress, say, tell_losses, write_json
from imutool.report import UNSET, Report, UnsetType

REPAIRED = Written((".mcap", ".bag"))


class Damaged(StrEnum):
    """Treatment of damaged bytes."""

    drop = "drop"
    keep = "keep"


class Repair(Report, frozen=True, kw_only=True, tag="imutool.repair/1"):
    """Report of `imutool repair`; `kept` counts damaged stretches kept as attachments (MCAP)."""

    output: str
    whole: bool
    messages: dict[str, int]
    chunks: int
    kept: int | UnsetType = UNSET
    losses: dict[str, Any]


@app.command(
    epilog="Example: [bold]imutool repair crashed.mcap saved.mcap[/]. Exit code 0: the log was intact; 3: data are lost."
)
def repair(
    source: Annotated[str, typer.Argument(metavar="IN", help="A damaged MCAP log or ROS 1 bag: a file or a URL.")],
    target: Annotated[str, typer.Argument(metavar="OUT", help="New log with all intact messages."), REPAIRED],
    damaged: Annotated[
        Damaged, typer.Option(help="Damaged stretches: drop them, or keep their bytes as attachments (MCAP).")
    ] = Damaged.drop,
    max_chunk: MaxChunk = None,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Save the intact messages of a damaged log or ROS 1 bag, and report the losses.

    The log may be cut short, overwritten, unfinished, or joined from parts.
    """
    from imutool.api.cleaning import repair as run
    from imutool.bag.repair import BagReport

    with progress("Repairing", verbose, quiet) as tell:
        repaired = run(
            source,
            target,
            damaged=damaged.value,
            max_chunk=max_chunk,
            overwrite=overwrite,
            progress=lambda done, total: tell(done, total, ""),
        )
    report = Repair(
        output=target,
        whole=repaired.whole,
        messages=dict(repaired.messages),
        chunks=repaired.chunks,
        kept=UNSET if isinstance(repaired, BagReport) else repaired.kept,
        losses=repaired.plain() if isinstance(repaired, BagReport) else repaired.losses.plain(),
    )
    if not write_json(report, json_to, overwrite=overwrite):
        tell_losses(report.losses)
        counts = ", ".join(f"{count} on {topic}" for topic, count in report.messages.items()) or "no message"
        state = "the log was whole" if report.whole else "saved"
        say(f"{target}: {state}, {counts}")
    if report.losses["stretches"]:
        raise typer.Exit(LOST)
