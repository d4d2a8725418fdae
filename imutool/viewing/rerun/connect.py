"""Connection to a running viewer, which is checked before anything is sent."""

from __future__ import annotations

import queue
import socket
import ssl
import threading
import time
from collections.abc import Sequence
from typing import NamedTuple
from urllib.parse import SplitResult, urlsplit

from imutool.errors import ConfigError
from imutool.viewing import Output
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import require_rerun, scene, sdk
from imutool.viewing.rerun.sdk import FLUSH_S, new_stream, recording_name, rerun_version

ANSWER_TIMEOUT_S = 0.6  # for a connection to open, for the first bytes of the listener, and for a viewer's version
CURSOR_TIMEOUT_S = 1.5  # for a recording to arrive before its cursor can be set
PLAIN, SECURE = "rerun+http", ("rerun", "rerun+https")
PATH = "/proxy"
DEFAULT_PORT = 9876

# RFC 9113, 3.4: a client begins with this preface and a SETTINGS frame, and an HTTP/2 server answers with one.
PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
EMPTY_SETTINGS = b"\x00\x00\x00\x04\x00\x00\x00\x00\x00"
FRAME_HEAD_BYTES, SETTINGS = 9, 4


class Listener(NamedTuple):
    """Listener at a URL with the version of its viewer; None where no viewer answered."""

    url: str
    version: str | None


def probe(url: str) -> Listener:
    """Find the listener at a URL, in less than two seconds.

    Raises:
        ConfigError: Rerun is not installed, the URL is not a viewer's, nothing listens, or it is not a viewer.
    """
    require_rerun()
    url = full_url(url)
    _check_http2(url)
    return Listener(url, _viewer_version(url))


def send(logs: Sequence[RunData], peer: Listener, *, source: bool = True, at_s: float | None = None) -> Output:
    """Send all logs to the listener that `probe` found, and set the cursor to `at_s` seconds.

    Raises:
        ConfigError: the listener stopped.
    """
    _check_http2(peer.url)  # logs may have taken minutes to read
    recording = new_stream(recording_name(logs))
    recording.connect_grpc(peer.url)
    scene.send(logs, recording, source=source)
    try:
        recording.flush(timeout_sec=FLUSH_S)
    except (RuntimeError, ValueError) as error:
        raise ConfigError(f"stopped listening ({error})", where=peer.url, fix="Start it again, or use `save`") from error
    finally:
        recording.disconnect()
    if at_s is not None and peer.version is not None:
        set_cursor(peer, at_s)
    return Output("connect", peer.url, f"Sent to {peer.url}{version_mismatch(peer)}.")


def set_cursor(peer: Listener, at_s: float) -> None:
    """Set a viewer's cursor to a time since the first IMU sample, paused.

    Raises:
        ConfigError: the viewer is gone.
    """
    from rerun.experimental import ViewerClient

    end = time.monotonic() + CURSOR_TIMEOUT_S
    while True:
        try:
            ViewerClient.connect(peer.url).set_time(sdk.ELAPSED, duration=at_s, play_state="paused")
        except (ConnectionError, TimeoutError, RuntimeError, ValueError) as error:
            if time.monotonic() > end:  # until then the recording may be on its way
                raise ConfigError(f"the cursor cannot be set ({error})", where=peer.url, fix="Leave `at` out") from error
            time.sleep(0.05)
        else:
            return


def version_mismatch(peer: Listener) -> str:
    """Text that names both versions where they differ; empty where they agree or one is unknown."""
    if peer.version is None or peer.version == rerun_version():
        return ""
    return f", which is Rerun {peer.version}, not {rerun_version()} as here. If something is missing, start it with `rerun`"


def full_url(url: str) -> str:
    """Complete the URL of a viewer from HOST, HOST:PORT or PORT.

    Raises:
        ConfigError: the URL is not a viewer's.
    """
    complete = f"{PLAIN}://127.0.0.1:{url}" if url.isdecimal() else url if "://" in url else f"{PLAIN}://{url}"
    expected = f"{PLAIN}://HOST:PORT{PATH}, HOST:PORT or PORT"
    try:
        parts = urlsplit(complete)
        port = parts.port  # refuses other than a number
    except ValueError as error:
        raise ConfigError(f"{url!r} is no address ({error})", where="connect", expected=expected) from error
    if parts.scheme not in (PLAIN, *SECURE) or not parts.hostname or parts.path.rstrip("/") not in ("", PATH) or parts.query:
        raise ConfigError(f"{url!r} is no address", where="connect", expected=expected)
    return parts._replace(netloc=parts.netloc if port else f"{parts.netloc}:{DEFAULT_PORT}", path=PATH).geturl()


def _check_http2(url: str) -> None:
    """Check that the listener speaks HTTP/2: Rerun's client would wait forever for a silent one.

    Raises:
        ConfigError: nothing listens there, or something else.
    """
    parts = urlsplit(url)
    try:
        plain = socket.create_connection((parts.hostname, parts.port), timeout=ANSWER_TIMEOUT_S)
    except OSError as error:
        raise ConfigError(
            f"nothing listens there ({error.strerror or error})",
            where=url,
            expected="a running viewer",
            fix="Start one with `rerun`, or use `save`",
        ) from error
    try:
        with plain, _encrypted(plain, parts) as line:
            line.sendall(PREFACE + EMPTY_SETTINGS)
            first = line.recv(FRAME_HEAD_BYTES, socket.MSG_WAITALL) if line is plain else line.recv(FRAME_HEAD_BYTES)
    except OSError as error:
        raise _not_a_viewer(url) from error
    if len(first) < FRAME_HEAD_BYTES or first[3] != SETTINGS:
        raise _not_a_viewer(url)


def _encrypted(plain: socket.socket, parts: SplitResult) -> socket.socket:
    """Connection, encrypted where the URL says so."""
    if parts.scheme not in SECURE:
        return plain
    context = ssl.create_default_context()
    context.set_alpn_protocols(["h2"])
    return context.wrap_socket(plain, server_hostname=parts.hostname)


def _viewer_version(url: str) -> str | None:
    """Version of a viewer; None for a bare server or a viewer too old or too busy to answer.

    Raises:
        ConfigError: the listener is not a viewer.
    """
    from rerun.experimental import ViewerClient

    answers: queue.Queue[str | ConnectionError | None] = queue.Queue()

    def ask() -> None:
        try:
            answers.put(ViewerClient.connect(url).get_state().viewer_version)
        except ConnectionError as error:
            answers.put(error)
        except (RuntimeError, TimeoutError, AttributeError):  # the last one: a client of Rerun 0.40
            answers.put(None)

    # a relay server keeps the request for fifteen seconds: nothing waits for that thread
    threading.Thread(target=ask, daemon=True).start()
    try:
        answer = answers.get(timeout=ANSWER_TIMEOUT_S)
    except queue.Empty:
        return None
    if isinstance(answer, ConnectionError):
        if "Unimplemented" in str(answer):
            return None
        raise _not_a_viewer(url) from answer
    return answer


def _not_a_viewer(url: str) -> ConfigError:
    return ConfigError(
        "the program that listens there is not a viewer",
        where=url,
        expected="the address that a viewer prints",
        fix="Start a viewer with `rerun --port auto`, or use `save`",
    )
