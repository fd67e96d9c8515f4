"""The one list of what can be wrong with a session, what each would look like, and the poses with it undone.

`MISTAKES` owns every kind and every sentence: what is found elsewhere in screening is said through it (`problem`,
`sentence`). Of mistakes that change poses, `hypotheses` makes the poses with each one undone: those that are right
after one of these changes, and only then, say which mistake was made.
"""

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stitch.numerics import frames
from stitch.numerics.frames import Array, Indices
from stitch.screening.problems import SessionProblem
from stitch.session.robot import forward
from stitch.session.session import Mount, SessionData

# By kind, as `stitch check --deep` has it, and by name: what to say, with the words to fill in. How to correct the
# session stands behind "to fix:". Each kind says what it would look like; of the last, no kind is printed.
MISTAKES: dict[str, dict[str, str]] = {
    # Two scans, or more, close at each other's poses; the distances between targets fit under each other's names.
    "exchanged": {
        "rows": "the clouds of two rows are exchanged; to fix: exchange the clouds of these rows",
        "pair": "the scans of {pair} fit each other's poses; to fix: exchange the clouds of {pair} in views.csv",
        "cycle": "the clouds of {count} rows are mixed up; to fix: move {moves}",
        "pair with a silent scan": "the scan of {view} fits the pose of {silent}, whose own scan shows too little of "
        "the others to be placed; to fix: exchange the clouds of {view} and {silent} in views.csv, or leave both out",
        "names of targets": "{message}",
    },
    # Every scan closes at the pose of another row, or midway between two rows; all rows in one order.
    "shifted": {
        "shifted": "every cloud belongs to the pose {rows} {where} it; to fix: shift the column back",
        "text order": "the {sorted} are sorted as text (1, 10, 11, 2, …), the {others} by number; to fix: pair them "
        "by number",
        "between rows": "every pose stands half a row {where} its scan: midway between the poses of this scan and the "
        "{neighbour} one, as if it had been interpolated to another time: pair scans and poses by their own times",
        "lagging": "every pose lags its scan by {share:.0%} of the way from the one before; to fix: record each pose "
        "once the arm stands still",
    },
    "reversed": {"reversed": "the poses are in reverse order; to fix: turn the list around"},
    # The scanner's motions, or the targets, agree with all poses once these are inverted. Without joints the other
    # mount looks the same.
    "inverse": {
        "inverted": "the poses are T_flange_base, or the mount is not as stated (the size of the hand-eye shows "
        'which); to fix: invert the poses, or set mount = "{mount}" in session.toml'
    },
    # They agree with the other mount; or the scanner did not move at all.
    "mount": {
        "mount": 'the scanner is not mounted as stated; to fix: set mount = "{mount}" in session.toml',
        "common frame": "the clouds stand in one common frame already, or show mostly a wall or a table before the "
        "scanner; to fix: export them in the scanner's frame, or cut the background away (within, under [scanner])",
    },
    # Positions are right, and rotations once they are read in another order, in another unit, or from other columns.
    "euler": {
        "angle order": "the Euler angles are {right}, not {order}; to fix: convert them as {right}",
        "rotation vector": "the angles are a rotation vector, not Euler angles; to fix: convert them as such",
        "no rotation vector": "the rotation vectors are Euler angles in the order {right}; to fix: convert them as "
        "such",
    },
    "degrees": {
        "radians": "the angles are radians, and were read as degrees{order}; to fix: convert them to degrees",
        "joints": "the joint angles are radians, not degrees; to fix: convert them",
        "one joint": "{joint} alone is in radians; to fix: convert this column to degrees",
    },
    "quaternion": {
        "other way": "the quaternions turn the other way; to fix: negate qx, qy, qz",
        "w first": "the quaternion columns are w, x, y, z, not x, y, z, w; to fix: rename them",
        "w reordered": "the quaternion columns are x, y, z, w but were reordered as if w came first; to fix: undo that",
    },
    # Lengths differ by the factor between two units, of all rows, of one column or of one cloud.
    "unit": {
        "clouds": "the clouds are {factor:.6g} times as large as the poses say ({units}); to fix: correct cloud_unit "
        "or length_unit",
        "sightings": "the sightings are {factor:.6g} times as large as the poses say ({units}); to fix: correct "
        "length_unit",
        "column": "{axis} of the positions alone is in {units}; to fix: convert this column",
        "one cloud": "this cloud is {factor:.6g} times too large ({units}); to fix: export it in the right unit",
        "depth": "the clouds are {factor:.6g} times as large as the robot's motions, so a count of depth is "
        '{count:.4g} mm; to fix: write "depth_scale": {per_metre:.6g} (counts per metre) in {file}',
    },
    # By another factor; or rotations turn as the scanner did, and positions do not follow.
    "scale": {
        "factor": "the clouds are {factor} times as large as the robot's motions; to fix: check the scale of both",
        "no factor": "The robot's positions do not explain how the scanner moved; its rotations do; to fix: "
        "export the positions again",
        "scaled cloud": "this cloud is {factor:.4g} times as large as the part; to fix: multiply it by {by:.5g}",
        "stuck column": "{axis} of the positions is {value:.6g} in all rows, and the scans show that it changes; to "
        "fix: export the poses again, with this column",
    },
    "linear_axis": {
        "linear axis": "{column} is a linear axis that carries the robot, and the positions leave it out; to fix: "
        "{where}"
    },
    # Once an axis has the other sign, or two are exchanged: in all poses, or in one cloud, which closes at its own
    # pose.
    "mirrored": {
        "left-handed": "the scans, or the frames of the poses, are left-handed; to fix: look for two exchanged "
        "columns, or one with the wrong sign",
        "columns": "the columns of the positions are {columns}, not x, y, z; to fix: correct the table of poses",
        "signs": "{axes} of the positions {have} the wrong sign; to fix: correct the table of poses",
        "mirrored cloud": "{flip} in this cloud; to fix: export it again",
    },
    # The poses that follow from the joints are right once these count otherwise; or one joint alone explains a view.
    "joint_sign": {"joint sign": "{joints} {count} the other way; to fix: negate {joints} in views.csv"},
    "joint_coupling": {
        "joint coupling": "j3 is shown as it moves with j2; to fix: write j3 {sign} j2 in place of j3 in views.csv"
    },
    "joint_row": {
        "copied joints": "{view} has the joint angles of {of}, and is {off}; to fix: put in its own",
        "neighbour's joint": "{joint} of {view} reads {stated:.4f}, {fits:.4f} would fit (it is {off}); to fix: "
        "correct it",
    },
    # Two rows with the very same points, or the very same pose, of which one does not belong.
    "duplicate_scan": {
        "copied scan": "this scan is a copy of that of {of}; to fix: put the right file in its row",
        "copies": "The scans of {views} are the same points; to fix: put the right file in each row, or leave one out.",
    },
    "duplicate_pose": {"copied pose": "{view} has the pose of {of}, and is {off}; to fix: put in its own"},
    # One scan closes elsewhere than at its pose, or with one half only; poses scatter by more than arms do, and nothing
    # else explains it; distances from one target to the others step or creep, those among the others do not.
    "displaced": {
        "displaced": "its pose is {off}; to fix: correct the row, or scan again",
        "not held": "it contradicts the others by an amount that its surface does not show; to fix: add views that "
        "overlap with it, or leave it out",
        "wrong joint": "{joint} of {view} reads {stated:.4f}, {fits:.4f} would fit (it is {off}); to fix: correct it",
        "torn": "a part of this scan contradicts the other scans wherever it is put: something moved during the scan, "
        "or two scans are in one file; to fix: scan again",
        "stock": "{view} shows its surface {size} ± {U} {side} that of the others, {where}, as stock or a moved zero "
        "of the scanner would; no single motion of the view explains it, other errors of the cell may. It was taken "
        "off; to fix: nothing if the part had stock, else scan again.",
        "suspected": "the view {off}, which an effect of the arm may cause too; to fix: run and diagnose, and look at "
        "this scan",
        "unexplained": "the poses contradict the scans by {by}, more than any arm, and no usual mistake explains it; "
        "to fix: check that rows and clouds belong together and how the poses were converted",
        "unexplained targets": "the targets scatter by {by} under the best hand-eye, and no usual mistake explains "
        "it; to fix: check names of targets, rows and how the poses were converted",
        "target moved": "{target} sits elsewhere among the targets from view {view} on: its distances to the others "
        "change by up to {length}; to fix: give it another name from there on in points.csv, or leave it out.",
        "target creeps": "{target} creeps among the targets over the session: its distances to the others change by "
        "up to {length}; to fix: leave it out of points.csv, and fasten it before you measure again.",
    },
    # One scan closes nowhere, or at several places alike. Points stand at one place before the scanner whatever the arm
    # did, or where other scans look through.
    "foreign": {
        "foreign": "this scan fits nowhere on the part: it shows another part or too little; to fix: leave it out",
        "several places": "this scan overlaps too little with the others at its pose, and fits the part at several "
        "other places alike; to fix: add views that overlap with it, or leave it out",
        "background": "{share:.0%} of what the scans show stands still before the scanner: a wall, a table or a "
        "bracket. {count} views show it, each elsewhere on the part. The stitched cloud leaves out what other views "
        "look through, and may hold the rest of it; to fix: {how}, and run again.",
        "in the way": "At least {share:.0%} of what {where} {show} stands where other scans see through: a cable, an "
        "arm, a clamp or stray points. The stitched cloud leaves out what several scans see through, and may hold the "
        "rest of it; to fix: cut it out, or scan again.",
    },
    # From some row on everything fits itself, and stands elsewhere for what came before.
    "reclamped": {
        "moved": "{what} between {before} and {after}; to fix: make two sessions of it",
        "step": "From view {after} on the {moved} sits elsewhere{unsure}, {by}; to fix: make two sessions, one up to "
        "{before} and one from {after} on{further}.",
    },
    # Surfaces link one group of views, and another, and not the two.
    "disconnected": {
        "groups": "no surface links {groups}; to fix: add views between them",
        "alone": "it shares no surface with the others; to fix: add views that overlap with it",
    },
    # What is only doubted: poses disagree by more than arms repeat, or by what the table rounds; the model of another
    # run leaves more than what is fitted here.
    "doubt": {
        "part of the table": "only from {first} to {last}: {fix}",
        "rounded": "The {numbers} in the table have {decimals}: rounding alone turns each pose by {rotation:.2g} "
        "mrad; to fix: export more digits",
        "implausible scatter": "No arm scatters by {by}: several rows or scans are wrong, and hand-eye and pose "
        "errors are not reliable; to fix: check first {farthest}.",
        "few views": "{count} poses contradict their scans by {by}: {odds} to 1 that a scan or a row is off, against "
        "what ordinary arms leave; to fix: add views, since {few} do not show which.",
        "one of few views": "{count} poses contradict their scans by {by}: {odds} to 1 that a view is off, most likely "
        "{view}, against what ordinary arms leave; to fix: check its row and scan, and add views.",
        "little overlap": "These {count} views overlap too little to say how well poses and scans agree; to fix: add "
        "views that overlap with several others.",
        "no test": "No test says whether these {count} views belong together, since one hand-eye brings any together; "
        "to fix: add views.",
        "hand-eye of another set-up": "the model's hand-eye is {by} off what these scans show: it belongs to another "
        "mount, scanner or unit; to fix: run without --hand-eye",
        "model of another set-up": "under the model of the other run the targets lie {off} off, which no arm does; to "
        "fix: name a run of the same set-up, or keep its arm alone (--arm)",
        "model does not hold": "{what} (targets are {off} off with it, {fitted} with what this session shows itself); "
        "to fix: run without --hand-eye, keep the arm alone (--arm), or give targets that moved another name",
        "arm does not hold": "The arm of the other run ({effects}) does not hold here: it leaves {leaves}, the "
        "nominal arm {nominal}; calibrate it at poses like these, or run without --arm.",
        "effect of the arm": "The arm of the other run ({effects}) does not hold here: it leaves {leaves}, the "
        "nominal arm {nominal}, and without its {effect} {rest} would be left; take that out there (stitch drop).",
        "another arm": "{session} does not share the effects of this rig: they leave {shared}, fitted to it alone "
        "{separate} ({expected} on views left out); another arm, or something that has changed between the sessions: "
        "stitch each by itself.",
    },
}
_KINDS = {mistake: kind for kind, sentences in MISTAKES.items() for mistake in sentences}
_SENTENCES = {mistake: text for sentences in MISTAKES.values() for mistake, text in sentences.items()}
# Kinds that accuse single views, and leave the rest as it is; kinds that leave many views out, and a good rest. All
# others are a mistake of the whole session.
KINDS_OF_VIEWS = ("displaced", "disconnected", "foreign", "duplicate_scan", "duplicate_pose")
KINDS_LEAVING_A_REST = ("reclamped", "exchanged")
# Kinds that say that something is wrong, and not what in the session's files: the computation reaches no result.
KINDS_WITHOUT_A_CAUSE = ("displaced", "disconnected")

