"""The picture of a run on labelled points: targets and views in the base frame, coloured by how far off they lie."""

from typing import Any

import numpy as np

from stitch.comparison.disagreement_field import TargetStep, target_history
from stitch.frames import Array
from stitch.runs.run import Run
from stitch.units import MICROMETRES, length_text
from viz.colours import robust_limit
from viz.filled_templates import script_json
from viz.packed_numbers import packed_values
from viz.page_parts import png
from viz.part_data import colour_stops, extent_of, packed_surface
from viz.part_picture import part_picture
from viz.target_bodies import bodies, camera_of
from viz.target_marks import Marks, mark_values, marks_of

_SEEN = "the views see the targets {} off their place, rms"
_PICTURE = "The targets in 3D, coloured by how far off their place they are seen."
_ENDS = ["on their place", "off their place"]


def target_scene(run: Run) -> dict[str, str] | None:
    """Data of the viewer (JSON) and the still picture in its place; None where no targets were seen."""
    steps = target_history(run)
    if run.targets is None or not steps:
        return None
    um, marks = MICROMETRES[run.session.length_unit], marks_of(run)
    values = [step_values(run, marks, step) * um for step in steps]
    limit = robust_limit(values[1])
    surface, camera = bodies(marks), camera_of(marks)
    shown = [
        (f"{step.name}\n{length_text(step.rms * um / 1e3, 'mm')} rms", own)
        for step, own in zip(steps[1:], values[1:], strict=True)
    ]
    still = part_picture(surface, camera, shown[-4:], limit, "targets lie off by (µm)")
    packed = packed_surface(surface, camera, marks.T[:, :3, 3], extent_of(surface.vertices, camera))
    told = _told(run, steps, values, limit) | {"marks": _names(run, marks)}
    return {"data": script_json(packed | told), "still": png(still, 110)}


def step_values(run: Run, marks: Marks, step: TargetStep) -> Array:
    """(M,) what the marks count at a step, length_unit."""
    assert run.targets is not None
    s = run.targets.rows.sightings
    v, slot = np.nonzero(s.used)
    return mark_values(marks.counted, v, s.target[v, slot], step.distances[v, slot])


def _told(run: Run, steps: tuple[TargetStep, ...], values: list[Array], limit: float) -> dict[str, Any]:
    """What the viewer says and shows of every step; µm."""
    assert run.targets is not None
    um = MICROMETRES[run.session.length_unit]
    floor = run.targets.noise_floor * um
    return {
        "steps": [
            {"name": step.name, "mean": step.rms * um, "noise": floor, "values": packed_values(own)}
            for step, own in zip(steps, values, strict=True)
        ],
        "views": [],
        "full": limit,
        "colours": colour_stops(),
        "words": {"picture": _PICTURE, "all": _SEEN, "ends": _ENDS},
        "begin": 1,
        "end": len(steps) - 2,
    }


def _names(run: Run, marks: Marks) -> list[list[str | None]]:
    """View and target of every mark, null where it stands for all of them; both null where it counts nothing."""
    assert run.targets is not None
    views, targets = run.session.names, run.targets.rows.sightings.targets
    return [[None if v < 0 else views[v], None if k < 0 else targets[k]] for v, k in marks.counted.tolist()]
