"""The result of a run in plain sentences."""

from collections.abc import Sequence

import numpy as np

from stitch.fit.coarse import CoarseHandEye
from stitch.fusion.register import Registration
from stitch.numerics.frames import Array
from stitch.numerics.units import angle_text, length_text
from stitch.observations.surfaces.hand_eye_fit import HandEyeFit, Repeatability
from stitch.observations.targets.outliers import Outlier
from stitch.observations.targets.target_model import TargetModelFit
from stitch.run_data import ExcludedView, Unsupported
from stitch.session.session import SessionData

ANOTHER_ARM = "another run's arm"
# Sources of the hand-eye's variance in words; the keys are the names of the components of its covariance.
SOURCES = {
    "white rotation": "random errors of the robot's rotations",
    "white translation": "random errors of the robot's positions",
    "sensor noise": "the sensor's noise",
    "joint_offset": "wrong joint zeros",
    "link_geometry": "wrong link lengths",
    "joint_compliance": "joint compliance under load",
    "gears": "uneven gears",
    "play": "play in the joints",
    "joint scatter": "random errors of the joints",
    "smooth": "smooth errors over the joint angles without a formula",
    "quickly wandering": "drift of the poses over a few views",
    "slowly wandering": "slow drift of the poses over the session",
    "stop rotation": "rotation errors shared by all scans from one pose",
    "stop translation": "position errors shared by all scans from one pose",
    "scanner field": "a scanner error that repeats in every view",
    "scanner scale": "a wrong scale of the scanner or of all arm lengths",
    ANOTHER_ARM: "the arm model of another run",
    "unseen": "directions that these views do not constrain",
}
# An rms of at most so many times the noise floor, its square by a fifth larger, is the noise; above, something else.
_NEAR_FLOOR = 1.1
# Sigmas that were widened by more than this factor on the variance are worth a note.
_WIDENED = 2.5
# Of fewer degrees of freedom what is usual for arms counts as much as what the views show: seven views leave 30.
_FEW_DEGREES = 30
# Outliers that are named; the others are counted.
_LISTED = 12
# Moves along surfaces of so many robust sigmas of the overlaps are worth a note.
_SLID = 20.0


def surface_sentence(
    residual: float,
    registered: float,
    floor: float,
    scatter: Repeatability,
    length_unit: str,
    effects: Sequence[str] = (),
) -> str:
    """Return the verdict of a run in sentences: residual between surfaces, noise floor, scatter of the poses.

    Args:
        residual: rms between surfaces under the model, length_unit.
        registered: the same after each view got its own correction.
        floor: the same by the sensor's noise alone.
        scatter: of the robot's poses.
        effects: names of those in the model beside the hand-eye.
    """
    left, noise = (length_text(x, length_unit) for x in (residual, floor))
    model = f"One hand-eye with {' and '.join(effects)}" if effects else "One hand-eye"
    if residual < _NEAR_FLOOR * floor:
        return f"{model} fits all overlaps to {left} rms. The sensor's noise ({noise}) explains that."
    return (
        f"{model} leaves {left} rms between the surfaces; the sensor's noise alone would leave {noise}. "
        f"{_scatter_sentences(scatter, registered, length_unit)}"
    )


def register_note(registration: Registration, session: SessionData, unseen: Array) -> str:
    """Return the note of the register stage: surfaces that are offset, moves that mean nothing, an early end; or "".

    Args:
        unseen: (V,) how far register moved each view in directions that no overlap shows, length_unit.
    """
    lines = []
    for v, offset in registration.offsets.items():
        side = "outside" if offset > 0 else "inside"
        distance = length_text(abs(offset), session.length_unit)
        lines.append(f"{session.names[v]} lies as a whole {side} the other views, by {distance}")
    if unseen.max(initial=0.0) > _SLID * registration.overlaps.gram.scale:
        farthest = length_text(float(unseen.max()), session.length_unit, 2)
        lines.append(f"views slide along these surfaces unseen, here by up to {farthest}: such moves mean nothing")
    return "; ".join([*lines, *([registration.note] if registration.note else [])])


