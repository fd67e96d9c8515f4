"""Statistics on plain arrays: variance components, least squares, folds, selection; nothing here knows a robot."""
