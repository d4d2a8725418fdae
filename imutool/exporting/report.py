"""What an export wrote."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

Progress = Callable[[int, int, str], None]  # done, in all, what is being written


@dataclass(frozen=True)
class ExportReport:
    """What was written: the IMU's topic (of a EuRoC folder), messages or rows by file, and the topics left behind."""

    output: Path
    format: str
    imu: str | None = None
    written: dict[str, int] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
