"""From a folder of somebody's own scans and poses to a session: what is found there, read, guessed and written."""
