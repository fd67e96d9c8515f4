"""Results in the formats of other programs: hand-eye, robot programs, clouds."""
