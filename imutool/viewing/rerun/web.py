"""Rerun's web viewer with a recording, served to this machine or exported as a folder."""

from __future__ import annotations

import contextlib
import html
import http.server
import shutil
import urllib.request
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from imutool.errors import ConfigError
from imutool.mcap_io.storage.local import remove_abandoned, temporary_path
from imutool.recording import nanoseconds
from imutool.viewing import Output
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import require_rerun, viewer
from imutool.viewing.rerun.scene import rrd
from imutool.viewing.rerun.sdk import recording_name

PAGE, START, RECORDING = "index.html", "start.js", "recording.rrd"
RERUN_FILES = ("re_viewer.js", "re_viewer_bg.wasm")  # built for the installed version
FILES = (PAGE, START, RECORDING, *RERUN_FILES)
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript",
    ".wasm": "application/wasm",
    ".rrd": "application/octet-stream",
}
FETCH_TIMEOUT_S = 10.0
LOCAL = ("127.0.0.1", "localhost")

# Rerun's own page asks four hosts for fonts, news and statistics; this one may ask only the server it came from.
POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; connect-src 'self'; img-src 'self' data: blob:; "
    "style-src 'unsafe-inline'; worker-src 'self' blob:; base-uri 'none'; form-action 'none'"
)


def site(logs: Sequence[RunData], *, source: bool = True, at_s: float | None = None) -> dict[str, bytes]:
    """Files of a web page with all logs: page, viewer and recording, by name.

    Raises:
        ConfigError: no log, Rerun is not installed, or its program does not run.
    """
    files = _page(recording_name(logs), RECORDING, "" if at_s is None else str(nanoseconds(at_s)))
    return {**files, RECORDING: rrd(logs, source=source)}


def catalog_site(urls: Sequence[str], origin: str) -> dict[str, bytes]:
    """Files of a web page that shows segments of a catalog, which listens at `origin`.

    Raises:
        ConfigError: Rerun is not installed, or its program does not run.
    """
    return _page("fleet", " ".join(urls), policy=policy_with(origin))


def policy_with(origin: str) -> str:
    """Policy of a page that may also ask a catalog at `origin`."""
    return POLICY.replace("connect-src 'self'", f"connect-src 'self' {origin}")


def _page(title: str, recordings: str, at_ns: str = "", policy: str = POLICY) -> dict[str, bytes]:
    """Page and viewer, for recordings separated by spaces."""
    require_rerun()
    folder = Path(__file__).parent / "site"
    page = (folder / PAGE).read_text(encoding="utf-8")
    for name, value in {"$POLICY": policy, "$TITLE": title, "$RECORDING": recordings, "$AT_NS": at_ns}.items():
        page = page.replace(name, html.escape(value))
    return {PAGE: page.encode(), START: (folder / START).read_bytes(), **viewer_files()}


def viewer_files() -> dict[str, bytes]:
    """Viewer files, downloaded on loopback from Rerun's program, which contains and serves them.

    Raises:
        ConfigError: the program is missing, does not run, or does not serve them.
    """
    grpc, port = viewer.free_port(), viewer.free_port()
    process = viewer.run("--serve-web", "--port", str(grpc), "--web-viewer-port", str(port))
    try:
        if not viewer.listens(process, port, viewer.START_TIMEOUT_S):
            raise ConfigError("Rerun's program does not serve the viewer's web page", where=viewer.binary())
        files = {}
        for name in RERUN_FILES:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/{name}", timeout=FETCH_TIMEOUT_S) as answer:
                files[name] = answer.read()
        return files
    except OSError as error:
        raise ConfigError(f"the viewer's web page cannot be read ({error})", where=viewer.binary()) from error
    finally:
        process.kill()
        process.wait()


