"""Made-up flights with a perfect IMU, for the estimates of `imutool.vio`."""

from __future__ import annotations

import pytest

from imutool.recording import Recording
from imutool.sensor.made_up_flight import FlightSettings, TriadSettings, flight

PERFECT = TriadSettings(
    noise_density=0.0, walk_density=0.0, typical_bias=0.0, turn_on_bias=0.0, warm_up=0.0, scale=0.0, misalignment_rad=0.0
)


@pytest.fixture(scope="session")
def perfect() -> Recording:
    """Ten seconds, IMU and truth without any error."""
    return flight(2, FlightSettings(gyro=PERFECT, accel=PERFECT, truth_noise_m=0.0, truth_noise_rad=0.0, duration_s=10.0))
