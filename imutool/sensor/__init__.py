"""What an ideal simulation leaves out of an IMU."""
