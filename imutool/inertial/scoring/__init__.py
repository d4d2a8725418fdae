"""Poses and paths along the samples of an IMU, block by block, and what is scored of them."""
