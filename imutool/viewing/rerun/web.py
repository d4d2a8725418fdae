"""The viewer as a web page: its files out of the installed Rerun, the recording beside them, served to this machine only."""

from __future__ import annotations

import contextlib
import html
import http.server
import urllib.request
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from imutool.errors import ConfigError
from imutool.recording import nanoseconds
from imutool.viewing.model.output import Output
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import viewer
from imutool.viewing.rerun.files import rrd
from imutool.viewing.rerun.sdk import need_sdk, title

PAGE, START, RECORDING = "index.html", "start.js", "recording.rrd"
THEIRS = ("re_viewer.js", "re_viewer_bg.wasm")  # Rerun's own, as built for the installed version
FILES = (PAGE, START, RECORDING, *THEIRS)
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript",
    ".wasm": "application/wasm",
    ".rrd": "application/octet-stream",
}
STARTS_S, FETCH_S = 1.5, 10.0
LOCAL = ("127.0.0.1", "localhost")

# Rerun's page asks four hosts for fonts, news and statistics; this one may ask nobody but the server it came from.
POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; connect-src 'self'; img-src 'self' data: blob:; "
    "style-src 'unsafe-inline'; worker-src 'self' blob:; base-uri 'none'; form-action 'none'"
)


def site(logs: Sequence[RunData], *, source: bool = True, at_s: float | None = None) -> dict[str, bytes]:
    """The files of a web page that shows all logs: its own, the viewer's and the recording, by name.

    Raises:
        ConfigError: no log, Rerun is not installed, or its program does not run.
    """
    need_sdk()
    ours = Path(__file__).parent / "site"
    words = {"$POLICY": POLICY, "$TITLE": title(logs), "$RECORDING": RECORDING}
    words["$AT_NS"] = "" if at_s is None else str(nanoseconds(at_s))
    page = (ours / PAGE).read_text(encoding="utf-8")
    for word, value in words.items():
        page = page.replace(word, html.escape(value))
    return {PAGE: page.encode(), START: (ours / START).read_bytes(), **assets(), RECORDING: rrd(logs, source=source)}


def assets() -> dict[str, bytes]:
    """The viewer's own files. They are inside Rerun's program, which hands them out as a web server: asked on loopback.

    Raises:
        ConfigError: the program is missing, does not run, or does not hand them out.
    """
    grpc, port = viewer.free_port(), viewer.free_port()
    process = viewer.run("--serve-web", "--port", str(grpc), "--web-viewer-port", str(port))
    try:
        if not viewer.listens(process, port, STARTS_S):
            raise ConfigError("the viewer's web page cannot be had: Rerun's program does not serve it", where=viewer.binary())
        found = {}
        for name in THEIRS:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/{name}", timeout=FETCH_S) as answer:
                found[name] = answer.read()
        return found
    except OSError as error:
        raise ConfigError(f"the viewer's web page cannot be had ({error})", where=viewer.binary()) from error
    finally:
        process.kill()
        process.wait()


class Server:
    """A web server on loopback, bound at once, so that a taken port is known before any work; context manager.

    `moved` says that the port asked for was taken and another one is used.
    """

    def __init__(self, port: int | None = None) -> None:
        self._files: Mapping[str, bytes] = {}
        handler = _handler(self)
        self.moved = ""
        try:
            self._http = http.server.ThreadingHTTPServer(("127.0.0.1", port or 0), handler)
        except (OSError, OverflowError) as error:
            if not isinstance(error, OSError):
                raise ConfigError(f"{port} is no port", where="--port", expected="1 to 65535") from error
            self._http = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
            self.moved = f"Port {port} cannot be had ({error.strerror}). "

    @property
    def port(self) -> int:
        """The port it listens on."""
        return int(self._http.server_port)

    @property
    def url(self) -> str:
        """The address for a browser on this machine."""
        return f"http://127.0.0.1:{self.port}/"

    def file(self, name: str) -> bytes | None:
        """What is served under a name; the page itself under none."""
        return self._files.get(name or PAGE)

    def offer(self, files: Mapping[str, bytes]) -> Output:
        """Takes what is to be served, and says where it is; `serve` then serves it."""
        self._files = files
        return Output("web", self.url, f"{self.moved}Open {self.url} in a browser on this machine; Ctrl-C ends it.")

    def serve(self) -> None:
        """Serves until Ctrl-C or `close`."""
        with contextlib.suppress(KeyboardInterrupt):
            self._http.serve_forever(poll_interval=0.1)

    def close(self) -> None:
        """Stops serving, also from another thread, and gives the port back."""
        self._http.shutdown()
        self._http.server_close()

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self._http.server_close()


def _handler(server: Server) -> type[http.server.BaseHTTPRequestHandler]:
    class Handler(http.server.BaseHTTPRequestHandler):
        """Gives the files that are there, and nothing else, to a browser that asked for this machine by its own name."""

        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            name = self.path.partition("?")[0].lstrip("/")
            # A page from elsewhere whose name was made to lead here would still say its own name: it gets nothing.
            known = self.headers.get("Host", "").partition(":")[0] in LOCAL
            content = server.file(name) if known else None
            self.send_response(200 if content is not None else 404)
            self.send_header("Content-Length", str(len(content or b"")))
            self.send_header("Content-Type", TYPES[Path(name or PAGE).suffix] if content is not None else "text/plain")
            self.send_header("Content-Security-Policy", POLICY)
            self.send_header("X-Content-Type-Options", "nosniff")
            self.send_header("Cross-Origin-Resource-Policy", "same-origin")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            if content and self.command == "GET":
                with contextlib.suppress(ConnectionError):  # a browser that was closed meanwhile
                    self.wfile.write(content)

        do_HEAD = do_GET  # noqa: N815  the library finds it by this name

        def log_message(self, *_: Any) -> None:
            """Nobody wants to read every request."""

    return Handler
