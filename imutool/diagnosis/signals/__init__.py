"""Diagnosis of any signal that is no IMU: joints, wheels, fields, pressures, positions, plain numbers."""
