"""What each candidate effect would leave of the field of disagreement, for the page."""

from dataclasses import dataclass
from typing import Any

from stitch.comparison.disagreement_field import DisagreementField, Patches, patches_of
from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.residual_structure import predicted_distances
from stitch.observations.surfaces.surface_model import SurfaceObservation
from stitch.units import MICROMETRES
from viz.packed_numbers import packed_floats, packed_values

# Best candidate effects whose field a page holds.
_SHOWN = 3


@dataclass(frozen=True)
class CandidateFields:
    """The field as it is, and as it would be with each of the best candidate effects."""

    patches: Patches
    present: DisagreementField
    if_added: dict[str, DisagreementField]


def candidate_fields(found: Diagnosis) -> CandidateFields | None:
    """None without clouds."""
    linear = found.linear
    present = predicted_distances(linear)
    if present is None or not isinstance(linear.observation, SurfaceObservation):
        return None
    overlaps = linear.observation.unconstrained.overlaps
    patches = patches_of(overlaps.matches, linear.measurement.views.count, overlaps.gram.scale, model_distances=present)
    worth = [c for c in found.candidates if c.ranked.score.observable and c.ranked.score.fitted][:_SHOWN]
    added = {}
    for candidate in worth:
        distances = predicted_distances(linear, candidate.ranked.score)
        assert distances is not None
        added[candidate.name] = patches.field(distances)
    return CandidateFields(patches, patches.field(present), added)


def packed_candidates(fields: CandidateFields, length_unit: str) -> dict[str, Any]:
    """Plain data for the viewer of the page; µm."""
    um = MICROMETRES[length_unit]
    return {
        "patches": packed_floats(fields.patches.points),
        "mean": fields.present.mean_abs * um,
        "noise": fields.present.noise * um,
        "values": packed_values(fields.present.overall * um),
        "candidates": [
            {"name": name, "mean": field.mean_abs * um, "values": packed_values(field.overall * um)}
            for name, field in fields.if_added.items()
        ],
    }
