"""The whole diagnosis: evidence, candidates, selection, what to measure next, one plain sentence."""

from dataclasses import replace

import numpy as np

from stitch.diagnosis.aliases import alias_matrix, aliases_of
from stitch.diagnosis.answer import Diagnosis, Suspect
from stitch.diagnosis.candidates import candidates_of
from stitch.diagnosis.detectable import smallest_detectable
from stitch.diagnosis.heldout import Left, left_by
from stitch.diagnosis.missed import hand_eye_if_missed, hand_eye_push
from stitch.diagnosis.next_view import propose
from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.select import Selection, implausible, select
from stitch.diagnosis.start import evidence_of_state
from stitch.diagnosis.unknown import dependences
from stitch.diagnosis.words import sentence_of
from stitch.state import State
from stitch.threads import library_threads_off

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
        tests, suspects = sum(c.effect.tier != "empirical" for c in candidates), []
        push = hand_eye_push(evidence)
        for k, ranked in enumerate(selection.ranked):
            clear = ranked.score.observable and k < _PREDICTED and np.isfinite(ranked.score.sigmas).all()
            left = left_by(evidence, ranked.score, points) if clear else None
            detectable = smallest_detectable(evidence, ranked.score.candidate, tests)
            missed = hand_eye_if_missed(evidence, push, ranked.score.candidate, detectable)
            suspects.append(Suspect(ranked, tuple(aliases_of(k, matrix, scores)), left, detectable, missed))
        selection, notes = checked(selection, suspects, implausible(evidence, state.session.length_unit))
        depends = dependences(evidence, selection.empirical)
        rotation, translation = np.sqrt(evidence.null.variances[:2])
        found = Diagnosis(
            selection.verdict, tuple(r.name for r in selection.named), "", state.residual_rms, state.noise_floor,
            float(rotation), float(translation), tuple(suspects), matrix, tuple(depends),
            tuple(propose(evidence, selection)), missing, evidence, notes,
        )  # fmt: skip
        return replace(found, sentence=sentence_of(found, state.session.length_unit, selection.second))


def checked(selection: Selection, suspects: list[Suspect], implausible: bool) -> tuple[Selection, tuple[str, ...]]:
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
        refusal = _refused(named, next((s.left for s in suspects if s.name == named.name), None), implausible)
        if refusal is None:
            if named is selection.named[0]:
                return selection, selection.notes
            return replace(selection, named=(named,), second=None), tuple(notes)
        verdicts.append(refusal[0])
        notes.append(refusal[1])
    return Selection(verdicts[0], (), selection.ranked, selection.empirical), tuple(notes[: len(selection.notes) + 1])


def _refused(named: Ranked, left: Left | None, implausible: bool) -> tuple[str, str] | None:
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
