"""Real viewers without a screen for the tests: Chromium, and Rerun's own viewer on a software Vulkan driver.

python tests/support/viewers.py    brings what is missing where apt-get may, and says what is missing where it may not
"""

from __future__ import annotations

import io
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NoReturn, TypeVar

import numpy as np

Picture = np.ndarray  # rows, columns, RGB in 0 to 255
T = TypeVar("T")

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
DRIVERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")
CHOSEN = ("VK_DRIVER_FILES", "VK_ICD_FILENAMES")  # by which Vulkan's loader is told of a driver
PACKAGES = {"browser": ("chromium",), "driver": ("mesa-vulkan-drivers", "libvulkan1")}
ATTEMPTS, PAUSE_S = 3, 10.0  # at fetching packages

# nothing that a browser asks the network for by itself
FLAGS = (
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)
WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")  # without a graphics card
NO_WEBGL = ("--disable-gpu",)  # a page alone takes a third of the time
WINDOW = (1280, 720)
STARTS_S, STEADY_S, ANSWERS_S = 60.0, 60.0, 30.0  # each takes a second or less where nothing else runs


def browser() -> str | None:
    """Where Chromium is."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


def driver() -> Path | None:
    """What Vulkan's loader reads of the software driver, or of the driver that the environment chooses."""
    chosen = [Path(name) for variable in CHOSEN for name in os.environ.get(variable, "").split(os.pathsep) if name]
    if chosen:
        return next((path for path in chosen if path.is_file()), None)
    return next((path for folder in DRIVERS for path in sorted(Path(folder).glob("lvp_icd*.json"))), None)


def absent(what: str) -> NoReturn:
    """Ends a test that has nothing to look with: in CI it fails."""
    import pytest

    packages = " ".join(PACKAGES[what])
    said = f"there is no {what} here to look with: `make viewers`, or apt-get install {packages}"
    if os.environ.get("CI"):
        pytest.fail(f"{said} (nothing is skipped where CI is set)", pytrace=False)
    pytest.skip(f"NOT LOOKED AT: {said}")


# ── Rerun's own ──────────────────────────────────────────────────────────────────────────────────────────────────────


class DiedError(Exception):
    """The viewer itself ended, which software drivers are known for; no statement about what it showed."""


@dataclass
class Native:
    """A viewer of our own: `client` asks it things, `url` is where recordings go."""

    process: subprocess.Popen[bytes]
    url: str
    said: IO[bytes]
    recording: Any = None

    def __post_init__(self) -> None:
        from rerun.experimental import ViewerClient

        self.client = ViewerClient.connect(self.url)

    def show(self, log: Callable[[Any], None], blueprint: Any) -> None:
        """A recording and its layout, in the place of what was shown before."""
        import rerun as rr

        self.leave()
        if self.client.get_state().recordings:
            self.client.close("all")
        self.recording = rr.RecordingStream("imutool test")
        self.recording.connect_grpc(self.url, default_blueprint=blueprint)
        log(self.recording)
        self.recording.flush(timeout_sec=ANSWERS_S)

    def leave(self) -> None:
        """Lets go of the recording: Rerun complains of a viewer that is gone before."""
        if self.recording is not None:
            self.recording.disconnect()

    def lay_out(self, blueprint: Any) -> None:
        """Another layout of the same recording."""
        self.recording.send_blueprint(blueprint, make_active=True, make_default=True)
        self.recording.flush(timeout_sec=ANSWERS_S)

    def views(self) -> dict[str, str]:
        """The views that are drawn now (a tab behind another is not): identifiers by name."""
        return {view.name: str(view.view_id) for view in self.client.get_state().views}

    def picture(self, view: str | None = None) -> Picture:
        """What is seen when it has stopped changing: of one view, or of the whole window.

        Raises:
            TimeoutError: it goes on changing.
        """
        return steady(lambda: self.client.take_screenshot(view))

    def pictures(self, views: Sequence[Any]) -> list[Picture]:
        """Each of several views that are in front together, when the first of them has stopped changing.

        Raises:
            TimeoutError: it goes on changing, or stays behind.
        """
        end = time.monotonic() + STEADY_S
        while True:
            try:
                return [self.picture(views[0]), *(pixels(self.client.take_screenshot(view)) for view in views[1:])]
            except ConnectionError as error:  # "not found": a new layout, or a tab that was turned, takes a moment
                if self.process.poll() is not None or time.monotonic() > end:
                    raise TimeoutError(f"not all of {len(views)} views came to the front within {STEADY_S:g} s") from error
                time.sleep(0.1)

    @property
    def resident_mib(self) -> float:
        """Memory of the process."""
        import psutil

        return float(psutil.Process(self.process.pid).memory_info().rss / 2**20)

    @property
    def cpu_s(self) -> float:
        """Seconds of a core that the process has used."""
        import psutil

        times = psutil.Process(self.process.pid).cpu_times()
        return float(times.user + times.system)


def steady(
    shoot: Callable[[], bytes], enough: Callable[[Picture], bool] = lambda _: True, seconds: float = STEADY_S
) -> Picture:
    """The first picture that is enough and the same twice.

    Raises:
        TimeoutError: there is none in time.
    """
    end, before = time.monotonic() + seconds, None
    while time.monotonic() < end:
        now = pixels(shoot())
        if before is not None and np.array_equal(now, before) and enough(now):
            return now
        before = now
        time.sleep(0.1)
    raise TimeoutError(f"no steady picture within {seconds:g} s")


