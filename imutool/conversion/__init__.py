"""Conversion of data sets to MCAP logs; worker processes of conversion and fleets."""
