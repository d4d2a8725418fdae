"""Cleaning of a log's IMU: `look` finds the defects, a `Cleaner` removes them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from imutool.array_types import Bool
from imutool.cleaning.finding import Finding
from imutool.cleaning.rule import CleaningSettings
from imutool.cleaning.survey import Survey, UntrustedError, look, raw_batches
from imutool.errors import LogError
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.mcap_io.log import Log

__all__ = [
    "Cleaner",
    "CleaningSettings",
    "Finding",
    "Survey",
    "UntrustedError",
    "cleaned",
    "look",
    "raw_batches",
    "rows",
]


class Cleaner:
    """Drop and convert the messages of a surveyed topic, in file order.

    Batches may have any size: the result does not depend on it.
    """

    def __init__(self, survey: Survey) -> None:
        self._survey, self._count = survey, 0
        self._matrices = survey.matrices
        self._converts = bool((self._matrices != np.eye(3)).any())

    def __call__(self, batch: ImuBatch) -> ImuBatch:
        """Remaining messages, in the units and axes that the survey settled.

        Raises:
            LogError: more messages than were surveyed.
        """
        end = self._count + len(batch.stamp_ns)
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
        if self._converts:
            gyro, accel = self._matrices
            batch = batch._replace(gyro=batch.gyro @ gyro.T, accel=batch.accel @ accel.T)
        return batch


def rows(batch: ImuBatch, index: slice | Bool[np.ndarray, " n"]) -> ImuBatch:
    """Rows of a batch."""
    return batch._replace(**{name: getattr(batch, name)[index] for name in batch._fields if name != "frame_id"})


def cleaned(log: Log, survey: Survey, end_ns: int | None) -> Iterator[ImuBatch]:
    """Clean messages of a surveyed IMU, up to and including the stamp `end_ns`.

    Raises:
        LogError: damage, or a log that has grown since it was surveyed.
    """
    for batch in map(Cleaner(survey), raw_batches(log, survey.topic)):
        count = len(batch.stamp_ns) if end_ns is None else int(np.searchsorted(batch.stamp_ns, end_ns, side="right"))
        if count < len(batch.stamp_ns):
            yield rows(batch, slice(count))
            return
        yield batch
