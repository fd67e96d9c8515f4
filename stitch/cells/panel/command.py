"""Where the command was; it goes once the package is installed anew."""

from stitch.cells.panel.panel_command import panel

__all__ = ["panel"]
