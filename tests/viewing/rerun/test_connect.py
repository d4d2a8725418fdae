"""Whoever listens at a URL is known before anything is sent to them, whatever they are, in less than two seconds."""

from __future__ import annotations

import http.server
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rerun as rr
from rerun.chunk import RrdReader

from imutool.errors import ConfigError
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import connect, viewer
from imutool.viewing.rerun.connect import Listener

NO_WAIT_S = 2.0
SERVER_STARTS_S = 10.0
BUSY_S = 3.0  # until a server answers, on a machine with other work


class Unread(http.server.BaseHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def website() -> Iterator[str]:
    server = http.server.HTTPServer(("127.0.0.1", 0), Unread)
    thread = threading.Thread(target=server.serve_forever, args=(0.05,))
    thread.start()
    yield f"127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture
def silent() -> Iterator[str]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield f"127.0.0.1:{listening.getsockname()[1]}"


@pytest.fixture
def dead() -> str:
    return f"127.0.0.1:{viewer.free_port()}"


@pytest.fixture
def received(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, Path, subprocess.Popen[bytes]]]:
    """A server that speaks as a viewer does, has none, and keeps what it is sent: its URL, the file and its process."""
    monkeypatch.setattr(connect, "ANSWER_TIMEOUT_S", BUSY_S)
    port, file = viewer.free_port(), tmp_path / "received.rrd"
    process = viewer.run("--save", str(file), "--port", str(port))
    assert viewer.listens(process, port, SERVER_STARTS_S)
    yield f"rerun+http://127.0.0.1:{port}/proxy", file, process
    process.kill()
    process.wait()


@pytest.mark.parametrize(
    ("who", "what"),
    [("dead", "nothing listens"), ("website", "not a viewer"), ("silent", "not a viewer"), ("away", "nothing listens")],
)
@pytest.mark.parametrize("scheme", ["rerun+http", "rerun+https"])
def test_who_is_no_viewer_is_refused_at_once(request: pytest.FixtureRequest, who: str, what: str, scheme: str) -> None:
    place = "no-such-host.invalid:9876" if who == "away" else request.getfixturevalue(who)
    start = time.monotonic()
    with pytest.raises(ConfigError, match=what) as refused:
        connect.probe(f"{scheme}://{place}")
    assert time.monotonic() - start < NO_WAIT_S
    assert place in str(refused.value)
    assert "rerun" in refused.value.fix


def test_a_line_opens_and_answers_within_two_seconds_or_never() -> None:
    assert 3 * connect.ANSWER_TIMEOUT_S < NO_WAIT_S
    assert connect.CURSOR_TIMEOUT_S < NO_WAIT_S


@pytest.mark.parametrize(
    "url",
    ["", "http://127.0.0.1:1", "rerun+http:///proxy", "127.0.0.1:x", "127.0.0.1:99999999", "rerun+http://a:1/b", "a:1?x=1"],
)
def test_what_is_no_url_of_a_viewer_is_refused(url: str) -> None:
    with pytest.raises(ConfigError, match="HOST:PORT"):
        connect.probe(url)


def test_port_host_and_whole_urls_name_the_same_place() -> None:
    full = "rerun+http://127.0.0.1:5555/proxy"
    assert {connect.full_url(words) for words in ("5555", "127.0.0.1:5555", full, full.removesuffix("/proxy"))} == {full}
    assert connect.full_url("example.org") == "rerun+http://example.org:9876/proxy"
    assert connect.full_url("rerun+https://[::1]:1") == "rerun+https://[::1]:1/proxy"


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # the server is ended, which leaves none
def test_a_server_without_a_viewer_is_known_as_such_and_gets_everything(
    data: RunData, received: tuple[str, Path, subprocess.Popen[bytes]]
) -> None:
    url, file, process = received
    peer = connect.probe(url)
    assert peer == Listener(url, None)
    shown = connect.send([data], peer, at_s=1.0)  # nobody there has a cursor
    assert (shown.how, shown.place) == ("connect", url)
    end = time.monotonic() + SERVER_STARTS_S
    while not file.exists() and time.monotonic() < end:
        time.sleep(0.05)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    process.wait(SERVER_STARTS_S)
    reader = RrdReader(file)
    (store,) = reader.recordings()
    found = {chunk.entity_path for chunk in reader.stream(store=store)}
    assert found >= {"/imu/gyro/raw", "/world/raw/path"}


def test_one_that_is_gone_when_the_logs_are_read_is_an_error_that_says_so(
    data: RunData, received: tuple[str, Path, subprocess.Popen[bytes]]
) -> None:
    url, _, process = received
    peer = connect.probe(url)
    process.kill()
    process.wait()
    with pytest.raises(ConfigError, match="nothing listens"):
        connect.send([data], peer)


def test_one_that_is_gone_while_it_is_sent_to_is_an_error_that_says_so(
    data: RunData, received: tuple[str, Path, subprocess.Popen[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    url, _, process = received
    peer = connect.probe(url)
    log = connect.scene.log

    def die_first(*words: Any, **options: Any) -> None:
        process.kill()
        process.wait()
        log(*words, **options)

    monkeypatch.setattr(connect.scene, "log", die_first)
    start = time.monotonic()
    with pytest.raises(ConfigError, match="stopped listening"):
        connect.send([data], peer)
    assert time.monotonic() - start < SERVER_STARTS_S


def test_another_version_is_named_beside_ours() -> None:
    assert connect.version_mismatch(Listener("", "0.40.2")).startswith(f", which is Rerun 0.40.2, not {rr.__version__}")
    assert connect.version_mismatch(Listener("", rr.__version__)) == ""
    assert connect.version_mismatch(Listener("", None)) == ""
