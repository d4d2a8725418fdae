"""Rotations: SO(3) on tensors, unit quaternions in numpy."""
