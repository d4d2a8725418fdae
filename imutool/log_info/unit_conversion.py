"""Samples in rad/s and m/s², where gravity and the poses settle their unit."""

from __future__ import annotations

from dataclasses import replace

from imutool.cleaning import CleaningSettings
from imutool.cleaning.rules.units import Units
from imutool.cleaning.truth import truth_of
from imutool.log_info.convention_report import convention_summary
from imutool.recording import Imu, Recording


def in_si_units(recording: Recording) -> tuple[Recording, list[str]]:
    """Recording in rad/s and m/s², and sentences on units that were converted or are in doubt."""
    imu = recording.imu
    whole = replace(convention_summary(imu, truth_of(recording)), settings=CleaningSettings())
    found = [finding for finding in Units().findings(whole) if finding.severity != "note"]
    texts = [finding.what + (", converted" if finding.action == "converted" else "") for finding in found]
    if (whole.scale == 1.0).all():
        return recording, texts
    return replace(recording, imu=Imu(imu.t_ns, imu.gyro * whole.scale[:3], imu.accel * whole.scale[3:])), texts