# Orders of Euler angles are those of Diebel (2006), "Representing Attitude": six with three axes, six with two.
ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "XYX", "XZX", "YXY", "YZY", "ZXZ", "ZYZ")
# Capitals turn about the axes that turned already (intrinsic), small letters about those that stay (extrinsic).
BOTH_ORDERS = (*ORDERS, *(order.lower() for order in ORDERS))
# Factors by which lengths are too large when units are mixed up, and how that comes about.
UNITS = {
    1000.0: "mm where m are stated",
    0.001: "m where mm are stated",
    25.4: "mm where inches are stated",
    1 / 25.4: "inches where mm are stated",
    10.0: "mm where cm are stated",
    0.1: "cm where mm are stated",
}
# A fitted factor is one between units if it is this near, or within three sigmas and the second share. No scanner's and
# no arm's own scale is off by the last one.
_UNIT_NEAR, _UNIT_FAR, _LARGEST_SCALE = 0.05, 0.2, 1.25
_OTHER_MOUNT: dict[Mount, Mount] = {"eye_to_hand": "eye_in_hand", "eye_in_hand": "eye_to_hand"}
# Without motions that accuse some rows, each pair is tried among so many views: in more, two that are exchanged neither
# move a median nor a robust fit.
MOST_EXCHANGED = 24
# Rows that a list may be shifted by.
_SHIFTS = (1, -1, 2, -2, 3, -3)
# Elements of the rotations of two motions that are one differ by less.
_SAME_TURN = 1e-3


