"""The command line: parse, call, print. Results go to stdout; log lines and progress to stderr; one place catches."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from imutool import __version__, registry
from imutool.errors import ConfigError, ImutoolError

if TYPE_CHECKING:
    from imutool.train.fit import Epoch

USAGE, INTERRUPTED = 2, 130

app = typer.Typer(
    name="imutool",
    help="Raw inertial data to MCAP, learned IMU bias dynamics, debiased logs, and a picture of what changed.",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    add_completion=False,
)
out, err = Console(), Console(stderr=True)

Logs = Annotated[list[Path], typer.Argument(help="MCAP logs.")]
Models = Annotated[list[str] | None, typer.Option("--model", help="Model file, a name that ships, or 'static'. Repeatable.")]
Init = Annotated[str, typer.Option(help="Start bias: auto, stationary, prior, truth, or gx,gy,gz,ax,ay,az (rad/s, m/s²).")]
Imu = Annotated[str | None, typer.Option(help="IMU topic, where a log has several.")]
Truth = Annotated[str | None, typer.Option(help="Topic of the true poses, where a log has several.")]
Json = Annotated[str | None, typer.Option("--json", metavar="FILE|-", help="Write the report as JSON; - is stdout.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")]
Verbose = Annotated[bool, typer.Option("-v", "--verbose", help="Say more.")]
Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Say only results and errors.")]


class Compression(StrEnum):
    """How chunks of a log are packed."""

    zstd = "zstd"
    lz4 = "lz4"
    none = "none"


def main() -> None:
    """Entry point of the `imutool` command: runs it and turns what went wrong into a sentence and an exit code."""
    try:
        app()
    except ImutoolError as error:
        _fail(str(error), error.exit_code)
    except KeyboardInterrupt:
        _fail("interrupted; nothing half-written is left", INTERRUPTED)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _fail(f"{place}{error.strerror or error}. Choose another place or make room.", ConfigError.exit_code)


def _fail(message: str, code: int) -> NoReturn:
    err.print(f"[bold red]error:[/] {_plain(message)}", highlight=False, soft_wrap=True)
    sys.exit(code)


def _plain(text: str) -> str:
    """Text from logs and files as it is: no markup, no control characters that a terminal would obey."""
    shown = "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)
    return shown.replace("[", r"\[")


@app.command(epilog="Example: [bold]imutool convert MH_04_difficult.zip MH_04.mcap[/]")
def convert(
    source: Annotated[Path, typer.Argument(help="Sequence folder, .zip, .tar, .tar.gz, .bag, or a folder of them.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="A file for one sequence, a folder for many.")],
    format: Annotated[str, typer.Option(help="auto, or the data set's name.")] = "auto",
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
    from imutool.convert import convert as run

    with _progress("Converting", verbose, quiet) as tell:
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
    if not _json(result, json_to):
        for path in report.written:
            out.print(_plain(str(path)), highlight=False, soft_wrap=True)
    for failure in report.failures:
        err.print(f"[bold red]error:[/] {_plain(failure.message)}", highlight=False, soft_wrap=True)
    if report.failures:
        raise typer.Exit(4)


@app.command(epilog="Example: [bold]imutool info MH_04.mcap[/]")
def info(logs: Logs, json_to: Json = None, verbose: Verbose = False, quiet: Quiet = False) -> None:
    """Say what is in a log and what looks wrong with it."""
    from imutool.info import imu_rows, inspect, topic_rows

    _log_to_stderr(verbose, quiet)
    reports = [inspect(log) for log in logs]
    if _json(reports[0] if len(reports) == 1 else {"schema": "imutool.infos/1", "logs": reports}, json_to):
        return
    for log, report in zip(logs, reports, strict=True):
        _table(str(log), topic_rows(report))
        _table("", imu_rows(report))
        for warning in report["warnings"]:
            out.print(f"[yellow]warning:[/] {_plain(warning)}", highlight=False, soft_wrap=True)


@app.command(epilog="Example: [bold]imutool train MH_0[135]*.mcap -o adis.safetensors --method neural_ode[/]")
def train(
    logs: Logs,
    model: Annotated[Path, typer.Option("-o", "--output", metavar="MODEL.safetensors", help="Where the model goes.")],
    method: Annotated[str, typer.Option(help="The bias model: a file name of imutool/bias.")] = "neural_ode",
    config: Annotated[Path | None, typer.Option(metavar="FILE.toml", help="Settings; see TrainSettings.")] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", metavar="key=value", help="One setting. Repeatable.")] = None,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    seed: Annotated[int | None, typer.Option(help="Seed of everything random.")] = None,
    imu: Imu = None,
    truth: Truth = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from an interrupted training's checkpoint.")] = False,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Train a bias model on logs of one sensor with true poses."""
    from imutool.config import load
    from imutool.train.fit import TrainSettings
    from imutool.train.run import train as run

    words = [*(set_ or ()), *([f"seed={seed}"] if seed is not None else ())]
    settings = load(TrainSettings, config, words)
    with _progress("Training", verbose, quiet) as tell:
        trained = run(
            logs,
            model,
            method=method,
            settings=settings,
            device=device,
            imu=imu,
            truth=truth,
            resume=resume,
            overwrite=overwrite,
            progress=lambda epoch: tell(*_epoch(epoch)),
        )
    if not _json({"schema": "imutool.training/1", "model": str(model), **trained.card}, json_to):
        out.print(_plain(str(model)), highlight=False, soft_wrap=True)


