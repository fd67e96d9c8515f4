"""What a run found, and who watches it work."""