def sentence(mistake: str, **words: Any) -> str:
    """Return what to say of a mistake of the list, with its words filled in."""
    return _SENTENCES[mistake].format(**words)


def problem(mistake: str, views: Iterable[str] = (), *, certain: bool = True, **words: Any) -> SessionProblem:
    """Return a mistake of the list as a problem of some views, by their names; of none: of the whole session."""
    return SessionProblem(_KINDS[mistake], tuple(views), sentence(mistake, **words), certain, mistake)


@dataclass(frozen=True)
class Hypothesis:
    """Poses with one mistake undone."""

    kind: str  # as in `stitch check --deep`; "stated" for the poses as they are
    T_base_flange: Array  # (V, 4, 4) of the views that are tried
    mount: Mount
    fix: str
    rows: tuple[int, ...] = ()  # whose poses change places; empty: all
    used: tuple[int, ...] | None = None  # scans that still have a pose; None: all

    @property
    def T_reference_mount(self) -> Array:
        """(V, 4, 4) as the chain of frames takes them."""
        return frames.inverse(self.T_base_flange) if self.mount == "eye_to_hand" else self.T_base_flange

    def undone(self, mistake: str, T_base_flange: Array, **words: Any) -> "Hypothesis":
        """Return the hypothesis that a mistake of `MISTAKES` was made; T_base_flange (V, 4, 4) are poses without it."""
        return replace(self, kind=_KINDS[mistake], T_base_flange=T_base_flange, fix=sentence(mistake, **words))


