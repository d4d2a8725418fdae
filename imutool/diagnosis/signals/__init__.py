"""Diagnosis of signals that are no IMU: joints, wheels, fields, pressures, positions."""
