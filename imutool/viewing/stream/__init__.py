"""Streams of samples: sources, debiased one sample at a time, shown live."""
