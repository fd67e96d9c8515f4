"""A window in a car body: scan onto CAD, deviation map, corrected path, flush and gap of the seam."""
