"""Gyroscope and accelerometer on topics of their own, joined to one IMU."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.errors import DataError
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import decode_imu
from imutool.mcap_io.codec.joined_imu import pairs_by_name
from imutool.recording import Imu
from imutool.recording.joined_imu import joined
from imutool.recording.message_log import MessageLog, MessageTopic, Remarks


class SensorPairs:
    """Samples of single sensors, gathered from a stream of messages: 56 bytes a sample.

    The pairs are those that the source names, else topics whose names differ by the sensor alone, as RealSense has them
    (`/camera/gyro/sample`, `/camera/accel/sample`; `Gyro_0`, `Accel_0`).
    """

    def __init__(self, source: MessageLog) -> None:
        imus = [topic.name for topic in source.topics if schemas.canonical(topic.schema_name) == schemas.IMU]
        self.pairs = dict(source.pairs) or pairs_by_name(imus)
        self._wholes = {part: whole for whole, parts in self.pairs.items() for part in parts}
        self._payloads: dict[str, list[bytes]] = defaultdict(list)
        self._columns: dict[str, list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = defaultdict(list)

    def whole_of(self, topic: str) -> str | None:
        """IMU topic that a sensor's topic is part of."""
        return self._wholes.get(topic)

    def take(self, topic: MessageTopic, payload: bytes | memoryview) -> None:
        """Take in a message, if it is of a single sensor."""
        if self._wholes and topic.name in self._wholes:
            waiting = self._payloads[topic.name]
            if waiting and (len(waiting) >= 1000 or len(waiting[0]) != len(payload)):
                self._decode(topic.name)
            waiting.append(bytes(payload))

    def _decode(self, topic: str) -> None:
        waiting = self._payloads[topic]
        rows = np.frombuffer(b"".join(waiting), np.uint8).reshape(len(waiting), -1)
        for part, layout in schemas.runs(rows, schemas.IMU):
            columns = decode_imu(rows[part], "cdr", layout)
            self._columns[topic].append((columns.stamp_ns, columns.gyro, columns.accel))
        waiting.clear()

    def joined(self, remarks: Remarks) -> Iterator[tuple[str, Imu]]:
        """IMU topics with their samples; a pair that cannot be joined is remarked on."""
        for whole, (gyro_topic, accel_topic) in self.pairs.items():
            for topic in (gyro_topic, accel_topic):
                if self._payloads[topic]:
                    self._decode(topic)
            if not (self._columns[gyro_topic] and self._columns[accel_topic]):
                continue
            gyro_ns, gyro = self._samples(gyro_topic, 1)
            accel_ns, accel = self._samples(accel_topic, 2)
            try:
                imu, notes = joined(gyro_ns, gyro, accel_ns, accel, whole)
            except DataError as error:
                remarks.losses.append(f"{gyro_topic} and {accel_topic} give no IMU: {error.what}")
                continue
            remarks.notes.extend(notes)
            yield whole, imu

    def _samples(self, topic: str, which: int) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
        parts = self._columns[topic]
        return np.concatenate([part[0] for part in parts]), np.concatenate([part[which] for part in parts])
