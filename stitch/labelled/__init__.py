"""Labelled points and measured probes: the same chain, effects and statistics without a cloud to match."""
