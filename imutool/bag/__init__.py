"""ROS 1 bags by their bytes: read without trusting their index, and written anew with one."""
