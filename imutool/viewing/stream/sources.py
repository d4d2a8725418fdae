"""Sources of a live stream: a log at its own speed, standard input, UDP, a rosbridge."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import sys
import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import NamedTuple
from urllib.parse import urlsplit

import msgspec

from imutool.errors import ConfigError, LogError
from imutool.location import to_location

EXPECTED = "a log, stdin, udp://HOST:PORT or rosbridge://HOST:PORT/TOPIC"
ROSBRIDGE_PORT = 9090
WAIT_S = 0.5  # for data, between looks at the time
CONNECT_TIMEOUT_S = 5.0
MAX_BYTES = 65_536  # of a message; a sample has some 200


Vector = tuple[float, float, float]


class Sample(NamedTuple):
    """Sample of an IMU: stamp (ns), rad/s, m/s², time of arrival (s of `time.perf_counter`)."""

    stamp_ns: int
    gyro: Vector
    accel: Vector
    arrival_s: float


class _Vector(msgspec.Struct):
    x: float
    y: float
    z: float

    def plain(self) -> Vector:
        return self.x, self.y, self.z


class _Stamp(msgspec.Struct):
    """Time of ROS 2 or of ROS 1."""

    sec: int | None = None
    nanosec: int | None = None
    secs: int | None = None
    nsecs: int | None = None

    def stamp_ns(self) -> int | None:
        """Nanoseconds; None without a time."""
        whole, rest = (self.sec, self.nanosec) if self.sec is not None else (self.secs, self.nsecs)
        return None if whole is None else whole * 1_000_000_000 + (rest or 0)


class _Header(msgspec.Struct):
    stamp: _Stamp


class _Message(msgspec.Struct):
    """Sample in imutool's JSON, or a sensor_msgs/Imu, perhaps in the envelope of a rosbridge."""

    t_ns: int | None = None
    t_s: float | None = None
    gyro: Vector | None = None
    accel: Vector | None = None
    header: _Header | None = None
    angular_velocity: _Vector | None = None
    linear_acceleration: _Vector | None = None
    msg: _Message | None = None

    def stamp_ns(self) -> int | None:
        """Nanoseconds; None without a time."""
        if self.t_ns is not None or self.t_s is not None:
            return self.t_ns if self.t_ns is not None else round(1e9 * (self.t_s or 0.0))
        return None if self.header is None else self.header.stamp.stamp_ns()

    def values(self) -> tuple[Vector | None, Vector | None]:
        """Angular rate and specific force; None where there is none."""
        rate, force = (None if v is None else v.plain() for v in (self.angular_velocity, self.linear_acceleration))
        return self.gyro or rate, self.accel or force


DECODER = msgspec.json.Decoder(_Message)


def sample(text: bytes | str, arrival_s: float) -> Sample:
    """Sample from JSON with t_ns or t_s, gyro and accel, or from a sensor_msgs/Imu in JSON.

    Raises:
        ValueError: it is none.
    """
    message = DECODER.decode(text)
    message = message.msg or message
    stamp_ns, (gyro, accel) = message.stamp_ns(), message.values()
    if gyro is None or accel is None:
        raise ValueError("neither gyro and accel nor a sensor_msgs/Imu")
    if stamp_ns is None:
        raise ValueError("no time: t_ns, t_s or header.stamp")
    return Sample(stamp_ns, gyro, accel, arrival_s)


@dataclass
class Malformed:
    """Count of messages that hold no sample, with the first reason."""

    count: int = 0
    first: str = field(default="")

    def add(self, text: bytes | str, error: Exception) -> None:
        """Count a message."""
        self.count += 1
        if not self.first:
            self.first = f"{error}: {text[:100]!r}"


Samples = Iterator[Sample | None]  # None: nothing came for a while


def open_source(name: str, malformed: Malformed, *, imu: str | None = None, speed: float = 1.0) -> Samples:
    """Samples of a source as they come; a wrong address is refused at once.

    Raises:
        ConfigError: no such source, or it cannot be opened.
        LogError: a log without an IMU, or with several.
    """
    parts = urlsplit(name)
    if name in {"-", "stdin"}:
        return _lines(malformed)
    if parts.scheme == "udp":
        return _udp(*_address(name, None), malformed)
    if parts.scheme in {"rosbridge", "ws", "wss"}:
        return _rosbridge(name, malformed)
    if parts.scheme == "zenoh":
        raise ConfigError("zenoh is no source of this version", where="source", expected=EXPECTED)
    if "://" in name and parts.scheme not in {"file", "s3", "gs", "az"}:
        raise ConfigError(f"{name!r}", where="source", expected=EXPECTED)
    return _replay(name, imu, speed)


