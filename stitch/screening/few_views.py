"""Whether one of few views is off, weighed against what ordinary arms leave: the odds (a Bayes factor).

Few views leave no scatter to test one of them by. What arms do is known in its sizes: joints and links a little
wrong, wandering, and scatter of the poses, each as large as the priors of `pose_errors.py` say. Under these the
marginal likelihood of what the overlaps show, the hand-eye free, is held against the same with one view displaced,
every view and every size as likely as the others (Kass and Raftery 1995, J. Am. Stat. Assoc. 90:773). Sizes are summed
over, so that an arm that is worse than most is no mistake of a row.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.special import logsumexp

from stitch.model.model import Model
from stitch.numerics.distributions import chi2_tail
from stitch.numerics.frames import Array
from stitch.observations.pose_errors import prior_pose_errors, usual_twist
from stitch.observations.surfaces.scanner_errors import rig_scanner_errors
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.screening.view_model import ViewModel
from stitch.session.measurement import Measurement

# So many views leave too few degrees of freedom for their scatter alone to accuse one of them.
FEW_VIEWS = 8
# Sizes of the arm's errors in those that are usual, of the scatter, and of a displaced view, in usual scatters.
_ARM_SIZES, _SCATTERS, _DISPLACEMENTS = np.geomspace(0.5, 16, 6), np.geomspace(0.5, 4, 4), (10.0, 30.0, 100.0)
# Neighbouring distances share points and normals: the variance of the overlaps' noise in that of independent ones.
_NOISE_FACTOR = 3.0


# Medians and spreads of the logarithm: of an ordinary arm, all joints and links at once, in scales at which one of them
# is likely (0.15 mrad each; 95 % of arms within a factor of four), and of the scatter in usual ones. A prior with more
# room for poor arms takes a row that is off by half a millimetre for one of these.
_ARM_PRIOR, _SCATTER_PRIOR = (1.5, 0.7), (1.0, 0.5)
# Chance that what an ordinary arm leaves is said not to be of one.
_CHANCE = 1e-4


@dataclass(frozen=True)
class FewViews:
    """What few views say against what ordinary arms leave."""

    odds: float  # to one, for a view that is off against an ordinary arm, if both were as likely before
    view: int  # the likeliest
    share: float  # of the probability that it is this one, if one is off
    is_ordinary: bool  # an ordinary arm leaves as much, one time in ten thousand at the least


def weigh_few_views(
    measurement: Measurement, hand_eye: Model, unconstrained: UnconstrainedPoses, model: ViewModel
) -> FewViews:
    """Return the odds that one of few views is off its pose, against ordinary errors of an arm: a Bayes factor.

    Numerator: the mean, over views and sizes of a displacement, of the marginal likelihood with this view displaced.
    Denominator: the same without any displacement. Both integrate over the sizes of the arm's errors and of white
    scatter; the scanner's errors have fixed sizes.

    Args:
        hand_eye: hand-eye and effects in use, about which the errors of the arm are linearised.
        unconstrained: the views moved by the overlaps alone.
        model: linear model of what these say about the poses.
    """
    errors = prior_pose_errors([measurement], hand_eye, [model.centre]).of_ordinary_arm.project(model.reduced.reduction)
    usual = errors.scales[:, None, None] ** 2 * errors.components
    rotation, translation = usual_twist(measurement.length_unit)[[0, 3]]
    white = rotation**2 * model.reduced.rotation + translation**2 * model.reduced.translation
    scanner = np.hstack([columns[0] for columns in rig_scanner_errors([measurement], [unconstrained]).values()])
    smooth = model.reduced.reduction @ scanner
    z, A = model.z, model.mixed().A[0]
    fixed = _NOISE_FACTOR * model.reduced.noise + smooth @ smooth.T
    varying = usual[errors.arm_components].sum(axis=0), white + usual[~errors.arm_components].sum(axis=0)
    without, square = _evidence(z, A, fixed, *varying)
    sizes = translation * np.array(_DISPLACEMENTS)
    each = []
    for columns in model.views:
        # Shifted, or shifted and turned by as much at the part.
        moved = [size * part for size in sizes for part in (columns, columns[:, 3:])]
        evidence = [_evidence(z, A, fixed + part @ part.T, *varying)[0] for part in moved]
        each.append(logsumexp(evidence) - np.log(len(moved)))
    best = int(np.argmax(each))
    log_odds = float(logsumexp(each)) - np.log(len(each)) - without
    degrees = len(z) - A.shape[1]
    return FewViews(
        odds=float(np.exp(np.clip(log_odds, -300, 300))),
        view=best,
        share=float(np.exp(each[best] - logsumexp(each))),
        is_ordinary=chi2_tail(square, degrees) > _CHANCE,
    )


def _evidence(z: Array, A: Array, fixed: Array, arm: Array, scatter: Array) -> tuple[float, float]:
    """Return the log restricted likelihood of z (n,), summed over sizes of the errors, and the least χ² among these.

    z = A ξ + e with cov e = fixed + a²·arm + s²·scatter, for a and s on a grid, weighted by log-normal priors.

    Args:
        A: (n, r) columns of the free hand-eye.
        fixed: (n, n) covariance that is known.
        arm, scatter: (n, n) covariances that errors of the arm, and white scatter, add at their usual size.
    """
    logs = list[float]()
    squares = list[float]()
    for arm_size, size in product(_ARM_SIZES, _SCATTERS):
        C = fixed + arm_size**2 * arm + size**2 * scatter
        CA = np.linalg.solve(C, A)
        Cz = np.linalg.solve(C, z)
        mean = A.T @ CA
        square = float(z @ Cz - Cz @ A @ np.linalg.solve(mean, A.T @ Cz))
        sizes = ((arm_size, *_ARM_PRIOR), (size, *_SCATTER_PRIOR))
        prior = sum(-0.5 * (np.log(value / median) / spread) ** 2 for value, median, spread in sizes)
        logs.append(prior - 0.5 * (np.linalg.slogdet(C)[1] + np.linalg.slogdet(mean)[1] + square))
        squares.append(square)
    return float(logsumexp(logs)), min(squares)
