"""Kinematic calibration of a robot: the arm as a table of links that is proved, and the poses that would tell more.

Offsets and links of a model are right beside its compliance and its gears, which no table holds; without these they
may leave more than the nominal arm does. So the table is fitted alone: all offsets and links, each with a prior of
what makers' tolerances are. How far they are trusted is told by whole ends of the joints' ranges that are left out,
since what imitates a gear where it was measured errs elsewhere. The proof: fitted without such an end, it is written
and read back, and that end is run with it and with the nominal arm, base and tool fitted anew for either.
"""

import tempfile
import tomllib
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from stitch.api.pipeline import run
from stitch.diagnosis.candidate_views import candidate_measurement, candidate_rows, nearby
from stitch.effects.contract import EFFECTS
from stitch.errors import InputError, NoResultError
from stitch.model.model import ARM_PLACES, Model, Term, sizes_of, stack_parameters, term_of, with_parameter_values
from stitch.numerics import frames
from stitch.numerics.frames import Array, Mask
from stitch.numerics.least_squares import equilibrated, significantly_smaller
from stitch.numerics.reml import fit_variances, whitener
from stitch.numerics.units import length_text
from stitch.output.result_document import result_document
from stitch.output.session_files import dh_rows, robot_toml
from stitch.output.urdf_file import to_urdf
from stitch.run_data import RunData
from stitch.session.axis_poses import reported_poses
from stitch.session.reading.csv_files import read_csv_rows
from stitch.session.reading.robot_description import robot_from_dh, robot_from_urdf
from stitch.session.reading.views_table import POSE_COLUMNS
from stitch.session.robot import Robot, elementary, forward
from stitch.session.session import SessionData, View

# The effects that DH rows can express.
GEOMETRY = ("joint_offset", "link_geometry")
_PROPOSED, _TRIED = 6, 250
# Sizes of the prior that are tried, in plausible sizes of each parameter.
LINK_TRUSTS = tuple(2.0**k for k in range(-6, 3))
# Share of the views that an end holds; joints that turn less than so much, rad, have none.
_END = 1 / 3
_STILL = 0.05
# The table is proved at so many ends, of the joints that turn farthest.
_ENDS_PROVED = 6
_CHANCE = 0.01  # that a table which is no better than the nominal arm is said to be
_FEWEST_VIEWS = 12
_NUMBERS_EACH = 3
_UNSEEN = 1e-9  # of the largest eigenvalue: what these views do not show of hand-eye and targets
_HEADER = "The [robot] table of session.toml: put it there in place of the nominal one."


def calibrated_robot_of_run(run: RunData) -> Robot:
    """The session's robot with the joint offsets and link errors of a run.

    Raises:
        InputError: the session has no robot with joints.
    """
    robot = run.session.robot
    if robot is None or not run.measurement.views.joints.shape[1]:
        raise InputError(f"{run.session.path}: no joint angles or no [robot]; a kinematic calibration needs both")
    return with_geometry(robot, run.terms)


def arm_effects(terms: Sequence[Term]) -> tuple[list[str], list[str]]:
    """The effects of the arm that a table of links can hold, and those that none can."""
    of_arm = [term.name for term in terms if term.effect.place in ARM_PLACES]
    return [name for name in of_arm if name in GEOMETRY], [name for name in of_arm if name not in GEOMETRY]


def beyond_sentence(terms: Sequence[Term], in_table: Collection[str] = GEOMETRY) -> str:
    """What a table of links cannot hold, and what it could but does not.

    Args:
        in_table: effects in the table that is written.
    """
    held, beyond = arm_effects(terms)
    sentences = []
    if unproved := [name for name in held if name not in in_table]:
        sentences.append(f"Found, but not in it for want of proof: {', '.join(unproved)}; model.toml has it.")
    if beyond:
        sentences.append(f"Not in it, because no table of links can hold it: {', '.join(beyond)}; model.toml has it.")
    return " ".join(sentences) or "The model has no other effect of the arm."


