"""Base to base of two robots that cannot reach each other, through a stand with a rail and a measuring rod."""

from stitch.cells.base_to_base.stand import Stand
from stitch.cells.base_to_base.stand_file import read_stand
from stitch.cells.base_to_base.stand_fit import BaseFit, fit
from stitch.cells.base_to_base.stand_projection import Projection, project
from stitch.cells.base_to_base.stand_solution import BaseResult, solve

__all__ = ["BaseFit", "BaseResult", "Projection", "Stand", "fit", "project", "read_stand", "solve"]
