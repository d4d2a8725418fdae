"""Inertial navigation: kinematics, strapdown integration, preintegration, rest detection.

Error metrics.
"""