def with_geometry(robot: Robot, terms: Sequence[Term]) -> Robot:
    """The arm with offsets on its joints and errors in its rows, exactly as the effects put them into the chain."""
    values = {term.name: term.arguments for term in terms if term.name in GEOMETRY}
    n = np.zeros(robot.n_joints)
    offset = values.get("joint_offset", {"d": n})["d"]
    links = values.get("link_geometry", {"da": n, "dd": n, "dalpha": n})
    x_error, z_error = elementary("x", links["dalpha"], links["da"]), elementary("z", 0, links["dd"])
    if robot.convention == "modified":
        before, after = robot.before @ x_error, robot.after @ z_error
    else:
        before, after = robot.before, z_error @ robot.after @ x_error
    robot = replace(robot, before=before, after=after, theta=robot.theta + offset)
    if robot.a is None or robot.alpha is None or robot.d is None:
        return robot
    errors = {"a": robot.a + links["da"], "alpha": robot.alpha + links["dalpha"], "d": robot.d + links["dd"]}
    return replace(robot, **errors)


def poses_to_add(run: RunData) -> Array:
    """(K, n) joint angles in degrees whose measurement would tell most of the effects' parameters.

    The determinant of the parameters' covariance falls most (D-optimal design, Fedorov 1972), one pose after
    the other, each seen beside those before it.
    """
    targets = run.targets
    if targets is None or not run.terms:
        return np.zeros((0, run.measurement.views.joints.shape[1]))
    joints = nearby(run.measurement.views.joints)[:_TRIED]
    rows, columns = candidate_rows(
        candidate_measurement(run.measurement, joints), targets.rows, targets.landmarks, run.terms
    )
    covariance = rows.mixed_model(rows.hand_eye).covariance(targets.variances)
    sigmas = np.array([p.sigma for p in stack_parameters(run.terms)])
    keep = np.isfinite(sigmas)
    half = np.linalg.inv(np.linalg.cholesky(covariance))
    # In units of what is known now: an information of one doubles it.
    white = half @ np.concatenate(columns, axis=2)[..., keep] * sigmas[keep]
    known = np.eye(int(keep.sum()))
    chosen = list[int]()
    for _ in range(min(_PROPOSED, len(joints))):
        gains = [np.linalg.slogdet(known + w.T @ w)[1] if k not in chosen else -np.inf for k, w in enumerate(white)]
        chosen.append(int(np.argmax(gains)))
        known = known + white[chosen[-1]].T @ white[chosen[-1]]
    return np.degrees(joints[chosen])


@dataclass(frozen=True)
class LinkTable:
    """The arm that is written, and what proves it; rms of targets in ranges that took no part, length_unit."""

    robot: Robot
    effects: tuple[str, ...]  # in it; none: the nominal arm
    heldout_rms: float = np.nan
    nominal_rms: float = np.nan
    ranges: Array | None = None  # (n, 2) rad, of the joints that the proof covers
    on_others: tuple[tuple[str, str, str], ...] = ()  # other sessions: what it leaves there, and the nominal arm

    def sentence(self, unit: str) -> str:
        """What the table is worth."""
        if np.isnan(self.nominal_rms):
            return "These views are too few to prove a table of links on a part of them: it is that of the nominal arm."
        here, nominal = length_text(self.heldout_rms, unit), length_text(self.nominal_rms, unit)
        if not self.effects and self.on_others:
            name, there, nominal = self.on_others[-1]
            left = f"The best table leaves {there} on session {name}, the nominal {nominal}"
            return f"{left}; it is that of the nominal arm."
        if not self.effects:
            return (
                f"No table of links is better than the nominal one: read back, the best leaves {here} at ends of the "
                f"joints' ranges that were left out, the nominal {nominal}; it is that of the nominal arm."
            )
        elsewhere = "".join(f" On session {name} it leaves {a}, the nominal {b}." for name, a, b in self.on_others)
        return (
            f"Fitted for the table alone and read back, it leaves {here} at ends of the joints' ranges that were left "
            f"out, the nominal {nominal}.{elsewhere}"
        )


