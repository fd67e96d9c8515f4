"""Hand-eyes from spheres and trackers, and an arm's own errors as DH rows and URDF."""
