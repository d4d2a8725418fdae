"""Sensor noise: data sheets, Allan deviation, residuals against a reference."""
