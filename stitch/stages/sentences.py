"""The result of a run in plain sentences."""

from collections.abc import Sequence

import numpy as np

from stitch.measurement.session import Session
from stitch.observations.surfaces.hand_eye_fit import HandEyeFit, Repeatability
from stitch.observations.targets.outliers import Outlier
from stitch.observations.targets.target_model import TargetModelFit
from stitch.runs.run import ExcludedView
from stitch.stages.initial_guess import CoarseHandEye
from stitch.stages.register import Registration
from stitch.units import angle_text, length_text

# What may be wrong in a hand-eye, in words.
#
# The keys are the sources of its variance: white scatter (`error_model.py`), what poses may err beside it
# (`pose_errors.py`), and what every view repeats (`surface_step.py`) or none shows (`hand_eye.py`).

ANOTHER_ARM = "another run's arm"

SOURCES = {
    "white rotation": "poses that turn at random",
    "white translation": "poses that scatter at random",
    "sensor noise": "the sensor's noise",
    "joint_offset": "joints that count from a wrong zero",
    "link_geometry": "links of another length than stated",
    "joint_compliance": "joints that give way under load",
    "gears": "gears that do not turn evenly",
    "play": "play in the joints",
    "joint scatter": "joints that scatter at random",
    "smooth": "errors that follow the joint angles by no law",
    "quickly wandering": "poses that wander, and forget it within a few views",
    "slowly wandering": "poses that wander slowly all session long",
    "stop rotation": "turns of the flange that all scans from one pose share",
    "stop translation": "shifts of the flange that all scans from one pose share",
    "scanner field": "errors of the scanner that every view repeats",
    ANOTHER_ARM: "the arm of another run",
    "unseen": "directions that these views do not show",
}


def unfitted(effect: str) -> str:
    """What an effect in use may do by parameters that stay at zero, as a source and in words."""
    return f"numbers of {effect} that stay at zero, since these views hardly tell them from the hand-eye"


# Residuals within a quarter of the noise floor's square are noise; above, something else is there.
_NEAR_FLOOR = 1.1
# Sigmas that were widened by more than this factor on the variance are worth a note.
_WIDENED = 2.5
# Two answers of the search whose scores differ by less than this ratio are equally good.
_CLOSE = 1.1
_LISTED = 12


def surface_sentence(
    residual: float,
    registered: float,
    floor: float,
    scatter: Repeatability,
    length_unit: str,
    effects: Sequence[str] = (),
) -> str:
    """What one hand-eye leaves between the surfaces, what the noise would leave, and where the difference sits.

    Args:
        effects: names of those that are in the model beside the hand-eye.
    """
    left, noise = (length_text(x, length_unit) for x in (residual, floor))
    model = f"One hand-eye with {' and '.join(effects)}" if effects else "One hand-eye"
    if residual < _NEAR_FLOOR * floor:
        return f"{model} closes all overlaps to {left} rms, which the sensor's own noise ({noise}) explains."
    return (
        f"{model} leaves {left} rms where the sensor's own noise would leave {noise}: the robot's poses "
        f"{_scatter_clause(scatter, registered, length_unit)}."
    )


def register_note(found: Registration, session: Session) -> str:
    """Return which surfaces stand off as a whole, and that register ended early; empty where neither is so."""
    lines = []
    for v, size in found.offsets.items():
        side = "outside" if size > 0 else "inside"
        apart = length_text(abs(size), session.length_unit)
        lines.append(f"the whole surface of {session.names[v]} lies {apart} {side} that of the other views")
    return "; ".join([*lines, *([found.note] if found.note else [])])


def target_sentence(found: TargetModelFit, registered: float, scatter: Repeatability, length_unit: str) -> str:
    """What the model leaves at the targets, what the noise would leave, and where the difference sits."""
    floor = found.noise_floor
    left, out, noise = (length_text(x, length_unit, 4) for x in (found.rms, found.heldout_rms, floor))
    if found.uninformative:
        return "No target is seen in two views: they lie where the model puts them, and nothing shows how well."
    if found.rms < _NEAR_FLOOR * floor:
        return f"The model puts all targets within {left} rms (3D), which the sensor's own noise ({noise}) explains."
    return (
        f"The model puts the targets within {left} rms (3D), {out} in views left out with their neighbours; the "
        f"sensor's own noise would leave {noise}. The robot's poses "
        f"{_scatter_clause(scatter, registered, length_unit)}."
    )


def _scatter_clause(scatter: Repeatability, registered: float, length_unit: str) -> str:
    return (
        f"scatter by {length_text(scatter.translation, length_unit)} and {angle_text(scatter.rotation, 2)}; moving "
        f"each view by its own correction leaves {length_text(registered, length_unit)}"
    )


