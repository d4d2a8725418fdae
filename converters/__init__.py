"""Readers of raw inertial data sets: one file a data set, `read(source) -> Iterator[Recording]`."""
