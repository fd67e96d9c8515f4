"""A cell over days: the history of its runs, what moves in it, since when, and until when a calibration holds."""