def stated_hypothesis(session: SessionData, rows: Indices | None = None) -> Hypothesis:
    """Return the poses as stated, of some rows or of all."""
    T = np.array([view.T_base_flange for view in session.views])
    return Hypothesis("stated", T if rows is None else T[rows], session.mount, "")


def hypotheses(
    session: SessionData, rows: Indices | None = None, exchangeable: Sequence[int] | None = None
) -> list[Hypothesis]:
    """Return the poses as stated, first, and then with every single mistake undone that these poses could have.

    Args:
        rows: numbers of the views that are tried; None: all.
        exchangeable: positions among `rows` of views that may have changed places; None: all, if they are few.
    """
    every = np.arange(len(session.views)) if rows is None else rows
    stated = stated_hypothesis(session, every)
    if exchangeable is None:
        exchangeable = range(len(every)) if len(every) <= MOST_EXCHANGED else ()
    of_rows = _row_mistakes(session, stated, every, exchangeable)
    if session.axes:
        # Axes move what poses and joints say: only whole rows are tried.
        return [stated, *of_rows]
    return [stated, *_joint_mistakes(session, stated, every), *_pose_mistakes(stated), *of_rows]


def _joint_mistakes(session: SessionData, stated: Hypothesis, rows: Indices) -> Iterator[Hypothesis]:
    """Yield the poses without a mistake of joint angles or of the mount.

    Without joints, another mount looks like inverted poses: then one hypothesis stands for both.
    """
    robot = session.robot
    T = stated.T_base_flange
    other_mount = _OTHER_MOUNT[session.mount]
    if robot is None or session.joints is None:
        yield stated.undone("inverted", frames.inverse(T), mount=other_mount)
        return
    q = session.joints[rows]
    yield replace(stated.undone("mount", T, mount=other_mount), mount=other_mount)
    yield stated.undone("joints", forward(robot, q * (180 / np.pi)))
    if not np.allclose(forward(robot, q), T, rtol=0, atol=1e-6 * np.abs(T).max()):
        # The poses were not taken from the joints.
        return
    for mistake, change, words in _joint_changes(q.shape[1]):
        yield stated.undone(mistake, forward(robot, q @ change.T), **words)


