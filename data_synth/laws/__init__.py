"""The laws of `nature.py`, by what they change: joints and links, bodies, measured points."""
