"""Cells that are more than scans of a part: bases, drilling, panel, window, an artefact to verify."""
