"""Units of an IMU's rates and accelerations that the comments of a ROS definition state."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from imutool.mcap_io.codec.reflection import Reflected, reflect, reflect_cdr

VALUES = 10.0, -20.0, 30.0, 0.1, -0.2, 1.0
RAW = b"\0\1\0\0" + struct.pack("<6d", *VALUES)
DEG, G = np.pi / 180, 9.80665


def reflected(text: str) -> Reflected:
    found = reflect_cdr("my_driver/msg/Imu", text.encode())
    assert found is not None
    return found


def fields(gyro: str, accel: str, above: str = "") -> str:
    return above + "".join([*(f"float64 gyro_{a}{gyro}\n" for a in "xyz"), *(f"float64 accel_{a}{accel}\n" for a in "xyz")])


@pytest.mark.parametrize(
    ("text", "gyro", "accel"),
    [
        (fields("  # deg/s", "  # g"), DEG, G),
        (fields(" # Degrees per second", " # acceleration in G's"), DEG, G),
        (fields(" # [mdps]", " # mg"), 1e-3 * DEG, 1e-3 * G),
        (fields(" # rate in rad/s", " # m/s^2"), 1.0, 1.0),
        (fields("", ""), 1.0, 1.0),
        (fields("", " # m/s**2", above="# angular rate (dps)\n"), DEG, 1.0),
        (fields("", "", above="# angular rate (dps)\n\n"), 1.0, 1.0),
        (fields(" # rad/s, not deg/s", " # x axis of the gyro"), 1.0, 1.0),
        ("float64[3] gyro  # deg/sec\nfloat64[3] accel  # (g)\n", DEG, G),
        ("Vec gyro # °/s\nVec accel\n" + "=" * 80 + "\nMSG: my_driver/Vec\nfloat64 x\nfloat64 y\nfloat64 z\n", DEG, 1.0),
    ],
)
def test_the_units_in_comments_count(text: str, gyro: float, accel: float) -> None:
    sizes = np.repeat([gyro, accel], 3)
    np.testing.assert_allclose(reflected(text).sample(RAW, 5).values, VALUES * sizes, rtol=1e-12)


def test_a_correction_is_written_in_the_unit_of_the_message() -> None:
    found = reflected(fields("  # deg/s", "  # g"))
    turned = found.with_vectors(RAW, np.stack([np.diag([1.0, -1.0, -1.0])] * 2))
    np.testing.assert_allclose(struct.unpack("<6d", turned[4:]), np.multiply(VALUES, [1, -1, -1, 1, -1, -1]), rtol=1e-12)


@pytest.mark.parametrize("key", ["description", "unit"])
def test_the_units_in_a_json_schema_count_both_ways(key: str) -> None:
    schema = {"properties": {"gyro": {"type": "object", key: "deg/s"}, "accel": {"type": "array", key: "g"}}}
    raw = json.dumps({"gyro": dict(zip("xyz", VALUES[:3], strict=True)), "accel": VALUES[3:], "t_ns": 5}).encode()
    found = reflect("json", "/imu", "Imu", json.dumps(schema).encode(), raw)
    assert found is not None
    sample = found.sample(raw, 0)
    np.testing.assert_allclose(sample.values, VALUES * np.repeat([DEG, G], 3), rtol=1e-12)
    again = json.loads(found.from_cdr(found.encode([sample]))[0])
    np.testing.assert_allclose([*again["gyro"].values(), *again["accel"]], VALUES, rtol=1e-12)
