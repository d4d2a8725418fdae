"""What was opened or written to be looked at, in a sentence for people and in fields for programs."""

from __future__ import annotations

from typing import Literal, NamedTuple

How = Literal["viewer", "connect", "rrd", "web", "folder", "png", "html"]


class Output(NamedTuple):
    """One way to look that was taken: `place` is a URL or a path, `said` says it and how to go on."""

    how: How
    place: str
    said: str

    def plain(self) -> dict[str, str]:
        """The fields by name, for JSON."""
        return self._asdict()
