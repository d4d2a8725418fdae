"""Training: recordings to segments, a loss, and the loop that yields one `Epoch` at a time."""
