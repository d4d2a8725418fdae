"""Effects an ideal IMU leaves out, one file each; the file's name is the key (`effect(sensor) -> Effect`, `SENSORS`)."""
