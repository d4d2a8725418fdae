"""A log's IMU as a first pass says it should be: what is no measurement left out, units put right, batch by batch."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool

from imutool.cleaning.first_pass import Survey, raw_batches
from imutool.errors import LogError
from imutool.mcap_io.log import Log
from imutool.mcap_io.topics import ImuBatch


class Cleaner:
    """Takes all messages of the surveyed topic in file order, in batches of any size; how they are cut changes nothing."""

    def __init__(self, survey: Survey) -> None:
        self._survey, self._count = survey, 0
        self._scales = bool((survey.scale != 1.0).any())

    def __call__(self, batch: ImuBatch) -> ImuBatch:
        """The messages that are left, converted where the survey says so.

        Raises:
            LogError: more messages than were surveyed.
        """
        n = len(batch.stamp_ns)
        end = self._count + n
        if end > self._survey.messages:
            raise LogError(
                f"has more than the {self._survey.messages} messages of the first pass",
                where=f"{self._survey.log} {self._survey.topic}",
                expected="a log that nobody writes to",
                fix="Start again when it is complete",
            )
        keep = ~self._survey.dropped[self._count : end]
        self._count = end
        if not keep.all():
            batch = rows(batch, keep)
        if self._scales:
            scale = self._survey.scale
            batch = batch._replace(gyro=np.multiply(batch.gyro, scale[:3]), accel=np.multiply(batch.accel, scale[3:]))
        return batch


def rows(batch: ImuBatch, index: slice | Bool[np.ndarray, " n"]) -> ImuBatch:
    """Some of a batch's messages."""
    return batch._replace(**{name: getattr(batch, name)[index] for name in batch._fields if name != "frame_id"})


def cleaned(log: Log, survey: Survey, end_ns: int | None = None) -> Iterator[ImuBatch]:
    """A surveyed IMU's clean messages, up to a stamp (its last sample at or before it included).

    Raises:
        LogError: damage, or a log that has grown since it was surveyed.
    """
    clean = Cleaner(survey)
    for batch in map(clean, raw_batches(log, survey.topic)):
        count = len(batch.stamp_ns) if end_ns is None else int(np.searchsorted(batch.stamp_ns, end_ns, side="right"))
        if count < len(batch.stamp_ns):
            yield rows(batch, slice(count))
            return
        yield batch
