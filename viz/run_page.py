"""The page of a run: one file, report.html, that needs nothing beside it."""

from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.model.hand_eye_uncertainty import expanded
from stitch.runs.run import Run
from stitch.system.whole_file import whole
from stitch.units import MICROMETRES, rounded
from viz import captions, maps, run_figures, target_figures
from viz.history_figures import waterfall
from viz.page_parts import png, render, svg
from viz.run_figures import shown_points, view_shifts

# Of more views than this the page lists the worst.
_VIEWS = 60


def write_report(run: Run, path: Path) -> None:
    """Write the page: verdict, stages, hand-eye, views and pictures; needs nothing beside it."""
    page = render("report.html.j2", **_content(run))
    with whole(path) as file:
        file.write_text(page, encoding="utf-8")


def _content(run: Run) -> dict[str, object]:
    rows = _views(run)
    return {
        "run": run,
        "um": MICROMETRES[run.session.length_unit],
        "views": rows,
        "hand_eye": _hand_eye(run),
        "hand_eye_matrix": _matrix(run),
        "mount_frame": "base" if run.session.mount == "eye_to_hand" else "flange",
        "effects": _effects(run),
        "history": _history(run),
        "largest": max((row["shift"] for row in rows), default=1.0) or 1.0,
        "all_views": len(run.session.views),
        "pictures": _pictures(run),
        "targets": _targets(run),
        "version": version("stitch"),
    }


def _views(run: Run) -> list[dict[str, Any]]:
    """Rows of the table of views; of many only the worst."""
    um = MICROMETRES[run.session.length_unit]
    by_view = zip(run.session.views, run.view_rms, view_shifts(run), run.corrections, strict=True)
    rows = [
        {
            "view": view.name,
            "points": len(shown_points(view)),
            "rms": rms * um,
            "shift": np.linalg.norm(moved) * um,
            "turn": np.linalg.norm(twist[:3]) * 1e3,
        }
        for view, rms, moved, twist in by_view
    ]
    return rows if len(rows) <= _VIEWS else sorted(rows, key=lambda row: -row["rms"])[:_VIEWS]


def _pictures(run: Run) -> list[tuple[str, str, str]]:
    """What the views have in common decides what can be drawn: overlaps or targets."""
    out = []
    if run.overlaps is not None:
        out += [
            ("Where the views disagree", png(maps.residual_maps(run), 130), captions.MAPS),
            ("How the error fell, iteration by iteration", svg(run_figures.convergence(run)), captions.CONVERGENCE),
            ("What register did to every view", svg(run_figures.per_view(run)), captions.PER_VIEW),
        ]
    if run.targets is not None:
        out += [
            ("Targets, as every view puts them", png(target_figures.sticks(run), 130), captions.STICKS),
            ("Distance of the targets", svg(target_figures.errors(run)), captions.TARGETS),
        ]
    return out


def _targets(run: Run) -> list[dict[str, object]]:
    """Rows of the table of targets: name, views that see it, rms, position."""
    sightings = run.measurement.capture.sightings
    if run.targets is None or sightings is None:
        return []
    um = MICROMETRES[run.session.length_unit]
    columns = (sightings.targets, sightings.seen, run.targets.target_rms, run.targets.landmarks.positions)
    return [
        {"name": name, "seen": int(n), "rms": rms * um, "position": position}
        for name, n, rms, position in zip(*columns, strict=True)
    ]


def _effects(run: Run) -> list[dict[str, str]]:
    """Parameters that were fitted or tried; those that the views do not show are left out."""
    return [
        {
            "effect": term.name,
            "name": p.name,
            "value": rounded(p.value, p.sigma),
            "sigma": f"{p.sigma:.1g}" if p.fitted else "–",
            "unit": p.unit,
        }
        for term in run.terms
        for p in term.parameters
        if p.fitted or p.grid
    ]


def _history(run: Run) -> list[tuple[str, str, str]]:
    """How the error fell as the model grew."""
    if len(run.ledger) < 2:
        return []
    picture = svg(waterfall(run.ledger, run.session.length_unit))
    out = [("The error over the history of the model", picture, captions.WATERFALL)]
    if run.poses_before is not None and run.overlaps is not None:
        picture = png(maps.change_maps(run), 130)
        out.append(("Where the last change of the model helped", picture, captions.CHANGE))
    return out


def _hand_eye(run: Run) -> list[dict[str, object]]:
    """Rows of the hand-eye table: name, coarse, corrected, U (k = 2), unit; all in the mount frame."""
    mm = MICROMETRES[run.session.length_unit] / 1e3
    values = []
    for T in (run.T_mount_coarse, run.T_mount):
        values.append([*(T[:3, 3] * mm), *np.degrees(Rotation.from_matrix(T[:3, :3]).as_rotvec())])
    U = expanded(run.T_mount, run.mount_covariance)
    expanded_units = [*(U[3:] * mm), *np.degrees(U[:3])]
    names = [(f"translation {axis}", "mm") for axis in "xyz"] + [(f"rotation vector {axis}", "°") for axis in "xyz"]
    return [
        {"name": name, "unit": unit, "coarse": coarse, "corrected": corrected, "U": u}
        for (name, unit), coarse, corrected, u in zip(names, values[0], values[1], expanded_units, strict=True)
    ]


def _matrix(run: Run) -> str:
    """The corrected hand-eye as four rows to copy, in the form of session.toml."""
    return "pose = " + "[\n  " + ",\n  ".join(str([float(f"{x:.12g}") for x in row]) for row in run.T_mount) + ",\n]"
