"""The calibrated arm as DH rows and as URDF, with the effects that such tables can hold."""

from stitch.calibrate.robot_calibration import calibrated_arm
from stitch.calibrate.robot_files import beyond_sentence, robot_toml
from stitch.errors import InputError
from stitch.export.arm_model import ArmModel
from stitch.export.text_lines import xml_comment
from stitch.writing.urdf_file import to_urdf


def arm_dh(arm: ArmModel) -> str:
    """The [robot] table of session.toml: DH rows in the session's length_unit and degrees.

    Raises:
        InputError: an arm that came as URDF has no DH rows.
    """
    table = robot_toml(calibrated_arm(arm.robot, arm.terms))
    if table is None:
        raise InputError(f"the arm of session {arm.session} is stated as URDF and has no DH rows; use --to arm-urdf")
    return table


def arm_urdf(arm: ArmModel) -> str:
    """URDF in m and rad: base_link, link_1 … link_n, flange."""
    found = calibrated_arm(arm.robot, arm.terms)
    declaration, chain = to_urdf(found.robot).split("\n", 1)
    told = [f"The arm of session {arm.session} with the joint offsets and link errors that were found"]
    return f"{declaration}\n{xml_comment([*told, beyond_sentence(found)])}{chain}\n"


ARM_FORMATS = {"arm-dh": arm_dh, "arm-urdf": arm_urdf}
