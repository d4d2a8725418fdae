"""Samples of an IMU in a temporary file: to read them again unpacks no chunk."""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np

from imutool.cleaning.samples import BLOCK, Samples

ROW_BYTES = 64  # of a sample: two times and six values; its message has some 350
MAX_ROWS = 1 << 21  # 128 MiB, three hours at 200 Hz: a folder of temporary files may lie in memory
LAST_NS = 2**63 - 1


class KeptBlocks:
    """Blocks of samples in a file without a name.

    Of more than `MAX_ROWS` samples, or where the system gives no file or no room, nothing is kept.
    """

    def __init__(self) -> None:
        self._file: BinaryIO | None = None
        self._rows = 0

    def add(self, samples: Samples) -> None:
        """Keep the next block; each but the last has `BLOCK` samples."""
        table = np.column_stack([samples.log_ns, samples.stamp_ns, samples.values.view(np.int64)])
        is_first, self._rows = not self._rows, self._rows + len(table)
        try:
            if is_first:
                self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115  closed with this object
                weakref.finalize(self, self._file.close)
            if self._file is not None and (self._rows > MAX_ROWS or self._file.write(table.tobytes()) != table.nbytes):
                self._drop()
        except OSError:
            self._drop()

    def _drop(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file = None

    def read(self, start_ns: int | None, end_ns: int | None) -> Iterator[Samples] | None:
        """The samples with log times from `start_ns` to `end_ns`, both included; None where they are not kept."""
        ends = 0 if start_ns is None else start_ns, LAST_NS if end_ns is None else end_ns
        return None if self._file is None else self._within(self._file, *ends)

    def _within(self, file: BinaryIO, start_ns: int, end_ns: int) -> Iterator[Samples]:
        for first in range(0, self._rows, BLOCK):
            file.seek(first * ROW_BYTES)
            table = np.frombuffer(file.read(min(BLOCK, self._rows - first) * ROW_BYTES), np.int64).reshape(-1, 8)
            log_ns, stamp_ns, values = table[:, 0].copy(), table[:, 1].copy(), table[:, 2:].copy().view(np.float64)
            samples = Samples(first + np.arange(len(table)), log_ns, stamp_ns, values)
            inside = (log_ns >= start_ns) & (log_ns <= end_ns)
            if inside.any():
                yield samples if inside.all() else samples.where(inside)