@app.command(epilog="Example: [bold]imutool debias MH_04.mcap MH_04_debiased.mcap --model adis.safetensors[/]")
def debias(
    source: Annotated[Path, typer.Argument(metavar="IN", help="An MCAP log.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="The log with the debiased IMU beside the raw one.")],
    model: Annotated[str | None, typer.Option(help="Model file or a name that ships; else a static estimate.")] = None,
    imu: Annotated[list[str] | None, typer.Option(help="IMU topic, where a log has several. Repeatable.")] = None,
    init: Init = "auto",
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Rewrite a log with a debiased IMU channel; everything else passes through unchanged."""
    from imutool.debias import debias as run

    with _progress("Debiasing", verbose, quiet) as tell:
        report = run(
            source,
            target,
            model=model,
            imus=imu or (),
            init=init,
            overwrite=overwrite,
            progress=lambda done, total: tell(done, total, ""),
        )
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
    added, copied = dict(report.rewrite.added), report.rewrite.copied
    result = {"schema": "imutool.debias/1", "output": str(target), "imus": imus, "copied": copied, "added": added}
    if _json(result, json_to):
        return
    for topic, entry in imus.items():
        bias = ", ".join(f"{b:+.5f}" for b in entry["gyro_bias"]), ", ".join(f"{b:+.4f}" for b in entry["accel_bias"])
        start = f"start bias {bias[0]} rad/s; {bias[1]} m/s² ({entry['init_how']})"
        out.print(_plain(f"{topic}: {entry['model']}, {start}"), highlight=False, soft_wrap=True)
    counts = ", ".join(f"{count} on {name}" for name, count in added.items())
    out.print(_plain(f"{target}: {copied} messages as they were, {counts}"), highlight=False, soft_wrap=True)


@app.command(epilog="Example: [bold]imutool evaluate MH_04.mcap --model adis.safetensors --init truth[/]")
def evaluate(
    logs: Logs,
    model: Models = None,
    init: Init = "auto",
    truth: Truth = None,
    imu: Imu = None,
    trajectories: Annotated[Path | None, typer.Option(metavar="DIR", help="Write TUM-format trajectories there.")] = None,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Integrate the IMU alone from the true start, raw and with each model, and score it against the truth."""
    from imutool.evaluate import SCHEMA
    from imutool.evaluate import evaluate as run

    results = []
    with _progress("Evaluating", verbose, quiet) as tell:
        for done, log in enumerate(logs):
            tell(done, len(logs), log.name)
            results += run(
                log, models=model or (), init=init, truth=truth, imu=imu, trajectories=trajectories, overwrite=overwrite
            )
        tell(len(logs), len(logs), "")
    if not _json({"schema": SCHEMA, "results": results}, json_to):
        _table("", _figures(results))


@app.command(epilog="Example: [bold]imutool view MH_04_debiased.mcap --save MH_04.rrd[/]")
def view(
    logs: Logs,
    model: Models = None,
    init: Init = "auto",
    truth: Truth = None,
    imu: Imu = None,
    save: Annotated[Path | None, typer.Option(metavar="F.rrd", help="Save instead of opening the viewer.")] = None,
    png: Annotated[Path | None, typer.Option(metavar="DIR", help="Also draw error curves, LOG.png each.")] = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Show truth, raw and debiased in the Rerun viewer, or save them for it."""
    from imutool.view import report, rerun
    from imutool.view.runs import load

    with _progress("Reading", verbose, quiet) as tell:
        data = []
        for done, log in enumerate(logs):
            tell(done, len(logs), log.name)
            data.append(load(log, models=model or (), init=init, imu=imu, truth=truth))
    if png is not None:
        png.mkdir(parents=True, exist_ok=True)
        for log, one in zip(logs, data, strict=True):
            report.error_curves(one, png / f"{log.stem}.png", overwrite=overwrite)
    out.print(_plain(rerun.show(data, save=save, overwrite=overwrite)), highlight=False, soft_wrap=True)


@app.command(epilog="Example: [bold]imutool models --json -[/]")
def models(json_to: Json = None, verbose: Verbose = False, quiet: Quiet = False) -> None:
    """List the models that ship, their sensor and their card."""
    from imutool.bias._file import header_of, library

    _log_to_stderr(verbose, quiet)
    found = []
    for path in sorted(library().glob("*.safetensors")):
        about = header_of(path)
        keys = ("method", "sensor", "dataset", "rate_hz")
        found.append({"name": path.stem, **{key: about.get(key) for key in keys}})
    if _json({"schema": "imutool.models/1", "models": found}, json_to):
        return
    if found:
        _table("", [tuple(found[0]), *(tuple(str(value) for value in one.values()) for one in found)])
    else:
        out.print("No model ships with this version; train one with: imutool train", highlight=False)
    methods = ", ".join(f"{name} ({registry.summary('imutool.bias', name)})" for name in registry.names("imutool.bias"))
    if verbose:
        out.print(_plain(f"Methods: {methods}"), highlight=False)


@app.command(epilog="Example: [bold]imutool demo -o demo-out[/]")
def demo(
    folder: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Where everything goes.")] = Path("demo-out"),
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Go the whole way on a made-up recording: convert, train, debias, evaluate, view. No download."""
    from imutool.demo import run

    _log_to_stderr(verbose, quiet)
    done = run(folder, lambda line: None if quiet else err.print(_plain(line), highlight=False), overwrite=overwrite)
    files = {name: str(getattr(done, name)) for name in ("log", "debiased", "model", "rrd", "png")}
    if not _json({"schema": "imutool.demo/1", "results": done.results, **files}, json_to):
        _table("Pure integration of a flight the model has not seen", _figures(done.results))
        out.print(_plain(f"Look at {done.png}, or open the viewer: rerun {done.rrd}"), highlight=False, soft_wrap=True)


def version(show: bool) -> None:
    """Prints the version and leaves."""
    if show:
        out.print(f"imutool {__version__}", highlight=False)
        raise typer.Exit


@app.callback()
def options(
    show_version: Annotated[bool, typer.Option("--version", callback=version, is_eager=True, help="Say the version.")] = False,
) -> None:
    """Options of imutool itself."""


def _epoch(epoch: Epoch) -> tuple[int, int, str]:
    scale, unit = (180 / 3.141592653589793, "°") if epoch.sensor == "gyro" else (1.0, " m/s")
    held_out, best = epoch.held_out * scale, epoch.best * scale
    text = f"{epoch.sensor}: loss {epoch.loss:.3f}, held out {held_out:.3f}{unit}, best {best:.3f}{unit}"
    return epoch.step, max(epoch.steps, 1), text


def _figures(results: Sequence[dict[str, Any]]) -> list[tuple[str, ...]]:
    """Evaluation results as rows of text, the first row the header."""

    def number(value: float | None, form: str) -> str:
        return "–" if value is None else format(value, form)

    distances = list(results[0]["roe_deg"])
    header = ("log", "model", "start", "AOE °", "AOE aligned °", "APE m", "velocity m/s")
    rows = [(*header, *(f"ROE {d} m °" for d in distances), *(f"RPE {d} m m" for d in distances))]
    for one in results:
        figures = (one["aoe_deg"], one["aoe_aligned_deg"], one["ape_m"], one["velocity_rmse_m_s"])
        forms = (".2f", ".2f", ".1f", ".2f")
        relative = [*(one["roe_deg"][d] for d in distances), *(one["rpe_m"][d] for d in distances)]
        texts = [number(value, form) for value, form in zip(figures, forms, strict=True)]
        rows.append((one["log"], one["model"], one["init"] or "–", *texts, *(number(value, ".2f") for value in relative)))
    return rows


def _table(title: str, rows: Sequence[Sequence[str]]) -> None:
    """Rows of text, the first one the header."""
    table = Table(title=_plain(title) or None, title_justify="left")
    for name in rows[0]:
        table.add_column(_plain(name), overflow="fold")
    for row in rows[1:]:
        table.add_row(*(_plain(cell) for cell in row))
    # a table wider than the terminal is cut by rich; where nobody looks at a terminal nothing must be cut
    (out if out.is_terminal else Console(width=240)).print(table)


def _json(report: Any, where: str | None) -> bool:
    """Writes the report where `--json` says; true if stdout is taken by it."""
    if where is None:
        return False
    text = json.dumps(report, indent=2, allow_nan=False, ensure_ascii=False)
    if where == "-":
        sys.stdout.write(text + "\n")
        return True
    beside = Path(where).with_name(f".{Path(where).name}.part")
    try:
        beside.write_text(text + "\n", encoding="utf-8")
        beside.replace(where)
    finally:
        beside.unlink(missing_ok=True)
    return False


def _log_to_stderr(verbose: bool, quiet: bool) -> None:
    level = logging.ERROR if quiet else logging.DEBUG if verbose else logging.WARNING
    logging.basicConfig(level=level, format="%(message)s", handlers=[RichHandler(console=err, show_path=False)], force=True)


@contextmanager
def _progress(what: str, verbose: bool, quiet: bool) -> Iterator[Callable[[int, int, str], None]]:
    """A bar on stderr, told how much is done, of how much, and a word on it."""
    _log_to_stderr(verbose, quiet)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, TextColumn("{task.fields[word]}"), console=err, disable=quiet, transient=True) as bar:
        task = bar.add_task(what, total=None, word="")

        def tell(done: int, total: int, word: str) -> None:
            bar.update(task, completed=done, total=total, word=_plain(word))

        yield tell


if __name__ == "__main__":
    main()
