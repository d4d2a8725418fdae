"""Functions in other processes: forked ones of this process, and a pool of worker processes."""
