"""Where the command was; it goes once the package is installed anew."""

from stitch.cells.drilling.drill_command import drill

__all__ = ["drill"]
