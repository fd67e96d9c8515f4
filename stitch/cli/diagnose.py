"""`stitch diagnose RUN`: which effect is missing; `stitch next RUN`: what to measure."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stitch.cli.options import EffectsFile, Json, RunFolder, Trust
from stitch.cli.progress import show_activity
from stitch.cli.terminal import emit, in_full, say, show_next, show_table
from stitch.system.process import end_at_once

if TYPE_CHECKING:
    from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
    from stitch.diagnosis.residual_structure import BudgetLine
    from stitch.run_data import RunData

_LISTED_CANDIDATES = 3
_LISTED_DEPENDENCES = 3
# A candidate with a larger p gets no line of its own.
_CLEAR = 0.05
# Share of the posterior that must be said where no candidate has it.
_MIN_DISPLACEMENT_SHARE = 0.05


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
    from stitch.output.json_file import to_json
    from stitch.output.plain_finding import suggested_command

    found, document, unit = _diagnose_folder(run, effects_file, trust)
    if as_json:
        emit(to_json(document))
    else:
        show_diagnosis(found, unit)
        show_next(suggested_command(found, shlex.quote(str(run))))
    end_at_once()


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
    from stitch.output.json_file import to_json

    found, document, _ = _diagnose_folder(run, effects_file, trust)
    if as_json:
        emit(to_json({"verdict": found.verdict, "effects": list(found.effects), "next": document["next"]}))
    elif found.next:
        for p in found.next:
            say(f"To separate {' from '.join(p.separates)}: {p.do}.")
    elif found.verdict == "adequate":
        say("Nothing is missing: there is nothing to tell apart.")
    elif len(found.effects) > 1:
        say(f"No pose within reach, and no artefact that is known here, separates {' from '.join(found.effects)}.")
    elif found.verdict == "missing_effect" and not found.likelier_than_not:
        say(f"{_no_correlation(found.effects[0])}. More views, at any poses, can tell it from chance.")
    else:
        say(f"Nothing has to be told apart. {_no_correlation('the likeliest')}.")
    end_at_once()


def _no_correlation(name: str) -> str:
    from stitch.diagnosis.thresholds import ALIAS_CORRELATION

    return f"No effect correlates with {name} by more than {ALIAS_CORRELATION} in these views"


def _diagnose_folder(run: Path, effects_file: Path | None, trust: bool) -> tuple[Diagnosis, dict[str, object], str]:
    from stitch.api.pipeline import diagnose
    from stitch.output.run_folder import lock_run_folder, preload_entry_points
    from stitch.output.stored_run import load_run

    with lock_run_folder(run):
        with show_activity("diagnosing: reading the scans"):
            state = load_run(run, effects_file, trust=trust)
            preload_entry_points("stitch.diagnosis_reports")
        with show_activity("diagnosing: trying every effect"):
            found = diagnose(state)
        return found, write_diagnosis(found, state, run), state.session.length_unit


def write_diagnosis(diagnosis: Diagnosis, state: RunData, run: Path) -> dict[str, object]:
    """Return the diagnosis as a document, after diagnosis.json and what other packages make of it are written."""
    from stitch.output.diagnosis_document import diagnosis_document
    from stitch.output.json_file import write_json
    from stitch.output.run_folder import call_entry_points
    from stitch.output.stored_run import diagnosed_state

    document = diagnosis_document(diagnosis) | {"of": diagnosed_state(state, run)}
    with show_activity("diagnosing: drawing pictures and page"):
        write_json(document, run / "diagnosis.json")
        call_entry_points("stitch.diagnosis_reports", diagnosis, state, run)
    return document


def show_diagnosis(diagnosis: Diagnosis, length_unit: str) -> None:
    """Print the finding for everybody, the evidence, the likeliest effects, and where the error comes from."""
    from stitch.output.plain_finding import open_doubts, plain_finding
    from stitch.run_data import doubt_remedy

    say(plain_finding(diagnosis, length_unit), bold=True)
    if in_full():
        for doubt in open_doubts(diagnosis):
            if more := doubt_remedy(doubt):
                say(more)
        say(diagnosis.sentence)
    listed = diagnosis.candidates[: max(_LISTED_CANDIDATES, len(diagnosis.effects))]
    show_table(
        "Likeliest effects",
        ("effect", "p", "posterior", "rms if added", "on views left out"),
        [_candidate_row(diagnosis, s, length_unit) for s in listed],
    )
    if in_full():
        _show_particulars(diagnosis, listed, length_unit)


def _show_particulars(diagnosis: Diagnosis, listed: Sequence[CandidateEffect], length_unit: str) -> None:
    """Print sizes and aliases of effects, the sources of the error, what was not tested, and what to measure next."""
    from stitch.diagnosis.sentences import curve_sentences, fitted_amounts
    from stitch.model.model import uncertainty_scope

    if (left := 1 - sum(s.ranked.posterior for s in diagnosis.candidates)) > _MIN_DISPLACEMENT_SHARE:
        say(f"{left:.2f} of the posterior: nothing is missing, or something without a name.")
    for s in listed:
        if s.ranked.score.observable and (s.name in diagnosis.effects or s.ranked.adjusted < _CLEAR):
            alike = ", ".join(f"{a.name} {a.correlation:.2f}" for a in s.aliases[:2])
            say(f"  {s.name}: {fitted_amounts(s.ranked)}{f'; aliases: {alike}' if alike else ''}", hang=2)
    show_budget(diagnosis.budget, length_unit)
    if unseen := [s.name for s in diagnosis.candidates if not s.ranked.score.observable]:
        say(f"These views cannot show: {', '.join(unseen)}.")
    _show_untested(diagnosis)
    if diagnosis.verdict == "adequate":
        _show_missed(diagnosis, length_unit)
    else:
        say(uncertainty_scope(diagnosis.verdict))
    if follows := [x for x in diagnosis.depends_on if x.p_value < _CLEAR][:_LISTED_DEPENDENCES]:
        told = ", ".join(f"{x.covariate} (p = {x.p_value:.1g})" for x in follows)
        say(f"What the present model leaves follows {told}.")
    for line in curve_sentences(diagnosis, length_unit):
        say(line)
    for p in diagnosis.next[:3]:
        say(f"To measure next: {p.do} (separates {', '.join(p.separates)}).")


def show_budget(budget: Sequence[BudgetLine], length_unit: str) -> None:
    """Print source, share of the variance and size (rms) of all that the poses leave; nothing without a budget."""
    from stitch.numerics.units import length_text
    from stitch.output.plain_finding import largest_error_sources, share_text

    told = [
        f"{line.source} {share_text(line)} ({length_text(line.sigma, length_unit, 2)})"
        for line in largest_error_sources(budget)
    ]
    if told:
        say(f"The error of whole views (rms) comes from: {', '.join(told)}.")


def _candidate_row(diagnosis: Diagnosis, s: CandidateEffect, length_unit: str) -> list[str]:
    from stitch.numerics.units import length_text

    if not s.ranked.score.observable:
        return [s.name, "not seen", "–", "–", "–"]
    left = ["–", "–"]
    if s.cross_validation is not None:
        left = [length_text(x, length_unit, zeros=True) for x in diagnosis.rms_if_added(s.cross_validation)]
    return [s.name, f"{s.ranked.adjusted:.1g}", f"{s.ranked.posterior:.2f}", *left]


def _show_untested(diagnosis: Diagnosis) -> None:
    """Print effects that lack what they need, all in one line."""
    from stitch.effects.contract import describe_need

    groups = []
    for needs in sorted(set(diagnosis.missing.values())):
        names = ", ".join(name for name, own in diagnosis.missing.items() if own == needs)
        groups.append(f"{names} ({' and '.join(map(describe_need, needs))})")
    if groups:
        say(f"Not tested, with what that would need: {'; '.join(groups)}.")


def _show_missed(diagnosis: Diagnosis, length_unit: str) -> None:
    """Print what effects too small to be seen could still do to the hand-eye."""
    from stitch.numerics.units import length_text

    known = sorted(((s.hand_eye, s.name) for s in diagnosis.candidates if s.hand_eye is not None), reverse=True)
    if told := ", ".join(f"{name} {length_text(size, length_unit, 2)}" for size, name in known[:3]):
        say(f"Effects too small to be seen could still displace the hand-eye, at the part by {told}. U omits them.")
