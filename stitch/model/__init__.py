"""The model of a cell: hand-eye and effects in use with named parameters, what it does to poses and points."""