def _replay(name: str, imu: str | None, speed: float) -> Samples:
    """Samples of a log at its own speed, times `speed`."""
    from imutool.mcap_io.log import Log

    log = Log(to_location(name))
    topics = log.imu_topics
    if imu is None and len(topics) != 1:
        log.close()
        raise LogError(f"the log has {len(topics)} IMUs", where=name, expected="one", fix="Choose one with `imu`")

    def samples() -> Generator[Sample | None]:
        with log:
            began, first_ns = time.perf_counter(), None
            for batch in log.imu_batches(imu or topics[0]):
                for stamp_ns, gyro, accel in zip(
                    batch.stamp_ns.tolist(), batch.gyro.tolist(), batch.accel.tolist(), strict=True
                ):
                    first_ns = stamp_ns if first_ns is None else first_ns
                    due_s = began + (stamp_ns - first_ns) * 1e-9 / speed
                    if (wait_s := due_s - time.perf_counter()) > 0.0:
                        time.sleep(wait_s)
                    yield Sample(stamp_ns, tuple(gyro), tuple(accel), due_s)

    return samples()


def _lines(malformed: Malformed) -> Samples:
    """Samples from standard input, one JSON object a line."""
    descriptor = sys.stdin.fileno()

    def samples() -> Generator[Sample | None]:
        rest = b""
        while True:
            if os.name == "posix" and not select.select([descriptor], [], [], WAIT_S)[0]:
                yield None
                continue
            block = os.read(descriptor, MAX_BYTES)
            arrival_s = time.perf_counter()
            *lines, rest = (rest + block).split(b"\n") if block else [rest, b""]
            for line in lines:
                yield from _decoded(line, arrival_s, malformed)
            if not block:
                return
            if len(rest) > MAX_BYTES:
                malformed.add(rest, ValueError("a line without an end"))
                rest = b""

    return samples()


def _udp(host: str, port: int, malformed: Malformed) -> Samples:
    """Samples from datagrams, each with one or several lines of JSON."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    line = socket.socket(family, socket.SOCK_DGRAM)
    try:
        line.bind((host, port))
    except OSError as error:
        line.close()
        raise ConfigError(
            f"cannot be bound ({error.strerror})", where=f"udp://{host}:{port}", fix="Choose another port"
        ) from error
    line.settimeout(WAIT_S)

    def samples() -> Generator[Sample | None]:
        with line:
            while True:
                try:
                    datagram = line.recv(MAX_BYTES)
                except TimeoutError:
                    yield None
                    continue
                arrival_s = time.perf_counter()
                for text in datagram.split(b"\n"):
                    yield from _decoded(text, arrival_s, malformed)

    return samples()


def _rosbridge(name: str, malformed: Malformed) -> Samples:
    """Samples of a topic from a rosbridge server (https://github.com/RobotWebTools/rosbridge_suite)."""
    if find_spec("websockets") is None:
        raise ConfigError("a rosbridge needs websockets, which is not installed", where=name, fix="pip install 'imutool[live]'")
    from websockets.exceptions import ConnectionClosed, InvalidHandshake
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
        with connection, contextlib.suppress(ConnectionClosed):
            while True:
                try:
                    text = line.recv(timeout=WAIT_S)
                except TimeoutError:
                    yield None
                    continue
                yield from _decoded(text, time.perf_counter(), malformed)

    return samples()


def _decoded(text: bytes | str, arrival_s: float, malformed: Malformed) -> Iterator[Sample]:
    """The sample of a message, if it holds one."""
    try:
        if text.strip():
            yield sample(text, arrival_s)
    except (msgspec.DecodeError, UnicodeDecodeError, ValueError, RecursionError) as error:
        malformed.add(text, error)


def _address(name: str, default: int | None) -> tuple[str, int]:
    """Host and port of a source.

    Raises:
        ConfigError: there is no port.
    """
    try:
        parts = urlsplit(name)
        port = parts.port or default
    except ValueError as error:
        raise ConfigError(f"{name!r} ({error})", where="source", expected=EXPECTED) from error
    if port is None:
        raise ConfigError(f"{name!r} has no port", where="source", expected=EXPECTED)
    return parts.hostname or "127.0.0.1", port
