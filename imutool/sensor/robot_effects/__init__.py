"""Effects of joints, wheels, magnetometers, barometers and GNSS, by the sizes of a signal."""
