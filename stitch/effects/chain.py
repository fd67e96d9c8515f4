"""The chain of frames with effects in it: poses and points as they truly were, and how both answer to parameters.

    x_ref = part⁻¹( robot(q*) · mount* · sensor⁻¹(x) )

A capture keeps this form: `T_reference_mount` holds what stands left of the hand-eye, `T_behind_mount`
what stands right of it, and the points are those that sensor and part would have shown without effects.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pykdtree.kdtree import KDTree

from stitch import frames
from stitch import robot as kinematics
from stitch.effects.contract import EVERY_VIEW, Effect, Parameter
from stitch.effects.robot import Links
from stitch.effects.views import ScanView, Views, views_of
from stitch.frames import Array, Indices
from stitch.overlap.capture import Capture
from stitch.overlap.scan import Scan
from stitch.robot import Robot
from stitch.session import Session

# Beyond 84° of incidence 1/cos α is noise of the normal; such points are not used anyway.
_SMALLEST_COSINE = 0.1
_EVENT_PLACES = 50


@dataclass(frozen=True)
class Chain:
    """What was measured: everything that a model needs to place the points."""

    capture: Capture  # without any effect
    T_base_flange: Array  # (V, 4, 4) reported
    eye_to_hand: bool
    robot: Robot | None
    views: Views
    scan_views: tuple[ScanView, ...]
    length_unit: str
    target_views: tuple[ScanView, ...] = ()  # the same as `scan_views` for labelled points

    def parameters(self, effect: Effect) -> tuple[Parameter, ...]:
        """The parameters of an effect in this session."""
        found = effect.parameters(self.views.joints.shape[1], self.views.torques.names, self.length_unit)
        return tuple(replace(p, grid=self._grid(p)) for p in found)

    def _grid(self, parameter: Parameter) -> tuple[float, ...]:
        if parameter.grid != EVERY_VIEW:
            return parameter.grid
        # An event can come before any view but the first two and the last: one view alone shows no event.
        places = range(2, self.views.count - 1)
        # Among hundreds of views the place of an event matters less than the time to try them all.
        return tuple(float(v) for v in places[:: max(len(places) // _EVENT_PLACES, 1)])

    def arguments(self, effect: Effect, values: Array) -> dict[str, float | Array]:
        """Keyword arguments of the effect's function."""
        return effect.arguments(values, self.views.joints.shape[1], len(self.views.torques.names))

    def lacks(self, effect: Effect) -> tuple[str, ...]:
        """What an effect needs and this session has not; time stands in for a covariate that it prefers."""
        known = {"intensity": self.has_intensity}
        lacking = [need for need in effect.needs if not known.get(need, self.views.has(need))]
        if effect.prefers and not any(self.views.has(name) for name in (*effect.prefers, "time")):
            lacking.append("time")
        return tuple(lacking)

    @property
    def has_intensity(self) -> bool:
        """True if every point has an intensity."""
        return bool(self.scan_views) and all(view.intensity is not None for view in self.scan_views)


@dataclass(frozen=True)
class Term:
    """An effect in use with the values of its parameters (P,), in the order of its specs."""

    effect: Effect
    values: Array


def chain_of(session: Session, capture: Capture) -> Chain:
    """Collect a session and its prepared scans."""
    views = views_of(session)
    eye_to_hand = session.mount == "eye_to_hand"
    T_base_flange = np.array([view.T_base_flange for view in session.views])
    gravity = np.array([0.0, 0.0, -1.0])
    if session.robot is not None and np.linalg.norm(session.robot.gravity) > 0:
        gravity = session.robot.gravity / np.linalg.norm(session.robot.gravity)
    down = frames.rotate(frames.inverse(T_base_flange), gravity[None])[:, 0] if eye_to_hand else None
    intensity = _intensities(session)
    size = float(np.median([np.ptp(points, axis=0).max() for points in capture.point_sets])) or 1.0
    scan_views = tuple(
        ScanView(v, views, np.maximum(scan.confidence, _SMALLEST_COSINE), intensity[v],
                 gravity if down is None else down[v], size)
        for v, scan in enumerate(capture.scans)
    )  # fmt: skip
    target_views: tuple[ScanView, ...] = ()
    if capture.sightings is not None:
        # Nobody knows at what slant a target was seen, or how bright: effects of these have nothing to say about it.
        straight = np.ones(capture.sightings.used.shape[1])
        usual = None if intensity[0] is None else np.zeros(len(straight))
        target_views = tuple(
            ScanView(v, views, straight, usual, gravity if down is None else down[v], size) for v in range(views.count)
        )
    return Chain(
        capture, T_base_flange, eye_to_hand, session.robot, views, scan_views, session.length_unit, target_views
    )


