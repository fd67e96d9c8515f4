"""The ground floor: frames, units, closed forms, least squares, variance components; nothing here knows a robot."""
