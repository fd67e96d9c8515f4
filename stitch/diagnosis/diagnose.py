"""The whole diagnosis: linear model, candidates, evidence, verdict, plain sentences."""

from concurrent.futures import wait
from dataclasses import replace
from functools import partial

import numpy as np

from stitch.diagnosis.candidates import candidates_of
from stitch.diagnosis.dependence import dependences
from stitch.diagnosis.diagnosis import CandidateEffect, Diagnosis
from stitch.diagnosis.evidence import (
    find_scanner_error,
    gather_evidence,
    lone_scanner_error,
    overlap_misfit_beyond_noise,
)
from stitch.diagnosis.ranking import Ranked, conditioned_on_effects, rank_one, too_large
from stitch.diagnosis.regime import regime_of
from stitch.diagnosis.residual_structure import follows_field, variance_budget
from stitch.diagnosis.score import expected_scatter, scatter_limit
from stitch.diagnosis.sensitivity import (
    alias_matrix,
    aliases_of,
    detectable_sizes,
    hand_eye_response,
    omitted_effect_bias,
    unseen_shape_error,
)
from stitch.diagnosis.sentences import diagnosis_sentence
from stitch.diagnosis.smooth_processes import FittedProcess
from stitch.diagnosis.thresholds import CROSS_VALIDATED_CANDIDATES, MANY_POSES
from stitch.diagnosis.unmodelled_joint_effects import joint_curves
from stitch.diagnosis.unmodelled_time_effects import RepeatingError, find_repeating_errors, reportable
from stitch.diagnosis.validation import cross_validate
from stitch.diagnosis.verdict import Evidence
from stitch.fit.pipelines import linearise
from stitch.numerics.frames import Array
from stitch.observations.linear_model import LinearModel
from stitch.run_data import RunData
from stitch.system.process import announce, return_large_arrays
from stitch.system.threads import begin, library_threads_off, parallel


def diagnose_state(state: RunData) -> Diagnosis:
    """Find which effect is missing in the model of a run; what to measure next is planned elsewhere.

    Raises:
        NoResultError: no two views overlap.
    """
    if len(state.session.views) > MANY_POSES:
        return_large_arrays()
    with library_threads_off():
        return _diagnose(state)


def linear_model_of(state: RunData) -> LinearModel:
    """Return the session of a run, linearised under its model."""
    return linearise(state.session, state.measurement, state.model, state.gate)


def _diagnose(state: RunData) -> Diagnosis:
    """Return the diagnosis of a run: verdict, candidates, and where the remaining error comes from.

    The order matters: the evidence decides the verdict, then every candidate is described. Last, repeating errors
    without a name are sought where the verdict is unknown_effect: the scatter of the poses is stated beside them.
    """
    announce("diagnosing: what every view tells of its pose")
    linear = linear_model_of(state)
    # Sums over all points, which leave the interpreter to the questions that come before theirs.
    scanner_error = begin(partial(lone_scanner_error, linear))
    limit = scatter_limit(state.session)
    announce("diagnosing: trying every effect")
    candidates, missing = candidates_of(linear)
    misfit = overlap_misfit_beyond_noise(linear, state.session.scanner.noise)
    evidence = gather_evidence(linear, candidates, limit, misfit)
    announce("diagnosing: errors without a name, and where the error comes from")
    is_unknown = evidence.verdict == "unknown_effect"
    repeating, with_reported, process, scatter = _errors_without_a_name(linear, evidence)
    # Decompositions of matrices, beside the candidates.
    budget = begin(partial(variance_budget, with_reported, [r.score for r in evidence.named[:1]], process))
    matrix = alias_matrix(linear, [r.score for r in evidence.ranked])
    examined = _examine_candidates(linear, evidence, matrix, sum(not c.empirical for c in candidates))
    rotation, translation = np.sqrt(scatter).tolist()
    diagnosis = Diagnosis(
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
        depends_on=dependences(linear, evidence.named, evidence.dictionary),
        missing=missing,
        linear=linear,
        run=state,
        notes=evidence.notes,
        coincidence=evidence.coincidence,
        scatter_limit=limit,
        implausible=evidence.implausible_scatter,
        expected_scatter=expected_scatter(linear, limit),
        beyond_expected=evidence.beyond_expected,
        repeating_errors=repeating,
        curves=joint_curves([effect for error in repeating for effect in error.joint_effects]),
        log_odds_over_nothing=evidence.log_odds_over_nothing,
        overlap_misfit=misfit,
        follows_field=is_unknown
        and (evidence.scanner_error is not None or follows_field(evidence.empirical, repeating)),
        scanner_error=evidence.scanner_error or (find_scanner_error(linear) if is_unknown else None),
        doubts=state.doubts,
        laws=evidence.reported_laws,
        rival_trend=evidence.rival_trend if evidence.named else "",
        places=evidence.reported_places,
        beyond_belief=too_large(evidence.named),
        together=evidence.missing_together,
        tried=state.tried,
        budget=budget.result(),
        answers=evidence.answers,
    )
    # Nothing goes on after a diagnosis; who asked has its answer, or its error, already.
    wait([scanner_error])
    sentence = diagnosis_sentence(diagnosis, state.session.length_unit, _pair_beside_each_other(linear, evidence))
    return replace(diagnosis, sentence=sentence)