def _joint_changes(count: int) -> Iterator[tuple[str, Array, dict[str, str]]]:
    """Yield the name of a mistake, the matrix (n, n) that undoes it on the joint angles, and the words of its sentence.

    Mistakes: signs of one or two joints, one joint in radians, joint 3 coupled to joint 2.
    """
    names = [f"j{j + 1}" for j in range(count)]
    for turned in (*combinations(range(count), 1), *combinations(range(count), 2)):
        signs = np.diag([-1.0 if j in turned else 1.0 for j in range(count)])
        joints = " and ".join(names[j] for j in turned)
        yield "joint sign", signs, {"joints": joints, "count": "counts" if len(turned) == 1 else "count"}
    for j in range(count):
        factors = np.eye(count)
        factors[j, j] = 180 / np.pi
        yield "one joint", factors, {"joint": names[j]}
    if count > 2:
        for value, sign in ((1.0, "+"), (-1.0, "-")):
            coupling = np.eye(count)
            coupling[2, 1] = value
            yield "joint coupling", coupling, {"sign": sign}


def _pose_mistakes(stated: Hypothesis) -> Iterator[Hypothesis]:
    """Yield the poses without a mistake that changes all of them alike: rotations, handedness, positions, frame."""
    T = stated.T_base_flange
    position = T[:, :3, 3]
    for mistake, turned, words in _other_rotations(Rotation.from_matrix(T[:, :3, :3])):
        yield stated.undone(mistake, frames.make(turned.as_matrix(), position), **words)
    flip = np.diag([-1.0, 1, 1])
    yield stated.undone("left-handed", frames.make(flip @ T[:, :3, :3] @ flip, position @ flip))
    for mistake, moved, words in _other_positions(position):
        yield stated.undone(mistake, frames.make(T[:, :3, :3], moved), **words)
    yield stated.undone("common frame", np.broadcast_to(np.eye(4), T.shape))


