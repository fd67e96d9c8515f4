"""The whole diagnosis: linear model, candidates, selection, what to measure next, one plain sentence."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from stitch.diagnosis.candidates import Candidate, candidates_of
from stitch.diagnosis.covariate_dependence import dependences
from stitch.diagnosis.design.next_view import propose
from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
from stitch.diagnosis.distorted_field import follows_field
from stitch.diagnosis.plausible_scatter import ScatterLimit, implausible, scatter_limit
from stitch.diagnosis.scanner_first import scanner_first
from stitch.diagnosis.score import Score
from stitch.diagnosis.selection.pairs import both_missing
from stitch.diagnosis.selection.upheld import hold_together, validated
from stitch.diagnosis.selection.verdict import Selection, select
from stitch.diagnosis.sensitivity.aliases import alias_matrix, aliases_of
from stitch.diagnosis.sensitivity.detectable import smallest_detectable
from stitch.diagnosis.sensitivity.omitted_effect_bias import hand_eye_response, omitted_effect_bias
from stitch.diagnosis.sentences import sentence_of
from stitch.diagnosis.thresholds import MANY_VIEWS, PREDICTED
from stitch.diagnosis.unknown.joint_curves import joint_curves
from stitch.diagnosis.unknown.unnamed_errors import Unnamed, to_be_said, unnamed_errors
from stitch.diagnosis.validation.cross_validation import CrossValidation, cross_validate
from stitch.diagnosis.validation.halves import halves
from stitch.diagnosis.variance_budget import variance_budget
from stitch.diagnosis.within_overlaps import left_within, scanner_error
from stitch.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.observations.surfaces.field_error import FieldError
from stitch.runs.state import State
from stitch.stages.course import linearise
from stitch.system.heap import return_large_arrays
from stitch.system.threads import library_threads_off, parallel

# From so many on, columns of candidates take a megabyte each.
_MANY_POSES = 1000


def diagnose_state(state: State) -> Diagnosis:
    """Which effect is missing in the model of a run.

    Raises:
        NoResultError: no two views overlap.
    """
    if len(state.session.views) > _MANY_POSES:
        return_large_arrays()
    with library_threads_off():
        return _diagnosed(state)


def _diagnosed(state: State) -> Diagnosis:
    linear, limit = linear_model_of(state), scatter_limit(state.session)
    candidates, missing = candidates_of(linear)
    selection = select(linear, candidates, limit)
    left_out = _left_out(linear, selection)
    selection, smooth = _held(linear, candidates, selection, left_out)
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
        within=within,
        of_field=of_field,
        smooth=smooth or (scanner_error(linear) if unknown else None),
        doubts=state.doubts,
        budget=variance_budget(linear, [r.score for r in selection.named[:1]], said[0].process if said else None),
    )
    return replace(found, sentence=sentence_of(found, state.session.length_unit, selection.second))


def _unnamed(linear: LinearModel, selection: Selection) -> tuple[Unnamed, ...]:
    """What repeats without a name, asked only where the verdict did not rest on it."""
    return unnamed_errors(linear) if selection.unnamed is None else selection.unnamed


def _scatter(linear: LinearModel, said: Sequence[Unnamed]) -> tuple[float, float]:
    """Of the poses, rad and length_unit: what is left beside errors that are said to repeat, or else all of it."""
    process = said[0].process if said else None
    null = process.fit if process else linear.null if said else linear.scatter_only.null
    rotation, translation = np.sqrt(null.variances[:2])
    return float(rotation), float(translation)


def concluded(linear: LinearModel, candidates: Sequence[Candidate], limit: ScatterLimit) -> Selection:
    """The verdict alone: selected, and held against views left out."""
    selection = select(linear, candidates, limit)
    return _held(linear, candidates, selection, _left_out(linear, selection))[0]


def _left_out(linear: LinearModel, selection: Selection) -> dict[str, CrossValidation]:
    """What each effect that may be named does on views left out, beside all that it was named beside."""
    asked = [r for r in (*selection.named, selection.second) if r is not None]
    return {r.name: cross_validate(linear, r.score) for r in asked}


def _held(
    linear: LinearModel,
    candidates: Sequence[Candidate],
    selection: Selection,
    left_out: Mapping[str, CrossValidation],
) -> tuple[Selection, FieldError | None]:
    """What is named, held against views left out, halves of the views and the scanner's own error, which is returned
    where it is part of the answer."""
    if selection.verdict == "missing_effect":
        asked = [r for r in (*selection.named, selection.second) if r is not None]
        held = validated(selection, left_out, {r.name: halves(r.score) for r in asked})
        selection = held if held.named else _together(linear, candidates, selection) or held
    return scanner_first(linear, selection)


def _together(linear: LinearModel, candidates: Sequence[Candidate], selection: Selection) -> Selection | None:
    """Two effects named where the first, the likeliest of all, does not hold alone: what the second does made it
    another in each half."""
    if linear.measurement.views.count >= MANY_VIEWS:
        return None
    two = both_missing(linear, candidates, selection.named[0])
    if two is None or two[0].name != selection.named[0].name or not hold_together(linear, two):
        return None
    return replace(selection, named=two[:1], second=two[1])


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
