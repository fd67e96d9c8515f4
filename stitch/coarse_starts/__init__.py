"""Ideas for a first hand-eye: centroids of the clouds, motions of scans against those of the robot."""
