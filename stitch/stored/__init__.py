"""A run folder read again: to go on from it, or to show it."""
