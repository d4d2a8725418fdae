"""Entities of a Rerun recording: paths, signals, errors, events and the report."""
