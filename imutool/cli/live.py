"""`imutool live`."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, closing, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from imutool.cli.app import COMMON, RRD, Common, Imu, app
from imutool.cli.terminal import err, out, say, tell_warning
from imutool.errors import ConfigError
from imutool.report import Report
from imutool.viewing import Output
from imutool.viewing.stream import StreamStatistics

if TYPE_CHECKING:
    import numpy as np

    from imutool.viewing.rerun.live import Live
    from imutool.viewing.stream.samples import Sample

FROM_HELP = "stdin (JSON lines), udp://HOST:PORT, zenoh://[HOST:PORT]/KEY, rosbridge://HOST:PORT/TOPIC, or a log."
FORCE_HELP = "Use a model although it does not fit the stream; a warning says why it does not."
MODEL_HELP = "Model file, a name that ships, or static: the bias at rest in the first two seconds."


class LiveReport(Report, frozen=True, tag="imutool.live/1"):
    """Report of `imutool live`: source, model, statistics of the stream, and outputs."""

    source: str
    model: str
    stream: StreamStatistics
    shown: list[Output]


@app.command(epilog="Example: [bold]imutool live log.mcap[/] or [bold]imutool live --from udp://127.0.0.1:5005[/]")
def live(
    log: Annotated[str | None, typer.Argument(metavar="LOG", help="An MCAP log to replay at its own speed.")] = None,
    source: Annotated[str | None, typer.Option("--from", metavar="SOURCE", help=FROM_HELP, show_default=False)] = None,
    model: Annotated[str, typer.Option(help=MODEL_HELP)] = "static",
    imu: Imu = None,
    speed: Annotated[float, typer.Option(min=0.01, help="Speed of a log, as a multiple of its own.")] = 1.0,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after this time; else at the end or at Ctrl-C.")] = None,
    connect: Annotated[str | None, typer.Option(metavar="URL", help="Show in a running viewer: HOST:PORT.")] = None,
    save: Annotated[Path | None, typer.Option(metavar="F.rrd", help="Save what is shown to a file."), RRD] = None,
    no_view: Annotated[bool, typer.Option("--no-view", help="Show nothing; with --print, for another program.")] = False,
    to_stdout: Annotated[bool, typer.Option("--print", help="Print each debiased sample as a line of JSON.")] = False,
    force: Annotated[bool, typer.Option("--force", help=FORCE_HELP)] = False,
    common: Common = COMMON,
) -> None:
    """Debias a stream of samples as it comes, show it, and measure the delay.

    A sample is a line of JSON: t_ns (or t_s), gyro in rad/s, accel in m/s², each of three numbers. Zenoh also carries
    sensor_msgs/Imu in CDR.
    """
    from imutool.api.models import load_model
    from imutool.bias.temperature import scale_of
    from imutool.viewing.stream.samples import Malformed
    from imutool.viewing.stream.session import run
    from imutool.viewing.stream.sources import open_source

    malformed = Malformed()
    origin = source or log
    if origin is None or (source and log):
        raise ConfigError("one source is needed", where="live", expected="a log, or --from SOURCE")
    if no_view and (save or connect):
        raise ConfigError("--no-view shows nothing", where="--save, --connect", fix="Leave one of them out")
    if to_stdout and common.json_to == "-":
        raise ConfigError("--print and --json - both go to stdout", where="live", fix="Give --json a file")
    found = load_model(model)
    channel = scale_of(found).channel if found.temperature_parameters() else None
    opened = closing(open_source(origin, malformed, imu=imu, speed=speed, temperature=channel))
    with opened as samples, _view(connect, save, common.overwrite) if not no_view else nullcontext() as show:
        stream = run(samples, found, malformed, show=show, each=_print if to_stdout else None, seconds=seconds, force=force)
    shown = [] if show is None else show.shown
    if malformed.count:
        tell_warning(f"messages without a sample: {malformed.count}, the first: {malformed.first}")
    if not common.write(LiveReport(origin, model, stream, shown)):
        for line in _lines(stream, shown):
            say(line, to=err if to_stdout else out)
    if save is not None and all(output.how != "rrd" for output in shown):
        raise typer.Exit(ConfigError.exit_code)  # a warning has said why


def _view(connect: str | None, save: Path | None, overwrite: bool) -> AbstractContextManager[Live]:
    from imutool.viewing.rerun.live import live_view

    return live_view("live", connect_to=connect, save=save, instead=Path("live.rrd"), overwrite=overwrite)


def _print(found: Sample, rate: np.ndarray, force: np.ndarray) -> None:
    """Print one debiased sample."""
    line = {"t_ns": found.stamp_ns, "gyro": rate.tolist(), "accel": force.tolist()}
    sys.stdout.write(f"{msgspec.json.encode(line).decode()}\n")
    sys.stdout.flush()


def _lines(stream: StreamStatistics, shown: list[Output]) -> list[str]:
    """Summary of a stream."""
    lines = [f"{stream.samples} samples in {stream.seconds:.1f} s ({stream.rate_hz:.0f} Hz); start: {stream.start}"]
    lines += [stream.fit.sentence("the model")] if stream.fit is not None else []
    if stream.delay_ms is not None:
        delay = stream.delay_ms
        lines.append(
            f"delay from arrival to the corrected sample: {delay.median:.2f} ms, 99 % within {delay.p99:.2f} ms, "
            f"at most {delay.max:.2f} ms"
        )
    counts = {
        "gaps": stream.gaps,
        "samples out of order": stream.out_of_order,
        "samples without a measurement": stream.not_measured,
    }
    counts["samples not shown, as they came faster than they could be drawn"] = stream.not_shown
    lines += [", ".join(f"{what}: {count}" for what, count in counts.items() if count)] if any(counts.values()) else []
    return [*lines, *(output.said for output in shown)]
