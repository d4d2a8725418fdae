"""Recordings of one table, or of the tables of a folder."""
