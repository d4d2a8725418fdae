"""Export a log as a EuRoC (ASL) or rosbag2 folder; the log stays as it is."""

from __future__ import annotations

from pathlib import Path

from imutool.report import Report


class ExportReport(Report, frozen=True, tag="imutool.export/1"):
    """Exported files with their rows, the IMU's topic (EuRoC), and the topics left out."""

    output: Path
    format: str
    imu: str | None
    written: dict[str, int]
    left_out: list[str]
