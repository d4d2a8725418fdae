"""Defects of a log: `imutool clean` of its IMU, `imutool repair` of its bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from imutool.cli.app import COMMON, HTML, LOG, Common, Imus, Init, MaxChunk, Smooth, Written, app, listing
from imutool.cli.terminal import out, plain, say, table, tell_losses
from imutool.errors import LOST
from imutool.file_location import to_location
from imutool.report import UNSET, Report, UnsetType

if TYPE_CHECKING:
    from imutool.cleaning import Survey
    from imutool.mcap_io.recovery.losses import Losses

COLORS = {"good": "green", "usable": "yellow", "quarantine": "red"}


@app.command(cls=listing("imutool.clean", "--rule"), epilog="Example: [bold]imutool clean robot.mcap robot_clean.mcap[/]")
def clean(
    source: Annotated[str, typer.Argument(metavar="LOG", help="An MCAP log: a file, or a URL such as s3://bucket/log.mcap.")],
    target: Annotated[str | None, typer.Argument(metavar="OUT", help="New log with a clean, debiased IMU topic."), LOG] = None,
    model: Annotated[str | None, typer.Option(help="For OUT: model file, physics.toml or a name that ships.")] = None,
    imu: Imus = None,
    rule: Annotated[list[str] | None, typer.Option("--rule", metavar="NAME", help="Run only this rule. Repeatable.")] = None,
    no_rule: Annotated[list[str] | None, typer.Option("--no-rule", metavar="NAME", help="Skip this rule. Repeatable.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Write OUT even if the log cannot be trusted.")] = False,
    fix: Annotated[bool, typer.Option("--fix", help="In OUT, correct axes that the motion contradicts.")] = False,
    report_to: Annotated[
        Path | None, typer.Option("--report", metavar="F.html", help="Write the findings as an HTML page."), HTML
    ] = None,
    init: Init = "auto",
    smooth: Smooth = False,
    max_chunk: MaxChunk = None,
    common: Common = COMMON,
) -> None:
    """Find the defects of a log's IMU, and say whether the log can be trusted.

    With OUT, write the log with a clean IMU next to the raw one.
    """
    from imutool.cleaning.rule import chosen

    rules = chosen(rule or (), no_rule or (), force, fix)
    if target is None:
        from imutool.api.cleaning import refuse_without_target, survey_imus

        replaces = common.overwrite and report_to is None and common.json_to is None
        refuse_without_target(model=model, init=init != "auto", smooth=smooth, force=force, fix=fix, overwrite=replaces)
        with common.progress("Looking through") as tell:
            found = survey_imus(source, imu or (), rules, max_chunk, tell)
        surveys, added, losses = list(found.surveys), found.added, found.losses
    else:
        from imutool.debiasing import debias

        with common.progress("Cleaning") as tell:
            report = debias(
                to_location(source),
                to_location(target),
                model=model,
                imus=imu or (),
                init=init,
                smooth=smooth,
                overwrite=common.overwrite,
                clean=rules,
                force=force,
                max_chunk=max_chunk,
                progress=lambda done, total: tell(done, total, ""),
            )
        surveys, added, losses = list(report.surveys.values()), dict(report.rewrite.added), report.losses
    if report_to is not None:
        from imutool.viewing.html import cleaning_page

        cleaning_page.write(surveys, report_to, overwrite=common.overwrite)
    _tell(source, surveys, losses, target, added, common)


def _tell(
    source: str,
    surveys: Sequence[Survey],
    losses: Losses,
    target: str | None,
    added: Mapping[str, int],
    common: Common,
) -> None:
    """Report findings and output as JSON or text; with losses the exit code is 3."""
    from imutool.cleaning.survey import CleaningReport

    report = CleaningReport(
        log=source,
        imus=[survey.report() for survey in surveys],
        losses=losses.plain(),
        output=UNSET if target is None else target,
        added=UNSET if target is None else dict(added),
    )
    if not common.write(report):
        for survey in surveys:
            show(survey)
        if target is not None:
            say(f"{target}: {', '.join(f'{count} on {name}' for name, count in added.items())}")
        tell_losses(losses.plain())
    if losses:
        raise typer.Exit(LOST)


def show(survey: Survey) -> None:
    """Print verdict, score and findings of one IMU."""
    counts = f"{survey.valid} of {survey.messages} samples valid, {survey.missing} missing"
    color = COLORS[survey.verdict]
    line = f"{plain(survey.topic)}: [bold {color}]{survey.verdict}[/], score {survey.score:.3f}, {counts}"
    out.print(line, highlight=False, soft_wrap=True)
    if survey.findings:
        head = "rule", "count", "what was found", "done", "when s"
        found = [(f.rule, str(f.count), f.what, f.action, f.when(survey.start_ns)) for f in survey.findings]
        table([head, *found], keys=1)
    for reason in survey.reasons:
        say(reason, "not to be trusted", "red")


REPAIRED = Written((".mcap", ".bag"))


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
        Literal["drop", "keep"], typer.Option(help="Drop damaged bytes, or keep them as attachments (MCAP).")
    ] = "drop",
    max_chunk: MaxChunk = None,
    common: Common = COMMON,
) -> None:
    """Save the intact messages of a damaged log or ROS 1 bag, and report the losses.

    The log may be cut short, overwritten, unfinished, or joined from parts.
    """
    from imutool.api.cleaning import repair as run
    from imutool.bag.repair import BagReport

    with common.progress("Repairing") as tell:
        repaired = run(
            source,
            target,
            damaged=damaged,
            max_chunk=max_chunk,
            overwrite=common.overwrite,
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
    if not common.write(report):
        tell_losses(report.losses)
        counts = ", ".join(f"{count} on {topic}" for topic, count in report.messages.items()) or "no message"
        state = "the log was whole" if report.whole else "saved"
        say(f"{target}: {state}, {counts}")
    if report.losses["stretches"]:
        raise typer.Exit(LOST)
