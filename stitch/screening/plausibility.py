"""What no arm does, and what to say of a session whose poses contradict its scans: limits, few views, rounded tables.

Limits in metres and radians are what arms in use stay far below; below them the session's own scatter decides.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import METRES, angle_text, length_text
from stitch.observations.pose_errors import usual_twist
from stitch.screening.background import find_occluder, find_static_background
from stitch.screening.hypotheses import BOTH_ORDERS, euler_angles, problem, sentence
from stitch.screening.problems import SessionProblem, displacement_text, list_views
from stitch.screening.snooping import MisplacedView, Snooping
from stitch.session.capture import part_size
from stitch.session.session import SessionData

# No arm scatters by more.
_ROTATION, _TRANSLATION_M = 0.010, 0.005
# No effect of an arm is believed to displace a single view by more than half of that.
_VIEW_ROTATION, _VIEW_M = 0.005, 0.0025
_NUMBERS = {2: "two", 3: "three", 4: "four", 5: "five", 6: "six", 7: "seven", 8: "eight"}
# Odds from which a doubt is said: good sessions on ordinary arms reach a half in 4 of 55. The largest odds that are
# told, and the share of the probability from which one view is named.
_DOUBTED_FROM, _MOST_ODDS, _LIKELY_VIEW = 0.5, 1000.0, 0.9
# Views that are named as farthest off.
_LISTED = 3
# Rounding explains a scatter that differs from what it makes by no more than this factor, up or down.
_TIMES_ROUNDING = 2.0
# Of a step: numbers that are whole within this were rounded. By chance one row in thousands is.
_WHOLE = 2e-3
_MOST_DECIMALS = 3
# Below so many views chance makes whole numbers.
_FEWEST_ROUNDED = 3
_DECIMALS = {0: "no decimals", 1: "one decimal", 2: "two decimals", 3: "three decimals"}


def beyond_any_arm(session: SessionData, rotation: float, translation: float) -> bool:
    """Return True if a rotation (rad) or a translation (length_unit) is larger than what any arm does."""
    return rotation > _ROTATION or translation > _TRANSLATION_M / METRES[session.length_unit]


def beyond_effects(session: SessionData, rotation: float, translation: float) -> bool:
    """Return True if no effect of an arm is believed to displace a single view so far (rad, length_unit)."""
    return rotation > _VIEW_ROTATION or translation * METRES[session.length_unit] > _VIEW_M


def apply_displacement_limits(session: SessionData, snooping: Snooping) -> Snooping:
    """Return the findings with suspected views counted as misplaced if an effect of the arm cannot explain them.

    That is so if the smallest displacement that their evidence admits is larger than what effects do.
    """
    beyond = [m for m in snooping.suspected if beyond_effects(session, *m.at_least)]
    return replace(
        snooping,
        misplaced=tuple(sorted((*snooping.misplaced, *beyond), key=lambda m: m.view)),
        suspected=tuple(m for m in snooping.suspected if m not in beyond),
    )


def poses_contradict_scans(session: SessionData, snooping: Snooping) -> bool:
    """Return True if the poses contradict the scans beyond what any arm does."""
    lost = len(snooping.not_belonging) > len(session.views) / 2
    return lost or (beyond_any_arm(session, snooping.rotation, snooping.translation) and not is_ordinary(snooping))


def scatters_beyond_effects(session: SessionData, snooping: Snooping) -> bool:
    """Return True if the poses scatter as no effect of an arm is believed to make them."""
    return beyond_effects(session, snooping.rotation, snooping.translation) and not is_ordinary(snooping)


def is_ordinary(snooping: Snooping) -> bool:
    """Return True if few views contradict their poses by no more than an ordinary arm leaves.

    A scatter that few overlaps hardly hold may be estimated at anything; what they do show decides.
    """
    return snooping.few is not None and snooping.few.is_ordinary


def scatter_in_words(session: SessionData, snooping: Snooping) -> str:
    """Return the scatter by which the poses contradict the scans, in words."""
    return f"{1e3 * snooping.rotation:.3g} mrad and {snooping.translation:.3g} {session.length_unit}"


def suspicion_in_words(session: SessionData, view: MisplacedView) -> str:
    """Return how far a suspected view is off, in words."""
    amount = displacement_text(view.at_least, view.at_least, session.length_unit)
    return f"is off by at least {amount}" if amount else "is off by an amount that its surface does not show"


def snooping_warnings(session: SessionData, snooping: Snooping) -> tuple[str, ...]:
    """Return warnings about the session as a whole: one about pose errors at the most, then background, then steps.

    Args:
        snooping: the outlier tests of every view's pose (data snooping).
    """
    pose_errors = _pose_error_warning(session, snooping)
    background = (found.fix for found in background_problems(session, snooping))
    steps = (step.describe(session.names, session.length_unit) for step in snooping.steps)
    return (*([pose_errors] if pose_errors else []), *background, *steps)


def _pose_error_warning(session: SessionData, snooping: Snooping) -> str | None:
    """Return the first of three warnings about pose errors that applies, or None.

    1. Rounding of the table explains the scatter: then neither the arm nor any view is to blame.
    2. The poses scatter beyond what effects of an arm do: then odds against an ordinary arm mean nothing.
    3. The views are too few to tell, or one of few is off (`check_few_views`).
    """
    rounding = rounding_that_explains(session, snooping)
    if rounding is not None:
        return f"{rounding.describe()}."
    if scatters_beyond_effects(session, snooping):
        return _implausible_scatter(session, snooping)
    return check_few_views(session, snooping)


def background_problems(session: SessionData, snooping: Snooping) -> list[SessionProblem]:
    """Return what the scans show beside the part, as problems: background that stands still, or things in the way.

    Things in the way are only sought if there is no background, and no view is left out or displaced.
    """
    scans = snooping.capture.scans
    size = part_size([snooping.capture])
    names = session.names
    model_poses = snooping.capture.poses(snooping.T_mount)
    background = find_static_background(scans, model_poses, snooping.tolerance, size)
    if background is not None:
        share, views, box, within = background
        sides = (f"{axis} {low:.4g} to {high:.4g}" for axis, low, high in zip("xyz", *box, strict=True))
        how = f"cut {', '.join(sides)} {session.length_unit} out of the scans"
        if within is not None:
            low, high = (", ".join(f"{side:.4g}" for side in corner) for corner in within)
            how = f"state within = [[{low}], [{high}]] under [scanner] in session.toml"
        showing = [names[v] for v in views]
        return [problem("background", showing, share=share, count=len(showing), how=how)]
    if snooping.left_out or snooping.steps:
        # The part itself stands elsewhere where a view is off; without that view it is asked again.
        return []
    occluder = find_occluder(scans, snooping.unconstrained.poses, size)
    if occluder is None:
        return []
    views, share = occluder
    named = [names[v] for v in views]
    show = "shows" if len(named) == 1 else "show"
    return [problem("in the way", named, share=share, where=list_views(named, names), show=show)]


def _implausible_scatter(session: SessionData, snooping: Snooping) -> str:
    """Return a warning of poses that scatter more than those of any arm, with the views farthest from their pose."""
    model_poses = snooping.capture.poses(snooping.T_mount)
    twists = frames.log(snooping.unconstrained.poses @ frames.inverse(model_poses))
    middles = np.array([points.mean(axis=0) for points in snooping.capture.visible_points])
    in_reference = frames.transform(model_poses, middles[:, None])[:, 0]
    displacement = np.linalg.norm(twists[:, 3:] + np.cross(twists[:, :3], in_reference), axis=1)
    worst = [v for v in np.argsort(-displacement) if v not in snooping.left_out][:_LISTED]
    farthest = ", ".join(f"{session.names[v]} ({displacement[v]:.3g} {session.length_unit})" for v in worst)
    return sentence("implausible scatter", by=scatter_in_words(session, snooping), farthest=farthest)


def check_few_views(session: SessionData, snooping: Snooping) -> str | None:
    """Return a warning that few views cannot show a wrong pose, or that one of them may be wrong; None without either.

    There are four: no test is possible; the views overlap too little; one view is off, by odds against ordinary errors
    of an arm; the same, and which one it is. None if a view is left out, if there are enough views for the tests, or if
    the odds are below `_DOUBTED_FROM`.
    """
    views = len(session.views)
    unit = session.length_unit
    count = _NUMBERS.get(views, str(views))
    if snooping.left_out:
        return None
    if snooping.blunder_search.null_projector.degrees < 1:
        return sentence("no test", count=count)
    few = snooping.few
    if few is None:
        return None
    if few.is_ordinary and beyond_effects(session, snooping.rotation, snooping.translation):
        return sentence("little overlap", count=count)
    if few.odds < _DOUBTED_FROM:
        return None
    by = f"{length_text(snooping.translation, unit, 2)} and {angle_text(snooping.rotation, 2)}"
    words = {
        "count": count.capitalize(),
        "by": by,
        "odds": f"{min(few.odds, _MOST_ODDS):.{0 if few.odds > 9 else 1}f}",
        "few": count,
    }
    if few.share < _LIKELY_VIEW:
        return sentence("few views", **words)
    off = (f" ({suspicion_in_words(session, m)})" for m in snooping.suspected if m.view == few.view)
    return sentence("one of few views", view=session.names[few.view] + next(off, ""), **words)


@dataclass(frozen=True)
class Rounding:
    """Rotations that were written with few decimals."""

    kind: str  # quaternion | euler, as a problem is called
    decimals: int
    rotation: float  # rad, by which rounding turns each pose about an axis, rms

    def describe(self) -> str:
        """Return what rounding alone does, and what to do."""
        numbers = "quaternions" if self.kind == "quaternion" else "angles"
        return sentence("rounded", numbers=numbers, decimals=_DECIMALS[self.decimals], rotation=1e3 * self.rotation)


def rounding_that_explains(session: SessionData, snooping: Snooping) -> Rounding | None:
    """Return the rounding of the table's rotations if it explains the scatter of the poses; else None.

    It must exceed the usual scatter of arms, and agree with the scatter found within a factor of `_TIMES_ROUNDING`.
    Callers ask it before they blame rows, since no row of such a table is wrong.
    """
    rounding = find_rounding(np.array([view.T_base_flange for view in session.views]))
    if rounding is None or rounding.rotation < usual_twist(session.length_unit)[0]:
        return None
    times = _TIMES_ROUNDING
    as_much = rounding.rotation / times < snooping.rotation < times * rounding.rotation
    return rounding if as_much else None


def find_rounding(T: Array) -> Rounding | None:
    """Return to how many decimals the rotations of poses (V, 4, 4) were rounded; None where no rounding is seen.

    Quaternions are tried, then angles (deg) in every order: all numbers must be whole multiples of the step.
    """
    R = Rotation.from_matrix(T[:, :3, :3])
    if len(T) < _FEWEST_ROUNDED or frames.angle_between(T[0], T[1:]).max(initial=0.0) == 0:
        return None
    for decimals in range(1, _MOST_DECIMALS + 1):
        step = 0.1**decimals
        if _quaternions_have(R.as_quat(), step):
            # A quaternion is half the rotation vector, and a number rounded to a step scatters by step/√12.
            return Rounding("quaternion", decimals, 2 * step / np.sqrt(12))
    for decimals in range(_MOST_DECIMALS):
        step = 0.1**decimals
        for order in BOTH_ORDERS:
            numbers = euler_angles(R, order) * 180 / np.pi / step
            if (np.abs(numbers - np.round(numbers)) < _WHOLE).all():
                return Rounding("euler", decimals, float(np.radians(step)) / np.sqrt(12))
    return None


def _quaternions_have(q: Array, step: float) -> bool:
    """Return whether all quaternions (V, 4), each times some factor near 1, are whole multiples of a step.

    The factor undoes normalisation after rounding: it makes the largest element a whole number of steps.
    """
    largest = np.abs(q).max(axis=1)
    # What was normalised was shorter or longer by a few steps.
    counts = np.round(largest / step)[:, None] + np.arange(-2, 3)
    numbers = q[:, None] * (counts / largest[:, None])[:, :, None]
    return bool((np.abs(numbers - np.round(numbers)).max(axis=2) < _WHOLE).any(axis=1).all())
