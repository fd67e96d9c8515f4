"""How far the scans lie off the CAD that session.toml states, before and after the last change of the model."""

import numpy as np
import trimesh

from stitch.errors import NoResultError
from stitch.model.forward import true_geometry
from stitch.model.model import Model
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES
from stitch.output.comparison.model_history import models_of
from stitch.plugins.cells.cad import CadSurface, cad_surface, nearest_partners
from stitch.plugins.cells.placed_scans import JoinedScans
from stitch.plugins.cells.scan_to_cad import find_cad_start, refine_start
from stitch.run_data import RunData
from viz.page_parts import round_length

# Points of the scans that are compared, evenly over their order.
_POINTS = 8_000
# Samples along its diagonal, at which a curved surface is known to a few micrometres.
_FINENESS = 300
# Share of the CAD's size beyond which a point is none of its surface, as at a start that is found.
_BEYOND = 1 / 250
# A change below this share of the deviation is none.
_SAME = 0.03


def cad_sentence(run: RunData) -> str:
    """Return by how much the last change of the model moved the scans onto the CAD, and whether the part got better.

    Each model's scans are laid onto the CAD by themselves (least squares along its normals): where the part stands is
    no deviation. Empty where no CAD is stated, nothing was changed yet, or scans and CAD do not meet.
    """
    if run.session.cad is None or run.registered is None or len(run.ledger) < 2:
        return ""
    mesh = trimesh.load_mesh(run.session.cad)
    mesh.apply_scale(METRES[run.session.cad_unit or run.session.length_unit] / METRES[run.session.length_unit])
    cad = cad_surface(mesh, _FINENESS)
    scans_before, scans_after = (_placed(run, model) for _, model in models_of(run)[-2:])
    try:
        T_reference_part, _, _ = find_cad_start(scans_after, cad)
    except NoResultError:
        return ""
    before, after = (_deviation(scans, cad, T_reference_part) for scans in (scans_before, scans_after))
    change = after / before - 1
    better = "got worse" if change > _SAME else "got better" if change < -_SAME else "is the same"
    texts = [round_length(value, run.session.length_unit) for value in (before, after)]
    return f"Deviation from the CAD: {texts[0]} before, {texts[1]} with it (rms). The part {better}."


def _placed(run: RunData, model: Model) -> JoinedScans:
    """Return points of all scans where a model puts them, reference frame."""
    scans = run.measurement.capture.scans
    every = max(1, sum(len(scan.points) for scan in scans) // _POINTS)
    poses, corrected = true_geometry(run.measurement, model)
    points = [frames.transform(T, p[::every]) for T, p in zip(poses, corrected, strict=True)]
    normals = [frames.rotate(T, scan.normals[::every]) for T, scan in zip(poses, scans, strict=True)]
    usable = np.concatenate([scan.usable[::every] for scan in scans])
    view = np.repeat(np.arange(len(scans)), [len(p) for p in points])
    none = np.zeros(len(view))
    return JoinedScans(np.vstack(points), np.vstack(normals), usable, none, spacing=0.0, noise=0.0, view=view)


def _deviation(scan: JoinedScans, cad: CadSurface, T_reference_part: Array) -> float:
    """Return the rms distance of the usable points from the CAD after they are laid onto it, length_unit."""
    scan = scan.take(scan.usable)
    T_reference_part = refine_start(T_reference_part, scan.points, scan.normals, cad, _BEYOND * cad.size)
    T_part_reference = frames.inverse(T_reference_part)
    local = frames.transform(T_part_reference, scan.points)
    distance, _, meets = nearest_partners(cad, local, frames.rotate(T_part_reference, scan.normals))
    near = distance[meets & (np.abs(distance) < _BEYOND * cad.size)]
    return float(np.sqrt(np.mean(near**2)))
