"""Contents and quality of a log: topics, clocks, IMU defects and noise, coverage by the truth."""
