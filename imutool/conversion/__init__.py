"""Conversion of data sets to MCAP logs, in worker processes."""
