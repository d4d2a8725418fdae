"""Logs in a notebook: the viewer as a widget, or the page that needs nothing but a browser.

::

    from imutool.view import notebook
    from imutool.view.runs import load

    notebook.show([load("MH_04.mcap", models=["euroc-adis16448-hybrid"])])
"""

from __future__ import annotations

import html
import os
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING

from imutool.errors import ConfigError
from imutool.viewing.html import report
from imutool.viewing.model.run_data import RunData

if TYPE_CHECKING:
    from rerun.notebook import Viewer

ASSET = "RERUN_NOTEBOOK_ASSET"  # where Rerun's widget takes its program from; of itself, from a server of Rerun's
INLINE = "inline"  # from the package that is installed: works without a network, and where the notebook's server is elsewhere
HEIGHT_PX = 720


def show(logs: Sequence[RunData], *, height_px: int = HEIGHT_PX, source: bool = True) -> Viewer:
    """A viewer of all logs as wide as its cell, which shows itself at the end of one; nothing comes from the network.

    The first one of a session takes some seconds. Who wants its program from elsewhere sets RERUN_NOTEBOOK_ASSET before.

    Raises:
        ConfigError: no log, or the extra `notebook` is not installed.
    """
    if find_spec("rerun") is None or find_spec("rerun_notebook") is None:
        raise ConfigError(
            "the viewer for notebooks is not installed",
            where="notebook",
            fix="Install it with: pip install 'imutool[notebook]', or show notebook.page(logs) instead",
        )
    from imutool.viewing.rerun import layout, scene
    from imutool.viewing.rerun.sdk import FLUSH_S, stream

    recording = stream(logs)
    os.environ.setdefault(ASSET, INLINE)  # read when the next line is first run
    from rerun.notebook import Viewer

    viewer = Viewer(width="auto", height=height_px, recording=recording)
    recording.send_blueprint(layout.blueprint(logs, source=source))
    scene.log(logs, recording, source=source)
    recording.flush(timeout_sec=FLUSH_S)  # the widget now has everything, and the recording may go
    return viewer


@dataclass(frozen=True)
class Page:
    """A whole page that a notebook shows in a frame of its own, where it can do nothing but be read."""

    content: str
    height_px: int = HEIGHT_PX

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {self.height_px}px; border: 0"
        return f'<iframe sandbox="" style="{style}" srcdoc="{html.escape(self.content)}"></iframe>'


def page(logs: Sequence[RunData], *, height_px: int = HEIGHT_PX) -> Page:
    """The report of all logs, which also shows where no program runs: in a saved notebook, on a web page made of it.

    Raises:
        ConfigError: no log, or matplotlib is not installed.
    """
    return Page(report.page(logs), height_px)
