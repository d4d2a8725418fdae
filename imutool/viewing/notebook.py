"""Show logs in a notebook: the viewer as a widget, or the HTML report in a frame.

::

    from imutool.viewing import notebook
    from imutool.viewing.model.load_view import load

    notebook.show([load("MH_04.mcap", models=["euroc-adis16448-hybrid"])])
"""

from __future__ import annotations

import html
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING

from imutool.errors import ConfigError
from imutool.viewing.html import report
from imutool.viewing.model.run_data import RunData

if TYPE_CHECKING:
    from rerun.notebook import Viewer

ASSET = "RERUN_NOTEBOOK_ASSET"  # source of the widget's program; by default a server of Rerun's
INLINE = "inline"  # the installed package: works without a network and with a remote notebook server
HEIGHT_PX = 720


def show(logs: Sequence[RunData], *, source: bool = True) -> Viewer:
    """Viewer widget with all logs, as wide as its cell; nothing comes from the network.

    The first widget of a session takes some seconds. RERUN_NOTEBOOK_ASSET, set before, selects another source of its program.

    Raises:
        ConfigError: no log, or the extra `notebook` is not installed.
    """
    if find_spec("rerun") is None or find_spec("rerun_notebook") is None:
        raise ConfigError(
            "the viewer for notebooks is not installed",
            where="notebook",
            fix="Install it with: pip install 'imutool[notebook]', or show notebook.page(logs) instead",
        )
    from imutool.viewing.rerun import scene
    from imutool.viewing.rerun.sdk import FLUSH_S, new_stream, recording_name

    recording = new_stream(recording_name(logs))
    os.environ.setdefault(ASSET, INLINE)  # read when the next line first runs
    from rerun.notebook import Viewer

    viewer = Viewer(width="auto", height=HEIGHT_PX, recording=recording)
    scene.send(logs, recording, source=source)
    recording.flush(timeout_sec=FLUSH_S)  # the widget has everything now
    return viewer


@dataclass(frozen=True)
class Page:
    """HTML page that a notebook shows in a sandboxed frame."""

    content: str = field(repr=False)

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {HEIGHT_PX}px; border: 0"
        return f'<iframe sandbox="" style="{style}" srcdoc="{html.escape(self.content)}"></iframe>'


def page(logs: Sequence[RunData]) -> Page:
    """HTML report of all logs, which also shows in a saved notebook.

    Raises:
        ConfigError: no log, or matplotlib is not installed.
    """
    return Page(report.page(logs))
