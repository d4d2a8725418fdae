"""Read and repair ROS 1 bags without trusting their index."""
