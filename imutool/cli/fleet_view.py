"""`imutool fleet view`."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from imutool.cli.app import COMMON, Common, Written
from imutool.cli.fleet import fleet
from imutool.cli.terminal import say, table, tell_warning
from imutool.errors import ConfigError

if TYPE_CHECKING:
    from imutool.fleet.rerun_catalog import Catalog, CatalogReport, WorstLog
    from imutool.fleet.rerun_layers import Layers

WAITS_S = 3600.0  # Ctrl-C ends it at once
BY_HELP = "Measure of the worst logs: aoe, score, bias, effects or losses; by default the first that a log has."
CACHE_HELP = "Folder for the layers' files; by default DIR/catalog. They are written once."
LAYERS = Written(files=("*.rrd", "layout.rbl"), keeps=True)  # named by digests: a file stays, or is the same
COLUMNS = {"status": "status", "aoe_raw_deg": "AOE raw\n°", "aoe_deg": "AOE\n°", "score": "score"}
COLUMNS |= {"gyro_bias_deg_s": "gyro bias\n°/s", "effects": "effects", "losses": "losses", "robot": "robot"}


@fleet.command("view", epilog="Example: [bold]imutool fleet view debiased/ --web[/]")
def view(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR", help="OUT folders of `imutool fleet`, of the same logs.")],
    worst: Annotated[int, typer.Option(min=1, help="Number of logs to list and to open.")] = 10,
    by: Annotated[str | None, typer.Option(metavar="MEASURE", help=BY_HELP)] = None,
    web: Annotated[bool, typer.Option("--web", help="Open in a browser on this machine instead of a viewer.")] = False,
    list_only: Annotated[bool, typer.Option("--list", help="Print the worst logs and end.")] = False,
    port: Annotated[int | None, typer.Option(min=1, max=65535, help="Port of the catalog; else a free one.")] = None,
    cache: Annotated[Path | None, typer.Option(metavar="DIR", help=CACHE_HELP), LAYERS] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Number of logs at once; by default one per core.")] = None,
    common: Common = COMMON,
) -> None:
    """Serve a fleet as a Rerun catalog, and open its worst logs; until Ctrl-C.

    Each log is a segment with the layers raw, debiased and diagnosis. Only this machine can reach the server.
    """
    from imutool.fleet import rerun_catalog, rerun_layers

    rerun_catalog.require_catalog()
    if by is not None and by not in rerun_catalog.MEASURES:
        raise ConfigError(f"{by!r} is no measure", where="by", expected=", ".join(rerun_catalog.MEASURES))
    logs = rerun_layers.logs_of(folders)
    store = cache or folders[0] / rerun_catalog.FOLDER
    built: list[Layers] = []
    with common.progress("Reading") as tell:
        for done in rerun_layers.build(logs, store, workers=workers):
            built.append(done)
            tell(len(built), len(logs), done.name)
    shown = [log for log in built if log.files]
    for log in built:
        if log.trouble:
            tell_warning(f"not shown: {log.name}: {log.trouble}")
    if not shown:
        raise ConfigError("no log of the fleet can be shown", where=folders[0])
    with rerun_catalog.Catalog(shown, store, port) as served:
        measure, logs_worst = served.worst(by, worst)
        report = rerun_catalog.CatalogReport(
            url=served.url,
            segments=len(shown),
            by=measure,
            worst=logs_worst,
            not_shown=[rerun_catalog.NotShown(log.name, log.trouble) for log in built if log.trouble],
        )
        if not common.write(report):
            _show(report, rerun_catalog.MEASURES[measure].meaning)
        sys.stdout.flush()  # a program that reads it through a pipe wants the address now
        if not list_only:
            with contextlib.suppress(KeyboardInterrupt):
                _open(served, logs_worst, web)


def _show(report: CatalogReport, meaning: str) -> None:
    """Print the worst logs as a table."""
    used = [name for name in COLUMNS if any(name in log.values for log in report.worst)]
    rows = [["log", *(COLUMNS[name] for name in used)]]
    rows += [[log.name, *(_cell(log.values.get(name)) for name in used)] for log in report.worst]
    table(rows, keys=1)
    say(f"{len(report.worst)} of {report.segments} logs, the worst first by the {meaning}.")


def _cell(value: float | str | None) -> str:
    return "–" if value is None else format(value, ".4g") if isinstance(value, float) else str(value)


def _open(served: Catalog, logs: Sequence[WorstLog], web: bool) -> None:
    """Open the logs in a viewer or a browser, and serve until Ctrl-C or until the viewer is closed."""
    from imutool.viewing.rerun import viewer
    from imutool.viewing.rerun.web import Server, catalog_site, policy_with

    urls = [served.url, *(log.url for log in reversed(logs))]  # the last one is in front
    say(f"The catalog: {served.url}")
    if web:
        with Server() as page:
            page.policy = policy_with(served.origin)
            page.offer(catalog_site(urls, served.origin))
            say(f"Open {page.url} in a browser on this machine; Ctrl-C ends it.")
            sys.stdout.flush()
            page.serve()
        return
    if not viewer.has_display():
        say("There is no display here. `--web` shows the fleet in a browser, `--list` only lists it. Ctrl-C ends it.")
        sys.stdout.flush()
        while True:
            time.sleep(WAITS_S)
    process = viewer.run("--port", str(viewer.free_port()), "--memory-limit", viewer.MEMORY_LIMIT, *urls)
    say("The viewer is open; closing it ends the command.")
    try:
        process.wait()
    finally:
        process.terminate()
