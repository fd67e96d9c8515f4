"""Which parts of the hand-eye the motions of a session cannot show, in words.

Moving the hand-eye by ξ moves every view by Ad(T_v) ξ. What is common to all views moves the whole
part and cannot be seen; the rest is what overlaps can show. The rms of that rest per unit of ξ, both
as displacements of the part, is a pure number: at 0.01 a millimetre of error moves the views apart
by ten micrometres.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.errors import NoResultError
from stitch.numerics import frames
from stitch.numerics.frames import Array
from stitch.session import robot as kinematics
from stitch.session.capture import Capture
from stitch.session.robot import Robot
from stitch.session.scan import centroid, spread

# Names of the hand-eye's numbers: position, then rotation vector.
NUMBERS = ("x", "y", "z", "rx", "ry", "rz")
# A direction of the hand-eye of a smaller gain (`motion_gain`, a pure number) is not shown by the motions.
_VISIBLE = 0.01
# Step of a derivative, as a share of what moves the part by its unit.
_SMALL = 1e-4
# Directions within 2° are parallel.
_PARALLEL = np.cos(np.radians(2.0))
# Joints that turn by less stand still.
_TURNED = np.radians(0.5)


def seen_part(captures: Sequence[Capture], scanner: int = 0) -> tuple[Array, float]:
    """Return the centre (3,) of what a scanner saw, scanner frame, and the size of the part, length_unit."""
    every = [points for c in captures for points in c.seen_by(scanner)]
    centre = np.asarray(np.mean([centroid(p) for p in every], axis=0))
    size = float(np.median([spread(p) for p in every]))
    # A probe is a point: a tenth of its distance stands in for its size.
    return centre, size or 0.1 * float(np.linalg.norm(centre))


def motion_gain(
    captures: Sequence[Capture], T_mount: Array, centre: Array, size: float, scanner: int = 0
) -> tuple[Array, Array]:
    """Return gains (6,), ascending, of six directions of the hand-eye, and these directions (6, 6) as columns.

    A direction is a twist ξ of the hand-eye, T_mount·exp(ξ), about the part's centre in the scanner's frame. It moves
    view v by Ad(T_v) ξ. Its gain is the rms over the views of that motion less its mean, per unit of ξ, both as
    displacements of the part: 0 where the motions of the session show nothing of it.

    With several scanners the hand-eyes of the others are free: a direction that they can undo has no gain.

    Args:
        T_mount: (4, 4) T_flange_scanner or T_base_scanner.
        centre: (3,) of the part, scanner frame. About it, a rotation of the scanner is not mistaken for the translation
            that it causes at the part.
        size: of the part, length_unit: what makes a rotation a displacement.
        scanner: number of the scanner that moves, among several.
    """
    about = frames.make(np.eye(3), centre)
    scale = np.diag([1 / size] * 3 + [1.0] * 3)
    scanners = 1 + max((int(c.scanner.max()) for c in captures if c.scanner is not None), default=0)
    # Σ JᵀJ over the views, with J the motion of a view per twist of each scanner's hand-eye, less its mean.
    squares, views = np.zeros((6 * scanners, 6 * scanners)), 0
    for capture in captures:
        poses = capture.poses(T_mount) @ about
        J = np.linalg.inv(scale) @ frames.adjoint_about(poses[:, :3, 3].mean(axis=0), poses) @ scale
        if capture.scanner is not None:
            is_own = np.eye(scanners)[capture.scanner]
            J = np.einsum("vij,vs->visj", J, is_own).reshape(len(poses), 6, -1)
        J = J - J.mean(axis=0)
        squares += np.einsum("vij,vik->jk", J, J)
        views += len(poses)
    if scanners > 1:
        # The Schur complement lets the other scanners go where they fit best.
        own = np.arange(6 * scanner, 6 * scanner + 6)
        rest = np.setdiff1d(np.arange(len(squares)), own)
        across = squares[np.ix_(own, rest)] @ np.linalg.pinv(squares[np.ix_(rest, rest)], rcond=1e-9, hermitian=True)
        squares = squares[np.ix_(own, own)] - across @ squares[np.ix_(rest, own)]
    values, vectors = np.linalg.eigh(squares / views)
    return np.sqrt(np.maximum(values, 0)), scale @ vectors


def visible_twists(captures: Sequence[Capture], T_mount: Array, part: tuple[Array, float]) -> Array:
    """Return a basis (6, k) of the twists ξ of the hand-eye, T_mount·exp(ξ), that the motions show: all six, if k = 6.

    Along the others nothing may be fitted: what rounded poses seem to say there is thousands of times the truth.

    Args:
        part: centre (3,) in the scanner's frame and size in length_unit, of `seen_part`.

    Raises:
        NoResultError: the motions show none.
    """
    gains, directions = motion_gain(captures, T_mount, *part)
    if gains[-1] < _VISIBLE:
        raise NoResultError(
            f"{captures[0].name}: the flange stands at one place in all views, which shows nothing of the hand-eye; to "
            "fix: turn it by 20° and more about two axes between the views"
        )
    if gains[0] >= _VISIBLE:
        return np.eye(6)
    columns = frames.adjoint(frames.make(np.eye(3), part[0])) @ directions[:, gains >= _VISIBLE]
    # A turn about the part carries the scanner along; where it stands is not seen, so there it stays.
    shifts = hidden_translations(captures, T_mount)
    columns[3:] -= shifts @ (shifts.T @ columns[3:])
    return columns


def hidden_translations(captures: Sequence[Capture], T_mount: Array) -> Array:
    """Return unit vectors (3, k), scanner frame, along which no view shows a shift of the hand-eye.

    A shift d of the scanner in the mount's frame moves view v by R_v d. Views show what differs between them,
    (R_v − mean R) d, so that the hidden d are the eigenvectors of its mean square whose eigenvalue is nearly zero.

    Args:
        T_mount: (4, 4) maps scanner to mount.
    """
    total, views = np.zeros((3, 3)), 0
    for capture in captures:
        R = capture.T_reference_mount[:, :3, :3]
        deviation = R - R.mean(axis=0)
        total += np.einsum("vji,vjk->ik", deviation, deviation)
        views += len(R)
    values, vectors = np.linalg.eigh(total / views)
    return T_mount[:3, :3].T @ vectors[:, values < _VISIBLE**2]


def unknown_numbers(captures: Sequence[Capture], T_mount: Array, scanner: int = 0) -> tuple[str, ...]:
    """Return the names among x, y, z, rx, ry, rz of the hand-eye's numbers that the motions do not determine.

    They are position and rotation vector of T_mount, in the frame that carries the scanner. A number is undetermined if
    a twist of gain below `_VISIBLE` (see `motion_gain`) changes it, as a displacement at the part, by more than that
    share of the twist's own displacement.

    Args:
        T_mount: (4, 4) of the first scanner.
        scanner: number of the scanner that is asked about.
    """
    centre, size = seen_part(captures, scanner)
    gains, directions = motion_gain(captures, T_mount, centre, size, scanner)
    T_mount = _own_mount(captures, T_mount, scanner)
    at_scanner = frames.adjoint(frames.make(np.eye(3), centre)) @ directions[:, gains < _VISIBLE]
    moved = T_mount @ frames.exp(_SMALL * at_scanner.T)
    turned = Rotation.from_matrix(moved[:, :3, :3]).as_rotvec() - Rotation.from_matrix(T_mount[:3, :3]).as_rotvec()
    changes = np.concatenate([moved[:, :3, 3] - T_mount[:3, 3], size * turned], axis=1) / _SMALL
    return tuple(np.array(NUMBERS)[np.linalg.norm(changes, axis=0) > _VISIBLE].tolist())


def _own_mount(captures: Sequence[Capture], T_mount: Array, scanner: int) -> Array:
    """Return the hand-eye (4, 4) of one of several scanners from that of the first."""
    of_view, behind = captures[0].scanner, captures[0].T_behind_mount
    return T_mount if of_view is None or behind is None else T_mount @ behind[of_view == scanner][0]


def unobservable(
    captures: Sequence[Capture],
    T_mount: Array,
    robot: Robot | None = None,
    joints: Array | None = None,
    scanner: int = 0,
) -> tuple[str, ...]:
    """Return one phrase per direction of the hand-eye that these motions cannot show, as "translation along …".

    Args:
        T_mount: (4, 4) of the first scanner.
        robot, joints: kinematics and joint angles (V, n) rad, if known: a direction may then be named after a joint.
        scanner: number of the scanner that is asked about.
    """
    gains, directions = motion_gain(captures, T_mount, *seen_part(captures, scanner), scanner)
    axes = _named_axes(captures, robot, joints)
    # No joint's axis is farther from the part: the largest distance of a scanner from the reference frame, its distance
    # from the mount, and that of the part from the scanner.
    ways = [np.linalg.norm(frames.inverse(c.poses(T_mount))[:, :3, 3], axis=1).max() for c in captures]
    reach = max(ways) + np.linalg.norm(T_mount[:3, 3]) + np.linalg.norm(seen_part(captures)[0])
    hidden = _split(directions[:, gains < _VISIBLE], float(reach))
    T_mount = _own_mount(captures, T_mount, scanner)
    return tuple(f"{kind} {_name(T_mount[:3, :3] @ direction, axes)}" for kind, direction in hidden)


def _split(hidden: Array, reach: float) -> list[tuple[str, Array]]:
    """Return k pairs (kind, unit direction (3,), scanner frame) that span the hidden twists, translations first.

    Args:
        hidden: (6, k) twists about the part's centre, rotation first.
        reach: length_unit; a rotation about an axis farther off than this counts as a translation.
    """
    if hidden.shape[1] == 0:
        return []
    # Combinations of the twists in the order of how much they turn (singular values `turned`).
    U, turned, Vt = np.linalg.svd(hidden[:3])
    shifted = np.linalg.norm(hidden[3:] @ Vt[: len(turned)].T, axis=0)
    rank = int(np.sum(turned * reach > shifted))
    kinds = [("translation along", v) for v in (hidden[3:] @ Vt[rank:].T).T]
    kinds += [("rotation about", U[:, i]) for i in range(rank)]
    return [(kind, v / np.linalg.norm(v)) for kind, v in kinds]


def _named_axes(captures: Sequence[Capture], robot: Robot | None, joints: Array | None) -> dict[str, Array]:
    """Return by name the directions (3,), mount frame, that people have a word for; {} where there are none.

    They are the axes of joints that move, where these stand still in the mount frame, and the one axis about which all
    views of the first capture were turned, if there is one.
    """
    axes = dict[str, Array]()
    first = captures[0]
    if robot is not None and joints is not None:
        T_base_flange = kinematics.forward(robot, joints)
        _, base_axes = kinematics.joint_axes(robot, joints)
        for i in np.flatnonzero(np.ptp(joints, axis=0) > _TURNED):
            axis = base_axes[:, i]
            if first.scanner_rides:
                axis = np.einsum("vji,vj->vi", T_base_flange[:, :3, :3], axis)
            # A joint's axis has a place in the mount frame only while it does not move there.
            if np.linalg.norm(axis.mean(axis=0)) > _PARALLEL:
                axes[f"the axis of joint {i + 1}"] = axis.mean(axis=0)
    # One axis if the rotation vectors from the first view to the others are parallel: one singular value beside zero.
    motions = frames.log(frames.inverse(first.T_reference_mount[:1]) @ first.T_reference_mount[1:])[:, :3]
    _, s, Vt = np.linalg.svd(motions, full_matrices=False)
    if len(s) and s[0] > 1e-9 and np.all(s[1:] < 0.02 * s[0]):
        axes["the axis about which all views were turned"] = Vt[0]
    return axes


def _name(direction: Array, axes: dict[str, Array]) -> str:
    """Return a direction (3,) in words: the axis that it is parallel to, or its components."""
    for name, axis in axes.items():
        if abs(float(direction @ axis)) / np.linalg.norm(axis) > _PARALLEL:
            return name
    rounded = ", ".join(f"{x:+.2f}" for x in direction * np.sign(direction[np.abs(direction).argmax()]))
    return f"({rounded}) of the frame that carries the scanner"
