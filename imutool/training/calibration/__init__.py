"""Calibration in closed form: least squares over windows between true poses, log by log."""
