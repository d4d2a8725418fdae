"""Turns raw inertial data into MCAP logs, learns how an IMU's bias evolves, and writes the debiased log."""

__version__ = "0.1.0"
