"""Visual-inertial odometry on real IMU samples and simulated feature tracks."""
