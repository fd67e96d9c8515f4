"""`stitch diagnose RUN`: which effect is missing."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stitch.cli.options import EffectsFile, Json, RunFolder, Trust
from stitch.cli.progress import opened_run, show_activity
from stitch.cli.terminal import emit, in_full, say, show_columns, show_next
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
_MIN_POSTERIOR_SHARE = 0.05


def diagnose_run(run: RunFolder, effects_file: EffectsFile = None, trust: Trust = False, as_json: Json = False) -> None:
    """Say which physical effect is missing in the model of a run, or why nobody can tell.

    Of the folder of several sessions of one arm: what they decide together.

    \b
    Examples:
      stitch diagnose runs/blade-17
      stitch diagnose runs/blade-17 --effects-file mine.py --json
    """
    from stitch.output.json_file import runs_of_rig, to_json
    from stitch.output.plain_finding import next_step_line

    if sessions := runs_of_rig(run):
        _diagnose_together([run / name for name in sessions], effects_file, trust, as_json)
        end_at_once()
        return
    diagnosis, document = diagnose_folder(run, effects_file, trust)
    if as_json:
        emit(to_json(document))
    else:
        show_diagnosis(diagnosis)
        show_next(next_step_line(diagnosis, shlex.quote(str(run))))
    end_at_once()


def _diagnose_together(runs: Sequence[Path], effects_file: Path | None, trust: bool, as_json: bool) -> None:
    """Diagnose the runs of several sessions of one arm together, and print which effect of the arm is missing."""
    from stitch.diagnosis.diagnose import linear_model_of
    from stitch.diagnosis.together import decide_together, together_document, together_sentence
    from stitch.output.json_file import to_json
    from stitch.output.stored_run import load_run

    with show_activity("diagnosing: trying every effect"):
        states = [load_run(run, effects_file, trust) for run in runs]
        together = decide_together([linear_model_of(state) for state in states])
    names = [state.session.name for state in states]
    if as_json:
        emit(to_json(together_document(together, names)))
        return
    say(f"{', '.join(names)} together: {together_sentence(together)}", bold=True)
    columns = (("effect", lambda c: c.name), ("log posterior", lambda c: f"{c.log_posterior:.1f}"))
    show_columns("Likeliest effects of the arm", columns, together.candidates[:_LISTED_CANDIDATES])
    if together.verdict == "missing_effect":
        sessions = " ".join(shlex.quote(str(state.session.path)) for state in states)
        folder = shlex.quote(str(runs[0].parent))
        show_next(f"Next: stitch run {sessions} -o {folder} --force --effects {','.join(together.effects)}")


def diagnose_folder(run: Path, effects_file: Path | None, trust: bool) -> tuple[Diagnosis, dict[str, Any]]:
    """Return the diagnosis of a run folder and diagnosis.json as a dictionary, after writing it there."""
    from stitch.api.pipeline import diagnose
    from stitch.output.comparison.model_history import model_history
    from stitch.output.run_folder import preload_entry_points
    from stitch.system.threads import begin

    preload_entry_points("stitch.diagnosis_reports")
    with opened_run(run, effects_file, trust, "diagnosing: reading the scans") as state:
        # For the page, which waits for it: matched anew, beside the diagnosis.
        begin(partial(model_history, state))
        with show_activity("diagnosing: trying every effect"):
            diagnosis = diagnose(state)
        return diagnosis, write_diagnosis(diagnosis, state, run)


def write_diagnosis(diagnosis: Diagnosis, state: RunData, run: Path) -> dict[str, Any]:
    """Return diagnosis.json as a dictionary, after writing it and the pages of installed packages.

    Its entry `of` identifies the run and the version of stitch, to know later whether it is still valid.
    """
    from stitch.output import json_file, run_folder, stored_run
    from stitch.output.diagnosis_document import diagnosis_document

    document = diagnosis_document(diagnosis) | {"of": stored_run.diagnosed_state(state, run)}
    with show_activity("diagnosing: drawing pictures and page"):
        json_file.write_json(document, run / "diagnosis.json")
        run_folder.call_entry_points("stitch.diagnosis_reports", diagnosis, state, run)
    return document


def show_diagnosis(diagnosis: Diagnosis) -> None:
    """Print a diagnosis: the finding in plain words, the evidence, a table of the likeliest effects, and details.

    Where only headlines are printed, the finding and the table alone.
    """
    from stitch.diagnosis.sentences import posterior_text
    from stitch.numerics.units import length_text
    from stitch.output.plain_finding import open_doubts, plain_finding
    from stitch.run_data import doubt_remedy

    length_unit = diagnosis.linear.measurement.length_unit
    posteriors = {c.name: c.ranked.posterior for c in diagnosis.candidates}
    posterior = partial(posterior_text, diagnosis.verdict, diagnosis.effects, posteriors)

    def rms_if_added(candidate: CandidateEffect, heldout: bool) -> str:
        """Return the rms predicted with an effect, on views left out or in the fit; a dash where unknown."""
        if not candidate.ranked.score.observable or candidate.cross_validation is None:
            return "–"
        return length_text(diagnosis.rms_if_added(candidate.cross_validation)[heldout], length_unit, zeros=True)

    say(plain_finding(diagnosis, length_unit), bold=True)
    if in_full():
        for remedy in filter(None, map(doubt_remedy, open_doubts(diagnosis))):
            say(remedy)
        say(diagnosis.sentence)
    listed = diagnosis.candidates[: max(_LISTED_CANDIDATES, len(diagnosis.effects))]
    columns = (
        ("effect", lambda c: c.name),
        ("p", lambda c: f"{c.ranked.adjusted:.1g}" if c.ranked.score.observable else "not seen"),
        ("posterior", lambda c: posterior(c.name) if c.ranked.score.observable else "–"),
        ("rms if added", lambda c: rms_if_added(c, heldout=False)),
        ("on views left out", lambda c: rms_if_added(c, heldout=True)),
    )
    show_columns("Likeliest effects", columns, listed)
    if in_full():
        _show_particulars(diagnosis, listed, length_unit)


def _show_particulars(diagnosis: Diagnosis, listed: Sequence[CandidateEffect], length_unit: str) -> None:
    """Print the details below the table of a diagnosis: sizes, sources of the error, untested effects, proposals.

    Args:
        listed: the effects in the table. Their aliases are effects that look alike in these views, with correlation.
        length_unit: "mm" or "m".
    """
    from stitch.diagnosis.sentences import curve_sentences, fitted_amounts
    from stitch.model.model import uncertainty_scope
    from stitch.output.finding_screen import unseen_text, untested_text

    rest = 1 - sum(c.ranked.posterior for c in diagnosis.candidates)
    if rest > _MIN_POSTERIOR_SHARE and any(c.ranked.score.observable for c in diagnosis.candidates):
        say(f"Probability that no known effect is missing: {rest:.2f}.")
    for c in listed:
        if c.ranked.score.observable and (c.name in diagnosis.effects or c.ranked.adjusted < _CLEAR):
            aliases = ", ".join(f"{name} {alike:.2f}" for name, alike in list(c.aliases.items())[:2])
            say(f"  {c.name}: {fitted_amounts(c.ranked)}{f'; aliases: {aliases}' if aliases else ''}", hang=2)
    show_budget(diagnosis.budget, length_unit)
    if untested := untested_text(diagnosis):
        say(untested)
    if diagnosis.verdict == "adequate":
        if unseen := unseen_text(diagnosis):
            say(unseen)
        _show_missed(diagnosis, length_unit)
    else:
        say(uncertainty_scope(diagnosis.verdict))
    if follows := [x for x in diagnosis.depends_on if x.p_value < _CLEAR][:_LISTED_DEPENDENCES]:
        covariates = ", ".join(f"{x.covariate} (p = {x.p_value:.1g})" for x in follows)
        say(f"What the present model leaves follows {covariates}.")
    for line in curve_sentences(diagnosis, length_unit):
        say(line)
    for proposal in diagnosis.next[:3]:
        separates = f" (separates {', '.join(proposal.separates)})" if proposal.separates else ""
        say(f"To measure next: {proposal.do}{separates}.")


def show_budget(budget: Sequence[BudgetLine], length_unit: str) -> None:
    """Print the sources of the error of whole views, with shares of its variance and rms; nothing without a budget."""
    from stitch.numerics.units import length_text
    from stitch.output.plain_finding import largest_error_sources, share_text

    sources = [
        f"{line.source} {share_text(line)} ({length_text(line.sigma, length_unit, 2)})"
        for line in largest_error_sources(budget)
    ]
    if sources:
        say(f"The error of whole views (rms) comes from: {', '.join(sources)}.")


def _show_missed(diagnosis: Diagnosis, length_unit: str) -> None:
    """Print the three largest errors of the hand-eye, at the part, from effects too small for these views to show."""
    from stitch.numerics.units import length_text

    known = sorted(((c.hand_eye, c.name) for c in diagnosis.candidates if c.hand_eye is not None), reverse=True)
    if sizes := ", ".join(f"{name} {length_text(size, length_unit, 2)}" for size, name in known[:3]):
        still = "Effects too small to be seen could still displace the hand-eye, at the part by"
        say(f"{still} {sizes}. U anywhere the arm reaches counts them at usual sizes.")
