"""Start a native viewer with the logs, or save an .rrd file where no viewer can open."""

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

from msgspec.structs import replace

from imutool.errors import ConfigError
from imutool.viewing import Output
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import connect, require_rerun, scene
from imutool.viewing.rerun.connect import Listener
from imutool.viewing.rerun.sdk import recording_name, rerun_version

MEMORY_LIMIT = "50%"  # of the machine's memory; the viewer's default is three quarters
START_TIMEOUT_S = 10.0  # for a viewer that runs but does not listen yet, as from a slow disk; a dead one is seen at once
DIES_WITHIN_S = 1.0  # a viewer without a window or graphics listens first and dies within this time

VIEWERS: list[subprocess.Popen[bytes]] = []  # they outlive us; kept so that Python does not warn of a lost child


def show(logs: Sequence[RunData], *, source: bool = True, at_s: float | None = None, overwrite: bool = False) -> Output:
    """Open a viewer, or save NAME.rrd here where no viewer can open.

    Raises:
        ConfigError: no log, Rerun is not installed, or the file exists (without `overwrite`) or cannot be written.
    """
    recording_name(logs)  # refuses where there is no log
    require_rerun()
    try:
        return open_viewer(logs, source=source, at_s=at_s)
    except ConfigError as error:
        trouble = as_sentence(error)
    saved = scene.save(logs, source=source, overwrite=overwrite)
    return replace(saved, said=f"{trouble}{saved.said}, or use a browser: imutool view LOG --web")


def open_viewer(logs: Sequence[RunData], *, source: bool = True, at_s: float | None = None) -> Output:
    """Open a viewer with all logs, the cursor at `at_s` seconds.

    Raises:
        ConfigError: no display, no viewer, or it dies before it has the logs.
    """
    viewer = start()
    try:
        connect.send(logs, viewer.peer, source=source, at_s=at_s)
    except ConfigError as error:
        raise viewer.trouble() or error from error
    if trouble := viewer.trouble():
        raise trouble
    return Output("viewer", viewer.peer.url, "The viewer is open.")


def has_display() -> bool:
    """Whether a window can open here; Rerun itself finds out only after 18 s."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


class Viewer(NamedTuple):
    """Started viewer and the address where it listens."""

    process: subprocess.Popen[bytes]
    peer: Listener

    def trouble(self, wait_s: float = 0.0) -> ConfigError | None:
        """Error if the viewer has died or dies within `wait_s`."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(wait_s)
        return None if self.process.returncode is None else _stopped(self.process)


def start() -> Viewer:
    """Start a viewer on loopback and a free port.

    Raises:
        ConfigError: no display, no viewer, or it dies at once or does not listen.
    """
    if not has_display():
        raise _no_viewer("there is no display here")
    port, began = free_port(), time.monotonic()
    process = run("--port", str(port), "--memory-limit", MEMORY_LIMIT, "--hide-welcome-screen")
    VIEWERS.append(process)
    if not listens(process, port, START_TIMEOUT_S):
        if process.poll() is not None:
            raise _stopped(process)
        process.terminate()
        raise _no_viewer(f"the viewer did not listen within {START_TIMEOUT_S:g} s")
    viewer = Viewer(process, Listener(f"{connect.PLAIN}://127.0.0.1:{port}{connect.PATH}", rerun_version()))
    waited_s = time.monotonic() - began  # on a busy machine it takes longer to listen, and to die
    if trouble := viewer.trouble(max(DIES_WITHIN_S, waited_s)):  # Rerun's client would try for 40 s to reach one that has died
        raise trouble
    return viewer


def run(*arguments: str) -> subprocess.Popen[bytes]:
    """Start Rerun's program: silent, reachable from this machine only, and not stopped with us.

    Raises:
        ConfigError: the program is missing or cannot be started.
    """
    quiet: Mapping[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    try:
        return subprocess.Popen([str(binary()), "--bind", "127.0.0.1", *arguments], **quiet, start_new_session=True)
    except OSError as error:
        raise _no_viewer(f"the viewer cannot be started ({error.strerror})") from error


def listens(process: subprocess.Popen[bytes], port: int, within_s: float) -> bool:
    """Whether a program listens on a local port before it dies or the time is up."""
    end = time.monotonic() + within_s
    while time.monotonic() < end and process.poll() is None:
        with socket.socket() as line:
            line.settimeout(0.2)
            if line.connect_ex(("127.0.0.1", port)) == 0:
                return True
        time.sleep(0.02)
    return False


def free_port() -> int:
    """Local port that was free a moment ago."""
    with socket.socket() as line:
        line.bind(("127.0.0.1", 0))
        return int(line.getsockname()[1])


def binary() -> Path:
    """Path of the viewer's program; its Python wrapper leaves the viewer running when killed."""
    spec = importlib.util.find_spec("rerun_cli")  # comes with rerun-sdk
    folders = list(spec.submodule_search_locations or ()) if spec else [""]
    return Path(folders[0]) / ("rerun.exe" if sys.platform == "win32" else "rerun")


def as_sentence(error: ConfigError) -> str:
    """Error as a sentence."""
    return f"{error.what[0].upper()}{error.what[1:]}. "


def _no_viewer(what: str) -> ConfigError:
    return ConfigError(what, where="view", fix="Use `save` for a file, or `web` for a browser")


def _stopped(process: subprocess.Popen[bytes]) -> ConfigError:
    return _no_viewer(f"the viewer stopped at once (exit code {process.returncode})")
