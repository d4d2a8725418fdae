"""Requested outputs of a view: checked before any work, then opened, written or served."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace

from imutool import __version__
from imutool.errors import ConfigError, DataError
from imutool.mcap_io.storage.output_conflicts import refuse_existing
from imutool.viewing import Output
from imutool.viewing.html import report
from imutool.viewing.html.drawing import require_matplotlib
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun.sdk import recording_name

if TYPE_CHECKING:
    from imutool.viewing.rerun.connect import Listener
    from imutool.viewing.rerun.web import Server

logger = logging.getLogger(__name__)

WORST = "worst"
NO_VIEWER = "The viewer is not installed (pip install 'imutool[view]')"


@dataclass(frozen=True)
class RequestedOutputs:
    """Outputs that the user requested; a viewer opens without any of them.

    `at` is the start of the cursor: seconds since the first IMU sample, or `worst`, the largest error of a model.
    """

    save: Path | None = None
    connect: str | None = None
    web: bool = False
    port: int | None = None
    export_web: Path | None = None
    png: Path | None = None
    html: Path | None = None
    at: str | None = None
    source: bool = True
    overwrite: bool = False

    @property
    def opens_viewer(self) -> bool:
        """Whether a viewer opens: no output was requested."""
        return not self.needs_rerun and self.png is None and self.html is None

    @property
    def needs_rerun(self) -> bool:
        """Whether a requested output needs Rerun."""
        return self.connect is not None or self.web or self.save is not None or self.export_web is not None

    @property
    def has_cursor(self) -> bool:
        """Whether an output has a cursor; a file has none."""
        return self.opens_viewer or self.connect is not None or self.web or self.export_web is not None


class Outputs:
    """Validates and runs the requested outputs; context manager.

    Listeners and ports are checked before the logs are read. Without a listener at `connect`, an .rrd file is saved instead
    and `refused` holds the error to end with.

    Raises:
        ConfigError: contradictory outputs, `connect` is not an address, or Rerun is needed and not installed.
    """

    def __init__(self, asked: RequestedOutputs) -> None:
        self.asked = asked
        self.refused: ConfigError | None = None
        self._peer: Listener | None = None
        self._server: Server | None = None
        self._stack = ExitStack()
        _check_contradictions(asked)
        _check_extras(asked)
        if not asked.needs_rerun:
            return
        from imutool.viewing.rerun import connect, require_rerun, web

        require_rerun()
        if asked.export_web is not None:
            web.check_folder(asked.export_web, overwrite=asked.overwrite)
        if asked.connect is not None:
            url = connect.full_url(asked.connect)
            try:
                self._peer = connect.probe(url)
            except ConfigError as error:
                self.refused = error
                logger.warning("%s: %s; an .rrd is saved in its place", error.where, error.what)
        if asked.web:
            self._server = self._stack.enter_context(web.Server(asked.port))

    def show(self, logs: Sequence[RunData]) -> list[Output]:
        """Run every requested output, the slowest last.

        Raises:
            ConfigError: a target exists or cannot be written, or a viewer stops listening.
            DataError: `worst` without truth, a time outside the log, or nothing to draw.
        """
        at_s = None if self.asked.at is None else cursor_s(logs, self.asked.at)
        return [*self._pages(logs), *self._recordings(logs, at_s)]

    def versions(self) -> dict[str, str | None]:
        """Versions of imutool, of the installed Rerun, and of the viewer at `connect`."""
        rerun = version("rerun-sdk") if find_spec("rerun") is not None else None
        return {"imutool": __version__, "rerun": rerun, "viewer": rerun if self._peer is None else self._peer.version}

    def serve(self) -> None:
        """Serve the page of `web` until Ctrl-C; return at once without `web`."""
        if self._server is not None:
            self._server.serve()

    def __enter__(self) -> Outputs:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _pages(self, logs: Sequence[RunData]) -> Iterator[Output]:
        """Outputs without Rerun."""
        if (page := self.asked.html) is not None:
            yield _page(logs, page, self.asked.overwrite)
        if (folder := self.asked.png) is not None:
            for data in report.with_unique_names(logs):
                paths = report.write_pngs(data, folder, overwrite=self.asked.overwrite)
                listed = ", ".join(map(str, paths))
                yield Output("png", str(folder), f"Drew {listed}" if paths else f"There is nothing to draw of {data.name}")

    def _recordings(self, logs: Sequence[RunData], at_s: float | None) -> Iterator[Output]:
        """Outputs with Rerun."""
        asked = self.asked
        if asked.opens_viewer:
            yield _open(logs, asked, at_s)
        if not asked.needs_rerun:
            return
        from imutool.viewing.rerun import connect, scene, web

        if asked.save is not None or self.refused is not None:
            yield scene.save(logs, asked.save, source=asked.source, overwrite=asked.overwrite)
        if asked.export_web is not None:
            yield web.export(logs, asked.export_web, source=asked.source, at_s=at_s, overwrite=asked.overwrite)
        if self._peer is not None:
            yield connect.send(logs, self._peer, source=asked.source, at_s=at_s)
        if self._server is not None:
            yield self._server.offer(web.site(logs, source=asked.source, at_s=at_s))


def cursor_s(logs: Sequence[RunData], at: str) -> float:
    """Cursor time (s since the first IMU sample) from `at`: seconds, or `worst`.

    The error is the orientation error of the models, of raw without a model.

    Raises:
        ConfigError: neither a number nor `worst`.
        DataError: no log has truth, or the time is outside them all.
    """
    if at == WORST:
        data = next((data for data in logs if any(trace.errors is not None for trace in data.traces)), None)
        if data is None:
            raise DataError("no log has truth, so the worst error is unknown", where="at", fix="Give the time in seconds")
        peaks = [trace.errors for trace in data.models() or data.traces if trace.errors is not None]
        worst = max(peaks, key=lambda errors: float(np.nanmax(errors.orientation_total_deg)))
        row = int(np.nanargmax(worst.orientation_total_deg))
        return float(data.elapsed_s(worst.t_ns[row : row + 1])[0])
    longest = max(data.duration_s for data in logs)
    try:
        seconds = float(at)
    except ValueError as error:
        raise ConfigError(f"{at!r} is no time", where="at", expected="seconds since the first IMU sample, or worst") from error
    if not 0.0 <= seconds <= longest:
        raise DataError(f"{at} s is outside the log", where="at", expected=f"0 to {longest:.3f} s")
    return seconds


def _open(logs: Sequence[RunData], asked: RequestedOutputs, at_s: float | None) -> Output:
    """Open a viewer, or write a page without Rerun."""
    if find_spec("rerun") is None:
        path = Path(f"{recording_name(logs)}.html")
        refuse_existing(path, overwrite=asked.overwrite, choose="Give another name as `html`")
        page = _page(logs, path, asked.overwrite)
        return replace(page, said=f"{NO_VIEWER}. {page.said}")
    from imutool.viewing.rerun import viewer

    return viewer.show(logs, source=asked.source, at_s=at_s, overwrite=asked.overwrite)


def _page(logs: Sequence[RunData], path: Path, overwrite: bool) -> Output:
    report.write_page(logs, path, overwrite=overwrite)
    return Output("html", str(path), f"Wrote {path}. Open it in a browser")


def _check_extras(asked: RequestedOutputs) -> None:
    """Refuses before the logs are read what a missing package or an existing page would refuse after (ConfigError)."""
    if asked.html is not None:
        report.check_target(asked.html, overwrite=asked.overwrite)
    if asked.png is not None:
        require_matplotlib()
    if asked.opens_viewer and find_spec("rerun") is None and find_spec("matplotlib") is None:
        what = "neither the viewer nor matplotlib for a page is installed"
        raise ConfigError(what, where="view", fix="Install them with: pip install 'imutool[view,report]'")


def _check_contradictions(asked: RequestedOutputs) -> None:
    """Refuses outputs that exclude each other, and settings without an output (ConfigError)."""
    if asked.connect is not None and asked.web:
        raise ConfigError("`connect` and `web` exclude each other", where="view", fix="Leave one of them out")
    if asked.port is not None and not asked.web:
        raise ConfigError(f"{asked.port} has no effect without `web`", where="port", fix="Add `web`")
    if asked.at is not None and not asked.has_cursor:
        raise ConfigError("a file has no cursor", where="at", fix="Leave it out, or add `connect`, `web` or `export_web`")
