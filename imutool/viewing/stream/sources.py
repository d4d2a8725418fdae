"""Sources of a live stream: a log at its own speed, standard input, UDP, Zenoh, a rosbridge."""

from __future__ import annotations

import contextlib
import logging
import os
import select
import socket
import sys
import time
from collections.abc import Generator, Iterator
from importlib.util import find_spec
from queue import Empty, Full, Queue
from urllib.parse import urlsplit

import msgspec
import numpy as np

from imutool.array_types import Int64
from imutool.bias.temperature import channel_of
from imutool.cleaning import raw_batches
from imutool.errors import ConfigError, LogError, not_installed
from imutool.file_location import STORES, to_location
from imutool.mcap_io.temperature import temperatures
from imutool.recording import Scalars
from imutool.recording.columns import MAX_GAP_S
from imutool.viewing.stream.samples import Malformed, Sample, decoded

logger = logging.getLogger("imutool")
EXPECTED = "a log, stdin, udp://HOST:PORT, zenoh://[HOST:PORT]/KEY or rosbridge://HOST:PORT/TOPIC"
ROSBRIDGE_PORT = 9090
SILENT_S = 5.0  # without a sample, before a warning
WAIT_S = 0.5  # for data, between looks at the time
CONNECT_TIMEOUT_S = 5.0
MAX_WAITING = 10_000  # messages between two looks
MAX_BYTES = 65_536  # of a message; a sample has some 200


Samples = Generator[Sample | None]  # None: nothing came for a while


def open_source(
    name: str, malformed: Malformed, *, imu: str | None = None, speed: float = 1.0, temperature: str | None = None
) -> Samples:
    """Samples of a source as they come; a wrong address is refused at once.

    `temperature` is the channel of a log whose numbers come with the samples.

    Raises:
        ConfigError: no such source, or it cannot be opened.
        LogError: a log without an IMU, or with several.
    """
    samples = _source(name, malformed, imu, speed, temperature)
    next(samples)  # it is open until it is closed, or nothing refers to it
    return samples


def timely(source: Iterator[Sample | None], seconds: float | None, malformed: Malformed) -> Iterator[Sample]:
    """Samples until the time is up; warns once of a source without any."""
    began = last = time.perf_counter()
    warned = False
    for found in source:
        now = time.perf_counter()
        if seconds is not None and now - began > seconds:
            return
        if found is not None:
            last = now
            yield found
        elif not warned and now - last > SILENT_S:
            warned = True
            logger.warning("The source has sent no sample for %.0f s%s. Still waiting; Ctrl-C ends it", now - last, malformed)


def _source(name: str, malformed: Malformed, imu: str | None, speed: float, temperature: str | None) -> Samples:
    """Open source; its first item is None."""
    parts = urlsplit(name)
    if name in {"-", "stdin"}:
        return _lines(malformed)
    if parts.scheme == "udp":
        return _udp(*_address(name, None), malformed)
    if parts.scheme in {"rosbridge", "ws", "wss"}:
        return _rosbridge(name, malformed)
    if parts.scheme == "zenoh":
        return _zenoh(name, malformed)
    if "://" in name and parts.scheme not in {"file", *STORES}:
        raise ConfigError(f"{name!r} is no source", where="source", expected=EXPECTED)
    return _replay(name, imu, speed, temperature)


def _replay(name: str, imu: str | None, speed: float, temperature: str | None) -> Samples:
    """Samples of a log at its own speed, times `speed`; a jump of its clock takes no time."""
    from imutool.mcap_io.log import Log

    log = Log(to_location(name))
    try:
        topic = imu or log.only_imu()
    except LogError:
        log.close()
        raise

    def samples() -> Generator[Sample | None]:
        with log:
            yield None
            due_s, last_ns = time.perf_counter(), None
            found = None if temperature is None else channel_of(temperatures(log), topic, temperature)
            for batch in raw_batches(log, topic):
                warm = _arriving(batch.stamp_ns, last_ns, None if found is None else found[1])
                for stamp_ns, gyro, accel, celsius in zip(
                    batch.stamp_ns.tolist(), batch.gyro.tolist(), batch.accel.tolist(), warm, strict=True
                ):
                    step_s = 0.0 if last_ns is None else (stamp_ns - last_ns) * 1e-9
                    due_s, last_ns = due_s + (step_s if 0.0 < step_s <= MAX_GAP_S else 0.0) / speed, stamp_ns
                    if (wait_s := due_s - time.perf_counter()) > 0.0:
                        time.sleep(wait_s)
                    yield Sample(stamp_ns, tuple(gyro), tuple(accel), due_s, celsius)

    return samples()


def _arriving(stamp_ns: Int64[np.ndarray, " n"], last_ns: int | None, channel: Scalars | None) -> list[float | None]:
    """Temperature that arrives with each sample since the one before it; None where none does."""
    out: list[float | None] = [None] * len(stamp_ns)
    if channel is not None and len(out):
        known = channel.between(-1 if last_ns is None else last_ns + 1, int(stamp_ns[-1]))
        for row, celsius in zip(np.searchsorted(stamp_ns, known.t_ns).tolist(), known.values[:, 0].tolist(), strict=True):
            out[row] = celsius
    return out