def _intensities(session: Session) -> list[Array | None]:
    """Standardised over the session: (I − Ī)/σ_I."""
    raw = [None if v.cloud is None else v.cloud.scalars.get("intensity") for v in session.views]
    if any(values is None for values in raw):
        return [None] * len(raw)
    everything = np.concatenate([values for values in raw if values is not None])
    spread = float(everything.std())
    if spread <= 0:
        return [None] * len(raw)
    return [None if values is None else (values - everything.mean()) / spread for values in raw]


def placed(chain: Chain, terms: Sequence[Term]) -> tuple[Array, Array]:
    """(V, 4, 4) what stands left of the hand-eye and right of it under effects of robot, mount and part."""
    views = chain.views
    joints = views.joints
    count, n = joints.shape
    links = Links(np.ones(count), *np.zeros((3, n)))
    mount, part = np.zeros((2, count, 6))
    moved = False
    for term in terms:
        arguments = chain.arguments(term.effect, term.values)
        if term.effect.place == "robot":
            # The function adds to what it is given; what it reads of the pose are the reported angles.
            joints, moved = term.effect.function(joints, views, **arguments), True
        elif term.effect.place == "links":
            links, moved = term.effect.function(links, views, **arguments), True
        elif term.effect.place == "mount":
            mount = mount + term.effect.function(views, **arguments)
        elif term.effect.place == "part":
            part = part + term.effect.function(views, **arguments)
    T_base_flange = chain.T_base_flange
    if moved and chain.robot is not None:
        true = kinematics.forward_with_errors(chain.robot, joints, links.scale, links.da, links.dd, links.dalpha)
        # A reported pose that differs from the nominal kinematics (a calibrated controller) keeps its difference.
        T_base_flange = T_base_flange @ frames.inverse(kinematics.forward(chain.robot, views.joints)) @ true
    left = frames.inverse(T_base_flange) if chain.eye_to_hand else T_base_flange
    return np.asarray(frames.exp(-part) @ left), np.asarray(frames.exp(mount))


def shift(chain: Chain, terms: Sequence[Term], v: int, pose: Array, index: Indices | slice) -> Array:
    """(N, 3) what must be added to the scanned points of view v, scanner frame, to undo sensor and part effects.

    Args:
        pose: (4, 4) T_reference_scanner of the view.
    """
    view = chain.scan_views[v]
    view = replace(view, cosine=view.cosine[index],
                   intensity=None if view.intensity is None else view.intensity[index])  # fmt: skip
    return undone(chain, terms, chain.capture.scans[v].points[index], view, pose)


def undone(chain: Chain, terms: Sequence[Term], points: Array, view: ScanView, pose: Array) -> Array:
    """(N, 3) what must be added to measured points (N, 3) of one view to undo sensor and part effects."""
    true = points
    for term in (t for t in terms if t.effect.place == "sensor"):
        # Corrections are thousandths of the range: one fixed-point step leaves millionths.
        first = true - (term.effect.function(true, view, **chain.arguments(term.effect, term.values)) - true)
        true = true - (term.effect.function(first, view, **chain.arguments(term.effect, term.values)) - first)
    for term in (t for t in terms if t.effect.place == "shape"):
        placed_points = frames.transform(pose, true)
        arguments = chain.arguments(term.effect, term.values)
        moved = term.effect.function(placed_points, view, **arguments) - placed_points
        true = true - frames.rotate(frames.inverse(pose), moved)
    return np.asarray(true - points)


