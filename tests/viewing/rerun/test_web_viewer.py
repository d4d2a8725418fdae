"""In a real browser `--web` and the folder of `--export-web` draw the log, light and dark, and ask nobody but their server."""

from __future__ import annotations

import http.server
import os
import shutil
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from support import viewers
from support.processes import SOON_S

from imutool.viewing.rerun.entities.styles import XYZ

SIZE = {"width": 800, "height": 500}  # software draws it
MIN = 200  # pixels of a colour; a legend alone has some fifty
WAITS_S = 120.0  # some ten on an idle machine
AT_S = "15"  # the cursor is put somewhere, or the log would play and no two pictures be the same
ELSEWHERE = "http://imutool.invalid/telemetry"


class Silent(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        pass


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a folder on Python's own web server."""
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Silent, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with viewers.chromium(webgl=True) as running:
        yield running


@pytest.fixture(scope="module")
def exported(logs: Path, imutool: Callable[..., subprocess.CompletedProcess[str]], tmp_path_factory: Any) -> Path:
    """The folder of `--export-web`; of this worker, for the logs are shared."""
    folder: Path = tmp_path_factory.mktemp("exported") / "web"
    done = imutool("view", logs / "flight_1.mcap", "--export-web", folder, "--at", AT_S, cwd=logs)
    assert done.returncode == 0, done.stderr
    return folder


class Visit:
    """A page of which every request is noted, and those that leave its server are not let through."""

    def __init__(self, browser: Any, url: str, scheme: str) -> None:
        self.asked: list[str] = []
        self.broken: list[str] = []
        self.context = browser.new_context(color_scheme=scheme, viewport=SIZE)
        self.context.set_default_timeout(1e3 * SOON_S)
        self.page = self.context.new_page()
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("pageerror", lambda error: self.broken.append(str(error)))
        self.page.route(lambda address: not address.startswith(url), lambda route: route.abort())
        self.page.goto(url)
        self.elsewhere = lambda: [address for address in self.asked if not address.startswith((url, "blob:", "data:"))]

    def picture(self, enough: Callable[[Any], bool]) -> Any:
        """The page when it shows enough and stands still."""
        return viewers.steady(self.page.screenshot, enough, WAITS_S)

    def __enter__(self) -> Visit:
        return self

    def __exit__(self, *_: object) -> None:
        self.context.close()


def draws(picture: Any) -> bool:
    """Whether all three axes are there."""
    return all(viewers.drawn(picture, color) >= MIN for color in XYZ)


def is_up(picture: Any) -> bool:
    """Whether the viewer itself is there: its bar warns in orange of the software it draws with."""
    return viewers.saturated(picture[:30]) > 20


def test_the_exported_folder_draws_the_log_and_no_request_leaves_it(browser: Any, exported: Path) -> None:
    with served(exported) as url, Visit(browser, url, "dark") as visit:
        picture = visit.picture(draws)
        assert visit.elsewhere() == []
        assert visit.broken == []
        assert picture[2, SIZE["width"] // 2].max() < 80  # the bar above is dark


def test_the_page_of_web_draws_the_log_and_asks_this_machine_alone(browser: Any, logs: Path, command: str) -> None:
    port = viewers.free_port()
    line = [command, "view", str(logs / "flight_1.mcap"), "--web", "--port", str(port), "--at", AT_S]
    server = subprocess.Popen(
        line, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env={**os.environ, "COLUMNS": "200"}
    )
    try:
        assert server.stdout is not None
        assert f"http://127.0.0.1:{port}/" in server.stdout.readline()
        with Visit(browser, f"http://127.0.0.1:{port}/", "light") as visit:
            picture = visit.picture(draws)
            assert visit.elsewhere() == []
            assert visit.broken == []
            assert picture[2, SIZE["width"] // 2].min() > 180
        server.send_signal(signal.SIGINT)
        assert server.wait(10.0) == 0
    finally:
        server.kill()
        server.communicate()


def test_a_viewer_without_a_recording_is_not_taken_for_one_that_draws(browser: Any, exported: Path, tmp_path: Path) -> None:
    shutil.copytree(exported, tmp_path / "web")
    (tmp_path / "web" / "recording.rrd").write_bytes(b"")
    with served(tmp_path / "web") as url, Visit(browser, url, "dark") as visit:
        assert not draws(visit.picture(is_up))


def test_a_request_that_leaves_the_server_is_seen(browser: Any, tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text(f"<script>fetch('{ELSEWHERE}').catch(() => document.title = 'refused')</script>")
    with served(tmp_path) as url, Visit(browser, url, "dark") as visit:
        visit.page.wait_for_function("document.title === 'refused'")
        assert visit.elsewhere() == [ELSEWHERE]
