"""The whole diagnosis: linear model, candidates, selection, what to measure next, one plain sentence."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from stitch.diagnosis.candidates import candidates_of
from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
from stitch.diagnosis.next_view import propose_measurements
from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.residual_structure import BudgetLine, dependences, follows_field, variance_budget
from stitch.diagnosis.score import Score, implausible, scatter_limit
from stitch.diagnosis.sensitivity import (
    alias_matrix,
    aliases_of,
    detectable_sizes,
    hand_eye_response,
    omitted_effect_bias,
)
from stitch.diagnosis.sentences import diagnosis_sentence
from stitch.diagnosis.thresholds import CROSS_VALIDATED_CANDIDATES, MANY_POSES, MANY_VIEWS
from stitch.diagnosis.unnamed_joint_laws import joint_curves
from stitch.diagnosis.unnamed_time_laws import RepeatingError, find_repeating_errors, reportable
from stitch.diagnosis.validation import CrossValidation, cross_validate
from stitch.diagnosis.verdict import (
    Selection,
    check_verdict,
    cross_validate_named,
    find_scanner_error,
    overlap_misfit_beyond_noise,
    score_pair,
    select,
)
from stitch.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.runs.run import RunState
from stitch.stages.assemble import linearise
from stitch.system.threads import library_threads_off, parallel, return_large_arrays


def diagnose_state(state: RunState) -> Diagnosis:
    """Which effect is missing in the model of a run.

    Raises:
        NoResultError: no two views overlap.
    """
    if len(state.session.views) > MANY_POSES:
        return_large_arrays()
    with library_threads_off():
        return _diagnose(state)


def _diagnose(state: RunState) -> Diagnosis:
    linear, limit = linear_model_of(state), scatter_limit(state.session)
    candidates, missing = candidates_of(linear)
    selection = select(linear, candidates, limit)
    left_out = cross_validate_named(linear, selection)
    selection, smooth = check_verdict(linear, candidates, selection, left_out)
    matrix = alias_matrix(linear, [r.score for r in selection.ranked])
    examined = _examine_candidates(linear, selection, matrix, sum(not c.empirical for c in candidates), left_out)
    within = overlap_misfit_beyond_noise(linear, state.session.scanner.noise)
    if within and selection.verdict == "adequate":
        selection = replace(selection, verdict="unknown_effect")
    unknown = selection.verdict == "unknown_effect"
    unnamed = _repeating_errors(linear, selection) if unknown else ()
    of_field = unknown and (smooth is not None or follows_field(selection.empirical, unnamed))
    curves = joint_curves([law for kind in unnamed for law in kind.laws])
    beyond = implausible(linear, limit)
    said = reportable(unnamed, beyond)
    rotation, translation = _pose_scatter(linear, said)
    found = Diagnosis(
        verdict=selection.verdict,
        effects=tuple(r.name for r in selection.named),
        sentence="",
        residual_rms=state.residual_rms,
        heldout_rms=state.heldout_rms,
        noise_floor=state.noise_floor,
        rotation=rotation,
        translation=translation,
        candidates=tuple(examined),
        matrix=matrix,
        depends_on=tuple(dependences(linear, selection.empirical)),
        next=tuple(propose_measurements(linear, selection)),
        missing=missing,
        linear=linear,
        notes=selection.notes,
        scatter_limit=limit,
        implausible=beyond,
        repeating_errors=unnamed,
        curves=curves,
        log_odds_over_nothing=selection.log_odds_over_nothing,
        overlap_misfit=within,
        follows_field=of_field,
        scanner_error=smooth or (find_scanner_error(linear) if unknown else None),
        doubts=state.doubts,
        budget=_error_budget(linear, selection, said),
    )
    return replace(
        found, sentence=diagnosis_sentence(found, state.session.length_unit, _rescore_pair(linear, selection))
    )


def _rescore_pair(linear: LinearModel, selection: Selection) -> tuple[Ranked, Ranked] | None:
    """Two effects that are missing; of many views they were chosen beside each other."""
    if selection.second is None:
        return None
    first, second = selection.named[0], selection.second
    if linear.measurement.views.count >= MANY_VIEWS:
        return first, second
    return score_pair(linear, first, second, len(selection.ranked))


def _repeating_errors(linear: LinearModel, selection: Selection) -> tuple[RepeatingError, ...]:
    """What repeats without a name, asked only where the verdict did not rest on it."""
    return find_repeating_errors(linear) if selection.repeating_errors is None else selection.repeating_errors


def _pose_scatter(linear: LinearModel, reported: Sequence[RepeatingError]) -> tuple[float, float]:
    """Of the poses, rad and length_unit: what is left beside errors that are said to repeat, or else all of it."""
    process = reported[0].process if reported else None
    beside = _with_joint_law(linear, reported) if reported else linear.scatter_only
    rotation, translation = np.sqrt(process.flange_scatter if process else beside.flange_scatter(beside.null))
    return float(rotation), float(translation)


def _error_budget(
    linear: LinearModel, selection: Selection, reported: Sequence[RepeatingError]
) -> tuple[BudgetLine, ...]:
    """Of what the poses leave, with what is named first and what is said to err without a name."""
    process = reported[0].process if reported else None
    return variance_budget(_with_joint_law(linear, reported), [r.score for r in selection.named[:1]], process)


def _with_joint_law(linear: LinearModel, reported: Sequence[RepeatingError]) -> LinearModel:
    """The views where the joint that is said to err without a name may err so."""
    laws = reported[0].laws if reported else ()
    return laws[0].model if laws else linear


def linear_model_of(state: RunState) -> LinearModel:
    """What a session says beside the model of a run."""
    return linearise(state.session, state.measurement, state.model, state.gate)


def _examine_candidates(
    linear: LinearModel, selection: Selection, matrix: Array, tests: int, left_out: Mapping[str, CrossValidation]
) -> list[CandidateEffect]:
    """Every candidate with what it would leave on views left out, what looks like it, and its detectable sizes.

    Args:
        left_out: of those that may be named, beside all that they were named beside; the others are asked alone.
    """
    scores, push = [r.score for r in selection.ranked], hand_eye_response(linear)

    def validated(k: int) -> CandidateEffect:
        ranked, candidate = selection.ranked[k], scores[k].candidate
        detectable = detectable_sizes(linear, candidate, tests)
        return CandidateEffect(
            ranked=ranked,
            aliases=tuple(aliases_of(k, matrix, scores)),
            cross_validation=left_out.get(ranked.name)
            or (_cross_validate_fitted(linear, scores[k]) if k < CROSS_VALIDATED_CANDIDATES else None),
            detectable=detectable,
            hand_eye=omitted_effect_bias(linear, push, candidate, detectable),
        )

    return list(parallel(validated, range(len(scores)), "candidate effects on views left out"))


def _cross_validate_fitted(linear: LinearModel, scored: Score) -> CrossValidation | None:
    return cross_validate(linear, scored) if scored.observable and scored.fitted else None
