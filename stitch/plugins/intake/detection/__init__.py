"""Targets in scans: boards and balls, found without a guess; plain arrays in, labelled points out."""
