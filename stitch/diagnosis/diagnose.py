"""The whole diagnosis: evidence, candidates, selection, what to measure next, one plain sentence."""

from dataclasses import replace

import numpy as np

from stitch.diagnosis.candidates import candidates_of
from stitch.diagnosis.covariate_dependence import dependences
from stitch.diagnosis.design.next_view import propose
from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
from stitch.diagnosis.initial_values import evidence_of_state
from stitch.diagnosis.selection.ranking import Ranked
from stitch.diagnosis.selection.select import Selection, implausible, select
from stitch.diagnosis.sensitivity.aliases import alias_matrix, aliases_of
from stitch.diagnosis.sensitivity.detectable import smallest_detectable
from stitch.diagnosis.sensitivity.omitted_effect_bias import hand_eye_response, omitted_effect_bias
from stitch.diagnosis.sentences import sentence_of
from stitch.diagnosis.validation.cross_validation import CrossValidation, cross_validate
from stitch.stored.load_state import State
from stitch.system.threads import library_threads_off

# Candidates whose prediction on left-out views is computed; the others explain nothing.
_PREDICTED = 8
# An effect must not vanish when one view is left out.
_STEADY = 0.25
_BEYOND_CHANCE = 1e-5


def diagnose(state: State) -> Diagnosis:
    """Which effect is missing in the model of a run.

    Raises:
        NoResultError: no two views overlap.
    """
    with library_threads_off():
        evidence = evidence_of_state(state)
        candidates, points, missing = candidates_of(evidence)
        selection = select(evidence, candidates, state.session.length_unit)
        scores = [r.score for r in selection.ranked]
        matrix = alias_matrix(evidence, scores)
        tests, examined = sum(c.effect.tier != "empirical" for c in candidates), []
        push = hand_eye_response(evidence)
        for k, ranked in enumerate(selection.ranked):
            clear = ranked.score.observable and k < _PREDICTED and np.isfinite(ranked.score.sigmas).all()
            left = cross_validate(evidence, ranked.score, points) if clear else None
            detectable = smallest_detectable(evidence, ranked.score.candidate, tests)
            missed = omitted_effect_bias(evidence, push, ranked.score.candidate, detectable)
            examined.append(CandidateEffect(ranked, tuple(aliases_of(k, matrix, scores)), left, detectable, missed))
        selection, notes = checked(selection, examined, implausible(evidence, state.session.length_unit))
        depends = dependences(evidence, selection.empirical)
        rotation, translation = np.sqrt(evidence.null.variances[:2])
        found = Diagnosis(
            selection.verdict, tuple(r.name for r in selection.named), "", state.residual_rms, state.noise_floor,
            float(rotation), float(translation), tuple(examined), matrix, tuple(depends),
            tuple(propose(evidence, selection)), missing, evidence, notes,
        )  # fmt: skip
        return replace(found, sentence=sentence_of(found, state.session.length_unit, selection.second))


def checked(
    selection: Selection, examined: list[CandidateEffect], implausible: bool
) -> tuple[Selection, tuple[str, ...]]:
    """An effect that does not help on views left out, or that one view carries, is not named; a second one may be.

    What is left then is below what matters, unless the scatter is one that no arm has, or the one view stands out
    beyond chance.
    """
    if selection.verdict != "missing_effect":
        return selection, selection.notes
    verdicts, notes = list[str](), list(selection.notes)
    for named in (selection.named[0], selection.second):
        if named is None:
            continue
        refusal = _refused(
            named, next((s.cross_validation for s in examined if s.name == named.name), None), implausible
        )
        if refusal is None:
            if named is selection.named[0]:
                return selection, selection.notes
            return replace(selection, named=(named,), second=None), tuple(notes)
        verdicts.append(refusal[0])
        notes.append(refusal[1])
    return Selection(verdicts[0], (), selection.ranked, selection.empirical), tuple(notes[: len(selection.notes) + 1])


def _refused(named: Ranked, left: CrossValidation | None, implausible: bool) -> tuple[str, str] | None:
    """Verdict and reason if an effect does not stand the test of views left out."""
    if left is None:
        return None
    if left.steadiness < _STEADY:
        note = f"{named.name} rests on a single view: without it {max(left.steadiness, 0):.0%} of it remain"
        return "unknown_effect" if implausible or named.adjusted < _BEYOND_CHANCE else "adequate", note
    if not left.helps:
        share = f"{left.poses:.2f} ± {left.poses_sigma:.2f}"
        note = f"{named.name} would not help on views left out (mean square pose error {share} of now)"
        return "unknown_effect" if implausible else "adequate", note
    return None
