"""The ways to look: a viewer of our own, or .rrd files for one."""

from __future__ import annotations

import importlib.util
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from imutool.errors import ConfigError
from imutool.mcap_io.target import Target
from imutool.view.rerun.layout import blueprint
from imutool.view.rerun.scene import log
from imutool.view.rerun.sdk import FLUSH_S, need_sdk, stream
from imutool.view.rundata import RunData

MEMORY_LIMIT = "50%"  # of the machine, for a viewer of our own: by default it takes three quarters
VIEWER_STARTS_S = 10.0

VIEWERS: list[subprocess.Popen[bytes]] = []  # they outlive us; held so that Python does not warn of a lost child


def show(logs: Sequence[RunData], *, save: Path | None = None, spawn: bool | None = None, overwrite: bool = False) -> str:
    """Opens the viewer or saves .rrd files, and returns a sentence that says which and how to go on.

    Without `save` and `spawn`, the viewer opens if there is a display, else the logs are saved as NAME.rrd here.
    Several logs are several recordings in one viewer, or several files in the folder `save`. A display is looked for
    before anything is sent, and a viewer that does not start is given up after ten seconds, at once if it dies; if
    nobody insisted on it with `spawn`, the logs are then saved instead.

    Raises:
        ConfigError: no log, Rerun is not installed, no display though `spawn` is true, or the target cannot be written.
    """
    if not logs:
        raise ConfigError("there is no log to show", where="view")
    need_sdk()
    wants_viewer = spawn if spawn is not None else save is None and has_display()
    if wants_viewer and not has_display():
        raise ConfigError("there is no display (DISPLAY and WAYLAND_DISPLAY are not set)", where="view", fix="Use --save")
    said = []
    if wants_viewer:
        trouble = _open(logs)
        if trouble and spawn:
            raise ConfigError(trouble, where="view", fix="Use --save")
        said.append(trouble or "The viewer is open.")
    elif save is None:
        said.append("There is no display here.")
    if save is not None or not wants_viewer or trouble:
        said.append(_save(logs, save, overwrite))
    return " ".join(said)


def has_display() -> bool:
    """Whether a window can open here: always asked before a viewer is, since Rerun finds out only after 18 s."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def rrd(data: RunData) -> bytes:
    """The log and its layout as the content of an .rrd file.

    Raises:
        ConfigError: Rerun is not installed.
    """
    need_sdk()
    import rerun as rr

    recording = stream(data)
    written = rr.binary_stream(recording)
    recording.send_blueprint(blueprint([data]))
    log([data], recording)
    content = written.read(flush_timeout_sec=FLUSH_S)
    assert content, "a stream that was written to holds bytes"
    return bytes(content)


def _save(logs: Sequence[RunData], save: Path | None, overwrite: bool) -> str:
    """Saves one file, or a file per log in a folder, and says how to open them."""
    names = [re.sub(r"[^\w.-]", "_", data.name) + ".rrd" for data in logs]
    if len(logs) > 1:
        folder = save or Path()
        if folder.suffix == ".rrd" or folder.is_file():
            raise ConfigError(f"{len(logs)} logs do not fit one .rrd", where=folder, expected="a folder")
        targets = [folder / name for name in names]
    elif save is not None and save.is_dir():
        targets = [save / names[0]]
    else:
        targets = [save or Path(names[0])]
    if len(set(targets)) < len(targets):
        raise ConfigError("two logs have the same name", where=save or Path(), expected="names of their own")
    if len(logs) > 1:
        _make(targets[0].parent)
    with ExitStack() as stack:  # every target is refused before the first is written, and none is left alone
        opened = [stack.enter_context(Target(target, overwrite=overwrite)) for target in targets]
        for data, target in zip(logs, opened, strict=True):
            target.write(rrd(data))
    listed = " ".join(str(target) for target in targets)
    return f"Saved {listed}. Open with: rerun {listed}"


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"the folder cannot be made ({error.strerror})", where=folder) from error


def _open(logs: Sequence[RunData]) -> str:
    """Opens a viewer of our own and sends the logs; an empty string, or what went wrong."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    arguments = ["--bind", "127.0.0.1", "--port", str(port), "--memory-limit", MEMORY_LIMIT, "--hide-welcome-screen"]
    quiet: Mapping[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    try:
        viewer = subprocess.Popen([str(binary()), *arguments], **quiet, start_new_session=True)
    except OSError as error:
        return f"The viewer cannot be started ({error.strerror})."
    VIEWERS.append(viewer)
    if not _answers(viewer, port):
        if viewer.poll() is None:
            viewer.terminate()
            return f"The viewer did not answer within {VIEWER_STARTS_S:g} s."
        return f"The viewer stopped at once (exit code {viewer.returncode})."
    for data in logs:
        recording = stream(data)
        recording.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy", default_blueprint=blueprint([data]))
        log([data], recording)
        try:
            recording.flush(timeout_sec=FLUSH_S)
        except (RuntimeError, ValueError) as error:
            return f"The viewer stopped listening ({error})."
        recording.disconnect()
    return ""


def _answers(viewer: subprocess.Popen[bytes], port: int) -> bool:
    """Whether the viewer listens before it dies or the time is up."""
    end = time.monotonic() + VIEWER_STARTS_S
    while time.monotonic() < end and viewer.poll() is None:
        with socket.socket() as probe:
            probe.settimeout(0.2)
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return True
        time.sleep(0.05)
    return False


def binary() -> Path:
    """The viewer itself: its Python wrapper needs a PATH, and outlives nothing it starts."""
    spec = importlib.util.find_spec("rerun_cli")  # comes with rerun-sdk
    folders = list(spec.submodule_search_locations or ()) if spec else [""]
    return Path(folders[0]) / ("rerun.exe" if sys.platform == "win32" else "rerun")
