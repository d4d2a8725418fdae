"""`imutool convert` into logs, and `imutool export` out of them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from imutool.cli.app import COMMON, Common, Quiet, Verbose, Written, app, listing
from imutool.cli.parameters import with_flags
from imutool.cli.terminal import log_to_stderr, say, tell_error, tell_warning
from imutool.config import entries
from imutool.errors import LOST, DataError
from imutool.mcap_io.storage.local import is_stream

if TYPE_CHECKING:
    from imutool.conversion.workers import ConvertReport

LOGS = Written(files=("*.mcap",), keeps=True)  # a file, or a folder of files
FOLDER = Written(files=("*",), keeps=True)


@app.command(
    cls=listing("imutool.converters", "--format"), epilog="Example: [bold]imutool convert MH_04_difficult.zip MH_04.mcap[/]"
)
def convert(
    source: Annotated[
        Path, typer.Argument(metavar="SRC", help="Bag, log, table, sequence folder or archive, or a folder of these.")
    ],
    target: Annotated[str, typer.Argument(metavar="OUT", help="File for one sequence, folder (or NAME/) for several."), LOGS],
    format: Annotated[str, typer.Option(help="auto, or a name from the list below.")] = "auto",
    sequence: Annotated[list[str] | None, typer.Option(help="Convert only this sequence. Repeatable.")] = None,
    compression: Annotated[Literal["zstd", "lz4", "none"], typer.Option(help="Compression of the chunks.")] = "zstd",
    no_images: Annotated[bool, typer.Option("--no-images", help="Leave camera frames out.")] = False,
    sensor: Annotated[str, typer.Option(metavar="NAME", help="The IMU's name, such as bmi160.")] = "",
    kind: Annotated[
        list[str] | None,
        typer.Option(metavar="TOPIC=KIND", help="Kind of poses: truth, estimate, odometry or unknown. Repeatable."),
    ] = None,
    imu: Annotated[str, typer.Option(metavar="gyro=T,accel=T", help="Two topics that become one IMU.")] = "",
    map_: Annotated[
        list[str] | None,
        typer.Option(
            "--map", metavar="F.toml|KEY=VALUE", help="Meaning and units of a table's columns, as gyro_unit=deg/s. Repeatable."
        ),
    ] = None,
    fix: Annotated[bool, typer.Option("--fix", help="Correct units, axes and frames that the motion contradicts.")] = False,
    restamp: Annotated[bool, typer.Option("--restamp", help="Put late stamps on the clock of the IMU.")] = False,
    workers: Annotated[int | None, typer.Option(min=1, help="Number of processes; by default one per core.")] = None,
    common: Common = COMMON,
) -> None:
    """Convert any recording with an IMU to MCAP; the format is recognised."""
    from imutool.api.logs import convert as run

    with common.progress("Converting") as tell:
        report = run(
            source,
            target,
            format=format,
            sequences=sequence or (),
            compression=compression,
            images=not no_images,
            overwrite=common.overwrite,
            sensor=sensor,
            kinds=kind or (),
            mapping=_mapping(map_ or []),
            imu=imu,
            fix=fix,
            restamp=restamp,
            workers=workers,
            progress=tell,
        )
    _tell(report, common)


def _mapping(words: list[str]) -> Path | dict[str, Any] | None:
    """A map file, or the entries that `KEY=VALUE` words state."""
    if len(words) == 1 and ("=" not in words[0] or Path(words[0]).exists()):
        return Path(words[0])
    return entries(words, "mapping") if words else None


def _tell(report: ConvertReport, common: Common) -> None:
    """Report written logs, notes, losses and failures; the exit code says which there are."""
    if not common.write(report):
        for path in report.written:
            say(str(path))
    if not common.quiet:
        bare = [path for path in report.written if path.suffix.lower() != ".mcap" and not is_stream(path)]
        asked = [f"{path} is a log, although its name does not end in .mcap; for a folder add a slash" for path in bare]
        for note in [*_grouped(report.notes), *asked]:
            tell_warning(note, "note")
    for loss in _grouped(report.losses):
        tell_warning(with_flags(loss))
    printed: set[str] = set()
    for failure in report.failures:
        first, _, others = failure.message.partition("\n")
        tell_error(with_flags(f"{first} the same as above" if others in printed else failure.message))
        printed.update(filter(None, [others]))
    if report.failures or report.losses:
        raise typer.Exit(DataError.exit_code if report.failures else LOST)


def _grouped(sentences: list[str]) -> list[str]:
    """Sentences `LOG: TEXT`, each text once, in front of it the first of its logs and the number of the others."""
    logs: dict[str, list[str]] = {}
    for sentence in dict.fromkeys(sentences):  # both rounds of a correction may say the same
        log, colon, text = sentence.partition(": ")
        logs.setdefault(colon + text, []).append(log)
    others = {text: f" and {len(names) - 1} other{'s' if len(names) > 2 else ''}" for text, names in logs.items()}
    return [f"{names[0]}{others[text] if len(names) > 1 else ''}{text}" for text, names in logs.items()]


@app.command(epilog="Example: [bold]imutool export MH_04_debiased.mcap MH_04_debiased --format euroc[/]")
def export(
    log: Annotated[
        Path, typer.Argument(metavar="LOG", help="An MCAP log; for a simulator, the folder of a diagnosis, or one of several.")
    ],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="New folder."), FOLDER],
    format: Annotated[
        str,
        typer.Option(
            help="euroc: an ASL folder; rosbag2: a folder around a copy of the log; mujoco, gazebo, isaac, toml: "
            "the diagnosed sensor as a simulator's configuration, with ranges."
        ),
    ],
    imu: Annotated[str | None, typer.Option(help="IMU topic of a EuRoC folder; by default the debiased one.")] = None,
    noise: Annotated[
        str | None, typer.Option(metavar="NAME|F.toml", help="Noise for sensor.yaml or a simulator: a data sheet or a file.")
    ] = None,
    common: Common = COMMON,
) -> None:
    """Write a log as a EuRoC or rosbag2 folder, or a diagnosed sensor for a simulator."""
    from imutool.api.logs import export as run

    with common.progress("Exporting") as tell:
        report = run(log, target, format=format, imu=imu, noise=noise, overwrite=common.overwrite, progress=tell)
    if common.write(report):
        return
    counts = ", ".join(name if "." in name else f"{count} on {name}" for name, count in report.written.items())
    say(f"{target}: {counts}" + (f"; IMU from {report.imu}" if report.imu else ""))
    if report.left_out:
        say(f"left out: {', '.join(report.left_out)}")


@app.command(epilog="Example: [bold]imutool new-converter my_logger[/]")
def new_converter(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name on the command line, such as my_logger.")],
    folder: Annotated[
        Path | None, typer.Option("--output", "--folder", "-o", metavar="DIR", help="New folder; by default imutool-NAME.")
    ] = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Write a template of a converter, with a test, as a package of its own."""
    from imutool.conversion.converter_template import write_template

    log_to_stderr(verbose, quiet)
    place = Path(f"imutool-{name}") if folder is None else folder
    for path in write_template(name, place):
        say(str(path))
    say(f"Change imutool_{name}.py, run pytest {place}, then pip install -e {place}: imutool convert accepts {name}.")
