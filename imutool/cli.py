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
    from imutool.identify import Identified
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
Smooth = Annotated[bool, typer.Option("--smooth", help="Take the whole log for every sample's bias: better, not causal.")]
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


@app.command(epilog="Example: [bold]imutool info MH_04.mcap[/] or [bold]imutool info still.mcap --noise --noise-toml i.toml[/]")
def info(
    logs: Logs,
    noise: Annotated[bool, typer.Option("--noise", help="Identify the IMU's noise, at rest and against the truth.")] = False,
    model: Annotated[str | None, typer.Option(help="For --noise: model that corrects the samples in motion.")] = None,
    imu: Annotated[str | None, typer.Option(help="For --noise: IMU topic, where a log has several.")] = None,
    truth: Annotated[str | None, typer.Option(help="For --noise: topic of the true poses, where a log has several.")] = None,
    noise_plot: Annotated[Path | None, typer.Option(metavar="F.png", help="Draw the Allan deviations (with --noise).")] = None,
    noise_toml: Annotated[Path | None, typer.Option(metavar="F.toml", help="Write the noise as TOML (with --noise).")] = None,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Say what is in a log and what looks wrong with it; with --noise, how noisy its IMU is."""
    from imutool.info import imu_rows, inspect, topic_rows

    log_to_stderr(verbose, quiet)
    asked = {"--model": model, "--imu": imu, "--truth": truth, "--noise-plot": noise_plot, "--noise-toml": noise_toml}
    if not noise and (idle := [name for name, value in asked.items() if value is not None]):
        raise ConfigError(f"{idle[0]} says nothing without --noise", where="info", fix="Add --noise")
    if len(logs) > 1 and (noise_plot or noise_toml):
        raise ConfigError(f"{len(logs)} logs do not fit one file", where="--noise-plot, --noise-toml", expected="one log")
    reports = [inspect(log) for log in logs]
    found = []
    if noise:
        from imutool import identify

        found = [identify.identify(log, imu=imu, truth=truth, model=model) for log in logs]
        for report, one in zip(reports, found, strict=True):
            report["noise"] = identify.plain(one)
        _write_noise(found[0], noise_plot, noise_toml, overwrite)
    if write_json(reports[0] if len(reports) == 1 else {"schema": "imutool.infos/1", "logs": reports}, json_to):
        return
    for number, (log, report) in enumerate(zip(logs, reports, strict=True)):
        say(str(log))
        table(topic_rows(report), keys=1)
        table(imu_rows(report), keys=2)
        if found:
            table(identify.rows(found[number]), keys=1)
            for remark in found[number].remarks:
                out.print(f"[cyan]noise:[/] {plain(remark)}", highlight=False, soft_wrap=True)
        for warning in report["warnings"]:
            out.print(f"[yellow]warning:[/] {plain(warning)}", highlight=False, soft_wrap=True)


def _write_noise(found: Identified, plot: Path | None, toml: Path | None, overwrite: bool) -> None:
    """The files that were asked for."""
    if plot is not None:
        from imutool.view.allan import deviations

        deviations(found, plot, overwrite=overwrite)
    if toml is not None:
        from imutool.noise import write

        write(found.noise, toml, overwrite=overwrite)


@app.command(
    cls=_listing("imutool.bias", "--method"),
    epilog="Example: [bold]imutool train MH_01.mcap MH_03.mcap -o adis.safetensors[/]",
)
def train(
    logs: Logs,
    model: Annotated[Path, typer.Option("-o", "--output", metavar="MODEL.safetensors", help="Where the model goes.")],
    method: Annotated[str, typer.Option(help="The bias model, one of those listed below.")] = "hybrid",
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
    from imutool.train.run import train as run
    from imutool.train.settings import settings_of

    words = [*(set_ or ()), *([f"seed={seed}"] if seed is not None else ())]
    settings = load(settings_of(method), config, words)
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
    smooth: Smooth = False,
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
            smooth=smooth,
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


@app.command(epilog="Example: [bold]imutool export MH_04_debiased.mcap MH_04_debiased --format euroc[/]")
def export(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="An MCAP log.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="The folder that is made.")],
    format: Annotated[str, typer.Option(help="euroc: an ASL folder; rosbag2: a folder around a copy of the log.")],
    imu: Annotated[str | None, typer.Option(help="IMU topic of a EuRoC folder; by default the debiased one.")] = None,
    noise: Annotated[
        str | None, typer.Option(metavar="NAME|F.toml", help="Noise for its sensor.yaml: a data sheet or a file.")
    ] = None,
    overwrite: Overwrite = False,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Write a log as a EuRoC folder or a rosbag2 folder, for programs that read those."""
    from imutool.export import export as run

    with progress("Exporting", verbose, quiet) as tell:
        report = run(log, target, format=format, imu=imu, sensor_noise=noise, overwrite=overwrite, progress=tell)
    if write_json(report.plain(), json_to):
        return
    counts = ", ".join(f"{count} on {name}" for name, count in report.written.items())
    say(f"{target}: {counts}" + (f"; IMU from {report.imu}" if report.imu else ""))
    if report.left_out:
        say(f"left out: {', '.join(report.left_out)}")


@app.command(epilog="Example: [bold]imutool evaluate MH_04.mcap --model adis.safetensors --init truth[/]")
def evaluate(
    logs: Logs,
    model: Models = None,
    init: Init = "auto",
    smooth: Smooth = False,
    zupt: Annotated[bool, typer.Option("--zupt", help="Also dead reckoning that knows when it stands still.")] = False,
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
                log,
                models=model or (),
                init=init,
                smooth=smooth,
                zupt=zupt,
                truth=truth,
                imu=imu,
                trajectories=trajectories,
                overwrite=overwrite,
            )
        tell(len(logs), len(logs), "")
    if not write_json({"schema": SCHEMA, "results": results}, json_to):
        _figures([{**one, "model": f"{one['model']} zupt"} if one["estimate"] == "zupt" else one for one in results])


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


@app.command(epilog="Example: [bold]imutool vio MH_04.mcap --model adis.safetensors --blackout 3[/]")
def vio(
    logs: Logs,
    model: Models = None,
    init: Init = "auto",
    truth: Truth = None,
    imu: Imu = None,
    bias_states: Annotated[
        bool | None, typer.Option("--bias-states/--no-bias-states", help="Estimate biases, or trust the IMU; by default both.")
    ] = None,
    lag: Annotated[float, typer.Option(metavar="S", help="How far back the smoother still changes its mind.")] = 3.0,
    keyframes: Annotated[float, typer.Option(metavar="HZ", help="Camera frames taken a second.")] = 4.0,
    features: Annotated[int, typer.Option(help="Tracks in a frame.")] = 30,
    pixel_noise: Annotated[float, typer.Option(metavar="PX", help="White noise of a pixel coordinate.")] = 1.0,
    blackout: Annotated[float, typer.Option(metavar="S", help="The camera sees nothing so long of every 15 s.")] = 0.0,
    duration: Annotated[float | None, typer.Option(metavar="S", help="Only so much of each log.")] = None,
    seed: Annotated[int, typer.Option(help="Of landmarks, tracks and pixel noise.")] = 0,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="key=value", help="Another of imutool.vio.run.VioSettings. Repeatable.")
    ] = None,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Score a visual-inertial estimate on the log's IMU, raw and with each model.

    The camera is simulated: EuRoC's stereo pair along the log's true poses, on every data set.
    """
    from imutool.config import load
    from imutool.vio.run import SCHEMA, VioSettings, tabulate
    from imutool.vio.run import vio as run

    given = {"smoother.lag_s": lag, "keyframes_hz": keyframes, "features": features, "pixel_noise": pixel_noise}
    given |= {"blackout_s": blackout, "seed": seed} | ({} if duration is None else {"duration_s": duration})
    settings = load(VioSettings, None, [*(f"{key}={value}" for key, value in given.items()), *(set_ or ())])
    states = (True, False) if bias_states is None else (bias_states,)
    results = []
    with progress("Estimating", verbose, quiet) as tell:
        for log in logs:
            results += run(
                log, models=model or (), init=init, truth=truth, imu=imu, bias_states=states, settings=settings, progress=tell
            )
    if write_json({"schema": SCHEMA, "results": results}, json_to):
        return
    for rows in tabulate(results):
        table(rows, keys=3)
    say(f"Camera, simulated along the truth: {results[0]['camera']}; {results[0]['tracks']} tracks in a frame")
    for one in results:
        if one["failed"]:
            say(f"{one['log']}, {one['model']}, bias states {'on' if one['bias_states'] else 'off'}: {one['failed']}")


@app.command(epilog="Example: [bold]imutool models --json -[/]")
def models(json_to: Json = None, verbose: Verbose = False, quiet: Quiet = False) -> None:
    """List the models that ship, their sensor and their card."""
    from imutool.bias._file import header_of, library

    log_to_stderr(verbose, quiet)
    found = []
    for path in sorted(library().glob("*.safetensors")):
        about = header_of(path)
        keys = ("method", "sensor", "dataset", "rate_hz")
        one = {"name": path.stem, **{key: about.get(key) for key in keys}}
        found.append({**one, "rate_hz": round(float(about["rate_hz"]), 1)})
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
    if epoch.note:
        return 0, 1, epoch.note
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
