"""What everything that talks to Rerun needs: the library or a clear word that it is missing, recordings and entity paths."""

from __future__ import annotations

import re
import uuid
from typing import TYPE_CHECKING

from imutool.errors import ConfigError
from imutool.view.rundata import RunData

if TYPE_CHECKING:
    import rerun as rr

FLUSH_S = 30.0


def need_sdk() -> None:
    """Nothing, if Rerun is there.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import rerun  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            f"the viewer is not installed ({error})", where="view", fix="Install it with: pip install 'imutool[view]'"
        ) from error


def stream(data: RunData) -> rr.RecordingStream:
    """A recording of its own, in an application of its own: Rerun keeps one layout per application."""
    need_sdk()
    import rerun as rr

    plain = re.sub(r"[^A-Za-z0-9_-]", "_", data.name)[:100]
    return rr.RecordingStream(f"imutool {plain}", recording_id=f"{plain}-{uuid.uuid4().hex[:8]}")


def entity_path(*parts: str) -> str:
    """An entity path of which every part may hold any character."""
    import rerun as rr

    return str(rr.new_entity_path(list(parts)))
