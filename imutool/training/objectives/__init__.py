"""Objectives of the descent: what its steps make smaller."""
