"""Taught points from the files of robot controllers and trackers."""
