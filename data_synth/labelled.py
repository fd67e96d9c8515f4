"""Points of a part that a scanner's software can name: sphere centres and holes."""

import numpy as np
from numpy.typing import NDArray

from data_synth.scene import Scene
from data_synth.shapes import drill_plate, spheres

Array = NDArray[np.float64]


def targets_of(scene: Scene) -> dict[str, Array]:
    """Name → (3,) in the part frame; empty unless the scene asks for labelled points.

    Raises ValueError for a part without any.
    """
    if not scene.part.labelled:
        return {}
    shape, parameters = scene.part.shape, scene.part.parameters
    if shape == "sphere_plate":
        places, word = spheres.centres(spheres.SpherePlate(**parameters)), "ball"
    elif shape in ("drill_plate", "curved_drill_plate"):
        kind = drill_plate.DrillPlate if shape == "drill_plate" else drill_plate.CurvedDrillPlate
        places, word = drill_plate.holes(kind(**parameters))[0], "hole"
    elif shape == "sphere":
        places, word = np.zeros((1, 3)), "ball"
    else:
        raise ValueError(f"part.labelled: {shape} has no labelled points; spheres and drill plates have")
    return {f"{word}{i + 1}": np.asarray(p, float) for i, p in enumerate(places)}
