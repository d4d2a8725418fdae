"""Effects that an ideal IMU lacks: one file, one `EFFECT`; the file's name is the key."""