def _lines(malformed: Malformed) -> Samples:
    """Samples from standard input, one JSON object a line."""
    if sys.stdin is None:
        raise ConfigError("standard input is closed", where="stdin", fix="Pipe the samples into the command")
    descriptor = sys.stdin.fileno()

    def samples() -> Generator[Sample | None]:
        rest = b""
        yield None
        while True:
            if os.name == "posix" and not select.select([descriptor], [], [], WAIT_S)[0]:
                yield None
                continue
            block = os.read(descriptor, MAX_BYTES)
            arrival_s = time.perf_counter()
            *lines, rest = (rest + block).split(b"\n") if block else [rest, b""]
            for line in lines:
                yield from decoded(line, arrival_s, malformed)
            if not block:
                return
            if len(rest) > MAX_BYTES:
                malformed.add(rest, ValueError("a line without an end"))
                rest = b""
                yield None

    return samples()


def _udp(host: str, port: int, malformed: Malformed) -> Samples:
    """Samples from datagrams, each with one or several lines of JSON."""
    line = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
    try:
        line.bind((host, port))
    except OSError as error:
        line.close()
        raise ConfigError(
            f"cannot be bound ({error.strerror})", where=f"udp://{host}:{port}", fix="Choose another host or port"
        ) from error
    line.settimeout(WAIT_S)

    def samples() -> Generator[Sample | None]:
        with line:
            yield None
            while True:
                try:
                    datagram = line.recv(MAX_BYTES)
                except TimeoutError:
                    yield None
                    continue
                arrival_s = time.perf_counter()
                for text in datagram.split(b"\n"):
                    yield from decoded(text, arrival_s, malformed)

    return samples()


def _rosbridge(name: str, malformed: Malformed) -> Samples:
    """Samples of a topic from a rosbridge server (https://github.com/RobotWebTools/rosbridge_suite)."""
    if find_spec("websockets") is None:
        raise not_installed("websockets", "live", where=name, user="a rosbridge")
    from websockets.exceptions import ConnectionClosed, ConnectionClosedOK, InvalidHandshake
    from websockets.sync.client import connect

    host, port = _address(name, ROSBRIDGE_PORT)
    topic = urlsplit(name).path
    if not topic.strip("/"):
        raise ConfigError(f"{name!r} names no topic", where="source", expected="rosbridge://HOST:PORT/TOPIC")
    place = f"[{host}]" if ":" in host else host
    url = f"{'wss' if name.startswith('wss') else 'ws'}://{place}:{port}"
    connection = contextlib.ExitStack()
    try:
        line = connection.enter_context(connect(url, open_timeout=CONNECT_TIMEOUT_S, max_size=1 << 20))
    except (OSError, TimeoutError, InvalidHandshake) as error:
        raise ConfigError(f"no rosbridge answers there ({error})", where=url, fix="Start rosbridge_websocket") from error
    line.send(msgspec.json.encode({"op": "subscribe", "topic": topic}).decode())

    def samples() -> Generator[Sample | None]:
        with connection:
            yield None
            while True:
                try:
                    text = line.recv(timeout=WAIT_S)
                except TimeoutError:
                    yield None
                    continue
                except ConnectionClosed as error:
                    if not isinstance(error, ConnectionClosedOK):
                        logger.warning("%s: the connection is lost (%s); the stream ends here", url, error)
                    return
                yield from decoded(text, time.perf_counter(), malformed)

    return samples()


def _zenoh(name: str, malformed: Malformed) -> Samples:
    """Samples that are published under a key: JSON, or the CDR of a sensor_msgs/Imu, as rmw_zenoh sends it."""
    if find_spec("zenoh") is None:
        raise not_installed("eclipse-zenoh", "live", where=name, user="the source")
    import zenoh

    parts, config, arrived = urlsplit(name), zenoh.Config(), Queue[tuple[float, bytes]](MAX_WAITING)
    key = parts.path.strip("/")
    if not key:
        raise ConfigError(f"{name!r} names no key", where="source", expected="zenoh://[HOST:PORT]/KEY")
    if parts.netloc:  # else peers are found on the local network
        config.insert_json5("connect/endpoints", f'["tcp/{parts.netloc}"]')
        config.insert_json5("mode", '"client"')
    session = contextlib.ExitStack()

    def arrive(published: zenoh.Sample) -> None:
        payload = published.payload.to_bytes()
        try:
            arrived.put_nowait((time.perf_counter(), payload))
        except Full as error:
            malformed.add(payload, ValueError(f"lost: {MAX_WAITING} messages wait already ({error!r})"))

    try:
        session.enter_context(zenoh.open(config)).declare_subscriber(key, arrive)
    except zenoh.ZError as error:
        session.close()
        raise ConfigError(
            f"cannot be opened ({str(error).partition('!')[0]})", where=name, expected="a Zenoh router or peer"
        ) from error

    def samples() -> Generator[Sample | None]:
        with session:
            yield None
            while True:
                try:
                    arrival_s, payload = arrived.get(timeout=WAIT_S)
                except Empty:
                    yield None
                    continue
                yield from decoded(payload, arrival_s, malformed)

    return samples()


def _address(name: str, default: int | None) -> tuple[str, int]:
    """Host and port of a source.

    Raises:
        ConfigError: there is no port.
    """
    try:
        parts = urlsplit(name)
        port = parts.port or default
    except ValueError as error:
        raise ConfigError(f"{name!r} is no source ({error})", where="source", expected=EXPECTED) from error
    if port is None:
        raise ConfigError(f"{name!r} has no port", where="source", expected=EXPECTED)
    return parts.hostname or "127.0.0.1", port
