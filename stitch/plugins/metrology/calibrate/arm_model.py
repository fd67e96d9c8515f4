"""The arm of a run as its model has it: where the flange truly goes; and as DH rows or URDF for other programs."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from stitch.effects.contract import find_effect, missing_need
from stitch.errors import InputError
from stitch.model.forward import perturbed_frames
from stitch.model.model import ARM_PLACES, EffectsCovariance, Term
from stitch.model.model_toml import ModelFile, bind_to_session, convert_unit, without_events
from stitch.numerics.frames import Array
from stitch.output.session_files import robot_toml
from stitch.output.stored_run import read_result, trusted_model
from stitch.output.urdf_file import to_urdf, xml_comment
from stitch.plugins.metrology.calibrate.robot import arm_effects, beyond_sentence, with_geometry
from stitch.session import robot as kinematics
from stitch.session.capture import build_capture
from stitch.session.measurement import Measurement, Views, gravity_of, views_of
from stitch.session.reading.session_folder import load_session
from stitch.session.robot import Robot
from stitch.session.session import SessionData
from stitch.session.torques import PAYLOAD, no_torques, torques_of


@dataclass(frozen=True)
class ArmModel:
    """Nominal arm and effects of a model; lengths in length_unit."""

    session: str
    robot: Robot
    terms: tuple[Term, ...]  # effects of the arm
    length_unit: str
    joints: Array  # (V, n) rad, where the model was fitted
    other_effects: tuple[str, ...] = ()  # effects of the model that are not the arm's
    payload: float | None = None  # kg at the last view, where it is a column
    torques_measured: bool = False
    covariance: EffectsCovariance = field(default_factory=EffectsCovariance)  # of all parameters together

    def at_rest(self) -> tuple["ArmModel", tuple[str, ...]]:
        """Return the arm with what joint angles alone decide, and the names of effects of time, speed or heat."""
        still = _measurement(self, self.joints[:1], self.joints[:1], np.zeros_like(self.joints[:1]))
        here = tuple(term for term in self.terms if not missing_need(still, term.effect))
        return replace(self, terms=here), tuple(term.name for term in self.terms if term not in here)

    def true_flange(self, joints: Array, previous: Array, approach: Array) -> Array:
        """Return (K, 4, 4) T_base_flange of commanded joint angles (K, n) in rad.

        Args:
            previous: (K, n) of the targets before.
            approach: (K, n) −1, 0, +1, how each joint comes.
        """
        left, _ = perturbed_frames(_measurement(self, joints, previous, approach), self.terms)
        return left


def arm_of_run(folder: Path, effects_file: Path | None = None, trust: bool = False) -> ArmModel:
    """Return the arm of a run folder; of its session robot and joint angles are read, no scans.

    Args:
        trust: run the Python file of effects that the model names.

    Raises:
        InputError: no run, its session has gone or has no robot with joint angles, or an effect that does not fit it.
    """
    file, _ = trusted_model(folder, effects_file, trust)
    path = Path(read_result(folder)["session"])
    if not path.is_dir():
        raise InputError(f"{folder}/result.json: its session {path} has gone; to fix: put it back, or correct the path")
    return arm_from(load_session(path, scans=False), file)


def arm_from(session: SessionData, file: ModelFile) -> ArmModel:
    """Return the arm of a session with the arm's effects of a model.

    Raises:
        InputError: the session has no robot with joint angles, or an effect does not fit it.
    """
    views = views_of(session)
    if session.robot is None or not views.joints.shape[1]:
        raise InputError(f"{session.path}: no joint angles or no [robot]; to fix: state both, which an arm needs")
    T_base_flange = np.array([view.T_base_flange for view in session.views])
    measurement = _arm_measurement(session.name, session.robot, T_base_flange, views, session.length_unit)
    effects = without_events(file).effects
    of_arm = {name: values for name, values in effects.items() if find_effect(name).place in ARM_PLACES}
    model = bind_to_session(convert_unit(replace(file, effects=of_arm), session.length_unit), measurement)
    return ArmModel(
        session=session.name,
        robot=session.robot,
        terms=model.terms,
        covariance=model.effects_covariance,
        payload=float(views.covariates[PAYLOAD][-1]) if PAYLOAD in views.covariates else None,
        torques_measured=views.torques.measured,
        length_unit=session.length_unit,
        joints=views.joints,
        other_effects=tuple(name for name in file.effects if name not in of_arm),
    )


def _measurement(arm: ArmModel, joints: Array, previous: Array, approach: Array) -> Measurement:
    """Return targets of a program as views: at rest, at no stated time and temperature."""
    count, T_base_flange = len(joints), kinematics.forward(arm.robot, joints)
    payload = None if arm.payload is None else np.full(count, arm.payload)
    views = Views(
        count=count,
        time=np.zeros(count),
        joints=joints,
        previous=previous,
        approach=approach,
        velocity=None,
        # A model that follows what drives report has none here: a program does not hold that.
        torques=no_torques(count) if arm.torques_measured else torques_of(arm.robot, joints, payload),
        covariates={},
        standoff=1.0,
        first={},
        number=np.arange(count),
        path=joints,
        T_base_flange=T_base_flange,
        gravity=gravity_of(arm.robot),
        eye_to_hand=False,
    )
    return _arm_measurement(arm.session, arm.robot, T_base_flange, views, arm.length_unit)


def _arm_measurement(name: str, robot: Robot, T_base_flange: Array, views: Views, length_unit: str) -> Measurement:
    """Return a measurement of the arm alone; what carries the scanner does not matter."""
    capture = build_capture(name, (), T_base_flange, "eye_in_hand")
    return Measurement(capture, T_base_flange, False, robot, views, (), length_unit)


def arm_dh(arm: ArmModel) -> str:
    """Return the [robot] table of session.toml: DH rows in the session's length_unit and degrees.

    Raises:
        InputError: an arm that came as URDF has no DH rows.
    """
    table = robot_toml(
        with_geometry(arm.robot, arm.terms), ["The [robot] table of session.toml", *_comment_lines(arm.terms)]
    )
    if table is None:
        raise InputError(f"the arm of session {arm.session} is stated as URDF, without DH rows; to fix: --to arm-urdf")
    return table


def arm_urdf(arm: ArmModel) -> str:
    """Return URDF in m and rad: base_link, link_1 … link_n, flange."""
    declaration, chain = to_urdf(with_geometry(arm.robot, arm.terms)).split("\n", 1)
    comment = xml_comment([f"The arm of session {arm.session}", *_comment_lines(arm.terms)])
    return f"{declaration}\n{comment}{chain}\n"


def _comment_lines(terms: Sequence[Term]) -> list[str]:
    """Return what is in it, what is not, and which command fits a table that stands alone."""
    lines = ["with the joint offsets and link errors that the model of the run has.", beyond_sentence(terms)]
    if arm_effects(terms)[1]:
        lines.append(
            "Without it this may leave more than the nominal arm; stitch calibrate robot fits a table for itself."
        )
    return lines


ARM_FORMATS = {"arm-dh": arm_dh, "arm-urdf": arm_urdf}
