"""Conversion of data sets to MCAP logs."""