def shift_targets(chain: Chain, terms: Sequence[Term], poses: Array) -> Array:
    """(V, S, 3) the same as `shift` for the labelled points of all views; zero in empty slots."""
    sightings = chain.capture.sightings
    assert sightings is not None
    if not any(term.effect.place in ("sensor", "shape") for term in terms):
        return np.zeros(sightings.points.shape)
    # An empty slot borrows a point: its own zero has no ray.
    first = sightings.points[np.arange(len(poses)), (sightings.target >= 0).argmax(axis=1)]
    filled = np.where((sightings.target >= 0)[..., None], sightings.points, first[:, None])
    blank = ~(sightings.target >= 0).any(axis=1)
    filled[blank] = filled[~blank].mean(axis=0)
    moved = [undone(chain, terms, filled[v], view, poses[v]) for v, view in enumerate(chain.target_views)]
    return np.where((sightings.target >= 0)[..., None], np.array(moved), 0.0)


def corrected(chain: Chain, terms: Sequence[Term], T_mount: Array) -> Capture:
    """The capture as it would be without the effects in `terms`."""
    left, right = placed(chain, terms)
    capture = replace(chain.capture, T_reference_mount=left, T_behind_mount=right)
    if any(term.effect.place in ("sensor", "shape") for term in terms):
        poses = capture.poses(T_mount)
        scans = [_moved(scan, shift(chain, terms, v, poses[v], slice(None))) for v, scan in enumerate(capture.scans)]
        capture = replace(capture, scans=tuple(scans))
        if capture.sightings is not None:
            points = capture.sightings.points + shift_targets(chain, terms, poses)
            capture = replace(capture, sightings=replace(capture.sightings, points=points))
    return capture


def _moved(scan: Scan, by: Array) -> Scan:
    """Points moved by micrometres: normals, edges and spacing stay, the tree must follow."""
    points = scan.points + by
    return replace(scan, points=points, tree=KDTree(points, leafsize=16))


def twists(chain: Chain, terms: Sequence[Term], term: Term, T_mount: Array, centre: Array) -> Array:
    """(P, V, 6) left twists of the views about `centre`, reference frame, per unit of each parameter of `term`.

    Central differences about `terms` with the values of `term` in place of its own, or added at its values.
    """
    others = [t for t in terms if t.effect.name != term.effect.name]
    to_centre = frames.make(np.eye(3), -centre)
    out = []
    for i, parameter in enumerate(chain.parameters(term.effect)):
        if parameter.discrete:
            out.append(np.zeros((chain.views.count, 6)))
            continue
        size = (0.005 if parameter.grid else 0.1) * parameter.typical
        step = size * np.eye(len(term.values))[i]
        both = []
        for sign in (1, -1):
            left, right = placed(chain, [*others, replace(term, values=term.values + sign * step)])
            both.append(to_centre @ left @ T_mount @ right)
        out.append(frames.log(both[0] @ frames.inverse(both[1])) / (2 * size))
    return np.array(out).reshape(len(term.values), chain.views.count, 6)


def shifts(chain: Chain, terms: Sequence[Term], term: Term, v: int, pose: Array, index: Indices | slice) -> Array:
    """(P, N, 3) slopes of `shift` for each parameter of `term`, scanner frame."""
    return _slopes(chain, terms, term, lambda with_step: shift(chain, with_step, v, pose, index))


def target_shifts(chain: Chain, terms: Sequence[Term], term: Term, poses: Array) -> Array:
    """(P, V, S, 3) slopes of `shift_targets` for each parameter of `term`, sensor frame."""
    return _slopes(chain, terms, term, lambda with_step: shift_targets(chain, with_step, poses))


def _slopes(chain: Chain, terms: Sequence[Term], term: Term, moved: Callable[[Sequence[Term]], Array]) -> Array:
    """Central differences of `moved` in each parameter of `term`."""
    others = [t for t in terms if t.effect.name != term.effect.name]
    out = []
    for i, parameter in enumerate(chain.parameters(term.effect)):
        step = 0.1 * parameter.typical * np.eye(len(term.values))[i]
        both = [moved([*others, replace(term, values=term.values + s * step)]) for s in (1, -1)]
        out.append((both[0] - both[1]) / (0.2 * parameter.typical))
    return np.array(out)
