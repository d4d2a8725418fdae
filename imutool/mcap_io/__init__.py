"""Read, write, copy, verify and repair MCAP logs."""

from __future__ import annotations

from imutool.report import Section


class Verified(Section, frozen=True):
    """Checks made on a log: the mode, and how many of its chunks were unpacked."""

    mode: str
    chunks_checked: int
    chunks: int