class Server:
    """Web server on loopback, bound at once so that a used port is known before any work.

    `moved` is a sentence where the requested port is in use and another one serves.
    """

    def __init__(self, port: int | None = None) -> None:
        self._files: Mapping[str, bytes] = {}
        self.policy = POLICY
        handler = _handler(self)
        self.moved = ""
        try:
            self._http = http.server.ThreadingHTTPServer(("127.0.0.1", port or 0), handler)
        except (OSError, OverflowError) as error:
            if not isinstance(error, OSError):
                raise ConfigError(f"{port} is not a port", where="port", expected="1 to 65535") from error
            self._http = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
            self.moved = f"Port {port} cannot be used ({error.strerror}). "

    @property
    def port(self) -> int:
        """Port of the server."""
        return int(self._http.server_port)

    @property
    def url(self) -> str:
        """Address for a browser on this machine."""
        return f"http://127.0.0.1:{self.port}/"

    def file(self, name: str) -> bytes | None:
        """Content of a file; the page for an empty name."""
        return self._files.get(name or PAGE)

    def offer(self, files: Mapping[str, bytes]) -> Output:
        """Set the files that `serve` serves."""
        self._files = files
        return Output("web", self.url, f"{self.moved}Open {self.url} in a browser on this machine; Ctrl-C ends it.")

    def serve(self) -> None:
        """Serve until Ctrl-C or `close`."""
        with contextlib.suppress(KeyboardInterrupt):
            self._http.serve_forever(poll_interval=0.1)

    def close(self) -> None:
        """Stop serving, also from another thread, and release the port."""
        self._http.shutdown()
        self._http.server_close()

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self._http.server_close()


def _handler(server: Server) -> type[http.server.BaseHTTPRequestHandler]:
    class Handler(http.server.BaseHTTPRequestHandler):
        """Serves the files to a browser that addressed this machine by a local name."""

        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            name = self.path.partition("?")[0].lstrip("/")
            # DNS rebinding: a foreign page whose name resolves to this machine still sends its own name, and gets nothing
            local = self.headers.get("Host", "").partition(":")[0] in LOCAL
            content = server.file(name) if local else None
            self.send_response(200 if content is not None else 404)
            self.send_header("Content-Length", str(len(content or b"")))
            self.send_header("Content-Type", TYPES[Path(name or PAGE).suffix] if content is not None else "text/plain")
            self.send_header("Content-Security-Policy", server.policy)
            self.send_header("X-Content-Type-Options", "nosniff")
            self.send_header("Cross-Origin-Resource-Policy", "same-origin")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            if content and self.command == "GET":
                with contextlib.suppress(ConnectionError):  # the browser was closed meanwhile
                    self.wfile.write(content)

        do_HEAD = do_GET  # noqa: N815  http.server calls this name

        def log_message(self, *_: Any) -> None:
            """Log nothing."""

    return Handler


def check_folder(folder: Path, *, overwrite: bool) -> None:
    """Check before the work that the folder can be written.

    Raises:
        ConfigError: a file has that name, the folder has other content, or it exists (without `overwrite`).
    """
    if not folder.exists():
        return
    if not folder.is_dir():
        raise ConfigError("is a file", where=folder, expected="a folder or a new name")
    others = sorted({path.name for path in folder.iterdir()} - set(FILES))
    if others:
        raise ConfigError(f"has other content ({others[0]})", where=folder, fix="Choose another folder")
    if not overwrite and any(folder.iterdir()):
        raise ConfigError("the target exists", where=folder, fix="Choose another folder, or add `overwrite`")


def export(
    logs: Sequence[RunData], folder: Path, *, source: bool = True, at_s: float | None = None, overwrite: bool = False
) -> Output:
    """Write the folder, whole or not at all: the page, the viewer's files and the recording.

    Raises:
        ConfigError: as `check_folder`, Rerun is not installed or does not run, or the system refuses to write.
    """
    check_folder(folder, overwrite=overwrite)
    files = site(logs, source=source, at_s=at_s)
    place = folder.absolute()  # "." has no name
    remove_abandoned(place)
    partial = temporary_path(place)
    try:
        partial.mkdir(parents=True)
        for name, content in files.items():
            (partial / name).write_bytes(content)
        check_folder(folder, overwrite=overwrite)
        _replace_folder(partial, place)
    except OSError as error:
        raise ConfigError(f"cannot be written ({error.strerror})", where=folder, fix="Choose another place") from error
    finally:
        with contextlib.suppress(FileNotFoundError):
            shutil.rmtree(partial)
    served = f"python -m http.server --bind 127.0.0.1 --directory {folder}"
    return Output("folder", str(folder / PAGE), f"Exported {folder} for any web server, for instance: {served}")


def _replace_folder(source: Path, target: Path) -> None:
    """Move a folder to its place; remove an existing one after, restore it on failure."""
    if not target.exists():
        source.rename(target)
        return
    old = source.with_suffix(".replaced")
    target.rename(old)
    try:
        source.rename(target)
    except BaseException:
        old.rename(target)
        raise
    shutil.rmtree(old)
