"""Flight logs made up message by message: PX4's ULog and ArduPilot's DataFlash."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

START_US = 5_000_000
ULOG_CODES = {"uint64_t": "Q", "int32_t": "i", "float": "f", "uint32_t": "I", "uint8_t": "B"}
DATAFLASH_CODES = {
    "I": "I",
    "H": "H",
    "Q": "Q",
    "B": "B",
    "f": "f",
    "c": "h",
    "C": "H",
    "n": "4s",
    "L": "i",
    "Z": "64s",
    "N": "16s",
}
COMBINED = (
    "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;int32_t accelerometer_timestamp_relative;"
    "float[3] accelerometer_m_s2;uint32_t accelerometer_integral_dt"
)
ATTITUDE = "uint64_t timestamp;float[4] q"
POSITION = "uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz"
SENSOR = "uint64_t timestamp;uint64_t timestamp_sample;float x;float y;float z;float temperature"


class Ulog:
    """A ULog: formats, then messages."""

    def __init__(self) -> None:
        self.raw = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", START_US) + self._record(b"B", bytes(40))
        self.data = b""
        self.formats: dict[str, str] = {}
        self.ids = 0

    @staticmethod
    def _record(kind: bytes, content: bytes) -> bytes:
        return struct.pack("<H", len(content)) + kind + content

    def text(self, key: str, value: str) -> None:
        name = f"char[{len(value)}] {key}".encode()
        self.raw += self._record(b"I", bytes([len(name)]) + name + value.encode())

    def parameter(self, key: str, value: float) -> None:
        name = f"float {key}".encode()
        self.raw += self._record(b"P", bytes([len(name)]) + name + struct.pack("<f", value))

    def topic(self, name: str, fields: str, rows: list[tuple[Any, ...]], instance: int = 0) -> None:
        code = "<"
        for part in fields.split(";"):
            kind, _, size = part.split()[0].partition("[")
            code += f"{size.rstrip(']')}{ULOG_CODES[kind]}"
        if name not in self.formats:
            self.raw += self._record(b"F", f"{name}:{fields};".encode())
            self.formats[name] = fields
        number, self.ids = self.ids, self.ids + 1
        self.data += self._record(b"A", struct.pack("<BH", instance, number) + name.encode())
        for row in rows:
            self.data += self._record(b"D", struct.pack("<H", number) + struct.pack(code, *row))

    def log(self, text: str, t_us: int) -> None:
        self.data += self._record(b"L", b"4" + struct.pack("<Q", t_us) + text.encode())

    def dropout(self, duration_ms: int) -> None:
        self.data += self._record(b"O", struct.pack("<H", duration_ms))

    def write(self, path: Path) -> Path:
        path.write_bytes(self.raw + self.data)
        return path


def ulog_flight() -> Ulog:
    """One second at rest, nose to the north-east, with simulated truth."""
    writer = Ulog()
    writer.text("sys_name", "PX4")
    writer.parameter("IMU_GYRO_CUTOFF", 40.0)
    times = [START_US + 4000 * n for n in range(250)]
    yaw = (float(np.cos(np.pi / 8)), 0.0, 0.0, float(np.sin(np.pi / 8)))
    writer.topic("sensor_combined", COMBINED, [(t, 0.1, 0.2, 0.3, 4000, 0, 1.0, 2.0, -9.75, 4000) for t in times])
    writer.topic("vehicle_attitude", ATTITUDE, [(t, *yaw) for t in times[::4]])
    writer.topic("vehicle_attitude_groundtruth", ATTITUDE, [(t, *yaw) for t in times[::4]])
    moves = [(t, 1.0, 2.0, -3.0, 0.5, 0.25, -0.125) for t in times[::10]]
    writer.topic("vehicle_local_position_groundtruth", POSITION, moves)
    for instance in (0, 1):
        for sensor, shift in (("sensor_gyro", 0), ("sensor_accel", 700)):
            rows = [(t + shift, t + shift, float(instance), 1.0, 2.0, 25.0 + instance) for t in times]
            writer.topic(sensor, SENSOR, rows, instance)
    writer.topic("parameter_update", "uint64_t timestamp;uint32_t changes", [(0, 7)])
    writer.log("Takeoff detected", times[50])
    writer.dropout(12)
    return writer


class DataFlash:
    """A DataFlash log: formats and messages as they come."""

    def __init__(self) -> None:
        self.raw, self.numbers, self.letters, self.lines = b"", {}, {}, []
        self.form(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns", 89)

    def form(self, number: int, name: str, letters: str, labels: str, size: int | None = None) -> None:
        code = "<" + "".join(DATAFLASH_CODES.get(letter, "") for letter in letters)
        self.numbers[name], self.letters[name] = (number, code), letters
        size = struct.calcsize(code) + 3 if size is None else size
        self.lines.append(f"FMT, {number}, {size}, {name}, {letters}, {labels}")
        self.raw += b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, size, name.encode(), letters.encode(), labels.encode())

    def add(self, name: str, *values: object) -> None:
        number, code = self.numbers[name]
        self.raw += b"\xa3\x95" + bytes([number]) + struct.pack(code, *values)
        texts = [as_text(value, letter) for value, letter in zip(values, self.letters[name], strict=True)]
        self.lines.append(", ".join([name, *texts]))


def as_text(value: Any, letter: str) -> str:
    """Field as Mission Planner writes it into a .log."""
    if isinstance(value, bytes):
        return value.decode()
    return f"{value / 1e7:.7f}" if letter == "L" else f"{value / 100:.2f}" if letter in "cC" else repr(value)


def write_dataflash(path: Path, text: bool = False) -> Path:
    log = DataFlash()
    log.form(1, "IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    log.form(2, "XKF1", "QBccCffffff", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,PN,PE,PD")
    log.form(3, "GPS", "QBL", "TimeUS,Status,Lat")
    log.form(4, "PARM", "QNf", "TimeUS,Name,Value")
    log.form(5, "MSG", "QZ", "TimeUS,Message")
    log.add("PARM", 1, b"INS_GYRO_RATE", 2.0)
    log.add("MSG", 2, b"ArduCopter V4.5")
    for n in range(500):
        t_us = 7_000_000 + 5000 * n
        for instance in (0, 1):
            log.add("IMU", t_us + instance, instance, 0.1, 0.2, 0.3, 1.0, 2.0, -9.75)
        log.add("XKF1", t_us, 0, 0, 0, 4500, 0.5, 0.25, -0.125, 1.0, 2.0, -3.0)
    log.add("GPS", 8_000_000, 3, 473_977_418)
    if text:
        path.write_text("\n".join([*log.lines, ""]))
    else:
        path.write_bytes(log.raw)
    return path
