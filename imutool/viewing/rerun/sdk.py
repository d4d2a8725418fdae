"""What everything that talks to Rerun needs: the library or a clear word that it is missing, recordings and entity paths."""

from __future__ import annotations

import os
import re
import uuid
from collections.abc import Sequence
from typing import TYPE_CHECKING

from imutool.errors import ConfigError
from imutool.viewing.model.run_data import RunData

if TYPE_CHECKING:
    import rerun as rr

FLUSH_S = 30.0
LOGGING = "RUST_LOG"
ONLY_NEW = "warn,re_grpc_client=off,re_sdk=off,re_log_encoding=off"  # of Rerun's own lines, those that say what we do not say


def need_sdk() -> None:
    """Nothing, if Rerun is there.

    Raises:
        ConfigError: it is not installed.
    """
    os.environ.setdefault(LOGGING, ONLY_NEW)  # read when Rerun is first imported
    try:
        import rerun  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            f"the viewer is not installed ({error})", where="view", fix="Install it with: pip install 'imutool[view]'"
        ) from error


def stream(logs: Sequence[RunData]) -> rr.RecordingStream:
    """A recording of its own for these logs.

    Raises:
        ConfigError: no log, or Rerun is not installed.
    """
    return named(title(logs))


def named(name: str) -> rr.RecordingStream:
    """A recording of its own, in an application of its own: Rerun keeps one layout per application.

    It has no `log_time` and no `log_tick`: when we drew something is nothing to look at.

    Raises:
        ConfigError: Rerun is not installed.
    """
    need_sdk()
    import rerun as rr

    short = plain(name)
    recording = rr.RecordingStream(f"imutool {short}", recording_id=f"{short}-{uuid.uuid4().hex[:8]}")
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    return recording


def title(logs: Sequence[RunData]) -> str:
    """A name for one or several logs, of letters that files and applications may have.

    Raises:
        ConfigError: no log.
    """
    if not logs:
        raise ConfigError("there is no log to show", where="view")
    more = f"_and_{len(logs) - 1}_more" if len(logs) > 1 else ""
    return plain(logs[0].name) + more


def plain(name: str) -> str:
    """A name of which nothing is left that a file or an application may not be called, or that leads elsewhere."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", name)[:100] or "_"


def version() -> str:
    """The version of the installed Rerun, which is also that of the viewer beside it."""
    import rerun as rr

    return str(rr.__version__)


def entity_path(*parts: str) -> str:
    """An entity path of which every part may hold any character."""
    import rerun as rr

    return str(rr.new_entity_path(list(parts)))
