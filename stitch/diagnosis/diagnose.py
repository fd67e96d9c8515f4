"""The whole diagnosis: linear model, candidates, evidence, verdict, plain sentences."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stitch.diagnosis.candidates import candidates_of
from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
from stitch.diagnosis.evidence import find_scanner_error, gather_evidence, overlap_misfit_beyond_noise, score_pair
from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.residual_structure import BudgetLine, dependences, follows_field, variance_budget
from stitch.diagnosis.score import scatter_limit
from stitch.diagnosis.sensitivity import (
    alias_matrix,
    aliases_of,
    detectable_sizes,
    hand_eye_response,
    omitted_effect_bias,
)
from stitch.diagnosis.sentences import diagnosis_sentence
from stitch.diagnosis.thresholds import CROSS_VALIDATED_CANDIDATES, MANY_POSES
from stitch.diagnosis.unnamed_joint_laws import joint_curves
from stitch.diagnosis.unnamed_time_laws import RepeatingError, find_repeating_errors, reportable
from stitch.diagnosis.validation import cross_validate
from stitch.diagnosis.verdict import Evidence
from stitch.fit.pipelines import linearise
from stitch.numerics.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.run_data import RunData
from stitch.system.process import announce
from stitch.system.threads import library_threads_off, parallel, return_large_arrays


def diagnose_state(state: RunData) -> Diagnosis:
    """Find which effect is missing in the model of a run; what to measure next is planned elsewhere.

    Raises:
        NoResultError: no two views overlap.
    """
    if len(state.session.views) > MANY_POSES:
        return_large_arrays()
    with library_threads_off():
        return _diagnose(state)


def _diagnose(state: RunData) -> Diagnosis:
    announce("diagnosing: what every view tells of its pose")
    linear, limit = linear_model_of(state), scatter_limit(state.session)
    announce("diagnosing: trying every effect")
    candidates, missing = candidates_of(linear)
    within = overlap_misfit_beyond_noise(linear, state.session.scanner.noise)
    evidence = replace(gather_evidence(linear, candidates, limit), overlap_misfit=within)
    matrix = alias_matrix(linear, [r.score for r in evidence.ranked])
    examined = _examine_candidates(linear, evidence, matrix, sum(not c.empirical for c in candidates))
    unknown = evidence.verdict == "unknown_effect"
    announce("diagnosing: errors without a name, and where the error comes from")
    unnamed = evidence.repeating_errors or ()
    if unknown and evidence.repeating_errors is None:
        unnamed = find_repeating_errors(linear)
    of_field = unknown and (evidence.scanner_error is not None or follows_field(evidence.empirical, unnamed))
    curves = joint_curves([law for kind in unnamed for law in kind.laws])
    said = reportable(unnamed, evidence.implausible_scatter)
    rotation, translation = _pose_scatter(linear, said)
    found = Diagnosis(
        verdict=evidence.verdict,
        named=evidence.named,
        sentence="",
        residual_rms=state.residual_rms,
        heldout_rms=state.heldout_or_fit_rms,
        noise_floor=state.noise_floor,
        rotation=rotation,
        translation=translation,
        candidates=tuple(examined),
        matrix=matrix,
        depends_on=tuple(dependences(linear, evidence.empirical)),
        missing=missing,
        linear=linear,
        notes=evidence.notes,
        coincidence=evidence.coincidence,
        scatter_limit=limit,
        implausible=evidence.implausible_scatter,
        repeating_errors=unnamed,
        curves=curves,
        log_odds_over_nothing=evidence.log_odds_over_nothing,
        overlap_misfit=within,
        follows_field=of_field,
        scanner_error=evidence.scanner_error or (find_scanner_error(linear) if unknown else None),
        doubts=state.doubts,
        together=_named_together(evidence),
        tried=state.tried,
        budget=_error_budget(linear, evidence, said),
    )
    return replace(
        found, sentence=diagnosis_sentence(found, state.session.length_unit, _rescore_pair(linear, evidence))
    )


def _named_together(evidence: Evidence) -> tuple[str, ...]:
    """Return the effects that are missing at once, the one that is named first; else those that are named."""
    named, together = [r.name for r in evidence.named], [r.name for r in evidence.together]
    return tuple(together if evidence.verdict == "missing_effect" and together[:1] == named else named)


def _rescore_pair(linear: LinearModel, evidence: Evidence) -> tuple[Ranked, Ranked] | None:
    """Two effects that are missing; of many views they were chosen beside each other."""
    if evidence.second is None:
        return None
    first, second = evidence.named[0], evidence.second
    if regime_of(linear).many_views:
        return first, second
    return score_pair(linear, first, second, len(evidence.ranked))


def _pose_scatter(linear: LinearModel, reported: Sequence[RepeatingError]) -> tuple[float, float]:
    """Return the scatter of the poses (rad, length_unit): beside errors said to repeat, or else all of it."""
    process = reported[0].process if reported else None
    beside = _with_joint_law(linear, reported) if reported else linear.restricted(())
    rotation, translation = np.sqrt(process.flange_scatter if process else beside.flange_scatter(beside.null))
    return float(rotation), float(translation)


def _error_budget(
    linear: LinearModel, evidence: Evidence, reported: Sequence[RepeatingError]
) -> tuple[BudgetLine, ...]:
    """Return shares of what the poses leave, with what is named first and what is said to err without a name."""
    process = reported[0].process if reported else None
    return variance_budget(_with_joint_law(linear, reported), [r.score for r in evidence.named[:1]], process)


def _with_joint_law(linear: LinearModel, reported: Sequence[RepeatingError]) -> LinearModel:
    """The views where the joint that is said to err without a name may err so."""
    laws = reported[0].laws if reported else ()
    return laws[0].model if laws else linear


def linear_model_of(state: RunData) -> LinearModel:
    """Linearise a session under the model of a run."""
    return linearise(state.session, state.measurement, state.model, state.gate)


def _examine_candidates(linear: LinearModel, evidence: Evidence, matrix: Array, tests: int) -> list[CandidateEffect]:
    """Every candidate with what it would leave on views left out, what looks like it, and its detectable sizes.

    Those that are not among what may be named are asked alone.
    """
    scores, push = [r.score for r in evidence.ranked], hand_eye_response(linear)

    def validated(k: int) -> CandidateEffect:
        ranked, candidate = evidence.ranked[k], scores[k].candidate
        detectable = detectable_sizes(linear, candidate, tests)
        asked = k < CROSS_VALIDATED_CANDIDATES and scores[k].observable and scores[k].fitted
        return CandidateEffect(
            ranked=ranked,
            aliases=tuple(aliases_of(k, matrix, scores)),
            cross_validation=evidence.left_out.get(ranked.name)
            or (cross_validate(linear, scores[k]) if asked else None),
            detectable=detectable,
            hand_eye=omitted_effect_bias(linear, push, candidate, detectable),
        )

    return list(parallel(validated, range(len(scores)), "candidate effects on views left out"))
