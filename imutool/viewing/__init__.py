"""Pictures and pages of a log, the data behind them, and the viewer that shows them."""

from __future__ import annotations

from typing import Literal

from imutool.report import Section

How = Literal["viewer", "connect", "rrd", "web", "folder", "png", "html"]


class Output(Section, frozen=True):
    """Output of a view: `place` is a URL or a path, `said` a sentence on how to open it."""

    how: How
    place: str
    said: str
