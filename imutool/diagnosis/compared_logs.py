"""Logs of a diagnosis, and what of them is compared."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from imutool.diagnosis.settings import DiagnoseSettings
from imutool.file_location import Location
from imutool.mcap_io.log import Log


def imu_topics(log: Location) -> list[str]:
    """Topics of the IMUs of a log."""
    with Log(log) as opened:
        return opened.imu_topics


class ComparedLogs(NamedTuple):
    """Recordings and a simulation, or none, what is compared in them, and settings."""

    reals: Sequence[Location]
    sim: Location | None = None
    imu: str | None = None
    truth: str | None = None
    signals: Sequence[str] = ()
    settings: DiagnoseSettings = DiagnoseSettings()

    def compared_imu(self) -> str | None:
        """Topic of the IMU that is diagnosed: `imu`, or the first of several in one recording."""
        topics = imu_topics(self.reals[0])
        return self.imu or (topics[0] if len(topics) > 1 and len(self.reals) == 1 else None)
