"""The page of a run: one file, report.html, that needs nothing beside it."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.model.model import expanded_uncertainty, uncertainty_scope
from stitch.numerics.units import MICROMETRES, value_uncertainty_text
from stitch.observations.observability import NUMBERS
from stitch.output.comparison.model_history import ModelHistory, effect_changes, model_history
from stitch.output.comparison.run_verdict import run_headline, run_light
from stitch.run_data import RunData, doubt_headline
from stitch.system.files import whole_file
from viz import captions
from viz.machine_drawing import machine_svg
from viz.page_parts import (
    Head,
    Subject,
    Tile,
    identity,
    page_written,
    render,
    script_json,
    sections_of,
    with_sections,
)
from viz.part_data import part_data
from viz.part_surface import camera_for, part_shape, part_surface
from viz.run_numbers import shown_points, view_shifts
from viz.target_scene import target_scene

# Tables of the page of a run, as rows of plain values.

# Of more views than this the page lists those to look at first.
_VIEWS = 60


def view_rows(run: RunData, history: ModelHistory | None) -> list[dict[str, Any]]:
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


def target_rows(run: RunData) -> list[dict[str, object]]:
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


def effect_rows(run: RunData) -> list[dict[str, str]]:
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


def note_rows(run: RunData) -> list[dict[str, str]]:
    """Return the remarks of reviewers on the steps of the ledger."""
    return [
        {
            "step": effect_changes(run.ledger, i),
            "text": note.text,
            "signed": ", ".join(x for x in (note.by, note.at[:10]) if x),
        }
        for i, step in enumerate(run.ledger)
        for note in step.notes
    ]


def hand_eye_rows(run: RunData) -> list[dict[str, str]]:
    """Name, coarse, corrected, U (k = 2) and unit of every number of the hand-eye; all in the mount frame."""
    mm = MICROMETRES[run.session.length_unit] / 1e3
    values = []
    for T in (run.T_mount_coarse, run.T_mount):
        values.append([*(T[:3, 3] * mm), *(Rotation.from_matrix(T[:3, :3]).as_rotvec() * 1e3)])
    U = expanded_uncertainty(run.T_mount, run.mount_covariance)
    units = [*(U[3:] * mm), *(U[:3] * 1e3)]
    names = [(f"translation {axis}", "mm") for axis in "xyz"] + [(f"rotation vector {axis}", "mrad") for axis in "xyz"]
    rows = [
        {"name": name, "unit": unit} | _told(coarse, corrected, u)
        for (name, unit), coarse, corrected, u in zip(names, values[0], values[1], units, strict=True)
    ]
    stated = run.session.scanner.T_mount is not None
    for number, row in zip(NUMBERS, rows, strict=True):
        if number in run.unknown:
            row |= {"corrected": "as stated"} if stated else {"coarse": "–", "corrected": "not known"}
            row["U"] = "–"
    return rows


def _told(coarse: float, corrected: float, U: float) -> dict[str, str]:
    """Three numbers with the digits that U knows, as the terminal has them."""
    value, _, U_text = value_uncertainty_text(corrected, U).partition(" ± ")
    begun = f"{coarse:.{len(value.partition('.')[2])}f}"
    return {name: text.replace("-", "−") for name, text in (("coarse", begun), ("corrected", value), ("U", U_text))}


def matrix(run: RunData) -> str:
    """The corrected hand-eye as four rows to copy, in the form of session.toml."""
    open_numbers = f"# Not shown by these views: {', '.join(run.unknown)}\n" if run.unknown else ""
    rows = ",\n  ".join(str([float(f"{x:.12g}") for x in row]) for row in run.T_mount)
    return f"{open_numbers}pose = [\n  {rows},\n]"


def ledger_rows(run: RunData) -> list[dict[str, Any]]:
    """Return a row for every model that was fitted: its name and its errors, µm."""
    um = MICROMETRES[run.session.length_unit]
    # A session of too few views has nothing to leave out.
    largest = max((step.heldout_rms for step in run.ledger if step.heldout_rms > 0), default=1.0)
    return [
        {
            "name": effect_changes(run.ledger, i),
            "rms": step.residual_rms * um,
            "heldout": step.heldout_rms * um,
            "share": 100 * float(np.nan_to_num(step.heldout_rms / largest)),
        }
        for i, step in enumerate(run.ledger)
    ]


def write_report(run: RunData, path: Path, tolerance: float | None = None) -> None:
    """Write the page of a run; it needs nothing beside it. What a diagnosis of this very model said on the page that
    stands there stays.

    Args:
        tolerance: within which the views have to agree on the part, length_unit.
    """
    page = page_with_diagnosis(run, path, tolerance)
    with whole_file(path) as file:
        file.write_text(page, encoding="utf-8")


def page_with_diagnosis(run: RunData, path: Path, tolerance: float | None = None) -> str:
    """Return the page of a run, with what a diagnosis of this very model said on the page at `path`.

    Args:
        tolerance: as of `write_report`.
    """
    diagnosed = _is_diagnosed(run, path.parent)
    sections = sections_of(path.read_text(encoding="utf-8")) if diagnosed and path.is_file() else {}
    return with_sections(report_html(run, tolerance, diagnosed), sections)


def report_html(run: RunData, tolerance: float | None = None, diagnosed: bool = False) -> str:
    """Return the page of a run as text.

    Args:
        tolerance: as of `write_report`.
        diagnosed: a diagnosis of this model lies in its folder.
    """
    with ThreadPoolExecutor(1) as beside:
        if run.registered is not None:
            beside.submit(part_shape, run.fused)
        history = model_history(run)
    content = _content(run, history, tolerance)
    return render("report.html.j2", head=_head(run, history, tolerance), diagnosed=diagnosed, **content)


def _is_diagnosed(run: RunData, folder: Path) -> bool:
    """Whether the diagnosis in a folder is of this very model; where there is none nothing is loaded to ask."""
    if not (folder / "diagnosis.json").is_file():
        return False
    from stitch.output.stored_run import standing_diagnosis

    return bool(standing_diagnosis(folder, run))


def _head(run: RunData, history: ModelHistory | None, tolerance: float | None) -> Head:
    light = None if tolerance is None else run_light(run, history, tolerance)
    gone = [f"View {item.view} does not fit its robot pose and was left out: {item.why}." for item in run.left_out]
    hidden = [f"Not observable from these motions: {direction}." for direction in run.unobservable]
    # What is doubted comes first, alone; without a doubt how far the views agree.
    doubted, agreement = " ".join(map(doubt_headline, run.doubts)), run_headline(run, history)
    agreement = agreement.removeprefix(doubted).strip()
    return Head(
        title=run.session.name,
        verdict=doubted or agreement,
        subjects=[Subject(identity(run))],
        lights=[] if light is None else [light],
        evidence=f"{agreement} {run.verdict}" if doubted else run.verdict,
        notes=[*gone, *hidden],
    )


def _content(run: RunData, history: ModelHistory | None, tolerance: float | None) -> dict[str, object]:
    um = MICROMETRES[run.session.length_unit]
    return {
        "run": run,
        "um": um,
        "written": page_written()[1],
        "doubts": run.doubts,
        "tolerance": None if tolerance is None else tolerance * um,
        "tiles": run_tiles(run, history),
        "on_cad": "" if run.session.cad is None else _on_cad(run),
        "part": shown_part(run, history),
        "surfaces": history is not None,
        "views": view_rows(run, history),
        "hand_eye": hand_eye_rows(run),
        "uncertainty": uncertainty_scope(None),
        "hand_eye_matrix": matrix(run),
        "mount_frame": "base" if run.session.mount == "eye_to_hand" else "flange",
        "effects": effect_rows(run),
        "steps": [] if history is None else history.steps,
        "ledger": ledger_rows(run),
        "notes": note_rows(run),
        "machine": machine_svg(run),
        "targets": target_rows(run),
    }


def _on_cad(run: RunData) -> str:
    from viz.cad_deviation import cad_sentence

    return cad_sentence(run)


def run_tiles(run: RunData, history: ModelHistory | None) -> list[Tile]:
    """Return the three numbers of a run: those of the model before and of the present one."""
    unit, before = run.session.length_unit, len(run.ledger) > 1
    heldout = [step.heldout_rms for step in run.ledger[-2:]] if before else [run.heldout_or_fit_rms]
    tiles = [Tile("heldout", "rms on held-out views", heldout, unit)]
    if history is not None:
        fields = [step.field for step in history.models[-2:]]
        tiles += [
            Tile("mean", "mean on the part", [field.mean_abs for field in fields], unit),
            Tile("worst", "worst place", [float(np.nanmax(field.overall)) for field in fields], unit),
        ]
    return tiles


def shown_part(run: RunData, history: ModelHistory | None) -> dict[str, Any] | None:
    """Return what the viewer of a page shows: the part, or the labelled points; None where there is neither."""
    return _targets(run) if history is None else _part(run, history)


def _part(run: RunData, history: ModelHistory) -> dict[str, Any]:
    """Data of the viewer, and its words."""
    surface = part_surface(run.fused, history.patches)
    camera = camera_for(surface.vertices, surface.normals, upright=run.session.mount == "eye_in_hand")
    data = part_data(surface, camera, history, run.session)
    return {
        "data": script_json(data),
        "title": "Where the views disagree",
        "scale": "Views disagree by (µm)",
        "caption": captions.FIELD,
        "handling": captions.HANDLING,
        "alt": "The part in 3D, coloured by how far the views disagree.",
    }


def _targets(run: RunData) -> dict[str, Any] | None:
    """The same of labelled points; None where there are none."""
    scene = target_scene(run)
    return (
        None
        if scene is None
        else {
            "data": script_json(scene),
            "title": "Where the targets lie off",
            "scale": "Targets lie off by (µm)",
            "caption": captions.CARRIED_TARGETS if run.session.mount == "eye_to_hand" else captions.SEEN_TARGETS,
            "handling": captions.HANDLING,
            "alt": "The targets in 3D, coloured by how far off their place they are seen.",
        }
    )
