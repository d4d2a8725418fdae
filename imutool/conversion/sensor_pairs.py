"""Gyroscope and accelerometer on topics of their own, joined to one IMU."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.conversion.robot_messages import Px4, px4_sensors
from imutool.errors import DataError
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import decode_imu
from imutool.mcap_io.codec.joined_imu import pairs_by_name
from imutool.recording import Imu
from imutool.recording.joined_imu import joined
from imutool.recording.message_log import MessageLog, MessageTopic, Remarks

AT_ONCE = 1000  # messages that are decoded together


class SensorPairs:
    """Samples of single sensors, gathered from a stream of messages: 64 bytes a sample.

    The pairs are those that the source names, else topics whose names differ by the sensor alone, as RealSense has them
    (`/camera/gyro/sample`, `/camera/accel/sample`; `Gyro_0`, `Accel_0`). In a log without another IMU PX4's `SensorGyro` and
    `SensorAccel` are such topics, too.
    """

    def __init__(self, source: MessageLog) -> None:
        imus = [topic.name for topic in source.topics if schemas.canonical(topic.schema_name) == schemas.IMU]
        self._px4: dict[str, Px4] = {} if imus else px4_sensors(source.topics)
        self.pairs = dict(source.pairs) or pairs_by_name(imus or self._px4)
        self._wholes = {part: whole for whole, parts in self.pairs.items() for part in parts}
        self._waiting: dict[str, list[tuple[int, bytes]]] = defaultdict(list)
        self._columns: dict[str, list[tuple[np.ndarray, ...]]] = defaultdict(list)
        self._lacking: dict[str, int] = defaultdict(int)

    def whole_of(self, topic: str) -> str | None:
        """IMU topic that a sensor's topic is part of."""
        return self._wholes.get(topic)

    def take(self, topic: MessageTopic, log_time: int, payload: bytes | memoryview) -> None:
        """Take in a message, if it is of a single sensor."""
        if self._wholes and topic.name in self._wholes:
            waiting = self._waiting[topic.name]
            if waiting and (len(waiting) >= AT_ONCE or len(waiting[0][1]) != len(payload)):
                self._decode(topic.name)
            waiting.append((log_time, bytes(payload)))

    def _decode(self, topic: str) -> None:
        waiting = self._waiting[topic]
        if topic in self._px4:
            self._decode_px4(topic)
        else:
            log_times = np.array([log_time for log_time, _ in waiting], np.int64)
            rows = np.frombuffer(b"".join(payload for _, payload in waiting), np.uint8).reshape(len(waiting), -1)
            for part, layout in schemas.runs(rows, schemas.IMU):
                columns = decode_imu(rows[part], "cdr", layout)
                self._columns[topic].append((log_times[part], columns.stamp_ns, columns.gyro, columns.accel))
        waiting.clear()

    def _decode_px4(self, topic: str) -> None:
        """Decode messages of PX4, whose one vector stands for both."""
        found = []
        for log_time, payload in self._waiting[topic]:
            try:
                sample = self._px4[topic].sample(payload, log_time)
            except ValueError:
                self._lacking[topic] += 1
            else:
                found.append((log_time, sample.stamp_ns, sample.values))
        if found:
            log_times, stamps, values = zip(*found, strict=True)
            vectors = np.array(values, np.float64)
            self._columns[topic].append((np.array(log_times, np.int64), np.array(stamps, np.int64), vectors, vectors))

    def joined(self, remarks: Remarks) -> Iterator[tuple[str, Int64[np.ndarray, " n"], Imu]]:
        """IMU topics, the log times of the gyro's messages, and samples; a pair that cannot be joined is remarked on."""
        for whole, (gyro_topic, accel_topic) in self.pairs.items():
            for topic in (gyro_topic, accel_topic):
                if self._waiting[topic]:
                    self._decode(topic)
                if self._lacking[topic]:
                    remarks.losses.append(f"messages of {topic} without a sample: {self._lacking[topic]}")
            if not (self._columns[gyro_topic] and self._columns[accel_topic]):
                continue
            log_times, gyro_ns, gyro, _ = self._samples(gyro_topic)
            _, accel_ns, _, accel = self._samples(accel_topic)
            try:
                imu, rows, notes = joined(gyro_ns, gyro, accel_ns, accel, whole)
            except DataError as error:
                remarks.losses.append(f"{gyro_topic} and {accel_topic} give no IMU: {error.what}")
                continue
            axes = ", in FLU" if gyro_topic in self._px4 else ""
            remarks.notes += [f"{whole} is made of {gyro_topic} and {accel_topic}{axes}", *notes]
            yield whole, log_times[rows], imu

    def _samples(
        self, topic: str
    ) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
        """Log times, stamps, rates and accelerations of a topic."""
        log_times, stamps, rates, forces = (np.concatenate(parts) for parts in zip(*self._columns[topic], strict=True))
        return log_times, stamps, rates, forces