def support_note(dropped: Unsupported) -> str:
    """Return how many scanned points are not in the stitched cloud, and why; empty where all are."""
    if not dropped.share:
        return ""
    return (
        f"left out {dropped.alone + dropped.looked_through:,} of {dropped.points:,} points ({dropped.share:.2%}): "
        f"{dropped.alone:,} strays, {dropped.looked_through:,} that another view sees through"
    )


def target_sentence(targets: TargetModelFit, registered: float, scatter: Repeatability, length_unit: str) -> str:
    """Return the verdict of a run in sentences: residual at the targets, noise floor, scatter of the poses.

    Args:
        registered: rms distance of the targets after each view got its own correction, length_unit.
        scatter: of the robot's poses.
    """
    floor = targets.noise_floor
    left, out, noise = (length_text(x, length_unit, 4) for x in (targets.rms, targets.heldout_rms, floor))
    if targets.uninformative:
        return "No target is seen in two views, so nothing shows how well the model places them."
    if targets.rms < _NEAR_FLOOR * floor:
        return f"The model fits all targets to {left} rms (3D). The sensor's noise ({noise}) explains that."
    return (
        f"The model fits the targets to {left} rms (3D), and to {out} in views left out with their neighbours. "
        f"The sensor's noise alone would leave {noise}. {_scatter_sentences(scatter, registered, length_unit)}"
    )


def _scatter_sentences(scatter: Repeatability, registered: float, length_unit: str) -> str:
    """Return how far the poses scatter, and the rms that register leaves (`registered`, length_unit), in sentences."""
    return (
        f"The robot's poses scatter by {length_text(scatter.translation, length_unit)} and "
        f"{angle_text(scatter.rotation, 2)}. After each view got its own correction, "
        f"{length_text(registered, length_unit)} rms remain."
    )


def coarse_note(start: CoarseHandEye) -> str:
    """Return the note of the coarse stage: where the hand-eye comes from and, if searched, how clear the answer is."""
    # A hand-eye that was given has no candidates.
    if not start.candidates:
        return start.source
    best = start.candidates[0]
    tried = sum(c.reached for c in start.candidates)
    source = f"found from {best.source}; {best.reached} of {tried} starts agree"
    if len(start.candidates) == 1:
        return f"{source}, no other answer"
    return f"{source}, the runner-up is {start.runner_up_ratio:.1f} times worse"


def warnings(start: CoarseHandEye, hand_eye: HandEyeFit) -> tuple[str, ...]:
    """Return warnings about a hand-eye: a second answer as good, few degrees of freedom, a much widened covariance."""
    notes = []
    if start.is_ambiguous:
        notes.append(
            f"Two different hand-eyes fit almost equally well (ratio {start.runner_up_ratio:.2f}); to fix: "
            "state scanner.pose in session.toml, or add views with other orientations."
        )
    if hand_eye.degrees is not None and hand_eye.degrees < _FEW_DEGREES:
        notes.append(
            f"U of the hand-eye rests on {hand_eye.degrees} degrees of freedom, and on how much arms usually err; "
            "to fix: add views."
        )
    if hand_eye.inflation > _WIDENED:
        notes.append(
            f"U of the hand-eye is {np.sqrt(hand_eye.inflation):.1f} times larger than noise alone would give. "
            f"{_largest_sources(hand_eye)}"
        )
    return tuple(notes)


def _largest_sources(hand_eye: HandEyeFit) -> str:
    """Return a sentence that names the largest source of the variance of rotation and of position, with its share."""
    (of_rotation, rotation_share), (of_position, position_share) = (
        max(shares.items(), key=lambda item: item[1]) for shares in (hand_eye.rotation_shares, hand_eye.position_shares)
    )
    first, second = (SOURCES.get(source, source) for source in (of_rotation, of_position))
    if of_rotation == of_position:
        shares = f"{rotation_share:.0%} in rotation, {position_share:.0%} in position"
        return f"Most of its variance may come from {first}: {shares}."
    return (
        f"Most of its variance in rotation may come from {first} ({rotation_share:.0%}). "
        f"In position it may come from {second} ({position_share:.0%})."
    )


