"""Add comparison and diagnosis to a run folder: sections of the page, pictures, a tab of the recording."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from markupsafe import escape
from matplotlib.figure import Figure

from stitch.comparison.residual_tables import ResidualTables
from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
from stitch.diagnosis.sentences import fitted_amounts
from stitch.model.model import uncertainty_scope
from stitch.runs.run import Run
from stitch.system.files import whole_file
from stitch.units import MICROMETRES, length_text
from stitch.writing.diagnosis_document import (
    effect_description,
    largest_error_sources,
    plain_finding,
    suggested_command,
)
from viz import captions
from viz import diagnosis_figures as draw
from viz.diagnosis_figures import budget, comparison, joint_courses, scanner_field, time_course
from viz.diagnosis_recording import CandidateFields, add_diagnosis, candidate_fields, packed_candidates
from viz.page_parts import render, script_json, svg_address, svg_text, unbroken

# Candidate effects in the table of the page.
_SHOWN = 8


def write_diagnosis(found: Diagnosis, state: Run, folder: Path) -> None:
    """Section of report.html, pictures/*.svg and *.png, a tab of the recording."""
    pictures = _pictures(found, state.session.length_unit)
    addresses = _save(folder / "pictures", {name: picture.figure for name, picture in pictures.items()})
    unit, fields = state.session.length_unit, candidate_fields(found)
    plain = plain_finding(found, unit)
    lacking = sorted({need for needs in found.missing.values() for need in needs})
    html = render(
        "diagnosis.html.j2",
        found=found,
        plain=plain,
        rows=_rows(found, fields, MICROMETRES[unit]),
        field=None if fields is None else script_json(packed_candidates(fields, unit)),
        lacking=[(need, [name for name, needs in found.missing.items() if need in needs]) for need in lacking],
        unseen=[s.name for s in found.candidates if not s.ranked.score.observable],
        pictures=[(pictures[name].title, address, pictures[name].caption) for name, address in addresses.items()],
    )
    _insert(folder / "report.html", "diagnosis", html)
    why, command = suggested_command(found, "RUN").rsplit(": ", 1)
    then = f'<p class="evidence">{escape(why)}: <code>{escape(command)}</code>, RUN the folder of this page.</p>'
    _insert(folder / "report.html", "finding", f'<p class="finding">{escape(unbroken(plain))}</p>{then}')
    _insert(folder / "report.html", "uncertainty", f'<p class="soft">{uncertainty_scope(found.verdict)}</p>')
    add_diagnosis(found, fields, unit, folder / "recording.rrd")


class _Picture(NamedTuple):
    title: str
    figure: Figure | None  # where there is nothing to draw
    caption: str


def _pictures(found: Diagnosis, unit: str) -> dict[str, _Picture]:
    """File name → picture, in the order of the page."""
    predicted = "What the views show against what the first candidate effects predict"
    curves = joint_courses(found) if found.curves else None
    in_time = None if found.time_curve is None else time_course(found, found.time_curve, unit)
    return {
        "joint_courses": _Picture("Where and when a joint errs without a name", curves, captions.COURSES),
        "time_course": _Picture("When in the session poses err without a name", in_time, captions.TIME_COURSE),
        "field_map": _field_map(found, unit),
        "budget": _Picture("Where the error comes from", budget(found, unit), _of_budget(found)),
        "candidates": _Picture("How likely each candidate effect is", draw.candidates(found), captions.CANDIDATES),
        "added_variable": _Picture(predicted, draw.added_variable(found), captions.ADDED_VARIABLE),
        "shape": _Picture("What the unexplained displacement follows", draw.shape(found, unit), captions.SHAPE),
        "aliases": _Picture("Aliases in these views", draw.alias_picture(found), captions.ALIASES),
        "views": _Picture("Displacement of every view from the model", draw.view_arrows(found, unit), captions.VIEWS),
    }


def _field_map(found: Diagnosis, unit: str) -> _Picture:
    """Draw the errors of the scanner over its field, if any were found."""
    title, shown = (
        "How the scanner errs over its field",
        None if found.scanner_error is None else found.scanner_error.map,
    )
    if shown is None:
        return _Picture(title, None, "")
    size, sigma = (length_text(x, unit, 2) for x in (shown.rms, shown.uncertainty))
    return _Picture(title, scanner_field(shown, unit), captions.SCANNER_FIELD.format(size=size, sigma=sigma))


def _of_budget(found: Diagnosis) -> str:
    return captions.BUDGET if largest_error_sources(found.budget) else captions.MEAN_SQUARES


def _rows(found: Diagnosis, fields: CandidateFields | None, um: float) -> list[dict[str, str]]:
    """The best candidate effects that these views can show."""
    shown = [s for s in found.candidates if s.ranked.score.observable][:_SHOWN]
    on_part = {} if fields is None else {name: f"{f.mean_abs * um:.3g}" for name, f in fields.if_added.items()}
    return [
        {
            "name": s.name,
            "p": f"{s.ranked.adjusted:.1g}".replace("-", "−"),
            "posterior": f"{s.ranked.posterior:.2f}",
            "told": "; ".join(filter(None, [effect_description(s.name), fitted_amounts(s.ranked).replace("-", "−")])),
            "rms_if_added": _rms(found, s, 0, um),
            "heldout": _rms(found, s, 1, um),
            "on_part": on_part.get(s.name, "–"),
            "aliases": ", ".join(f"{a.name} {a.correlation:.2f}" for a in s.aliases[:2]),
        }
        for s in shown
    ]


def _rms(found: Diagnosis, candidate: CandidateEffect, which: int, um: float) -> str:
    """Rms (µm) with the effect added, in the fit (0) or on views left out (1); a dash where it was not validated."""
    validation = candidate.cross_validation
    return "–" if validation is None else f"{um * found.rms_if_added(validation)[which]:.1f}"


def write_comparison(found: ResidualTables, state: Run, folder: Path) -> None:
    """Section of report.html and pictures/compare.*."""
    figure = comparison(found, state.session.length_unit)
    picture = _save(folder / "pictures", {"compare": figure})["compare"]
    um = MICROMETRES[state.session.length_unit]
    worst = []
    for table in found.labelled:
        worst.append((table.name, ", ".join(f"{table.label[i]} {table.rms[i] * um:.1f}" for i in table.worst(5))))
    html = render("comparison.html.j2", picture=picture, caption=captions.COMPARISON, worst=worst, rms=found.rms * um)
    _insert(folder / "report.html", "comparison", html)


def _insert(page: Path, name: str, html: str) -> None:
    """Put a section between its marks; a page from elsewhere without marks stays as it is."""
    if not page.is_file():
        return
    begin, end = f"<!-- {name} begins -->", f"<!-- {name} ends -->"
    text = page.read_text(encoding="utf-8")
    new = re.sub(f"{begin}.*?{end}", lambda _: begin + html + end, text, flags=re.S)
    with whole_file(page) as file:
        file.write_text(new, encoding="utf-8")


def _save(folder: Path, figures: Mapping[str, Figure | None]) -> dict[str, str]:
    """Each figure as SVG and PNG, none that an earlier one left where there is none; the SVG's data address by name."""
    folder.mkdir(exist_ok=True)
    addresses = {}
    for name, figure in figures.items():
        if figure is None:
            for ending in ("png", "svg"):
                (folder / f"{name}.{ending}").unlink(missing_ok=True)
            continue
        text = svg_text(figure)
        figure.set_layout_engine("none")  # found once; it takes half of the time of a drawing
        with whole_file(folder / f"{name}.png") as file:
            figure.savefig(file, format="png", dpi=120)
        with whole_file(folder / f"{name}.svg") as file:
            file.write_text(text, encoding="utf-8")
        addresses[name] = svg_address(text)
    return addresses
