import numpy as np

from stitch.effects import effect, event, twist


@effect("mount", v=event(), xi=twist("", 6e-4, 0.2))
def knock(views, v, xi):
    """M·exp(ξ) from view v on"""
    return np.outer(views.number >= v, xi)
