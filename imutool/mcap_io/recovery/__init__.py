"""Damaged logs: find the valid records and rebuild the index."""
