"""What comparison and diagnosis add to a run folder: sections of the page, pictures, a recording of their own."""

import re
from pathlib import Path

import rerun as rr
from jinja2 import Environment, PackageLoader, select_autoescape
from matplotlib.figure import Figure

from stitch.comparison.tables import Comparison
from stitch.diagnosis.diagnosis import Diagnosis
from stitch.diagnosis.sentences import amounts_of
from stitch.stored.load_state import State
from stitch.system.whole_file import whole
from viz import captions
from viz import diagnosis_figures as draw
from viz.blueprint import diagnosis_blueprint
from viz.report import svg_text, uri
from viz.units import to_micrometres


def write_diagnosis(found: Diagnosis, state: State, folder: Path) -> None:
    """Section of report.html, pictures/*.svg and *.png, diagnosis.rrd."""
    unit = state.session.length_unit
    now = found.residual_rms * to_micrometres(unit)
    pictures = {
        "budget": ("Where the error comes from", draw.budget(found, unit), captions.BUDGET),
        "suspects": ("How likely each suspect is", draw.candidates(found), captions.SUSPECTS),
        "added_variable": ("What the views show against what the first suspects predict", draw.added_variable(found),
                           captions.ADDED),
        "shape": ("What the unexplained displacement follows", draw.shape(found, unit), captions.SHAPE),
        "aliases": ("Which suspects look alike in these views", draw.alias_picture(found), captions.ALIASES),
        "views": ("Displacement of every view from the model", draw.view_arrows(found, unit), captions.VIEWS),
    }  # fmt: skip
    rows = [
        {"name": s.name, "p": f"{s.ranked.adjusted:.1g}", "posterior": f"{s.ranked.posterior:.2f}",
         "amounts": amounts_of(s.ranked),
         "left": "–" if s.cross_validation is None else f"{now * s.cross_validation.inside**0.5:.1f}",
         "heldout": "–" if s.cross_validation is None else f"{now * s.cross_validation.heldout**0.5:.1f}",
         "alike": ", ".join(f"{a.name} {a.correlation:.2f}" for a in s.aliases[:2])}
        for s in found.candidates if s.ranked.score.observable
    ][:8]  # fmt: skip
    unseen = [s.name for s in found.candidates if not s.ranked.score.observable]
    addresses = _save(folder / "pictures", {name: figure for name, (_, figure, _) in pictures.items()})
    shown = [(title, addresses[name], caption) for name, (title, _, caption) in pictures.items()]
    _insert(folder / "report.html", "diagnosis", _render("diagnosis.html.j2", found=found, rows=rows, unseen=unseen,
                                                         pictures=shown))  # fmt: skip
    _record(found, folder)


def write_comparison(found: Comparison, state: State, folder: Path) -> None:
    """Section of report.html and pictures/compare.*."""
    figure = draw.comparison(found, state.session.length_unit)
    picture = _save(folder / "pictures", {"compare": figure})["compare"]
    um = to_micrometres(state.session.length_unit)
    worst = []
    for table in found.labelled:
        worst.append((table.name, ", ".join(f"{table.label[i]} {table.rms[i] * um:.1f}" for i in table.worst(5))))
    html = _render("comparison.html.j2", picture=picture, caption=captions.COMPARISON, worst=worst, rms=found.rms * um)
    _insert(folder / "report.html", "comparison", html)


def _render(name: str, **content: object) -> str:
    environment = Environment(loader=PackageLoader("viz"), autoescape=select_autoescape(default=True), trim_blocks=True)
    return environment.get_template(name).render(**content)


def _insert(page: Path, name: str, html: str) -> None:
    """Put a section between its marks; a page from elsewhere without marks stays as it is."""
    if not page.is_file():
        return
    begin, end = f"<!-- {name} begins -->", f"<!-- {name} ends -->"
    text = page.read_text(encoding="utf-8")
    new = re.sub(f"{begin}.*?{end}", lambda _: begin + html + end, text, flags=re.S)
    with whole(page) as file:
        file.write_text(new, encoding="utf-8")


def _save(folder: Path, figures: dict[str, Figure]) -> dict[str, str]:
    """Each figure as SVG and PNG; the SVG's data address by name."""
    folder.mkdir(exist_ok=True)
    addresses = {}
    for name, figure in figures.items():
        text = svg_text(figure)
        with whole(folder / f"{name}.png") as file:
            figure.savefig(file, format="png", dpi=120)
        with whole(folder / f"{name}.svg") as file:
            file.write_text(text, encoding="utf-8")
        addresses[name] = uri("svg+xml", text.encode())
    return addresses


def _record(found: Diagnosis, folder: Path) -> None:
    """The verdict and its pictures; `stitch view` opens it beside the recording of the run."""
    recording = rr.RecordingStream("stitch_diagnosis")
    text = f"# {found.verdict}\n\n{found.sentence}"
    with whole(folder / "diagnosis.rrd") as file:
        recording.save(str(file), default_blueprint=diagnosis_blueprint())
        recording.log("diagnosis/verdict", rr.TextDocument(text, media_type="text/markdown"), static=True)
        for picture in sorted((folder / "pictures").glob("*.png")):
            recording.log(f"diagnosis/{picture.stem}", rr.EncodedImage(path=picture), static=True)
        recording.disconnect()
