"""Contents and quality of a log: topics, clocks, IMU defects and noise, truth coverage."""
