"""What a cell may add to the core: found by entry points, imported by nothing of the core."""
