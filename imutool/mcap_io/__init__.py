"""Read, write, copy, verify and repair MCAP logs."""
