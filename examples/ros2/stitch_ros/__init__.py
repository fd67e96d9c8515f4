"""stitch in a ROS 2 cell."""
