"""`imutool repair`."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any

import typer

from imutool.cli.app import LOST, Json, MaxChunk, Overwrite, Quiet, Verbose, Written, app
from imutool.cli.terminal import progress, say, tell_losses, write_json
from imutool.errors import ConfigError
from imutool.location import to_location
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
    from imutool.bag.repair import NO_ATTACHMENTS, is_bag, repair_bag
    from imutool.mcap_io.repair import repair as repair_log

    log_in, log_out = to_location(source), to_location(target)
    with progress("Repairing", verbose, quiet) as tell:
        if is_bag(log_in):
            if damaged is Damaged.keep:
                raise ConfigError(NO_ATTACHMENTS, where="damaged=keep", fix="Leave `damaged` out")
            bag = repair_bag(log_in, log_out, overwrite=overwrite, progress=lambda done, total: tell(done, total, ""))
            report = Repair(output=target, whole=bag.whole, messages=dict(bag.messages), chunks=bag.chunks, losses=bag.plain())
        else:
            log = repair_log(
                log_in,
                log_out,
                damaged=damaged.value,
                max_chunk=max_chunk,
                overwrite=overwrite,
                progress=lambda done, total: tell(done, total, ""),
            )
            report = Repair(
                output=target,
                whole=log.whole,
                messages=dict(log.messages),
                chunks=log.chunks,
                kept=log.kept,
                losses=log.losses.plain(),
            )
    if not write_json(report, json_to, overwrite=overwrite):
        tell_losses(report.losses)
        counts = ", ".join(f"{count} on {topic}" for topic, count in report.messages.items()) or "no message"
        state = "the log was whole" if report.whole else "saved"
        say(f"{target}: {state}, {counts}")
    if report.losses["stretches"]:
        raise typer.Exit(LOST)
