"""Where the command was; it goes once the package is installed anew."""

from stitch.cells.base_to_base.base_command import base

__all__ = ["base"]
