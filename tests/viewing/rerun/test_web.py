"""The web page: served to this machine alone, or as a folder that any server can serve; it may ask nobody else for anything."""

from __future__ import annotations

import html.parser
import http.client
import socket
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from imutool.errors import ConfigError
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import viewer, web

FAKE = {"re_viewer.js": b"// a viewer", "re_viewer_bg.wasm": b"\0asm"}


@pytest.fixture
def no_program(monkeypatch: pytest.MonkeyPatch) -> None:
    """The viewer's own files, 43 MB, are asked for in one test; elsewhere they are stood in for."""
    monkeypatch.setattr(web, "viewer_files", lambda: dict(FAKE))


@pytest.fixture
def server() -> Iterator[web.Server]:
    with web.Server() as made:
        made.offer({"index.html": b"<p>", "start.js": b"1", "recording.rrd": b"RRF2" * 1000})
        thread = threading.Thread(target=made.serve)
        thread.start()
        yield made
        made.close()
        thread.join()


def ask(
    server: web.Server, path: str, *, method: str = "GET", host: str | None = None
) -> tuple[http.client.HTTPResponse, bytes]:
    line = http.client.HTTPConnection("127.0.0.1", server.port, timeout=5.0)
    try:
        line.request(method, path, headers={} if host is None else {"Host": host})
        answer = line.getresponse()
        return answer, answer.read()
    finally:
        line.close()


class Tags(html.parser.HTMLParser):
    """Every tag with its attributes, and the text of the title."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def test_the_page_and_its_files_are_served_with_their_types_and_the_policy(server: web.Server) -> None:
    for path, kind, length in (("/", "text/html; charset=utf-8", 3), ("/start.js", "text/javascript", 1)):
        answer, content = ask(server, path + "?theme=dark")
        assert (answer.status, answer.headers["Content-Type"], len(content)) == (200, kind, length)
        assert answer.headers["Content-Security-Policy"] == web.POLICY
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
    answer, content = ask(server, "/recording.rrd", method="HEAD")
    assert (answer.headers["Content-Length"], content) == ("4000", b"")


@pytest.mark.parametrize("path", ["/nothing", "/../../etc/passwd", "/%2e%2e/%2e%2e/etc", "//[::1", "/index.html/x"])
def test_nothing_else_is_served(server: web.Server, path: str) -> None:
    answer, content = ask(server, path)
    assert (answer.status, content) == (404, b"")


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "[::1", ""])
def test_a_name_that_was_made_to_lead_here_gets_nothing(server: web.Server, host: str) -> None:
    answer, content = ask(server, "/recording.rrd", host=host)
    assert (answer.status, content) == (404, b"")


def test_it_listens_on_this_machine_only(server: web.Server) -> None:
    lines = Path("/proc/net/tcp").read_text(encoding="ascii").splitlines()[1:]
    listening = [w[1] for w in map(str.split, lines) if w[3] == "0A" and w[1].endswith(f":{server.port:04X}")]
    assert listening == [f"0100007F:{server.port:04X}"]
    everywhere = [*Path("/proc/net/tcp6").read_text(encoding="ascii").splitlines()[1:]]
    assert not [line for line in everywhere if f":{server.port:04X} " in line.split("0A")[0]]


def test_a_port_that_is_taken_is_said_at_once_and_another_one_used() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with web.Server(port) as server:
            shown = server.offer({})
            assert server.port != port
            assert shown.said.startswith(
                f"Port {port} cannot be used (Address already in use). Open http://127.0.0.1:{server.port}/"
            )
    with web.Server(port) as server:
        assert (server.port, server.moved) == (port, "")


def test_the_pages_own_words_are_escaped_and_it_holds_no_address_but_its_own(data: RunData, no_program: None) -> None:
    page = web.site([replace(data, name="a</title><script>alert(1)</script>")], at_s=1.5)["index.html"].decode()
    found = Tags(page)
    assert [attributes.get("src") for tag, attributes in found.tags if tag == "script"] == ["re_viewer.js", "start.js"]
    assert "alert" not in page.replace("alert_1_", "")
    policies = [a["content"] for tag, a in found.tags if tag == "meta" and a.get("http-equiv") == "Content-Security-Policy"]
    assert policies == [web.POLICY]
    assert "://" not in page
    (canvas,) = [attributes for tag, attributes in found.tags if tag == "canvas"]
    assert (canvas["data-recording"], canvas["data-at-ns"]) == ("recording.rrd", "1500000000")
    assert "$" not in page


def test_the_policy_lets_nothing_in_or_out_but_the_pages_own_origin() -> None:
    rules = {words[0]: words[1:] for words in map(str.split, web.POLICY.split(";"))}
    assert rules["default-src"] == ["'none'"]
    assert rules["connect-src"] == ["'self'"]
    assert rules["script-src"] == ["'self'", "'wasm-unsafe-eval'"]
    assert not [source for sources in rules.values() for source in sources if "*" in source or "http" in source]


def test_the_viewers_files_come_out_of_the_installed_program() -> None:
    found = web.viewer_files()
    assert set(found) == set(web.RERUN_FILES)
    assert found["re_viewer_bg.wasm"][:4] == b"\0asm"
    assert b"WebHandle" in found["re_viewer.js"]
    assert b"viewer_control" in found["re_viewer.js"]  # by which our page moves the cursor


@pytest.mark.parametrize("binary", ["/bin/false", "/nowhere/rerun"])
def test_a_program_that_does_not_run_is_said(monkeypatch: pytest.MonkeyPatch, binary: str) -> None:
    monkeypatch.setattr(viewer, "binary", lambda: Path(binary))
    with pytest.raises(ConfigError, match=r"cannot be|does not serve"):
        web.viewer_files()


def test_a_folder_holds_the_whole_page_and_replaces_only_itself(data: RunData, no_program: None, tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "web"
    shown = web.export([data], folder)
    assert {path.name for path in folder.iterdir()} == set(web.FILES)
    assert shown.place == str(folder / "index.html")
    assert f"--directory {folder}" in shown.said
    with pytest.raises(ConfigError, match="exists"):
        web.export([data], folder)
    (folder / "start.js").write_bytes(b"old")
    web.export([data], folder, overwrite=True)
    assert (folder / "start.js").read_bytes() == (Path(web.__file__).parent / "site" / "start.js").read_bytes()
    assert [path.name for path in folder.parent.iterdir()] == ["web"]


def test_a_folder_with_anything_else_in_it_is_never_replaced(data: RunData, no_program: None, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years", encoding="ascii")
    with pytest.raises(ConfigError, match=r"thesis\.tex"):
        web.export([data], tmp_path, overwrite=True)
    with pytest.raises(ConfigError, match="is a file"):
        web.export([data], tmp_path / "thesis.tex", overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_a_failure_on_the_way_leaves_the_old_folder_and_no_other(
    data: RunData, no_program: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: BaseException
) -> None:
    folder = tmp_path / "web"
    web.export([data], folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    rename = Path.rename

    def fail(path: Path, target: Path) -> Path:
        if target == folder and ".partial" in path.name and not path.name.endswith(".replaced"):
            raise failure
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", fail)
    with pytest.raises((KeyboardInterrupt, ConfigError)):
        web.export([data], folder, overwrite=True)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["web"]
