"""The page of a run under its former name, until the entry points are installed anew."""

from viz.page_parts import png, svg
from viz.run_page import write_report

__all__ = ["png", "svg", "write_report"]
