"""Overlapping surfaces: matches, sums over pairs of views, free-network views, their linear model."""
