"""Imu messages per second in memory: `python tests/bench/codec.py [COUNT]`, ours against `mcap-ros2-support`, same run.

Encoding is payload and Message record; decoding is from the bytes of a chunk to the columns. Times are CPU seconds, the
best of several runs, because the machine may be shared.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.records import Message
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic

from imutool.mcap_io.codec import messages, schemas
from imutool.mcap_io.codec.decode import ImuColumns, decode_imu
from imutool.mcap_io.codec.encode import encode_imu

REPEATS = 7
THEIR_COUNT = 3000  # enough for a rate; the whole column would take minutes
CHUNK = 2900  # messages in a chunk of 1 MiB


def best(run: Callable[[], object]) -> float:
    """CPU seconds of the fastest of several runs."""
    taken = []
    for _ in range(REPEATS):
        start = time.process_time()
        run()
        taken.append(time.process_time() - start)
    return min(taken)


def encode(t_ns: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> list[bytes]:
    """Chunks of message records."""
    chunks = []
    for first in range(0, len(t_ns), CHUNK):
        part = slice(first, first + CHUNK)
        payload = encode_imu(t_ns[part], gyro[part], accel[part], "body")
        sequence = np.arange(first, first + len(payload), dtype=np.uint32)
        chunks.append(messages.message_rows(1, t_ns[part], t_ns[part], sequence, payload).tobytes())
    return chunks


def decode(chunks: list[bytes]) -> list[ImuColumns]:
    """The columns in chunks of message records."""
    decoded = []
    for chunk in chunks:
        found = messages.parse(chunk, 0)
        for heads, payload in messages.cut(found, found.of_channels([1])):
            rows = messages.columns(heads, payload)
            for part, layout in schemas.runs(rows.payload, schemas.IMU):
                decoded.append(decode_imu(rows.payload[part], "cdr", layout))
    return decoded


def their_messages(t_ns: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> list[dict[str, object]]:
    """The first messages, as `mcap-ros2-support` wants them."""
    vectors = [[dict(zip("xyz", map(float, row), strict=True)) for row in table[:THEIR_COUNT]] for table in (gyro, accel)]
    return [
        {
            "header": {"stamp": {"sec": int(t) // 10**9, "nanosec": int(t) % 10**9}, "frame_id": "body"},
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            "orientation_covariance": [-1.0] + [0.0] * 8,
            "angular_velocity": rate,
            "angular_velocity_covariance": [0.0] * 9,
            "linear_acceleration": force,
            "linear_acceleration_covariance": [0.0] * 9,
        }
        for t, rate, force in zip(t_ns, *vectors, strict=False)
    ]


def main() -> None:
    """Prints a table of rates and their ratio."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 200_000
    rng = np.random.default_rng(0)
    t_ns = 1_403_638_128_245_096_960 + 5_000_000 * np.arange(count)
    gyro, accel = rng.normal(size=(count, 3)), rng.normal(size=(count, 3))
    chunks = encode(t_ns, gyro, accel)
    back = decode(chunks)
    assert np.concatenate([columns.gyro for columns in back]).tobytes() == gyro.tobytes()

    text = schemas.definition(schemas.IMU)
    serialize = serialize_dynamic(schemas.IMU, text)[schemas.IMU]
    deserialize = generate_dynamic(schemas.IMU, text)[schemas.IMU]
    samples = their_messages(t_ns, gyro, accel)
    payloads = [serialize(sample) for sample in samples]
    assert payloads[0] == chunks[0][31 : 31 + len(payloads[0])]

    def their_encode() -> None:
        builder = RecordBuilder()
        for i, sample in enumerate(samples):
            time_ns = int(t_ns[i])
            Message(1, time_ns, serialize(sample), time_ns, i).write(builder)

    theirs = {
        "encode": len(samples) / best(their_encode),
        "decode": len(samples) / best(lambda: [deserialize(payload) for payload in payloads]),
    }
    ours = {
        "encode": count / best(lambda: encode(t_ns, gyro, accel)),
        "decode": count / best(lambda: decode(chunks)),
    }
    print(f"{'Imu messages/s':16}{'imutool':>14}{'mcap-ros2-support':>20}{'ratio':>10}")
    for what in ("encode", "decode"):
        print(f"{what:16}{ours[what]:14,.0f}{theirs[what]:20,.0f}{ours[what] / theirs[what]:9.0f}x")


if __name__ == "__main__":
    main()
