"""Defects planted in an IMU's messages, and logs that hold them: our own writer would refuse most."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

from imutool.cleaning.survey import Survey, look, raw_batches
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.mcap_io.codec.encode import encode_imu
from imutool.mcap_io.log import Log
from imutool.recording import Imu

JITTER_NS = 200_000  # of the recorder's clock


def batch_of(imu: Imu) -> ImuBatch:
    """An IMU's samples as messages; the recorder gets them a little later, with some jitter."""
    n = len(imu)
    log_ns = imu.t_ns + 3_000_000 + np.random.default_rng(7).integers(0, JITTER_NS, n)
    return ImuBatch(log_ns, log_ns, np.arange(n, dtype=np.uint32), imu.t_ns.copy(), imu.gyro.copy(), imu.accel.copy(), "imu0")


def messages(log: Path, topic: str = "/imu0") -> ImuBatch:
    """The messages of a log as one batch."""
    with Log(log) as opened:
        parts = list(raw_batches(opened, topic))
    return ImuBatch(
        *(np.concatenate(columns) for columns in zip(*(part[:6] for part in parts), strict=True)), parts[0].frame_id
    )


def survey(log: Path) -> Survey:
    """Survey the only IMU of a log."""
    with Log(log) as opened:
        return look(opened, opened.only_imu())


def pick(batch: ImuBatch, index: np.ndarray) -> ImuBatch:
    """Messages in another order, some of them more than once or not at all; their sequence counts on."""
    columns = [column[index] for column in batch[:6]]
    columns[2] = np.arange(len(index), dtype=np.uint32)
    return ImuBatch(*columns, batch.frame_id)


def cut(batch: ImuBatch, edges: Sequence[int]) -> Iterator[ImuBatch]:
    """The same messages in several batches."""
    for first, last in zip([0, *edges], [*edges, len(batch.stamp_ns)], strict=True):
        yield ImuBatch(*(column[first:last] for column in batch[:6]), batch.frame_id)


def with_values(
    batch: ImuBatch, rows: np.ndarray | slice | int, axis: int | slice, values: object, *, add: bool = False
) -> ImuBatch:
    """Gyro (axes 0 to 2) and accel (3 to 5) changed in some rows."""
    u = np.concatenate([batch.gyro, batch.accel], axis=1)
    u[rows, axis] = u[rows, axis] + values if add else values  # type: ignore[operator]
    return batch._replace(gyro=np.ascontiguousarray(u[:, :3]), accel=np.ascontiguousarray(u[:, 3:]))


def repeated(batch: ImuBatch, rows: Sequence[int], later: int = 1) -> ImuBatch:
    """Some messages once more, so many places later."""
    order = np.arange(len(batch.stamp_ns), dtype=float)
    index = np.concatenate([order, np.asarray(rows) + later - 0.5])
    return pick(batch, np.concatenate([order, rows]).astype(int)[np.argsort(index, kind="stable")])


def late(batch: ImuBatch, rows: Sequence[int], later: int = 3) -> ImuBatch:
    """Some messages so many places late."""
    place = np.arange(len(batch.stamp_ns), dtype=float)
    place[list(rows)] += later + 0.5
    return pick(batch, np.argsort(place, kind="stable"))


def without(batch: ImuBatch, rows: np.ndarray | slice) -> ImuBatch:
    """Some messages missing."""
    return pick(batch, np.delete(np.arange(len(batch.stamp_ns)), rows))


def write_log(batch: ImuBatch, path: Path, beside: Path | None = None, topic: str = "/imu0") -> None:
    """A log with these messages on its IMU topic, and with everything else of the log `beside`."""
    payload = encode_imu(batch.stamp_ns, batch.gyro, batch.accel, batch.frame_id)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        channels: dict[str, int] = {}

        def channel(name: str, kind: str, definition: bytes) -> int:
            if name not in channels:
                channels[name] = writer.register_channel(name, "cdr", writer.register_schema(kind, "ros2msg", definition))
            return channels[name]

        for row, data in enumerate(payload):
            number = channel(topic, schemas.IMU, schemas.definition(schemas.IMU).encode())
            times = int(batch.publish_time[row]), int(batch.sequence[row])
            writer.add_message(number, int(batch.log_time[row]), data.tobytes(), *times)
        if beside is not None:
            with beside.open("rb") as source:
                for kind, about, message in make_reader(source).iter_messages():
                    if about.topic != topic and kind is not None:
                        number = channel(about.topic, kind.name, kind.data)
                        writer.add_message(number, message.log_time, message.data, message.publish_time, message.sequence)
        writer.finish()
