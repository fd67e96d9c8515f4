"""Kinematic calibration of a robot: the nominal arm with what a model found, and the poses that would tell more."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stitch.diagnosis.design.candidate_targets import candidate_rows
from stitch.diagnosis.design.candidate_views import candidate_measurement, nearby
from stitch.errors import InputError
from stitch.frames import Array
from stitch.measurement.robot import Robot, elementary
from stitch.model.term import Term, stack_parameters
from stitch.runs.run import Run

# The effects that DH rows can express.
GEOMETRY = ("joint_offset", "link_geometry")
_PROPOSED, _TRIED = 6, 250


@dataclass(frozen=True)
class CalibratedRobot:
    """The corrected arm, and the effects in use that it holds and that no table of links can hold."""

    robot: Robot
    beyond: tuple[str, ...]
    held: tuple[str, ...] = ()


def calibrated_robot_of_run(run: Run) -> CalibratedRobot:
    """The session's robot with the joint offsets and link errors of a run.

    Raises:
        InputError: the session has no robot with joints.
    """
    robot = run.session.robot
    if robot is None or not run.measurement.views.joints.shape[1]:
        raise InputError(f"{run.session.path}: no joint angles or no [robot]; a kinematic calibration needs both")
    return calibrated_robot(robot, run.terms)


def calibrated_robot(robot: Robot, terms: Sequence[Term]) -> CalibratedRobot:
    """A robot with the joint offsets and link errors of a model."""
    of_the_arm = [term.name for term in terms if term.effect.place in ("robot", "links")]
    held = tuple(name for name in of_the_arm if name in GEOMETRY)
    beyond = tuple(name for name in of_the_arm if name not in GEOMETRY)
    return CalibratedRobot(with_geometry(robot, terms), beyond, held)


def beyond_sentence(calibrated_arm: CalibratedRobot, in_table: Collection[str] = GEOMETRY) -> str:
    """What a table of links cannot hold, and what it could but does not.

    Args:
        in_table: effects in the table that is written.
    """
    told = []
    if unproved := [name for name in calibrated_arm.held if name not in in_table]:
        told.append(f"Found, but not in it for want of proof: {', '.join(unproved)}; model.toml has it.")
    if calibrated_arm.beyond:
        told.append(
            f"Not in it, because no table of links can hold it: {', '.join(calibrated_arm.beyond)}; model.toml has it."
        )
    return " ".join(told) or "No other error of the arm was found."


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


def poses_to_add(run: Run) -> Array:
    """(K, n) joint angles in degrees whose measurement would tell most of the effects' parameters.

    The determinant of the parameters' covariance falls most (D-optimal design, Fedorov 1972), one pose after
    the other, each seen beside those before it.
    """
    found = run.targets
    if found is None or not run.terms:
        return np.zeros((0, run.measurement.views.joints.shape[1]))
    joints = nearby(run.measurement.views.joints)[:_TRIED]
    _, columns, covariance = candidate_rows(
        candidate_measurement(run.measurement, joints), found.rows, found.landmarks, found.variances, run.terms
    )
    sigmas = np.array([p.sigma for p in stack_parameters(run.terms)])
    keep = np.isfinite(sigmas)
    half = np.linalg.inv(np.linalg.cholesky(covariance))
    # In units of what is known now: an information of one doubles it.
    white = half @ np.concatenate(columns, axis=2)[..., keep] * sigmas[keep]
    known, chosen = np.eye(int(keep.sum())), list[int]()
    for _ in range(min(_PROPOSED, len(joints))):
        gains = [np.linalg.slogdet(known + w.T @ w)[1] if k not in chosen else -np.inf for k, w in enumerate(white)]
        chosen.append(int(np.argmax(gains)))
        known = known + white[chosen[-1]].T @ white[chosen[-1]]
    return np.asarray(np.degrees(joints[chosen]))
