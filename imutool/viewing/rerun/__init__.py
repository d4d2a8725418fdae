"""Logs in the Rerun viewer: entities, layouts, and outputs to a viewer, a file or a page.

`rr` and `rrb` are the modules `rerun` and `rerun.blueprint`, imported when a name of theirs is first used: no module of this
room needs Rerun to be imported.
"""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

from imutool.errors import required

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

__all__ = ["require_rerun", "rr", "rrb"]

LOGGING = "RUST_LOG"
LOG_LEVELS = "warn,re_grpc_client=off,re_sdk=off,re_log_encoding=off"  # drops Rerun's lines that repeat our own messages


def require_rerun() -> None:
    """Check that Rerun can be imported.

    Raises:
        ConfigError: Rerun is not installed.
    """
    if LOGGING in os.environ:
        required("rerun", "view", package="the viewer", where="view")
        return
    os.environ[LOGGING] = LOG_LEVELS  # read when Rerun is first imported, and not for other programs of the caller
    try:
        required("rerun", "view", package="the viewer", where="view")
    finally:
        os.environ.pop(LOGGING, None)


class _Rerun:
    """Module of Rerun by its name; ConfigError at its first use where Rerun is not installed."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        require_rerun()
        return getattr(importlib.import_module(self._name), attribute)


if not TYPE_CHECKING:
    rr, rrb = _Rerun("rerun"), _Rerun("rerun.blueprint")
