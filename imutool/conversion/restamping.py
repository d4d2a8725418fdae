"""New stamps for messages: on the line under those recorded, or under the log times."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np

from imutool.array_types import Int64
from imutool.cleaning import raw_batches
from imutool.cleaning.stamp_line import WRAPS, read_stamps, restamped
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import ImuBatch, PoseBatch, ScalarBatch
from imutool.mcap_io.codec.reflection import Reflected
from imutool.mcap_io.log import Log
from imutool.mcap_io.topics import ENCODINGS, MESSAGE_POSES, Topic
from imutool.recording.message_log import MessageTopic

STAMP = slice(4, 12)  # of a message that begins with a header: behind the encapsulation of CDR, or the sequence of ROS 1
SAME_CLOCK_NS = 10**9  # most by which a topic may come into the log later than the IMU


class SharedStamps:
    """Count of an IMU's messages that have the stamp of the one before, and other values."""

    def __init__(self) -> None:
        self._last: dict[str, bytes] = {}
        self._shared, self._all = Counter[str](), Counter[str]()

    def take(self, topic: MessageTopic, payload: bytes | memoryview) -> None:
        """Take in a message, if it is one of an IMU."""
        if schemas.canonical(topic.schema_name) == schemas.IMU and topic.message_encoding in ENCODINGS:
            raw, last = bytes(payload[STAMP.start :]), self._last.get(topic.name, b"")
            size = STAMP.stop - STAMP.start
            self._shared[topic.name] += raw[:size] == last[:size] and raw != last
            self._all[topic.name] += 1
            self._last[topic.name] = raw

    def notes(self) -> Iterator[str]:
        """Sentence on each topic with such messages."""
        for name, count in self._shared.items():
            if 0 < count == self._all[name] - 1:
                yield f"{name}: the stamps were never set; imutool convert LOG OUT --restamp takes the log times"
            elif count:
                note = f"{count} of {self._all[name]} messages have the stamp of the one before, and other values"
                yield f"{name}: {note}; imutool convert LOG OUT --restamp spreads them at the sensor's rate"


def find_stamps(log: Log, notes: Mapping[str, list[str]]) -> dict[str, Int64[np.ndarray, "..."]]:
    """New stamps of the IMUs, poses and vectors of a log in file order, with notes by topic.

    Raises:
        LogError: damage.
    """
    stamps: dict[str, Int64[np.ndarray, "..."]] = {}
    clock: dict[str, int] = {}
    for topic in filter(lambda name: _has_stamp(log.topics[name]), log.imu_topics):
        log_ns, recorded = _times(raw_batches(log, topic))
        before = _set(log_ns, recorded)
        found = read_stamps(before)
        late_stamps = log_ns if found.unset else before
        stamps[topic] = restamped(late_stamps)
        moved_s = 1e-9 * float(np.abs(stamps[topic] - late_stamps).max(initial=0))
        under = "the log times" if found.unset else "them"
        line = f"stamps are now on a line under {under}, moved by {moved_s:.6f} s at most"
        notes[topic].append("; ".join([*_unset(recorded, before), *found.faults, line]))
        if found.wraps and not clock:
            clock = {"size_ns": WRAPS[found.wraps.most_common(1)[0][0]], "late_ns": int(log_ns[0] - found.stamp_ns[0])}
    for described in log.with_schema((*MESSAGE_POSES, schemas.VECTOR3)):
        if described.message_encoding in ENCODINGS and described.reflected is None:
            every = partial(described.decode_poses, lost=True)
            decode = every if described.schema_name in MESSAGE_POSES else described.decode_scalars
            log_ns, recorded = _times(batch for _, rows in log.rows([described.name]) for batch in decode(rows))
            before = _set(log_ns, recorded)
            found = read_stamps(before)
            whole_ns = log_ns if found.unset else _unwrapped(log_ns, before, **clock)
            if (whole_ns != recorded).any():
                stamps[described.name] = whole_ns
                faults = "; ".join([*_unset(recorded, before), *found.faults]) or "stamps start after a wrap"
                notes[described.name].append(f"{faults}; they {'are the log times' if found.unset else 'run on'} now")
    return stamps


def _has_stamp(topic: Topic) -> bool:
    """Whether the messages of an IMU have a stamp that can be written: also those of a type of its own, in CDR."""
    if topic.message_encoding not in ENCODINGS:
        return False
    return topic.reflected is None or (isinstance(topic.reflected, Reflected) and bool(topic.reflected.stamp))


def _times(batches: Iterator[ImuBatch | PoseBatch | ScalarBatch]) -> Int64[np.ndarray, "2 n"]:
    """Log times and stamps of a topic, in file order."""
    every = [np.stack([batch.log_time.astype(np.int64), batch.stamp_ns]) for batch in batches]
    return np.concatenate([np.zeros((2, 0), np.int64), *every], axis=1)


def _set(log_ns: Int64[np.ndarray, " n"], stamp_ns: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Stamps, of which those that a driver left at 0, while it waited for its clock, follow the log times."""
    lags = np.sort((log_ns - stamp_ns)[stamp_ns != 0])
    if not len(lags):
        return stamp_ns
    expected_ns = log_ns - lags[len(lags) // 2]
    return np.where((stamp_ns == 0) & (np.abs(expected_ns) > SAME_CLOCK_NS), expected_ns, stamp_ns)


def _unset(recorded: Int64[np.ndarray, " n"], stamp_ns: Int64[np.ndarray, " n"]) -> list[str]:
    count = int((recorded != stamp_ns).sum())
    return [f"stamps that were not set: {count}"] if count else []


def _unwrapped(
    log_ns: Int64[np.ndarray, " n"], stamp_ns: Int64[np.ndarray, " n"], size_ns: int = 0, late_ns: int = 0
) -> Int64[np.ndarray, " n"]:
    """Stamps of poses or vectors without wraps; on the counter of the IMU, of `size_ns`, with as many turns as it has made.

    The log lags behind the IMU's counter by `late_ns`; what lags alike but for whole turns is on the same counter.
    """
    whole_ns = read_stamps(stamp_ns).stamp_ns
    if size_ns < 4 * SAME_CLOCK_NS or not len(whole_ns):
        return whole_ns
    turns = round((int(log_ns[0]) - late_ns - int(whole_ns[0])) / size_ns)
    rest_ns = int(log_ns[0]) - late_ns - int(whole_ns[0]) - turns * size_ns
    return whole_ns + turns * size_ns if abs(rest_ns) < SAME_CLOCK_NS else whole_ns
