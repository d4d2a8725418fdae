"""Export a log for programs that cannot read it as MCAP."""