def _other_rotations(R: Rotation) -> Iterator[tuple[str, Rotation, dict[str, str]]]:
    """Yield the name of a mistake, the V rotations without it, and the words of its sentence.

    Quaternions with another sign or order, Euler angles of another order, radians read as degrees.
    """
    # SciPy's order: x, y, z, w.
    q = R.as_quat()
    yield "other way", R.inv(), {}
    yield "w first", Rotation.from_quat(q[:, [1, 2, 3, 0]]), {}
    yield "w reordered", Rotation.from_quat(q[:, [3, 0, 1, 2]]), {}
    yield from _other_orders(R)
    yield "radians", Rotation.from_rotvec(R.as_rotvec() * 180 / np.pi), {"order": ""}
    for order in ORDERS:
        turned = Rotation.from_euler(order, euler_angles(R, order) * 180 / np.pi)
        yield "radians", turned, {"order": f" ({_order_name(order)})"}


def _other_orders(R: Rotation) -> Iterator[tuple[str, Rotation, dict[str, str]]]:
    """Yield the name of a mistake, the V rotations without it, and words: Euler angles read in a wrong order.

    Columns may belong to places in the order, or to axes by name. Rotation vectors read as angles, and the other way
    round, are tried too.
    """
    for order in BOTH_ORDERS:
        angles = euler_angles(R, order)
        for right in BOTH_ORDERS:
            if right != order:
                words = {"right": _order_name(right), "order": _order_name(order)}
                yield "angle order", Rotation.from_euler(right, angles), words
        if len(set(order.upper())) == 3:
            for right in ORDERS[:6]:
                if right != order:
                    by_axis = np.column_stack([angles[:, order.upper().index(axis)] for axis in right])
                    words = {"right": _order_name(right), "order": _order_name(order)}
                    yield "angle order", Rotation.from_euler(right, by_axis), words
        yield "rotation vector", Rotation.from_rotvec(_shortest(angles)), {}
    for right in BOTH_ORDERS:
        yield "no rotation vector", Rotation.from_euler(right, R.as_rotvec()), {"right": _order_name(right)}


def _order_name(order: str) -> str:
    """Return an order of Euler angles in words: xyz-intrinsic, zyx-extrinsic."""
    return f"{order.lower()}-{'intrinsic' if order.isupper() else 'extrinsic'}"


def euler_angles(R: Rotation, order: str) -> Array:
    """Return Euler angles (V, 3), rad, in an order as SciPy has it: "XYZ" about moving axes, "xyz" about fixed ones."""
    with warnings.catch_warnings():
        # Gimbal lock sets an angle to zero: that reading is one of those to try.
        warnings.simplefilter("ignore")
        return R.as_euler(order)


def _shortest(angles: Array) -> Array:
    """Return the shorter of the two triples of angles that make one rotation: vectors are at most π long."""
    other = np.stack([angles[:, 0] - np.pi, np.pi - angles[:, 1], angles[:, 2] - np.pi], axis=1)
    other = (other + np.pi) % (2 * np.pi) - np.pi
    shorter = np.linalg.norm(other, axis=1) < np.linalg.norm(angles, axis=1)
    return np.where(shorter[:, None], other, angles)


def _other_positions(position: Array) -> Iterator[tuple[str, Array, dict[str, str]]]:
    """Yield the name of a mistake, the positions (V, 3) without it, and words: columns, signs, or a column's unit.

    One or two wrong signs: three are a left-handed frame, which is tried elsewhere.
    """
    for order in permutations(range(3)):
        if order != (0, 1, 2):
            yield "columns", position[:, order], {"columns": ", ".join("xyz"[i] for i in np.argsort(order))}
    for signs in product((1.0, -1.0), repeat=3):
        wrong = [axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0]
        if len(wrong) in (1, 2):
            words = {"axes": " and ".join(wrong), "have": "has" if len(wrong) == 1 else "have"}
            yield "signs", position * signs, words
    for column, axis in enumerate("xyz"):
        for factor, units in UNITS.items():
            right = np.array(position)
            right[:, column] /= factor
            yield "column", right, {"axis": axis, "units": units}


