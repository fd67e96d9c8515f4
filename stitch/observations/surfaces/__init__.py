"""Overlapping surfaces: matches, sums over pairs of views, freed views, their linear model."""
