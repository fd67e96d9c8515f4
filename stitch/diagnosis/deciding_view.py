"""Which further views decide between rival effects, and how likely: by simulation over the rivals and the scatter.

Each rival, with hand-eye and effects in use fitted beside it, predicts what a further view would show: a mean and a
covariance (of what it does not know of itself, of the arm's errors, of scatter and noise). It does so in each form that
its views leave likely, of a time constant, a joint, a view from which it acts. A view is worth as much as
these predictions differ for what they are known to (Box & Hill 1967, Technometrics 9:57; Atkinson & Fedorov 1975,
Biometrika 62:57). Every rival in turn is taken for the true one and its views are drawn; that one is decided for which
is then twenty times likelier than all others, as a diagnosis asks. Among the rivals is a joint that follows the pose by
no law that anybody wrote down. What a verdict asks beside, of views left out and of halves of the views, is in
none of these odds.

A further view is counted in the frame of the views that there are: less the mean motion of these, as nobody sees it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from stitch.diagnosis.candidate_views import (
    candidate_measurement,
    candidate_rows,
    drawn_until,
    nearby,
    reachable,
    with_candidates,
)
from stitch.diagnosis.ranking import Ranked
from stitch.diagnosis.score import Score
from stitch.diagnosis.thresholds import ODDS
from stitch.diagnosis.unmodelled_joint_effects import JointEffect, joint_effects, log_posterior_of_any
from stitch.model.forward import moves_points, pose_derivatives
from stitch.model.model import Model, Term
from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.numerics.kernels import exponential_kernel, process_covariance
from stitch.numerics.least_squares import equilibrated
from stitch.numerics.reml import NOISE, at_variances
from stitch.observations.linear_model import LinearModel
from stitch.observations.pose_errors import (
    ALL_ANGLES,
    DRIFT_MEMORY,
    OWN_ANGLE,
    TWO_ANGLES,
    PoseErrors,
    flange_twists,
    prior_pose_errors,
    usual_time_step,
)
from stitch.observations.row_model import ReducedRows
from stitch.observations.row_reduction import pose_numbers
from stitch.observations.surfaces.hand_eye_fit import hand_eye_jacobian
from stitch.observations.surfaces.surface_model import SurfaceObservation
from stitch.observations.targets.rows import TargetRows
from stitch.session.capture import build_capture
from stitch.session.measurement import Measurement
from stitch.session.robot import forward
from stitch.system.threads import remembered

# Poses that are tried; then the best of them again, with so many poses close to those.
_TRIED, _BEST, _CLOSE_TO_BEST = 72, 3, 24
# Points of the scans of which it is asked whether a pose sees them, the least share of what the views see, and the
# least cosine at which a surface is seen.
_POINTS, _LEAST_SEEN, _FACING = 300, 0.5, 0.2
# Views that are proposed at the most, and the odds at which one more is not needed.
MOST_VIEWS, SURE = 3, 0.95
# A view that adds less than this to the probability that the true one is named is not worth driving to.
_WORTH = 0.02
# Draws of each rival for the search, and for the odds that are stated.
_SEARCH_DRAWS, _STATED_DRAWS = 96, 2000
# Forms of a rival that compete at the most, and the nats by which they may be behind its best.
_FORMS, _BEHIND_BEST = 5, 6.0
# What a joint without a law may follow, of which a pose alone tells what is expected there.
_BY_POSE = (ALL_ANGLES, OWN_ANGLE, TWO_ANGLES)
# Shares of the session's duration that one may wait where a rival goes with time.
_WAITS = (0.0, 0.5, 1.0, 2.0)


@dataclass(frozen=True)
class Prediction:
    """What a rival predicts that N further views show: m numbers each, jointly normal.

    The m numbers of a view are the six of its twist (surfaces), or the reduced residuals of its targets.
    """

    mean: Array  # (N, m)
    covariance: Array  # (N, m, N, m) by what the views taken leave uncertain: coefficients, pose errors, noise
    design: Array  # (N, m, a) of hand-eye and effects in use

    def of_sets(self, chosen: Sequence[int], last: Indices) -> tuple[Array, Array]:
        """Return mean (C, D) and covariance (C, D, D) of the D numbers that C sets of k views will show, view by view.

        A set is the chosen views and one more, all different, so that D = k m.

        Args:
            chosen: indices (k − 1) of the views that are in every set.
            last: (C,) index of the last view of each set.
        """
        sets = np.column_stack([np.tile(np.array(chosen, np.int64), (len(last), 1)), last])
        C, k = sets.shape
        numbers = k * self.mean.shape[1]
        # Indices with a slice between them put their axes first: (C, k, k, m, m).
        blocks = self.covariance[sets[:, :, None], :, sets[:, None, :]]
        covariance = blocks.transpose(0, 1, 3, 2, 4).reshape(C, numbers, numbers)
        return self.mean[sets].reshape(C, numbers), covariance


def deciding_views(
    linear: LinearModel, rivals: Sequence[Ranked], undecided: int = 0
) -> tuple[Array, Array, Array] | None:
    """Return the further views after which one of the rivals is most likely named; None where no pose tells them apart.

    Views are chosen among poses near those driven, from which the scanner sees the part as it has before; then again
    among the best of these and poses close to them.

    Args:
        rivals: effects, as they are ranked beside each other.
        undecided: number of rivals, the first ones, between which the verdict did not decide. Where their evidence
            would have decided, the verdict overruled it: then they are taken for equally likely.

    Returns:
        Of up to `MOST_VIEWS` views in the order in which they are taken: joints (K, n), rad; waits (K,), s after the
        last view that there is, beside the usual pause; probabilities (K,) that the true rival is named by then.
    """
    scores = [ranked.score for ranked in rivals]
    if linear.measurement.robot is None or not linear.measurement.views.joints.shape[1]:
        return None
    if not scores or not all(scored.fitted for scored in scores):
        return None
    if isinstance(linear.observation, SurfaceObservation) and moves_points([scored.form.term for scored in scores]):
        return None
    unnamed = unnamed_joints(linear, scores)
    if len(scores) + bool(unnamed) < 2:
        return None
    log_weights = np.array([ranked.log_evidence for ranked in rivals])
    group = log_weights[:undecided]
    if undecided and np.ptp(group) > ODDS:
        log_weights[:undecided] = group.max()
    joints = possible_joints(linear)[:_TRIED]
    if not len(joints):
        return None
    forms = competing_forms(scores, log_weights, [ranked.log_belief for ranked in rivals], unnamed)
    chosen, _, _, share_alone = _choose(linear, forms, joints)
    best = joints[np.argsort(-share_alone, kind="stable")[:_BEST]]
    close_to_best = possible_joints(linear, best)[:_CLOSE_TO_BEST]
    refined = np.unique(np.concatenate([best, joints[chosen], close_to_best]).round(9), axis=0)
    chosen, wait, probability, _ = _choose(linear, forms, refined)
    return (refined[chosen], wait[chosen], probability) if chosen else None


def unnamed_joints(linear: LinearModel, scores: Sequence[Score]) -> list[tuple[JointEffect, float]]:
    """Return the likeliest unmodelled effects of single joints that follow the pose, each with its log posterior.

    They are scored in the model without random effects of the rivals' names, as the rivals are. [] where the views tell
    of none.
    """
    base = linear.without([scored.name for scored in scores])
    effects = joint_effects(base)
    by_pose = [effect for effect in effects if effect.follows in _BY_POSE][:_FORMS]
    factors = np.array([effect.log_bayes_factor for effect in by_pose])
    # Each has its share of the prior of all effects of joints.
    posteriors = log_posterior_of_any(factors[None]) - np.log(max(len(effects), 1))
    pairs = zip(by_pose, posteriors.tolist(), strict=True)
    return [(effect, posterior) for effect, posterior in pairs if posterior > posteriors.max() - _BEHIND_BEST]


@dataclass(frozen=True)
class RivalForms:
    """F forms of all R rivals, each as a score of its own; the last rival may be a joint without a law."""

    scores: list[Score | JointEffect]
    log_weights: Array  # (F,) log posterior by the views taken, not normalised
    rival: Indices  # (F,) index of the rival whose form it is
    log_belief: Array  # (R,) how often each rival is met, a judgement that decides nothing by itself

    def margins(self, log_posteriors: Array) -> Array:
        """Return (R, …) by how many nats each rival is ahead of the nearest other one, from log posteriors (R, …).

        A rival that is met more rarely has to be ahead by that too; one that is met more often gains nothing by it.
        """
        margins = list[Array]()
        for r, log_posterior in enumerate(log_posteriors):
            others = np.delete(np.arange(len(log_posteriors)), r)
            handicap = np.minimum(self.log_belief[r] - self.log_belief[others], 0.0)
            by_other = handicap.reshape(-1, *[1] * log_posterior.ndim)
            margins.append((log_posterior - log_posteriors[others] + by_other).min(axis=0))
        return np.array(margins)


def competing_forms(
    scores: Sequence[Score],
    log_weights: Array,
    log_belief: Sequence[float] = (),
    unnamed: Sequence[tuple[JointEffect, float]] = (),
) -> RivalForms:
    """Return the likeliest forms of each rival, and the joints without a law as the forms of one more rival.

    Args:
        scores: of the rivals that have a name.
        log_weights: (R,) of these, not normalised; the forms of a rival share its weight.
        log_belief: (R,) how often each is met; () where all are met alike.
        unnamed: effects of single joints with their weights.
    """
    forms = list[Score | JointEffect]()
    weights = list[float]()
    rival = list[int]()
    for r, scored in enumerate(scores):
        of_rival, shares = scored.candidate.forms, scored.log_shares
        if shares is None:
            of_rival, shares = (scored.form,), np.zeros(1)
        likeliest = np.argsort(-shares, kind="stable")[:_FORMS]
        kept = [i for i in likeliest if shares[i] > shares.max() - _BEHIND_BEST and of_rival[i].columns.any()]
        forms += [replace(scored, form=of_rival[i]) for i in kept]
        weights += (log_weights[r] + shares[kept] - np.logaddexp.reduce(shares[kept])).tolist()
        rival += [r] * len(kept)
    forms += [effect for effect, _ in unnamed]
    weights += [weight for _, weight in unnamed]
    rival += [len(scores)] * len(unnamed)
    belief = np.zeros(max(rival) + 1)
    belief[: len(log_belief)] = log_belief
    return RivalForms(forms, np.array(weights), np.array(rival), belief)


def _choose(linear: LinearModel, forms: RivalForms, joints: Array) -> tuple[list[int], Array, Array, Array]:
    """Return the views that decide best, chosen one after the other, and how much each view decides alone.

    The measure is the probability that the true rival will have, on average over what the view may show. Choosing ends
    when the true rival will be named with probability `SURE`, or when a further view adds less than `_WORTH`.

    Args:
        joints: (N, n) rad, of the views to choose from.

    Returns:
        The indices of the K chosen views; (N,) s, how long is waited before each view; (K,) the probability that the
        true rival is named after each chosen one; and (N,) the measure after each view alone.
    """
    wait = _waits(linear, forms.scores, len(joints))
    predictions = predict_views(linear, forms.scores, joints, wait)
    m = predictions[0].mean.shape[1]
    indices: Indices = np.arange(len(joints), dtype=np.int64)
    rng = np.random.default_rng(0)
    weights = np.exp(forms.log_weights - forms.log_weights.max())
    # Before any further view: a rival is the true one with its share, and has that share then.
    true_share = float(np.sum((np.bincount(forms.rival, weights) / weights.sum()) ** 2))
    chosen = list[int]()
    probability = list[float]()
    share_alone = np.zeros(len(joints))
    while len(chosen) < min(MOST_VIEWS, len(joints)) and (not probability or probability[-1] < SURE):
        draws = rng.standard_normal((_SEARCH_DRAWS, (len(chosen) + 1) * m))
        shares = np.full(len(joints), -1.0)
        others = np.delete(indices, chosen)
        _, shares[others] = _simulate_decisions(predictions, forms, chosen, others, draws)
        if not chosen:
            share_alone = shares
        k = int(shares.argmax())
        more_draws = rng.standard_normal((_STATED_DRAWS, (len(chosen) + 1) * m))
        (named,), (share,) = _simulate_decisions(predictions, forms, chosen, indices[k : k + 1], more_draws)
        if share < true_share + _WORTH:
            break
        chosen.append(k)
        probability.append(float(named))
        true_share = float(share)
    return chosen, wait, np.array(probability), share_alone


def _simulate_decisions(
    predictions: Sequence[Prediction], forms: RivalForms, chosen: Sequence[int], last: Indices, draws: Array
) -> tuple[Array, Array]:
    """Return what C sets of views will decide, by simulation; each is the chosen views and one of `last`.

    Each form in turn is taken for the true one, as often as its weight says: what a set shows is drawn from its
    prediction, and held against the predictions of all forms.

    Args:
        predictions: of the F forms.
        chosen: indices of the views that are in every set.
        last: (C,) index of the last view of each set.
        draws: (S, D) standard normal numbers, from which the D numbers that a set shows are drawn S times.

    Returns:
        (C,) the probability that the true rival is named, and (C,) its posterior probability; on average over the
        rivals and over what the views may show.
    """
    sets = [prediction.of_sets(chosen, last) for prediction in predictions]
    means = [mean for mean, _ in sets]
    roots = [np.linalg.cholesky(covariance) for _, covariance in sets]
    whiteners = [np.linalg.inv(root).transpose(0, 2, 1) for root in roots]
    half_log_dets = np.array([np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1) for root in roots])
    # Log density of what is shown, by each form: this less half the square of what is shown, whitened.
    log_heights = forms.log_weights[:, None] - half_log_dets
    weights = np.exp(forms.log_weights - forms.log_weights.max())
    weights = weights / weights.sum()
    rivals = range(int(forms.rival.max()) + 1)
    right, share = np.zeros((2, len(last)))
    for weight, true, true_mean, root in zip(weights, forms.rival, means, roots, strict=True):
        drawn = true_mean[:, None] + draws @ root.transpose(0, 2, 1)  # (C, S, D)
        whitened = ((drawn - mean[:, None]) @ whitener for mean, whitener in zip(means, whiteners, strict=True))
        squares = np.array([np.sum(deviation**2, axis=2) for deviation in whitened])
        of_forms = log_heights[:, :, None] - 0.5 * squares
        log_posteriors = np.array([np.logaddexp.reduce(of_forms[forms.rival == r], axis=0) for r in rivals])
        decided = forms.margins(log_posteriors) > ODDS
        right += weight * decided[true].mean(axis=1)
        share += weight * np.exp(log_posteriors[true] - np.logaddexp.reduce(log_posteriors, axis=0)).mean(axis=1)
    return right, share


def possible_joints(linear: LinearModel, chosen: Array | None = None) -> Array:
    """Return random joint angles (K, n), rad, from which the scanner sees the part as it has before.

    Of labelled points what is seen is not asked.

    Args:
        chosen: (C, n) rad, angles to stay close to; None: those of the views taken.
    """
    driven = linear.measurement.views.joints
    observation = linear.observation
    if not isinstance(observation, SurfaceObservation):
        return nearby(driven, chosen)
    T_mount = linear.model.T_mount

    def poses_of(joints: Array) -> Array:
        assert linear.measurement.robot is not None
        T = forward(linear.measurement.robot, joints)
        return build_capture("candidates", (), T, linear.measurement.mount).poses(T_mount)

    scan_poses = observation.capture.poses(T_mount)
    least = _LEAST_SEEN * np.median(seen_shares(observation, scan_poses, scan_poses))

    def seeing(seed: int) -> Array:
        """Return random joint angles (k, n) from which the scanner sees the part."""
        joints = reachable(driven, poses_of, scan_poses, observation.centre, chosen, seed)
        return joints[seen_shares(observation, scan_poses, poses_of(joints)) > least] if len(joints) else joints

    return drawn_until(seeing, _TRIED)


def seen_shares(observation: SurfaceObservation, scan_poses: Array, poses: Array) -> Array:
    """Return (K,) the share of the scanned surface that faces the scanner, within its field, at poses (K, 4, 4).

    About `_POINTS` points of the scans stand for the surface.

    Args:
        scan_poses: T_reference_scanner (V, 4, 4) of the scans.
        poses: T_reference_scanner (K, 4, 4) that are asked.
    """
    scans = observation.capture.scans
    per_scan = max(_POINTS // len(scans), 1)
    sampled = [np.linspace(0, len(scan.points) - 1, per_scan).astype(int) for scan in scans]
    posed = list(zip(scan_poses, scans, sampled, strict=True))
    points = np.concatenate([frames.transform(T, scan.points[i]) for T, scan, i in posed])
    normals = np.concatenate([scan.normals[i] @ T[:3, :3].T for T, scan, i in posed])
    away = frames.transform(frames.inverse(poses), points) - scans[0].eye
    facing = np.einsum("kmi,kmi->km", normals @ poses[:, :3, :3], -away) > _FACING * np.linalg.norm(away, axis=2)
    low, high = _scanned_field(observation)
    places = _field_places(away)
    in_field = (places > low).all(axis=2) & (places < high).all(axis=2)
    return np.asarray((facing & in_field).mean(axis=1))


@remembered
def _scanned_field(observation: SurfaceObservation) -> tuple[Array, Array]:
    """Return the least and the largest places in the scanner's field (3,), (3,) of all scans.

    A box of places is a frustum: near the scanner the field is narrower than far away.
    """
    places = [_field_places(scan.points - scan.eye) for scan in observation.capture.scans]
    return np.min([p.min(axis=0) for p in places], axis=0), np.max([p.max(axis=0) for p in places], axis=0)


def _field_places(away: Array) -> Array:
    """Return x/z, y/z and z (…, 3) of vectors (…, 3) from the scanner's eye, scanner frame."""
    z = away[..., 2:]
    return np.concatenate([away[..., :2] / np.where(z == 0, 1e-300, z), z], axis=-1)


