"""The report: one self-contained page."""

import base64
import io
from importlib.metadata import version
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, select_autoescape
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from stitch.runs.run import Run
from stitch.system.whole_file import whole
from stitch.units import rounded
from viz import captions, figures, maps, target_figures
from viz.diagnosis_figures import waterfall
from viz.recording import shown_points, view_shifts
from viz.units import to_micrometres, to_millimetres

# Of more views than this the page lists the worst.
_VIEWS = 60


def write_report(run: Run, path: Path) -> None:
    """Write the page: verdict, stages, hand-eye, views and pictures; needs nothing beside it."""
    environment = Environment(loader=PackageLoader("viz"), autoescape=select_autoescape(default=True), trim_blocks=True)
    template = environment.get_template("report.html.j2")
    page = template.render(**_content(run))
    with whole(path) as file:
        file.write_text(page, encoding="utf-8")


def _content(run: Run) -> dict[str, object]:
    um = to_micrometres(run.session.length_unit)
    shift = view_shifts(run)
    rows = [
        {"view": view.name, "points": len(shown_points(view)), "rms": rms * um,
         "shift": np.linalg.norm(moved) * um, "turn": np.linalg.norm(twist[:3]) * 1e3}
        for view, rms, moved, twist in zip(run.session.views, run.view_rms, shift, run.corrections, strict=True)
    ]  # fmt: skip
    if len(rows) > _VIEWS:
        rows = sorted(rows, key=lambda row: -row["rms"])[:_VIEWS]
    return {
        "run": run, "um": um, "views": rows, "hand_eye": _hand_eye(run),
        "effects": _effects(run), "history": _history(run),
        "largest": max((row["shift"] for row in rows), default=1.0) or 1.0,
        "all_views": len(run.session.views), "pictures": _pictures(run),
        "targets": _targets(run),
        "version": version("stitch"),
    }  # fmt: skip


def _pictures(run: Run) -> list[tuple[str, str, str]]:
    """What the views have in common decides what can be drawn: overlaps or targets."""
    out = []
    if run.overlaps is not None:
        out += [
            ("Where the views disagree", png(maps.residual_maps(run), 130), captions.MAPS),
            ("How the error fell, iteration by iteration", svg(figures.convergence(run)), captions.CONVERGENCE),
            ("What register did to every view", svg(figures.per_view(run)), captions.PER_VIEW),
        ]
    if run.labelled is not None:
        out += [
            ("Targets, as every view puts them", png(target_figures.sticks(run), 130), captions.STICKS),
            ("Distance of the targets", svg(target_figures.errors(run)), captions.TARGETS),
        ]
    return out


def _targets(run: Run) -> list[dict[str, object]]:
    """Rows of the table of targets; their places stand where a cloud would."""
    sightings = run.measurement.capture.sightings
    if run.labelled is None or sightings is None:
        return []
    um = to_micrometres(run.session.length_unit)
    return [
        {"name": name, "seen": int(n), "rms": rms * um, "position": position}
        for name, n, rms, position in zip(
            sightings.targets, sightings.seen, run.labelled.target_rms, run.labelled.landmarks.positions, strict=True)
    ]  # fmt: skip


def _effects(run: Run) -> list[dict[str, str]]:
    """Fitted parameters that the views can see."""
    rows = []
    for term, sigmas in zip(run.terms, run.sigmas, strict=True):
        for p, value, sigma in zip(run.measurement.parameters(term.effect), term.values, sigmas, strict=True):
            if np.isfinite(sigma) or p.grid:
                told = f"{sigma:.1g}" if np.isfinite(sigma) else "–"
                rows.append({"effect": term.effect.name, "name": p.name, "value": rounded(value, sigma), "sigma": told,
                             "unit": p.unit})  # fmt: skip
    return rows


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
    """Rows of the hand-eye table: name, coarse, corrected, sigma, unit."""
    mm = to_millimetres(run.session.length_unit)
    sigma = np.sqrt(np.diag(run.mount_covariance))
    values = []
    for T in (run.T_mount_coarse, run.T_mount):
        values.append([*(T[:3, 3] * mm), *np.degrees(Rotation.from_matrix(T[:3, :3]).as_rotvec())])
    sigmas = [*(sigma[3:] * mm), *np.degrees(sigma[:3])]
    names = [(f"translation {axis}", "mm") for axis in "xyz"] + [(f"rotation vector {axis}", "°") for axis in "xyz"]
    return [
        {"name": name, "unit": unit, "coarse": coarse, "corrected": corrected, "sigma": s}
        for (name, unit), coarse, corrected, s in zip(names, values[0], values[1], sigmas, strict=True)
    ]


def svg(figure: Figure) -> str:
    """A figure as a data address."""
    return uri("svg+xml", svg_text(figure).encode())


def svg_text(figure: Figure) -> str:
    """A figure as the text of a file."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def png(figure: Figure, dpi: int) -> str:
    """A figure as a data address."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return uri("png", buffer.getvalue())


def uri(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
