"""The whole diagnosis: linear model, candidates, selection, what to measure next, one plain sentence."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from stitch.diagnosis.candidates import candidates_of
from stitch.diagnosis.conclusion import on_views_left_out, upheld
from stitch.diagnosis.covariate_dependence import dependences
from stitch.diagnosis.design.next_view import propose
from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
from stitch.diagnosis.distorted_field import follows_field
from stitch.diagnosis.plausible_scatter import implausible, scatter_limit
from stitch.diagnosis.score import Score
from stitch.diagnosis.selection.pairs import beside_each_other
from stitch.diagnosis.selection.ranking import Ranked
from stitch.diagnosis.selection.verdict import Selection, select
from stitch.diagnosis.sensitivity.aliases import alias_matrix, aliases_of
from stitch.diagnosis.sensitivity.detectable import smallest_detectable
from stitch.diagnosis.sensitivity.omitted_effect_bias import hand_eye_response, omitted_effect_bias
from stitch.diagnosis.sentences import sentence_of
from stitch.diagnosis.thresholds import MANY_POSES, MANY_VIEWS, PREDICTED
from stitch.diagnosis.unknown.joint_curves import joint_curves
from stitch.diagnosis.unknown.unnamed_errors import Unnamed, to_be_said, unnamed_errors
from stitch.diagnosis.validation.cross_validation import CrossValidation, cross_validate
from stitch.diagnosis.variance_budget import BudgetLine, variance_budget
from stitch.diagnosis.within_overlaps import left_within, scanner_error
from stitch.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.runs.state import State
from stitch.stages.course import linearise
from stitch.system.heap import return_large_arrays
from stitch.system.threads import library_threads_off, parallel


def diagnose_state(state: State) -> Diagnosis:
    """Which effect is missing in the model of a run.

    Raises:
        NoResultError: no two views overlap.
    """
    if len(state.session.views) > MANY_POSES:
        return_large_arrays()
    with library_threads_off():
        return _diagnosed(state)


def _diagnosed(state: State) -> Diagnosis:
    linear, limit = linear_model_of(state), scatter_limit(state.session)
    candidates, missing = candidates_of(linear)
    selection = select(linear, candidates, limit)
    left_out = on_views_left_out(linear, selection)
    selection, smooth = upheld(linear, candidates, selection, left_out)
    matrix = alias_matrix(linear, [r.score for r in selection.ranked])
    examined = _examined(linear, selection, matrix, sum(not c.empirical for c in candidates), left_out)
    within = left_within(linear, state.session.scanner.noise)
    if within and selection.verdict == "adequate":
        selection = replace(selection, verdict="unknown_effect")
    unknown = selection.verdict == "unknown_effect"
    unnamed = _unnamed(linear, selection) if unknown else ()
    of_field = unknown and (smooth is not None or follows_field(selection.empirical, unnamed))
    curves = joint_curves([law for kind in unnamed for law in kind.laws])
    beyond = implausible(linear, limit)
    said = to_be_said(unnamed, beyond)
    rotation, translation = _scatter(linear, said)
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
        next=tuple(propose(linear, selection)),
        missing=missing,
        linear=linear,
        notes=selection.notes,
        scatter_limit=limit,
        implausible=beyond,
        unnamed=unnamed,
        curves=curves,
        over_nothing=selection.over_nothing,
        within=within,
        of_field=of_field,
        smooth=smooth or (scanner_error(linear) if unknown else None),
        doubts=state.doubts,
        budget=_budget(linear, selection, said),
    )
    return replace(found, sentence=sentence_of(found, state.session.length_unit, _pair(linear, selection)))


def _pair(linear: LinearModel, selection: Selection) -> tuple[Ranked, Ranked] | None:
    """Two effects that are missing; of many views they were chosen beside each other."""
    if selection.second is None:
        return None
    first, second = selection.named[0], selection.second
    if linear.measurement.views.count >= MANY_VIEWS:
        return first, second
    return beside_each_other(linear, first, second, len(selection.ranked))


def _unnamed(linear: LinearModel, selection: Selection) -> tuple[Unnamed, ...]:
    """What repeats without a name, asked only where the verdict did not rest on it."""
    return unnamed_errors(linear) if selection.unnamed is None else selection.unnamed


def _scatter(linear: LinearModel, said: Sequence[Unnamed]) -> tuple[float, float]:
    """Of the poses, rad and length_unit: what is left beside errors that are said to repeat, or else all of it."""
    process = said[0].process if said else None
    beside = _beside(linear, said) if said else linear.scatter_only
    rotation, translation = np.sqrt(process.flange_scatter if process else beside.flange_scatter(beside.null))
    return float(rotation), float(translation)


def _budget(linear: LinearModel, selection: Selection, said: Sequence[Unnamed]) -> tuple[BudgetLine, ...]:
    """Of what the poses leave, with what is named first and what is said to err without a name."""
    process = said[0].process if said else None
    return variance_budget(_beside(linear, said), [r.score for r in selection.named[:1]], process)


def _beside(linear: LinearModel, said: Sequence[Unnamed]) -> LinearModel:
    """The views where the joint that is said to err without a name may err so."""
    laws = said[0].laws if said else ()
    return laws[0].model if laws else linear


def linear_model_of(state: State) -> LinearModel:
    """What a session says beside the model of a run."""
    return linearise(state.session, state.measurement, state.model, state.gate)


def _examined(
    linear: LinearModel, selection: Selection, matrix: Array, tests: int, left_out: Mapping[str, CrossValidation]
) -> list[CandidateEffect]:
    """Every candidate with what it would leave on views left out, what looks like it, and its detectable sizes.

    Args:
        left_out: of those that may be named, beside all that they were named beside; the others are asked alone.
    """
    scores, push = [r.score for r in selection.ranked], hand_eye_response(linear)

    def asked(k: int) -> CandidateEffect:
        ranked, candidate = selection.ranked[k], scores[k].candidate
        detectable = smallest_detectable(linear, candidate, tests)
        return CandidateEffect(
            ranked=ranked,
            aliases=tuple(aliases_of(k, matrix, scores)),
            cross_validation=left_out.get(ranked.name) or (_alone(linear, scores[k]) if k < PREDICTED else None),
            detectable=detectable,
            hand_eye=omitted_effect_bias(linear, push, candidate, detectable),
        )

    return list(parallel(asked, range(len(scores)), "candidate effects on views left out"))


def _alone(linear: LinearModel, scored: Score) -> CrossValidation | None:
    return cross_validate(linear, scored) if scored.observable and scored.fitted else None