def _row_mistakes(
    session: SessionData, stated: Hypothesis, rows: Indices, exchangeable: Sequence[int]
) -> Iterator[Hypothesis]:
    """Yield the poses without a mistake of their order: reversed, sorted as text, shifted, or two rows exchanged.

    Args:
        rows: numbers of the views that are tried.
        exchangeable: positions among `rows` of views of which two may be exchanged.
    """
    T = stated_hypothesis(session).T_base_flange
    count = len(T)
    yield stated.undone("reversed", T[::-1][rows])
    # File names may count from 0 or from 1.
    for first in (0, 1):
        as_text = np.argsort([str(v + first) for v in range(count)])
        yield stated.undone("text order", T[as_text][rows], sorted="clouds", others="poses")
        yield stated.undone("text order", T[np.argsort(as_text)][rows], sorted="poses", others="clouds")
    for shift in (shift for shift in _SHIFTS if abs(shift) < count - 2):
        # Scans at the end of the list have no pose left.
        used = np.flatnonzero((rows + shift >= 0) & (rows + shift < count))
        named = f"{abs(shift)} row{'s' * (abs(shift) > 1)}"
        where = "below" if shift > 0 else "above"
        shifted = stated.undone("shifted", np.roll(T, -shift, axis=0)[rows], rows=named, where=where)
        yield replace(shifted, used=tuple(used.tolist()))
    for a, b in combinations(exchangeable, 2):
        order = np.arange(len(stated.T_base_flange))
        order[[a, b]] = [b, a]
        yield replace(stated.undone("rows", stated.T_base_flange[order]), rows=(a, b))


def distinct(tried: Sequence[Hypothesis], length: float) -> list[Hypothesis]:
    """Return the hypotheses without those that have the same relative motions as an earlier one.

    Those that do not use all views are all kept.

    Args:
        length: largest difference of a translation, length_unit; that of an element of a rotation is `_SAME_TURN`.
    """
    kept = list[Hypothesis]()
    signatures = np.empty((len(tried), 0))
    for h in tried:
        relative = frames.inverse(h.T_reference_mount[:1]) @ h.T_reference_mount[1:]
        # Twelve numbers a motion: those of the first one tell most hypotheses apart, and are compared first.
        turned_and_moved = [relative[:, :3, :3].reshape(-1, 9) / _SAME_TURN, relative[:, :3, 3] / length]
        signature = np.concatenate(turned_and_moved, axis=1).ravel()
        if not signatures.size:
            signatures = np.empty((len(tried), len(signature)))
        off = np.abs(signatures[: len(kept), :12] - signature[:12]).max(axis=1, initial=0.0)
        alike = np.flatnonzero(off < 1)
        if h.used is None and (np.abs(signatures[alike] - signature).max(axis=1) < 1).any():
            continue
        signatures[len(kept)] = signature
        kept.append(h)
    return kept


def known_unit_ratio(scale: float, sigma: float = 0.0) -> float | None:
    """Return the factor of `UNITS` that a fitted scale is, None where it is none.

    Args:
        sigma: standard error of `scale`: within three of it the two may differ, but by no more than `_UNIT_FAR`.
    """
    if scale <= 0:
        return None
    factor = min(UNITS, key=lambda unit: abs(np.log(scale / unit)))
    near = np.clip(3 * sigma / factor, _UNIT_NEAR, _UNIT_FAR)
    return factor if abs(scale / factor - 1) < near else None


def scale_text(scale: float, sigma: float = 0.0) -> str:
    """Return what a fitted factor between clouds and robot says, without the factor where lengths cannot differ so."""
    unit = known_unit_ratio(scale, sigma)
    if unit is not None or 1 / _LARGEST_SCALE <= scale <= _LARGEST_SCALE:
        return sentence("factor", factor=f"{scale:.5g}" if unit is None else f"{unit:.6g}")
    return sentence("no factor")