def _errors_without_a_name(
    linear: LinearModel, evidence: Evidence
) -> tuple[tuple[RepeatingError, ...], LinearModel, FittedProcess | None, Array]:
    """Return the kinds of pose errors that repeat, and what scatters beside the one that is reported.

    Without a reported one all pose errors together count as scatter.

    Returns:
        The kinds; the model in which the joint that is reported may err without a name; the process in time, where
        one is reported; and the variances (2,) per axis of the flange's scatter, rad² and length_unit².
    """
    repeating = evidence.repeating_errors or ()
    if evidence.verdict == "unknown_effect" and (evidence.repeating_errors is None or evidence.reported_laws):
        repeating = find_repeating_errors(conditioned_on_effects(linear, evidence.reported_laws[:1]))
    reported = next(iter(reportable(repeating, evidence.implausible_scatter)), None)
    if reported is None:
        scattering = linear.restricted(())
        return repeating, linear, None, scattering.flange_scatter(scattering.null)
    model = reported.joint_effects[0].model if reported.joint_effects else linear
    process = reported.process
    return repeating, model, process, process.flange_scatter if process else model.flange_scatter(model.null)


def _examine_candidates(linear: LinearModel, evidence: Evidence, matrix: Array, tests: int) -> list[CandidateEffect]:
    """Return every candidate with its cross-validation, its aliases and the smallest sizes that would show.

    Effects that may be named have been cross-validated already; of the others the first `CROSS_VALIDATED_CANDIDATES`
    are, each alone.

    Args:
        matrix: (K, K) alias matrix of the K candidates, in the order of `evidence.ranked`.
        tests: number of effects among which one is chosen.
    """
    scores = [r.score for r in evidence.ranked]
    response = hand_eye_response(linear)

    def examined(k: int) -> CandidateEffect:
        """Return the description of candidate k; threads run it for several k at once."""
        scored = scores[k]
        detectable = detectable_sizes(linear, scored.candidate, tests)
        validation = evidence.left_out.get(scored.name)
        if not validation and k < CROSS_VALIDATED_CANDIDATES and scored.observable and scored.fitted:
            validation = cross_validate(linear, scored)
        return CandidateEffect(
            ranked=evidence.ranked[k],
            aliases=aliases_of(k, matrix, scores),
            cross_validation=validation,
            detectable=detectable,
            hand_eye=omitted_effect_bias(linear, response, scored.candidate, detectable),
            shape=unseen_shape_error(linear, scored.candidate, detectable),
        )

    return list(parallel(examined, range(len(scores)), "candidate effects on views left out"))


def _pair_beside_each_other(linear: LinearModel, evidence: Evidence) -> tuple[Ranked, Ranked] | None:
    """Return two effects that are both missing, each scored with the other in the model; None unless two are.

    With many views the selection has scored them so already.
    """
    if evidence.second is None:
        return None
    first = evidence.named[0]
    second = evidence.second
    if regime_of(linear).many_views:
        return first, second
    tests = len(evidence.ranked)
    of_first = rank_one(conditioned_on_effects(linear, [second]), first.score.candidate, tests)
    return of_first, rank_one(conditioned_on_effects(linear, [first]), second.score.candidate, tests)
