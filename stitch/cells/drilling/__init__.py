"""Drilling on curved structures: see the surface, correct the drive of a group of holes from its reference holes.

Frames: base R, flange F, tool T with its origin on the work plane at height h along the flange's z, hole H.
"""
