"""`stitch diagnose RUN`: which effect is missing; `stitch next RUN`: what to measure."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from stitch.diagnosis.diagnose import diagnose
from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
from stitch.diagnosis.sentences import amounts_of
from stitch.stored.load_state import State, load_state
from stitch.units import MICROMETRES
from stitch.writing.diagnosis_document import diagnosis_document
from stitch.writing.json_file import to_json, write_json
from stitch.writing.run_folder import extend

_SHOWN = 6


def diagnose_run(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `stitch run` wrote.")],
    effects_file: Annotated[
        Path | None, typer.Option("--effects-file", metavar="PY", help="Python file with effects of your own.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print diagnosis.json alone on standard output.")] = False,
) -> None:
    """Say which physical effect is missing in the model of a run, or why nobody can tell."""
    found, document, unit = _diagnosed(run, effects_file)
    if as_json:
        print(to_json(document))
    else:
        show(found, unit)


def next_measurement(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `stitch run` wrote.")],
    effects_file: Annotated[
        Path | None, typer.Option("--effects-file", metavar="PY", help="Python file with effects of your own.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the proposals as JSON.")] = False,
) -> None:
    """Say which poses or artefacts would separate what cannot be told apart."""
    found, document, _ = _diagnosed(run, effects_file)
    if as_json:
        print(to_json({"verdict": found.verdict, "effects": list(found.effects), "next": document["next"]}))
        return
    console = Console(stderr=True)
    if not found.next:
        console.print(_nothing_next(found), soft_wrap=True, highlight=False)
    for p in found.next:
        console.print(f"To separate {' from '.join(p.separates)}: {p.do}.", soft_wrap=True, highlight=False)


def _nothing_next(found: Diagnosis) -> str:
    if found.verdict == "adequate":
        return "Nothing is missing: there is nothing to tell apart."
    if len(found.effects) > 1:
        return f"No pose within reach, and no artefact that is known here, separates {' from '.join(found.effects)}."
    return "Nothing has to be told apart: no two suspects look alike in these views."


def _diagnosed(run: Path, effects_file: Path | None) -> tuple[Diagnosis, dict[str, object], str]:
    state = load_state(run, effects_file, thin=True)
    found = diagnose(state)
    return found, write_diagnosis(found, state, run), state.session.length_unit


def write_diagnosis(found: Diagnosis, state: State, run: Path) -> dict[str, object]:
    """diagnosis.json and what other packages make of it."""
    document = diagnosis_document(found)
    write_json(document, run / "diagnosis.json")
    extend("stitch.diagnosis_reports", found, state, run)
    return document


def show(found: Diagnosis, length_unit: str) -> None:
    """Sentence first, then the suspects, what the poses follow, what to do next."""
    console, to_um = Console(stderr=True), MICROMETRES[length_unit]
    console.print(found.sentence, soft_wrap=True, highlight=False, style="bold")
    table = Table(title="Suspects", title_justify="left")
    for heading in ("effect", "p", "posterior", "left (µm)", "held-out (µm)"):
        table.add_column(heading, justify="left" if heading == "effect" else "right", no_wrap=True)
    for s in found.candidates[:_SHOWN]:
        table.add_row(*_row(found, s, to_um))
    console.print(table)
    for s in found.candidates[:3]:
        if s.ranked.score.observable:
            alike = ", ".join(f"{a.name} {a.correlation:.2f}" for a in s.aliases[:2])
            told = f"  {s.name}: {amounts_of(s.ranked)}" + (f"; looks like {alike}" if alike else "")
            console.print(told, soft_wrap=True, highlight=False)
    unseen = [s.name for s in found.candidates if not s.ranked.score.observable]
    if unseen:
        console.print(f"These views cannot show: {', '.join(unseen)}.", soft_wrap=True, highlight=False)
    lacking = sorted({need for needs in found.missing.values() for need in needs})
    for need in lacking:
        names = ", ".join(name for name, needs in found.missing.items() if need in needs)
        console.print(f"Not tested without {need}: {names}.", soft_wrap=True, highlight=False)
    if found.verdict == "adequate":
        _show_missed(console, found, to_um)
    for x in [x for x in found.depends_on if x.p_value < 0.05][:3]:
        console.print(f"What is left follows {x.covariate} (p = {x.p_value:.1g}).", soft_wrap=True, highlight=False)
    for p in found.next[:3]:
        console.print(f"Next: {p.do} (separates {', '.join(p.separates)}).", soft_wrap=True, highlight=False)


def _show_missed(console: Console, found: Diagnosis, to_um: float) -> None:
    """What effects too small to be seen could still do to the hand-eye."""
    known = sorted(((s.hand_eye, s.name) for s in found.candidates if s.hand_eye is not None), reverse=True)
    told = ", ".join(f"{name} {size * to_um:.2g} µm" for size, name in known[:3])
    if told:
        console.print(f"An effect too small to be seen could still displace the hand-eye, at the part by as much as: "
                      f"{told}. Its sigma does not hold that.", soft_wrap=True, highlight=False)  # fmt: skip


def _row(found: Diagnosis, s: CandidateEffect, to_um: float) -> list[str]:
    if not s.ranked.score.observable:
        return [s.name, "not seen", "–", "–", "–"]
    left = ["–", "–"]
    if s.cross_validation is not None:
        left = [
            f"{found.residual_rms * to_um * x**0.5:.1f}"
            for x in (s.cross_validation.inside, s.cross_validation.heldout)
        ]
    return [s.name, f"{s.ranked.adjusted:.1g}", f"{s.ranked.posterior:.2f}", *left]
