"""Effects that an ideal IMU leaves out, one file and one `EFFECT` each; the file's name is the key."""