def correct_note(before: float, after: float) -> str:
    """Why the correction may leave a larger rms than it found."""
    if after > before:
        return "views weighed by the robot's scatter: the hand-eye is more certain, single overlaps fit less tightly"
    return ""


def coarse_note(start: CoarseHandEye) -> str:
    """Where the hand-eye came from, and how far the second answer was."""
    if not start.candidates:
        return start.source
    best = start.candidates[0]
    tried = sum(c.reached for c in start.candidates)
    found = f"found from {best.source}; {best.reached} of {tried} starts ended there"
    if len(start.candidates) == 1:
        return f"{found}, no other answer"
    return f"{found}, the runner-up is {start.runner_up_ratio:.1f} times worse"


def warnings(start: CoarseHandEye, found: HandEyeFit) -> tuple[str, ...]:
    """What a user should know before trusting the hand-eye."""
    notes = []
    if start.candidates and start.runner_up_ratio < _CLOSE:
        notes.append(
            f"Two different hand-eyes fit almost equally well (ratio {start.runner_up_ratio:.2f}): "
            "give scanner.pose, or add views with other orientations."
        )
    if found.inflation > _WIDENED:
        notes.append(
            f"The hand-eye is {np.sqrt(found.inflation):.1f} times less certain than independent pose errors would "
            f"leave it; {_largest_sources(found)}."
        )
    return tuple(notes)


def _largest_sources(found: HandEyeFit) -> str:
    """Where most of its variance may come from."""
    (turn, of_turn), (shift, of_shift) = (
        max(shares.items(), key=lambda item: item[1]) for shares in (found.rotation_shares, found.position_shares)
    )
    first, second = (SOURCES.get(source, source) for source in (turn, shift))
    largest = "the largest part of the variance of its"
    if turn == shift:
        return f"{largest} rotation, {of_turn:.0%}, and of its position, {of_shift:.0%}, may come from {first}"
    return f"{largest} rotation, {of_turn:.0%}, may come from {first}, of its position, {of_shift:.0%}, from {second}"


def view_notes(
    left_out: Sequence[ExcludedView], kept: Sequence[ExcludedView], suspected: Sequence[ExcludedView] = ()
) -> tuple[str, ...]:
    """Views that do not belong, first of all."""
    told = [f"View {item.view} does not belong and was left out: {item.why}." for item in left_out]
    told += [f"View {item.view} does not belong and was kept as asked: {item.why}." for item in kept]
    if suspected:
        names = "; ".join(f"{item.view} {item.why}" for item in suspected)
        told.append(
            f"More than chance, but no more than effects of the arm may do: {names}. Fused all the same: diagnose, and "
            "look at these scans."
        )
    return tuple(told)


def target_notes(found: TargetModelFit, outliers: Sequence[Outlier], session: Session) -> tuple[str, ...]:
    """Outliers by name, targets seen once, clouds that were not used, and a covariance that had to be widened."""
    notes = _unused_points(found, outliers, session)
    if any(view.cloud is not None for view in session.views):
        notes.append("Some views have no cloud: only the labelled points were fitted.")
    if found.inflation > _WIDENED:
        notes.append(
            f"Views near each other err alike: all sigmas are {np.sqrt(found.inflation):.1f} times those of "
            "independent pose errors."
        )
    return tuple(notes)


def mixed_notes(found: TargetModelFit, outliers: Sequence[Outlier], session: Session) -> tuple[str, ...]:
    """Outliers by name, targets seen once, and what is not used of labelled points beside clouds."""
    notes = _unused_points(found, outliers, session)
    if session.nominal is not None:
        notes.append("Nominal positions (targets.csv) are not used beside clouds; the targets' places were free.")
    if found.landmarks.orientation is not None:
        notes.append("Of the probe in frames.csv only the place counts beside clouds, not its turn.")
    return tuple(notes)


def _unused_points(found: TargetModelFit, outliers: Sequence[Outlier], session: Session) -> list[str]:
    notes = []
    if outliers:
        named_outliers = [
            f"{outlier_name(o, session)} ({length_text(o.distance, session.length_unit)}, {o.times:.0f} times the "
            "usual)"
            for o in outliers
        ]
        more = f" and {len(named_outliers) - _LISTED} more" if len(named_outliers) > _LISTED else ""
        notes.append(f"Not used, because they contradict the rest: {', '.join(named_outliers[:_LISTED])}{more}.")
    if found.single_view_targets and not found.uninformative:
        notes.append(f"Seen in fewer than two views, so that they say nothing: {', '.join(found.single_view_targets)}.")
    return notes


def outlier_name(outlier: Outlier, session: Session) -> str:
    """An outlier by the names of its view and target."""
    view = session.views[outlier.view].name
    return f"view {view}" if outlier.target is None else f"{outlier.target} in view {view}"
