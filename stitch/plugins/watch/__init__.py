"""A cell over days: the history of its runs, what moves in it, and until when a calibration holds."""
