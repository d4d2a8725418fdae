"""The CRC-32 of the format: on the log of `tests/bench/rewrite.py` zlib's costs a third of what `cp` does, isal's a tenth."""

from __future__ import annotations

try:
    from isal.isal_zlib import crc32
except ImportError:  # no wheel for this machine: the same numbers, later
    from zlib import crc32

__all__ = ["crc32"]
