"""The command line: parse, call, print. Results go to stdout; log lines and progress to stderr; one place catches."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup

from imutool import __version__, registry
from imutool.errors import ConfigError, DataError, ImutoolError
from imutool.terminal import err, log_to_stderr, out, plain, progress, say, table, tell_error, write_json

if TYPE_CHECKING:
    from imutool.train.fit import Epoch

INTERRUPTED = 130
PIPE_CLOSED = 141  # what a shell reports of a program that SIGPIPE ended
NOTHING_LEFT = "Nothing half-written is left"


class _Commands(TyperGroup):
    """Commands whose interrupt is told here: typer would end the program without a word."""

    def invoke(self, ctx: Any) -> Any:
        with _caught():
            result = super().invoke(ctx)
            sys.stdout.flush()  # at the interpreter's end it would be too late to say anything
        return result


@contextmanager
def _caught() -> Iterator[None]:
    """The one place that catches: what went wrong becomes a sentence and an exit code."""
    try:
        yield
    except ImutoolError as error:
        _fail(str(error), error.exit_code)
    except KeyboardInterrupt as interrupt:
        _fail(f"interrupted. {str(interrupt) or NOTHING_LEFT}.", INTERRUPTED)
    except BrokenPipeError:
        _forget_stdout()
        sys.exit(PIPE_CLOSED)
    except OSError as error:
        if error.filename is None:  # then it is a stream, and stdout the only one we fill
            _forget_stdout()
        place = f"{error.filename}: " if error.filename else ""
        _fail(f"{place}{error.strerror or error}. Choose another place or make room.", ConfigError.exit_code)


def _listing(group: str, option: str) -> type[TyperCommand]:
    """A command whose help also lists what can be named, found (and nothing of it imported) when help is asked for."""

    class Listing(TyperCommand):
        def format_help(self, ctx: Any, formatter: Any) -> None:
            lines = [f"[bold]{name}[/]  {plain(registry.summary(group, name))}" for name in registry.names(group)]
            self.epilog = "\n\n".join([f"Values of {option}:", *lines, self.epilog or ""])
            super().format_help(ctx, formatter)

    return Listing


app = typer.Typer(
    name="imutool",
    help="Raw inertial data to MCAP, learned IMU bias dynamics, debiased logs, and a picture of what changed.",
    cls=_Commands,
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    add_completion=False,
)

Logs = Annotated[list[Path], typer.Argument(metavar="LOG...", help="MCAP logs.")]
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
    """Entry point of the `imutool` command."""
    # Idle OpenMP threads would spin: on a busy machine with two processors, training took 87 s of their time instead of 11
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with _caught():
        app()


def _fail(message: str, code: int) -> NoReturn:
    tell_error(message)
    sys.exit(code)


def _forget_stdout() -> None:
    """What is still to be flushed into a closed pipe or a full disk goes nowhere, so that leaving raises nothing more."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@app.command(
    cls=_listing("imutool.converters", "--format"), epilog="Example: [bold]imutool convert MH_04_difficult.zip MH_04.mcap[/]"
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
    from imutool.convert import convert as run

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


@app.command(epilog="Example: [bold]imutool info MH_04.mcap[/]")
def info(logs: Logs, json_to: Json = None, verbose: Verbose = False, quiet: Quiet = False) -> None:
    """Say what is in a log and what looks wrong with it."""
    from imutool.info import imu_rows, inspect, topic_rows

    log_to_stderr(verbose, quiet)
    reports = [inspect(log) for log in logs]
    if write_json(reports[0] if len(reports) == 1 else {"schema": "imutool.infos/1", "logs": reports}, json_to):
        return
    for log, report in zip(logs, reports, strict=True):
        say(str(log))
        table(topic_rows(report), keys=1)
        table(imu_rows(report), keys=2)
        for warning in report["warnings"]:
            out.print(f"[yellow]warning:[/] {plain(warning)}", highlight=False, soft_wrap=True)


