"""Pages of cells over days, and of the plant that they stand in."""
