"""`imutool debias`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from imutool.cli.app import LOST, Init, Json, Overwrite, Quiet, Smooth, Verbose, app
from imutool.cli.terminal import progress, say, tell_losses, write_json
from imutool.errors import ConfigError
from imutool.location import Location, to_location

if TYPE_CHECKING:
    from imutool.debiasing import DebiasReport
    from imutool.viewing.model.output import Output
    from imutool.viewing.rerun.live import Live

MODEL_HELP = (
    "Model file, physics.toml or a name that ships; else a static estimate. TOPIC=MODEL is for one IMU of several. Repeatable."
)
CLEAN_HELP = "Leave out what is no measurement, convert units (imutool clean)."
VERIFY_HELP = "What of OUT is checked beside its structure: all chunks, those with IMU messages (imu), or none."


@app.command(epilog="Example: [bold]imutool debias MH_04.mcap MH_04_debiased.mcap --model adis.safetensors[/]")
def debias(
    source: Annotated[str, typer.Argument(metavar="IN", help="An MCAP log: a file, or a URL such as s3://bucket/log.mcap.")],
    target: Annotated[
        str | None,
        typer.Argument(metavar="OUT", help="The log with the debiased IMU beside the raw one.", show_default=False),
    ] = None,
    model: Annotated[list[str] | None, typer.Option(help=MODEL_HELP)] = None,
    imu: Annotated[list[str] | None, typer.Option(help="IMU topic, where a log has several. Repeatable.")] = None,
    init: Init = "auto",
    smooth: Smooth = False,
    verify: Annotated[str, typer.Option(metavar="all|imu|none", help=VERIFY_HELP)] = "imu",
    in_place: Annotated[bool, typer.Option("--in-place", help="Put the result in the place of IN, when it is whole.")] = False,
    clean: Annotated[bool, typer.Option("--clean", help=CLEAN_HELP)] = False,
    view: Annotated[bool, typer.Option("--view", help="Show it in a viewer as it goes.")] = False,
    connect: Annotated[str | None, typer.Option(metavar="URL", help="Show it in a viewer that runs: HOST:PORT.")] = None,
    save_view: Annotated[Path | None, typer.Option(metavar="F.rrd", help="Keep what a viewer would show in a file.")] = None,
    report_to: Annotated[
        Path | None, typer.Option("--report", metavar="F.html", help="Write a page about the debiased log.")
    ] = None,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Rewrite a log with a debiased IMU channel; everything else passes through unchanged."""
    _refuse_contradictions(target, in_place, overwrite)
    models = assigned(model or ())
    if report_to is not None:
        from imutool.viewing.html import report as pages

        pages.check_target(report_to, overwrite=overwrite)
    from imutool.cleaning import Rules
    from imutool.debiasing import debias as run

    live = _watching(source, target, view, connect, save_view, overwrite)
    with progress("Debiasing", verbose, quiet) as tell, live as watch:
        report = run(
            to_location(source),
            None if target is None else to_location(target),
            model=models,
            imus=imu or (),
            init=init,
            smooth=smooth,
            check=verify,
            clean=Rules() if clean else None,
            overwrite=overwrite,
            progress=lambda done, total: tell(done, total, ""),
            watch=watch,
        )
    output, shown = str(target or source), None if watch is None else watch.shown
    result = _result(report, output, shown, report_to, clean)
    told = write_json(result, json_to)
    if not told:
        _say(report, output, result["imus"], verify, shown or ())
    if report_to is not None:  # last: should it fail, the log is there all the same, and that has been said
        with progress("Drawing", verbose, quiet):
            _draw(to_location(target or source), list(report.starts), report_to, overwrite)
        if not told:
            say(f"Report: {report_to}")
    raise typer.Exit(LOST if report.losses else 0)


