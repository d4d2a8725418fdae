"""`imutool view`."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from imutool.cli.app import COMMON, HTML, Aid, Common, Imu, Init, LogUrls, Models, Smooth, Truth, Written, app
from imutool.cli.terminal import kept_for_end, raise_kept, say
from imutool.errors import ImutoolError
from imutool.file_location import to_location
from imutool.mcap_io.storage import output_conflicts
from imutool.report import Report
from imutool.viewing import Output

AT_HELP = "Start of the cursor: seconds, or worst (the largest orientation error of a model)."
ALIGN_HELP = "Align each path with the truth before taking errors: by its start, heading, or completely."
SOURCE_HELP = "Also show other topics of the log, such as cameras."


SAVED = Written(output_conflicts.RRD, may_be_folder=True)
PICTURES, SITE = Written(files=("*.png",), keeps=True, of_each="{}-*.png"), Written(files=("*",), keeps=True)


class View(Report, frozen=True, tag="imutool.view/1"):
    """Report of `imutool view`: outputs, and the versions of imutool, Rerun and the viewer."""

    logs: list[str]
    shown: list[Output]
    imutool: str | None
    rerun: str | None
    viewer: str | None


@app.command(epilog="Example: [bold]imutool view MH_04_debiased.mcap --save MH_04.rrd[/]")
def view(
    logs: LogUrls,
    model: Models = None,
    init: Init = "auto",
    smooth: Smooth = False,
    truth: Truth = None,
    imu: Imu = None,
    aid: Aid = None,
    align: Annotated[str, typer.Option(metavar="none|origin|yaw|se3", help=ALIGN_HELP)] = "none",
    findings: Annotated[Path | None, typer.Option(metavar="DIR", help="Mark the findings of this diagnosis folder.")] = None,
    source: Annotated[bool, typer.Option("--source/--no-source", help=SOURCE_HELP)] = True,
    at: Annotated[str | None, typer.Option(metavar="SECONDS|worst", help=AT_HELP)] = None,
    save: Annotated[Path | None, typer.Option(metavar="F.rrd", help="Save a file for the viewer."), SAVED] = None,
    connect: Annotated[str | None, typer.Option(metavar="URL", help="Send to a running viewer: HOST:PORT.")] = None,
    web: Annotated[bool, typer.Option("--web", help="Serve to a browser on this machine, until Ctrl-C.")] = False,
    port: Annotated[int | None, typer.Option(min=1, max=65535, help="Port of --web; else a free one.")] = None,
    export_web: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write a folder that any web server can serve."), SITE
    ] = None,
    png: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Draw pictures, LOG-errors.png and so on; without Rerun."), PICTURES
    ] = None,
    html: Annotated[Path | None, typer.Option(metavar="F.html", help="Write an HTML page, without Rerun."), HTML] = None,
    common: Common = COMMON,
) -> None:
    """Show truth, raw and debiased: in the Rerun viewer, in a browser, or as files.

    Without --save, --connect, --web, --export-web, --png and --html, a viewer opens; without a display, an .rrd is saved.
    Logs that are not usable are named at the end.
    """
    from imutool.viewing.model.load_view import load
    from imutool.viewing.model.trajectory_error import alignment
    from imutool.viewing.outputs import Outputs, RequestedOutputs

    aligned, places = alignment(align), [to_location(log) for log in logs]
    read = partial(load, models=model or (), init=init, smooth=smooth, imu=imu, truth=truth, aid=aid)
    read = partial(read, align=aligned, findings=findings)
    asked = RequestedOutputs(save, connect, web, port, export_web, png, html, at, source, common.overwrite)
    with Outputs(asked) as outputs:
        with common.progress("Reading") as tell:
            data = []
            used: list[str] = []
            errors: list[ImutoolError] = []
            for done, log in enumerate(places):
                tell(done, len(places), log.name)
                with kept_for_end(errors):
                    data.append(read(log))
                    used.append(str(log))
        if not data:
            raise_kept(errors)
        shown = outputs.show(data)
        report = View(used, shown, **outputs.versions())
        if not common.write(report):
            for output in shown:
                say(output.said)
        sys.stdout.flush()  # whoever reads it through a pipe wants the address now
        if outputs.refused is not None:
            raise outputs.refused
        raise_kept(errors)
        outputs.serve()
