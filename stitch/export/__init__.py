"""What a run found in the words of other programs: hand-eye, arm, robot programs, clouds."""
