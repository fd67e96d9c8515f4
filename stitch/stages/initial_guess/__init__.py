"""First hand-eyes from nothing: centroids of the clouds, motions of scans against the robot's."""
