"""The result of a run on labelled points in plain sentences."""

from collections.abc import Sequence

import numpy as np

from stitch.stages.target_fit import LabelledFit
from stitch.observations.targets.outliers import Outlier
from stitch.observations.surfaces.pose_channel import Repeatability
from stitch.units import MICROMETRES
from stitch.measurement.session import Session

# Within a quarter of the noise floor's square it is noise; above, something else is there.
_NEAR_FLOOR = 1.1
_LISTED = 12


def sentence(found: LabelledFit, after: float, floor: float, scatter: Repeatability, length_unit: str) -> str:
    """What the model leaves at the targets, what the noise would leave, and where the difference sits."""
    to_um = MICROMETRES[length_unit]
    left, out, noise = (f"{x * to_um:.4g} µm" for x in (found.rms, found.heldout_rms, floor))
    if found.rms < _NEAR_FLOOR * floor:
        return f"The model puts all targets within {left} rms (3D), which the sensor's own noise ({noise}) explains."
    return (
        f"The model puts the targets within {left} rms (3D), {out} in views left out with their neighbours; "
        f"the sensor's own noise would leave {noise}. The robot's poses scatter by "
        f"{scatter.translation * to_um:.3g} µm and "
        f"{scatter.rotation * 1e3:.2g} mrad; moving each view by its own correction leaves {after * to_um:.3g} µm."
    )


def notes_of(found: LabelledFit, outliers: Sequence[Outlier], session: Session) -> tuple[str, ...]:
    """Outliers by name, targets seen once, clouds that were not used, and a covariance that had to be widened."""
    notes = _left_out(found, outliers, session)
    if any(view.cloud is not None for view in session.views):
        notes.append("Some views have no cloud: only the labelled points were fitted.")
    if found.inflation > 2.5:
        notes.append(
            f"Views near each other err alike: all sigmas are {np.sqrt(found.inflation):.1f} times those of "
            "independent pose errors."
        )
    return tuple(notes)


def beside_notes(found: LabelledFit, outliers: Sequence[Outlier], session: Session) -> tuple[str, ...]:
    """Outliers by name, targets seen once, and what is not used of labelled points beside clouds."""
    notes = _left_out(found, outliers, session)
    if session.nominal is not None:
        notes.append("Nominal positions (targets.csv) are not used beside clouds; the targets' places were free.")
    if found.landmarks.orientation is not None:
        notes.append("Of the probe in frames.csv only the place counts beside clouds, not its turn.")
    return tuple(notes)


def _left_out(found: LabelledFit, outliers: Sequence[Outlier], session: Session) -> list[str]:
    to_um = MICROMETRES[session.length_unit]
    notes = []
    if outliers:
        told = [f"{named(o, session)} ({o.distance * to_um:.3g} µm, {o.times:.0f} times the usual)" for o in outliers]
        more = f" and {len(told) - _LISTED} more" if len(told) > _LISTED else ""
        notes.append(f"Not used, because they contradict the rest: {', '.join(told[:_LISTED])}{more}.")
    sightings = found.rows.capture.sightings
    assert sightings is not None
    once = [name for name, n in zip(sightings.targets, sightings.seen, strict=True) if n < 2]
    if once:
        notes.append(f"Seen in fewer than two views, so that they say nothing: {', '.join(once)}.")
    return notes


def named(outlier: Outlier, session: Session) -> str:
    """An outlier by the names of its view and target."""
    view = session.views[outlier.view].name
    return f"view {view}" if outlier.target is None else f"{outlier.target} in view {view}"
