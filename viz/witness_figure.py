"""Where another program's stitched cloud differs from a run's: the part coloured by distance, and each view's shift."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from stitch.numerics.units import MICROMETRES
from stitch.output.comparison.open3d_witness import Witness
from stitch.run_data import RunData

_DPI = 110
_SPAN_QUANTILE = 0.98


def write_witness(witness: Witness, run: RunData, folder: Path) -> None:
    """Write witness.png: the run's cloud seen along its thinnest axis, and the views' shifts, in µm."""
    to_um = MICROMETRES[run.session.length_unit]
    figure = Figure(figsize=(11, 5), layout="constrained")
    FigureCanvasAgg(figure)
    part, views = figure.subplots(1, 2, width_ratios=(3, 2))
    centred = witness.places - witness.places.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    distance = witness.from_run * to_um
    span = float(np.quantile(np.abs(distance), _SPAN_QUANTILE)) or 1.0
    shown = part.scatter(*(centred @ axes[:2].T).T, c=distance, s=2, cmap="RdBu_r", vmin=-span, vmax=span, linewidths=0)
    part.set_aspect("equal")
    part.set_xlabel(run.session.length_unit)
    part.set_title("From this cloud to Open3D's, along the normal")
    figure.colorbar(shown, ax=part, label="µm")
    views.barh(witness.views, witness.shift * to_um, color="0.45")
    views.invert_yaxis()
    views.set_xlabel("µm")
    views.set_title("How far Open3D puts each view elsewhere")
    figure.savefig(folder / "witness.png", dpi=_DPI)
