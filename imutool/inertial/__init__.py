"""Inertial navigation: kinematics, integration, rest detection, error metrics."""