def view_notes(
    left_out: Sequence[ExcludedView], kept: Sequence[ExcludedView], suspected: Sequence[ExcludedView] = ()
) -> tuple[str, ...]:
    """Return notes on views that do not fit their robot pose, for the report of a run.

    Args:
        left_out: not used in the fit.
        kept: would be left out, but the user asked to keep them.
        suspected: stand out, but errors of the arm could explain them, so that they are used.
    """
    notes = [f"View {item.view} does not fit its robot pose and was left out: {item.why}." for item in left_out]
    if left_out:
        notes.append(f"To fuse {'it' if len(left_out) == 1 else 'them'} all the same: stitch run --keep.")
    notes += [f"View {item.view} does not fit its robot pose and was kept as asked: {item.why}." for item in kept]
    if suspected:
        names = "; ".join(f"{item.view} {item.why}" for item in suspected)
        notes.append(
            f"These views stand out more than chance, but errors of the arm could explain them: {names}. They were "
            "fused; to fix: run `stitch diagnose`, and look at these scans."
        )
    return tuple(notes)


def target_notes(targets: TargetModelFit, outliers: Sequence[Outlier], session: SessionData) -> tuple[str, ...]:
    """Return notes on outliers, targets seen once, clouds that were not used, and a widened covariance."""
    notes = _unused_points(targets, outliers, session)
    fitted = targets.rows.sightings.target.shape[1]
    most = max(len(view.sighting.targets) for view in session.views if view.sighting)
    if fitted < most:
        notes.append(
            f"Of {most} labelled points of a view at most {fitted} were fitted, others in each view: more take memory "
            "and time, and show the poses no better than these scatter."
        )
    if any(view.cloud is not None for view in session.views):
        notes.append("Some views have no cloud: only the labelled points were fitted.")
    if targets.inflation > _WIDENED:
        notes.append(
            f"All sigmas are {np.sqrt(targets.inflation):.1f} times larger than for independent pose errors, because "
            "neighbouring views have similar errors."
        )
    return tuple(notes)


def mixed_notes(targets: TargetModelFit, outliers: Sequence[Outlier], session: SessionData) -> tuple[str, ...]:
    """Return notes on outliers, targets seen once, and labelled data that clouds replace."""
    notes = _unused_points(targets, outliers, session)
    if session.nominal is not None:
        notes.append("Nominal positions in targets.csv were not used: with clouds, target positions are fitted.")
    if targets.landmarks.orientation is not None:
        notes.append("Only positions from frames.csv were used, not rotations, because the session has clouds.")
    return tuple(notes)


def _unused_points(targets: TargetModelFit, outliers: Sequence[Outlier], session: SessionData) -> list[str]:
    """Return notes on labelled points that do not count: outliers, and targets that only one view sees."""
    notes = []
    if outliers:
        named_outliers = [
            f"{outlier_name(o, session)} ({length_text(o.distance, session.length_unit)}, {o.times:.0f} times the "
            "usual)"
            for o in outliers
        ]
        more = f" and {len(named_outliers) - _LISTED} more" if len(named_outliers) > _LISTED else ""
        notes.append(f"Outliers were not used: {', '.join(named_outliers[:_LISTED])}{more}.")
    if targets.single_view_targets and not targets.uninformative:
        notes.append(f"Targets seen in fewer than two views add nothing: {', '.join(targets.single_view_targets)}.")
    return notes


def outlier_name(outlier: Outlier, session: SessionData) -> str:
    """Return the names of an outlier's target and view."""
    view = session.views[outlier.view].name
    return f"view {view}" if outlier.target is None else f"{outlier.target} in view {view}"


def unfitted(effect: str) -> str:
    """Return the source of variance for parameters of an effect that stay at zero, in words."""
    return f"parameters of {effect} held at zero, because these views hardly separate them from the hand-eye"