@app.command(
    cls=_listing("imutool.bias", "--method"),
    epilog="Example: [bold]imutool train MH_01.mcap MH_03.mcap -o adis.safetensors --method neural_ode[/]",
)
def train(
    logs: Logs,
    model: Annotated[Path, typer.Option("-o", "--output", metavar="MODEL.safetensors", help="Where the model goes.")],
    method: Annotated[str, typer.Option(help="The bias model, one of those listed below.")] = "neural_ode",
    config: Annotated[
        Path | None, typer.Option(metavar="FILE.toml", help="Settings; imutool.train.fit.TrainSettings says which.")
    ] = None,
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
    registry.load("imutool.bias", method)  # a slip of the pen is told before any log is read
    from imutool.config import load
    from imutool.train.fit import TrainSettings
    from imutool.train.run import train as run

    words = [*(set_ or ()), *([f"seed={seed}"] if seed is not None else ())]
    settings = load(TrainSettings, config, words)
    with progress("Training", verbose, quiet) as tell:
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
    if not write_json({"schema": "imutool.training/1", "model": str(model), **trained.card}, json_to):
        say(str(model))


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

    with progress("Debiasing", verbose, quiet) as tell:
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
    if write_json(result, json_to):
        return
    for topic, entry in imus.items():
        bias = ", ".join(f"{b:+.5f}" for b in entry["gyro_bias"]), ", ".join(f"{b:+.4f}" for b in entry["accel_bias"])
        start = f"start bias {bias[0]} rad/s; {bias[1]} m/s² ({entry['init_how']})"
        say(f"{topic}: {entry['model']}, {start}")
    counts = ", ".join(f"{count} on {name}" for name, count in added.items())
    say(f"{target}: {copied} messages as they were, {counts}")


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
    with progress("Evaluating", verbose, quiet) as tell:
        for done, log in enumerate(logs):
            tell(done, len(logs), log.name)
            results += run(
                log, models=model or (), init=init, truth=truth, imu=imu, trajectories=trajectories, overwrite=overwrite
            )
        tell(len(logs), len(logs), "")
    if not write_json({"schema": SCHEMA, "results": results}, json_to):
        _figures(results)


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

    with progress("Reading", verbose, quiet) as tell:
        data = []
        for done, log in enumerate(logs):
            tell(done, len(logs), log.name)
            data.append(load(log, models=model or (), init=init, imu=imu, truth=truth))
    if png is not None:
        png.mkdir(parents=True, exist_ok=True)
        for log, one in zip(logs, data, strict=True):
            report.error_curves(one, png / f"{log.stem}.png", overwrite=overwrite)
    say(rerun.show(data, save=save, overwrite=overwrite))


@app.command(epilog="Example: [bold]imutool models --json -[/]")
def models(json_to: Json = None, verbose: Verbose = False, quiet: Quiet = False) -> None:
    """List the models that ship, their sensor and their card."""
    from imutool.bias._file import header_of, library

    log_to_stderr(verbose, quiet)
    found = []
    for path in sorted(library().glob("*.safetensors")):
        about = header_of(path)
        keys = ("method", "sensor", "dataset", "rate_hz")
        found.append({"name": path.stem, **{key: about.get(key) for key in keys}})
    if write_json({"schema": "imutool.models/1", "models": found}, json_to):
        return
    if found:
        table([tuple(found[0]), *(tuple(str(value) for value in one.values()) for one in found)], keys=1)
    else:
        say("No model ships with this version; train one with: imutool train")


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

    def announce(line: str) -> None:
        if not quiet:
            err.print(plain(line), highlight=False, soft_wrap=True)

    with progress("Training", verbose, quiet) as tell:
        done = run(folder, announce, overwrite=overwrite, progress=lambda epoch: tell(*_epoch(epoch)))
    files = {name: str(getattr(done, name)) for name in ("log", "debiased", "model", "rrd", "png")}
    if not write_json({"schema": "imutool.demo/1", "results": done.results, **files}, json_to):
        say("Pure integration of a flight the model has not seen, from its true start:")
        _figures(done.results)
        say(f"Error curves: {done.png}. In the viewer: rerun {done.rrd}")


def _version(show: bool) -> bool:
    if show:
        say(f"imutool {__version__}")
        raise typer.Exit
    return show


@app.callback()
def options(
    show_version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Say the version.")] = False,
) -> None:
    """Options of imutool itself."""


def _epoch(epoch: Epoch) -> tuple[int, int, str]:
    """A line of training as progress: steps done, steps in all, the figures in words."""
    scale, unit = (180.0 / math.pi, "°") if epoch.sensor == "gyro" else (1.0, " m/s")
    held_out, best = epoch.held_out * scale, epoch.best * scale
    minutes, seconds = divmod(round(epoch.left_s), 60)
    loss = "" if math.isnan(epoch.loss) else f"loss {epoch.loss:.3f}, "  # before the first step there is none
    text = f"{epoch.sensor} {epoch.step}/{epoch.steps}: {loss}held out {held_out:.3f}{unit} (best {best:.3f})"
    return epoch.step, max(epoch.steps, 1), f"{text}, {minutes}:{seconds:02d} left" if epoch.step else text


def _figures(results: Sequence[dict[str, Any]]) -> None:
    """Evaluation results as two tables: over the whole path, and per metres flown."""

    def number(value: float | None) -> str:
        return "–" if value is None else format(value, ".2f")

    distances = list(results[0]["roe_deg"])
    names = ("aoe_deg", "aoe_aligned_deg", "ape_m", "ape_aligned_m", "velocity_rmse_m_s")
    whole = [("log", "model", "AOE\n°", "aligned\n°", "APE\nm", "aligned\nm", "velocity\nm/s")]
    roe = [("log", "model", *(f"ROE °\n{d} m" for d in distances))]
    rpe = [("log", "model", *(f"RPE m\n{d} m" for d in distances))]
    for one in results:
        whole.append((one["log"], one["model"], *(number(one[name]) for name in names)))
        roe.append((one["log"], one["model"], *(number(one["roe_deg"][d]) for d in distances)))
        rpe.append((one["log"], one["model"], *(number(one["rpe_m"][d]) for d in distances)))
    for rows in (whole, roe, rpe):
        table(rows, keys=2)


if __name__ == "__main__":
    main()
