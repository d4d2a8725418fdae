"""The messages of an IMU on their way through the rules: columns with each message's number, and cuts with context."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from imutool.mcap_io.topics import ImuBatch

BLOCK = 4096  # samples: what rules see at a time depends on the log alone, not on how its chunks were cut

Numbers = Int64[np.ndarray, " n"]


class Samples(NamedTuple):
    """Consecutive messages, those dropped so far left out; `number` counts every message from 0, in file order."""

    number: Numbers
    log_ns: Int64[np.ndarray, " n"]
    stamp_ns: Int64[np.ndarray, " n"]
    values: Float64[np.ndarray, "n 6"]  # gyro, accel, in the log's own units

    def where(self, index: slice | Bool[np.ndarray, " n"]) -> Samples:
        """The chosen rows."""
        return Samples(*(column[index] for column in self))


def joined(parts: list[Samples]) -> Samples:
    """Parts in a row as one."""
    return parts[0] if len(parts) == 1 else Samples(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def blocks(batches: Iterable[ImuBatch]) -> Iterator[Samples]:
    """The messages in blocks of `BLOCK`, the last one shorter, whatever the batches were."""
    parts: list[Samples] = []
    count, waiting = 0, 0
    for batch in batches:
        n = len(batch.stamp_ns)
        number = np.arange(count, count + n)
        parts.append(Samples(number, batch.log_time, batch.stamp_ns, np.concatenate([batch.gyro, batch.accel], axis=1)))
        count, waiting = count + n, waiting + n
        if waiting >= BLOCK:
            whole = joined(parts)
            for first in range(0, waiting - BLOCK + 1, BLOCK):
                yield whole.where(slice(first, first + BLOCK))
            parts = [whole.where(slice(waiting // BLOCK * BLOCK, None))]
            waiting %= BLOCK
    if waiting:
        yield joined(parts)


def padded(stream: Iterable[Samples], margin: int) -> Iterator[tuple[Samples, slice]]:
    """The samples with up to `margin` before and after each: rows, and which of them are now to be judged."""
    waiting: list[Samples] = []
    before = 0
    for block in stream:
        waiting.append(block)
        count = sum(len(part.number) for part in waiting)
        if count - before > margin:
            whole = joined(waiting)
            yield whole, slice(before, count - margin)
            waiting = [whole.where(slice(max(0, count - 2 * margin), None))]
            before = min(margin, count - margin)
    if waiting:
        whole = joined(waiting)
        if before < len(whole.number):
            yield whole, slice(before, len(whole.number))
