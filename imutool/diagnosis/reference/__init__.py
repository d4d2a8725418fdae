"""Reference of a recording: what it covers, and where it is wrong."""