def pixels(png: bytes) -> Picture:
    """A PNG as numbers."""
    from PIL import Image

    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image.convert("RGB"))


@contextmanager
def native(
    window: tuple[int, int] = WINDOW, memory: str = "2GiB", *, files: Sequence[Path] = (), path: str | None = None
) -> Iterator[Native]:
    """Rerun's viewer without a window, on a port of its own on loopback, in a software Vulkan driver.

    It opens `files`; with `path` it looks for importers there.

    Raises:
        DiedError: it did not start.
    """
    from imutool.viewing.rerun.viewer import binary

    found = driver() or absent("driver")
    port = free_port()
    options = ["--headless", "--bind", "127.0.0.1", "--port", str(port), "--memory-limit", memory, "--hide-welcome-screen"]
    line = [str(binary()), *map(str, files), *options, "--window-size", f"{window[0]}x{window[1]}"]
    environment = {**os.environ, "RERUN_APP_ONLY": "true", "RUST_LOG": "error", **dict.fromkeys(CHOSEN, str(found))}
    # at other levels of its log it lays notices of its start over the views for some seconds
    environment |= {} if path is None else {"PATH": path}
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(line, env=environment, stdin=subprocess.DEVNULL, stdout=said, stderr=subprocess.STDOUT)
        try:
            _await(process, port, said)
            viewer = Native(process, f"rerun+http://127.0.0.1:{port}/proxy", said)
            try:
                yield viewer
            finally:
                viewer.leave()
        finally:
            process.kill()
            process.wait()


def _await(process: subprocess.Popen[bytes], port: int, said: IO[bytes]) -> None:
    end = time.monotonic() + STARTS_S
    while process.poll() is None and time.monotonic() < end:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.05)
    raise DiedError(last_words(said))


def last_words(said: IO[bytes]) -> str:
    """What a viewer wrote before it ended."""
    said.seek(0)
    return said.read().decode(errors="replace")[-2000:]


def seen(job: Callable[[Native], T], window: tuple[int, int] = WINDOW) -> T:
    """What a job in a viewer returns. A second viewer is asked if the first one dies, never if it shows the wrong thing."""
    for last in (False, True):
        try:
            with native(window) as viewer:
                try:
                    return job(viewer)
                except AssertionError:
                    raise
                except Exception as error:
                    if not _ended(viewer.process):
                        raise
                    raise DiedError(last_words(viewer.said)) from error
        except DiedError:
            if last:
                raise
    raise AssertionError("one of the two returned or raised")


def _ended(process: subprocess.Popen[bytes]) -> bool:
    """Whether it is at its end, which comes a moment after its connections break."""
    try:
        process.wait(1.0)
    except subprocess.TimeoutExpired:
        return False
    return True


# ── Chromium ─────────────────────────────────────────────────────────────────────────────────────────────────────────


@contextmanager
def chromium(*, webgl: bool = False) -> Iterator[Any]:
    """Playwright's `Browser`, Chromium without a window."""
    found = browser() or absent("browser")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        args = [*FLAGS, *(WEBGL if webgl else NO_WEBGL)]
        running = play.chromium.launch(executable_path=found, headless=True, args=args)
        try:
            yield running
        finally:
            running.close()


def free_port() -> int:
    """A port of loopback that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


# ── pixels ───────────────────────────────────────────────────────────────────────────────────────────────────────────


def drawn(picture: Picture, color: tuple[int, int, int], within: float = 40.0) -> int:
    """How many pixels have a colour, or one that an edge mixes with little of its ground (distance in RGB)."""
    return int((np.linalg.norm(picture.astype(float) - np.array(color), axis=-1) <= within).sum())


def saturated(picture: Picture) -> int:
    """How many pixels are neither grey nor near it: a blank page or a spinner has none to speak of."""
    return int((np.ptp(picture.astype(int), axis=-1) > 60).sum())


# ── packages ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def main() -> None:
    """Installs what is missing, if this user may."""
    missing = [*([] if browser() else PACKAGES["browser"]), *([] if driver() else PACKAGES["driver"])]
    if not missing:
        return
    words = " ".join(missing)
    may = [] if hasattr(os, "geteuid") and os.geteuid() == 0 else ["sudo", "-n"]
    allowed = shutil.which("apt-get") and (not may or (shutil.which("sudo") and _runs([*may, "true"])))
    if not allowed:
        print(f"viewers: {words} cannot be installed from here; what they show is NOT LOOKED AT", file=sys.stderr)
        return
    print(f"viewers: apt-get install {words}")
    for attempt in range(ATTEMPTS):
        quiet = [*may, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-qq", "-o", "Acquire::Retries=3"]
        if _runs([*quiet, "update"]) and _runs([*quiet, "install", "-y", "--no-install-recommends", *missing]):
            return
        print(f"viewers: attempt {attempt + 1} of {ATTEMPTS} failed", file=sys.stderr)
        time.sleep(PAUSE_S)
    print(f"viewers: {words} could not be installed; what they show is NOT LOOKED AT", file=sys.stderr)


def _runs(line: list[str]) -> bool:
    return subprocess.run(line, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, check=False).returncode == 0


if __name__ == "__main__":
    main()
