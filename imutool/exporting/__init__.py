"""Export a log as a EuRoC (ASL) or rosbag2 folder; the log stays as it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

Progress = Callable[[int, int, str], None]  # done, in all, what is being written


@dataclass(frozen=True)
class ExportReport:
    """Exported files with their rows, the IMU's topic (EuRoC), and the topics left out."""

    output: Path
    format: str
    imu: str | None = None
    written: dict[str, int] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
