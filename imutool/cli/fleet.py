"""`imutool fleet`."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from math import inf
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from imutool.cli.app import COMMON, App, Common, Init, Smooth, Truth, Written, app, expanded, with_options
from imutool.cli.debias import FORCE_HELP, VERIFY_HELP
from imutool.cli.parameters import Group, with_flags
from imutool.cli.terminal import say
from imutool.errors import ConfigError
from imutool.fleet.task import Settings
from imutool.mcap_io.storage import output_conflicts

if TYPE_CHECKING:
    from imutool.fleet.run import FleetReport

fleet = App(
    name="fleet",
    help="Process many logs on all cores of this machine, or on a Ray cluster.",
    cls=Group,
    no_args_is_help=True,
    rich_markup_mode="rich",
)
app.add_typer(fleet)

FOLDER, PAGE = Written(files=(), keeps=True), Written(output_conflicts.HTML, keeps=True)  # the journal says whose the files are
UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
SHOWN = 10  # logs that are not whole; all are in fleet.parquet
PAGES_HELP = "Also write a page for each log, with a link from --report; it takes 5 to 10 s for a log of minutes."
TIME_LIMIT_HELP = "Longest time for one log; then it fails, and the others go on. Without --address."
RESUME = "Continue an earlier run: skip finished logs."
Imus = Annotated[
    list[str] | None,
    typer.Option("--imu", help="IMU topic, where logs have several. Repeatable: each log uses those of them that it has."),
]
CODES = "\n\nExit code: 0 all logs are intact; 3 data were lost or quarantined; else the largest code of the failed logs."


def _run(
    settings: Settings,
    source: Annotated[str, typer.Argument(metavar="SRC", help="A folder, pattern, log or URL.")],
    target: Annotated[str, typer.Argument(metavar="OUT", help="Folder or URL; every log keeps its path below SRC."), FOLDER],
    *,
    address: Annotated[
        str | None, typer.Option(help="Address of a Ray cluster, or auto; by default processes of this machine.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help=RESUME)] = False,
    recheck: Annotated[bool, typer.Option("--recheck", help="With --resume: read all finished results again.")] = False,
    report: Annotated[str | None, typer.Option(metavar="F.html", help="Write an HTML page about the fleet."), PAGE] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Number of logs at once; by default one per core.")] = None,
    memory: Annotated[str, typer.Option("--memory-per-task", metavar="SIZE", help="Memory for each log: 800M, 2G.")] = "1G",
    retries: Annotated[int, typer.Option(min=0, help="Number of retries after a worker died.")] = 3,
    time_limit: Annotated[float, typer.Option(min=1.0, metavar="SECONDS", help=TIME_LIMIT_HELP, show_default=False)] = inf,
    common: Common = COMMON,
) -> None:
    """Run a command; its parameters but the settings are options of every fleet command."""
    from imutool.file_location import to_location
    from imutool.fleet.engine import ProcessEngine, RayEngine
    from imutool.fleet.run import run

    limits: dict[str, Any] = {"workers": workers, "memory_bytes": memory_bytes(memory), "retries": retries}
    if time_limit < inf and address is not None:
        raise ConfigError("a cluster's workers have no time limit", where="--time-limit", fix="Leave out --address, or this")
    page = None if report is None else to_location(report)
    with common.progress(f"Fleet {settings.command}") as tell:
        done = run(
            source,
            target,
            settings,
            lambda: ProcessEngine(**limits, limit_s=time_limit) if address is None else RayEngine(address, **limits),
            resume=resume,
            overwrite=common.overwrite,
            recheck=recheck,
            page=page,
            json_to=None if common.json_to in (None, "-") else to_location(common.json_to),
            tell=tell,
            wording=with_flags,
        )
    if common.json_to != "-":
        _show(done, target, report if done.page_error is None else None)
    common.write(done.summary(), replace=resume)
    if done.page_error is not None:
        raise done.page_error
    raise typer.Exit(done.progress.exit_code)


def _command(example: str) -> Callable[[Callable[..., Settings]], Callable[..., Settings]]:
    """Decorator that makes a fleet command of a function from its own options to settings."""

    def made(settings_of: Callable[..., Settings]) -> Callable[..., Settings]:
        run, own = (inspect.signature(f, eval_str=True).parameters for f in (expanded(_run), settings_of))

        def command(**words: Any) -> None:
            expanded(_run)(settings=settings_of(**{name: words.pop(name) for name in own}), **words)

        options = [run["source"], run["target"], *own.values(), *list(run.values())[3:]]
        fleet.command(epilog=f"Example: [bold]imutool fleet {example}[/]{CODES}")(with_options(command, options, settings_of))
        return settings_of

    return made


@_command("debias logs/ clean/ --model euroc-adis16448-hybrid --report clean.html")
def debias(
    model: Annotated[
        str | None, typer.Option(help="Model file, physics.toml or a name that ships; by default from the log's metadata.")
    ] = None,
    init: Init = "auto",
    smooth: Smooth = False,
    force: Annotated[bool, typer.Option("--force", help=FORCE_HELP)] = False,
    clean: Annotated[bool, typer.Option(help="Also clean the IMU; skip logs that cannot be trusted.")] = True,
    verify: Annotated[str, typer.Option(metavar="all|imu|none", help=VERIFY_HELP)] = "imu",
    pages: Annotated[bool, typer.Option("--pages", help=PAGES_HELP)] = False,
    imu: Imus = None,
) -> Settings:
    """Debias every log, as `imutool debias --clean` does."""
    from imutool.bias_start.model_choice import check_start
    from imutool.fleet.task import with_model_hash
    from imutool.mcap_io.verify import check_mode

    check_start(init, smooth)
    check_mode(verify)
    if pages:
        from imutool.viewing.html.drawing import require_matplotlib

        require_matplotlib("pages")
    start = {"init": init, "smooth": smooth, "force": force}
    settings = Settings(command="debias", model=model, **start, clean=clean, check=verify, pages=pages, imu=_one_or_more(imu))  # type: ignore[arg-type]
    return with_model_hash(settings)


@_command("repair logs/ repaired/ --report repaired.html")
def repair(
    damaged: Annotated[
        Literal["drop", "keep"], typer.Option(help="Drop damaged bytes, or keep them as attachments (MCAP).")
    ] = "drop",
) -> Settings:
    """Repair every log and ROS 1 bag, as `imutool repair` does; copy intact ones."""
    return Settings(command="repair", damaged=damaged)


@_command("info logs/ about/ --report logs.html")
def info() -> Settings:
    """Report the contents of every log, as `imutool info --json` does."""
    return Settings(command="info")


@_command("diagnose logs/ diagnosis/ --robot-from '^([^/]+)/' --report robots.html")
def diagnose(
    sim: Annotated[
        str | None, typer.Option(metavar="DIR", help="Folder of simulations with the logs' names; by default the true poses.")
    ] = None,
    robot_from: Annotated[
        str | None,
        typer.Option(
            "--robot-from",
            metavar="PATTERN",
            help="Regular expression on names, or metadata:RECORD.KEY; by default the folder.",
        ),
    ] = None,
    search: Annotated[bool, typer.Option(help="Also search each log for other physics.")] = True,
    imu: Imus = None,
    truth: Truth = None,
) -> Settings:
    """Compare one kind of sensor on many robots: shared parameters and outliers."""
    from pathlib import Path

    from imutool.file_location import absolute, to_location
    from imutool.fleet.robots import robot_pattern

    robot_pattern(robot_from)
    place = None if sim is None else to_location(sim)
    where = absolute(place) if isinstance(place, Path) else place
    return Settings(
        command="diagnose",
        sim=None if where is None else str(where),
        robot_from=robot_from,
        quick=not search,
        imu=_one_or_more(imu),
        truth=truth,
    )


def _one_or_more(imus: list[str] | None) -> str | tuple[str, ...] | None:
    return None if not imus else imus[0] if len(imus) == 1 else tuple(imus)


def _show(done: FleetReport, target: str, report: str | None) -> None:
    for result in done.not_whole[:SHOWN]:
        why = result.error or "; ".join(result.losses) or "; ".join(result.warnings)
        why = why if result.source in why else f"{result.source}: {why}"
        say(with_flags(why), result.earlier or result.status)
    if len(done.not_whole) > SHOWN:
        say("and more")
    if done.comparison is not None:
        say(done.comparison.summary)
        for outlier in done.comparison.outliers:
            say(outlier.sentence)
    made = [f"{target.rstrip('/')}/fleet.parquet", *([report] if report else [])]
    say(f"{done.progress.line()}; {', '.join(made)}")


def memory_bytes(text: str) -> int:
    """Number of bytes in a size such as `800M`, `2G` or `2GiB`.

    Raises:
        ConfigError: no such size.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)(?:i?B)?", text.strip(), re.IGNORECASE)
    if match is None:
        raise ConfigError(f"{text!r} is not a size", where="memory_bytes", expected="bytes, or a number with K, M, G or T")
    return int(float(match[1]) * UNITS[match[2].upper()])
