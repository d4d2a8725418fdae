"""Audit of a simulator's IMU: what it does wrong by itself."""
