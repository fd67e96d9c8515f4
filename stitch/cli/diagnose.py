"""`stitch diagnose RUN`: which effect is missing; `stitch next RUN`: what to measure."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stitch.cli.options import EffectsFile, Json, RunFolder, Trust
from stitch.cli.terminal import emit, show_activity

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
    from stitch.diagnosis.residual_structure import BudgetLine
    from stitch.runs.run import Run


# Where the error comes from, as a table of the terminal.


def budget_table(budget: Sequence[BudgetLine], length_unit: str) -> Table | None:
    """Source, share of the variance and size (rms) of all that the poses leave; None where there is no budget."""
    from rich.table import Table

    from stitch.units import length_text
    from stitch.writing.diagnosis_document import largest_error_sources, share_text

    told = largest_error_sources(budget)
    if not told:
        return None
    table = Table(title="Where the error comes from (of whole views, against one hand-eye)", title_justify="left")
    for heading in ("source", "share", "size (rms)"):
        table.add_column(heading, justify="left" if heading == "source" else "right", no_wrap=True)
    for line in told:
        table.add_row(line.source, share_text(line), length_text(line.sigma, length_unit, 2))
    return table


# What `stitch diagnose` and `stitch next` do: a diagnosis into the run folder and for people.

_LISTED_CANDIDATES = 6
# Share of the posterior that must be said where no candidate has it.
_MIN_DISPLACEMENT_SHARE = 0.05


def run_diagnose(run: Path, effects_file: Path | None, *, trust: bool, as_json: bool, says_next: bool = True) -> None:
    """Diagnose a run and show what was found.

    Raises:
        InputError, NoResultError: as `stitch diagnose` ends.
    """
    from stitch.system.process import console
    from stitch.writing.diagnosis_document import suggested_command
    from stitch.writing.json_file import to_json

    found, document, unit = _diagnose_folder(run, effects_file, trust)
    if as_json:
        emit(to_json(document))
    else:
        show_diagnosis(found, unit)
    if says_next and not as_json:
        console().print(suggested_command(found, shlex.quote(str(run))), soft_wrap=True)


def run_next(run: Path, effects_file: Path | None, *, trust: bool, as_json: bool) -> None:
    """Diagnose a run and say what to measure next.

    Raises:
        InputError, NoResultError: as `stitch next` ends.
    """
    from stitch.system.process import console
    from stitch.writing.json_file import to_json

    found, document, _ = _diagnose_folder(run, effects_file, trust)
    if as_json:
        emit(to_json({"verdict": found.verdict, "effects": list(found.effects), "next": document["next"]}))
        return
    terminal = console()
    if not found.next:
        terminal.print(_no_next_reason(found), soft_wrap=True)
    for p in found.next:
        terminal.print(f"To separate {' from '.join(p.separates)}: {p.do}.", soft_wrap=True)


def _no_next_reason(diagnosis: Diagnosis) -> str:
    if diagnosis.verdict == "adequate":
        return "Nothing is missing: there is nothing to tell apart."
    if len(diagnosis.effects) > 1:
        return (
            f"No pose within reach, and no artefact that is known here, separates {' from '.join(diagnosis.effects)}."
        )
    return "Nothing has to be told apart: no two candidate effects are aliases in these views."


def _diagnose_folder(run: Path, effects_file: Path | None, trust: bool) -> tuple[Diagnosis, dict[str, object], str]:
    from stitch.pipeline import diagnose
    from stitch.stored.stored_run import load_run
    from stitch.writing.run_folder import lock_run_folder, preload_entry_points

    with lock_run_folder(run), show_activity("diagnosing"):
        state = load_run(run, effects_file, trust=trust)
        preload_entry_points("stitch.diagnosis_reports")
        found = diagnose(state)
        return found, write_diagnosis(found, state, run), state.session.length_unit


def write_diagnosis(diagnosis: Diagnosis, state: Run, run: Path) -> dict[str, object]:
    """diagnosis.json and what other packages make of it."""
    from stitch.writing.diagnosis_document import diagnosis_document
    from stitch.writing.json_file import write_json
    from stitch.writing.run_folder import call_entry_points

    document = diagnosis_document(diagnosis)
    write_json(document, run / "diagnosis.json")
    call_entry_points("stitch.diagnosis_reports", diagnosis, state, run)
    return document


def show_diagnosis(diagnosis: Diagnosis, length_unit: str) -> None:
    """For everybody first, then the evidence, where the error comes from, the candidate effects, what to do next."""
    from rich.table import Table

    from stitch.diagnosis.sentences import curve_sentences, fitted_amounts
    from stitch.effects.contract import describe_need
    from stitch.model.model import uncertainty_scope
    from stitch.system.process import console
    from stitch.writing.diagnosis_document import open_doubts, plain_finding

    terminal = console()
    terminal.print(plain_finding(diagnosis, length_unit), soft_wrap=True, style="bold")
    for line in (*open_doubts(diagnosis), diagnosis.sentence):
        terminal.print(line, soft_wrap=True)
    if diagnosis.verdict != "adequate":
        terminal.print(uncertainty_scope(diagnosis.verdict), soft_wrap=True)
    if (sources := budget_table(diagnosis.budget, length_unit)) is not None:
        terminal.print(sources)
    table = Table(title="Candidate effects", title_justify="left")
    for heading in ("effect", "p", "posterior", "rms if added", "held-out if added"):
        table.add_column(heading, justify="left" if heading == "effect" else "right", no_wrap=True)
    for s in diagnosis.candidates[:_LISTED_CANDIDATES]:
        table.add_row(*_candidate_row(diagnosis, s, length_unit))
    terminal.print(table)
    if (left := 1 - sum(s.ranked.posterior for s in diagnosis.candidates)) > _MIN_DISPLACEMENT_SHARE:
        terminal.print(f"{left:.2f} of the posterior: nothing is missing, or something without a name.", soft_wrap=True)
    for s in diagnosis.candidates[:3]:
        if s.ranked.score.observable:
            alike = ", ".join(f"{a.name} {a.correlation:.2f}" for a in s.aliases[:2])
            told = f"  {s.name}: {fitted_amounts(s.ranked)}" + (f"; aliases: {alike}" if alike else "")
            terminal.print(told, soft_wrap=True)
    unseen = [s.name for s in diagnosis.candidates if not s.ranked.score.observable]
    if unseen:
        terminal.print(f"These views cannot show: {', '.join(unseen)}.", soft_wrap=True)
    for needs in sorted(set(diagnosis.missing.values())):
        names = ", ".join(name for name, own in diagnosis.missing.items() if own == needs)
        terminal.print(f"Not tested without {' and '.join(map(describe_need, needs))}: {names}.", soft_wrap=True)
    if diagnosis.verdict == "adequate":
        _show_missed(terminal, diagnosis, length_unit)
    for x in [x for x in diagnosis.depends_on if x.p_value < 0.05][:3]:
        terminal.print(f"What the present model leaves follows {x.covariate} (p = {x.p_value:.1g}).", soft_wrap=True)
    for told in curve_sentences(diagnosis, length_unit):
        terminal.print(told, soft_wrap=True)
    for p in diagnosis.next[:3]:
        terminal.print(f"To measure next: {p.do} (separates {', '.join(p.separates)}).", soft_wrap=True)


def _show_missed(terminal: Console, diagnosis: Diagnosis, length_unit: str) -> None:
    """What effects too small to be seen could still do to the hand-eye."""
    from stitch.units import length_text

    known = sorted(((s.hand_eye, s.name) for s in diagnosis.candidates if s.hand_eye is not None), reverse=True)
    told = ", ".join(f"{name} {length_text(size, length_unit, 2)}" for size, name in known[:3])
    if told:
        terminal.print(
            "An effect too small to be seen could still displace the hand-eye, at the part by as much as: "
            f"{told}. Its sigma does not hold that.",
            soft_wrap=True,
        )


def _candidate_row(diagnosis: Diagnosis, s: CandidateEffect, length_unit: str) -> list[str]:
    from stitch.units import length_text

    if not s.ranked.score.observable:
        return [s.name, "not seen", "–", "–", "–"]
    left = ["–", "–"]
    if s.cross_validation is not None:
        left = [length_text(x, length_unit, zeros=True) for x in diagnosis.rms_if_added(s.cross_validation)]
    return [s.name, f"{s.ranked.adjusted:.1g}", f"{s.ranked.posterior:.2f}", *left]


def diagnose_run(
    run: RunFolder,
    effects_file: EffectsFile = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Say which physical effect is missing in the model of a run, or why nobody can tell.

    \b
    Examples:
      stitch diagnose runs/blade-17
      stitch diagnose runs/blade-17 --effects-file mine.py --json
    """

    run_diagnose(run, effects_file, trust=trust, as_json=as_json)


def next_measurement(
    run: RunFolder,
    effects_file: EffectsFile = None,
    trust: Trust = False,
    as_json: Json = False,
) -> None:
    """Say which poses or artefacts would separate what cannot be told apart.

    \b
    Examples:
      stitch next runs/blade-17
    """

    run_next(run, effects_file, trust=trust, as_json=as_json)