def _waits(linear: LinearModel, scores: Sequence[Score | JointEffect], count: int) -> Array:
    """Return (N,) s to wait before each view, `_WAITS` in turn; zero where no rival goes with time."""
    views = linear.measurement.views
    effects = [scored.candidate.effect for scored in scores if isinstance(scored, Score)]
    with_time = any("time" in effect.needs or "time" in effect.prefers for effect in effects)
    if not with_time or not views.has("time"):
        return np.zeros(count)
    shares = np.array(_WAITS)[np.arange(count) % len(_WAITS)]
    return np.asarray((shares * float(np.ptp(views.time))).round(-1))


def predict_views(
    linear: LinearModel, scores: Sequence[Score | JointEffect], joints: Array, wait: Array
) -> list[Prediction]:
    """Return each rival's prediction of N further views: twists of surfaces, or reduced numbers of labelled points.

    Args:
        scores: of the rivals.
        joints: (N, n) rad.
        wait: (N,) s before each view, beside the usual pause.
    """
    match linear.observation:
        case SurfaceObservation() as surfaces:
            scans = _further_scans(linear, surfaces, joints, wait)
            return [_predict_scans(linear, scored, scans) for scored in scores]
        case ReducedRows(rows=TargetRows()) as observation:
            named = [scored for scored in scores if isinstance(scored, Score)]
            return _predict_targets(linear, observation, named, joints, wait)
    return []


