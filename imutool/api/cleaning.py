"""Find and remove defects of a log's IMU; save the sound part of a damaged log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from imutool.api import Init, checked, init_text
from imutool.bag.repair import NO_ATTACHMENTS, BagReport, is_bag, repair_bag
from imutool.cleaning import CleaningSettings, Survey, look
from imutool.cleaning.rule import chosen
from imutool.errors import ConfigError
from imutool.file_location import LogPath, location, several
from imutool.mcap_io.recovery.losses import Losses
from imutool.mcap_io.recovery.recovered_log import RecoveredLog
from imutool.mcap_io.repair import RepairReport
from imutool.mcap_io.repair import repair as repair_log
from imutool.mcap_io.storage import output_conflicts
from imutool.mcap_io.storage.output_conflicts import OutputFile, check_outputs
from imutool.report import NamedProgress, Progress, silent


@dataclass(frozen=True)
class CleanReport:
    """Defects of a log's IMUs, and the samples written, if any.

    Attributes:
        surveys: One survey per IMU: `topic`, `verdict`, `score`, `findings`, `reasons`.
        losses: Stretches that a damaged log lost.
        added: Messages written, by topic; empty without `target`.
    """

    surveys: tuple[Survey, ...]
    losses: Losses
    added: dict[str, int]


@checked
def clean(
    source: LogPath,
    target: LogPath | None = None,
    *,
    model: str | Path | None = None,
    imus: str | Sequence[str] = (),
    rules: str | Sequence[str] = (),
    skip_rules: str | Sequence[str] = (),
    force: bool = False,
    fix: bool = False,
    init: Init = "auto",
    smooth: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> CleanReport:
    """Find defects in a log's IMU; with `target`, write the log with a clean, debiased IMU.

    Args:
        source: MCAP log: a file or a URL.
        target: Log to write; without one, the function only reports.
        model: Bias model for `target`, as in `debias`.
        imus: IMU topics; by default all, and with `target` the only one.
        rules: Rules to apply; by default all (`imutool clean --help` lists them).
        skip_rules: Rules to leave out.
        force: Write `target` even from a log with the verdict `quarantine`.
        fix: Correct also the axes that the motion shows to be wrong, in `target`.
        init: Initial bias for `target`, as in `debias`.
        smooth: Smoothing for `target`, as in `debias`.
        overwrite: Replace an existing `target`.
        progress: Callback with bytes done and bytes in all.

    Raises:
        ConfigError: The log cannot be opened, a rule is unknown, an option needs `target`, or `target` exists.
        LogError: No such IMU, or the log is not trusted and `force` is false.

    Examples:
        >>> import imutool
        >>> report = imutool.clean("flight_1.mcap")
        >>> report.surveys[0].verdict
        'good'
    """
    wanted, start = chosen(several(rules), several(skip_rules), force, fix), init_text(init)
    if target is None:
        refuse_without_target(model=model, init=start != "auto", smooth=smooth, force=force, fix=fix, overwrite=overwrite)
        return survey_imus(source, several(imus), wanted)
    from imutool.debiasing import debias

    check_outputs([OutputFile("target", target, output_conflicts.LOG)], [source, model], overwrite=overwrite)
    run = partial(debias, location(source), location(target), model=model, imus=several(imus), init=start, smooth=smooth)
    report = run(clean=wanted, force=force, overwrite=overwrite, progress=progress or silent)
    return CleanReport(tuple(report.surveys.values()), report.losses, dict(report.rewrite.added))


def refuse_without_target(**options: object) -> None:
    """Refuse options of a new log, by name, that are given without one."""
    if idle := [name for name, given in options.items() if given]:
        raise ConfigError(f"`{idle[0]}` needs `target`", where="clean", fix="Name the log to be written")


def survey_imus(
    source: LogPath,
    imus: Sequence[str],
    rules: CleaningSettings,
    max_chunk: int | None = None,
    tell: NamedProgress = silent,
) -> CleanReport:
    """Survey of each IMU of a log, and the losses of a damaged log."""
    with RecoveredLog(location(source), max_chunk=max_chunk) as log:
        topics = list(imus) or log.imu_topics
        if not topics:
            raise log.no_imu()
        surveys = []
        for done, topic in enumerate(topics):
            tell(done, len(topics), topic)
            surveys.append(look(log, topic, rules))
        return CleanReport(tuple(surveys), log.losses, {})


@checked
def repair(
    source: LogPath,
    target: LogPath,
    *,
    damaged: str = "drop",
    max_chunk: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> RepairReport | BagReport:
    """Save the sound part of a damaged MCAP log or ROS 1 bag, with new indexes.

    Args:
        source: Damaged log or bag: a file or a URL.
        target: File or URL to write.
        damaged: `drop` damaged bytes, or `keep` them as attachments (MCAP only).
        max_chunk: Largest chunk in bytes, packed or unpacked, to read into memory (256 MiB).
        overwrite: Replace an existing `target`.
        progress: Callback with bytes done and bytes in all.

    Returns:
        `whole` (no damage found), `messages` saved by topic, and `losses`.

    Raises:
        ConfigError: A file cannot be opened, `target` exists or is `source`, or `damaged` is unknown.
        LogError: Not a log, or no part of it is sound.

    Examples:
        >>> import imutool
        >>> report = imutool.repair("cut_short.mcap", "saved.mcap")
        >>> report.whole, report.messages["/imu0"] > 0
        (False, True)
    """
    check_outputs([OutputFile("target", target, (*output_conflicts.LOG, ".bag"))], [source], overwrite=overwrite)
    origin, destination, tell = location(source), location(target), progress or silent
    if not is_bag(origin):
        return repair_log(origin, destination, damaged=damaged, max_chunk=max_chunk, overwrite=overwrite, progress=tell)
    if damaged != "drop":
        raise ConfigError(NO_ATTACHMENTS, where="damaged=keep", fix="Leave `damaged` out")
    return repair_bag(origin, destination, overwrite=overwrite, progress=tell)