def _result(
    report: DebiasReport, output: str, shown: Sequence[Output] | None, page: Path | None, clean: bool
) -> dict[str, Any]:
    """What was done, for programs."""
    imus = {
        topic: {
            "model": report.models[topic],
            "init_how": start.how,
            "gyro_bias": start.rest[:3].tolist(),
            "accel_bias": start.rest[3:].tolist(),
            "std": start.std.tolist(),
        }
        for topic, start in report.starts.items()
    }
    result = {
        "schema": "imutool.debias/1",
        "output": output,
        "imus": imus,
        "copied": report.rewrite.copied,
        "added": dict(report.rewrite.added),
        "verified": report.rewrite.verified._asdict(),
        "losses": report.losses.plain(),
    }
    if shown is not None:
        result["shown"] = [one.plain() for one in shown]
    if page is not None:
        result["report"] = str(page)
    if clean:
        result["clean"] = [one.plain() for one in report.surveys.values()]
    return result


def _say(
    report: DebiasReport, target: str, imus: Mapping[str, Mapping[str, Any]], verify: str, shown: Sequence[Output]
) -> None:
    """What was done, in lines."""
    for topic, one in report.surveys.items():
        say(f"{topic}: {one.verdict}, score {one.score:.3f}, {one.valid} of {one.messages} samples valid")
    for topic, entry in imus.items():
        bias = ", ".join(f"{b:+.5f}" for b in entry["gyro_bias"]), ", ".join(f"{b:+.4f}" for b in entry["accel_bias"])
        start = f"start bias {bias[0]} rad/s; {bias[1]} m/s² ({entry['init_how']})"
        say(f"{topic}: {entry['model']}, {start}")
    counts = ", ".join(f"{count} on {name}" for name, count in report.rewrite.added.items())
    say(f"{target}: {report.rewrite.copied} messages as they were, {counts}")
    verified = report.rewrite.verified
    say(f"checked: every index, and the contents of {verified.chunks_checked} of {verified.chunks} chunks (--verify {verify})")
    for way in shown:
        say(way.said)
    tell_losses(report.losses.plain())


def _watching(
    source: str, target: str | None, view: bool, connect: str | None, save: Path | None, overwrite: bool
) -> AbstractContextManager[Live | None]:
    """Whoever is to watch; without that nothing of the viewer is imported."""
    if not view and connect is None and save is None:
        return nullcontext()
    from imutool.viewing.rerun.live import live_view

    out = Path(target or source)
    return live_view(out.stem, connect_to=connect, save=save, instead=Path(f"{out.stem}.rrd"), overwrite=overwrite)


def _draw(log: Location, topics: Sequence[str], page: Path, overwrite: bool) -> None:
    """A page about the debiased log, each of its IMUs under its own topic where there are several."""
    from imutool.viewing.html.report import name_by_topic, write_page
    from imutool.viewing.model.runs import load

    write_page(name_by_topic([load(log, imu=topic) for topic in topics], topics), page, overwrite=overwrite)


def _refuse_contradictions(target: str | None, in_place: bool, overwrite: bool) -> None:
    if in_place and target is not None:
        raise ConfigError(f"--in-place and {target}", where="--in-place", fix="Leave one of the two out")
    if in_place and overwrite:
        raise ConfigError("--in-place and --overwrite", where="--in-place", fix="Leave --overwrite out: IN alone is replaced")
    if target is None and not in_place:
        raise ConfigError(
            "no OUT", where="debias", expected="a name for the new log", fix="Give OUT, or --in-place to replace IN"
        )


def assigned(words: Sequence[str]) -> dict[str, str]:
    """Models by IMU topic, "" for all that are not named: TOPIC=MODEL, where no file has that name as a whole, else MODEL.

    Raises:
        ConfigError: two models for the same IMUs, or nothing on one side of the sign.
    """
    found: dict[str, str] = {}
    for word in words:
        topic, sign, name = word.partition("=")
        if not sign or Path(word).exists():
            topic, name = "", word
        elif not topic or not name:
            raise ConfigError(f"{word!r}", where="--model", expected="MODEL or TOPIC=MODEL")
        if topic in found:
            whom = topic or "all IMUs"
            raise ConfigError(f"{found[topic]} and {name} for {whom}", where="--model", expected="one model for each IMU")
        found[topic] = name
    return found
