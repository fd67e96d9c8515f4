"""Tables of the page of a run, as rows of plain values."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.comparison.disagreement_field import ModelHistory, effect_changes
from stitch.model.model import expanded_uncertainty
from stitch.runs.run import Run
from stitch.units import MICROMETRES, value_uncertainty_text
from viz.run_figures import shown_points, view_shifts

# Of more views than this the page lists those to look at first.
_VIEWS = 60


def view_rows(run: Run, history: ModelHistory | None) -> list[dict[str, Any]]:
    """A row for every view, those that disagree most first."""
    um = MICROMETRES[run.session.length_unit]
    apart = np.full(len(run.poses), np.nan)
    if history is not None:
        apart = history.models[-1].field.by_view
    by_view = zip(run.session.views, apart, run.view_rms, view_shifts(run), run.corrections, strict=True)
    rows = [
        {
            "view": view.name,
            "points": len(shown_points(view)),
            "apart": off * um,
            "rms": rms * um,
            "shift": np.linalg.norm(moved) * um,
            "turn": np.linalg.norm(twist[:3]) * 1e3,
        }
        for view, off, rms, moved, twist in by_view
    ]
    key = "rms" if history is None else "apart"
    rows.sort(key=lambda row: -np.nan_to_num(row[key]))
    largest = max((np.nan_to_num(row[key]) for row in rows), default=1.0) or 1.0
    return [row | {"share": 100 * np.nan_to_num(row[key]) / largest} for row in rows[:_VIEWS]]


def target_rows(run: Run) -> list[dict[str, object]]:
    """A row for every target: name, views that see it, rms, position."""
    sightings = run.measurement.capture.sightings
    if run.targets is None or sightings is None:
        return []
    um = MICROMETRES[run.session.length_unit]
    columns = (sightings.targets, sightings.view_counts, run.targets.target_rms, run.targets.landmarks.positions)
    return [
        {"name": name, "seen": int(n), "rms": rms * um, "position": position}
        for name, n, rms, position in zip(*columns, strict=True)
    ]


def effect_rows(run: Run) -> list[dict[str, str]]:
    """Parameters that were fitted or tried; those that the views do not show are left out."""
    return [
        {
            "effect": term.name,
            "name": p.name,
            "value": told.value if p.discrete else told.value.replace("-", "−"),
            "sigma": told.sigma.replace("-", "−"),
            "unit": told.unit,
        }
        for term in run.terms
        for p in term.parameters
        if p.fitted or p.grid
        for told in [p.formatted]
    ]


def note_rows(run: Run) -> list[dict[str, str]]:
    """What reviewers remarked on the steps of the ledger."""
    return [
        {
            "step": effect_changes(run.ledger, i),
            "text": note.text,
            "signed": ", ".join(x for x in (note.by, note.at[:10]) if x),
        }
        for i, step in enumerate(run.ledger)
        for note in step.notes
    ]


def hand_eye_rows(run: Run) -> list[dict[str, str]]:
    """Name, coarse, corrected, U (k = 2) and unit of every number of the hand-eye; all in the mount frame."""
    mm = MICROMETRES[run.session.length_unit] / 1e3
    values = []
    for T in (run.T_mount_coarse, run.T_mount):
        values.append([*(T[:3, 3] * mm), *(Rotation.from_matrix(T[:3, :3]).as_rotvec() * 1e3)])
    U = expanded_uncertainty(run.T_mount, run.mount_covariance)
    units = [*(U[3:] * mm), *(U[:3] * 1e3)]
    names = [(f"translation {axis}", "mm") for axis in "xyz"] + [(f"rotation vector {axis}", "mrad") for axis in "xyz"]
    return [
        {"name": name, "unit": unit} | _told(coarse, corrected, u)
        for (name, unit), coarse, corrected, u in zip(names, values[0], values[1], units, strict=True)
    ]


def _told(coarse: float, corrected: float, U: float) -> dict[str, str]:
    """Three numbers with the digits that U knows, as the terminal has them."""
    value, _, U_text = value_uncertainty_text(corrected, U).partition(" ± ")
    begun = f"{coarse:.{len(value.partition('.')[2])}f}"
    return {name: text.replace("-", "−") for name, text in (("coarse", begun), ("corrected", value), ("U", U_text))}


def matrix(run: Run) -> str:
    """The corrected hand-eye as four rows to copy, in the form of session.toml."""
    return "pose = " + "[\n  " + ",\n  ".join(str([float(f"{x:.12g}") for x in row]) for row in run.T_mount) + ",\n]"
