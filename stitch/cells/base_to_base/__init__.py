"""Base to base of two robots that cannot reach each other, through a stand with a rail and a measuring rod."""

from stitch.cells.base_to_base.fit import BaseFit, fit
from stitch.cells.base_to_base.projection import Projection, project
from stitch.cells.base_to_base.reading import read_stand
from stitch.cells.base_to_base.report import BaseResult, solve
from stitch.cells.base_to_base.stand import Stand

__all__ = ["BaseFit", "BaseResult", "Projection", "Stand", "fit", "project", "read_stand", "solve"]