def link_table(session: SessionData, others: Sequence[SessionData] = ()) -> LinkTable:
    """The table that the ends of the joints' ranges trust; the nominal one where none leaves clearly less, or where it
    leaves more on another session.

    Raises:
        InputError: the session has no robot with joints.
    """
    nominal = session.robot
    if nominal is None or session.joints is None:
        raise InputError(f"{session.path}: no [robot] with joint angles; a table of its links needs them")
    try:
        seen = observe_links(session)
    except (InputError, NoResultError):
        return LinkTable(nominal, ())
    ends = _ends(seen.joints)
    if len(seen.joints) < _FEWEST_VIEWS or not ends:
        return LinkTable(nominal, ())
    trust = min((0.0, *LINK_TRUSTS), key=lambda scale: sum(seen.left_at(end, scale) for end in ends))
    widest = np.argsort(-np.ptp(seen.joints, axis=0))[: _ENDS_PROVED // 2]
    proof = [(end, seen.table(nominal, trust, ~end)) for end in _ends(seen.joints, widest.tolist())]
    judged = _judge(session, seen.names, proof)
    plain = _judge(session, seen.names, [(end, None) for end, _ in proof])
    if judged is None or plain is None:
        return LinkTable(nominal, ())
    heldout_rms = float(np.sqrt(np.nanmean(judged)))
    nominal_rms = float(np.sqrt(np.nanmean(plain)))
    if not trust or not significantly_smaller(judged, plain, _CHANCE):
        return LinkTable(nominal, (), heldout_rms, nominal_rms)
    ranges = np.stack([seen.joints.min(axis=0), seen.joints.max(axis=0)], axis=1)
    robot = seen.table(nominal, trust, np.ones(len(seen.joints), bool))
    on_others = list[tuple[str, str, str]]()
    for other in others:
        read = _read_back(robot, other.length_unit)
        leaves, nominal_leaves = (run(of).residual_rms for of in (_with_reported_arm(other, read), other))
        texts = length_text(leaves, other.length_unit), length_text(nominal_leaves, other.length_unit)
        on_others.append((other.name, *texts))
        if leaves > nominal_leaves:
            return LinkTable(nominal, (), heldout_rms, nominal_rms, on_others=tuple(on_others))
    names = tuple(term.name for term in seen.terms)
    return LinkTable(robot, names, heldout_rms, nominal_rms, ranges, tuple(on_others))


def _ends(joints: Array, of: Sequence[int] | None = None) -> list[Mask]:
    """(V,) views at each end of the range of each joint that turns, or of some joints."""
    turning = np.flatnonzero(np.ptp(joints, axis=0) > _STILL) if of is None else of
    low, high = np.quantile(joints, [_END, 1 - _END], axis=0)
    return [mask for k in turning for mask in (joints[:, k] <= low[k], joints[:, k] >= high[k])]


@dataclass(frozen=True)
class SeenLinks:
    """What V views that show targets tell of offsets and links about the nominal arm, whitened."""

    names: tuple[str, ...]
    joints: Array  # (V, n) rad
    terms: tuple[Term, ...]
    unknowns: int  # of hand-eye and targets
    products: Array  # (V, k, k) of every view's columns: theirs, P parameters' in plausible sizes, what is left

    def _without_base(self, views: Mask) -> Array:
        """(P + 1, P + 1) products of parameters and rest, hand-eye and targets fitted anew to these views."""
        whole, unit = equilibrated(self.products[views].sum(axis=0))
        a = self.unknowns
        rest = whole[a:, a:] - whole[a:, :a] @ np.linalg.pinv(whole[:a, :a], _UNSEEN, hermitian=True) @ whole[:a, a:]
        return rest / np.outer(unit[a:], unit[a:])

    def fit(self, views: Mask, scale: float) -> Array:
        """(P,) in plausible sizes, with a prior of so many of them."""
        rest = self._without_base(views)
        if not scale:
            return np.zeros(len(rest) - 1)
        return np.asarray(np.linalg.solve(rest[:-1, :-1] + np.eye(len(rest) - 1) / scale**2, rest[:-1, -1]), float)

    def left_at(self, end: Mask, scale: float) -> float:
        """The sum of squares there under what the other views tell."""
        step = np.append(-self.fit(~end, scale), 1.0)
        return float(step @ self._without_base(end) @ step)

    def table(self, nominal: Robot, scale: float, views: Mask) -> Robot:
        """The arm that some views tell of."""
        values = self.fit(views, scale) * sizes_of(self.terms)
        return with_geometry(nominal, with_parameter_values(self.terms, values))


def observe_links(session: SessionData) -> SeenLinks:
    """Linearise the targets of a session about its nominal arm."""
    fit = run(session)
    if fit.targets is None or fit.session.joints is None:
        raise InputError(f"{session.path}: no labelled points or no joint angles; a calibration needs both")
    rows = fit.targets.rows
    measurement = fit.measurement
    terms = tuple(term_of(measurement, EFFECTS[name]) for name in GEOMETRY if name in EFFECTS)
    columns = np.concatenate(rows.effect_columns(measurement, Model(rows.T_mount), terms), axis=2) * sizes_of(terms)
    base = np.concatenate([rows.hand_eye, rows.landmarks], axis=2)
    every = rows.mixed_model(np.concatenate([base, columns], axis=2))
    # Of few numbers all columns together leave no scatter to be seen.
    enough = every.size > _NUMBERS_EACH * every.A.shape[2]
    variances = fit_variances(every, both_starts=True).variances if enough else fit.targets.variances
    half = whitener(rows.mixed_model(base), variances)
    V = len(rows.lever)
    shown = np.flatnonzero(np.asarray(rows.used.any(axis=1))[:V])
    white = (half @ np.concatenate([base, columns, every.z[..., None]], axis=2))[shown]
    names = tuple(fit.session.names[v] for v in shown)
    products = white.transpose(0, 2, 1) @ white
    return SeenLinks(names, fit.session.joints[shown], terms, base.shape[2], products)


def _judge(session: SessionData, names: Sequence[str], proof: Sequence[tuple[Mask, Robot | None]]) -> Array | None:
    """(V,) mean squares of the targets' distances in views that took no part, with each arm as its file says it; NaN
    where a view was never left out. None where a part is too little for it.

    Args:
        proof: (V,) views that are judged, and the arm; None: the nominal one.
    """
    number = {name: k for k, name in enumerate(names)}
    total, count = np.zeros((2, len(names)))
    try:
        for end, robot in proof:
            left_out = {name for name, out in zip(names, end, strict=True) if out}
            part = session.without([view.name for view in session.views if view.name not in left_out])
            if robot is not None:
                part = _with_reported_arm(part, _read_back(robot, session.length_unit))
            judged = run(part)
            at = [number[view.name] for view in judged.session.views]
            total[at] += judged.view_rms**2
            count[at] += 1
    except (InputError, NoResultError):
        return None
    with np.errstate(invalid="ignore"):
        return total / count


def _read_back(robot: Robot, unit: str) -> Robot:
    """As its file says: rows where it has them, else URDF."""
    text = robot_toml(robot)
    if text is not None:
        table = tomllib.loads(text)["robot"]
        payload = table.get("payload")
        return robot_from_dh(table["name"], table["dh"], table["joints"], payload, np.array(table["gravity"]), unit)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "robot.urdf"
        file.write_text(to_urdf(robot), encoding="utf-8")
        return robot_from_urdf(file, "base_link", "flange", unit, robot.gravity)


def _with_reported_arm(session: SessionData, robot: Robot) -> SessionData:
    """As the arm of a table would have reported its poses; what a controller corrects beside its table, stays."""
    assert session.robot is not None
    nominal = session.robot

    def moved(view: View) -> View:
        assert view.joints is not None
        before, after = forward(nominal, view.joints), forward(robot, view.joints)
        return replace(view, T_base_flange=view.T_base_flange @ frames.inverse(before) @ after)

    return replace(session, robot=robot, views=tuple(map(moved, session.views)))


def write_robot(table: LinkTable, run: RunData, folder: Path, proved: Sequence[str] = ()) -> None:
    """robot.toml (for an arm of DH rows) and robot.urdf.

    Args:
        proved: what the model beside it was found to do on other sessions.
    """
    (folder / "robot.urdf").write_text(to_urdf(table.robot), encoding="utf-8")
    notes = [_HEADER, *robot_notes(table, run), *(f"The model: {line}" for line in proved)]
    text = robot_toml(table.robot, notes, run.session.repeatability)
    if text is not None:
        (folder / "robot.toml").write_text(text, encoding="utf-8")


def robot_notes(table: LinkTable, run: RunData) -> list[str]:
    """What the table is worth, what is not in it, and what has to be done so that it counts; a line each."""
    session = run.session
    notes = [table.sentence(session.length_unit)]
    if table.effects and table.ranges is not None:
        each = [f"j{i + 1} {a:.0f} … {b:.0f}°" for i, (a, b) in enumerate(np.degrees(table.ranges))]
        notes.append(f"Proved for {', '.join(each)}; beyond, nothing was measured.")
    notes.append(beyond_sentence(run.terms, table.effects))
    if table.effects and session.robot is not None and _has_reported_poses(session.path / "views.csv"):
        views = zip(reported_poses(session), session.views, strict=True)
        poses = [(T, view.joints) for T, view in views if view.joints is not None]
        off = max(float(np.linalg.norm((T - forward(session.robot, q))[:3, 3])) for T, q in poses)
        notes.append(
            "Take x … qw out of views.csv too: they are the nominal arm's (within "
            f"{length_text(off, session.length_unit, 2)}), and where they stand they are used and no table is."
        )
    return notes


def _has_reported_poses(file: Path) -> bool:
    """Return True if some row of a views.csv, checked before, has a pose; False where there is no such file."""
    if not file.is_file():
        return False
    header, rows = read_csv_rows(file)
    return any(row[name] for row in rows for name in POSE_COLUMNS if name in header)


def robot_document(
    run: RunData, table: LinkTable, notes: list[str], sentence: str, proved: Sequence[str] = ()
) -> dict[str, Any]:
    """The JSON document; `proved` is what the model was found to do on other sessions."""
    result = result_document(run)
    held, beyond = arm_effects(run.terms)
    steps = [
        {"effects": list(s.effects), "residual_rms": s.residual_rms, "heldout_rms": s.heldout_rms} for s in run.ledger
    ]
    return {
        "format": "stitch-calibrate/1",
        "kind": "robot",
        "session": run.session.name,
        "length_unit": run.session.length_unit,
        "steps": steps,
        **{key: result[key] for key in ("residual_rms", "heldout_rms", "noise_floor", "effects", "targets", "notes")},
        "outliers": result.get("outliers", []),
        "robot": dh_rows(table.robot),
        "table": {
            "effects": list(table.effects),
            "heldout_rms": table.heldout_rms,
            "nominal_heldout_rms": table.nominal_rms,
            "sentence": table.sentence(run.session.length_unit),
            "sentences": robot_notes(table, run),
        },
        "proved": list(proved),
        "beyond_dh": beyond,
        "unproved": [name for name in held if name not in table.effects],
        "way": notes,
        "left": sentence,
        "next": np.round(poses_to_add(run), 2).tolist(),
    }
