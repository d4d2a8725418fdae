"""A viewer of our own: started, given the logs, and left to the person; or the next best thing."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from imutool.errors import ConfigError
from imutool.viewing.model.output import Output
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import connect, files
from imutool.viewing.rerun.connect import Peer
from imutool.viewing.rerun.sdk import LOGGING, ONLY_NEW, need_sdk, title, version

MEMORY_LIMIT = "50%"  # of the machine, for a viewer of our own: by default it takes three quarters
STARTS_S = 10.0  # for a viewer that lives but does not listen yet, as from a slow disk; one that dies is seen at once
SETTLES_S = 1.0  # within which one that finds no window or no graphics has died, though it listened

VIEWERS: list[subprocess.Popen[bytes]] = []  # they outlive us; held so that Python does not warn of a lost child


def show(logs: Sequence[RunData], *, source: bool = True, at_s: float | None = None, overwrite: bool = False) -> Output:
    """Opens a viewer; where there is no display or the viewer does not start, saves NAME.rrd here, and says so.

    Raises:
        ConfigError: no log, Rerun is not installed, or the file exists (without `overwrite`) or cannot be written.
    """
    title(logs)  # refuses where there is no log
    need_sdk()
    try:
        return open_viewer(logs, source=source, at_s=at_s)
    except ConfigError as error:
        trouble = sentence(error)
    saved = files.save(logs, source=source, overwrite=overwrite)
    return saved._replace(said=f"{trouble}{saved.said}, or look in a browser: imutool view --web")


def open_viewer(logs: Sequence[RunData], *, source: bool = True, at_s: float | None = None) -> Output:
    """Opens a viewer of our own with all logs, the cursor at `at_s` seconds.

    Raises:
        ConfigError: no display, no viewer, or it does not live long enough to take the logs.
    """
    viewer = start()
    if trouble := viewer.trouble():  # before anything is sent: Rerun's client tries for 40 s to reach one that has died
        raise trouble
    try:
        connect.send(logs, viewer.peer, source=source, at_s=at_s)
    except ConfigError as error:
        raise viewer.trouble() or error from error
    if trouble := viewer.trouble(wait_s=0.0):
        raise trouble
    return Output("viewer", viewer.peer.url, "The viewer is open.")


def open_empty() -> Peer:
    """Opens a viewer of our own for what is still to come.

    Raises:
        ConfigError: no display, no viewer, or it dies at once.
    """
    viewer = start()
    if trouble := viewer.trouble():
        raise trouble
    return viewer.peer


def has_display() -> bool:
    """Whether a window can open here: always asked before a viewer is, since Rerun finds out only after 18 s."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


class Viewer(NamedTuple):
    """A viewer of our own that was started, and where it listens."""

    process: subprocess.Popen[bytes]
    peer: Peer

    def trouble(self, wait_s: float = SETTLES_S) -> ConfigError | None:
        """What became of it, if it has died or does so now: one that finds no window listens before it notices."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(wait_s)
        return None if self.process.returncode is None else _stopped(self.process)


def start() -> Viewer:
    """Starts a viewer of our own, on loopback and a free port.

    Raises:
        ConfigError: no display, no viewer, or it dies at once or does not listen.
    """
    if not has_display():
        raise _trouble("there is no display here")
    port = free_port()
    process = run("--port", str(port), "--memory-limit", MEMORY_LIMIT, "--hide-welcome-screen")
    VIEWERS.append(process)
    if not listens(process, port, STARTS_S):
        if process.poll() is not None:
            raise _stopped(process)
        process.terminate()
        raise _trouble(f"the viewer did not listen within {STARTS_S:g} s")
    return Viewer(process, Peer(f"{connect.PLAIN}://127.0.0.1:{port}{connect.PATH}", version()))


def run(*arguments: str) -> subprocess.Popen[bytes]:
    """Rerun's own program, silent, reachable from this machine only and alive after us.

    Raises:
        ConfigError: it is missing or the system does not run it.
    """
    env = {name: value for name, value in os.environ.items() if (name, value) != (LOGGING, ONLY_NEW)}  # it may say all
    quiet: Mapping[str, Any] = {
        "env": env,
        "stdin": subprocess.DEVNULL,
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
    }
    try:
        return subprocess.Popen([str(binary()), "--bind", "127.0.0.1", *arguments], **quiet, start_new_session=True)
    except OSError as error:
        raise _trouble(f"the viewer cannot be started ({error.strerror})") from error


def listens(process: subprocess.Popen[bytes], port: int, within_s: float) -> bool:
    """Whether a program listens on a port of this machine before it dies or the time is up."""
    end = time.monotonic() + within_s
    while time.monotonic() < end and process.poll() is None:
        with socket.socket() as line:
            line.settimeout(0.2)
            if line.connect_ex(("127.0.0.1", port)) == 0:
                return True
        time.sleep(0.02)
    return False


def free_port() -> int:
    """A port of this machine on which nobody listened a moment ago."""
    with socket.socket() as line:
        line.bind(("127.0.0.1", 0))
        return int(line.getsockname()[1])


def binary() -> Path:
    """The viewer itself: its Python wrapper needs a PATH, and outlives nothing it starts."""
    spec = importlib.util.find_spec("rerun_cli")  # comes with rerun-sdk
    folders = list(spec.submodule_search_locations or ()) if spec else [""]
    return Path(folders[0]) / ("rerun.exe" if sys.platform == "win32" else "rerun")


def sentence(error: ConfigError) -> str:
    """What went wrong as the beginning of what is said."""
    return f"{error.what[0].upper()}{error.what[1:]}. "


def _trouble(what: str) -> ConfigError:
    return ConfigError(what, where="view", fix="Use --save for a file, or --web for a browser")


def _stopped(process: subprocess.Popen[bytes]) -> ConfigError:
    return _trouble(f"the viewer stopped at once (exit code {process.returncode})")
