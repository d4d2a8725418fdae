"""Conversion of data sets to MCAP logs."""

from __future__ import annotations

from imutool.report import Section


class Failure(Section, frozen=True):
    """Failed sequence, with the reason."""

    name: str
    message: str
