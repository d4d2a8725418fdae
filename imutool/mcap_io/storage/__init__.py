"""Read a log from, and write it to, a disk or an object store."""
