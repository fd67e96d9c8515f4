"""Labelled points and probes: landmarks, rows, outliers, their linear model."""
