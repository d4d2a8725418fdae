"""`imutool debias`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from imutool.bias_start import Fitness
from imutool.cli.app import COMMON, HTML, LOG, RRD, Common, Imus, Init, MaxChunk, Smooth, app
from imutool.cli.terminal import say, tell_losses
from imutool.errors import LOST, ConfigError
from imutool.file_location import Location, to_location
from imutool.mcap_io import Verified
from imutool.report import UNSET, Report, Section, UnsetType, json_values
from imutool.viewing import Output

if TYPE_CHECKING:
    from imutool.debiasing import DebiasReport
    from imutool.viewing.rerun.live import Live

MODEL_HELP = (
    "Model file, physics.toml or a name that ships; else a static estimate. TOPIC=MODEL sets the model of one IMU. Repeatable."
)
CONNECT_HELP = "Show the progress in a running viewer: HOST:PORT."
CLEAN_HELP = "Drop invalid samples and convert units, as imutool clean does."
REPORT_HELP = "Write an HTML page about the debiased log."
FORCE_HELP = "Use a model although it does not fit the log; a warning says why it does not."
ENCODING_HELP = "Encoding of the new IMU topic: that of its source, or CDR."
VERIFY_HELP = "Chunks of OUT to read back: all, those with IMU messages (imu), or none."


@app.command(epilog="Example: [bold]imutool debias MH_04.mcap MH_04_debiased.mcap --model adis.safetensors[/]")
def debias(
    source: Annotated[str, typer.Argument(metavar="IN", help="An MCAP log: a file, or a URL such as s3://bucket/log.mcap.")],
    target: Annotated[
        str | None,
        typer.Argument(metavar="OUT", help="New log with the debiased IMU next to the raw one.", show_default=False),
        LOG,
    ] = None,
    model: Annotated[list[str] | None, typer.Option(help=MODEL_HELP)] = None,
    imu: Imus = None,
    init: Init = "auto",
    smooth: Smooth = False,
    verify: Annotated[str, typer.Option(metavar="all|imu|none", help=VERIFY_HELP)] = "imu",
    in_place: Annotated[bool, typer.Option("--in-place", help="Replace IN with the complete result.")] = False,
    clean: Annotated[bool, typer.Option("--clean", help=CLEAN_HELP)] = False,
    encoding: Annotated[str, typer.Option(metavar="own|cdr", help=ENCODING_HELP)] = "own",
    view: Annotated[bool, typer.Option("--view", help="Show the progress in a new viewer.")] = False,
    connect: Annotated[str | None, typer.Option(metavar="URL", help=CONNECT_HELP)] = None,
    save_view: Annotated[Path | None, typer.Option(metavar="F.rrd", help="Save the viewer's data to a file."), RRD] = None,
    report_to: Annotated[Path | None, typer.Option("--report", metavar="F.html", help=REPORT_HELP), HTML] = None,
    max_chunk: MaxChunk = None,
    force: Annotated[bool, typer.Option("--force", help=FORCE_HELP)] = False,
    common: Common = COMMON,
) -> None:
    """Write a log with a debiased IMU topic; all other messages stay unchanged."""
    unused = save_view is None and report_to is None and common.json_to is None
    _refuse_contradictions(target, in_place, common.overwrite and unused)
    models = assigned(model or ())
    _require_matplotlib(report_to)
    from imutool.cleaning import CleaningSettings
    from imutool.debiasing import debias as run

    live = _watching(source, target, view, connect, save_view, common.overwrite)
    with common.progress("Debiasing") as tell, live as watch:
        report = run(
            to_location(source),
            None if target is None else to_location(target),
            model=models,
            imus=imu or (),
            init=init,
            smooth=smooth,
            check=verify,
            max_chunk=max_chunk,
            clean=CleaningSettings() if clean else None,
            force=force,
            overwrite=common.overwrite and not in_place,
            encoding=encoding,
            progress=lambda done, total: tell(done, total, ""),
            watch=watch,
        )
    summary = _summary(report, str(target or source), None if watch is None else watch.shown, report_to, clean)
    if not (json_only := common.write(summary)):
        _say(report, summary)
    if report_to is not None:  # last: should it fail, the log is there all the same, and that has been said
        with common.progress("Drawing"):
            _draw(to_location(target or source), report.fits, report_to, common.overwrite)
        if not json_only:
            say(f"Report: {report_to}")
    unsaved = save_view is not None and watch is not None and all(output.how != "rrd" for output in watch.shown)
    raise typer.Exit(LOST if report.lossy or unsaved else 0)


def _require_matplotlib(report_to: Path | None) -> None:
    """Refuse a report without matplotlib before the work."""
    if report_to is not None:
        from imutool.viewing.html.drawing import require_matplotlib

        require_matplotlib()


class StretchEntry(Section, frozen=True):
    """Beginning of a stretch of samples after a gap or a jump of the clock."""

    start_ns: int
    step_s: float


class DebiasedImu(Section, frozen=True):
    """Model and initial bias of an IMU (gyro rad/s, accel m/s²) with its standard deviation."""

    model: str
    init_how: str
    gyro_bias: list[float]
    accel_bias: list[float]
    std: list[float]
    fit: Fitness | UnsetType = UNSET  # of the model; older reports have none
    left_out: dict[str, int] | UnsetType = UNSET  # samples that are no measurement, by reason
    stretches: list[StretchEntry] | UnsetType = UNSET  # each but the first: gaps and jumps of the clock


class DebiasSummary(Report, frozen=True, kw_only=True, tag="imutool.debias/1"):
    """Report of `imutool debias`; `shown`, `report` and `clean` only if requested."""

    output: str
    imus: dict[str, DebiasedImu]
    copied: int
    added: dict[str, int]
    verified: Verified
    losses: dict[str, Any]
    shown: list[Output] | UnsetType = UNSET
    report: str | UnsetType = UNSET
    clean: list[dict[str, Any]] | UnsetType = UNSET


def _summary(
    report: DebiasReport, output: str, shown: Sequence[Output] | None, page: Path | None, clean: bool
) -> DebiasSummary:
    imus = {
        topic: DebiasedImu(
            report.models[topic],
            start.how,
            start.rest[:3].tolist(),
            start.rest[3:].tolist(),
            start.std.tolist(),
            report.fits[topic],
            report.sieves[topic].left_out or UNSET,
            [StretchEntry(*stretch) for stretch in report.sieves[topic].clock.stretches] or UNSET,
        )
        for topic, start in report.starts.items()
    }
    return DebiasSummary(
        output=output,
        imus=imus,
        copied=report.rewrite.copied,
        added=dict(report.rewrite.added),
        verified=report.rewrite.verified,
        losses=report.losses.plain(),
        shown=UNSET if shown is None else list(shown),
        report=UNSET if page is None else str(page),
        clean=[json_values(survey.report()) for survey in report.surveys.values()] if clean else UNSET,
    )


def _say(report: DebiasReport, summary: DebiasSummary) -> None:
    """Print starts, counts and verification."""
    for topic, survey in report.surveys.items():
        say(f"{topic}: {survey.verdict}, score {survey.score:.3f}, {survey.valid} of {survey.messages} samples valid")
    for topic, imu in summary.imus.items():
        gyro = ", ".join(f"{b:+.5f}" for b in imu.gyro_bias)
        accel = ", ".join(f"{b:+.4f}" for b in imu.accel_bias)
        say(f"{topic}: {imu.model}, initial bias {gyro} rad/s; {accel} m/s² ({imu.init_how})")
        say(f"{topic}: {report.fits[topic].sentence('the model')}")
    counts = ", ".join(f"{count} on {name}" for name, count in summary.added.items())
    say(f"{summary.output}: {summary.copied} messages copied, {counts}")
    verified = summary.verified
    chunks = f"{verified.chunks_checked} of {verified.chunks} chunks"
    say(f"checked: every index, and the contents of {chunks} (--verify {verified.mode})")
    for output in summary.shown if isinstance(summary.shown, list) else ():
        say(output.said)
    tell_losses(summary.losses)


def _watching(
    source: str, target: str | None, view: bool, connect: str | None, save: Path | None, overwrite: bool
) -> AbstractContextManager[Live | None]:
    """Live view of the debiasing; without one no viewer module is imported."""
    if not view and connect is None and save is None:
        return nullcontext()
    from imutool.viewing.rerun.live import live_view

    out = Path(target or source)
    return live_view(out.stem, connect_to=connect, save=save, instead=Path(f"{out.stem}.rrd"), overwrite=overwrite)


def _draw(log: Location, fits: Mapping[str, Fitness], page: Path, overwrite: bool) -> None:
    """Write a page about the debiased log; of several IMUs each has its topic as name."""
    from imutool.viewing.html.report import name_by_topic, write_page
    from imutool.viewing.model.load_view import load

    shown = [load(log, imu=topic) for topic in fits]
    shown = [replace(run, notes=(*run.notes, fit.sentence("The model"))) for run, fit in zip(shown, fits.values(), strict=True)]
    write_page(name_by_topic(shown, list(fits)), page, overwrite=overwrite)


def _refuse_contradictions(target: str | None, in_place: bool, overwrite: bool) -> None:
    if in_place and target is not None:
        raise ConfigError(f"--in-place and {target} exclude each other", where="--in-place", fix="Leave one of the two out")
    if in_place and overwrite:
        raise ConfigError(
            "--in-place and --overwrite exclude each other",
            where="--in-place",
            fix="Leave --overwrite out: IN alone is replaced",
        )
    if target is None and not in_place:
        raise ConfigError(
            "OUT is missing", where="debias", expected="a name for the new log", fix="Give OUT, or --in-place to replace IN"
        )


def assigned(words: Sequence[str]) -> dict[str, str]:
    """Models by IMU topic; the key "" holds the model of all other IMUs.

    A word is TOPIC=MODEL, or MODEL if a file has the whole word as its name.

    Raises:
        ConfigError: two models for the same IMUs, or nothing on one side of the sign.
    """
    models: dict[str, str] = {}
    for word in words:
        topic, sign, name = word.partition("=")
        if not sign or Path(word).exists():
            topic, name = "", word
        elif not topic or not name:
            raise ConfigError(f"{word!r} has nothing on one side of =", where="--model", expected="MODEL or TOPIC=MODEL")
        if topic in models:
            whom = topic or "all IMUs"
            raise ConfigError(
                f"{models[topic]} and {name} are both given for {whom}", where="--model", expected="one model for each IMU"
            )
        models[topic] = name
    return models
