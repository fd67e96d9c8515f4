"""The scanner's smooth error over its field, and how well it is known, as two maps side by side."""

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stitch.frames import Array
from stitch.observations.surfaces.scanner_errors import FieldMap
from stitch.units import MICROMETRES
from viz.colours import FIELD, SIGNED

_NO_POINTS = "#d0d3d7"


def scanner_field(found: FieldMap, length_unit: str) -> Figure:
    """Error along the ray (µm) by the direction of the ray, blue too near, red too far; beside it its sigma."""
    um = MICROMETRES[length_unit]
    # As high as the field is beside its width, so that little is empty around the maps.
    across, down = (np.ptp(np.degrees(np.arctan(way))) for way in (found.x, found.y))
    figure = Figure(figsize=(7.4, 1.8 + 3.2 * float(np.clip(down / across, 0.4, 1.6))), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    limit = float(np.nanmax(np.abs(found.error))) * um
    _map(
        left,
        found,
        found.error * um,
        (-limit, limit),
        SIGNED,
        "error along the ray (µm)\nblue: seen too near, red: too far",
    )
    highest = float(np.nanmax(found.sigma)) * um
    _map(right, found, found.sigma * um, (0, highest), FIELD, "standard uncertainty of it (µm)\n")
    left.set_ylabel("direction along the scanner's y (°)")
    return figure


def _map(axes: Axes, found: FieldMap, values: Array, limits: tuple[float, float], colours: str, label: str) -> None:
    """One map of values (Y, X), grey where there are none."""
    x, y = (np.degrees(np.arctan(_edges(way))) for way in (found.x, found.y))
    axes.set_facecolor(_NO_POINTS)
    image = axes.pcolormesh(x, y, np.ma.masked_invalid(values), cmap=colormaps[colours], vmin=limits[0], vmax=limits[1])
    image.set_rasterized(True)
    axes.set_aspect("equal")
    axes.set_xlabel("direction along the scanner's x (°)")
    axes.figure.colorbar(image, ax=axes, location="top", label=label, shrink=0.9)


def _edges(places: Array) -> Array:
    """(n + 1,) half-way between places (n,) at equal distances."""
    step = places[1] - places[0]
    return np.append(places, places[-1] + step) - step / 2
