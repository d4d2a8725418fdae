"""A log for programs that do not read MCAP as it is."""
