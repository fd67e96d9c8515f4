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

from stitch.diagnosis.candidate_views import (
    candidate_measurement,
    candidate_rows,
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

# Poses that are tried, and again close to the best of them.
_TRIED, _CLOSER, _BEST = 72, 24, 3
# Times that poses are sought, until there are enough to try.
_SEARCHES = 6
# How much a pose sees is asked of so many points of the scans; less than this share of what the views see is too
# little, and of a surface that is turned farther away (cosine) nothing is seen. The field reaches a tenth farther.
_POINTS, _LEAST_SEEN, _FACING, _MARGIN = 300, 0.5, 0.2, 0.1
# Views that are proposed at the most, and the odds at which one more is not needed.
MOST_VIEWS, SURE = 3, 0.95
# A view that adds less than this to the probability that the true one is named is not worth driving to.
_WORTH = 0.02
# Draws of each rival for the search, and for the odds that are stated.
_SEARCH_DRAWS, _STATED_DRAWS = 96, 2000
# Forms of a rival that compete, of those within so many nats of its best.
_FORMS, _NEAR_FORMS = 5, 6.0
# What a joint without a law may follow, of which a pose alone tells what is expected there.
_BY_POSE = (ALL_ANGLES, OWN_ANGLE, TWO_ANGLES)
# Shares of the session's duration that one may wait where a rival goes with time.
_WAITS = (0.0, 0.5, 1.0, 2.0)


@dataclass(frozen=True)
class DecidingViews:
    """Further views in the order in which they are taken."""

    joints: Array  # (K, n) rad
    wait: Array  # (K,) s after the last view that there is, beside the usual pause
    probability: Array  # (K,) that the true rival is named after the view and those before it


@dataclass(frozen=True)
class Prediction:
    """What a rival expects of N further views, m numbers each."""

    mean: Array  # (N, m)
    unknown: Array  # (N, m, q) root of the covariance by what the rival does not know of itself
    shared: Array | None  # (N, m, N, m) covariance of all else; None: independent between views
    own: Array  # (N, m, m) covariance of each view beside
    design: Array  # (N, m, a) of hand-eye and effects in use

    def of(self, chosen: Sequence[int], more: Indices) -> tuple[Array, Array]:
        """Return mean (C, D) and covariance (C, D, D) of the chosen views, each time with one of `more` (C,)."""
        stacks = np.column_stack([np.tile(np.array(chosen, np.int64), (len(more), 1)), more])
        C, k = stacks.shape
        m = self.mean.shape[1]
        roots = self.unknown[stacks].reshape(C, k * m, -1)
        covariance = roots @ roots.transpose(0, 2, 1)
        blocks = covariance.reshape(C, k, m, k, m)
        if self.shared is not None:
            blocks += self.shared[stacks[:, :, None], :, stacks[:, None, :]].transpose(0, 1, 3, 2, 4)
        each = np.arange(k)
        blocks[:, each, :, each] += self.own[stacks].transpose(1, 0, 2, 3)
        return self.mean[stacks].reshape(C, k * m), covariance


def deciding_views(
    linear: LinearModel, rivals: Sequence[Ranked], most: int = MOST_VIEWS, undecided: int = 0
) -> DecidingViews | None:
    """Return the further views after which one of the rivals is most likely named; None where no pose tells them apart.

    Poses within reach, near those driven, from which the scanner sees the part as it has before.

    Args:
        undecided: so many rivals, the first, are held undecided by a verdict. Where the evidence so far would have
            decided between them, it did not count there: then they are taken for equally likely.
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
    first, single = _choose(linear, forms, joints, most)
    best = joints[np.argsort(-single, kind="stable")[:_BEST]]
    closer = possible_joints(linear, best)[:_CLOSER]
    both = np.concatenate([best, first.joints, closer])
    views, _ = _choose(linear, forms, np.unique(both.round(9), axis=0), most)
    return views if len(views.joints) else None


def unnamed_joints(linear: LinearModel, scores: Sequence[Score]) -> list[tuple[JointEffect, float]]:
    """Return what single joints may do that follow the pose by no known law, beside none of the rivals, the likeliest
    with their log posteriors; [] where the views tell of none."""
    base = linear.without([scored.name for scored in scores])
    effects = joint_effects(base)
    followed = [effect for effect in effects if effect.follows in _BY_POSE][:_FORMS]
    factors = np.array([effect.log_bayes_factor for effect in followed])
    shares = log_posterior_of_any(factors[None]) - np.log(max(len(effects), 1))
    return [each for each in zip(followed, shares.tolist(), strict=True) if each[1] > shares.max() - _NEAR_FORMS]


@dataclass(frozen=True)
class RivalForms:
    """Forms of all rivals, each as a score of its own; the last rival may be a joint without a law."""

    scores: list[Score | JointEffect]
    log_weights: Array  # (F,) not normalised
    rival: Indices  # (F,) whose form it is
    log_belief: Array  # (R,) how often each rival is met, a judgement that decides nothing by itself
    named: int  # so many rivals, the first, have a name

    def margins(self, fits: Array) -> Array:
        """Return (R, …) by how much each rival is ahead of all others, from log posteriors (R, …) of all.

        Ahead by what the views say, and by that and what is believed.
        """
        others = [np.delete(np.arange(len(fits)), r) for r in range(len(fits))]
        held = [np.minimum(self.log_belief[r] - self.log_belief[some], 0.0) for r, some in enumerate(others)]
        return np.array(
            [
                (fits[r] - fits[some] + held[r].reshape(-1, *[1] * (fits.ndim - 1))).min(axis=0)
                for r, some in enumerate(others)
            ]
        )


def competing_forms(
    scores: Sequence[Score],
    log_weights: Array,
    log_belief: Sequence[float] = (),
    unnamed: Sequence[tuple[JointEffect, float]] = (),
) -> RivalForms:
    """Return the likeliest forms of each rival, which share its weight (R,), and of joints without a law as one more.

    Args:
        log_belief: of each rival; () where all are met alike.
    """
    forms = list[Score | JointEffect]()
    weights = list[float]()
    rival = list[int]()
    for r, scored in enumerate(scores):
        every, shares = scored.candidate.forms, scored.log_shares
        if shares is None:
            every, shares = (scored.form,), np.zeros(1)
        likeliest = np.argsort(-shares, kind="stable")[:_FORMS]
        kept = [i for i in likeliest if shares[i] > shares.max() - _NEAR_FORMS and every[i].columns.any()]
        of_rival = log_weights[r] + shares[kept] - np.logaddexp.reduce(shares[kept])
        forms += [replace(scored, form=every[i]) for i in kept]
        weights += of_rival.tolist()
        rival += [r] * len(kept)
    forms += [effect for effect, _ in unnamed]
    weights += [weight for _, weight in unnamed]
    rival += [len(scores)] * len(unnamed)
    belief = np.zeros(max(rival) + 1)
    belief[: len(log_belief)] = log_belief
    return RivalForms(forms, np.array(weights), np.array(rival), belief, len(scores))


def _choose(linear: LinearModel, forms: RivalForms, joints: Array, most: int) -> tuple[DecidingViews, Array]:
    """Return the views that are chosen one after the other among joints (N, n), and (N,) the mean probability of the
    true rival after each alone."""
    wait = _waits(linear, forms.scores, len(joints))
    predictions = predict_views(linear, forms.scores, joints, wait)
    m = predictions[0].mean.shape[1]
    every: Indices = np.arange(len(joints), dtype=np.int64)
    rng = np.random.default_rng(0)
    weights = np.exp(forms.log_weights - forms.log_weights.max())
    true_share = float(np.sum((np.bincount(forms.rival, weights) / weights.sum()) ** 2))
    chosen = list[int]()
    probability = list[float]()
    single = np.zeros(len(joints))
    while len(chosen) < min(most, len(joints)) and (not probability or probability[-1] < SURE):
        draws = rng.standard_normal((_SEARCH_DRAWS, (len(chosen) + 1) * m))
        of_true = _decisions(predictions, forms, chosen, every, draws)[2]
        of_true[chosen] = -1.0
        if not chosen:
            single = of_true
        k = int(of_true.argmax())
        stated = rng.standard_normal((_STATED_DRAWS, (len(chosen) + 1) * m))
        right, _, share = _decisions(predictions, forms, chosen, every[k : k + 1], stated)
        if share[0] < true_share + _WORTH:
            break
        chosen.append(k)
        probability.append(float(right[0]))
        true_share = float(share[0])
    return DecidingViews(joints[chosen], wait[chosen], np.array(probability)), single


def _decisions(
    predictions: Sequence[Prediction], forms: RivalForms, chosen: Sequence[int], more: Indices, draws: Array
) -> tuple[Array, Array, Array]:
    """Return for each of `more` (C,) the probabilities that the true rival is named after it, that a wrong one is, and
    the mean probability of the true one.

    Args:
        draws: (S, D) standard normal numbers, the same for all.
    """
    parts = [prediction.of(chosen, more) for prediction in predictions]
    halves = [np.linalg.cholesky(covariance) for _, covariance in parts]
    inverses = [np.linalg.inv(half) for half in halves]
    sizes = [np.log(np.diagonal(half, axis1=1, axis2=2)).sum(axis=1) for half in halves]
    weights = np.exp(forms.log_weights - forms.log_weights.max())
    weights = weights / weights.sum()
    rivals = range(int(forms.rival.max()) + 1)
    right, wrong, share = np.zeros((3, len(more)))
    for weight, true, (mean, _), half in zip(weights, forms.rival, parts, halves, strict=True):
        seen = mean[:, None] + draws @ half.transpose(0, 2, 1)
        of_forms = np.array(
            [
                log_weight
                - size[:, None]
                - 0.5 * np.sum(((seen - other[:, None]) @ back.transpose(0, 2, 1)) ** 2, axis=2)
                for log_weight, size, (other, _), back in zip(forms.log_weights, sizes, parts, inverses, strict=True)
            ]
        )
        fits = np.array([np.logaddexp.reduce(of_forms[forms.rival == r], axis=0) for r in rivals])
        decided = forms.margins(fits) > ODDS
        right += weight * decided[true].mean(axis=1)
        others = [r for r in range(forms.named) if r != true]
        wrong += weight * decided[others].any(axis=0).mean(axis=1)
        share += weight * np.exp(fits[true] - np.logaddexp.reduce(fits, axis=0)).mean(axis=1)
    return right, wrong, share


def possible_joints(linear: LinearModel, chosen: Array | None = None) -> Array:
    """Return (K, n) joint angles, rad, near those driven, or closer to chosen ones, from which the part is seen."""
    driven = linear.measurement.views.joints
    observation = linear.observation
    if not isinstance(observation, SurfaceObservation):
        return nearby(driven, chosen)
    T_mount = linear.model.T_mount

    def poses_of(joints: Array) -> Array:
        assert linear.measurement.robot is not None
        T = forward(linear.measurement.robot, joints)
        return build_capture("candidates", (), T, linear.measurement.mount).poses(T_mount)

    seen_from = observation.capture.poses(T_mount)
    least = _LEAST_SEEN * np.median(seen_shares(observation, seen_from, seen_from))
    found = np.zeros((0, driven.shape[1]))
    for seed in range(_SEARCHES):
        joints = reachable(driven, poses_of, seen_from, observation.centre, chosen, seed)
        joints = joints[seen_shares(observation, seen_from, poses_of(joints)) > least] if len(joints) else joints
        found = np.concatenate([found, joints])
        if len(found) >= _TRIED:
            break
    return found


def seen_shares(observation: SurfaceObservation, seen_from: Array, poses: Array) -> Array:
    """Return (K,) share of the scanned surface that faces the scanner, within its field, at poses (K, 4, 4).

    Args:
        seen_from: T_reference_scanner (V, 4, 4) of the scans.
    """
    scans = observation.capture.scans
    of_each = [np.linspace(0, len(scan.points) - 1, max(_POINTS // len(scans), 1)).astype(int) for scan in scans]
    some = list(zip(seen_from, scans, of_each, strict=True))
    points = np.concatenate([frames.transform(T, scan.points[i]) for T, scan, i in some])
    normals = np.concatenate([scan.normals[i] @ T[:3, :3].T for T, scan, i in some])
    boxes = np.array([scan.box for scan in scans])
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    low, high = low - _MARGIN * (high - low), high + _MARGIN * (high - low)
    there = frames.transform(frames.inverse(poses), points)
    sight = some[0][1].eye - there
    facing = np.einsum("kmi,kmi->km", normals @ poses[:, :3, :3], sight) > _FACING * np.linalg.norm(sight, axis=2)
    return np.asarray((facing & (there > low).all(axis=2) & (there < high).all(axis=2)).mean(axis=1))


def _waits(linear: LinearModel, scores: Sequence[Score | JointEffect], count: int) -> Array:
    """Return (N,) s that one waits before each view; none where no rival goes with time."""
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
    """Return what each rival expects of views at joints (N, n)."""
    match linear.observation:
        case SurfaceObservation() as surfaces:
            further = _FurtherScans.of(linear, surfaces, joints, wait)
            return [_predict_scans(linear, scored, further) for scored in scores]
        case ReducedRows(rows=TargetRows()) as observation:
            named = [scored for scored in scores if isinstance(scored, Score)]
            return _predict_targets(linear, observation, named, joints, wait)
    return []


@dataclass(frozen=True)
class _FurtherScans:
    """V views of surfaces and N further ones."""

    surfaces: SurfaceObservation
    measurement: Measurement  # of V + N
    errors: PoseErrors | None  # of their twists, not reduced
    flange: Array  # (V + N, 6, 6) adjoint of the flange

    @classmethod
    def of(cls, linear: LinearModel, surfaces: SurfaceObservation, joints: Array, wait: Array) -> "_FurtherScans":
        """Return further views at joint angles (N, J), rad, after waits (N,), s, beside those of a linear model."""
        further = candidate_measurement(linear.measurement, joints, wait)
        every = with_candidates(linear.measurement, further)
        errors = None
        if linear.pose_errors is not None:
            errors = prior_pose_errors([every], linear.model, [surfaces.centre])
            errors = _with_drift(errors, every, linear.measurement, surfaces.centre)
        to_centre = frames.make(np.eye(3), -surfaces.centre)
        flange = frames.adjoint(to_centre @ every.capture.T_reference_flange)
        return cls(surfaces, every, errors, flange)

    @property
    def before(self) -> int:
        """6V numbers of the views that there are."""
        return len(self.surfaces.reduced_poses.reduction[0])

    def further(self, columns: Array) -> Array:
        """(6N, P) of the further views, less the mean motion (6, P) of the others, of columns (6 (V + N), P)."""
        mean = columns[: self.before].reshape(-1, 6, columns.shape[1]).mean(axis=0)
        return columns[self.before :] - np.tile(mean, ((len(columns) - self.before) // 6, 1))

    def covariance(self, base: LinearModel, unnamed: JointEffect | None) -> Array:
        """Return the covariance (6 (V + N), 6 (V + N)) of the twists of V views and N further ones by errors of poses.

        Args:
            base: whose variances they have.
            unnamed: a joint that errs by no known law beside them.
        """
        variances = base.null.variances
        n = 6 * len(self.flange)
        blocks = np.zeros((len(self.flange), 6, len(self.flange), 6))
        each = np.arange(len(self.flange))
        white = np.repeat(np.maximum(variances[:NOISE], 1e-300), 3)
        blocks[each, :, each] = (self.flange * white) @ self.flange.transpose(0, 2, 1)
        out = blocks.reshape(n, n)
        if self.errors is not None and base.pose_errors is not None:
            components = self.errors.restricted(base.pose_errors.causes).components
            if unnamed is not None:
                components = np.concatenate([components, self._of_joint(unnamed)[None]])
            out = out + np.einsum("c,cij->ij", variances[NOISE + 1 :], components)
        return out

    def _of_joint(self, unnamed: JointEffect) -> Array:
        """(6 (V + N), 6 (V + N)) of the twists by a joint without a law, of unit variance."""
        assert self.errors is not None
        here, every = unnamed.errors, self.errors.joint_processes[unnamed.follows]
        own = here.joints[unnamed.process], here.others[unnamed.process] if here.others else None
        same = list(zip(every.joints, every.others or (None,) * len(every.joints), strict=True)).index(own)
        return every.twist_covariance(same)

    def noise(self, base: LinearModel) -> Array:
        """Return the covariance (6, 6) of a further view's twist by noise of the surfaces: the mean of those so far."""
        expansion = self.surfaces.reduced_poses.expansion
        noise = base.mixed.components[NOISE, 0] * base.null.variances[NOISE]
        if base.mixed.fixed is not None:
            noise = noise + base.mixed.fixed[0]
        blocks = (expansion @ noise @ expansion.T).reshape(-1, 6, self.before // 6, 6)
        each = np.arange(len(blocks))
        return np.asarray(blocks[each, :, each].mean(axis=0))


def _with_drift(errors: PoseErrors, every: Measurement, before: Measurement, centre: Array) -> PoseErrors:
    """Return the errors with what wanders counted in the steps of the views that there are."""
    step = usual_time_step(before)
    time = every.views.time / step if step > 0 else every.views.number.astype(float)
    flange = flange_twists([every], [centre])
    components = errors.components.copy()
    for name, memory in DRIFT_MEMORY.items():
        components[errors.names.index(name)] = process_covariance(flange, exponential_kernel(time, time, memory))
    return replace(errors, components=components)


def _predict_scans(linear: LinearModel, scored: Score | JointEffect, scans: _FurtherScans) -> Prediction:
    """Return what further views would show of their poses if an effect, as these views fit it, were there.

    Args:
        scored: the effect, or a joint that errs without a name.
        scans: the further views, beside those that there are.

    Returns:
        Mean (N, 6) of the left twists of the further views about the centre, how it answers to what is unknown,
        covariance that the views share, that of each alone, and how they answer to hand-eye and effects in use.
    """
    unnamed = scored if isinstance(scored, JointEffect) else None
    base = scored.model if isinstance(scored, JointEffect) else model_beside(linear, scored)
    measurement, bare, centre = scans.measurement, Model(linear.model.T_mount), scans.surfaces.centre
    hand_eye = hand_eye_jacobian(measurement.capture.hand_eye_frames(bare.T_mount), centre)
    every = [hand_eye, _used_columns(linear, scans)]
    if isinstance(scored, Score):
        every.append(_twists(measurement, bare, zero_term(scored), centre)[:, scored.form.keep])
    columns = scans.further(np.hstack(every))
    covariance = scans.covariance(base, unnamed)
    across = scans.further(covariance[:, : scans.before] @ scans.surfaces.reduced_poses.reduction.T)
    together = scans.further(scans.further(covariance).T)
    N = len(columns) // 6
    own = np.broadcast_to(scans.noise(base) + 1e-18 * np.eye(6), (N, 6, 6))
    mean, unknown, explained = _given_views(base, scored, columns, across)
    shared = (together - explained).reshape(N, 6, N, 6)
    design = columns[:, : base.white_design.shape[1]].reshape(N, 6, -1)
    return Prediction(mean.reshape(N, 6), unknown.reshape(N, 6, -1), shared, own, design)


def _used_columns(linear: LinearModel, scans: _FurtherScans) -> Array:
    """Return how the twists of views and further ones answer to the effects in use, (6 (V + N), a − 6).

    Columns of the fit are found again among those of each effect; further views answer only to what moves poses.
    """
    design = linear.design[:, 6:]
    out = np.vstack([design, np.zeros((6 * len(scans.flange) - len(design), design.shape[1]))])
    for term in linear.model.terms:
        if moves_points([term]):
            continue
        twists = _twists(scans.measurement, linear.model, term, scans.surfaces.centre)
        for j, column in enumerate(design.T):
            off = np.linalg.norm(twists[: len(design)] - column[:, None], axis=0)
            if len(off) and off.min() < 1e-6 * np.linalg.norm(column):
                out[:, j] = twists[:, off.argmin()]
    return out


def _twists(measurement: Measurement, model: Model, term: Term, centre: Array) -> Array:
    """(6V, P) twists of all views per unit of each parameter of a term."""
    derivative = next(pose_derivatives(measurement, model, [term], centre))
    return derivative.reshape(len(derivative), -1).T


def _given_views(
    base: LinearModel, scored: Score | JointEffect, columns: Array, across: Array
) -> tuple[Array, Array, Array]:
    """Return mean (M,) of further numbers given those that were seen, the root (M, q) of what is not known of the
    coefficients, and the covariance (M, M) that the seen ones explain.

    Args:
        columns: (M, q) of the further numbers: hand-eye and effects in use, then the rival's parameters.
        across: (M, n) covariance with the reduced observations.
    """
    white, precision = base.white_design, np.zeros(base.white_design.shape[1])
    if isinstance(scored, Score):
        # A rival is of plausible size, or as much larger as it seems to be.
        white = np.column_stack([white, base.whiten(scored.form.columns)])
        precision = np.append(precision, (scored.scale * scored.form.sizes) ** -2.0)
    seen = base.whiten(np.ascontiguousarray(across.T))
    normal, unit = equilibrated(white.T @ white + np.diag(precision))
    values, vectors = np.linalg.eigh(normal)
    root = unit[:, None] * vectors / np.sqrt(np.maximum(values, 1e-12 * values.max()))
    coefficients = root @ (root.T @ (white.T @ base.white_z))
    mean = columns @ coefficients + seen.T @ (base.white_z - white @ coefficients)
    return mean, (columns - seen.T @ white) @ root, seen.T @ seen


def _predict_targets(
    linear: LinearModel, observation: ReducedRows, scores: Sequence[Score], joints: Array, wait: Array
) -> list[Prediction]:
    """Return what rivals expect where all targets are seen, in numbers that a motion of the view or a rival moves.

    Beside a rival views err independently.
    """
    targets = observation.rows
    assert isinstance(targets, TargetRows)
    measurement = candidate_measurement(linear.measurement, joints, wait)
    rows, columns = candidate_rows(measurement, targets, targets.places, [zero_term(scored) for scored in scores])
    within = [moved for scored, moved in zip(scores, columns, strict=True) if moves_points([scored.form.term])]
    per_sigma = np.where(rows.noise > 0, rows.noise, np.inf) ** -0.5
    turn = pose_numbers(per_sigma[..., None] * np.concatenate([rows.lever, *within], axis=2)) * per_sigma[:, None]
    placed = rows.landmarks @ observation.reduction.kept
    extra = np.zeros((*rows.residual.shape, linear.design.shape[1] - 6 - placed.shape[2]))
    scattered = [turn @ moved for moved in rows.scattered]
    predictions = []
    for scored, moved in zip(scores, columns, strict=True):
        base = model_beside(linear, scored)
        every = turn @ np.concatenate([rows.hand_eye, placed, extra, moved[..., scored.form.keep]], axis=2)
        N, d, q = every.shape
        mean, unknown, _ = _given_views(base, scored, every.reshape(-1, q), np.zeros((N * d, len(base.white_z))))
        own = base.null.variances[NOISE] * np.broadcast_to(np.eye(d), (N, d, d)).copy()
        for variance, of_flange in zip(base.flange_scatter(base.null), scattered, strict=True):
            own += variance * (of_flange @ of_flange.transpose(0, 2, 1))
        design = every[..., : base.white_design.shape[1]]
        predictions.append(Prediction(mean.reshape(N, d), unknown.reshape(N, d, -1), None, own, design))
    return predictions


def model_beside(linear: LinearModel, scored: Score) -> LinearModel:
    """Return the model with the variances that are left beside a candidate."""
    if scored.base_model is not None or scored.variances is None:
        return scored.base_model or linear
    base = linear.without([scored.name])
    return replace(base, null=at_variances(base.mixed, scored.variances))


def zero_term(scored: Score) -> Term:
    """Return the candidate's best form at zero."""
    return scored.form.at(np.zeros(len(scored.form.sizes)))