@dataclass(frozen=True)
class _FurtherScans:
    """N further views of surfaces, and the V that were taken.

    Twists of all views are six rows a view, those taken first: left twists of the pose about the surface's centre,
    reference frame, rotation first; rad and length_unit.
    """

    surfaces: SurfaceObservation  # of the views taken
    measurement: Measurement  # of all views
    columns: Array  # (6 (V + N), a) twists per unit of hand-eye and effects in use
    errors: PoseErrors | None  # of all twists; None: no prior
    flange: Array  # (V + N, 6, 6) adjoints, from a twist of the flange to that of the view

    def beside_taken(self, rows: Array) -> Array:
        """Return the rows (6N, P) of the further views less the mean over those taken, of all rows (6 (V + N), P).

        That mean moves all views together, which no overlap shows.
        """
        of_views = rows.reshape(len(self.flange), 6, -1)
        taken = len(self.surfaces.reduced_poses.reduction[0]) // 6
        return (of_views[taken:] - of_views[:taken].mean(axis=0)).reshape(-1, rows.shape[1])

    def error_covariance(self, base: LinearModel, unnamed: JointEffect | None) -> Array:
        """Return the covariance (6 (V + N), 6 (V + N)) of all twists by scatter of the flange and by pose errors.

        Args:
            base: the model with the variances of these.
            unnamed: a joint without a law, whose variance is the last one of `base`; None: none is there.
        """
        variances = base.null.variances
        white = np.repeat(np.maximum(variances[:NOISE], 1e-300), 3)
        out = block_diag(*((self.flange * white) @ self.flange.transpose(0, 2, 1)))
        if self.errors is None or base.pose_errors is None:
            return out
        components = self.errors.restricted(base.pose_errors.causes).components
        if unnamed is not None:
            # Its random function of variance 1 is found again, by the joints that it follows, among those of all views.
            of_taken, of_all = unnamed.errors, self.errors.joint_processes[unnamed.follows]
            joints = of_taken.joints[unnamed.process], of_taken.others[unnamed.process] if of_taken.others else None
            pairs = list(zip(of_all.joints, of_all.others or (None,) * len(of_all.joints), strict=True))
            components = np.concatenate([components, of_all.twist_covariance(pairs.index(joints))[None]])
        return out + np.einsum("c,cij->ij", variances[NOISE + 1 :], components)

    def noise(self, base: LinearModel) -> Array:
        """Return the covariance (6, 6) of a further view's twist by noise of the surfaces: the mean of views taken."""
        reduced = self.surfaces.reduced_poses
        noise = base.mixed.components[NOISE, 0] * base.null.variances[NOISE]
        if base.mixed.fixed is not None:
            noise = noise + base.mixed.fixed[0]
        covariance = reduced.expansion @ noise @ reduced.expansion.T
        blocks = covariance.reshape(-1, 6, len(covariance) // 6, 6)
        each = np.arange(len(blocks))
        return np.asarray(blocks[each, :, each].mean(axis=0))


def _further_scans(linear: LinearModel, surfaces: SurfaceObservation, joints: Array, wait: Array) -> _FurtherScans:
    """Return further views at joint angles (N, n), rad, after waits (N,), s, beside those of a linear model."""
    both = with_candidates(linear.measurement, candidate_measurement(linear.measurement, joints, wait))
    errors = None
    if linear.pose_errors is not None:
        errors = prior_pose_errors([both], linear.model, [surfaces.centre])
        errors = _with_drift(errors, both, linear.measurement, surfaces.centre)
    hand_eye = hand_eye_jacobian(both.capture, linear.model.T_mount, surfaces.centre)
    columns = np.hstack([hand_eye, _used_columns(linear, both, surfaces.centre)])
    flange = frames.adjoint_about(surfaces.centre, both.capture.T_reference_flange)
    return _FurtherScans(surfaces, both, columns, errors, flange)


def _with_drift(errors: PoseErrors, both: Measurement, taken: Measurement, centre: Array) -> PoseErrors:
    """Return the pose errors of all views with drift that counts time in the usual steps of the views taken.

    Their own steps would be others, since further views are all taken at the end.
    """
    step = usual_time_step(taken)
    time = both.views.time / step if step > 0 else both.views.number.astype(float)
    flange = flange_twists([both], [centre])
    components = errors.components.copy()
    for name, memory in DRIFT_MEMORY.items():
        components[errors.names.index(name)] = process_covariance(flange, exponential_kernel(time, time, memory))
    return replace(errors, components=components)


def _predict_scans(linear: LinearModel, rival: Score | JointEffect, scans: _FurtherScans) -> Prediction:
    """Return what a rival predicts of the twists of further views beside the mean of those taken, m = 6.

    The twists of all views are columns · coefficients + errors, the errors jointly normal. What the views taken show
    gives the coefficients, and a part of the errors (`_condition_on_views`).

    Args:
        rival: an effect as the views taken fit it, or a joint without a law.
    """
    if isinstance(rival, JointEffect):
        base, unnamed, columns = rival.model, rival, scans.columns
    else:
        base, unnamed = model_beside(linear, rival), None
        bare = Model(linear.model.T_mount)
        by_rival = _twists(scans.measurement, bare, zero_term(rival), scans.surfaces.centre)[:, rival.form.keep]
        columns = np.hstack([scans.columns, by_rival])
    columns = scans.beside_taken(columns)
    covariance = scans.error_covariance(base, unnamed)
    reduction = scans.surfaces.reduced_poses.reduction
    with_taken = scans.beside_taken(covariance[:, : reduction.shape[1]] @ reduction.T)
    N = len(columns) // 6
    noise = block_diag(*[scans.noise(base) + 1e-18 * np.eye(6)] * N)
    among_further = scans.beside_taken(scans.beside_taken(covariance).T) + noise
    mean, covariance = _condition_on_views(base, rival, columns, with_taken, among_further)
    design = columns[:, : base.white_design.shape[1]].reshape(N, 6, -1)
    return Prediction(mean.reshape(N, 6), covariance.reshape(N, 6, N, 6), design)


def _used_columns(linear: LinearModel, both: Measurement, centre: Array) -> Array:
    """Return left twists (6 (V + N), U) of all views about `centre` per unit of each of U fitted parameters in use.

    The first six columns of the design, those of the hand-eye, are left out. The design (6V, 6 + U) does not say which
    parameter a column is of: it is the one whose twists of the V views are these. Effects that move points have zeros
    in further views, which have no points.

    Args:
        linear: of the V views taken.
        both: measurement of the V views taken and the N further ones.
        centre: (3,) of the surface, reference frame.
    """
    of_taken = linear.design[:, 6:]
    of_all = np.vstack([of_taken, np.zeros((6 * both.views.count - len(of_taken), of_taken.shape[1]))])
    for term in linear.model.terms:
        if moves_points([term]):
            continue
        of_term = _twists(both, linear.model, term, centre)
        for j, column in enumerate(of_taken.T):
            off = np.linalg.norm(of_term[: len(of_taken)] - column[:, None], axis=0)
            if len(off) and off.min() < 1e-6 * np.linalg.norm(column):
                of_all[:, j] = of_term[:, off.argmin()]
    return of_all


def _twists(measurement: Measurement, model: Model, term: Term, centre: Array) -> Array:
    """Return the twists (6V, P) of all views per unit of each parameter of a term, about a centre (3,)."""
    derivative = next(pose_derivatives(measurement, model, [term], centre))
    return derivative.reshape(len(derivative), -1).T


def _condition_on_views(
    base: LinearModel, scored: Score | JointEffect, columns: Array, with_taken: Array, errors: Array
) -> tuple[Array, Array]:
    """Return mean (M,) and covariance (M, M) of M further numbers given the views taken, for a rival.

    The numbers are columns · coefficients + errors (Rasmussen & Williams 2006, eq. 2.42).

    Args:
        columns: (M, q) of the further numbers: hand-eye and effects in use, then the rival's parameters.
        with_taken: (M, n) covariance of the errors with the reduced observations.
        errors: (M, M) their covariance among each other.
    """
    white, precision = base.white_design, np.zeros(base.white_design.shape[1])
    if isinstance(scored, Score):
        # A rival is of plausible size, or as much larger as it seems to be.
        white = np.column_stack([white, base.whiten(scored.form.columns)])
        precision = np.append(precision, (scored.scale * scored.form.sizes) ** -2.0)
    white_covariance = base.whiten(np.ascontiguousarray(with_taken.T))
    normal, unit = equilibrated(white.T @ white + np.diag(precision))
    values, vectors = np.linalg.eigh(normal)
    root = unit[:, None] * vectors / np.sqrt(np.maximum(values, 1e-12 * values.max()))
    coefficients = root @ (root.T @ (white.T @ base.white_z))
    mean = columns @ coefficients + white_covariance.T @ (base.white_z - white @ coefficients)
    by_coefficients = (columns - white_covariance.T @ white) @ root
    return mean, by_coefficients @ by_coefficients.T + errors - white_covariance.T @ white_covariance


def _predict_targets(
    linear: LinearModel, observation: ReducedRows, scores: Sequence[Score], joints: Array, wait: Array
) -> list[Prediction]:
    """Return the rivals' predictions of N further views that see all targets.

    The m residuals of a view are reduced to the d numbers that a motion of the view, or a rival, can change. Their
    errors are independent of those of all other views.

    Args:
        observation: the targets of the V views taken, reduced.
        scores: of the rivals.
        joints: (N, n) of the further views, rad.
        wait: (N,) s before each of them, beside the usual pause.
    """
    targets = observation.rows
    assert isinstance(targets, TargetRows)
    measurement = candidate_measurement(linear.measurement, joints, wait)
    # by_rival: per rival (N, m, P), change of the further views' rows per unit of its parameters.
    rows, by_rival = candidate_rows(measurement, targets, targets.places, [zero_term(scored) for scored in scores])
    of_points = [moved for scored, moved in zip(scores, by_rival, strict=True) if moves_points([scored.form.term])]
    changes = np.concatenate([rows.lever, *of_points], axis=2)
    per_sigma = np.where(rows.noise > 0, rows.noise, np.inf) ** -0.5
    # (N, d, m). What can change is found in rows divided by their sigmas; the last factor divides those to be reduced.
    reduction = pose_numbers(per_sigma[..., None] * changes) * per_sigma[:, None]
    landmarks = rows.landmarks @ observation.reduction.kept
    # Effects in use stay as they are in the further views.
    zeros_of_effects = np.zeros((*rows.residual.shape, linear.design.shape[1] - 6 - landmarks.shape[2]))
    by_model = np.concatenate([rows.hand_eye, landmarks, zeros_of_effects], axis=2)
    by_flange = [reduction @ moved for moved in rows.scattered]
    predictions = []
    for scored, moved in zip(scores, by_rival, strict=True):
        base = model_beside(linear, scored)
        # (N, d, q): change of the numbers per unit of the model's coefficients, then of the rival's.
        columns = reduction @ np.concatenate([by_model, moved[..., scored.form.keep]], axis=2)
        N, d, q = columns.shape
        # Zero: no view shares errors with another one.
        with_taken = np.zeros((N * d, len(base.white_z)))
        errors = block_diag(*_errors_of_views(base, by_flange))
        mean, covariance = _condition_on_views(base, scored, columns.reshape(-1, q), with_taken, errors)
        design = columns[..., : base.white_design.shape[1]]
        predictions.append(Prediction(mean.reshape(N, d), covariance.reshape(N, d, N, d), design))
    return predictions


def _errors_of_views(base: LinearModel, by_flange: Sequence[Array]) -> Array:
    """Return the covariance (N, d, d) of each view's numbers by the sensor's noise and by scatter of the flange.

    Args:
        by_flange: two (N, d, 3), change of the numbers per rotation and per translation of the flange.
    """
    noise = base.null.variances[NOISE] * np.eye(by_flange[0].shape[1])
    of_scatter = zip(base.flange_scatter(base.null), by_flange, strict=True)
    return sum((variance * (moved @ moved.transpose(0, 2, 1)) for variance, moved in of_scatter), start=noise)


def model_beside(linear: LinearModel, scored: Score) -> LinearModel:
    """Return the model in which a candidate was scored, with the variances that were fitted beside the candidate."""
    if scored.base_model is not None or scored.variances is None:
        return scored.base_model or linear
    base = linear.without([scored.name])
    return replace(base, null=at_variances(base.mixed, scored.variances))


def zero_term(scored: Score) -> Term:
    """Return the term of the candidate's best form, its free parameters at zero."""
    return scored.form.at(np.zeros(len(scored.form.sizes)))
