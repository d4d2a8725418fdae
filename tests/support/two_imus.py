"""A log of two IMUs on the same clock, the other with a bias of its own."""

from __future__ import annotations

from pathlib import Path

from mcap.writer import CompressionType, Writer

from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.encode import encode_imu
from imutool.recording import Recording


def write_two_imus(recording: Recording, log: Path, about: dict[str, str] | None = None, other: float = 0.1) -> tuple[str, str]:
    imu = recording.imu
    with log.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start("ros2", "test")
        kind = writer.register_schema(schemas.IMU, "ros2msg", schemas.definition(schemas.IMU).encode())
        for topic, change in (("/imu0", 0.0), ("/imu1", other)):
            channel = writer.register_channel(topic, "cdr", kind)
            payloads = encode_imu(imu.t_ns, imu.gyro + change, imu.accel, "body")
            for k, (stamp, payload) in enumerate(zip(imu.t_ns.tolist(), payloads, strict=True)):
                writer.add_message(channel, stamp, payload.tobytes(), stamp, k)
        if about is not None:
            writer.add_metadata("imutool", about)
        writer.finish()
    return "/imu0", "/imu1"
