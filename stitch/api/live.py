"""A session that is measured while you watch: every view is judged as it comes."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from threading import RLock
from typing import Any, Literal, Protocol, cast

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.api.run import FittedHandEye, Run, fitted_hand_eye
from stitch.api.session import LengthUnit, Session, check_convention, public_session
from stitch.api.verbs import run
from stitch.errors import InputError, NoResultError
from stitch.fit import surface_steps
from stitch.fit.coarse import turn_about
from stitch.fit.fit import FitStart
from stitch.fit.live_fit import LiveFit, fit_live_hand_eye, place_view, start_live_fit, without_view
from stitch.model.model import Model, displacement
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.numerics.units import length_text
from stitch.observations.observability import unknown_numbers
from stitch.observations.pose_errors import PoseErrors, prior_pose_errors
from stitch.observations.surfaces.scanner_errors import rig_scanner_errors
from stitch.observations.surfaces.view_poses import UnconstrainedPoses
from stitch.recorder import Recorder, SilentRecorder
from stitch.screening.pose_tests import BlunderSearch, find_blunders, least_displacement
from stitch.screening.view_model import UsualEffects, ViewModel, view_model
from stitch.screening.view_screening import fit_screened_views
from stitch.session.axis_poses import axes_of, place_axes, place_stated_axes, require_placed, require_readings
from stitch.session.capture import Capture, build_capture, prepare_capture
from stitch.session.measurement import measurement_of
from stitch.session.reading.session_toml import read_axes
from stitch.session.robot import Robot
from stitch.session.session import Mount, Scanner, SessionData, View
from stitch.system.threads import library_threads_off
from stitch.system.values import Value

Verdict = Literal["waiting", "fits", "does_not_belong", "adds_nothing"]

# Views before a hand-eye is searched, and before one that is stated is corrected: fewer leave nothing to test it by.
_FEWEST_TO_SEARCH = 4
_FEWEST_TO_CORRECT = 3
# A view adds nothing if others see so much of it already, and U falls by no more than this share.
_SEEN_BEFORE = 0.98
_LEAST_GAIN = 0.05
# Turns below this are not worth a word, rad.
_SMALLEST_TURN = 5e-5
# Views in a row that do not belong before one cause is named.
_IN_A_ROW = 2
# By which proposed poses are turned from those taken.
_TURNS_DEG = (15.0, 30.0, 45.0)
# Weight of a prior on every direction, as a share of the clearest.
_UNSEEN = 1e-8


@dataclass(frozen=True, eq=False)
class LiveView(Value):
    """What is said of one view as it comes; `print` writes it as one line.

    Example:
        >>> print(live.said[-1])
        v004: fits. ... % of it was seen before, U falls by ... %. U ... mm, ... mrad.
    """

    name: str
    verdict: Verdict
    why: str  # one sentence
    hand_eye: FittedHandEye | None  # so far, with its U; None before there is one
    seconds: float  # from the call to the answer

    def __str__(self) -> str:
        known = ""
        if self.hand_eye is not None and self.hand_eye.unknown:
            are = "are" if len(self.hand_eye.unknown) > 1 else "is"
            known = f" Of the hand-eye {', '.join(self.hand_eye.unknown)} {are} not known."
        elif self.hand_eye is not None:
            known = f" U {self.hand_eye.U.mm:.2g} mm, {self.hand_eye.U.mrad:.2g} mrad."
        return f"{self.name}: {self.verdict.replace('_', ' ')}. {self.why}{known}"


@dataclass(frozen=True, eq=False)
class ProposedPose(Value):
    """A pose of the flange that would show more of the hand-eye; whether the arm can take it is not asked.

    Example:
        >>> print(live.next_pose())
        Next: view v... turned by ...° about (...) of the base, U 0... mm.
    """

    T_base_flange: Array  # (4, 4) length_unit
    like: str  # the view from which it is turned
    turn_deg: Array  # (3,) rotation vector of the flange from there, base frame, degrees
    U_mm: float  # of the hand-eye at the part, with this view

    def __str__(self) -> str:
        angle = float(np.linalg.norm(self.turn_deg))
        axis = ", ".join(f"{x:.2f}" for x in self.turn_deg / angle)
        return f"Next: view {self.like} turned by {angle:.0f}° about ({axis}) of the base, U {self.U_mm:.2g} mm."


class LiveRecording(Protocol):
    """Shows a session while it is measured."""

    def view(self, view: View, T_reference_scanner: Array | None, said: LiveView) -> None:
        """Show one view: its scan at its pose (4, 4) as far as that is known, and what is said of it."""


class LiveSession:
    """Session that grows by one view at a time; `stitch.live` begins one.

    Every view is matched with those before it, once. `finish` runs the session as `stitch.run` does, so that its result
    is that of a batch. Whatever ends a call, an interrupt too, leaves the session as it was before; calls of several
    threads come one after the other.

    Example:
        >>> live = stitch.live(mount="eye_in_hand", name="bracket")
        >>> for cloud, pose in zip(clouds, poses):
        ...     said = live.add_view(cloud, pose)
        >>> said.name, said.verdict in ("fits", "adds_nothing")
        ('v004', True)
        >>> live.hand_eye.frame, len(live.said)
        ('flange', 5)
    """

    def __init__(
        self, session: Session, recording: LiveRecording | None = None, cloud_unit: LengthUnit | None = None
    ) -> None:
        """Begin with the views that the session has; `cloud_unit` is that of clouds which are given as arrays."""
        self.session: Session = session  # with the views so far
        self.said: list[LiveView] = []  # of every view, in their order
        self._recording = recording
        self._cloud_unit = cloud_unit
        self._members: list[int] = []  # views of the session that the fit holds
        self._drawn = 0  # views that the recording shows in their places
        self._fit: LiveFit | None = None
        self._lock = RLock()

    def add_view(
        self,
        cloud: Any,
        pose: Any = None,
        *,
        joints: Any = None,
        time_s: float | None = None,
        covariates: Mapping[str, float] | None = None,
        name: str | None = None,
    ) -> LiveView:
        """Take in one view and say whether it belongs.

        Args:
            cloud: a scan in the scanner frame, as `Session.from_arrays` takes one.
            pose: T_base_flange, (4, 4) or any form that `Session.from_arrays` takes; None: from the joints.
            joints: (n,) rad.
            time_s: s, not before the view before.
            covariates: numbers by name that errors may follow.
            name: of the view; v000, v001, … by default.

        Raises:
            InputError: what does not fit, as of `Session.from_arrays`; the views before it stay as they are.

        Example:
            >>> live = stitch.live(mount="eye_in_hand")
            >>> live.add_view(clouds[0], poses[0]).verdict
            'waiting'
        """
        began = time.perf_counter()
        with self._lock:
            cell = self.session
            name = name or f"v{len(cell.views):03d}"
            if name in cell.names:
                raise InputError(f"view {name}: there is one of that name; to fix: give it another name")
            one = Session.from_arrays(
                {name: cloud},
                None if pose is None else [pose],
                mount=cell.mount,
                joints=None if joints is None else [joints],
                robot=cell.robot,
                times=None if time_s is None else [time_s],
                covariates={key: [value] for key, value in (covariates or {}).items()},
                scanner=cell.scanner,
                unit=cast(LengthUnit, cell.length_unit),
                cloud_unit=self._cloud_unit,
                name=cell.name,
                check=False,
            )
            return self._take(self._with_axes(replace(one.views[0], approach=None)), began)

    def _with_axes(self, view: View) -> View:
        """Return a view whose pose takes in its readings of the external axes; without axes, the view as it is.

        `place_axes` multiplies the reported T_base_flange by the motion of the axes at these readings.

        Raises:
            InputError: the view's covariates hold no reading of an axis.
        """
        cell = self.session
        if not cell.axes:
            return view
        require_readings([view], cell.axes, cell.length_unit)
        return place_axes(replace(cell, axes=(), views=(view,)), cell.axes).views[0]

    def take(self, view: View) -> LiveView:
        """Take in a view that was read before, as of a session folder, and say whether it belongs.

        Raises:
            InputError: an earlier time than that of the view before; poses of another convention than stated.

        Example:
            >>> live = stitch.live(mount="eye_in_hand")
            >>> live.take(session.views[0]).verdict
            'waiting'
        """
        return self._take(view, time.perf_counter())

    def _take(self, view: View, began: float) -> LiveView:
        """Judge one more view, remember and show what is said of it; after an error the session is as it was before.

        Args:
            began: `time.perf_counter` at the call, from which the seconds count.
        """
        with self._lock:
            # The values themselves are never changed in place, so that holding them is enough to go back.
            before = (self.session, self._fit, self._members, self._drawn)
            count = len(self.said)
            try:
                with library_threads_off():
                    said = replace(self._judge(self._after_last(view)), seconds=time.perf_counter() - began)
                self.said.append(said)
                if self._recording is not None:
                    self._show(self._recording)
            except BaseException:
                self.session, self._fit, self._members, self._drawn = before
                del self.said[count:]
                raise
            return said

    @property
    def hand_eye(self) -> FittedHandEye | None:
        """The hand-eye so far; its U holds for a complete model. None before there is one."""
        fit = self._fit
        if fit is None:
            return None
        unknown = unknown_numbers([fit.capture], fit.T_mount)
        return fitted_hand_eye(self.session, fit.capture, fit.T_mount, fit.covariance, unknown=unknown)

    def next_pose(self) -> ProposedPose | None:
        """Return the pose, near those taken, that would lower U of the hand-eye most; None before there is one.

        The candidates are the poses of the views, turned about the middle of what they see by 15 to 45°. The new view
        is assumed to show its pose as precisely as the others do on average.

        Example:
            >>> proposed = live.next_pose()
            >>> proposed.T_base_flange.shape, proposed.U_mm < live.hand_eye.U.mm
            ((4, 4), True)
        """
        with self._lock:
            hand_eye = self.hand_eye
            if self._fit is None or hand_eye is None:
                return None
            views = [self.session.views[i] for i in self._members]
            return _as_reported(_next_pose(self._fit, views, hand_eye), self.session)

    def finish(self, recorder: Recorder | None = None, **options: Any) -> Run:
        """Run the session: the same result as `stitch.run` on all its views.

        Args:
            recorder: is told of every stage.
            options: further ones of `stitch.run`.

        Raises:
            InputError, NoResultError: as of `stitch.run`.

        Example:
            >>> len(live.finish().views)
            5
        """
        return run(self.session, recorder=recorder, **options)

    def _after_last(self, view: View) -> View:
        """Append a view to the session, and return it with its direction of approach filled in.

        The approach of each joint is the sign (n,) of its travel from the view before; 0 in the first view.

        Raises:
            InputError: the view has no scan, or its time lies before that of the view before.
        """
        if view.cloud is None:
            raise InputError(f"view {view.name}: no scan; to fix: pass one, or leave the view out")
        before = self.session.views[-1] if self.session.views else None
        if before is not None and None not in (before.time_s, view.time_s) and view.time_s < before.time_s:  # type: ignore[operator]
            raise InputError(f"view {view.name}: its time lies before that of {before.name}; to fix: check the clock")
        if view.joints is not None and view.approach is None:
            from_there = view.joints if before is None or before.joints is None else before.joints
            view = replace(view, approach=np.sign(view.joints - from_there))
        self.session = replace(self.session, views=(*self.session.views, view))
        return view

    def _judge(self, view: View) -> LiveView:
        """Return the verdict on `view`, the last view of the session, and add it to the fit if it belongs.

        First it is compared with earlier scans, since a copy would fit its original perfectly. Then its surface places
        it among the others, and all views are tested again: older ones may turn out to be wrong and leave the fit.
        Last, the fall of the hand-eye's U (k = 2) tells whether the view adds anything.
        """
        if (verdict_on_copy := self._judge_copy(view)) is not None:
            return verdict_on_copy
        if self._fit is None:
            return self._first_fit(view)
        before = self.hand_eye
        assert before is not None
        capture = prepare_capture(replace(self.session, views=(view,)))
        try:
            fit, seen_before = place_view(
                self._fit, capture.scans[0], capture.T_reference_mount[0], capture.T_reference_flange[0]
            )
        except NoResultError:
            return self._rejected(
                view, "It shares no surface with the others: its pose is far off, or it shows another part."
            )
        # Position in `members` is the view's index in the fit; its value is the index in the session.
        members = [*self._members, len(self.session.views) - 1]
        blunders = self._blunders(fit, members)
        if len(members) - 1 in blunders:
            return self._rejected(view, blunders[len(members) - 1])
        self._members = members
        self._fit = fit
        # From the last on, so that the indices of those before stay valid.
        for v in sorted(blunders, reverse=True):
            self._fit = without_view(self._fit, v)
            self._members = self._members[:v] + self._members[v + 1 :]
        self._fit = fit_live_hand_eye(self._fit, self._errors)
        others = " ".join(f"{self.session.names[members[v]]} does not belong: {why}" for v, why in blunders.items())
        gain = 1 - self.hand_eye.U.mm / before.U.mm  # type: ignore[union-attr]
        is_idle = seen_before > _SEEN_BEFORE and gain < _LEAST_GAIN and not blunders
        share = f"{100 * seen_before:.0f} % of it was seen before, U falls by {max(100 * gain, 0):.0f} %."
        return self._report(view, "adds_nothing" if is_idle else "fits", f"{others} {share}".strip())

    def _judge_copy(self, view: View) -> LiveView | None:
        """Return the verdict on a view whose scan has exactly the points of an earlier one; None for any other view."""
        assert view.cloud is not None
        for original in self.session.views[:-1]:
            if original.cloud and np.array_equal(original.cloud.points, view.cloud.points):
                same = np.allclose(original.T_base_flange, view.T_base_flange, rtol=0.0, atol=1e-9)
                why = f"Its scan is a copy of that of {original.name}, at {'the same' if same else 'another'} pose."
                return self._report(view, "adds_nothing" if same else "does_not_belong", why)
        return None

    def _first_fit(self, view: View) -> LiveView:
        """Try the first fit of the hand-eye from the views so far, and return the verdict on the last one, `view`.

        "waiting" means no fit yet: too few views, two hand-eyes that fit equally well, or no solution. Otherwise the
        fit is begun with the views that screening leaves in.
        """
        # Before there is a fit, every verdict but "waiting" is that of a copied scan.
        copies = [i for i, said in enumerate(self.said) if said.verdict != "waiting"]
        whole = [i for i in range(len(self.session.views)) if i not in copies]
        session = self._session_of(whole)
        count = len(whole)
        least = _FEWEST_TO_SEARCH if self.session.scanner.T_mount is None else _FEWEST_TO_CORRECT
        if count < least:
            return self._report(view, "waiting", f"The hand-eye is fitted from {least} views on.")
        check_convention(session)
        measurement = measurement_of(session, prepare_capture(session))
        try:
            starts = surface_steps.start([session], [measurement], None)
            if starts[0].is_ambiguous:
                return self._report(
                    view, "waiting", "Two hand-eyes fit these views equally well; a turned view decides."
                )
            fit = partial(surface_steps.fit, start=FitStart(starts), recorder=SilentRecorder())
            screened = fit_screened_views([session], [measurement], fit)
        except NoResultError as error:
            return self._report(view, "waiting", f"No hand-eye yet: {error}.")
        screening = screened.screenings[0]
        assert screened.fitted.correction is not None
        self._members = [i for i in whole if self.session.names[i] not in screening.names]
        self._fit = start_live_fit(screened.fitted.correction)
        left_out = screening.line(session.names)
        if view.name in screening.names:
            return self._report(view, "does_not_belong", left_out)
        return self._report(view, "fits", f"The first hand-eye.{f' {left_out}.' if left_out else ''}")

    def _blunders(self, fit: LiveFit, members: list[int]) -> dict[int, str]:
        """Return the views of a fit that contradict the others, as sentences by index in the fit.

        They are searched twice: without effects of the arm, and with usual sizes of these as further errors. Only views
        found both times count, since an ordinary arm error is no wrong pose.

        Args:
            members: by index in the fit, the index of each view in the session.
        """
        model = view_model(fit.capture, fit.T_mount, fit.unconstrained)
        search = find_blunders(model)
        if not search.blunders:
            return {}
        measurement = measurement_of(self._session_of(members), fit.capture)
        usual = UsualEffects(measurement, Model(fit.T_mount)).twists(fit.unconstrained)
        sure = find_blunders(model.with_usual(usual)).blunders
        blunders = [v for v in search.blunders if v in sure]
        search = replace(search, blunders=tuple(blunders))
        sentences = {v: self._displacement(fit, model, search, v) for v in blunders}
        return {v: sentence for v, sentence in sentences.items() if sentence is not None}

    def _displacement(self, fit: LiveFit, model: ViewModel, search: BlunderSearch, view: int) -> str | None:
        """Return a sentence on the least error of a view's pose that agrees with the scans; None where that may be 0.

        The error is a rotation (rad) and the shift of the middle of the view's points (length_unit).

        Args:
            model: linear model of the views' pose errors.
            search: the views whose poses are wrong by `model`, and the scatter of the poses.
            view: index of the view in the fit.
        """
        middle = frames.transform(fit.unconstrained.poses[view], fit.capture.scans[view].points.mean(axis=0)[None])[0]
        rotation, shift = least_displacement(model, search, view, middle)
        if shift == 0 and rotation <= _SMALLEST_TURN:
            return None
        turn = f" and {1e3 * rotation:.2g} mrad" if rotation > _SMALLEST_TURN else ""
        return f"Its pose is off by at least {length_text(shift, self.session.length_unit)}{turn}."

    def _rejected(self, view: View, why: str) -> LiveView:
        """Return the verdict "does_not_belong" for a view; the fit stays without it.

        From `_IN_A_ROW` rejected views in a row on, the sentence `why` also names their probable common cause.
        """
        # This view and the rejected ones at the end of `said`.
        rejected = [view.name]
        for said in reversed(self.said):
            if said.verdict != "does_not_belong":
                break
            rejected.append(said.name)
        if len(rejected) >= _IN_A_ROW:
            why += (
                f" The part or the scanner has probably moved: the last {len(rejected)} views do not belong, from "
                f"{rejected[-1]} on."
            )
        return self._report(view, "does_not_belong", why)

    def _report(self, view: View, verdict: Verdict, why: str) -> LiveView:
        """Return what is said of a view, with the hand-eye so far; `_take` fills in the seconds."""
        return LiveView(view.name, verdict, why, self.hand_eye, 0.0)

    def _session_of(self, members: list[int]) -> Session:
        """Return the session with those of its views alone, by index."""
        return replace(self.session, views=tuple(self.session.views[i] for i in members))

    def _errors(
        self, capture: Capture, freed: UnconstrainedPoses, T_mount: Array
    ) -> tuple[PoseErrors, dict[str, list[Array]]]:
        """Return errors of usual size, of the poses and of the scanner, for the covariance of the live fit.

        Args:
            capture: the views in the fit.
            freed: poses of these views by their overlaps alone, without the robot.
            T_mount: (4, 4) hand-eye so far, scanner to mount, length_unit.

        Returns:
            Errors of poses; and by source of the scanner's errors, (6V, K) twists that the views show for one sigma of
            each of K errors.
        """
        measurement = measurement_of(self._session_of(self._members), capture)
        errors = prior_pose_errors([measurement], Model(T_mount), [freed.overlaps.gram.centre])
        return errors, rig_scanner_errors([measurement], [freed])

    def _show(self, recording: LiveRecording) -> None:
        """Show the last view in a recording; the first hand-eye gives places, so that all views are shown again."""
        first = self._drawn if self._fit is not None else len(self.said) - 1
        for i in range(first, len(self.said)):
            recording.view(self.session.views[i], self._pose_of(i), self.said[i])
        self._drawn = len(self.said) if self._fit is not None else 0

    def _pose_of(self, index: int) -> Array | None:
        """Return T_reference_scanner (4, 4) of a view, length_unit; None before there is a fit.

        A view in the fit stands where its overlaps put it; one that does not belong, where robot and hand-eye do.

        Args:
            index: of the view in the session.
        """
        if self._fit is None:
            return None
        if index in self._members:
            return self._fit.unconstrained.poses[self._members.index(index)]
        alone = self.session.views[index].T_base_flange[None]
        capture = build_capture(self.session.name, (), alone, self.session.mount)
        return capture.poses(self._fit.T_mount)[0]


def live(
    *,
    mount: Mount,
    robot: Robot | Mapping[str, Any] | Path | str | None = None,
    scanner: Scanner | Mapping[str, Any] | None = None,
    axes: Sequence[Mapping[str, Any]] = (),
    unit: LengthUnit = "mm",
    cloud_unit: LengthUnit | None = None,
    name: str = "session",
    recording: Path | str | None = None,
) -> LiveSession:
    """Return a session without views, which are taken in and judged one by one.

    Args:
        mount, robot, scanner, unit, cloud_unit, name: as of `Session.from_arrays`; scanner.pose (4, 4), where it is
            stated, saves the search and one view of waiting.
        axes: [[axis]] tables of session.toml as mappings, each with its place; `covariates` of a view hold the
            readings. They stay where they are stated until `finish` fits them.
        recording: shows the views as they come: "view" opens Rerun's viewer, "rerun+http://HOST:PORT/proxy" sends them
            to one, the path of an .rrd file keeps them.

    Returns:
        The session, without a view; lengths in `unit`, angles in rad.

    Raises:
        InputError: what is stated of the cell does not fit.

    Example:
        >>> live = stitch.live(mount="eye_in_hand", unit="mm")
        >>> live.hand_eye is None, live.next_pose() is None
        (True, True)
    """
    session = Session.empty(mount=mount, robot=robot, scanner=scanner, unit=unit, cloud_unit=cloud_unit, name=name)
    placed = place_stated_axes(
        session, read_axes(session.path / "session.toml", [dict(t) for t in axes], mount, has_poses=True)
    )
    require_placed(placed)
    session = public_session(placed) if axes else session
    return LiveSession(session, None if recording is None else _recording(session, str(recording)), cloud_unit)


def follow(session: SessionData) -> LiveSession:
    """Begin a live session with what a session folder states of its cell; its views come by `LiveSession.take`.

    Raises:
        InputError: an external axis that nobody has placed.
    """
    require_placed(session)
    return LiveSession(public_session(replace(session, views=())))


def _recording(session: Session, target: str) -> LiveRecording:
    """Return a recording that shows a live session at `target`, of the first package that offers one (entry points).

    Raises:
        InputError: none does.
    """
    entry = next(iter(entry_points(group="stitch.live_recordings")), None)
    if entry is None:
        raise InputError("recording: nothing here shows it; to fix: install rerun-sdk, or leave recording out")
    recording: LiveRecording = entry.load()(session, target)
    return recording


def _as_reported(proposed: ProposedPose, session: SessionData) -> ProposedPose:
    """Return a proposed pose in the frame that the robot reports, its external axes as at the view it is turned from.

    The fit works with T_base_flange that includes the motion of the axes; `carried` is that motion, undone here.
    """
    if not session.axes:
        return proposed
    like = next(view for view in session.views if view.name == proposed.like)
    T = frames.inverse(axes_of(replace(session, views=(like,))).carried())[0]
    return replace(proposed, T_base_flange=T @ proposed.T_base_flange, turn_deg=T[:3, :3] @ proposed.turn_deg)


def _next_pose(live_fit: LiveFit, views: list[View], hand_eye: FittedHandEye) -> ProposedPose:
    """Return the pose that would reduce the hand-eye's U most, among all poses taken, each turned about the part.

    Args:
        live_fit: the views in the fit and their hand-eye.
        views: those views, in the order of the fit.
        hand_eye: the hand-eye so far, with its U at the part.
    """
    capture = live_fit.capture
    gram = live_fit.unconstrained.overlaps.gram
    turns = [np.radians(angle) * axis for angle in _TURNS_DEG for axis in np.vstack([np.eye(3), -np.eye(3)])]
    about_part = [turn_about(turn, gram.centre) for turn in turns]
    # One row for each view and turn: T_reference_mount.
    turned = np.array([[T @ T_mount for T in about_part] for T_mount in capture.T_reference_mount])
    poses = turned.reshape(-1, 4, 4)
    # Both (·, 6, 6): left twist of a view about the centre per right twist of the hand-eye.
    jacobians_taken = frames.adjoint_about(gram.centre, capture.hand_eye_frames(live_fit.T_mount))
    jacobians_proposed = frames.adjoint_about(gram.centre, poses @ live_fit.T_mount)
    relative_U = partial(_relative_uncertainty, lever=gram.lever, middle=hand_eye.middle)
    with_pose = [relative_U(np.concatenate([jacobians_taken, J[None]])) for J in jacobians_proposed]
    best = int(np.argmin(with_pose))
    view = views[best // len(turns)]
    # A fixed scanner sees the part on the flange: the reference is the flange then, and the mount the base.
    T_base_flange = poses[best] if hand_eye.frame == "flange" else frames.inverse(poses[best])
    turn_deg = Rotation.from_matrix(T_base_flange[:3, :3] @ view.T_base_flange[:3, :3].T).as_rotvec(degrees=True)
    U_mm = hand_eye.U.mm * with_pose[best] / relative_U(jacobians_taken)
    return ProposedPose(T_base_flange, view.name, turn_deg, U_mm)


def _relative_uncertainty(jacobians: Array, *, lever: float, middle: Array) -> float:
    """Return U of the hand-eye at the part, up to a factor that is common to all sets of views.

    Each view v is assumed to measure its pose with the same precision; J_v is that pose's derivative by the hand-eye.
    The information is Σ (J_v − J̄)ᵀ (J_v − J̄) with the mean J̄ over the views, since a motion of all views together
    leaves their overlaps unchanged.

    Args:
        jacobians: (V, 6, 6) left twist of each view about the part's centre per right twist of the hand-eye.
        lever: length_unit: rotations count as the displacements that they make at this distance.
        middle: (3,) of the part, scanner frame, length_unit.
    """
    unit = np.array([lever] * 3 + [1.0] * 3)[:, None]
    deviations = unit * (jacobians - jacobians.mean(axis=0))
    information = np.einsum("vki,vkj->ij", deviations, deviations)
    # A weak prior keeps the information invertible: a direction that no view shows yet gets a large variance.
    weak = np.diag(_UNSEEN * np.diag(information).max() / unit[:, 0] ** 2)
    return displacement(np.linalg.inv(information + weak), middle)
