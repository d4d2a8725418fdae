"""A viewer that runs already, here or on another machine: asked who it is before anything is sent to it."""

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
from imutool.viewing.model.output import Output
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import layout, scene
from imutool.viewing.rerun.entities import clock
from imutool.viewing.rerun.sdk import FLUSH_S, need_sdk, stream, version

REACH_S = 0.6  # for a connection to open, for the first words of whoever is there, and for a viewer to say what it is
MOVE_S = 1.5  # for a recording to arrive whose cursor is to be set
PLAIN, SECURE = "rerun+http", ("rerun", "rerun+https")
PATH = "/proxy"
DEFAULT_PORT = 9876

# RFC 9113, 3.4: a client begins with these words and a SETTINGS frame, and whoever speaks HTTP/2 answers with one.
PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
EMPTY_SETTINGS = b"\x00\x00\x00\x04\x00\x00\x00\x00\x00"
FRAME_HEAD_BYTES, SETTINGS = 9, 4


class Peer(NamedTuple):
    """Who listens at a URL: `version` is that of the viewer, None where none answered (a server without one, for instance)."""

    url: str
    version: str | None


def probe(url: str) -> Peer:
    """Who listens there, found out in less than two seconds.

    Raises:
        ConfigError: Rerun is not installed, the URL is none of a viewer, nobody listens, or somebody else does.
    """
    need_sdk()
    place = full(url)
    _speaks(place)
    return Peer(place, _version(place))


def send(logs: Sequence[RunData], peer: Peer, *, source: bool = True, at_s: float | None = None) -> Output:
    """Sends all logs to whoever `probe` found, the cursor set to `at_s` seconds where a viewer can be told.

    Raises:
        ConfigError: it stopped listening.
    """
    _speaks(peer.url)  # logs may have taken minutes to read
    recording = stream(logs)
    recording.connect_grpc(peer.url)
    recording.send_blueprint(layout.blueprint(logs, source=source))
    scene.log(logs, recording, source=source)
    try:
        recording.flush(timeout_sec=FLUSH_S)
    except (RuntimeError, ValueError) as error:
        raise ConfigError(f"stopped listening ({error})", where=peer.url, fix="Start it again, or use --save") from error
    finally:
        recording.disconnect()
    if at_s is not None and peer.version is not None:
        move(peer, at_s)
    return Output("connect", peer.url, f"Sent to {peer.url}{told(peer)}.")


def move(peer: Peer, at_s: float) -> None:
    """Sets a viewer's cursor to a time since the first IMU sample; what it shows then stands still.

    Raises:
        ConfigError: the viewer is gone.
    """
    from rerun.experimental import ViewerClient

    end = time.monotonic() + MOVE_S
    while True:
        try:
            ViewerClient.connect(peer.url).set_time(clock.ELAPSED, duration=at_s, play_state="paused")
        except (ConnectionError, TimeoutError, RuntimeError, ValueError) as error:
            if time.monotonic() > end:  # until then the recording may be on its way
                raise ConfigError(f"the cursor cannot be set ({error})", where=peer.url, fix="Leave --at out") from error
            time.sleep(0.05)
        else:
            return


def told(peer: Peer) -> str:
    """Both versions in words where they differ; nothing where they are the same or the other one is not known."""
    if peer.version is None or peer.version == version():
        return ""
    return f", which is Rerun {peer.version}, not {version()} as here: if something is missing, start that one with `rerun`"


def full(url: str) -> str:
    """The whole URL of a viewer; HOST, HOST:PORT and PORT alone are taken for one.

    Raises:
        ConfigError: it is none.
    """
    words = f"{PLAIN}://127.0.0.1:{url}" if url.isdecimal() else url if "://" in url else f"{PLAIN}://{url}"
    expected = f"{PLAIN}://HOST:PORT{PATH}, HOST:PORT or PORT"
    try:
        parts = urlsplit(words)
        port = parts.port  # refuses what is no number
    except ValueError as error:
        raise ConfigError(f"{url!r} ({error})", where="--connect", expected=expected) from error
    if parts.scheme not in (PLAIN, *SECURE) or not parts.hostname or parts.path.rstrip("/") not in ("", PATH) or parts.query:
        raise ConfigError(f"{url!r}", where="--connect", expected=expected)
    place = parts.netloc if port else f"{parts.netloc}:{DEFAULT_PORT}"
    return parts._replace(netloc=place, path=PATH).geturl()


def _speaks(url: str) -> None:
    """Nothing, if somebody is there who speaks HTTP/2; Rerun's own client would wait for a silent one without an end.

    Raises:
        ConfigError: nobody, or somebody else.
    """
    parts = urlsplit(url)
    try:
        plain = socket.create_connection((parts.hostname, parts.port), timeout=REACH_S)
    except OSError as error:
        raise ConfigError(
            f"nobody listens there ({error.strerror or error})",
            where=url,
            expected="a running viewer",
            fix="Start one with `rerun`, or use --save",
        ) from error
    try:
        with plain, _dressed(plain, parts) as line:
            line.sendall(PREFACE + EMPTY_SETTINGS)
            first = line.recv(FRAME_HEAD_BYTES, socket.MSG_WAITALL) if line is plain else line.recv(FRAME_HEAD_BYTES)
    except OSError as error:
        raise _foreign(url) from error
    if len(first) < FRAME_HEAD_BYTES or first[3] != SETTINGS:
        raise _foreign(url)


def _dressed(plain: socket.socket, parts: SplitResult) -> socket.socket:
    """The connection, encrypted where the URL says so."""
    if parts.scheme not in SECURE:
        return plain
    context = ssl.create_default_context()
    context.set_alpn_protocols(["h2"])
    return context.wrap_socket(plain, server_hostname=parts.hostname)


def _version(url: str) -> str | None:
    """What a viewer says it is; None for a server without one, and for one that is too old or too busy to answer at once.

    Raises:
        ConfigError: it is no viewer.
    """
    from rerun.experimental import ViewerClient

    answers: queue.Queue[str | ConnectionError | None] = queue.Queue()

    def ask() -> None:
        try:
            answers.put(ViewerClient.connect(url).get_state().viewer_version)
        except ConnectionError as error:
            answers.put(error)
        except (RuntimeError, TimeoutError):
            answers.put(None)

    # A server that passes on what it gets holds the question for fifteen seconds: nobody waits for that thread.
    threading.Thread(target=ask, daemon=True).start()
    try:
        answer = answers.get(timeout=REACH_S)
    except queue.Empty:
        return None
    if isinstance(answer, ConnectionError):
        if "Unimplemented" in str(answer):
            return None
        raise _foreign(url) from answer
    return answer


def _foreign(url: str) -> ConfigError:
    return ConfigError(
        "somebody listens there, but it is no viewer",
        where=url,
        expected="the address that a viewer says it listens on",
        fix="Start a viewer with `rerun --port auto`, or use --save",
    )
