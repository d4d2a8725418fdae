"""Inertial navigation: kinematics, strapdown integration, preintegration, rest detection, error metrics."""
