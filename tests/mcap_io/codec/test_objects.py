"""Messages of objects: numbers and times that are text, and MessagePack."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

import imutool
from imutool.mcap_io.codec.formats.objects import MessagePack, number_in
from imutool.mcap_io.codec.reflection import reflect
from imutool.mcap_io.codec.transforms import Transforms
from imutool.mcap_io.fields import read_field
from imutool.mcap_io.read import read

START_NS = 1_764_500_000_123_456_789
T_NS = START_NS + 5_000_000 * np.arange(400, dtype=np.int64)
GYRO = np.random.default_rng(2).normal(0, 0.01, (400, 3))
ACCEL = np.random.default_rng(3).normal([0.0, 0.0, 9.81], 0.01, (400, 3))
PACK = {"json": lambda message: json.dumps(message).encode(), "msgpack": msgspec.msgpack.encode}


def iso(t_ns: int) -> str:
    return f"{np.datetime64(t_ns, 'ns')}Z"


def write(path: Path, stamped: dict[str, Any], encoding: str = "json", text: type = float) -> Path:
    """Log of an IMU whose messages come a few ms after their stamps; `stamped` gives a field by the stamp."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/imu", encoding, 0)
        for t_ns, gyro, accel in zip(T_NS.tolist(), GYRO, ACCEL, strict=True):
            late_ns = t_ns + 2_000_000 + t_ns % 1_000_003
            vectors = {"gyro": gyro, "accel": accel}
            message = {
                name: {axis: text(v) for axis, v in zip("xyz", values.tolist(), strict=True)}
                for name, values in vectors.items()
            }
            message |= {name: of(t_ns) for name, of in stamped.items()} | {"temperature": text(21.5)}
            writer.add_message(channel, late_ns, PACK[encoding](message), late_ns)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("text", "number"),
    [
        (iso(START_NS), START_NS),
        ("2025-11-30T10:53:20.005+01:00", (1_764_500_000 - 3600) * 10**9 + 5_000_000),
        ("2025-11-30 10:53:20", 1_764_500_000 * 10**9),
        ("1764500000123456789", START_NS),
        ("-1.5e-3", -1.5e-3),
    ],
)
def test_the_number_in_a_text(text: str, number: float) -> None:
    assert number_in(text) == number


@pytest.mark.parametrize("text", ["", "none", "2025-13-30T10:53:20Z", "1_000", "nan", "10:53:20", "9" * 5000])
def test_other_texts_are_no_numbers(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        number_in(text)


@pytest.mark.parametrize(
    "stamped",
    [
        {"timestamp": iso},  # as protobuf writes its Timestamp in JSON
        {"header": lambda t_ns: {"stamp": iso(t_ns), "frame_id": "7"}},
        {"dateTime": iso},
        {"timestampNs": str},  # as protobuf writes numbers of 64 bits in JSON
        {"stamp": lambda t_ns: {"seconds": str(t_ns // 10**9), "nanos": t_ns % 10**9}},
    ],
)
@pytest.mark.parametrize("encoding", PACK)
def test_stamps_that_are_text_are_stamps(tmp_path: Path, stamped: dict[str, Any], encoding: str) -> None:
    """They were taken for none, and the log times in their place were a few ms late."""
    path = write(tmp_path / "in.mcap", stamped, encoding)
    assert read(path).imu.t_ns.tolist() == T_NS.tolist()
    assert not imutool.convert(path, tmp_path / "out.mcap").losses
    imu = read(tmp_path / "out.mcap").imu
    assert imu.t_ns.tolist() == T_NS.tolist()
    assert np.array_equal(imu.gyro, GYRO)


def test_whole_seconds_are_no_stamps(tmp_path: Path) -> None:
    imu = read(write(tmp_path / "in.mcap", {"timestamp": lambda t_ns: iso(t_ns)[:19] + "Z"})).imu
    assert (np.abs(imu.t_ns - T_NS) < 4_000_000).all()  # the log times


@pytest.mark.parametrize("encoding", PACK)
def test_the_debiased_messages_have_stamps_and_numbers_as_their_source(tmp_path: Path, encoding: str) -> None:
    path = write(tmp_path / "in.mcap", {"timestamp": iso, "t_ns": str}, encoding, text=str)
    imutool.debias(path, tmp_path / "out.mcap")
    assert read(tmp_path / "out.mcap", imu="/imu/debiased").imu.t_ns.tolist() == T_NS.tolist()
    with (tmp_path / "out.mcap").open("rb") as file:
        raw = next(message.data for _, _, message in make_reader(file).iter_messages("/imu/debiased"))
    message = msgspec.msgpack.decode(raw) if encoding == "msgpack" else json.loads(raw)
    assert message["timestamp"] == iso(START_NS)
    assert isinstance(message["gyro"]["x"], str)


def test_a_number_that_is_text_is_read_where_it_is_named(tmp_path: Path) -> None:
    found = read_field(write(tmp_path / "in.mcap", {"timestamp": iso}, text=str), "/imu.temperature")
    assert found.t_ns.tolist() == T_NS.tolist()
    assert (found.values == 21.5).all()


def test_transforms_have_stamps_that_are_text() -> None:
    pose = {"translation": {"x": 1, "y": 2, "z": 3}, "rotation": {"w": 1, "x": 0, "y": 0, "z": 0}}
    raw = json.dumps({"timestamp": iso(START_NS), "parent_frame_id": "map", "child_frame_id": "7", **pose}).encode()
    found = reflect("json", "/tf", "foxglove.FrameTransform", b"", raw)
    assert isinstance(found, Transforms)
    (sample,) = found.sample(raw, 5)
    assert (sample.stamp_ns, sample.frames) == (START_NS, ("map", "7"))


@pytest.mark.parametrize("raw", [b"", b"\xdd\xff\xff\xff\xff", b"\xc1", b"\x91" * 100_000, b"\x80\x80"])
def test_hostile_msgpack_is_refused(raw: bytes) -> None:
    with pytest.raises(ValueError, match=r"."):
        MessagePack().parse(raw)


def test_keys_of_msgpack_may_be_numbers() -> None:
    raw = msgspec.msgpack.encode({1: [1, 2, 3], "gyro": [1, 2, 3], "on": True, "raw": b"\0"})
    assert MessagePack().tree(MessagePack().parse(raw)) == {"gyro": "vector", "on": "", "raw": ""}
